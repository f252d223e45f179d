"""The pages on numerics and robustness cite only existing tests and cases, and they cite every hard case.

All hard cases are in this folder instead of beside the modules that they test, because each test here is one row of
these pages, and many rows involve several packages.
"""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

REPOSITORY_ROOT = Path(__file__).parents[2]
CITING_PAGES = [REPOSITORY_ROOT / "docs" / "explanation" / name for name in ("numerics.md", "robustness.md")]
CITATION_PATTERN = re.compile(r"`(tests/[\w/]+\.py)::(test_\w+)(?:\[([^`]+)\])?`")


@cache
def _parse(path: str) -> ast.Module:
    return ast.parse((REPOSITORY_ROOT / path).read_text(encoding="utf-8"))


@cache
def _test_names(path: str) -> set[str]:
    """Names of the test functions of a file."""
    functions = {node.name for node in _parse(path).body if isinstance(node, ast.FunctionDef)}
    return {name for name in functions if name.startswith("test_")}


@cache
def _string_constants(path: str) -> set[str]:
    nodes = (node for node in ast.walk(_parse(path)) if isinstance(node, ast.Constant))
    return {node.value for node in nodes if isinstance(node.value, str)}


def _read_citations() -> list[tuple[str, str, str]]:
    return [found for page in CITING_PAGES for found in CITATION_PATTERN.findall(page.read_text(encoding="utf-8"))]


def test_every_cited_test_exists() -> None:
    citations = _read_citations()
    assert len(citations) > 50
    missing = {f"{path}::{name}" for path, name, _ in citations if name not in _test_names(path)}
    assert not missing


def test_every_cited_case_exists() -> None:
    """A case is the name in brackets, after the implementation where the test has several."""
    missing = set()
    for path, name, case in _read_citations():
        if case and not _string_constants(path) & {case, case.partition("-")[2]}:
            missing.add(f"{path}::{name}[{case}]")
    assert not missing


def test_every_hard_case_is_cited() -> None:
    cited = {(path, name) for path, name, _ in _read_citations()}
    files = sorted(path.relative_to(REPOSITORY_ROOT).as_posix() for path in Path(__file__).parent.glob("test_*.py"))
    hard = {(path, name) for path in files if not path.endswith("test_documented.py") for name in _test_names(path)}
    assert not hard - cited

"""docs/explanation/numerics.md and the tests: what it cites exists, and it cites every hard case.

Hard cases lie together in this folder, not each with the module that it strains, because together they are what that
page promises: every test here is one of its rows, and what one row asks for often runs through several rooms.
"""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
CITATION = re.compile(r"`(tests/[\w/]+\.py)::(test_\w+)(?:\[([^`]+)\])?`")


@cache
def _tree(path: str) -> ast.Module:
    return ast.parse((ROOT / path).read_text(encoding="utf-8"))


@cache
def _tests(path: str) -> set[str]:
    """Names of the test functions of a file."""
    functions = {node.name for node in _tree(path).body if isinstance(node, ast.FunctionDef)}
    return {name for name in functions if name.startswith("test_")}


@cache
def _strings(path: str) -> set[str]:
    nodes = (node for node in ast.walk(_tree(path)) if isinstance(node, ast.Constant))
    return {node.value for node in nodes if isinstance(node.value, str)}


def _citations() -> list[tuple[str, str, str]]:
    return CITATION.findall((ROOT / "docs" / "explanation" / "numerics.md").read_text(encoding="utf-8"))


def test_every_cited_test_exists() -> None:
    citations = _citations()
    assert len(citations) > 50
    missing = {f"{path}::{name}" for path, name, _ in citations if name not in _tests(path)}
    assert not missing


def test_every_cited_case_exists() -> None:
    """A case is the name in brackets, after the implementation where there is one."""
    missing = set()
    for path, name, case in _citations():
        if case and not _strings(path) & {case, case.partition("-")[2]}:
            missing.add(f"{path}::{name}[{case}]")
    assert not missing


def test_every_hard_case_is_cited() -> None:
    cited = {(path, name) for path, name, _ in _citations()}
    files = sorted(path.relative_to(ROOT).as_posix() for path in Path(__file__).parent.glob("test_*.py"))
    hard = {(path, name) for path in files if not path.endswith("test_documented.py") for name in _tests(path)}
    assert not hard - cited

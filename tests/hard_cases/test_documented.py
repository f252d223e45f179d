"""docs/numerics.md and the tests: what it cites exists, and it cites every hard case.

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
def _tests(path: str) -> dict[str, str]:
    """The source, decorators included, of each test function of a file, by name."""
    source = (ROOT / path).read_text(encoding="utf-8")
    functions = (node for node in ast.parse(source).body if isinstance(node, ast.FunctionDef))
    return {
        node.name: "\n".join(ast.get_source_segment(source, part) or "" for part in (*node.decorator_list, node))
        for node in functions
        if node.name.startswith("test_")
    }


def _citations() -> list[tuple[str, str, str]]:
    return CITATION.findall((ROOT / "docs" / "numerics.md").read_text(encoding="utf-8"))


def test_every_cited_test_exists() -> None:
    citations = _citations()
    assert len(citations) > 50
    missing = {f"{path}::{name}" for path, name, _ in citations if name not in _tests(path)}
    assert not missing


def test_every_cited_case_exists() -> None:
    """A case is the name in brackets, after the implementation where there is one."""
    missing = set()
    for path, name, case in _citations():
        strings = {
            node.value
            for node in ast.walk(ast.parse((ROOT / path).read_text(encoding="utf-8")))
            if isinstance(node, ast.Constant) and isinstance(node.value, str)
        }
        if case and not strings & {case, case.partition("-")[2]}:
            missing.add(f"{path}::{name}[{case}]")
    assert not missing


def test_every_hard_case_is_cited() -> None:
    cited = {(path, name) for path, name, _ in _citations()}
    files = sorted(path.relative_to(ROOT).as_posix() for path in Path(__file__).parent.glob("test_*.py"))
    hard = {(path, name) for path in files if not path.endswith("test_documented.py") for name in _tests(path)}
    assert not hard - cited

"""Every import of the package runs down the floors that docs/architecture.md lists, so that rooms know no circle."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "hyrfpack"
PAGE = ROOT / "docs" / "architecture.md"


def floors() -> list[list[str]]:
    """The rooms of each floor, top floor first, from the first indented block of the page."""
    block = re.search(r"(?:^    .*\n)+", PAGE.read_text(), re.MULTILINE)
    return [re.split(r"  +", line.strip())[0].split(", ") for line in block[0].splitlines()]


def room_of(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imports(path: Path, text: str | None = None) -> Iterator[tuple[int, str]]:
    """(line, dotted name) of what a file imports, inside functions and under TYPE_CHECKING, too."""
    for node in ast.walk(ast.parse(path.read_text() if text is None else text)):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{path}:{node.lineno}: imports are absolute here"
            yield from ((node.lineno, f"{node.module}.{alias.name}") for alias in node.names)


def upward(path: Path, text: str | None = None) -> list[str]:
    """The imports of a file that do not run down."""
    height = {room: -place for place, floor in enumerate(floors()) for room in floor}
    here, wrong = room_of(path), []
    for line, name in imports(path, text):
        package, room, *_ = f"{name}.".split(".")
        if package == "hyrfpack" and room in height and room != here and height[room] >= height[here]:
            wrong.append(f"{path.relative_to(ROOT)}:{line}: {here} imports {room}")
    return wrong


def modules() -> list[Path]:
    """All of the package but its front door, which names what is public, and what starts the command line."""
    return [path for path in sorted(PACKAGE.rglob("*.py")) if room_of(path) not in ("__init__", "__main__")]


def test_the_page_names_every_room_once():
    assert sorted(room for floor in floors() for room in floor) == sorted({room_of(path) for path in modules()})


def test_no_import_runs_upwards_or_across():
    assert [line for path in modules() for line in upward(path)] == []


@pytest.mark.parametrize(
    "text",
    [
        "from hyrfpack.bench.rows import Row",
        "import hyrfpack.compress.packer",
        "from hyrfpack import train",
        "def f():\n    from hyrfpack.quant import bits",
    ],
)
def test_an_import_upwards_or_across_would_be_seen(text):
    assert upward(PACKAGE / "ops" / "made_up.py", text)


def test_the_package_knows_neither_tools_nor_tests():
    known = {name.partition(".")[0] for path in PACKAGE.rglob("*.py") for _, name in imports(path)}
    assert "numpy" in known and not known & {"tools", "tests"}

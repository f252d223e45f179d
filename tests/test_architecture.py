"""Every import of the package runs downwards through the layers that docs/explanation/architecture.md lists."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import pytest

REPOSITORY_ROOT = Path(__file__).parents[1]
PACKAGE_FOLDER = REPOSITORY_ROOT / "hyrfpack"
ARCHITECTURE_PAGE = REPOSITORY_ROOT / "docs" / "explanation" / "architecture.md"


@cache
def read_layers() -> list[list[str]]:
    """Return the packages of each layer, top layer first, from the first indented block of the page."""
    block = re.search(r"(?:^    .*\n)+", ARCHITECTURE_PAGE.read_text(), re.MULTILINE)
    return [re.split(r"  +", line.strip())[0].split(", ") for line in block[0].splitlines()]


def package_of(path: Path) -> str:
    """Return the sub-package or top-level module that a file belongs to."""
    return path.relative_to(PACKAGE_FOLDER).parts[0].removesuffix(".py")


@cache
def read_imports(path: Path, text: str | None = None) -> list[tuple[int, str]]:
    """Return (line, dotted name) of each import of a file, also inside functions and under TYPE_CHECKING."""
    imports: list[tuple[int, str]] = []
    for node in ast.walk(ast.parse(path.read_text() if text is None else text)):
        if isinstance(node, ast.Import):
            imports += ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{path}:{node.lineno}: imports are absolute here"
            imports += ((node.lineno, f"{node.module}.{alias.name}") for alias in node.names)
    return imports


def find_upward_imports(path: Path, text: str | None = None) -> list[str]:
    """Return the imports of a file that do not run downwards."""
    height = {room: -place for place, floor in enumerate(read_layers()) for room in floor}
    here, wrong = package_of(path), []
    for line, name in read_imports(path, text):
        package, room, *_ = f"{name}.".split(".")
        if package == "hyrfpack" and room in height and room != here and height[room] >= height[here]:
            wrong.append(f"{path.relative_to(REPOSITORY_ROOT)}:{line}: {here} imports {room}")
    return wrong


def list_modules() -> list[Path]:
    """Return all files of the package except `__init__.py`, which names what is public, and `__main__.py`."""
    return [path for path in sorted(PACKAGE_FOLDER.rglob("*.py")) if package_of(path) not in ("__init__", "__main__")]


def test_the_architecture_page_names_every_package_once():
    assert sorted(room for floor in read_layers() for room in floor) == sorted(
        {package_of(path) for path in list_modules()}
    )


def test_no_import_runs_upwards_or_across():
    assert [line for path in list_modules() for line in find_upward_imports(path)] == []


@pytest.mark.parametrize(
    "text",
    [
        "from hyrfpack.bench.rows import Row",
        "import hyrfpack.compress.packer",
        "from hyrfpack import train",
        "def f():\n    from hyrfpack.quant import bits",
    ],
)
def test_an_import_upwards_or_across_is_found(text):
    assert find_upward_imports(PACKAGE_FOLDER / "ops" / "made_up.py", text)


def test_the_package_imports_neither_tools_nor_tests():
    known = {name.partition(".")[0] for path in PACKAGE_FOLDER.rglob("*.py") for _, name in read_imports(path)}
    assert "numpy" in known and not known & {"tools", "tests"}


def test_compiled_kernels_take_constants_and_functions_from_their_own_package():
    """Their machine code on disk is stamped with the sources of this package (`hyrfpack.parallel.compiled`)."""
    kernel_files = [
        path
        for path in list_modules()
        if re.search(r"^@(_kernel|_inlined|njit|compiled)\b", path.read_text(), re.MULTILINE)
    ]
    callers = (
        "hyrfpack.parallel.compiled",
        "hyrfpack.parallel.pool",
    )  # The digest has the first; no kernel calls either.
    own = {path: (*callers, f"hyrfpack.{package_of(path)}.") for path in kernel_files}
    assert len(kernel_files) > 5
    assert [
        f"{path}:{line}: {name}"
        for path in kernel_files
        for line, name in read_imports(path)
        if name.startswith("hyrfpack.") and not name.startswith(own[path])
    ] == []

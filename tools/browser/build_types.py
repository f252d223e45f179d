"""Write the type declarations of hyrf.js from the JSDoc comments of its modules.

    python -m tools.browser.build_types       needs node, and TypeScript in tests/node

The declarations are stored in hyrfpack/web/hyrf/types/, to which the package's `exports` refer. The same sources give
the same bytes.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import tempfile
from pathlib import Path

from tools.browser.node_programs import REPOSITORY_ROOT, run_node_program
from tools.command import run_command

HYRF_FOLDER = REPOSITORY_ROOT / "hyrfpack" / "web" / "hyrf"
TYPES_FOLDER = HYRF_FOLDER / "types"
MODULE_PATTERN = re.compile(r'"\./(\w+\.js)"')
TSC_OPTIONS = (
    "--ignoreConfig --declaration --emitDeclarationOnly --allowJs --checkJs --strict --target es2022 "
    "--module nodenext --lib es2022,dom"
).split()


def list_public_modules() -> list[str]:
    """Return the names of the modules that the package exports."""
    exports = json.loads((HYRF_FOLDER / "package.json").read_text("utf-8"))["exports"]
    return [conditions["default"].removeprefix("./") for conditions in exports.values()]


def build_types() -> dict[str, str]:
    """Return the declarations of the public modules, and those to which these refer, by file name.

    Raises:
        HyrfError: TypeScript is not installed, or refuses a module.
    """
    with tempfile.TemporaryDirectory() as folder:
        options = [*TSC_OPTIONS, "--types", "", "--outDir", folder]
        run_node_program("tsc", *options, *list_public_modules(), working_folder=HYRF_FOLDER)
        declarations = {path.name: path.read_text("utf-8") for path in sorted(Path(folder).iterdir())}
    # The compiler also writes those of modules that only implementations import.
    needed_names: set[str] = set()
    referenced_names = {declaration_name(module) for module in list_public_modules()}
    while referenced_names - needed_names:
        needed_names |= referenced_names
        texts = [declarations[name] for name in needed_names]
        referenced_names = {declaration_name(module) for text in texts for module in MODULE_PATTERN.findall(text)}
    return {name: text for name, text in declarations.items() if name in needed_names}


def declaration_name(module: str) -> str:
    """Return the file name of the declarations of a module."""
    return f"{module.removesuffix('.js')}.d.ts"


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    declarations = build_types()
    shutil.rmtree(TYPES_FOLDER, ignore_errors=True)
    TYPES_FOLDER.mkdir()
    for name, text in declarations.items():
        (TYPES_FOLDER / name).write_text(text, "utf-8")
    print(f"{len(declarations)} files of type declarations")


if __name__ == "__main__":
    run_command(main)

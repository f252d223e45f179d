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
import subprocess
import tempfile
from pathlib import Path

from tools.browser.build_player import PROGRAMS_FOLDER, REPOSITORY_ROOT

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
        SystemExit: TypeScript is not installed, or it refuses a module; it has printed the reason.
    """
    program = PROGRAMS_FOLDER / "tsc"
    if not program.exists():
        raise SystemExit(f"{program} is missing: install node, then run 'npm ci --prefix tests/node'")
    with tempfile.TemporaryDirectory() as folder:
        command = [program, *TSC_OPTIONS, "--types", "", "--outDir", folder, *list_public_modules()]
        if subprocess.run(command, cwd=HYRF_FOLDER).returncode:
            raise SystemExit("the type declarations of hyrf.js could not be written")
        declarations = {path.name: path.read_text("utf-8") for path in sorted(Path(folder).iterdir())}
    # The compiler also writes those of modules that only implementations import.
    needed: set[str] = set()
    found = {declaration_name(module) for module in list_public_modules()}
    while found - needed:
        needed |= found
        found = {declaration_name(name) for file in needed for name in MODULE_PATTERN.findall(declarations[file])}
    return {name: text for name, text in declarations.items() if name in needed}


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
    main()

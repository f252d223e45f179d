"""The type declarations of hyrf.js are those of its modules, and strict TypeScript compiles against them."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from tools.browser.build_types import HYRF_FOLDER, TYPES_FOLDER, build_types, list_public_modules

USER_FILE = Path(__file__).with_name("user.ts")
STRICT_FLAGS = (
    "--noEmit --strict --exactOptionalPropertyTypes --noUncheckedIndexedAccess --noUnusedLocals --module nodenext "
    "--target es2022 --lib es2022,dom --ignoreConfig"
).split()


MISTAKES = [
    "void read('scene.hyrf');",
    "void openRemoteModel(5);",
    "void openRemoteModel('a', { onOrder: (order: string) => order });",
    "export const levels: string = gridLevels({});",
]
MODULES = [name for name in list_public_modules() if name != "remote_worker.js"]


def exported_names() -> dict[str, list[str]]:
    """Return the names that each module exports, by module."""
    code = f"""
        const names = {{}};
        for (const module of {json.dumps(MODULES)}) names[module] = Object.keys(await import(`./${{module}}`));
        console.log(JSON.stringify(names));"""
    command = ["node", "--input-type=module", "-e", code]
    done = subprocess.run(command, cwd=HYRF_FOLDER, capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def declare_names(module: str, names: list[str]) -> str:
    """Return a program that compiles only if a module declares these names and no others."""
    address = "hyrf.js" if module == "index.js" else f"hyrf.js/{module}"
    listed = ", ".join(f"{name}: true" for name in names)
    declared = "{ [Name in keyof typeof all]: true }"
    return f'import * as all from "{address}";\nexport const names: {declared} = {{ {listed} }};\n'


@pytest.fixture(scope="module")
def error_lines(compiler: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[int]]:
    """Return the lines with type errors in each program, by the program's name.

    The compiler checks all programs at once, because its start takes most of the time. They are in a folder in which a
    copy of hyrf.js is installed, without the sources of its modules.
    """
    folder = tmp_path_factory.mktemp("programs")
    installed = folder / "node_modules" / "hyrf.js"
    installed.mkdir(parents=True)
    shutil.copy(HYRF_FOLDER / "package.json", installed)
    shutil.copytree(TYPES_FOLDER, installed / "types")
    (folder / "package.json").write_text('{"type": "module"}')

    programs = {"user.ts": USER_FILE.read_text()}
    for number, mistake in enumerate(MISTAKES):
        programs[f"mistake{number}.ts"] = f"{USER_FILE.read_text()}\n{mistake}\n"
    for module, names in exported_names().items():
        assert names, module
        programs[f"{module}.all.ts"] = declare_names(module, names)
        programs[f"{module}.fewer.ts"] = declare_names(module, names[1:])
    for name, text in programs.items():
        (folder / name).write_text(text)

    command = ["node", str(compiler), *STRICT_FLAGS, "--types", "", *programs]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120)
    lines: dict[str, list[int]] = {name: [] for name in programs}
    for name, line in re.findall(r"^(\S.*?)\((\d+),\d+\): error ", done.stdout, re.MULTILINE):
        lines[name].append(int(line))
    return lines


def test_the_declarations_were_made_from_the_current_modules(compiler):
    stored = {path.name: path.read_text("utf-8") for path in TYPES_FOLDER.iterdir()}
    assert stored == build_types(), "a module has changed: run 'make player'"


@pytest.mark.acceptance
def test_strict_typescript_compiles_a_program_of_a_user(error_lines):
    assert error_lines["user.ts"] == []


@pytest.mark.parametrize("number", range(len(MISTAKES)), ids=MISTAKES)
def test_mistakes_are_type_errors(error_lines, number):
    last = len(USER_FILE.read_text().splitlines()) + 2
    assert error_lines[f"mistake{number}.ts"][0] == last


@pytest.mark.parametrize("module", MODULES)
def test_every_exported_name_is_declared_and_no_other(error_lines, module):
    assert error_lines[f"{module}.all.ts"] == []
    assert error_lines[f"{module}.fewer.ts"], "the check does not see a missing name"

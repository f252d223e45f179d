"""The type declarations of hyrf.js are those of its modules, and strict TypeScript compiles against them."""

from __future__ import annotations

import json
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


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """Return a folder in which a copy of hyrf.js is installed, without the sources of its modules."""
    installed = tmp_path / "node_modules" / "hyrf.js"
    installed.mkdir(parents=True)
    shutil.copy(HYRF_FOLDER / "package.json", installed)
    shutil.copytree(TYPES_FOLDER, installed / "types")
    (tmp_path / "package.json").write_text('{"type": "module"}')
    return tmp_path


def compile_file(compiler: Path, project: Path, text: str) -> subprocess.CompletedProcess:
    (project / "user.ts").write_text(text)
    command = ["node", str(compiler), *STRICT_FLAGS, "--types", "", "user.ts"]
    return subprocess.run(command, cwd=project, capture_output=True, text=True, timeout=120)


def test_the_declarations_were_made_from_the_current_modules(compiler):
    stored = {path.name: path.read_text("utf-8") for path in TYPES_FOLDER.iterdir()}
    assert stored == build_types(), "a module has changed: run 'make player'"


def test_strict_typescript_compiles_a_program_of_a_user(compiler, project):
    done = compile_file(compiler, project, USER_FILE.read_text())
    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize(
    "mistake",
    [
        "void read('scene.hyrf');",
        "void openRemoteModel(5);",
        "void openRemoteModel('a', { onOrder: (order: string) => order });",
        "export const levels: string = gridLevels({});",
    ],
)
def test_mistakes_are_type_errors(compiler, project, mistake):
    done = compile_file(compiler, project, f"{USER_FILE.read_text()}\n{mistake}\n")
    assert done.returncode != 0
    last = len(USER_FILE.read_text().splitlines()) + 2
    assert done.stdout.startswith(f"user.ts({last},"), done.stdout


@pytest.mark.parametrize("module", [name for name in list_public_modules() if name != "remote_worker.js"])
def test_every_exported_name_is_declared_and_no_other(compiler, project, module):
    code = f"console.log(JSON.stringify(Object.keys(await import('./{module}'))))"
    done = subprocess.run(
        ["node", "--input-type=module", "-e", code], cwd=HYRF_FOLDER, capture_output=True, text=True, check=True
    )
    names = json.loads(done.stdout)
    assert names
    address = "hyrf.js" if module == "index.js" else f"hyrf.js/{module}"
    listed = ", ".join(f"{name}: true" for name in names)
    declared = "{ [Name in keyof typeof all]: true }"
    text = f'import * as all from "{address}";\nexport const names: {declared} = {{ {listed} }};'

    done = compile_file(compiler, project, text)

    assert done.returncode == 0, done.stdout
    fewer = text.replace(f"{names[0]}: true", "")
    assert compile_file(compiler, project, fewer).returncode != 0, "the check does not see a missing name"

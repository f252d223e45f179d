"""Build the npm package hyrf-viewer from the player's modules.

    python -m tools.browser.build_package dist/hyrf-viewer       needs node, and esbuild in tests/node

The folder then has the package's modules with source maps, the worker's script, type declarations, README and licence;
`npm publish` in it publishes the package. It prints each file's length in bytes. An earlier package in the folder is
replaced once the new one is complete; a folder with anything else in it is refused.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shutil
from pathlib import Path

from hyrfpack.atomic import make_folder, naming_failed_write, temporary_folder
from hyrfpack.errors import HyrfError
from hyrfpack.web.player import embedded_texts, webgpu_texts
from hyrfpack.web.scripts import is_minified_current, read_script
from tools.browser.node_programs import REPOSITORY_ROOT, run_node_program
from tools.command import run_command

PACKAGE_NAME = "hyrf-viewer"
PACKAGE_FOLDER = REPOSITORY_ROOT / "npm" / PACKAGE_NAME
ENTRY_NAMES = ("index.js", "element.js", "webgpu.js")
COPIED_NAMES = ("package.json", "README.md", "index.d.ts", "element.d.ts", "webgpu.d.ts")
ESBUILD_OPTIONS = (
    "--bundle --splitting --minify --sourcemap --format=esm --target=es2022 --charset=utf8 --legal-comments=none "
    "--chunk-names=[name]-[hash] --log-level=warning"
).split()


def build_package(folder: Path) -> None:
    """Write the package into a folder, which appears or is replaced when the package is complete.

    Raises:
        HyrfError: esbuild is not installed or refuses a source, the minified player is not current, or the folder holds
            something else than a package or cannot be written.
    """
    check_replaceable(folder)
    if not is_minified_current():
        raise HyrfError("the minified player was made from other sources", fix="run 'make player'")
    make_folder(folder.parent)
    # The temporary folder lies beside the final one, because source maps hold paths relative to it.
    with naming_failed_write(folder), temporary_folder(folder.parent) as temporary:
        _write_files(temporary)
        temporary.chmod(0o755)
        if folder.exists():
            shutil.rmtree(folder)
        os.rename(temporary, folder)


def check_replaceable(folder: Path) -> None:
    """Check that a folder does not exist, is empty or holds an earlier package.

    Raises:
        HyrfError: it is something else.
    """
    if not os.path.lexists(folder):
        return
    if not folder.is_dir() or folder.is_symlink():
        raise HyrfError(f"{folder}: this is not a folder", fix="choose another folder")
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        if json.loads((folder / "package.json").read_text("utf-8"))["name"] == PACKAGE_NAME:
            return
    if any(folder.iterdir()):
        raise HyrfError(
            f"{folder}: the files in this folder are not a package {PACKAGE_NAME}", fix="choose another folder"
        )


def _write_files(folder: Path) -> None:
    """Write the files of the package into an empty folder."""
    constants = {"EMBEDDED_TEXTS": embedded_texts("worker.js"), "WEBGPU_TEXTS": webgpu_texts()}
    files = [folder / f"{name.lower()}.js" for name in constants]  # two, so that each module gets only what it uses
    for file, (name, texts) in zip(files, constants.items(), strict=True):
        file.write_text(f"export const {name} = {json.dumps(texts)};\n", "utf-8")
    entries = [str(PACKAGE_FOLDER / name) for name in ENTRY_NAMES]
    inject = [f"--inject:{file}" for file in files]  # esbuild replaces the constants of the modules by these
    # The names of chunks depend on the paths of all files from here. So these may not hold the folder's random name.
    run_node_program("esbuild", *entries, *ESBUILD_OPTIONS, *inject, "--outdir=.", working_folder=folder)
    for file in files:
        file.unlink()
    (folder / "worker.js").write_text(read_script("worker.js"), "utf-8")
    for name in COPIED_NAMES:
        shutil.copy(PACKAGE_FOLDER / name, folder / name)
    shutil.copy(REPOSITORY_ROOT / "LICENSE", folder / "LICENSE")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="output folder; an earlier package in it is replaced")
    folder = parser.parse_args().folder
    build_package(folder)
    for path in sorted(folder.iterdir()):
        print(f"{path.name}: {path.stat().st_size:,} bytes")


if __name__ == "__main__":
    run_command(main)

"""Build the npm package hyrf-viewer from the player's modules.

    python -m tools.browser.build_package dist/hyrf-viewer       needs node, and esbuild in tests/node

The folder then has the package's modules with source maps, the worker's script, type declarations, README and licence;
`npm publish` in it publishes the package. It prints each file's length in bytes.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
from pathlib import Path

from hyrfpack.web.player import embedded_texts, webgpu_texts
from hyrfpack.web.scripts import is_minified_current, read_script
from tools.browser.build_player import PROGRAMS_FOLDER, REPOSITORY_ROOT

PACKAGE_FOLDER = REPOSITORY_ROOT / "npm" / "hyrf-viewer"
ENTRY_NAMES = ("index.js", "element.js", "webgpu.js")
COPIED_NAMES = ("package.json", "README.md", "index.d.ts", "element.d.ts", "webgpu.d.ts")
ESBUILD_OPTIONS = (
    "--bundle --splitting --minify --sourcemap --format=esm --target=es2022 --charset=utf8 --legal-comments=none "
    "--chunk-names=[name]-[hash] --log-level=warning"
).split()


def build_package(folder: Path) -> None:
    """Write the package into a folder, which is emptied before.

    Raises:
        SystemExit: esbuild is not installed, or the minified player is not current.
        subprocess.CalledProcessError: it refuses a source; it has printed the reason.
    """
    program = PROGRAMS_FOLDER / "esbuild"
    if not program.exists():
        raise SystemExit(f"{program} is missing: install node, then run 'npm ci --prefix tests/node'")
    if not is_minified_current():
        raise SystemExit("the minified player was made from other sources: run 'make player'")
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    constants = {"EMBEDDED_TEXTS": embedded_texts("worker.js"), "WEBGPU_TEXTS": webgpu_texts()}
    files = [folder / f"{name.lower()}.js" for name in constants]  # two, so that each module gets only what it uses
    for file, (name, texts) in zip(files, constants.items(), strict=True):
        file.write_text(f"export const {name} = {json.dumps(texts)};\n", "utf-8")
    entries = [str(PACKAGE_FOLDER / name) for name in ENTRY_NAMES]
    inject = [f"--inject:{file}" for file in files]  # esbuild replaces the constants of the modules by these
    subprocess.run([program, *entries, *ESBUILD_OPTIONS, *inject, f"--outdir={folder}"], check=True)
    for file in files:
        file.unlink()
    (folder / "worker.js").write_text(read_script("worker.js"), "utf-8")
    for name in COPIED_NAMES:
        shutil.copy(PACKAGE_FOLDER / name, folder / name)
    shutil.copy(REPOSITORY_ROOT / "LICENSE", folder / "LICENSE")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="output folder; it is emptied before")
    folder = parser.parse_args().folder
    build_package(folder)
    for path in sorted(folder.iterdir()):
        print(f"{path.name}: {path.stat().st_size:,} bytes")


if __name__ == "__main__":
    main()

"""Minify the web player's scripts and style sheet into hyrfpack/web/minified/, so that exported pages are small.

    python -m tools.browser.build_player       needs node, and esbuild and terser in tests/node

esbuild makes one script of each module and its imports. terser then shortens it further: pages are 3 % smaller than by
esbuild alone. The digest of the sources is stored beside the results, because pages use them only while it matches.
The same sources give the same bytes. It prints each file's length in bytes.
"""

from __future__ import annotations

import argparse
import subprocess
from pathlib import Path

from hyrfpack.atomic import write_atomic
from hyrfpack.web.scripts import (
    DIGEST_NAME,
    EDITING_STYLE_NAME,
    MINIFIED_FOLDER,
    SCRIPT_NAMES,
    STYLE_NAME,
    source_digest,
)

REPOSITORY_ROOT = Path(__file__).parents[2]
WEB_FOLDER = REPOSITORY_ROOT / "hyrfpack" / "web"
PROGRAMS_FOLDER = REPOSITORY_ROOT / "tests" / "node" / "node_modules" / ".bin"
ESBUILD_OPTIONS = (
    "--bundle --minify --format=iife --target=es2022 --charset=utf8 --legal-comments=none --log-level=warning"
).split()
STRICT_MODE = '--banner:js="use strict";'  # modules are strict, and a script is not by itself
TERSER_OPTIONS = "--ecma 2020 --mangle --compress passes=3,unsafe_arrows=true".split()


def build_player() -> dict[str, bytes]:
    """Return the minified files by name, and the digest of their sources.

    Raises:
        SystemExit: esbuild or terser is not installed.
        subprocess.CalledProcessError: one of them refuses a source; it has printed the reason.
    """
    scripts = {name: _run("terser", *TERSER_OPTIONS, stdin=_bundle(name, STRICT_MODE)) for name in SCRIPT_NAMES}
    styles = {name: _bundle(name) for name in (STYLE_NAME, EDITING_STYLE_NAME)}
    return scripts | styles | {DIGEST_NAME: f"{source_digest()}\n".encode()}


def _bundle(name: str, *options: str) -> bytes:
    """Return a file of the player and all that it imports as one minified file."""
    return _run("esbuild", str(WEB_FOLDER / "viewer" / name), *ESBUILD_OPTIONS, *options)


def _run(name: str, *arguments: str, stdin: bytes = b"") -> bytes:
    program = PROGRAMS_FOLDER / name
    if not program.exists():
        raise SystemExit(f"{program} is missing: install node, then run 'npm ci --prefix tests/node'")
    return subprocess.run([program, *arguments], input=stdin, stdout=subprocess.PIPE, check=True).stdout


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    for name, data in build_player().items():
        write_atomic(WEB_FOLDER / MINIFIED_FOLDER / name, data)
        print(f"{name}: {len(data):,} bytes")


if __name__ == "__main__":
    main()

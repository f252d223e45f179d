"""Minify the web player's scripts and style sheet into hyrfpack/web/minified/, so that exported pages are small.

    python -m tools.browser.build_player       needs node, and esbuild and terser in tests/node

esbuild makes one script of each module and its imports. terser then shortens it further: pages are 3 % smaller than by
esbuild alone. The digest of the sources is stored beside the results, because pages use them only while it matches.
The same sources give the same bytes. It prints each file's length in bytes.
"""

from __future__ import annotations

import argparse

from hyrfpack.atomic import write_atomic
from hyrfpack.web.scripts import (
    DIGEST_NAME,
    EDITING_STYLE_NAME,
    MINIFIED_FOLDER,
    SCRIPT_NAMES,
    STYLE_NAME,
    source_digest,
)
from tools.browser.node_programs import REPOSITORY_ROOT, run_node_program
from tools.command import run_command

WEB_FOLDER = REPOSITORY_ROOT / "hyrfpack" / "web"
ESBUILD_OPTIONS = (
    "--bundle --minify --format=iife --target=es2022 --charset=utf8 --legal-comments=none --log-level=warning"
).split()
STRICT_MODE_OPTION = '--banner:js="use strict";'  # modules are strict, and a script is not by itself
TERSER_OPTIONS = "--ecma 2020 --mangle --compress passes=3,unsafe_arrows=true".split()


def build_player() -> dict[str, bytes]:
    """Return the minified files by name, and the digest of their sources.

    Raises:
        HyrfError: esbuild or terser is not installed, or refuses a source.
    """
    scripts = {
        name: run_node_program("terser", *TERSER_OPTIONS, stdin=_bundle(name, STRICT_MODE_OPTION))
        for name in SCRIPT_NAMES
    }
    styles = {name: _bundle(name) for name in (STYLE_NAME, EDITING_STYLE_NAME)}
    return scripts | styles | {DIGEST_NAME: f"{source_digest()}\n".encode()}


def _bundle(name: str, *options: str) -> bytes:
    """Return a file of the player and all that it imports as one minified file."""
    return run_node_program("esbuild", str(WEB_FOLDER / "viewer" / name), *ESBUILD_OPTIONS, *options)


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    for name, data in build_player().items():
        write_atomic(WEB_FOLDER / MINIFIED_FOLDER / name, data)
        print(f"{name}: {len(data):,} bytes")


if __name__ == "__main__":
    run_command(main)

"""Run the programs that build the web player: esbuild, terser and TypeScript, which npm installs in tests/node."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from hyrfpack.errors import HyrfError

REPOSITORY_ROOT = Path(__file__).parents[2]
PROGRAMS_FOLDER = REPOSITORY_ROOT / "tests" / "node" / "node_modules" / ".bin"


def run_node_program(name: str, *arguments: str, stdin: bytes = b"", working_folder: Path | None = None) -> bytes:
    """Run a program and return what it writes to standard output.

    Raises:
        HyrfError: it is not installed, or it refuses a source. The reason is on standard error then.
    """
    program = PROGRAMS_FOLDER / name
    if not program.exists():
        raise HyrfError(f"{program}: the program is missing", fix="install node, then run 'npm ci --prefix tests/node'")
    process = subprocess.run([program, *arguments], input=stdin, stdout=subprocess.PIPE, cwd=working_folder)
    if process.returncode:
        sys.stderr.write(process.stdout.decode("utf-8", "replace"))
        raise HyrfError(f"{name} ended with exit code {process.returncode}", fix="correct what its message names")
    return process.stdout

"""Runs JavaScript modules of the page in node."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest


def run_script(script: Path, *arguments: object, flags: tuple[str, ...] = ()) -> Any:
    """The JSON in the last line that a script prints; skips where there is no node."""
    program = shutil.which("node")
    if program is None:
        pytest.skip("node is not on this machine")
    command = [program, *flags, str(script), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])

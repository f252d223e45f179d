"""Run JavaScript modules of the page in node."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest


def run_script(script: Path, *arguments: object, flags: tuple[str, ...] = ()) -> Any:
    """Run a script in node and return the JSON in the last line that it prints; skip the test without node."""
    program = shutil.which("node")
    if program is None:
        pytest.skip("node is not on this machine")
    command = [program, *flags, str(script), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])

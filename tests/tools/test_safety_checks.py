"""tools/safety: the checks that no test runs whole, in parts."""

from __future__ import annotations

import re
import subprocess
import tempfile
from pathlib import Path

from tools.safety import kill
from tools.safety.versions import PYTHON_VERSIONS

PROJECT_TEXT = (Path(__file__).parents[2] / "pyproject.toml").read_text("utf-8")


def test_a_command_that_prints_more_than_a_pipe_holds_does_not_wait_for_a_reader(tmp_path):
    with tempfile.TemporaryFile() as log:
        process = kill.start_command(["info", "x" * 100_000], log)
        try:
            assert process.wait(timeout=60) == 2 and len(kill.read_log(log)) > 1 << 16
        except subprocess.TimeoutExpired:
            process.kill()
            raise


def test_the_tested_versions_of_python_are_those_that_the_project_supports():
    assert PYTHON_VERSIONS["newest"] == tuple(re.findall(r"Python :: (3\.\d+)", PROJECT_TEXT))
    assert PYTHON_VERSIONS["oldest"] == tuple(re.findall(r'requires-python = ">=(3\.\d+)"', PROJECT_TEXT))

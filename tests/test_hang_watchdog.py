"""A test that hangs ends its process and leaves a trace."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

CONFTEST_SOURCE = """
from hang_watchdog import HangWatchdog

def pytest_configure(config):
    config.pluginmanager.register(HangWatchdog(max_seconds=0.3, renewal_seconds=0.1))
"""
TEST_MODULE_SOURCE = """
import time

def test_quick():
    print("quick")

def test_slow():
    time.sleep(60)
"""


def test_a_hanging_test_ends_its_process_and_is_named(tmp_path):
    (tmp_path / "conftest.py").write_text(CONFTEST_SOURCE)
    (tmp_path / "test_some.py").write_text(TEST_MODULE_SOURCE)
    (tmp_path / "pytest.ini").write_text(f"[pytest]\npythonpath = {Path(__file__).parent}\n")
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-p", "no:xdist", tmp_path]

    ended = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=120)

    assert ended.returncode == 1 and "in test_slow" in ended.stderr and "passed" not in ended.stdout

"""tools/browser: a browser that does not start leaves no process and no thread."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import pytest

from tools.browser import chromium, firefox


def test_a_display_with_a_strange_answer_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    program = tmp_path / "Xvfb"
    program.write_text('#!/bin/bash\necho $$ >"$0.pid"\necho nonsense >&"$2"\nexec sleep 60\n')
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    with pytest.raises(ValueError, match="nonsense"):
        firefox._start_display()
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "Xvfb.pid").read_text()), 0)


@pytest.mark.skipif(not firefox.find_program(), reason="Firefox or Xvfb is not installed")
@pytest.mark.parametrize("program", ["/nowhere/firefox", "/bin/false"])
def test_a_firefox_that_does_not_start_leaves_no_display(program: str, monkeypatch: pytest.MonkeyPatch):
    displays, start = [], firefox._start_display

    def start_display():
        displays.append(start())
        return displays[-1]

    monkeypatch.setattr(firefox, "_start_display", start_display)
    monkeypatch.setattr(firefox, "find_program", lambda: program)
    with pytest.raises((TimeoutError, FileNotFoundError)):
        firefox.Firefox()
    assert displays[0][0].poll() is not None


@pytest.mark.skipif(not chromium.find_program(), reason="Chromium or Playwright is not installed")
def test_a_chromium_that_does_not_start_leaves_no_thread(monkeypatch: pytest.MonkeyPatch):
    before = threading.enumerate()
    monkeypatch.setattr(chromium, "find_program", lambda: "/bin/false")
    with pytest.raises(Exception, match="launch"):
        chromium.Chromium()
    for thread in set(threading.enumerate()) - set(before):
        thread.join(timeout=10)  # Threads that wait for a process end a moment after it.
    assert threading.enumerate() == before

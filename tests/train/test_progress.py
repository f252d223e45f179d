from __future__ import annotations

import math

import pytest

from hyrfpack.train import progress
from hyrfpack.train.progress import ProgressLine


def test_a_log_file_gets_plain_lines_with_all_that_matters(capsys, monkeypatch):
    monkeypatch.setattr(progress, "LOG_EVERY", 0.0)
    with ProgressLine(20, 0) as line:
        for step in range(1, 21):
            line.update(step, 0.25, 0.01, 1234)
    out, err = capsys.readouterr()
    assert out == ""
    assert len(err.splitlines()) == 20
    last = err.splitlines()[-1]
    for part in ("step 20/20", "loss 0.2500", "PSNR 20.00", "1,234 Gaussians", "steps/s", "0 s left"):
        assert part in last


def test_the_last_step_is_always_said(capsys):
    with ProgressLine(3, 0) as line:
        for step in (1, 2, 3):
            line.update(step, 1.0, 0.1, 5)
    assert capsys.readouterr().err.startswith("step 3/3")


def test_quiet_says_nothing(capsys, monkeypatch):
    monkeypatch.setattr(progress, "LOG_EVERY", 0.0)
    with ProgressLine(3, 0, quiet=True) as line:
        line.update(3, 1.0, 0.1, 5)
    assert capsys.readouterr() == ("", "")


def test_running_means_start_at_the_first_value_and_follow():
    line = ProgressLine(1000, 0, quiet=True)
    line.update(1, 1.0, 0.5, 5)
    assert (line.loss, line.mse) == (1.0, 0.5)
    for step in range(2, 102):
        line.update(step, 0.0, 0.0, 5)
    assert line.loss == pytest.approx(0.95**100) and line.mse == pytest.approx(0.5 * 0.95**100)


def test_steps_without_an_error_leave_the_means_alone(capsys, monkeypatch):
    """A photo that is masked all over has none."""
    monkeypatch.setattr(progress, "LOG_EVERY", 0.0)
    with ProgressLine(10, 0) as line:
        line.update(1, 0.0, float("nan"), 5)
        assert capsys.readouterr().err == ""
        line.update(2, 1.0, 0.01, 5)
        line.update(3, 0.0, float("nan"), 5)
    assert (line.loss, line.mse) == (1.0, 0.01) and "PSNR 20.00" in capsys.readouterr().err


def test_a_perfect_picture_does_not_break_the_line(capsys):
    with ProgressLine(1, 0) as line:
        line.update(1, 0.0, 0.0, 5)
    assert "PSNR 100.00" in capsys.readouterr().err and math.isfinite(line.mse)

from __future__ import annotations

import io
import math
import re
import sys
import time

import pytest
from rich.console import Console

from hyrfpack.train import progress
from hyrfpack.train.progress import PhaseLine, ProgressLine, duration


def test_a_log_file_gets_plain_lines_with_all_that_matters(capsys, monkeypatch):
    monkeypatch.setattr(progress, "LOG_INTERVAL_SECONDS", 0.0)
    with ProgressLine(20, 0) as line:
        for step in range(1, 21):
            line.update(step, 0.25, 0.01, 1234)
    out, err = capsys.readouterr()
    assert out == ""
    assert len(err.splitlines()) == 20
    last = err.splitlines()[-1]
    for part in ("step 20/20  ", "loss 0.2500", "PSNR 20.00", "1,234 Gaussians", "steps/s", "0 s gone"):
        assert part in last
    assert "left" in err.splitlines()[-2] and "left" not in last


def test_the_last_step_is_always_said(capsys):
    with ProgressLine(3, 0) as line:
        for step in (1, 2, 3):
            line.update(step, 1.0, 0.1, 5)
    assert capsys.readouterr().err.startswith("step 3/3")


def test_quiet_says_nothing(capsys, monkeypatch):
    monkeypatch.setattr(progress, "LOG_INTERVAL_SECONDS", 0.0)
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
    monkeypatch.setattr(progress, "LOG_INTERVAL_SECONDS", 0.0)
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


# -- what fits on a terminal -----------------------------------------------------------------------------------------

PARTS = {
    "steps": "604/3,000",
    "speed": "40.2 steps/s",
    "loss": "loss 0.0381",
    "psnr": "PSNR 29.40",
    "gaussians": "4,850 Gaussians",
    "gone": "15 s gone",
    "left": "60 s left",
}
LONG_PARTS = {
    "steps": "29,604/30,000",
    "speed": "125.5 s/step",
    "loss": "loss 0.0381",
    "psnr": "PSNR 29.40",
    "gaussians": "1,234,850 Gaussians",
    "gone": "120:15:22 gone",
    "left": "11:15:22 left",
}
FITTING = {
    40: "604/3,000  PSNR 29.40  60 s left",
    60: "604/3,000  40.2 steps/s  PSNR 29.40  15 s gone  60 s left",
    80: "604/3,000  ━━━━━━━━  40.2 steps/s  loss 0.0381  PSNR 29.40  15 s gone  60 s left",
    120: "604/3,000  " + 24 * "━" + "  40.2 steps/s  loss 0.0381  PSNR 29.40  4,850 Gaussians  15 s gone  60 s left",
}


class Terminal(io.StringIO):
    encoding = "utf-8"

    def isatty(self) -> bool:
        return True


def drawn(parts: dict[str, str], width: int, encoding: str = "utf-8") -> str:
    """The line as a terminal shows it."""
    file = Terminal()
    file.encoding = encoding
    Console(width=width, file=file, force_terminal=True, color_system=None).print(
        progress.StatusLine(parts, 604 / 3000)
    )
    (line,) = file.getvalue().splitlines()
    return line


@pytest.mark.parametrize("width", FITTING)
def test_line_fits_the_terminal_and_leaves_out_the_least_important_first(width):
    assert drawn(PARTS, width) == FITTING[width]


@pytest.mark.parametrize("parts", [PARTS, LONG_PARTS], ids=["short", "long"])
def test_line_never_is_wider_than_the_terminal(parts):
    for width in range(1, 200):
        line = drawn(parts, width)
        assert len(line) <= width
        assert width < 14 or line.startswith(parts["steps"])
        assert width < 40 or (parts["psnr"] in line and parts["left"] in line)


def test_bar_of_a_terminal_without_unicode_is_ascii():
    assert drawn(PARTS, 120, encoding="ascii").isascii()


@pytest.mark.parametrize("width", [40, 60, 80, 120])
def test_a_terminal_gets_one_line_that_is_redrawn(width, monkeypatch):
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    for name, value in (("COLUMNS", str(width)), ("TERM", "xterm"), ("NO_COLOR", "1")):
        monkeypatch.setenv(name, value)
    with ProgressLine(3000, 0) as line:
        for step in range(1, 605):
            line.update(step, 0.05, 0.001, 4850)
        line.note("a sentence")
    shown = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", terminal.getvalue())
    lines = [part for part in re.split(r"[\r\n]+", shown) if part.strip()]
    assert max(map(len, lines)) <= width, lines
    assert "a sentence" in [part.strip() for part in lines]
    assert lines[-1].startswith("604/3,000  ") and "PSNR 30.00" in lines[-1] and lines[-1].endswith(" left")


def test_the_line_stands_before_anything_is_written_above_it(monkeypatch):
    """Else a sentence and the first drawing of the line, by another thread, can end up in one line."""
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    with ProgressLine(3000, 0):
        assert "preparing the first step" in terminal.getvalue()


def test_a_terminal_that_cannot_redraw_gets_plain_lines(monkeypatch):
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "dumb")
    with ProgressLine(3, 0) as line:
        line.update(3, 0.05, 0.001, 4850)
    assert terminal.getvalue().startswith("step 3/3  ") and "\x1b" not in terminal.getvalue()


# -- time ------------------------------------------------------------------------------------------------------------


class Clock:
    """Time that passes when told so."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 1000.0
        monkeypatch.setattr(progress, "monotonic", lambda: self.now)


def trained(clock: Clock, steps: int, seconds: float, count: int, **options) -> None:
    """`count` steps of a run of `steps`, so many seconds each, the first one ten times as many."""
    with ProgressLine(steps, 0, **options) as line:
        for step in range(1, count + 1):
            clock.now += seconds * (10 if step == 1 else 1)
            line.update(step, 0.05, 0.001, 4850)


@pytest.mark.parametrize(
    ("seconds", "said"),
    [
        (0, "0 s"),
        (0.4, "0 s"),
        (59.6, "60 s"),
        (120, "120 s"),
        (121, "0:02:01"),
        (3600, "1:00:00"),
        (45e3, "12:30:00"),
    ],
)
def test_more_than_two_minutes_are_said_as_hours_minutes_and_seconds(seconds, said):
    assert duration(seconds) == said


def test_times_of_a_log_file_are_readable(capsys, monkeypatch):
    trained(Clock(monkeypatch), steps=3000, seconds=0.5, count=600)
    last = capsys.readouterr().err.splitlines()[-1]
    assert re.search(r"  0:0[45]:\d\d gone  0:20:\d\d left$", last)


def test_compiling_in_the_first_steps_does_not_count_as_slowness(capsys, monkeypatch):
    trained(Clock(monkeypatch), steps=1000, seconds=2.0, count=20)
    assert "2.0 s/step" in capsys.readouterr().err.splitlines()[-1]


def test_more_than_an_hour_is_reported_once_with_what_would_shorten_it(capsys, monkeypatch):
    trained(Clock(monkeypatch), steps=3000, seconds=12.0, count=40, advice="fewer --steps")
    told = [line for line in capsys.readouterr().err.splitlines() if "hours" in line]
    assert told == ["this takes 10.0 more hours; fewer --steps would shorten it"]


@pytest.mark.parametrize(
    ("steps", "seconds", "count"),
    [(3000, 1.0, 200), (3000, 12.0, 4), (30_000, 1.0, 11)],
    ids=["less than an hour", "too few steps", "too few seconds"],
)
def test_hours_are_not_told_where_there_are_none_or_too_early(steps, seconds, count, capsys, monkeypatch):
    trained(Clock(monkeypatch), steps=steps, seconds=seconds, count=count, advice="fewer --steps")
    assert "hours" not in capsys.readouterr().err


def test_quiet_is_not_told_of_hours(capsys, monkeypatch):
    trained(Clock(monkeypatch), steps=3000, seconds=12.0, count=40, quiet=True, advice="fewer --steps")
    assert capsys.readouterr() == ("", "")


# -- standard error that is not there --------------------------------------------------------------------------------


def test_without_standard_error_nothing_is_shown_and_training_continues(capsys, monkeypatch):
    monkeypatch.setattr(sys, "stderr", None)
    with ProgressLine(3, 0) as line:
        line.update(3, 1.0, 0.1, 5)
        line.note("a sentence")
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("terminal", [False, True], ids=["a file", "a terminal"])
def test_standard_error_that_goes_away_does_not_end_the_training(terminal, monkeypatch):
    gone = Terminal() if terminal else io.StringIO()
    monkeypatch.setattr(sys, "stderr", gone)
    monkeypatch.setenv("TERM", "xterm")
    with ProgressLine(3, 0) as line:
        line.update(2, 1.0, 0.1, 5)
        gone.close()
        line.note("a sentence")
        line.update(3, 1.0, 0.1, 5)


# -- what comes before and after the steps ---------------------------------------------------------------------------


def test_a_phase_says_what_is_done_how_far_it_is_and_how_long_it_takes():
    line = PhaseLine(quiet=True)
    line.update("scoring held-out photos", 0, 20)
    line.update("scoring held-out photos", 5, 20)
    assert line.parts(line.start + 10) == {
        "what": "scoring held-out photos",
        "count": "5/20",
        "gone": "10 s gone",
        "left": "30 s left",
    }


@pytest.mark.parametrize(("done", "total"), [(0, 20), (20, 20), (0, 0)])
def test_a_phase_never_says_that_no_time_is_left(done, total):
    line = PhaseLine(quiet=True)
    line.update("scoring held-out photos", done, total)
    assert "left" not in line.parts(line.start + 10)


def test_the_clock_of_a_phase_begins_with_the_phase():
    line = PhaseLine(quiet=True)
    line.start -= 100
    line.update("reading photos", 0, 0)
    first = line.start
    line.update("reading photos", 0, 0)
    assert line.start == first and line.parts(first + 3)["gone"] == "3 s gone"


def test_a_log_file_gets_a_line_for_a_phase_that_is_long_and_none_for_a_short_one(capsys, monkeypatch):
    monkeypatch.setattr(progress, "FIRST_PHASE_LOG_SECONDS", 0.0)
    with PhaseLine() as line:
        line.update("scoring held-out photos", 5, 20)
        time.sleep(0.6)
    assert capsys.readouterr().err == "scoring held-out photos  5/20  0 s gone\n"
    monkeypatch.setattr(progress, "FIRST_PHASE_LOG_SECONDS", 1e9)
    with PhaseLine() as line:
        line.update("scoring held-out photos", 5, 20)
        time.sleep(0.6)
    assert capsys.readouterr().err == ""


def test_a_terminal_shows_a_phase_and_removes_it_at_the_end(monkeypatch):
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    with PhaseLine() as line:
        line.update("scoring held-out photos", 5, 20)
        time.sleep(0.6)
    shown = terminal.getvalue()
    assert "scoring held-out photos" in shown and "5/20" in shown
    assert "\x1b[2K" in shown[shown.rindex("photos") :]  # the line is erased

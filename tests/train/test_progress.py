from __future__ import annotations

import io
import math
import re
import sys
import time

import pytest
from rich.console import Console

from hyrfpack.cli.console import note
from hyrfpack.train import progress
from hyrfpack.train.progress import PhaseLine, ProgressLine, format_duration, format_speed


def test_a_log_file_gets_plain_lines_with_all_labels(capsys, monkeypatch):
    monkeypatch.setattr(progress, "LOG_INTERVAL_SECONDS", 0.0)
    with ProgressLine(20, 0) as line:
        for step in range(1, 21):
            line.update(step, 0.25, 0.01, 1234)
    out, err = capsys.readouterr()
    assert out == ""
    assert len(err.splitlines()) == 20
    last = err.splitlines()[-1]
    for part in ("step 20/20 | ", "loss 0.250", "PSNR 20.0 dB", "1,234 Gaussians", " it/s", "elapsed 0:00"):
        assert part in last
    assert "ETA 0:00" in err.splitlines()[-2] and "ETA" not in last


def test_the_last_step_is_always_printed(capsys):
    with ProgressLine(3, 0) as line:
        for step in (1, 2, 3):
            line.update(step, 1.0, 0.1, 5)
    assert capsys.readouterr().err.startswith("step 3/3")


def test_quiet_prints_nothing(capsys, monkeypatch):
    monkeypatch.setattr(progress, "LOG_INTERVAL_SECONDS", 0.0)
    with ProgressLine(3, 0, quiet=True) as line:
        line.update(3, 1.0, 0.1, 5)
    assert capsys.readouterr() == ("", "")


def test_running_means_start_at_the_first_value():
    line = ProgressLine(1000, 0, quiet=True)
    line.update(1, 1.0, 0.5, 5)
    assert (line.loss, line.mse) == (1.0, 0.5)
    for step in range(2, 102):
        line.update(step, 0.0, 0.0, 5)
    assert line.loss == pytest.approx(0.95**100) and line.mse == pytest.approx(0.5 * 0.95**100)


def test_steps_without_an_error_do_not_change_the_running_means(capsys, monkeypatch):
    """A photo that is masked completely has no error."""
    monkeypatch.setattr(progress, "LOG_INTERVAL_SECONDS", 0.0)
    with ProgressLine(10, 0) as line:
        line.update(1, 0.0, float("nan"), 5)
        assert capsys.readouterr().err == ""
        line.update(2, 1.0, 0.01, 5)
        line.update(3, 0.0, float("nan"), 5)
    assert (line.loss, line.mse) == (1.0, 0.01) and "PSNR 20.0 dB" in capsys.readouterr().err


def test_an_error_of_0_gives_a_valid_line(capsys):
    with ProgressLine(1, 0) as line:
        line.update(1, 0.0, 0.0, 5)
    assert "PSNR 100.0 dB" in capsys.readouterr().err and math.isfinite(line.mse)


# -- fitting the line to a terminal ----------------------------------------------------------------------------------

SHORT_LINE_PARTS = {
    "steps": "step 604/3000",
    "loss": "loss 0.038",
    "psnr": "PSNR 29.4 dB",
    "gaussians": "4,850 Gaussians",
    "speed": "40 it/s",
    "elapsed": "elapsed 0:15",
    "eta": "ETA 1:00",
}
LONG_LINE_PARTS = {
    "steps": "step 29604/30000",
    "loss": "loss 0.038",
    "psnr": "PSNR 29.4 dB",
    "gaussians": "1,234,850 Gaussians",
    "speed": "125.5 s/it",
    "elapsed": "elapsed 120:15:22",
    "eta": "ETA 11:15:22",
}
LINE_BY_TERMINAL_WIDTH = {
    40: "step 604/3000 | PSNR 29.4 dB | ETA 1:00",
    60: "step 604/3000 ━━━━━━━━━━ | PSNR 29.4 dB | 40 it/s | ETA 1:00",
    80: "step 604/3000 | loss 0.038 | PSNR 29.4 dB | 40 it/s | elapsed 0:15 | ETA 1:00",
    120: "step 604/3000 "
    + 24 * "━"
    + " | loss 0.038 | PSNR 29.4 dB | 4,850 Gaussians | 40 it/s | elapsed 0:15 | ETA 1:00",
}


class Terminal(io.StringIO):
    encoding = "utf-8"

    def isatty(self) -> bool:
        return True


def draw_line(parts: dict[str, str], width: int, encoding: str = "utf-8") -> str:
    """Return the line as a terminal shows it."""
    file = Terminal()
    file.encoding = encoding
    Console(width=width, file=file, force_terminal=True, color_system=None).print(
        progress.StatusLine(parts, 604 / 3000)
    )
    (line,) = file.getvalue().splitlines()
    return line


@pytest.mark.parametrize("width", LINE_BY_TERMINAL_WIDTH)
def test_line_fits_the_terminal_and_leaves_out_the_least_important_first(width):
    assert draw_line(SHORT_LINE_PARTS, width) == LINE_BY_TERMINAL_WIDTH[width]


@pytest.mark.parametrize("parts", [SHORT_LINE_PARTS, LONG_LINE_PARTS], ids=["short", "long"])
def test_line_never_is_wider_than_the_terminal(parts):
    for width in range(1, 200):
        line = draw_line(parts, width)
        assert len(line) <= width
        assert width < 16 or line.startswith(parts["steps"])
        assert width < 31 or parts["eta"] in line
        assert width < 46 or parts["psnr"] in line


def test_bar_of_a_terminal_without_unicode_is_ascii():
    assert draw_line(SHORT_LINE_PARTS, 120, encoding="ascii").isascii()


@pytest.mark.parametrize("width", [40, 60, 80, 120])
def test_a_terminal_gets_one_line_that_is_redrawn(width, monkeypatch):
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    for name, value in (("COLUMNS", str(width)), ("TERM", "xterm"), ("NO_COLOR", "1")):
        monkeypatch.setenv(name, value)
    with ProgressLine(3000, 0) as line:
        for step in range(1, 605):
            line.update(step, 0.05, 0.001, 4850)
        note("a sentence")
    shown = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", terminal.getvalue())
    lines = [part for part in re.split(r"[\r\n]+", shown) if part.strip()]
    assert max(map(len, lines)) <= width, lines
    assert "a sentence" in [part.strip() for part in lines]
    assert (
        lines[-1].startswith("step 604/3000 ")
        and "PSNR 30.0 dB" in lines[-1]
        and re.search(r"ETA \d+:\d\d$", lines[-1])
    )


def test_the_line_is_drawn_before_any_message_above_it(monkeypatch):
    """Otherwise a message and the line's first drawing, by another thread, can end up on one line."""
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
    assert terminal.getvalue().startswith("step 3/3 | ") and "\x1b" not in terminal.getvalue()


# -- time ------------------------------------------------------------------------------------------------------------


class Clock:
    """A clock that advances only when a test sets it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 1000.0
        monkeypatch.setattr(progress, "monotonic", lambda: self.now)


def report_steps(clock: Clock, steps: int, seconds: float, count: int, **options) -> None:
    """Report `count` steps of a run of `steps`; each takes `seconds`, the first one ten times as long."""
    with ProgressLine(steps, 0, **options) as line:
        for step in range(1, count + 1):
            clock.now += seconds * (10 if step == 1 else 1)
            line.update(step, 0.05, 0.001, 4850)


@pytest.mark.parametrize(
    ("seconds", "said"),
    [
        (0, "0:00"),
        (0.4, "0:00"),
        (15, "0:15"),
        (59.6, "1:00"),
        (3599, "59:59"),
        (3600, "1:00:00"),
        (45e3, "12:30:00"),
    ],
)
def test_durations_are_minutes_and_seconds_and_from_one_hour_on_hours_too(seconds, said):
    assert format_duration(seconds) == said


@pytest.mark.parametrize(
    ("speed", "said"),
    [(0.5, "2.0 s/it"), (1.0, "1.0 it/s"), (9.94, "9.9 it/s"), (10.0, "10 it/s"), (402.4, "402 it/s")],
)
def test_speed_is_in_iterations_per_second_or_seconds_per_iteration(speed, said):
    assert format_speed(speed) == said


def test_times_of_a_log_file_are_readable(capsys, monkeypatch):
    report_steps(Clock(monkeypatch), steps=3000, seconds=0.5, count=600)
    last = capsys.readouterr().err.splitlines()[-1]
    assert re.search(r" \| elapsed [45]:\d\d \| ETA 20:\d\d$", last)


def test_compiling_in_the_first_steps_does_not_count_as_slowness(capsys, monkeypatch):
    report_steps(Clock(monkeypatch), steps=1000, seconds=2.0, count=20)
    assert "2.0 s/it" in capsys.readouterr().err.splitlines()[-1]


def test_more_than_an_hour_is_reported_once_with_what_would_shorten_it(caplog, monkeypatch):
    report_steps(Clock(monkeypatch), steps=3000, seconds=12.0, count=40, advice="fewer --steps")
    assert caplog.messages == ["about 10.0 hours remain; to shorten the run, use fewer --steps"]


@pytest.mark.parametrize(
    ("steps", "seconds", "count"),
    [(3000, 1.0, 200), (3000, 12.0, 4), (30_000, 1.0, 11)],
    ids=["less than an hour", "too few steps", "too few seconds"],
)
def test_short_runs_and_early_steps_give_no_note_about_hours(steps, seconds, count, caplog, monkeypatch):
    report_steps(Clock(monkeypatch), steps=steps, seconds=seconds, count=count, advice="fewer --steps")
    assert caplog.messages == []


def test_quiet_suppresses_the_note_about_hours(caplog, monkeypatch):
    report_steps(Clock(monkeypatch), steps=3000, seconds=12.0, count=40, quiet=True, advice="fewer --steps")
    assert caplog.messages == []


# -- missing standard error ------------------------------------------------------------------------------------------


def test_without_standard_error_nothing_is_shown_and_training_continues(capsys, monkeypatch):
    monkeypatch.setattr(sys, "stderr", None)
    with ProgressLine(3, 0) as line:
        line.update(3, 1.0, 0.1, 5)
        note("a sentence")
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("terminal", [False, True], ids=["a file", "a terminal"])
def test_training_continues_when_standard_error_closes(terminal, monkeypatch):
    gone = Terminal() if terminal else io.StringIO()
    monkeypatch.setattr(sys, "stderr", gone)
    monkeypatch.setenv("TERM", "xterm")
    with ProgressLine(3, 0) as line:
        line.update(2, 1.0, 0.1, 5)
        gone.close()
        note("a sentence")
        line.update(3, 1.0, 0.1, 5)


# -- phases before and after the steps -------------------------------------------------------------------------------


def test_a_phase_shows_its_name_progress_and_remaining_time():
    line = PhaseLine(quiet=True)
    line.update("scoring held-out photos", 0, 20)
    line.update("scoring held-out photos", 5, 20)
    assert line.parts(line.start + 10) == {
        "what": "scoring held-out photos",
        "count": "5/20",
        "elapsed": "elapsed 0:10",
        "eta": "ETA 0:30",
    }


@pytest.mark.parametrize(("done", "total"), [(0, 20), (20, 20), (0, 0)])
def test_a_phase_never_shows_0_s_left(done, total):
    line = PhaseLine(quiet=True)
    line.update("scoring held-out photos", done, total)
    assert "eta" not in line.parts(line.start + 10)


def test_the_clock_of_a_phase_begins_with_the_phase():
    line = PhaseLine(quiet=True)
    line.start -= 100
    line.update("reading photos", 0, 0)
    first = line.start
    line.update("reading photos", 0, 0)
    assert line.start == first and line.parts(first + 3)["elapsed"] == "elapsed 0:03"


def test_a_log_file_gets_a_line_for_a_phase_that_is_long_and_none_for_a_short_one(capsys, monkeypatch):
    monkeypatch.setattr(progress, "FIRST_PHASE_LOG_SECONDS", 0.0)
    with PhaseLine() as line:
        line.update("scoring held-out photos", 5, 20)
        time.sleep(0.6)
    assert capsys.readouterr().err == "scoring held-out photos | 5/20 | elapsed 0:00\n"
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

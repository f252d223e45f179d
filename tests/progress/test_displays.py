"""Displays of progress: one line on a terminal, plain lines elsewhere, HTML in a notebook."""

from __future__ import annotations

import io
import math
import re
import sys
import time
from types import ModuleType, SimpleNamespace

import pytest
from rich.console import Console

from hyrfpack.cli.console import note
from hyrfpack.progress import Event, StageEvent, StepEvent, TaskEvent, lines, open_display, status
from hyrfpack.progress.notebook import MAX_CURVE_POINTS, Curves
from hyrfpack.progress.status import OPTIONAL_STEP_PARTS, Status, StatusLine, format_duration, format_speed
from hyrfpack.progress.terminal import FittedLine, TerminalDisplay

TRAINING_STAGE = StageEvent("training", 2, 5, 0.2, 72.4, ("step 604/3000", "PSNR 29.4 dB", "4,850 Gaussians"))
TRAINING_LINE = "2/5 training | step 604/3000 | PSNR 29.4 dB | 4,850 Gaussians | elapsed 0:00 | ETA 1:12"


def step_event(step: int, steps: int, loss: float = 0.25, mse: float = 0.01) -> StepEvent:
    return StepEvent(step, steps, loss, mse, 1234)


# -- choosing a display ----------------------------------------------------------------------------------------------


def test_a_function_gets_the_events_itself_and_nothing_is_printed(capsys):
    events: list[Event] = []
    with open_display(events.append) as progress:
        progress(TRAINING_STAGE)
    assert events == [TRAINING_STAGE] and capsys.readouterr() == ("", "")


def test_no_progress_prints_nothing(capsys, monkeypatch):
    monkeypatch.setattr(lines, "LOG_INTERVAL_SECONDS", 0.0)
    with open_display(None) as progress:
        progress(step_event(3, 3))
    assert capsys.readouterr() == ("", "")


# -- steps -----------------------------------------------------------------------------------------------------------


def test_a_log_file_gets_plain_lines_with_all_labels(capsys, monkeypatch):
    monkeypatch.setattr(lines, "LOG_INTERVAL_SECONDS", 0.0)
    with open_display() as progress:
        for step in range(1, 21):
            progress(step_event(step, 20))
    out, err = capsys.readouterr()
    assert out == ""
    assert len(err.splitlines()) == 20
    last = err.splitlines()[-1]
    for part in ("step 20/20 | ", "loss 0.250", "PSNR 20.0 dB", "1,234 Gaussians", " it/s", "elapsed 0:00"):
        assert part in last
    assert "ETA 0:00" in err.splitlines()[-2] and "ETA" not in last


def test_the_last_step_is_always_printed(capsys):
    with open_display() as progress:
        for step in (1, 2, 3):
            progress(step_event(step, 3))
    assert capsys.readouterr().err.startswith("step 3/3")


def test_running_means_start_at_the_first_value():
    shown = Status()
    shown.update(step_event(1, 1000, 1.0, 0.5))
    assert (shown.means.loss, shown.means.mse) == (1.0, 0.5)
    for step in range(2, 102):
        shown.update(step_event(step, 1000, 0.0, 0.0))
    assert shown.means.loss == pytest.approx(0.95**100) and shown.means.mse == pytest.approx(0.5 * 0.95**100)


def test_steps_without_an_error_do_not_change_the_running_means():
    """A photo that is masked completely has no error."""
    shown = Status()
    shown.update(step_event(1, 10, 0.0, math.nan))
    assert shown.line() is None
    shown.update(step_event(2, 10, 1.0, 0.01))
    shown.update(step_event(3, 10, 0.0, math.nan))
    assert (shown.means.loss, shown.means.mse) == (1.0, 0.01) and "PSNR 20.0 dB" in str(shown.line())


def test_an_error_of_0_gives_a_valid_line():
    shown = Status()
    shown.update(step_event(1, 1, 0.0, 0.0))
    assert "PSNR 100.0 dB" in str(shown.line())


def test_the_means_and_the_clock_of_another_run_begin_anew():
    shown = Status()
    shown.update(step_event(1, 10, 1.0, 0.5))
    shown.update(TaskEvent("preparing the first step"))
    begin = shown.task_start
    shown.update(step_event(4, 10, 0.2, 0.1))
    assert (shown.means.loss, shown.means.mse) == (0.2, 0.1) and shown.task_start == begin


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
    line = FittedLine(StatusLine(parts, 604 / 3000, OPTIONAL_STEP_PARTS))
    Console(width=width, file=file, force_terminal=True, color_system=None).print(line)
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
    with open_display() as progress:
        for step in range(1, 605):
            progress(step_event(step, 3000, mse=0.001))
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


def test_a_terminal_gets_plain_lines_if_rich_is_missing(monkeypatch):
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setitem(sys.modules, "rich", None)
    with open_display() as progress:
        progress(step_event(3000, 3000, mse=0.001))
    (line,) = terminal.getvalue().splitlines()
    assert line.startswith("step 3000/3000 | ") and "PSNR 30.0 dB" in line


@pytest.mark.parametrize(
    "width, words",
    [
        (120, ("2/5 training ━━━━━", *TRAINING_LINE.split(" | ")[1:])),
        (40, ("2/5 training", "step 604/3000", "ETA 1:12")),
        (20, ("2/5 training",)),
    ],
)
def test_the_line_of_a_stage_fits_every_terminal(width, words):
    shown, file = Status(), io.StringIO()
    shown.update(TRAINING_STAGE)
    Console(width=width, file=file, force_terminal=True, color_system=None).print(TerminalDisplay(shown))
    (line,) = file.getvalue().splitlines()
    assert all(word in line for word in words) and len(line) <= width


def open_terminal(monkeypatch: pytest.MonkeyPatch) -> Terminal:
    """Replace standard error by a terminal of 40 columns."""
    file = Terminal()
    monkeypatch.setattr(sys, "stderr", file)
    for name, value in (("COLUMNS", "40"), ("TERM", "xterm"), ("NO_COLOR", "1")):
        monkeypatch.setenv(name, value)
    return file


def read_lines(terminal: Terminal) -> list[str]:
    """Return all lines that were drawn on a terminal, without control sequences."""
    return [line for line in re.split(r"[\r\n]+", re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", terminal.getvalue())) if line]


def test_a_note_appears_whole_above_the_line_of_a_terminal(monkeypatch):
    """A terminal wraps a long sentence itself, so that a path in it can be copied."""
    sentence = "a sentence [of] its own that is longer than :one: line of the terminal"
    terminal = open_terminal(monkeypatch)
    with open_display() as progress:
        progress(TRAINING_STAGE)
        note(sentence)
        time.sleep(0.3)
    shown = [line for line in read_lines(terminal) if line.strip()]
    assert sentence in shown and shown[-1].startswith("2/5 training")


def test_a_line_of_a_terminal_leaves_the_output_that_goes_to_a_file_where_it_is(monkeypatch, capsys):
    terminal = open_terminal(monkeypatch)
    with open_display() as progress:
        progress(TRAINING_STAGE)
        print("PSNR 31.5")
    assert capsys.readouterr().out == "PSNR 31.5\n" and "31.5" not in terminal.getvalue()


def test_the_line_of_the_last_step_stays_and_that_of_a_task_is_removed(monkeypatch):
    terminal = open_terminal(monkeypatch)
    with open_display() as progress:
        progress(step_event(3, 3))
        progress(TaskEvent("scoring held-out photos", done=5, total=20))
        time.sleep(0.6)
    shown = terminal.getvalue()
    assert "scoring held-out photos" in shown and "5/20" in shown
    assert "\x1b[2K" in shown[shown.rindex("photos") :]  # the line is erased
    assert re.search(r"step 3/3[^\x1b]*\n", shown)  # the line of the step is not


def test_a_terminal_that_cannot_redraw_gets_plain_lines(monkeypatch):
    terminal = open_terminal(monkeypatch)
    monkeypatch.setenv("TERM", "dumb")
    with open_display() as progress:
        progress(step_event(3, 3))
    assert terminal.getvalue().startswith("step 3/3 | ") and "\x1b" not in terminal.getvalue()


# -- time ------------------------------------------------------------------------------------------------------------


class Clock:
    """A clock that advances only when a test sets it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 1000.0
        for module in (status, lines):
            monkeypatch.setattr(module, "monotonic", lambda: self.now)


def report_steps(clock: Clock, steps: int, seconds: float, count: int) -> None:
    """Report `count` steps of a run of `steps`; each takes `seconds`, the first one ten times as long."""
    with open_display() as progress:
        for step in range(1, count + 1):
            clock.now += seconds * (10 if step == 1 else 1)
            progress(step_event(step, steps))


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


def test_a_display_past_its_estimate_never_shows_0_s_left(monkeypatch):
    clock = Clock(monkeypatch)
    shown, left = Status(), []
    shown.update(TRAINING_STAGE)
    for seconds in (0.0, 50.0, 72.0, 100.0, 400.0):
        clock.now = 1000 + seconds
        left.append(shown.line().parts["eta"])
    assert left == ["ETA 1:12", "ETA 0:22", "ETA 0:18", "ETA 0:25", "ETA 1:40"]


def test_the_remaining_time_of_the_whole_follows_from_its_share(monkeypatch):
    clock = Clock(monkeypatch)
    shown = Status("compress")
    for second in range(1, 31):
        clock.now = 1000 + second
        shown.update(TaskEvent(f"measuring, camera {second}/60", second / 60))
    assert str(shown.line()) == "compress | measuring, camera 30/60 | elapsed 0:30 | ETA 0:30"


# -- missing standard error ------------------------------------------------------------------------------------------


def test_without_standard_error_nothing_is_shown_and_training_continues(capsys, monkeypatch):
    monkeypatch.setattr(sys, "stderr", None)
    with open_display() as progress:
        progress(step_event(3, 3))
        note("a sentence")
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("is_terminal", [False, True], ids=["a file", "a terminal"])
@pytest.mark.parametrize("is_closed_before", [False, True], ids=["closed meanwhile", "closed before"])
def test_training_continues_when_standard_error_closes(is_terminal, is_closed_before, monkeypatch):
    gone = Terminal() if is_terminal else io.StringIO()
    monkeypatch.setattr(sys, "stderr", gone)
    monkeypatch.setenv("TERM", "xterm")
    if is_closed_before:
        gone.close()
    with open_display() as progress:
        progress(step_event(2, 3))
        gone.close()
        note("a sentence")
        progress(step_event(3, 3))
        progress(TaskEvent("scoring held-out photos", done=1, total=2))


# -- tasks and stages ------------------------------------------------------------------------------------------------


def test_a_task_shows_its_name_progress_and_remaining_time(monkeypatch):
    clock = Clock(monkeypatch)
    shown = Status()
    shown.update(TaskEvent("scoring held-out photos", done=0, total=20))
    shown.update(TaskEvent("scoring held-out photos", done=5, total=20))
    clock.now += 10
    assert str(shown.line()) == "scoring held-out photos | 5/20 | elapsed 0:10 | ETA 0:30"


@pytest.mark.parametrize(("done", "total"), [(0, 20), (20, 20), (0, 0)])
def test_a_task_never_shows_0_s_left(done, total, monkeypatch):
    clock = Clock(monkeypatch)
    shown = Status()
    shown.update(TaskEvent("scoring held-out photos", done=done, total=total))
    clock.now += 10
    assert "eta" not in shown.line().parts


def test_the_clock_of_a_task_begins_with_the_task(monkeypatch):
    clock = Clock(monkeypatch)
    shown = Status()
    clock.now += 100
    shown.update(TaskEvent("reading photos"))
    clock.now += 3
    shown.update(TaskEvent("reading photos"))
    assert str(shown.line()) == "reading photos | elapsed 0:03"


def test_a_log_file_gets_a_line_for_a_task_that_is_long_and_none_for_a_short_one(capsys, monkeypatch):
    for seconds, printed in ((0.0, "scoring held-out photos | 5/20 | elapsed 0:00\n"), (1e9, "")):
        monkeypatch.setattr(lines, "FIRST_TASK_LOG_SECONDS", seconds)
        with open_display() as progress:
            progress(TaskEvent("scoring held-out photos", done=5, total=20))
            time.sleep(0.6)
        assert capsys.readouterr().err == printed


def test_a_log_file_gets_a_line_for_a_stage_every_few_seconds(capsys, monkeypatch):
    monkeypatch.setattr(lines, "LOG_INTERVAL_SECONDS", 0.01)
    monkeypatch.setattr(lines, "CHECK_INTERVAL_SECONDS", 0.01)
    with open_display() as progress:
        time.sleep(0.05)
        progress(TRAINING_STAGE)
        time.sleep(0.1)
    out, err = capsys.readouterr()
    assert out == "" and TRAINING_LINE in err.splitlines()


def test_an_unknown_remaining_time_is_not_shown():
    shown = Status()
    shown.update(StageEvent("import", 1, 2, 0.0, None))
    assert str(shown.line()) == "1/2 import | elapsed 0:00"


# -- notebooks -------------------------------------------------------------------------------------------------------


@pytest.fixture
def notebook(monkeypatch) -> list[str]:
    """The HTML that was displayed so far in a Jupyter notebook that this process seems to run."""
    pages: list[str] = []

    def display(page: str, display_id: bool) -> SimpleNamespace:
        pages.append(page)
        return SimpleNamespace(update=pages.append)

    package, displays = ModuleType("IPython"), ModuleType("IPython.display")
    package.get_ipython = lambda: SimpleNamespace(kernel=object())
    package.__path__ = []
    displays.HTML, displays.display = str, display
    monkeypatch.setitem(sys.modules, "IPython", package)
    monkeypatch.setitem(sys.modules, "IPython.display", displays)
    return pages


def test_a_notebook_shows_a_bar_the_line_and_the_curves(notebook, monkeypatch, capsys):
    monkeypatch.setattr("hyrfpack.progress.notebook.MIN_REDRAW_SECONDS", 0.0)
    with open_display() as progress:
        progress(TaskEvent("reading <photos>"))
        for step in range(1, 6):
            progress(step_event(step, 10, loss=1 / step, mse=0.1**step))
        progress(TaskEvent("writing the model"))
    assert "reading &lt;photos&gt;" in notebook[1] and "<svg" not in notebook[1]
    assert "writing the model" in notebook[-2]
    assert 'value="0.5000"' in notebook[-1] and "step 5/10" in notebook[-1]
    assert notebook[-1].count("<polyline") == 2 and "PSNR (dB) 10 to" in notebook[-1]
    assert capsys.readouterr() == ("", "")


def test_a_notebook_keeps_nothing_of_work_without_steps(notebook, monkeypatch):
    monkeypatch.setattr("hyrfpack.progress.notebook.MIN_REDRAW_SECONDS", 0.0)
    with open_display("auto", "compress") as progress:
        progress(TaskEvent("measuring", 0.5))
    assert "compress | measuring" in notebook[-2] and notebook[-1] == ""


def test_a_notebook_without_ipython_display_gets_plain_lines(notebook, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "IPython.display", None)
    with open_display() as progress:
        progress(step_event(3, 3))
    assert capsys.readouterr().err.startswith("step 3/3 | ") and notebook == []


def test_curves_of_a_long_run_keep_few_points_from_its_start_to_its_end():
    curves = Curves()
    for step in range(1, 30_001):
        curves.add(step, 1 / step, 20.0)
    points = re.search('points="([^"]*)"', curves.svg())[1].split()
    assert MAX_CURVE_POINTS / 2 <= len(points) <= MAX_CURVE_POINTS
    assert points[0].startswith("0.0,") and points[-1].startswith("320.0,")


def test_the_curves_of_a_second_run_begin_anew():
    curves = Curves()
    for step in (1, 2, 3, 1):
        curves.add(step, 0.5, 20.0)
    assert curves.svg() == ""
    curves.add(2, 0.25, 20.0)
    assert "loss 0.25 to 0.5" in curves.svg() and len(re.search('points="([^"]*)"', curves.svg())[1].split()) == 2

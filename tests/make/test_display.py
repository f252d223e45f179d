"""The progress display: one line on a terminal, plain lines elsewhere, and the estimate of the remaining time."""

from __future__ import annotations

import io
import re
import sys
from time import sleep

import pytest
from rich.console import Console

from hyrfpack.cli.console import note
from hyrfpack.make import display
from hyrfpack.make.display import Display
from hyrfpack.make.progress import SLOWDOWN_EXPONENT, Progress, Reporter

TRAINING_PROGRESS = Progress("training", 2, 5, 0.2, 72.4, ("step 604/3000", "PSNR 29.4 dB", "4,850 Gaussians"))


@pytest.mark.parametrize(
    "width, words",
    [
        (120, ("2/5 training ━━━━━", "step 604/3000", "PSNR 29.4 dB", "4,850 Gaussians", "elapsed 0:00", "ETA 1:12")),
        (40, ("2/5 training", "step 604/3000", "ETA 1:12")),
        (20, ("2/5 training",)),
    ],
)
def test_the_progress_line_fits_every_terminal(width, words):
    shown, file = Display(), io.StringIO()
    shown.show(TRAINING_PROGRESS)
    Console(width=width, file=file, force_terminal=True, color_system=None).print(shown)
    (line,) = file.getvalue().splitlines()
    assert all(word in line for word in words) and len(line) <= width


def test_without_a_terminal_a_plain_line_is_printed_every_few_seconds(capsys, monkeypatch):
    monkeypatch.setattr(display, "LOG_INTERVAL_SECONDS", 0.01)
    with Display() as shown:
        sleep(0.05)
        shown.show(TRAINING_PROGRESS)
        sleep(0.1)
    out, err = capsys.readouterr()
    assert out == ""
    assert "2/5 training | step 604/3000 | PSNR 29.4 dB | 4,850 Gaussians | elapsed 0:00 | ETA 1:12" in err


def test_a_note_appears_whole_above_the_line_of_a_terminal(monkeypatch):
    """A terminal wraps a long sentence itself, so that a path in it can be copied."""

    class Terminal(io.StringIO):
        encoding = "utf-8"

        def isatty(self) -> bool:
            return True

    terminal, sentence = Terminal(), "a sentence [of] its own that is longer than :one: line of the terminal"
    monkeypatch.setattr(sys, "stderr", terminal)
    for name, value in (("COLUMNS", "40"), ("TERM", "xterm"), ("NO_COLOR", "1")):
        monkeypatch.setenv(name, value)
    with Display() as shown:
        shown.show(TRAINING_PROGRESS)
        note(sentence)
        sleep(0.3)
    written = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", terminal.getvalue())
    lines = [line for line in re.split(r"[\r\n]+", written) if line.strip()]
    assert sentence in lines and lines[-1].startswith("2/5 training")


def test_an_unknown_remaining_time_is_not_printed(capsys, monkeypatch):
    monkeypatch.setattr(display, "LOG_INTERVAL_SECONDS", 0.01)
    with Display() as shown:
        Reporter(["import", "export"], shown.show).begin("import")
        sleep(0.1)
    lines = capsys.readouterr().err.splitlines()
    assert lines and all(line == "1/2 import | elapsed 0:00" for line in lines)


def test_a_display_past_its_estimate_never_shows_0_s_left(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr(display, "monotonic", lambda: clock[0])
    shown = Display()
    shown.show(TRAINING_PROGRESS)
    left = []
    for clock[0] in (0.0, 50.0, 72.0, 100.0, 400.0):
        left.append(shown._parts()["eta"])
    assert left == ["ETA 1:12", "ETA 0:22", "ETA 0:18", "ETA 0:25", "ETA 1:40"]


# -- the estimate ----------------------------------------------------------------------------------------------------


@pytest.fixture
def clock(monkeypatch) -> list[float]:
    seconds = [0.0]
    monkeypatch.setattr("hyrfpack.make.progress.monotonic", lambda: seconds[0])
    return seconds


def test_the_first_remaining_time_is_the_sum_of_the_forecasts(clock):
    messages: list[Progress] = []
    reporter = Reporter(["poses", "training", "export"], messages.append)
    reporter.estimates |= {"poses": 50.0, "pilots": 10.0, "training": 100.0, "results": 8.0, "export": 5.0}
    reporter.begin("poses")
    assert messages[-1].left == 50 + 10 + 100 + 8 + 5
    reporter.begin("training")
    assert messages[-1].left == 10 + 100 + 8 + 5
    reporter.begin("export")
    clock[0] = 3.0
    reporter.update(0.0, "writing")
    assert messages[-1].left == 2.0
    assert (messages[-1].place, messages[-1].of, messages[-1].words) == (3, 3, ("writing",))


def test_the_pace_of_a_part_replaces_its_forecast(clock):
    messages: list[Progress] = []
    reporter = Reporter(["poses"], messages.append)
    reporter.estimates["poses"] = 10.0
    reporter.begin("poses")
    for clock[0] in range(1, 31):
        reporter.update(clock[0] / 60)
    assert messages[-1].left == pytest.approx(30.0)


def test_the_pace_is_measured_over_the_last_half_of_the_progress(clock):
    messages: list[Progress] = []
    reporter = Reporter(["poses"], messages.append)
    reporter.begin("poses")
    for clock[0] in range(1, 101):  # at first 1 % a second, then a fifth of that pace
        reporter.update(min(clock[0], 50) / 100 + max(clock[0] - 50, 0) / 500)
    assert messages[-1].left == pytest.approx(0.4 / 0.002)


def test_the_pace_of_a_resumed_part_ignores_earlier_progress(clock):
    messages: list[Progress] = []
    reporter = Reporter(["training"], messages.append)
    reporter.begin("training")
    reporter.begin_part("training")
    for clock[0] in range(1, 42):
        reporter.update(0.5 + (clock[0] - 1) / 100)
    assert messages[-1].left == pytest.approx(10.0)


def test_forecasts_of_later_parts_are_scaled_by_the_pace_of_training(clock):
    messages: list[Progress] = []
    reporter = Reporter(["training", "compression"], messages.append)
    reporter.estimates |= {"pilots": 0.0, "training": 100.0, "results": 4.0, "compression": 16.0}
    reporter.begin("training")
    reporter.begin_part("training")
    for clock[0] in range(1, 151):  # three times slower than forecast
        reporter.update(clock[0] / 300)
    assert messages[-1].left == pytest.approx(150 + 3**SLOWDOWN_EXPONENT * (4 + 16))
    reporter.begin("compression")
    assert messages[-1].left == pytest.approx(3**SLOWDOWN_EXPONENT * 16)


def test_the_pace_of_pilots_scales_the_forecast_of_training(clock):
    messages: list[Progress] = []
    reporter = Reporter(["training"], messages.append)
    reporter.estimates |= {"pilots": 40.0, "training": 300.0, "results": 5.0}
    reporter.begin("training")
    for clock[0] in range(1, 41):  # twice as slow as forecast
        reporter.update(clock[0] / 80)
    assert messages[-1].left == pytest.approx(40 + 2 * 300 + 2**SLOWDOWN_EXPONENT * 5)


def test_training_in_an_earlier_call_scales_forecasts_too(clock):
    messages: list[Progress] = []
    reporter = Reporter(["training", "compression"], messages.append)
    reporter.estimates |= {"pilots": 0.0, "training": 100.0, "results": 10.0, "compression": 16.0}
    reporter.skip("training", 220.0)
    reporter.begin("compression")
    assert messages[-1].left == pytest.approx(2**SLOWDOWN_EXPONENT * 16)


def test_a_stage_past_its_forecast_never_shows_100_percent(clock):
    messages: list[Progress] = []
    reporter = Reporter(["compression"], messages.append)
    reporter.estimates["compression"] = 10.0
    reporter.begin("compression")
    clock[0] = 40.0
    reporter.update(0.0, "packing")
    assert messages[-1].left == 10.0


def test_the_progress_of_a_stage_covers_all_its_parts_and_never_decreases(clock):
    messages: list[Progress] = []
    reporter = Reporter(["training"], messages.append)
    reporter.estimates |= {"pilots": 20.0, "training": 60.0, "results": 20.0}
    reporter.begin("training")
    reporter.update(0.5)
    reporter.begin_part("training")
    reporter.update(0.5)
    reporter.update(1.0)
    reporter.begin_part("results", "scores")
    assert [progress.share for progress in messages] == pytest.approx([0.0, 0.1, 0.2, 0.5, 0.8, 0.8])

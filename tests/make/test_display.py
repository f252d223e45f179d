"""What is seen of the work: one line on a terminal, plain lines elsewhere; and what a forecast is made of."""

from __future__ import annotations

import io
from time import sleep

import pytest
from rich.console import Console

from hyrfpack.make import display
from hyrfpack.make.display import Display
from hyrfpack.make.progress import Progress, Reporter

TRAINING = Progress("training", 2, 5, 0.2, 72.4, ("604/3,000", "PSNR 29.40", "4,850 Gaussians"))


@pytest.mark.parametrize(
    "width, words",
    [
        (120, ("2/5 training  ━━━━━", "604/3,000", "PSNR 29.40", "4,850 Gaussians", "0 s gone", "about 72 s left")),
        (40, ("2/5 training", "604/3,000", "about 72 s left")),
        (20, ("2/5 training",)),
    ],
)
def test_one_line_fits_every_terminal(width, words):
    shown, file = Display(), io.StringIO()
    shown.show(TRAINING)
    Console(width=width, file=file, force_terminal=True, color_system=None).print(shown)
    (line,) = file.getvalue().splitlines()
    assert all(word in line for word in words) and len(line) <= width


def test_elsewhere_a_plain_line_comes_every_few_seconds(capsys, monkeypatch):
    monkeypatch.setattr(display, "LOG_EVERY", 0.01)
    with Display() as shown:
        sleep(0.05)
        shown.show(TRAINING)
        shown.say("a sentence [of] its own")
        sleep(0.1)
    out, err = capsys.readouterr()
    assert out == "" and "a sentence [of] its own" in err
    assert "2/5 training  604/3,000  PSNR 29.40  4,850 Gaussians  0 s gone  about 72 s left" in err


def test_nothing_is_said_of_a_time_that_is_not_known(capsys, monkeypatch):
    monkeypatch.setattr(display, "LOG_EVERY", 0.01)
    with Display() as shown:
        Reporter(["import", "export"], shown.show).begin("import")
        sleep(0.1)
    lines = capsys.readouterr().err.splitlines()
    assert lines and all(line == "1/2 import  0 s gone" for line in lines)


def test_what_is_left_is_of_this_stage_and_those_to_come(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr("hyrfpack.make.progress.monotonic", lambda: clock[0])
    told: list[Progress] = []
    reporter = Reporter(["poses", "training", "export"], told.append)
    reporter.estimates |= {"poses": 50.0, "training": 100.0, "export": 5.0}
    reporter.begin("poses")
    assert told[-1].left == 155.0
    clock[0] = 30.0
    reporter.update(0.25, "matching")
    assert told[-1].left == pytest.approx(0.75 * 50 + 105)  # its pace shows only from two reports on
    reporter.begin("training")
    reporter.update(0.5)  # of one that is gone on with
    clock[0] = 40.0
    reporter.update(0.6)
    assert told[-1].left == pytest.approx(40 + 5)
    reporter.begin("export")
    clock[0] = 43.0
    reporter.update(0.0, "writing")
    assert told[-1].left == pytest.approx(2.0)
    assert (told[-1].place, told[-1].of, told[-1].words) == (3, 3, ("writing",))

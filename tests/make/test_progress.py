"""The progress of all stages, and the estimate of the remaining time."""

from __future__ import annotations

import pytest

from hyrfpack.make.progress import SLOWDOWN_EXPONENT, Reporter
from hyrfpack.progress import StageEvent


@pytest.fixture
def clock(monkeypatch) -> list[float]:
    seconds = [0.0]
    monkeypatch.setattr("hyrfpack.make.progress.monotonic", lambda: seconds[0])
    return seconds


def test_the_first_remaining_time_is_the_sum_of_the_forecasts(clock):
    messages: list[StageEvent] = []
    reporter = Reporter(["poses", "training", "export"], messages.append)
    reporter.estimates |= {"poses": 50.0, "pilots": 10.0, "training": 100.0, "results": 8.0, "export": 5.0}
    reporter.begin("poses")
    assert messages[-1].seconds_left == 50 + 10 + 100 + 8 + 5
    reporter.begin("training")
    assert messages[-1].seconds_left == 10 + 100 + 8 + 5
    reporter.begin("export")
    clock[0] = 3.0
    reporter.update(0.0, "writing")
    assert messages[-1].seconds_left == 2.0
    assert (messages[-1].number, messages[-1].count, messages[-1].details) == (3, 3, ("writing",))


def test_the_pace_of_a_part_replaces_its_forecast(clock):
    messages: list[StageEvent] = []
    reporter = Reporter(["poses"], messages.append)
    reporter.estimates["poses"] = 10.0
    reporter.begin("poses")
    for clock[0] in range(1, 31):
        reporter.update(clock[0] / 60)
    assert messages[-1].seconds_left == pytest.approx(30.0)


def test_the_pace_is_measured_over_the_last_half_of_the_progress(clock):
    messages: list[StageEvent] = []
    reporter = Reporter(["poses"], messages.append)
    reporter.begin("poses")
    for clock[0] in range(1, 101):  # at first 1 % a second, then a fifth of that pace
        reporter.update(min(clock[0], 50) / 100 + max(clock[0] - 50, 0) / 500)
    assert messages[-1].seconds_left == pytest.approx(0.4 / 0.002)


def test_the_pace_of_a_resumed_part_ignores_earlier_progress(clock):
    messages: list[StageEvent] = []
    reporter = Reporter(["training"], messages.append)
    reporter.begin("training")
    reporter.begin_part("training")
    for clock[0] in range(1, 42):
        reporter.update(0.5 + (clock[0] - 1) / 100)
    assert messages[-1].seconds_left == pytest.approx(10.0)


def test_forecasts_of_later_parts_are_scaled_by_the_pace_of_training(clock):
    messages: list[StageEvent] = []
    reporter = Reporter(["training", "compression"], messages.append)
    reporter.estimates |= {"pilots": 0.0, "training": 100.0, "results": 4.0, "compression": 16.0}
    reporter.begin("training")
    reporter.begin_part("training")
    for clock[0] in range(1, 151):  # three times slower than forecast
        reporter.update(clock[0] / 300)
    assert messages[-1].seconds_left == pytest.approx(150 + 3**SLOWDOWN_EXPONENT * (4 + 16))
    reporter.begin("compression")
    assert messages[-1].seconds_left == pytest.approx(3**SLOWDOWN_EXPONENT * 16)


def test_the_pace_of_pilots_scales_the_forecast_of_training(clock):
    messages: list[StageEvent] = []
    reporter = Reporter(["training"], messages.append)
    reporter.estimates |= {"pilots": 40.0, "training": 300.0, "results": 5.0}
    reporter.begin("training")
    for clock[0] in range(1, 41):  # twice as slow as forecast
        reporter.update(clock[0] / 80)
    assert messages[-1].seconds_left == pytest.approx(40 + 2 * 300 + 2**SLOWDOWN_EXPONENT * 5)


def test_training_in_an_earlier_call_scales_forecasts_too(clock):
    messages: list[StageEvent] = []
    reporter = Reporter(["training", "compression"], messages.append)
    reporter.estimates |= {"pilots": 0.0, "training": 100.0, "results": 10.0, "compression": 16.0}
    reporter.skip("training", 220.0)
    reporter.begin("compression")
    assert messages[-1].seconds_left == pytest.approx(2**SLOWDOWN_EXPONENT * 16)


def test_a_stage_past_its_forecast_never_shows_100_percent(clock):
    messages: list[StageEvent] = []
    reporter = Reporter(["compression"], messages.append)
    reporter.estimates["compression"] = 10.0
    reporter.begin("compression")
    clock[0] = 40.0
    reporter.update(0.0, "packing")
    assert messages[-1].seconds_left == 10.0


def test_the_progress_of_a_stage_covers_all_its_parts_and_never_decreases(clock):
    messages: list[StageEvent] = []
    reporter = Reporter(["training"], messages.append)
    reporter.estimates |= {"pilots": 20.0, "training": 60.0, "results": 20.0}
    reporter.begin("training")
    reporter.update(0.5)
    reporter.begin_part("training")
    reporter.update(0.5)
    reporter.update(1.0)
    reporter.begin_part("results", "scores")
    assert [progress.share for progress in messages] == pytest.approx([0.0, 0.1, 0.2, 0.5, 0.8, 0.8])


def test_a_stop_ends_all_stages_but_training():
    reporter = Reporter(["poses", "training", "export"], lambda event: None, stop=lambda: True)
    reporter.begin("training")
    reporter.update(0.5)
    for stage in ("poses", "export"):
        with pytest.raises(KeyboardInterrupt):
            reporter.begin(stage)

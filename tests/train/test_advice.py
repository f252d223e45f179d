"""Advice on how to shorten a long training run."""

from __future__ import annotations

import logging

import pytest
import torch

from hyrfpack.progress import StepEvent
from hyrfpack.train import advice
from hyrfpack.train.advice import LongRunAdvice


@pytest.fixture
def messages(caplog, monkeypatch):
    """Return a function that takes steps of given length, and returns the messages logged meanwhile."""

    def take_steps(steps: int, seconds: float, count: int) -> list[str]:
        caplog.set_level(logging.INFO, "hyrfpack")
        clock = [0.0]
        monkeypatch.setattr(advice, "monotonic", lambda: clock[0])
        given = LongRunAdvice(0, torch.device("cpu"))
        for step in range(1, count + 1):
            clock[0] += seconds * (10 if step == 1 else 1)
            given.step(StepEvent(step, steps, 0.05, 0.001, 4850))
        return caplog.messages

    return take_steps


def test_more_than_an_hour_is_reported_once_with_what_would_shorten_it(messages):
    ways = "fewer steps, smaller photos, fewer Gaussians or a GPU"
    assert messages(3000, 12.0, 40) == [f"about 10.0 hours remain; to shorten the run, use {ways}"]


@pytest.mark.parametrize(
    ("steps", "seconds", "count"),
    [(3000, 1.0, 200), (3000, 12.0, 4), (30_000, 1.0, 11)],
    ids=["less than an hour", "too few steps", "too few seconds"],
)
def test_short_runs_and_early_steps_give_no_note_about_hours(steps, seconds, count, messages):
    assert messages(steps, seconds, count) == []

"""Advice on how to shorten a long training run."""

from __future__ import annotations

import logging
from time import monotonic

import torch

from hyrfpack.progress import StepEvent
from hyrfpack.progress.pace import StepPace

_LOG = logging.getLogger(__name__)

# Advice is logged if at least this much time is left. Before that, the speed must have been measured over at least this
# many steps and seconds.
MIN_ADVICE_STEPS = 3
MIN_ADVICE_SECONDS = 10.0
MIN_ADVICE_SECONDS_LEFT = 3600.0


class LongRunAdvice:
    """Logs once how to shorten a run of which more than an hour remains."""

    def __init__(self, done: int, device: torch.device) -> None:
        """Begin after `done` steps on a device."""
        self._pace = StepPace(done, monotonic())
        ways = ["fewer steps", "smaller photos", "fewer Gaussians"] + ["a GPU"] * (device.type == "cpu")
        self._advice = f"{', '.join(ways[:-1])} or {ways[-1]}"
        self._is_given = False

    def step(self, event: StepEvent) -> None:
        """Take a finished step."""
        now = monotonic()
        _, left = self._pace.at(event, now)
        steps, seconds = event.step - self._pace.warm_step, now - self._pace.warm
        is_speed_known = steps >= MIN_ADVICE_STEPS and seconds >= MIN_ADVICE_SECONDS
        if is_speed_known and left > MIN_ADVICE_SECONDS_LEFT and not self._is_given:
            _LOG.info(f"about {left / 3600:.1f} hours remain; to shorten the run, use {self._advice}")
            self._is_given = True

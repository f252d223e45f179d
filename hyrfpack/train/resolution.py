"""The resolution of each training step: coarse while there are few Gaussians, full for the last steps.

The time of a step grows with its pixels. As long as there are more pixels than Gaussians, a Gaussian learns nearly as
much from the mean of a block of pixels as from the block itself. So most steps on large photos render reduced photos,
and the resolution grows with the number of Gaussians, as in DashGaussian (2025).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean

import numpy as np

from hyrfpack.cameras.sampling import MAX_BACKGROUND_STRIDE
from hyrfpack.choices import CONSISTENT_EXPOSURE
from hyrfpack.config.train import DensityConfig
from hyrfpack.data.cache import DEFAULT_PREFETCHED_PICTURES
from hyrfpack.data.reduced import reduce_view
from hyrfpack.ops.rasterize.inputs import LOW_PASS_VARIANCE
from hyrfpack.render import RenderSettings
from hyrfpack.scene import Camera, View

MIN_PIXELS_PER_GAUSSIAN = 1.0  # A reduced photo has at least this many.
# Photos are not reduced below this size. On photos of 180 to 480 pixels, steps at half the size lose quality.
MIN_REDUCED_SIDE_PIXELS = 200
MAX_REDUCTION = 8
FULL_RESOLUTION_START = 0.8  # From this share of the run on, photos are not reduced.
# Time of a step that does not depend on its pixels, as a share of the time that pixels take at full resolution.
FIXED_STEP_COST = 0.05
COST_SAMPLE_COUNT = 100
# The last training steps evaluate the background at about this many pixels at most, and at every second one of small
# photos.
MAX_BACKGROUND_NODES = 40_000
MIN_BACKGROUND_STRIDE = 2
# The smallest stride for unreduced photos before FULL_RESOLUTION_START, unless their shorter side is below the limit.
COARSE_BACKGROUND_STRIDE = 3
MIN_COARSE_BACKGROUND_SIDE_PIXELS = 128


class ResolutionSchedule:
    """The reduction of each step's photo, a factor that is a power of two, and the stride of its background.

    The factor depends on the number of Gaussians after each round of density control. A change takes effect a few steps
    later, because photos are read in advance. So a resumed run takes the same steps as an uninterrupted one.

    Attributes:
        changes: the first step, from 1, and the factor of each part of the run before the steps at full resolution.
    """

    def __init__(
        self,
        views: Sequence[View],
        steps: int,
        gaussians: int,
        *,
        is_on: bool = True,
        has_coarse_background: bool = True,
    ) -> None:
        """Begin a run.

        Args:
            views: the training views.
            steps: number of optimiser steps.
            gaussians: number of Gaussians at the start.
            is_on: False for steps that are all at full resolution.
            has_coarse_background: use `COARSE_BACKGROUND_STRIDE`, if the schedule is on.
        """
        self._has_coarse_background = is_on and has_coarse_background
        self._size = PhotoSize.of_views(views)
        self._steps, self._last_coarse_step = steps, int(FULL_RESOLUTION_START * steps)
        self.changes = [(1, self._size.reduction_for(gaussians) if is_on else 1)]

    def update(self, step: int, gaussians: int) -> None:
        """Take the number of Gaussians after a step; the resolution only grows."""
        factor = self._size.reduction_for(gaussians)
        if factor < self.changes[-1][1]:
            self.changes.append((step + DEFAULT_PREFETCHED_PICTURES + 1, factor))

    def factor(self, step: int) -> int:
        """Return the factor of a step, counted from 1."""
        if step > self._last_coarse_step:
            return 1
        return next(factor for first, factor in reversed(self.changes) if first <= step)

    def reduce_view(self, view: View, step: int) -> View:
        """Return the view at the resolution of a step, counted from 1."""
        return reduce_view(view, self.factor(step))

    def share_done(self, step: int) -> float:
        """Return the estimated share of the run's work that is done after a step, if no further change comes."""
        parts = [(start, end, step_cost(factor)) for start, end, factor in self._parts()]
        done = sum(cost * max(0, min(end, step) - start) for start, end, cost in parts)
        return done / sum(cost * (end - start) for start, end, cost in parts)

    def _parts(self) -> list[tuple[int, int, int]]:
        """Return the steps before each part of the run, its last step and its factor; changes too late are left out."""
        changes = [(first - 1, factor) for first, factor in self.changes if first <= self._last_coarse_step]
        changes.append((self._last_coarse_step, 1))
        ends = [*(start for start, _ in changes[1:]), self._steps]
        return [(start, end, factor) for (start, factor), end in zip(changes, ends, strict=True)]

    def render_settings(self, camera: Camera, step: int) -> RenderSettings:
        """Return the settings with which a step renders its view.

        Args:
            camera: the camera at the resolution of the step.
            step: the step, counted from 1.
        """
        return RenderSettings(
            exposure=CONSISTENT_EXPOSURE,  # Training applies the gains of the photo itself.
            background_stride=max(background_stride(camera), self._min_background_stride(camera, step)),
            low_pass_variance=reduced_low_pass_variance(self.factor(step)),
        )

    def _min_background_stride(self, camera: Camera, step: int) -> int:
        """Return the smallest stride for a camera at the resolution of a step, counted from 1."""
        is_large = min(camera.width, camera.height) >= MIN_COARSE_BACKGROUND_SIDE_PIXELS
        is_early = step <= self._last_coarse_step
        is_coarse = self._has_coarse_background and is_early and is_large and self.factor(step) == 1
        return COARSE_BACKGROUND_STRIDE if is_coarse else MIN_BACKGROUND_STRIDE

    def describe(self) -> str:
        """Return in words what was reduced; empty if nothing was."""
        parts = [f"by {factor} until step {end:,}" for _, end, factor in self._parts() if factor > 1]
        return f"photos reduced {', '.join(parts)}" if parts else ""


@dataclass(frozen=True)
class PhotoSize:
    """The size of a scene's photos.

    Attributes:
        pixels: mean number of pixels of a photo.
        shorter_side: the smallest width or height in pixels.
    """

    pixels: float
    shorter_side: int

    @classmethod
    def of(cls, sizes: Sequence[tuple[int, int]]) -> PhotoSize:
        """Return the size of photos of these widths and heights."""
        return cls(fmean(width * height for width, height in sizes), min(map(min, sizes)))

    @classmethod
    def of_views(cls, views: Sequence[View]) -> PhotoSize:
        """Return the size of the photos of views."""
        return cls.of([(view.camera.width, view.camera.height) for view in views])

    def reduction_for(self, gaussians: float) -> int:
        """Return the largest factor, a power of two, that leaves enough pixels for each Gaussian and a large photo."""
        factor = 1
        while (
            2 * factor <= MAX_REDUCTION
            and self.shorter_side >= 2 * factor * MIN_REDUCED_SIDE_PIXELS
            and self.pixels >= MIN_PIXELS_PER_GAUSSIAN * gaussians * (2 * factor) ** 2
        ):
            factor *= 2
        return factor

    def mean_step_cost(self, density: DensityConfig, initial: int, budget: int) -> float:
        """Estimate the mean time of a run's steps, as a share of that of a step at full resolution."""
        times, counts = zip(*density.planned_counts(initial, budget), strict=True)
        costs, most = [], 0.0
        for time in np.linspace(0, 1, COST_SAMPLE_COUNT):
            most = max(most, float(np.interp(time, times, counts)))
            costs.append(step_cost(self.reduction_for(most) if time <= FULL_RESOLUTION_START else 1))
        return fmean(costs)


def step_cost(factor: int) -> float:
    """Return the time of a step on photos reduced by a factor, as a share of that of a step at full resolution."""
    return (FIXED_STEP_COST + 1 / factor**2) / (FIXED_STEP_COST + 1)


def reduced_low_pass_variance(factor: int) -> float:
    """Return the low-pass variance, in px^2 of a reduced image, with which it is the mean of blocks of the full image.

    The mean over blocks of `factor` x `factor` pixels adds the variance of `factor` samples at a distance of one
    pixel, (factor^2 - 1) / 12, to the variance of the full image.
    """
    return (LOW_PASS_VARIANCE + (factor**2 - 1) / 12) / factor**2


def background_stride(camera: Camera) -> int:
    """Return the stride at which the last training steps evaluate the background."""
    stride = math.ceil(math.sqrt(camera.width * camera.height / MAX_BACKGROUND_NODES))
    return min(max(MIN_BACKGROUND_STRIDE, stride), MAX_BACKGROUND_STRIDE)

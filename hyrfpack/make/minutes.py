"""Fit a plan to a time limit: choose the number of steps and the size of the photos by a short measurement."""

from __future__ import annotations

import dataclasses
import logging
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import monotonic, perf_counter

import numpy as np
import torch

from hyrfpack.config.train import FULL_STEPS
from hyrfpack.data import PictureCache
from hyrfpack.make.plan import (
    BACKGROUND_SEARCH_PASSES,
    PASSES_PER_SCORED_VIEW,
    QUALITIES,
    Plan,
    count_packing_passes,
    estimate_depth_map_seconds,
    estimate_scene_seconds,
    mean_megapixels,
)
from hyrfpack.make.progress import Reporter
from hyrfpack.make.source import LoadSettings
from hyrfpack.model import HybridModel
from hyrfpack.progress import StepEvent, part_of_progress
from hyrfpack.render import render_view
from hyrfpack.scene import DEFAULT_MAX_SIZE, Camera, Scene, evenly_spaced
from hyrfpack.train import DensityConfig, TrainConfig, Trainer
from hyrfpack.train.decisions import decide, is_budget_open
from hyrfpack.train.resolution import PhotoSize
from hyrfpack.train.setup import budget_for
from hyrfpack.train.teachers import TEACHER_STEPS, count_teachers

_LOG = logging.getLogger(__name__)

PROBE_STEPS = 45  # a complete small run, from the first Gaussians to the budget
# The number of Gaussians grows during most of the probe, so that the time per Gaussian can be measured.
PROBE_DENSITY = DensityConfig(stop=0.6, peak=0.6, excess=1.0)
PROBE_WARM_UP_STEPS = 3  # the first steps compile kernels
MAX_PROBE_TIME_RATIO = 0.06  # a probe takes at most this ratio of the remaining time
MIN_USEFUL_STEPS = 1_000  # with fewer steps, smaller photos give a better scene
CANDIDATE_PHOTO_SIZES = (1200, 800, 600, 400)  # longer sides in pixels, tried in this order
MIN_PROBE_PHOTO_SIZE = 640  # photos are not shrunk below this size in pixels for the first probe
TRAINED_PACE_RATIO = 0.92  # later steps take this ratio of the probe's time, because more Gaussians are hidden
# A pass, which renders a view on the CPU and back-propagates through it, is the unit of the work after training.
VERIFICATION_VIEWS = 12  # packing renders as many views to verify its result
CODING_SECONDS_PER_GAUSSIAN = 1.5e-4
OVERHEAD_SECONDS = 6.0  # coding and writing a model takes at least this long


@dataclass(frozen=True)
class SceneCost:
    """Times that a scene takes on this machine, at one size of its photos.

    Attributes:
        step_seconds: seconds of a training step at full resolution without Gaussians.
        step_seconds_per_gaussian: further seconds of a training step for each Gaussian.
        decoding_seconds: seconds that training waits until a photo is decoded.
        cpu_pass_seconds: seconds of a pass on the CPU with `gaussians`.
        gaussians: number of Gaussians at the end of the probe.
        requested: the requested plan, which determines the budget; its steps are not used.
    """

    step_seconds: float
    step_seconds_per_gaussian: float
    decoding_seconds: float
    cpu_pass_seconds: float
    gaussians: int
    requested: Plan = Plan(FULL_STEPS, DEFAULT_MAX_SIZE)

    def scaled_by_pixels(self, pixel_ratio: float) -> SceneCost:
        """Estimate the cost of photos that have `pixel_ratio` times as many pixels."""
        step, per_gaussian, cpu = (
            pixel_ratio * seconds
            for seconds in (self.step_seconds, self.step_seconds_per_gaussian, self.cpu_pass_seconds)
        )
        return dataclasses.replace(
            self, step_seconds=step, step_seconds_per_gaussian=per_gaussian, cpu_pass_seconds=cpu
        )

    def training_seconds(self, scene: Scene, steps: int) -> float:
        """Estimate the seconds of a training run from its mean number of Gaussians."""
        budget = self._budget(scene, steps)
        density = DensityConfig()
        step = self.step_seconds + self.step_seconds_per_gaussian * density.mean_count(budget, budget)
        step *= PhotoSize.of_views(scene.train).mean_step_cost(density, budget, budget)
        decoding = self.decoding_seconds * min(steps, len(scene.train))
        return TRAINED_PACE_RATIO * steps * step + decoding + estimate_depth_map_seconds(len(scene.train))

    def teacher_seconds(self, scene: Scene, steps: int) -> float:
        """Estimate the seconds of the teacher runs before a training run with this number of steps."""
        config = dataclasses.replace(self.requested, steps=steps).train_config(seed=0)
        teachers = count_teachers(len(scene.train), PhotoSize.of_views(scene.train), config)
        rendering = len(scene.train) * self._pass_seconds(scene, TEACHER_STEPS) / 2
        return teachers * (self.training_seconds(scene, TEACHER_STEPS) + rendering)

    def seconds_after_training(self, scene: Scene, steps: int) -> dict[str, float]:
        """Estimate the seconds of the work after the last training step, by part of a stage, see `STAGE_PARTS`."""
        budget, pass_seconds = self._budget(scene, steps), self._pass_seconds(scene, steps)
        scored = PASSES_PER_SCORED_VIEW * len(scene.test)
        return {
            "results": pass_seconds * (BACKGROUND_SEARCH_PASSES + scored) + OVERHEAD_SECONDS / 2,
            "compression": pass_seconds * (count_packing_passes(budget) + VERIFICATION_VIEWS)
            + CODING_SECONDS_PER_GAUSSIAN * budget,
            "scoring": pass_seconds * scored,
            "export": OVERHEAD_SECONDS / 2,
        }

    def _pass_seconds(self, scene: Scene, steps: int) -> float:
        """Estimate the seconds of a pass with the Gaussians of a training run with this number of steps."""
        budget = self._budget(scene, steps)
        at_end, at_probe = (self.step_seconds + self.step_seconds_per_gaussian * n for n in (budget, self.gaussians))
        return TRAINED_PACE_RATIO * self.cpu_pass_seconds * at_end / at_probe

    def _budget(self, scene: Scene, steps: int) -> int:
        """Return the budget of a training run with this number of steps."""
        return budget_for(scene, dataclasses.replace(self.requested, steps=steps).train_config(seed=0))[0]

    def total_seconds(self, scene: Scene, steps: int) -> float:
        """Estimate the seconds of teacher runs, training and everything after it."""
        training = self.teacher_seconds(scene, steps) + self.training_seconds(scene, steps)
        return training + sum(self.seconds_after_training(scene, steps).values())

    def max_steps_within(self, scene: Scene, seconds: float) -> int:
        """Return the largest number of steps, at least one, with which everything fits into `seconds`."""
        low, high = 1, FULL_STEPS
        while low < high:
            middle = (low + high + 1) // 2
            low, high = (middle, high) if self.total_seconds(scene, middle) <= seconds else (low, middle - 1)
        return low

    def plan_within(self, scene: Scene, seconds: float) -> Plan:
        """Return the requested plan with the most steps that fit into `seconds`, at least one.

        If teacher runs leave no time for the usual number of steps, the plan has more steps in their place.
        """
        plan = dataclasses.replace(self.requested, steps=self.max_steps_within(scene, seconds))
        if self.teacher_seconds(scene, plan.steps):
            return plan
        without = dataclasses.replace(self.requested, virtual_views=False)
        steps = dataclasses.replace(self, requested=without).max_steps_within(scene, seconds)
        return dataclasses.replace(without, steps=steps) if steps > plan.steps else plan


def fit_plan_to_minutes(
    path: Path,
    load_settings: LoadSettings,
    scene: Scene,
    requested: Plan,
    device: torch.device,
    end: float,
    seed: int,
    cache: PictureCache,
    reporter: Reporter,
) -> Plan:
    """Measure the cost of a scene, and return the plan with the most steps that is finished in time.

    If the time is too short for a sensible scene, the plan is a draft that ends later.

    Args:
        path: path of the photos.
        load_settings: settings with which they are read.
        scene: the photos at the size of `load_settings`.
        requested: the plan without a time limit, which has the target size, number of Gaussians and preset.
        device: device of the training.
        end: time limit by the monotonic clock, in seconds.
        seed: random seed.
        cache: cache of decoded photos.
        reporter: reports progress, and gets the estimates of the plan.
    """
    # The pilots that choose a number of steps take as long as the training itself, so the time limit alone chooses it.
    requested = dataclasses.replace(requested, early_stop=False)
    if (remaining := end - monotonic()) <= 0:
        return _plan_draft(path, load_settings, requested, device, reporter)
    max_probe_seconds = MAX_PROBE_TIME_RATIO * remaining
    scenes = {load_settings.max_size: scene}

    def scene_at(size: int) -> Scene:
        return scenes[size] if size in scenes else scenes.setdefault(size, load_settings.load(path, size))

    def measure_cost_at(size: int, share: float) -> SceneCost:
        reporter.update(share, f"timing training steps on photos of {_longest_side(scene_at(size))} pixels")
        return measure_scene_cost(scene_at(size), requested, device, seed, cache, max_probe_seconds)

    sizes = _candidate_sizes(scene, load_settings.max_size)
    size, cost = _choose_photo_size(sizes, scene_at, measure_cost_at, end)
    chosen_scene = scene_at(size)
    requested = cost.plan_within(chosen_scene, end - monotonic())
    config = requested.train_config(seed)
    decisions = decide(chosen_scene, config, cache, device, part_of_progress(reporter.report_event, 0.6, 1.0))
    assert decisions is not None  # None is only returned if the run is stopped, which nothing does here
    for reason in decisions.reasons.values():
        _LOG.info(f"pilot runs: {reason}")
    factor = decisions.config.budget_factor
    if is_budget_open(config) and factor is None:
        factor = 1.0  # the decision stays the same if a few more steps fit
    requested = dataclasses.replace(requested, max_size=size, budget_factor=factor, exposure=decisions.config.exposure)
    cost = dataclasses.replace(cost, requested=requested)
    plan = _choose_steps(cost, chosen_scene, end - monotonic())
    cost = dataclasses.replace(cost, requested=plan)
    reporter.estimates |= {
        "pilots": 0.0,
        "teachers": cost.teacher_seconds(chosen_scene, plan.steps),
        "training": cost.training_seconds(chosen_scene, plan.steps),
        **cost.seconds_after_training(chosen_scene, plan.steps),
    }
    return plan


def _plan_draft(
    path: Path, load_settings: LoadSettings, requested: Plan, device: torch.device, reporter: Reporter
) -> Plan:
    """Return the plan of a draft for a call without time for training, and estimate how long the draft takes."""
    draft = QUALITIES["draft"]
    _LOG.warning(f"no time is left for training: training a draft of {draft.steps} steps")
    max_size = min(load_settings.max_size or draft.max_size, draft.max_size)
    plan = dataclasses.replace(requested, steps=draft.steps, max_size=max_size)
    reporter.estimates |= estimate_scene_seconds(load_settings.load(path, max_size), plan, device)
    return plan


def _choose_photo_size(
    sizes: Sequence[int],
    scene_at: Callable[[int], Scene],
    measure_cost_at: Callable[[int, float], SceneCost],
    end: float,
) -> tuple[int, SceneCost]:
    """Choose the largest size of photos at which MIN_USEFUL_STEPS fit into the time; the smallest if none does.

    The cost is measured at a size of at least MIN_PROBE_PHOTO_SIZE, estimated from that for the other sizes, and
    measured again at the chosen size.

    Args:
        sizes: sizes to choose from, the largest first.
        scene_at: returns the scene with photos of a size.
        measure_cost_at: measures the cost at a size; its second argument is the share of the stage that is done.
        end: time limit by the monotonic clock, in seconds.

    Returns:
        The size, and the cost of the scene at this size.
    """
    probed = next((size for size in reversed(sizes) if size >= MIN_PROBE_PHOTO_SIZE), sizes[0])
    cost = probe = measure_cost_at(probed, 0.0)
    for size in sizes:
        cost = probe.scaled_by_pixels(mean_megapixels(scene_at(size)) / mean_megapixels(scene_at(probed)))
        if cost.max_steps_within(scene_at(size), end - monotonic()) >= MIN_USEFUL_STEPS:
            break
    return size, cost if size == probed else measure_cost_at(size, 0.5)


def _choose_steps(cost: SceneCost, scene: Scene, remaining: float) -> Plan:
    """Return the plan that fits into the remaining seconds, with at least the steps of a draft, and log its steps."""
    plan = cost.plan_within(scene, remaining)
    if plan.steps < (draft_steps := QUALITIES["draft"].steps):
        _LOG.warning(
            f"the time is short: training a draft of {draft_steps} steps, which takes about "
            f"{cost.total_seconds(scene, draft_steps) / 60:.1f} minutes"
        )
        return dataclasses.replace(plan, steps=draft_steps)
    note = ", the maximum; the scene will be finished early" if plan.steps == FULL_STEPS else ""
    _LOG.info(
        f"{remaining / 60:.1f} minutes are left: {plan.steps:,} steps on photos of {_longest_side(scene)} pixels{note}"
    )
    return plan


def measure_scene_cost(
    scene: Scene, requested: Plan, device: torch.device, seed: int, cache: PictureCache, max_seconds: float
) -> SceneCost:
    """Measure the cost of a scene by a small training run from its first Gaussians to the budget.

    Args:
        scene: the photos.
        requested: the requested plan, which determines the budget.
        device: device of the training.
        seed: random seed.
        cache: cache of decoded photos.
        max_seconds: the run stops after this time, but not before it has enough steps for a measurement.
    """
    default_config = dataclasses.replace(requested, steps=TrainConfig.steps).train_config(seed)
    budget, _ = budget_for(scene, default_config)
    config = TrainConfig(
        steps=PROBE_STEPS,
        resolution_schedule=False,
        seed=seed,
        preset=requested.preset,
        max_gaussians=budget,
        density=PROBE_DENSITY,
        surface_points=False,
    )
    trainer = Trainer(scene, config, cache, device)
    counts: list[int] = []
    working: list[float] = []
    waiting: list[float] = []
    end = monotonic() + max_seconds

    def measure_step(event: StepEvent) -> None:
        waited = trainer.seconds["data"] - sum(waiting)
        working.append(trainer.elapsed - sum(working) - sum(waiting) - waited)
        waiting.append(waited)
        counts.append(event.gaussians)

    trainer.run(progress=measure_step, stop=lambda: len(working) > 2 * PROBE_WARM_UP_STEPS and monotonic() > end)
    step_seconds, seconds_per_gaussian = _fit_line(counts[PROBE_WARM_UP_STEPS:], working[PROBE_WARM_UP_STEPS:])
    views = [view.camera for view in evenly_spaced(scene.train, 4)]
    cpu_pass_seconds = _measure_cpu_pass(trainer.model, views)
    decoding_seconds = statistics.fmean(waiting)
    return SceneCost(step_seconds, seconds_per_gaussian, decoding_seconds, cpu_pass_seconds, counts[-1], requested)


def _fit_line(counts: Sequence[int], seconds: Sequence[float]) -> tuple[float, float]:
    """Fit the line seconds = a + b count through the medians of the first and the last third; return a, b >= 0."""
    third = max(1, len(counts) // 3)
    first, last = slice(0, third), slice(-third, None)
    x0, x1 = (float(np.median(counts[part])) for part in (first, last))
    y0, y1 = (float(np.median(seconds[part])) for part in (first, last))
    slope = (y1 - y0) / (x1 - x0) if x1 > x0 else 0.0
    slope = min(max(slope, 0.0), y1 / max(x1, 1.0))
    return max(0.0, y1 - slope * x1), slope  # rounding can make the difference negative


def _measure_cpu_pass(model: HybridModel, cameras: Sequence[Camera]) -> float:
    """Return the median seconds of a pass on the CPU, without the first pass, which warms up."""
    model = model.to("cpu")
    times = []
    for camera in cameras:
        began = perf_counter()
        render_view(model, camera).rgb.sum().backward()
        times.append(perf_counter() - began)
    return statistics.median(times[1:] or times)


def _candidate_sizes(scene: Scene, max_size: int) -> list[int]:
    """Return the sizes of photos to choose from, the largest first."""
    longest = _longest_side(scene)
    return [max_size, *(size for size in CANDIDATE_PHOTO_SIZES if size < longest)]


def _longest_side(scene: Scene) -> int:
    """Return the longer side of the largest photo in pixels."""
    return max(max(view.camera.width, view.camera.height) for view in scene.views)

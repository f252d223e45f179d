"""Fitting a time: how many steps, on photos of which size, a scene may have on this machine, by a short measurement."""

from __future__ import annotations

import dataclasses
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import monotonic, perf_counter

import numpy as np
import torch

from hyrfpack.data import PictureCache
from hyrfpack.make.plan import (
    BACKGROUND_PASSES,
    PASSES_PER_SCORED_VIEW,
    QUALITIES,
    Plan,
    megapixels,
    passes,
)
from hyrfpack.make.progress import Reporter
from hyrfpack.make.source import Reading
from hyrfpack.make.work import Say
from hyrfpack.model import HybridModel
from hyrfpack.render import render
from hyrfpack.scene import DEFAULT_MAX_SIZE, Camera, Scene, evenly_spaced
from hyrfpack.train import DensityConfig, TrainConfig, Trainer
from hyrfpack.train.config import FULL_STEPS
from hyrfpack.train.decisions import decide, is_budget_open, max_pilot_steps
from hyrfpack.train.setup import budget_for

PROBE_STEPS = 45  # of a whole small run: from the first Gaussians to the budget
RISING = DensityConfig(stop=0.6, peak=0.6, excess=1.0)  # from few Gaussians to many, for what one of them takes
COLD_STEPS = 3  # which compile kernels
PROBE_TIME = 0.06  # of the time, for one measurement at most
USEFUL_STEPS = 1_000  # fewer are only a trial: smaller photos are better
SIZES = (1200, 800, 600, 400)  # of photos, where the time is short
SMALLEST = 640  # pixels: photos that are no larger are not shrunk further for the first measurement
SETTLED = 0.92  # of the probe's pace per Gaussian: a trained scene hides more of what lies behind
# A pass (drawing a view on the CPU and following it back) is the unit of all that comes after the training.
VERIFIED = 12  # views that packing draws
PER_GAUSSIAN, OVERHEAD = 1.5e-4, 6.0  # seconds of coding and writing, for a Gaussian and for anything


@dataclass(frozen=True)
class Cost:
    """What a scene costs on this machine, at one size of its photos.

    Attributes:
        step, step_per_gaussian: seconds of a training step: of pixels, and for each Gaussian.
        decoding: seconds that training waits for a photo to be decoded.
        cpu_pass: seconds to draw a view on the CPU and follow it back, at `gaussians`.
        gaussians: that the probe ended with.
        asked: what decides how many Gaussians there will be; its steps are not used.
    """

    step: float
    step_per_gaussian: float
    decoding: float
    cpu_pass: float
    gaussians: int
    asked: Plan = Plan(FULL_STEPS, DEFAULT_MAX_SIZE)

    def scaled(self, pixels: float) -> Cost:
        """That of photos with so many times the pixels, by estimate."""
        step, per_gaussian, cpu = (pixels * t for t in (self.step, self.step_per_gaussian, self.cpu_pass))
        return dataclasses.replace(self, step=step, step_per_gaussian=per_gaussian, cpu_pass=cpu)

    def training(self, scene: Scene, steps: int) -> float:
        """Seconds of a training, from the number of Gaussians that there are on average."""
        budget = self._budget(scene, steps)
        mean = DensityConfig().mean_count(min(budget, len(scene.points) or budget // 2), budget)
        step = self.step + self.step_per_gaussian * mean
        return SETTLED * steps * step + self.decoding * min(steps, len(scene.train))

    def after(self, scene: Scene, steps: int) -> dict[str, float]:
        """Seconds of what follows the last step, by part (`hyrfpack.make.progress.STAGE_PARTS`) or stage."""
        budget = self._budget(scene, steps)
        at_end, at_probe = (self.step + self.step_per_gaussian * n for n in (budget, self.gaussians))
        one = SETTLED * self.cpu_pass * at_end / at_probe
        scored = PASSES_PER_SCORED_VIEW * len(scene.test)
        return {
            "results": one * (BACKGROUND_PASSES + scored) + OVERHEAD / 2,
            "compression": one * (passes(budget) + VERIFIED) + PER_GAUSSIAN * budget,
            "scoring": one * scored,
            "export": OVERHEAD / 2,
        }

    def _budget(self, scene: Scene, steps: int) -> int:
        return budget_for(scene, dataclasses.replace(self.asked, steps=steps).config(seed=0))[0]

    def total(self, scene: Scene, steps: int) -> float:
        return self.training(scene, steps) + sum(self.after(scene, steps).values())

    def steps_within(self, scene: Scene, seconds: float) -> int:
        """The most steps, at least one, that all fits into so many seconds with."""
        low, high = 1, FULL_STEPS
        while low < high:
            middle = (low + high + 1) // 2
            low, high = (middle, high) if self.total(scene, middle) <= seconds else (low, middle - 1)
        return low


def measure(
    path: Path,
    reading: Reading,
    scene: Scene,
    asked: Plan,
    device: torch.device,
    end: float,
    seed: int,
    cache: PictureCache,
    reporter: Reporter,
    say: Say,
) -> Plan:
    """The plan that ends at a time, `end` by the monotonic clock, or as soon as is sensible where that is too early.

    Args:
        path, reading: of the photos.
        scene: them, as they are read.
        asked: what is asked for besides the time: target size, number of Gaussians, preset.
        cache: keeps photos that are decoded.
    """
    draft = QUALITIES["draft"]
    if (left := end - monotonic()) <= 0:
        say(f"the time is over before the training: a draft follows, of {draft.steps} steps")
        shrunk = min(reading.max_size or draft.max_size, draft.max_size)
        return dataclasses.replace(asked, steps=draft.steps, max_size=shrunk)
    sizes = _sizes(scene, reading.max_size)
    probed = next((size for size in reversed(sizes) if size >= SMALLEST), sizes[-1])
    scenes = {reading.max_size: scene}

    def at(size: int) -> Scene:
        return scenes[size] if size in scenes else scenes.setdefault(size, reading.scene(path, size))

    reporter.update(0.0, f"a few steps on photos of {_longest(at(probed))} pixels")
    cost = first = probe(at(probed), asked, device, seed, cache, PROBE_TIME * left)
    for chosen in sizes:
        cost = first.scaled(megapixels(at(chosen)) / megapixels(at(probed)))
        if cost.steps_within(at(chosen), end - monotonic()) >= USEFUL_STEPS:
            break
    if chosen != probed:
        reporter.update(0.5, f"a few steps on photos of {_longest(at(chosen))} pixels")
        cost = probe(at(chosen), asked, device, seed, cache, PROBE_TIME * left)
    fitting = at(chosen)
    config = dataclasses.replace(asked, steps=cost.steps_within(fitting, end - monotonic())).config(seed)
    most = max(max_pilot_steps(fitting, config), 1)

    def tell(step: int, loss: float, mse: float, gaussians: int) -> None:
        reporter.update(0.6 + 0.4 * step / most, "pilot runs choose the exposure compensation and the Gaussian budget")

    decisions = decide(fitting, config, cache, device, tell)
    assert decisions is not None  # nothing stops it
    factor = decisions.config.budget_factor
    if is_budget_open(config) and factor is None:
        factor = 1.0  # which stays so where there are a few more steps
    for reason in decisions.reasons.values():
        say(f"pilot runs: {reason}")
    asked = dataclasses.replace(asked, max_size=chosen, budget_factor=factor, exposure=decisions.config.exposure)
    cost = dataclasses.replace(cost, asked=asked)
    left = end - monotonic()
    steps = cost.steps_within(fitting, left)
    if steps < draft.steps:
        steps = draft.steps
        say(f"the time is short: a draft, of {steps} steps, takes about {cost.total(fitting, steps) / 60:.1f} minutes")
    else:
        enough = ", which are enough: it will be ready before" if steps == FULL_STEPS else ""
        say(f"{left / 60:.1f} minutes are left: {steps:,} steps on photos of {_longest(fitting)} pixels{enough}")
    reporter.estimates |= {"pilots": 0.0, "training": cost.training(fitting, steps), **cost.after(fitting, steps)}
    return dataclasses.replace(asked, steps=steps)


def probe(scene: Scene, asked: Plan, device: torch.device, seed: int, cache: PictureCache, seconds: float) -> Cost:
    """Measure what a scene costs by a small training run from its first Gaussians to a budget.

    Args:
        asked: what decides how many Gaussians there will be.
        seconds: after which it ends in any case, but for the steps that it takes to measure anything.
    """
    usual = dataclasses.replace(asked, steps=TrainConfig.steps).config(seed)
    budget, _ = budget_for(scene, usual)
    config = TrainConfig(steps=PROBE_STEPS, seed=seed, preset=asked.preset, max_gaussians=budget, density=RISING)
    trainer = Trainer(scene, config, cache, device)
    counts: list[int] = []
    working: list[float] = []
    waiting: list[float] = []
    end = monotonic() + seconds

    def report(trainer: Trainer, loss: float, mse: float) -> None:
        waited = trainer.seconds["data"] - sum(waiting)
        working.append(trainer.elapsed - sum(working) - sum(waiting) - waited)
        waiting.append(waited)
        counts.append(len(trainer.model))

    trainer.run(report=report, stop=lambda: len(working) > 2 * COLD_STEPS and monotonic() > end)
    step, per_gaussian = _line_through(counts[COLD_STEPS:], working[COLD_STEPS:])
    views = [view.camera for view in evenly_spaced(scene.train, 4)]
    cpu_pass = _cpu_pass(trainer.model, views)
    return Cost(step, per_gaussian, statistics.fmean(waiting), cpu_pass, counts[-1], asked)


def _line_through(counts: Sequence[int], seconds: Sequence[float]) -> tuple[float, float]:
    """(a, b), neither negative, of seconds = a + b count: through the medians of the first and the last third."""
    third = max(1, len(counts) // 3)
    first, last = slice(0, third), slice(-third, None)
    x0, x1 = (float(np.median(counts[part])) for part in (first, last))
    y0, y1 = (float(np.median(seconds[part])) for part in (first, last))
    slope = (y1 - y0) / (x1 - x0) if x1 > x0 else 0.0
    slope = min(max(slope, 0.0), y1 / max(x1, 1.0))
    return y1 - slope * x1, slope


def _cpu_pass(model: HybridModel, cameras: Sequence[Camera]) -> float:
    """Seconds to draw a view on the CPU and follow it back to every number; the median, the first left out."""
    model = model.to("cpu")
    times = []
    for camera in cameras:
        began = perf_counter()
        render(model, camera).rgb.sum().backward()
        times.append(perf_counter() - began)
    return statistics.median(times[1:] or times)


def _sizes(scene: Scene, max_size: int) -> list[int]:
    """Limits on the size of photos to choose from, the largest first."""
    longest = _longest(scene)
    return [max_size, *(size for size in SIZES if size < longest)]


def _longest(scene: Scene) -> int:
    """Pixels of the longer side of the largest photo."""
    return max(max(view.camera.width, view.camera.height) for view in scene.views)

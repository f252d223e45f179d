"""Settings of a training run."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, fields
from itertools import pairwise

from hyrfpack.checks import check_bool, check_choice, check_float, check_int, check_pair
from hyrfpack.choices import PRECISIONS, PRESETS

BACKGROUND_COLORS = ("black", "white", "random")
LARGEST_SEED = 2**64 - 1  # torch's generators take seeds of 64 bits.
FULL_STEPS = 30_000  # The paper's schedules are written for runs of this length.
MIN_RATE_SCALING_STEPS = 1_000  # Shorter runs use the learning rates of a run of this length.
BUDGET_FACTOR_RANGE = 1e-3, 1e3
MIN_LEARNING_RATE = 1e-30  # It is above 0, because the schedule divides by the first rate.


@dataclass(frozen=True)
class LearningRates:
    """Adam's learning rates of each parameter group at the first and the last step of a full-length run.

    Rates decay exponentially in between. Shorter runs multiply them by sqrt(FULL_STEPS / steps). Positions are in local
    units (the frame's longest half-axis is 1). The other parameters are logits, weights of the fields, and log gains of
    photos. All rates are positive.
    """

    positions: tuple[float, float] = (2e-4, 2e-6)
    fields: tuple[float, float] = (3e-3, 3e-4)
    color_logits: tuple[float, float] = (6e-3, 6e-4)
    scale_logits: tuple[float, float] = (1.2e-2, 1.2e-3)
    opacity_logits: tuple[float, float] = (3e-2, 3e-3)
    exposure: tuple[float, float] = (1e-3, 1e-4)

    def __post_init__(self) -> None:
        for group in fields(self):
            check_pair(group.name, getattr(self, group.name))
            for rate in getattr(self, group.name):
                check_float(f"a rate of {group.name}", rate, MIN_LEARNING_RATE)

    def at(self, name: str, step: int, steps: int, views: int = 1) -> float:
        """Return the learning rate of the group `name` at `step` (from 0) of a run of `steps` steps.

        Each step uses the mean gradient of W = `views` views. That mean has 1 / sqrt(W) of the noise of one gradient,
        and the run has 1 / W of the steps. So the rate grows with sqrt(W).
        """
        first, last = getattr(self, name)
        pace = math.sqrt(views * FULL_STEPS / min(max(steps * views, MIN_RATE_SCALING_STEPS), FULL_STEPS))
        return pace * first * (last / first) ** (step / steps)


@dataclass(frozen=True)
class DensityConfig:
    """Settings of density control, which clones, splits and prunes Gaussians. Times are fractions of the run, 0 to 1.

    Attributes:
        start, stop: times between which rounds take place.
        peak: time at which the number of Gaussians is largest; it grows linearly until then, and falls linearly after.
        excess: largest number of Gaussians, in budgets, at least 1. Until `stop` those with the lowest importance are
            pruned, down to one budget. With 1 the number stays at the budget from `peak` on.
        rounds: number of rounds, at least 1.
        gradient: mean absolute gradient of a Gaussian's projected centre (NDC units) above which it is cloned or split.
        split_scale: a Gaussian with a larger scale (local units, divided by max(1, |u|)) is split instead of cloned.
        prune_opacity: Gaussians with a lower opacity are pruned.
        prune_scale: Gaussians with a larger scale (units of `split_scale`) are pruned, unless they are more than a
            tenth of all.
        resets: number of opacity resets, evenly spread between `start` and `peak` (exclusive); 0 or more.
        reset_opacity: opacity that a reset caps all Gaussians at, between 0 and 1.
    """

    start: float = 0.02
    stop: float = 0.65
    peak: float = 0.35
    excess: float = 2.0
    rounds: int = 30
    gradient: float = 2e-4
    split_scale: float = 0.01
    prune_opacity: float = 0.005
    prune_scale: float = 0.5
    resets: int = 0
    reset_opacity: float = 0.01

    def __post_init__(self) -> None:
        for name in ("start", "stop", "peak", "prune_opacity"):
            check_float(name, getattr(self, name), 0, 1)
        for name in ("gradient", "split_scale", "prune_scale"):
            check_float(name, getattr(self, name))
        check_float("excess", self.excess, 1)
        check_int("rounds", self.rounds, 1)
        check_int("resets", self.resets, 0)
        check_float("reset_opacity", self.reset_opacity, 1e-6, 1 - 1e-6)  # so that its logit is finite

    def mean_count(self, initial: int, budget: int) -> float:
        """Return the mean number of Gaussians over a run in which each round reaches its target number."""
        most = self.excess * budget
        corners = (0, initial), (self.start, initial), (self.peak, most), (self.stop, budget), (1, budget)
        return sum((t1 - t0) * (n0 + n1) / 2 for (t0, n0), (t1, n1) in pairwise(corners))


@dataclass(frozen=True)
class TrainConfig:
    """Everything that decides the outcome of a run, besides the scene.

    Attributes:
        steps: optimiser steps, one view each; every schedule scales with it.
        seed: random seed of view order, initialisation and density control; 0 to LARGEST_SEED.
        preset: the paper's regime, one of PRESETS; "auto" chooses by the scene.
        max_gaussians: budget, the most Gaussians that a run ends with, at least 1. During the run there may be
            `DensityConfig.excess` times as many. None chooses the budget by the photos' pixels, the steps,
            `target_bytes` and `budget_factor`.
        budget_factor: the budget as a multiple of what pixels and steps suggest, instead of `max_gaussians`; 0.001 to
            1000. None means 1, but `hyrfpack.train_model` measures the factor before a run of at least 2,000 steps on
            at least eight photos, see `hyrfpack.train.budget_pilots`.
        target_bytes: size in bytes of the packed file to train for, instead of `max_gaussians`; None for no limit.
        log2_table_size: log2 of the radiance grid's rows per level, 4 to 24 (the geometry grid has half as many rows);
            None chooses it by the budget.
        background: whether a background sphere is trained; None lets the preset decide.
        exposure: whether per-image gains (exposure compensation) and an exposure map, which the file stores, are learnt
            beside the model. None leaves the decision to pilot runs, see `hyrfpack.train.exposure_pilots`; a `Trainer`
            by itself then learns none.
        background_color: colour that transparent pictures are composited over: "black", "white", or "random" (a new
            colour in each step; the model's own background is then black).
        ssim_weight: weight w of SSIM in the loss (1 - w) L1 + w (1 - SSIM), 0 to 1.
        checkpoint_every: steps between checkpoints; None for a twentieth of the run.
        precision: number format of products in GPU kernels, "mixed" or "float32", see `HybridModel.precision`.
        scale_rule, scale_grows, direction_encoding, position_gradients, antialiased: as in ModelConfig.
        learning_rates, density: see LearningRates and DensityConfig.
        grid_resolutions: vertices per axis of the coarsest and the finest level of both hash grids, 2 to 65536.
    """

    steps: int = 3000
    seed: int = 0
    preset: str = "auto"
    max_gaussians: int | None = None
    budget_factor: float | None = None
    target_bytes: int | None = None
    log2_table_size: int | None = None
    background: bool | None = None
    exposure: bool | None = None
    background_color: str = "black"
    antialiased: bool = False
    ssim_weight: float = 0.2
    checkpoint_every: int | None = None
    precision: str = "mixed"
    scale_rule: str = "sum"
    scale_grows: bool = True
    direction_encoding: str = "frequency"
    grid_resolutions: tuple[int, int] = (8, 512)
    position_gradients: bool = False
    learning_rates: LearningRates = field(default_factory=LearningRates)
    density: DensityConfig = field(default_factory=DensityConfig)

    def __post_init__(self) -> None:
        check_int("steps", self.steps, 1)
        check_int("seed", self.seed, 0, LARGEST_SEED)
        for name in ("max_gaussians", "target_bytes", "checkpoint_every"):
            if getattr(self, name) is not None:
                check_int(name, getattr(self, name), 1)
        sizes = {
            "a number of Gaussians": self.max_gaussians,
            "a target size": self.target_bytes,
            "a factor": self.budget_factor,
        }
        if len(given := [name for name, value in sizes.items() if value is not None]) > 1:
            raise ValueError(f"{' and '.join(given)} each decide how large the model is; give one")
        if self.budget_factor is not None:
            check_float("budget_factor", self.budget_factor, *BUDGET_FACTOR_RANGE)
        if self.log2_table_size is not None:
            check_int("log2_table_size", self.log2_table_size, 4, 24)
        check_choice("preset", self.preset, PRESETS)
        check_choice("precision", self.precision, PRECISIONS)
        check_choice("background_color", self.background_color, BACKGROUND_COLORS)
        check_choice("scale_rule", self.scale_rule, ("sum", "product"))
        check_choice("direction_encoding", self.direction_encoding, ("frequency", "sh"))
        for name in ("background", "exposure"):
            if getattr(self, name) is not None:
                check_bool(name, getattr(self, name))
        for name in ("antialiased", "scale_grows", "position_gradients"):
            check_bool(name, getattr(self, name))
        check_float("ssim_weight", self.ssim_weight, 0, 1)
        check_pair("grid_resolutions", self.grid_resolutions)
        coarsest, finest = self.grid_resolutions
        check_int("the finest of grid_resolutions", finest, 2, 65536)
        check_int("the coarsest of grid_resolutions", coarsest, 2, finest)
        for name, kind in (("learning_rates", LearningRates), ("density", DensityConfig)):
            if not isinstance(getattr(self, name), kind):
                raise ValueError(f"{name} is {getattr(self, name)!r}; it must be a {kind.__name__}")

    def to_dict(self) -> dict:
        """Return the settings as plain numbers, strings, lists and dictionaries, ready for JSON."""
        return asdict(self)

"""Settings of a training run."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, fields, replace
from itertools import pairwise
from typing import Annotated

from hyrfpack.checks import check_float, check_int, check_pair
from hyrfpack.choices import PRECISIONS, PRESETS
from hyrfpack.config.settings import OneOf, Range, Seed, check_settings

FULL_STEPS = 30_000  # The paper's schedules are written for runs of this length.
MIN_RATE_SCALING_STEPS = 1_000  # Shorter runs use the learning rates of a run of this length.
# The learning rate of untrained fields rises linearly over the first steps. At the full rate, the first steps of Adam,
# which all have about the same direction, can make every Gaussian as large and opaque as it can be. The sigmoids then
# have no gradient, and the scene stays empty. A rise over 10 steps prevents most such runs, one over 20 steps all known
# ones.
FIELD_WARMUP_STEPS = 20
# Distance between Gaussians, in local units, up to which positions have the learning rate as stated. The default rate
# is .07 of this distance at the start of 2,000 steps.
POSITION_RATE_SPACING = 0.011
MIN_LEARNING_RATE = 1e-30  # It is above 0, because the schedule divides by the first rate.


@dataclass(frozen=True)
class LearningRates:
    """Adam's learning rates of each parameter group at the first and the last step of a full-length run.

    Rates decay exponentially in between. Shorter runs multiply them by sqrt(FULL_STEPS / steps). Positions are in local
    units (the frame's longest half-axis is 1) and learn faster where Gaussians are far apart (`at_spacing`). The other
    parameters are logits, weights of the fields, and log gains of photos. All rates are positive.
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

    def at_spacing(self, spacing: float) -> LearningRates:
        """Return these rates for Gaussians that are `spacing` local units apart.

        Where that is more than POSITION_RATE_SPACING, the rate of positions grows in proportion.
        """
        first, last = self.positions
        factor = max(1.0, spacing / POSITION_RATE_SPACING)
        return replace(self, positions=(factor * first, factor * last))

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
        start, stop: times between which rounds take place; there are none if `stop` comes before `start`.
        peak: time from `start` to `stop` at which the number of Gaussians is largest; it grows linearly until then, and
            falls linearly after.
        excess: largest number of Gaussians, in budgets, at least 1. Until `stop` those with the lowest importance are
            pruned, down to one budget. With 1 the number stays at the budget from `peak` on.
        rounds: approximate number of rounds, at least 1. They are a whole number of steps apart, at least five.
        gradient: mean absolute gradient of a Gaussian's projected centre (NDC units) above which it is cloned or split.
        split_scale: a Gaussian with a larger scale (local units, divided by max(1, |u|)) is split instead of cloned.
        prune_opacity: Gaussians with a lower opacity are pruned.
        prune_scale: Gaussians with a larger scale (units of `split_scale`) are pruned, unless they are more than a
            tenth of all.
        resets: approximate number of opacity resets, evenly spread between `start` and `peak`; 0 or more. None comes
            within a round's interval before `peak`.
        reset_opacity: opacity that a reset caps all Gaussians at, between 0 and 1.
    """

    start: Annotated[float, Range(0, 1)] = 0.02
    stop: Annotated[float, Range(0, 1)] = 0.65
    peak: Annotated[float, Range(0, 1)] = 0.35
    excess: Annotated[float, Range(1)] = 2.0
    rounds: Annotated[int, Range(1)] = 30
    gradient: Annotated[float, Range(0)] = 2e-4
    split_scale: Annotated[float, Range(0)] = 0.01
    prune_opacity: Annotated[float, Range(0, 1)] = 0.005
    prune_scale: Annotated[float, Range(0)] = 0.5
    resets: Annotated[int, Range(0)] = 0
    reset_opacity: Annotated[float, Range(1e-6, 1 - 1e-6)] = 0.01  # limited so that its logit is finite

    def __post_init__(self) -> None:
        check_settings(self)

    def planned_counts(self, initial: int, budget: int) -> list[tuple[float, float]]:
        """Return the corners (time, number of Gaussians) of a run in which each round reaches its target number."""
        if self.stop < self.start:
            return [(0, initial), (1, initial)]
        peak_count, peak = self.excess * budget, min(max(self.start, self.peak), self.stop)
        return [(0, initial), (self.start, initial), (peak, peak_count), (self.stop, budget), (1, budget)]

    def mean_count(self, initial: int, budget: int) -> float:
        """Return the mean number of Gaussians over a run in which each round reaches its target number."""
        corners = pairwise(self.planned_counts(initial, budget))
        return sum((t1 - t0) * (n0 + n1) / 2 for (t0, n0), (t1, n1) in corners)


@dataclass(frozen=True)
class TrainConfig:
    """Everything that decides the outcome of a run, besides the scene.

    Each step renders one view, and every schedule scales with `steps`. `max_gaussians`, `target_bytes` and
    `budget_factor` exclude each other. Without them, the budget follows from the photos' pixels and the steps;
    `hyrfpack.train_model` also measures the factor before a run of at least 2,000 steps on at least eight photos
    (`hyrfpack.train.budget_pilots`). During the run there may be `DensityConfig.excess` times as many Gaussians. Pilot
    runs decide `exposure`, too (`hyrfpack.train.exposure_pilots`), and before a run of at least 6,000 steps on 8 to 30
    photos, or of at least 20,000 on 31 to 100, whether fewer steps are enough (`hyrfpack.train.length_pilots`). A
    `Trainer` by itself makes no pilot runs: it takes all steps, and learns no gains unless `exposure` is True. The hash
    grid whose rows `log2_table_size` states is that of radiance (None: by the budget); the geometry grid has half as
    many, at least 2^4. The background colour "random" is a new one in each step, and the model's own background is then
    black.

    Attributes:
        steps: training steps.
        early_stop: shorten a run of 6,000 steps or more on 8 to 30 photos, or of 20,000 or more on up to 100, where
            pilot runs show that more do not help.
        resolution_schedule: in the first 80 % of the steps, reduce photos if they are large and Gaussians few, and
            evaluate the background of photos that are not reduced at every third pixel.
        seed: random seed. On a CPU, the same seed gives the same file.
        preset: kind of scene; auto detects it.
        max_gaussians: budget: the number of Gaussians in the end, at most. Default: measured by pilot runs.
        budget_factor: multiplies the budget that the pixels suggest; below 1, it does not lower the limit for short
            runs. Default: measured by pilot runs.
        target_bytes: choose the budget so that 'hyrfpack compress' reaches this file size, such as 500kB.
        surface_points: start with points on surfaces that photos show, beside those of the scene, up to the budget.
        virtual_views: train runs of at least 3,000 steps (2,000 on photos of 1.7 megapixels) on 2 to 16 photos also
            on virtual views: the mean render of three short runs at viewpoints between the photos.
        log2_table_size: rows per level of the hash grid: 2^B.
        background: train a background sphere. Default: by preset.
        exposure: exposure compensation: learn per-image gains and an exposure map. Default: decided by pilot runs.
        background_color: colour behind transparent photos.
        antialiased: antialiasing: dim small Gaussians as the pixel filter widens them.
        ssim_weight: weight w of SSIM in the loss (1 - w) L1 + w (1 - SSIM).
        checkpoint_every: steps between checkpoints, each of one view per process. Default: a twentieth of the run.
        precision: precision of matrix products on a GPU: bfloat16 with float32 sums (mixed), or float32. The CPU always
            uses float32.
        direction_encoding: as in ModelConfig.
        learning_rates, density: see LearningRates and DensityConfig.
        grid_resolutions: vertices per axis of the coarsest and the finest level of both hash grids, 2 to 65536.
    """

    steps: Annotated[int, Range(1)] = 3000
    early_stop: bool = True
    resolution_schedule: bool = True
    seed: Seed = 0
    preset: Annotated[str, OneOf(PRESETS)] = "auto"
    max_gaussians: Annotated[int | None, Range(1)] = None
    budget_factor: Annotated[float | None, Range(1e-3, 1e3)] = None
    target_bytes: Annotated[int | None, Range(1, unit="bytes")] = None
    surface_points: bool = True
    virtual_views: bool = True
    log2_table_size: Annotated[int | None, Range(4, 24, unit="b")] = None
    background: bool | None = None
    exposure: bool | None = None
    background_color: Annotated[str, OneOf(("black", "white", "random"))] = "black"
    antialiased: bool = False
    ssim_weight: Annotated[float, Range(0, 1)] = 0.2
    checkpoint_every: Annotated[int | None, Range(1, unit="steps")] = None
    precision: Annotated[str, OneOf(PRECISIONS)] = "mixed"
    direction_encoding: Annotated[str, OneOf(("frequency", "sh"))] = "frequency"
    grid_resolutions: tuple[int, int] = (8, 512)
    learning_rates: LearningRates = field(default_factory=LearningRates)
    density: DensityConfig = field(default_factory=DensityConfig)

    def __post_init__(self) -> None:
        check_settings(self)
        sizes = {
            "a number of Gaussians": self.max_gaussians,
            "a target size": self.target_bytes,
            "a factor": self.budget_factor,
        }
        if len(given_sizes := [name for name, value in sizes.items() if value is not None]) > 1:
            raise ValueError(f"{' and '.join(given_sizes)} each decide how large the model is; give one")
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

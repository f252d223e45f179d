"""Settings of a training run."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field

PRECISIONS = ("mixed", "float32")
PRESETS = ("auto", "synthetic", "standard", "large", "street")
FULL_STEPS = 30_000  # the length of a run that the paper's schedule is written for
SHORT_STEPS = 1_000  # rates grow no further in runs shorter than this


@dataclass(frozen=True)
class LearningRates:
    """Adam's step sizes at the first and the last step of a full-length run; exponential in between.

    A shorter run has fewer steps to go the same way: its rates are sqrt(FULL_STEPS / steps) times these.
    Positions are in local units (the frame's longest half-axis is 1), the rest are logits and field weights.
    """

    positions: tuple[float, float] = (2e-4, 2e-6)
    fields: tuple[float, float] = (3e-3, 3e-4)
    color_logits: tuple[float, float] = (6e-3, 6e-4)
    scale_logits: tuple[float, float] = (1.2e-2, 1.2e-3)
    opacity_logits: tuple[float, float] = (3e-2, 3e-3)

    def at(self, name: str, step: int, steps: int) -> float:
        """The rate of one group for `step` (from 0) of a run of `steps`."""
        first, last = getattr(self, name)
        pace = math.sqrt(FULL_STEPS / min(max(steps, SHORT_STEPS), FULL_STEPS))
        return pace * first * (last / first) ** (step / steps)


@dataclass(frozen=True)
class DensityConfig:
    """When and how Gaussians are cloned, split and pruned. Times are fractions of the run.

    Attributes:
        start, stop: density control acts in this part of the run.
        rounds: how many times it acts.
        gradient: least mean absolute gradient of a Gaussian's projected centre (NDC units) to clone or split it.
        split_scale: Gaussians larger than this (local units, divided by max(1, |u|)) are split, others cloned.
        prune_opacity: Gaussians fainter than this are removed.
        prune_scale: Gaussians larger than this (as split_scale) are removed, unless they are more than a tenth of all.
        resets: how many times opacities are capped at reset_opacity, evenly spread over the part that density
            control acts in, not counting its end.
        reset_opacity: the cap.
    """

    start: float = 0.02
    stop: float = 0.6
    rounds: int = 30
    gradient: float = 2e-4
    split_scale: float = 0.01
    prune_opacity: float = 0.005
    prune_scale: float = 0.5
    resets: int = 0
    reset_opacity: float = 0.01


@dataclass(frozen=True)
class TrainConfig:
    """Everything that decides the outcome of a run, besides the scene.

    Attributes:
        steps: optimiser steps, one view each; every schedule scales with it.
        seed: of view order, initialisation and density control.
        preset: the paper's regime, one of PRESETS; "auto" looks at the scene.
        max_gaussians: budget; None chooses from the pictures' pixels and the steps.
        log2_table_size: rows per level of the radiance grid as a power of two (the geometry grid has half);
            None follows the budget.
        background: whether a background sphere is trained; None lets the preset decide.
        background_color: what transparent pictures are laid over: "black", "white" or "random" (a new colour
            every step; the model then has black behind it).
        ssim_weight: w in (1 - w) L1 + w (1 - SSIM).
        checkpoint_every: steps between checkpoints; None for a twentieth of the run.
        precision: "mixed" or "float32", as `HybridModel.precision`: what GPU kernels multiply in.
        scale_rule, scale_grows, direction_encoding, position_gradients, antialiased: as in ModelConfig.
        learning_rates, density: see LearningRates and DensityConfig.
        grid_resolutions: vertices per axis of the coarsest and the finest level of both hash grids.
    """

    steps: int = 3000
    seed: int = 0
    preset: str = "auto"
    max_gaussians: int | None = None
    log2_table_size: int | None = None
    background: bool | None = None
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
        if self.steps < 1:
            raise ValueError(f"steps is {self.steps}; it must be at least 1")
        if self.preset not in PRESETS:
            raise ValueError(f"preset is '{self.preset}'; it must be one of {', '.join(PRESETS)}")
        if self.precision not in PRECISIONS:
            raise ValueError(f"precision is '{self.precision}'; it must be one of {', '.join(PRECISIONS)}")
        if self.background_color not in ("black", "white", "random"):
            raise ValueError(f"background_color is '{self.background_color}'; it must be black, white or random")
        for name in ("max_gaussians", "checkpoint_every"):
            if getattr(self, name) is not None and getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be at least 1")
        if self.seed < 0:
            raise ValueError(f"seed is {self.seed}; it must not be negative")
        if not 0 <= self.ssim_weight <= 1:
            raise ValueError(f"ssim_weight is {self.ssim_weight}; it must lie in [0, 1]")

    def to_dict(self) -> dict:
        """Plain numbers, strings, lists and dictionaries, ready for JSON."""
        return asdict(self)

"""How long each stage works: what the words for a quality mean, and what that takes, roughly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from hyrfpack.compress.sensitivity import MAX_SENSITIVITY_VIEWS, MIN_SENSITIVITY_VIEWS, TARGET_DRAWN_GAUSSIANS
from hyrfpack.scene import DEFAULT_MAX_SIZE, Scene
from hyrfpack.train.config import FULL_STEPS, TrainConfig
from hyrfpack.train.decisions import (
    MAX_BUDGET_PILOT_STEPS,
    MIN_BUDGET_STEPS,
    max_exposure_pilot_steps,
    max_pilot_steps,
)
from hyrfpack.train.setup import budget_for

# Seconds, of two CPU cores: for a megapixel that is trained on once, and that is drawn and followed back while packing.
# Only the first forecast needs them: what is measured on the way takes their place.
STEP, STEP_GPU, PASS = 0.7, 0.02, 0.6
BACKGROUND_PASSES = 8.0  # as long as so many such drawings takes the search for a background that nobody sees
PASSES_PER_SCORED_VIEW = 2.0  # as long as so many such drawings takes a held-out photo, its scores and picture
POSES = 3.0  # for a photo
UNKNOWN = 100  # photos, where that is not known yet


@dataclass(frozen=True)
class Quality:
    """What a word for a quality stands for.

    Attributes:
        steps: of training on a CPU.
        gpu_steps: of training on a GPU.
        max_size: pixels of the longer side that larger photos are shrunk to.
        finetune_steps: of fitting to the photos while packing.
        import_steps: of learning from splats of other programs.
    """

    steps: int
    gpu_steps: int
    max_size: int
    finetune_steps: int
    import_steps: int


QUALITIES = {
    "draft": Quality(steps=600, gpu_steps=1_000, max_size=640, finetune_steps=0, import_steps=150),
    "normal": Quality(
        steps=TrainConfig.steps,
        gpu_steps=TrainConfig.steps,
        max_size=DEFAULT_MAX_SIZE,
        finetune_steps=0,
        import_steps=500,
    ),
    "best": Quality(
        steps=10_000, gpu_steps=FULL_STEPS, max_size=DEFAULT_MAX_SIZE, finetune_steps=500, import_steps=1_500
    ),
}


@dataclass(frozen=True)
class Plan:
    """What was decided for a scene.

    Attributes:
        steps: of training.
        max_size: of photos, as in `load_scene`.
        finetune_steps: of packing.
        target_bytes: what the packed model may have; None for no limit.
        max_gaussians, preset, budget_factor, exposure: as in `TrainConfig`.
    """

    steps: int
    max_size: int
    finetune_steps: int = 0
    target_bytes: int | None = None
    max_gaussians: int | None = None
    preset: str = "auto"
    budget_factor: float | None = None
    exposure: bool | None = None

    def config(self, seed: int) -> TrainConfig:
        """Settings of its training."""
        return TrainConfig(
            steps=self.steps,
            seed=seed,
            preset=self.preset,
            target_bytes=self.target_bytes,
            max_gaussians=self.max_gaussians,
            budget_factor=self.budget_factor,
            exposure=self.exposure,
        )

    def packed_into(self, target_bytes: int | None) -> Plan:
        """The same plan for another target size, which takes the place of a measured budget."""
        return replace(self, target_bytes=target_bytes, budget_factor=None if target_bytes else self.budget_factor)


def passes(gaussians: int) -> int:
    """How many views packing draws and follows back."""
    return int(np.clip(TARGET_DRAWN_GAUSSIANS // max(gaussians, 1), MIN_SENSITIVITY_VIEWS, MAX_SENSITIVITY_VIEWS))


def megapixels(scene: Scene) -> float:
    """Of a photo, the mean."""
    return float(np.mean([view.camera.width * view.camera.height for view in scene.views])) / 1e6


def forecast(
    pixels: float, plan: Plan, gaussians: int, held_out: int, pilot_steps: int, device: torch.device
) -> dict[str, float]:
    """Seconds that what follows the poses takes, roughly, by part (`hyrfpack.make.progress.STAGE_PARTS`) or stage.

    Args:
        pixels: megapixels of a photo.
        gaussians: that the model will have.
        held_out: photos that are scored.
        pilot_steps: of the pilot runs.
    """
    step, scored = pixels * (STEP if device.type == "cpu" else STEP_GPU), PASSES_PER_SCORED_VIEW * held_out
    return {
        "pilots": pilot_steps * step,
        "training": 2 + plan.steps * step,
        "results": 2 + (BACKGROUND_PASSES + scored) * pixels * PASS,
        "compression": 3 + (passes(gaussians) + 3 * plan.finetune_steps) * pixels * PASS,
        "scoring": 0.5 + scored * pixels * PASS,
        "export": 2.0,
    }


def forecast_scene(scene: Scene, plan: Plan, device: torch.device) -> dict[str, float]:
    """`forecast` for photos that are known."""
    config = plan.config(seed=0)
    gaussians, _ = budget_for(scene, config)
    return forecast(megapixels(scene), plan, gaussians, len(scene.test), max_pilot_steps(scene, config), device)


def forecast_photos(sizes: Sequence[tuple[int, int]], plan: Plan, device: torch.device) -> dict[str, float]:
    """`forecast` for photos of these (width, height) and for their poses, or where there are none, of a video."""
    width, height = sizes[0] if sizes else (1920, 1080)
    shrunk = min(1.0, plan.max_size / max(width, height)) if plan.max_size else 1.0
    pixels, count = width * height * shrunk**2 / 1e6, len(sizes) or UNKNOWN
    pilot_steps = MAX_BUDGET_PILOT_STEPS + max_exposure_pilot_steps(count - count // 8)
    pilot_steps *= plan.steps >= MIN_BUDGET_STEPS
    return {"poses": POSES * count, **forecast(pixels, plan, 20_000, count // 8, pilot_steps, device)}

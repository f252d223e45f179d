"""Plans of a pipeline: the qualities that can be requested, and rough estimates of the time that stages take."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from hyrfpack.compress.sensitivity import MAX_SENSITIVITY_VIEWS, TARGET_DRAWN_GAUSSIANS
from hyrfpack.config.imports import DEFAULT_IMPORT_PSNR_DB
from hyrfpack.config.make import MakeConfig
from hyrfpack.config.train import FULL_STEPS, DensityConfig, TrainConfig
from hyrfpack.data.pictures import fit_size
from hyrfpack.scene import DEFAULT_MAX_SIZE, Scene
from hyrfpack.train.decisions import (
    MAX_BUDGET_PILOT_STEPS,
    MIN_BUDGET_STEPS,
    MIN_EXPOSURE_STEPS,
    max_exposure_pilot_steps,
    max_pilot_steps,
)
from hyrfpack.train.length_pilots import max_length_pilot_steps
from hyrfpack.train.pilots import BUDGET_REFERENCE_STEPS
from hyrfpack.train.resolution import PhotoSize
from hyrfpack.train.setup import LARGE_PHOTO_STEPS, budget_for, usual_budget, usual_steps
from hyrfpack.train.surface_depths import MAX_PHOTOS
from hyrfpack.train.teachers import TEACHER_STEPS, count_teachers

# Measured on two CPU cores, for the first estimate only; during the work, measured times replace it.
CPU_STEP_SECONDS = 0.03  # time of a training step that does not depend on the photo's size
CPU_STEP_SECONDS_PER_MEGAPIXEL = 0.2
GPU_STEP_SECONDS_PER_MEGAPIXEL = 0.02
CPU_PASS_SECONDS_PER_MEGAPIXEL = 0.6  # a pass renders a view and back-propagates through it
BACKGROUND_SEARCH_PASSES = 8.0  # time of the search for a background in unseen directions
PASSES_PER_SCORED_VIEW = 2.0  # time of scoring a held-out photo and writing its picture
POSE_SECONDS_PER_PHOTO = 3.0
DEPTH_MAP_SECONDS_PER_PHOTO = 0.1  # depth maps are as small for large photos as for small ones
# Before a video is decoded, number and size of its photos are unknown.
ASSUMED_VIDEO_PHOTOS = 100
ASSUMED_VIDEO_SIZE = (1920, 1080)


@dataclass(frozen=True)
class Quality:
    """Settings of one of the qualities that can be requested.

    Attributes:
        steps, large_photo_steps: training steps on a CPU, on small and on large photos (`usual_steps`).
        gpu_steps: training steps on a GPU.
        max_size: longer side in pixels to which larger photos are shrunk.
        finetune_steps: fine-tuning steps during packing.
        import_psnr: PSNR in dB that imported splats of other programs reach.
    """

    steps: int
    large_photo_steps: int
    gpu_steps: int
    max_size: int
    finetune_steps: int
    import_psnr: float

    def training_steps(self, pixels: float, device: torch.device) -> int:
        """Return the training steps on photos of `pixels` pixels."""
        return usual_steps(pixels, self.steps, self.large_photo_steps) if device.type == "cpu" else self.gpu_steps


QUALITIES = {
    "draft": Quality(
        steps=600, large_photo_steps=600, gpu_steps=1_000, max_size=640, finetune_steps=0, import_psnr=34.0
    ),
    "normal": Quality(
        steps=TrainConfig.steps,
        large_photo_steps=LARGE_PHOTO_STEPS,
        gpu_steps=TrainConfig.steps,
        max_size=DEFAULT_MAX_SIZE,
        finetune_steps=0,
        import_psnr=DEFAULT_IMPORT_PSNR_DB,
    ),
    "best": Quality(
        steps=10_000,
        large_photo_steps=10_000,
        gpu_steps=FULL_STEPS,
        max_size=DEFAULT_MAX_SIZE,
        finetune_steps=500,
        import_psnr=42.0,
    ),
}


def requested_quality(config: MakeConfig) -> Quality:
    """Return the settings of the requested quality, by default those of "normal"."""
    return QUALITIES[config.quality or "normal"]


@dataclass(frozen=True)
class Plan:
    """The settings that were decided for a scene.

    Attributes:
        steps: training steps.
        max_size: maximum size of the photos, see `load_scene`.
        finetune_steps: fine-tuning steps during packing.
        target_bytes: maximum size of the packed model in bytes; None for no limit.
        max_gaussians, preset, budget_factor, exposure, early_stop, virtual_views: see `TrainConfig`.
    """

    steps: int
    max_size: int
    finetune_steps: int = 0
    target_bytes: int | None = None
    max_gaussians: int | None = None
    preset: str = "auto"
    budget_factor: float | None = None
    exposure: bool | None = None
    early_stop: bool = True
    virtual_views: bool = True

    def train_config(self, seed: int) -> TrainConfig:
        """Return the training settings of the plan."""
        return TrainConfig(
            steps=self.steps,
            seed=seed,
            preset=self.preset,
            target_bytes=self.target_bytes,
            max_gaussians=self.max_gaussians,
            budget_factor=self.budget_factor,
            exposure=self.exposure,
            early_stop=self.early_stop,
            virtual_views=self.virtual_views,
        )

    def with_target_bytes(self, target_bytes: int | None) -> Plan:
        """Return a copy with another target size; a target size replaces the measured budget factor."""
        return replace(self, target_bytes=target_bytes, budget_factor=None if target_bytes else self.budget_factor)


def count_packing_passes(gaussians: int) -> int:
    """Return the number of whole views that packing renders and back-propagates through."""
    return int(np.clip(TARGET_DRAWN_GAUSSIANS // max(gaussians, 1), 1, MAX_SENSITIVITY_VIEWS))


def mean_megapixels(scene: Scene) -> float:
    """Return the mean number of megapixels of a photo."""
    return float(np.mean([view.camera.width * view.camera.height for view in scene.views])) / 1e6


def estimate_depth_map_seconds(trained: int) -> float:
    """Return the seconds in which a training run on `trained` photos estimates depth maps for its initial points."""
    return DEPTH_MAP_SECONDS_PER_PHOTO * min(trained, MAX_PHOTOS)


def estimate_seconds(
    size: PhotoSize,
    plan: Plan,
    gaussians: int,
    trained: int,
    held_out: int,
    pilot_steps: float,
    device: torch.device,
    teacher_gaussians: int,
) -> dict[str, float]:
    """Estimate roughly how many seconds the stages after the poses take.

    Args:
        size: size of the photos.
        plan: the plan.
        gaussians: expected number of Gaussians; training starts with at most as many.
        trained: number of photos that are trained on.
        held_out: number of photos that are scored.
        pilot_steps: number of steps of all pilot runs, see `max_pilot_steps`.
        device: device of the training.
        teacher_gaussians: expected number of Gaussians of teacher runs, which only a run on few photos has.

    Returns:
        Seconds by part of a stage (`hyrfpack.make.progress.STAGE_PARTS`) or by stage.
    """
    megapixels, scoring_passes = size.pixels / 1e6, PASSES_PER_SCORED_VIEW * held_out
    seconds_per_step, seconds_per_megapixel = (
        (CPU_STEP_SECONDS, CPU_STEP_SECONDS_PER_MEGAPIXEL)
        if device.type == "cpu"
        else (0.0, GPU_STEP_SECONDS_PER_MEGAPIXEL)
    )
    pilot_gaussians = usual_budget(size.pixels, size.pixels, BUDGET_REFERENCE_STEPS)
    step_seconds, pilot_step_seconds, teacher_step_seconds = (
        seconds_per_step + megapixels * seconds_per_megapixel * size.mean_step_cost(DensityConfig(), count, count)
        for count in (gaussians, pilot_gaussians, teacher_gaussians)
    )
    set_up_seconds = 2 + estimate_depth_map_seconds(trained)
    teachers = count_teachers(trained, size, plan.train_config(seed=0))
    teacher_seconds = set_up_seconds + TEACHER_STEPS * teacher_step_seconds
    return {
        "pilots": pilot_steps * pilot_step_seconds,
        "teachers": teachers * (teacher_seconds + trained * megapixels * CPU_PASS_SECONDS_PER_MEGAPIXEL / 2),
        "training": set_up_seconds + plan.steps * step_seconds,
        "results": 2 + (BACKGROUND_SEARCH_PASSES + scoring_passes) * megapixels * CPU_PASS_SECONDS_PER_MEGAPIXEL,
        "compression": 3
        + (count_packing_passes(gaussians) + 3 * plan.finetune_steps) * megapixels * CPU_PASS_SECONDS_PER_MEGAPIXEL,
        "scoring": 0.5 + scoring_passes * megapixels * CPU_PASS_SECONDS_PER_MEGAPIXEL,
        "export": 2.0,
    }


def estimate_scene_seconds(scene: Scene, plan: Plan, device: torch.device) -> dict[str, float]:
    """Return `estimate_seconds` for a loaded scene."""
    config = plan.train_config(seed=0)
    gaussians, _ = budget_for(scene, config)
    size = PhotoSize.of_views(scene.train)
    pilot_steps = max_pilot_steps(scene, config)
    teacher_gaussians, _ = budget_for(scene, replace(config, steps=TEACHER_STEPS))
    counts = len(scene.train), len(scene.test)
    return estimate_seconds(size, plan, gaussians, *counts, pilot_steps, device, teacher_gaussians)


def expected_photo_size(size: tuple[int, int] | None, max_size: int) -> PhotoSize:
    """Return the size of photos of this (width, height) after they are shrunk; None means frames of a video."""
    width, height = size or ASSUMED_VIDEO_SIZE
    return PhotoSize.of([fit_size(width, height, max_size)])


def estimate_photos_seconds(count: int, size: PhotoSize, plan: Plan, device: torch.device) -> dict[str, float]:
    """Return `estimate_seconds` and the seconds of the pose estimation, for `count` photos of this size."""
    trained = count - count // 8
    gaussians = usual_budget(size.pixels, trained * size.pixels, plan.steps)
    pilot_steps = max_exposure_pilot_steps(trained, plan.steps) * (plan.steps >= MIN_EXPOSURE_STEPS)
    pilot_steps += MAX_BUDGET_PILOT_STEPS * (plan.steps >= MIN_BUDGET_STEPS)
    pilot_steps += max_length_pilot_steps(trained, plan.steps) * plan.early_stop
    teacher_gaussians = usual_budget(size.pixels, trained * size.pixels, TEACHER_STEPS)
    return {
        "poses": POSE_SECONDS_PER_PHOTO * count,
        **estimate_seconds(size, plan, gaussians, trained, count // 8, pilot_steps, device, teacher_gaussians),
    }

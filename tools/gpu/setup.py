"""What a check runs on and how much of everything: the sizes of all parts, in one place."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import torch

GOAL_ROOM = "1,000,000"  # what the goals are about


@dataclass(frozen=True)
class Setup:
    """Sizes and devices.

    Attributes:
        device: of the kernels, as torch names it.
        implementation: of the operations, as they name it.
        width, height: of pictures.
        kernel_gaussians: how many the single kernels are timed with.
        frame_gaussians: how many whole frames and training steps are timed with, one after the other.
        trained_gaussians: the same for rooms whose Gaussians are as training on photos leaves them.
        error_rows: most points and rows of a subsample whose error is measured.
        crop: side in pixels of the part of the picture whose error is measured.
        repeats: turns of each measurement.
        views: cameras in the room.
        warm_steps: training steps before those that are timed, in a third of their time at most.
        steps, step_seconds: most steps that are timed, and for how long at most.
        demo_views, demo_size: photos of the built-in scene and their side in pixels.
        quality_steps: most steps of each training that is compared.
        quality_seconds: how long the comparison on the CPU may take; fewer steps are made if it would take longer.
        data: folder of a real set, if there is one.
    """

    device: str = "cuda"
    implementation: str = "gpu"
    width: int = 1920
    height: int = 1080
    kernel_gaussians: int = 1_000_000
    frame_gaussians: tuple[int, ...] = (100_000, 1_000_000, 3_000_000)
    trained_gaussians: tuple[int, ...] = (1_000_000,)
    error_rows: int = 65_536
    crop: int = 96
    repeats: int = 15
    views: int = 12
    warm_steps: int = 60
    steps: int = 1000
    step_seconds: float = 18.0
    demo_views: int = 48
    demo_size: int = 200
    quality_steps: int = 1000
    quality_seconds: float = 40.0
    data: str | None = None

    @property
    def torch_device(self) -> torch.device:
        return torch.device(self.device)

    def to_json(self) -> str:
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Setup:
        values = json.loads(text)
        return cls(**{name: tuple(value) if isinstance(value, list) else value for name, value in values.items()})


def find_set(folder: Path | None, environment: str | None, beside: Path) -> Path | None:
    """The real set to train on: the folder asked for, or the smallest set of the first data folder that is there.

    Args:
        folder: a set, or a folder of sets; asked for by name.
        environment: HYRFPACK_DATA.
        beside: where sets lie beside the repository.
    """
    for place in (folder, Path(environment) if environment else None, beside):
        if place is None or not place.is_dir():
            continue
        if _is_set(place):
            return place
        sets = sorted(part for part in place.iterdir() if part.is_dir() and _is_set(part))
        if sets:
            return next((part for part in sets if part.name == "mipnerf360_bonsai"), sets[0])
    return None


def _is_set(folder: Path) -> bool:
    return any((folder / name).exists() for name in ("sparse", "colmap", "transforms.json", "transforms_train.json"))

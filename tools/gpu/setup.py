"""Settings of a GPU check: the device, and the sizes and repeats of all its parts."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import torch

from hyrfpack.config.train import FULL_STEPS

GOAL_ROOM_NAME = "1,000,000"  # the goals hold for the room with this many Gaussians

FULL_RUN_SECONDS = 240.0


@dataclass(frozen=True)
class Setup:
    """Device, sizes and time limits of a check.

    Attributes:
        device: the device of the kernels, as torch names it.
        implementation: the implementation of the operations, such as "gpu".
        doctor_seconds: time limit in seconds for `hyrfpack doctor`, once its kernels are compiled.
        width, height: size of the pictures in pixels.
        kernel_gaussians: number of Gaussians with which single kernels are timed.
        frame_gaussians: numbers of Gaussians with which whole frames and training steps are timed.
        trained_gaussians: the same for rooms whose Gaussians look as if trained on photos.
        error_rows: the error is measured on a sample of at most about this many points or rows.
        crop: side in pixels of the crop of the picture whose error is measured.
        repeats: number of repeats of each measurement.
        views: number of cameras in the room.
        warm_steps: training steps before the timed ones; they take at most a third of `step_seconds`.
        steps: largest number of training steps that are timed.
        step_seconds: time limit in seconds for the timed training steps.
        demo_views, demo_size: number of photos of the built-in scene, and their side in pixels.
        quality_steps: largest number of steps of each training run of the quality comparison.
        quality_seconds: time limit in seconds for the CPU's training run; the number of steps is reduced to keep it.
        ranks_steps: number of photos that one process and two train on.
        ranks_seconds: time limit in seconds for each of these two runs.
        full_run_steps: number of steps of the full run.
        full_run_seconds: time limit in seconds for the full run; it then ends before its last step.
        full_run_interval: seconds of the full run between two rows of the report.
        test_paths: files and folders of the tests that pytest runs, relative to the repository's root.
        data: folder of a real data set, or None.
        logs: folder for what other programs print, or None.
        commit: the commit that is checked.
    """

    device: str = "cuda"
    implementation: str = "gpu"
    doctor_seconds: float = 60.0
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
    ranks_steps: int = 400
    ranks_seconds: float = 70.0
    full_run_steps: int = FULL_STEPS
    full_run_seconds: float = FULL_RUN_SECONDS
    full_run_interval: float = 20.0
    test_paths: tuple[str, ...] = ("tests/ops", "tests/test_gpu_path.py")
    data: str | None = None
    logs: str | None = None
    commit: str = ""

    @property
    def torch_device(self) -> torch.device:
        return torch.device(self.device)

    def log_path(self, name: str) -> Path | None:
        """Return the file for what a program of this name prints; None if there is no folder for it."""
        return Path(self.logs, f"{name}.txt") if self.logs else None

    def to_json(self) -> str:
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Setup:
        values = json.loads(text)
        return cls(**{name: tuple(value) if isinstance(value, list) else value for name, value in values.items()})


def find_dataset(folder: Path | None, environment: str | None, default: Path) -> Path | None:
    """Return the real data set to train on, from the first of three folders that has one; None if no folder has one.

    From a folder with several data sets it returns mipnerf360_bonsai, or else the first by name.

    Args:
        folder: a data set or a folder of data sets, from the command line.
        environment: the value of HYRFPACK_DATA.
        default: the folder of data sets beside the repository.
    """
    for candidate in (folder, Path(environment) if environment else None, default):
        if candidate is None or not candidate.is_dir():
            continue
        if _is_dataset(candidate):
            return candidate
        sets = sorted(part for part in candidate.iterdir() if part.is_dir() and _is_dataset(part))
        if sets:
            return next((part for part in sets if part.name == "mipnerf360_bonsai"), sets[0])
    return None


def _is_dataset(folder: Path) -> bool:
    return any((folder / name).exists() for name in ("sparse", "colmap", "transforms.json", "transforms_train.json"))

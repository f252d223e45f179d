"""The folder of a training run: the files in it, how far the run is, and which model a path names."""

from __future__ import annotations

import json
import math
import os
from dataclasses import dataclass
from pathlib import Path

from hyrfpack.errors import HyrfFormatError

MODEL, CHECKPOINT, METRICS = "model.hyrf", "checkpoint.pt", "metrics.json"


@dataclass(frozen=True)
class RunStatus:
    """How far a training run is and what it reached. A field is None where the folder does not tell it.

    Attributes:
        folder: of the run.
        finished: whether the model is there and no checkpoint is left.
        has_checkpoint: whether `hyrfpack train --resume` can continue it.
        step: optimiser steps taken, by the checkpoint or, of a finished run, by its settings.
        steps: optimiser steps that the run was asked for.
        photos: folder of the photos that it trains on.
        train, test: how many photos it trains on, and how many are held out.
        seconds: spent on training.
        psnr, psnr_consistent, ssim: means over the held-out photos, as in `hyrfpack.Evaluation`; PSNR in dB.
    """

    folder: str
    finished: bool
    has_checkpoint: bool
    step: int | None = None
    steps: int | None = None
    photos: str | None = None
    train: int | None = None
    test: int | None = None
    seconds: float | None = None
    psnr: float | None = None
    psnr_consistent: float | None = None
    ssim: float | None = None


def is_run_folder(path: str | os.PathLike[str]) -> bool:
    """Return whether a path is the folder of a training run, finished or not."""
    return any(Path(path, name).is_file() for name in (MODEL, CHECKPOINT))


def find_model(path: str | os.PathLike[str]) -> Path:
    """Return the `.hyrf` file that a path names: the file itself, or the model in the folder of a training run.

    Raises:
        HyrfFormatError: it is a folder without a model, or that of a run which has not finished.

    Example:
        >>> from hyrfpack.format import find_model
        >>> find_model("runs/bonsai").as_posix()
        'runs/bonsai/model.hyrf'
    """
    path = Path(path)
    if not os.path.isdir(path):
        return path
    if (path / MODEL).is_file():
        return path / MODEL
    if (path / CHECKPOINT).is_file():
        raise HyrfFormatError(f"{path}: {describe_unfinished(read_run_status(path))}")
    raise HyrfFormatError(
        f"{path}: this folder holds no {MODEL}; name a .hyrf file, or a folder that 'hyrfpack train' wrote"
    )


def describe_unfinished(run: RunStatus) -> str:
    """Return the clause that tells of an unfinished run, and how to finish it."""
    done = "" if run.step is None or run.steps is None else f" (step {run.step:,} of {run.steps:,})"
    return f"the run has not finished{done}; finish it by running its 'hyrfpack train' command again with `resume=True`"


def read_run_status(folder: str | os.PathLike[str]) -> RunStatus:
    """Read how far the run in a folder is; what is missing or damaged stays None."""
    folder = Path(folder)
    has_checkpoint = (folder / CHECKPOINT).is_file()
    finished = (folder / MODEL).is_file() and not has_checkpoint
    if has_checkpoint:
        step, steps = _checkpoint_steps(folder / CHECKPOINT)
        return RunStatus(str(folder), finished, has_checkpoint, step, steps)
    metrics = _object(folder / METRICS)
    settings, scene, scores = (_part(metrics, name) for name in ("settings", "scene", "evaluation"))
    steps = _count(settings, "steps")
    photos = scene.get("path")
    return RunStatus(
        folder=str(folder),
        finished=finished,
        has_checkpoint=has_checkpoint,
        step=steps,
        steps=steps,
        photos=photos if isinstance(photos, str) else None,
        train=_count(scene, "train"),
        test=_count(scene, "test"),
        seconds=_number(metrics, "seconds"),
        psnr=_number(scores, "psnr"),
        psnr_consistent=_number(scores, "psnr_consistent"),
        ssim=_number(scores, "ssim"),
    )


def _checkpoint_steps(path: Path) -> tuple[int | None, int | None]:
    """The step that a checkpoint was written at and the last one of its run, as `hyrfpack.train.checkpoint` saves them.

    None where the file cannot be read: nothing but a message depends on it. The tensors are not read.
    """
    import torch

    try:
        content = torch.load(path, weights_only=True, map_location="meta", mmap=True)
        settings, progress = json.loads(content["settings"]), json.loads(content["progress"])
        processes = settings.get("processes", 1)
        return int(progress["step"]), -(-int(settings["steps"]) // int(processes))
    except Exception:  # torch's unpickler raises whatever it meets
        return None, None


def _object(path: Path) -> dict:
    """The JSON object in a file; an empty one where there is none."""
    try:
        content = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def _part(values: dict, name: str) -> dict:
    part = values.get(name)
    return part if isinstance(part, dict) else {}


def _count(values: dict, name: str) -> int | None:
    value = values.get(name)
    return value if isinstance(value, int) and not isinstance(value, bool) else None


def _number(values: dict, name: str) -> float | None:
    value = values.get(name)
    usable = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    return value if usable else None

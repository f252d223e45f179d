"""Checkpoints hold the complete state of a run, from which it resumes as if it had never stopped.

Random numbers come from generators seeded by (seed, step), so that no generator state is stored.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from hyrfpack.atomic import write_atomic
from hyrfpack.config.settings import list_settings
from hyrfpack.config.train import TrainConfig
from hyrfpack.errors import HyrfTrainingError
from hyrfpack.scene import View

CHECKPOINT_VERSION = 2
DIGEST_BYTES = 32  # The file ends with the SHA-256 digest of everything before it.


def names_and_sizes(views: Sequence[View]) -> list[list]:
    """Return [name, width, height] of each photo, in pixels, to recognise the photos of a run."""
    return [[view.name, view.camera.width, view.camera.height] for view in views]


def save_checkpoint(
    path: Path, *, settings: dict, tensors: dict[str, torch.Tensor], progress: dict, overwrite: bool = True
) -> None:
    """Write a checkpoint atomically.

    Args:
        settings: plain values that must be the same in a resumed run.
        tensors: the tensors of the run's state by name.
        progress: plain values of the run's state (step, records).
        overwrite: replace a file at `path`.

    Raises:
        HyrfError: the file cannot be written; an earlier file stays.
    """
    buffer = io.BytesIO()
    texts = {
        "version": CHECKPOINT_VERSION,
        "settings": json.dumps(settings, sort_keys=True),
        "progress": json.dumps(progress),
    }
    torch.save({**texts, "tensors": tensors}, buffer)
    buffer.write(hashlib.sha256(buffer.getbuffer()).digest())
    write_atomic(path, buffer.getbuffer(), overwrite=overwrite, rename=False)


@dataclass(frozen=True)
class SavedDecisions:
    """What pilot runs may have decided for the run of a checkpoint.

    Attributes:
        budget_factor, exposure, steps: settings of `TrainConfig`.
        asked_steps: see `read_asked_steps`.
    """

    budget_factor: float | None
    exposure: bool
    steps: int
    asked_steps: int | None = None


def saved_decisions(path: Path) -> SavedDecisions:
    """Read from a checkpoint what pilot runs may have decided.

    Raises:
        HyrfTrainingError: the checkpoint is missing, damaged or of another version.
    """
    saved, _, progress = _read(path)
    steps = saved.get("steps", 0)
    asked_steps = read_asked_steps(progress, steps)
    decisions = SavedDecisions(saved.get("budget_factor"), saved.get("exposure", False), steps, asked_steps)
    settings = list_settings(TrainConfig)
    try:
        settings["budget_factor"].check(decisions.budget_factor)
        settings["steps"].check(decisions.steps)
    except ValueError as error:
        raise damaged_checkpoint(path) from error
    if not isinstance(decisions.exposure, bool):
        raise damaged_checkpoint(path)
    return decisions


def read_asked_steps(run: dict, steps: object) -> int | None:
    """Return the number of steps that the user asked for when a run was started.

    Args:
        run: `choices` and `pilots` of the run, as a checkpoint or a training record stores them.
        steps: number of steps of the run, which pilot runs may have chosen.

    Returns:
        The number; None if the run does not state it, as those of earlier versions.
    """
    choices, pilots = run.get("choices"), run.get("pilots")
    asked: object = None
    if isinstance(choices, dict) and "steps" not in choices:
        asked = steps  # No pilot run chose it.
    elif isinstance(pilots, list) and pilots and isinstance(pilots[-1], dict):
        asked = pilots[-1].get("run_steps")
    return asked if isinstance(asked, int) else None


def load_checkpoint(path: Path, settings: dict) -> tuple[dict[str, torch.Tensor], dict]:
    """Read a checkpoint without executing anything in it.

    Returns:
        Tensors by name, and progress.

    Raises:
        HyrfTrainingError: the checkpoint is missing or damaged, or its run had other settings, which the message names.
    """
    saved, tensors, progress = _read(path)
    if different := sorted(
        key for key in saved.keys() | settings.keys() if saved.get(key) != _plain(settings.get(key))
    ):
        raise HyrfTrainingError(
            f"{path}: the run was started with other settings ({', '.join(different)})",
            fix="resume with the same ones or train anew with `overwrite=True`",
        )
    return tensors, progress


def _read(path: Path) -> tuple[dict, dict[str, torch.Tensor], dict]:
    """Read a checkpoint and return its settings, tensors and progress."""
    if not path.is_file():
        raise HyrfTrainingError(f"{path}: there is no checkpoint to resume from", fix="train without `resume=True`")
    try:
        data = path.read_bytes()
        if hashlib.sha256(data[:-DIGEST_BYTES]).digest() != data[-DIGEST_BYTES:]:
            raise ValueError("the digest does not match")
        content = torch.load(io.BytesIO(data[:-DIGEST_BYTES]), weights_only=True, map_location="cpu")
        saved, progress = json.loads(content["settings"]), json.loads(content["progress"])
        tensors, version = content["tensors"], content["version"]
        if not all(isinstance(part, dict) for part in (saved, progress, tensors)):
            raise ValueError("a part is no object")
    except Exception as error:  # torch's unpickler raises errors of any type
        raise damaged_checkpoint(path) from error
    if version != CHECKPOINT_VERSION:
        raise HyrfTrainingError(
            f"{path}: the checkpoint is of another version of hyrfpack",
            fix="train anew with `overwrite=True`",
        )
    return saved, tensors, progress


def damaged_checkpoint(path: Path) -> HyrfTrainingError:
    """Return the error for a checkpoint that cannot be used."""
    return HyrfTrainingError(f"{path}: the checkpoint is damaged", fix="delete it and train anew")


def _plain(value: object) -> object:
    return json.loads(json.dumps(value))

"""The folder of a training run: names of its files, status of the run, and the model that a path names."""

from __future__ import annotations

import json
import os
import sys
from dataclasses import dataclass
from pathlib import Path

from hyrfpack.errors import HyrfFormatError

MODEL_FILE = "model.hyrf"
CHECKPOINT_FILE = "checkpoint.pt"
# What runs before the training itself leave for a resumed run: finished pilots, the checkpoint of the one in progress
# (`hyrfpack.train.pilot_journal`), and teachers (`hyrfpack.train.teachers`).
PILOTS_FILE, PILOT_CHECKPOINT_FILE = "pilots.json", "pilot.pt"
TEACHER_FILES = ("teacher-1.hyrf", "teacher-2.hyrf", "teacher-3.hyrf")
PREPARED_FILES = (PILOTS_FILE, PILOT_CHECKPOINT_FILE, *TEACHER_FILES)
METRICS_FILE = "metrics.json"
BLOCKS_FOLDER = "blocks"  # of a run in blocks, a folder for each block
BLOCKS_JOURNAL_FILE = f"{BLOCKS_FOLDER}/blocks.json"  # see `hyrfpack.blocks.journal`
# The manifest of a scene folder, and the name of its format, see `hyrfpack.format.scene_manifest`.
SCENE_MANIFEST_FILE, SCENE_FORMAT_NAME = "scene.json", "hyrf-scene"
MAX_MANIFEST_BYTES = 1 << 24
# The work folder of `hyrfpack make`: the record of its stages, and a model to look at if training was interrupted.
WORK_RECORD_FILE, PREVIEW_FILE = "make.json", "preview.hyrf"


@dataclass(frozen=True)
class RunStatus:
    """Progress and scores of a training run. A field is None where the folder does not hold its value.

    Attributes:
        folder: folder of the run.
        finished: whether the model exists and no checkpoint is left.
        has_checkpoint: whether there is a checkpoint, with which `hyrfpack train --resume` continues the training.
        step: optimiser steps taken, from the checkpoint or, if the run has finished, from its settings.
        steps: optimiser steps of the whole run.
        photos: folder of the training photos.
        train, test: number of training photos and of held-out photos.
        seconds: training time in seconds.
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
    return _has_file(path, MODEL_FILE) or _is_unfinished_run(path)


def is_prepared(folder: str | os.PathLike[str]) -> bool:
    """Return whether a folder holds what runs before the training itself have left, so that the run can be resumed."""
    return any(_has_file(folder, name) for name in PREPARED_FILES)


def _is_unfinished_run(folder: str | os.PathLike[str]) -> bool:
    """Return whether a folder holds what an interrupted run leaves, so that the run can be resumed."""
    return is_prepared(folder) or any(_has_file(folder, name) for name in (CHECKPOINT_FILE, BLOCKS_JOURNAL_FILE))


def is_scene_manifest(path: str | os.PathLike[str]) -> bool:
    """Return whether a file is called `scene.json` and names the format; other programs write files of this name."""
    if os.path.basename(path) != SCENE_MANIFEST_FILE or not os.path.isfile(path):
        return False
    try:
        with open(path, "rb") as file:
            return SCENE_FORMAT_NAME.encode() in file.read(MAX_MANIFEST_BYTES + 1)
    except OSError:
        return False


def find_model(path: str | os.PathLike[str]) -> Path:
    """Return the path of a `.hyrf` file: `path` itself, or the model if `path` is the folder of a training run.

    Of a scene folder, it is the path of the manifest. If the folder is also that of a run, the run counts.

    Raises:
        HyrfFormatError: `path` is a folder without a model, one that may not be read, or that of a run that has not
            finished.

    Example:
        >>> from hyrfpack.format import find_model
        >>> find_model("runs/bonsai").as_posix()
        'runs/bonsai/model.hyrf'
    """
    path = Path(path)
    if not os.path.isdir(path):
        return path
    if _has_file(path, MODEL_FILE):
        return path / MODEL_FILE
    if _is_unfinished_run(path):
        raise HyrfFormatError(
            f"{path}: {describe_unfinished_run(read_run_status(path))}", fix=advise_on_unfinished_run(path)
        )
    manifest = path / SCENE_MANIFEST_FILE
    if is_scene_manifest(manifest):
        return manifest
    if not os.access(path, os.X_OK):
        raise HyrfFormatError(f"{path}: permission to read the folder is denied", fix="check its permissions")
    if _has_file(path, SCENE_MANIFEST_FILE):
        if not os.access(manifest, os.R_OK):
            raise HyrfFormatError(f"{manifest}: permission to read the file is denied", fix="check its permissions")
        raise HyrfFormatError(
            f"{manifest}: this is not the manifest of a scene folder, and there is no {MODEL_FILE}",
            fix="name a .hyrf file, or copy the whole folder of the scene again",
        )
    if _has_file(path, WORK_RECORD_FILE):
        preview = f", or name {path / PREVIEW_FILE}" if _has_file(path, PREVIEW_FILE) else ""
        raise HyrfFormatError(
            f"{path}: this is the work folder of 'hyrfpack make', which writes the model elsewhere",
            fix=f"name that model; if the command was interrupted, repeat it, which resumes{preview}",
        )
    raise HyrfFormatError(
        f"{path}: this folder holds no {MODEL_FILE}",
        fix="name a .hyrf file, or a folder that 'hyrfpack train' wrote",
    )


def name_model(path: str | os.PathLike[str]) -> str:
    """Return the name of a model: that of its file without the ending, or that of the folder of its run or scene.

    Example:
        >>> from hyrfpack.format.run_folder import name_model
        >>> name_model("models/bonsai.hyrf")
        'bonsai'
    """
    return Path(os.path.abspath(path)).name if os.path.isdir(path) else Path(path).stem


def advise_on_unfinished_run(folder: str | os.PathLike[str]) -> str:
    """Return a message clause that says how to finish an unfinished run."""
    if _has_file(os.path.dirname(os.path.abspath(folder)), WORK_RECORD_FILE):
        return "finish it by repeating its 'hyrfpack make' command, which resumes"
    return "finish it by running its 'hyrfpack train' command again with `resume=True`"


def describe_unfinished_run(run: RunStatus) -> str:
    """Return a message clause on the progress of an unfinished run; `advise_on_unfinished_run` says what to do."""
    progress = "" if run.step is None or run.steps is None else f" (step {run.step:,} of {run.steps:,})"
    return f"the run has not finished{progress}"


def read_run_status(folder: str | os.PathLike[str]) -> RunStatus:
    """Read the status of the run in a folder; fields whose file is missing or damaged are None."""
    folder = Path(folder)
    has_checkpoint = _has_file(folder, CHECKPOINT_FILE)
    finished = _has_file(folder, MODEL_FILE) and not has_checkpoint
    if has_checkpoint:
        step, steps = _read_checkpoint_steps(folder / CHECKPOINT_FILE)
        return RunStatus(str(folder), finished, has_checkpoint, step, steps)
    metrics = _read_json_object(folder / METRICS_FILE)
    settings, scene, scores = (_get_dict(metrics, name) for name in ("settings", "scene", "evaluation"))
    steps = _get_int(settings, "steps")
    photos = scene.get("path")
    return RunStatus(
        folder=str(folder),
        finished=finished,
        has_checkpoint=has_checkpoint,
        step=steps,
        steps=steps,
        photos=photos if isinstance(photos, str) else None,
        train=_get_int(scene, "train"),
        test=_get_int(scene, "test"),
        seconds=_get_finite_number(metrics, "seconds"),
        psnr=_get_finite_number(scores, "psnr"),
        psnr_consistent=_get_finite_number(scores, "psnr_consistent"),
        ssim=_get_finite_number(scores, "ssim"),
    )


def _has_file(folder: str | os.PathLike[str], name: str) -> bool:
    """Return whether a folder has a file of this name; False if the folder may not be searched."""
    return os.path.isfile(os.path.join(folder, name))  # Path.is_file raises if the folder may not be searched


def _read_checkpoint_steps(path: Path) -> tuple[int | None, int | None]:
    """Read the step at which a checkpoint was written, and the last step of its run.

    Both are None where the file cannot be read, because only messages depend on them. `hyrfpack.train.checkpoint`
    writes the file. Its tensors are not read.
    """
    import torch

    try:
        content = torch.load(path, weights_only=True, map_location="meta", mmap=True)
        settings, progress = json.loads(content["settings"]), json.loads(content["progress"])
        processes = settings.get("processes", 1)
        return int(progress["step"]), -(-int(settings["steps"]) // int(processes))
    except Exception:  # torch's unpickler can raise errors of any type
        return None, None


def _read_json_object(path: Path) -> dict:
    """Read the JSON object in a file; return an empty dictionary if there is none."""
    try:
        content = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def _get_dict(values: dict, name: str) -> dict:
    """Return the dictionary of this name; an empty one if there is none."""
    part = values.get(name)
    return part if isinstance(part, dict) else {}


def _get_int(values: dict, name: str) -> int | None:
    """Return the integer of this name; None if there is none."""
    value = values.get(name)
    return value if isinstance(value, int) and not isinstance(value, bool) else None


def _get_finite_number(values: dict, name: str) -> float | None:
    """Return the finite number of this name; None if there is none."""
    value = values.get(name)
    usable = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max
    return value if usable else None

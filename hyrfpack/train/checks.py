"""Check, before the first step, that a run may be written and that its photos can be used."""

from __future__ import annotations

from pathlib import Path

from hyrfpack.config.train import TrainConfig
from hyrfpack.data import PictureCache
from hyrfpack.errors import HyrfError, HyrfTrainingError
from hyrfpack.evaluate import picture_names
from hyrfpack.format.run_folder import (
    BLOCKS_JOURNAL_FILE,
    CHECKPOINT_FILE,
    METRICS_FILE,
    MODEL_FILE,
    PREPARED_FILES,
    is_prepared,
)
from hyrfpack.outputs import Outputs
from hyrfpack.progress import Progress, TaskEvent
from hyrfpack.scene import Scene, View
from hyrfpack.train.pilots import is_usable
from hyrfpack.train.results import CURVE_FILE, RECORD_FILE, VIEWS_FOLDER, TrainingRecord, changed_settings


def check_folder(
    out: Path, scene: Scene, config: TrainConfig, record: TrainingRecord | None, *, resume: bool, overwrite: bool
) -> None:
    """Check that the run may be written or resumed; `record` is that of a finished model with missing results."""
    if record is not None:
        if different := changed_settings(record, scene, config):
            raise HyrfTrainingError(
                f"{out}: the folder holds a model that was trained with other settings ({', '.join(different)})",
                fix="use the same ones to complete its results, or replace it with `overwrite=True`",
            )
    elif resume and not ((out / CHECKPOINT_FILE).is_file() or is_prepared(out)):
        if (out / BLOCKS_JOURNAL_FILE).is_file():
            raise HyrfError(f"{out}: the run in this folder is one in blocks", fix="resume it with the same `blocks`")
        if (out / MODEL_FILE).is_file():
            raise HyrfError(
                f"{out}: there is no checkpoint to resume, only a finished model ({MODEL_FILE})",
                fix="use this model, or replace it by a new run with `overwrite=True` in place of `resume=True`",
            )
        raise HyrfError(f"{out}: there is no checkpoint to resume", fix="leave out `resume=True` to start a run")
    left = [
        name for name in (MODEL_FILE, *PREPARED_FILES, CHECKPOINT_FILE, BLOCKS_JOURNAL_FILE) if (out / name).exists()
    ]
    if left and not (resume or overwrite or record is not None):
        hint = "`resume=True` continues it, " if {CHECKPOINT_FILE, *PREPARED_FILES}.intersection(left) else ""
        raise HyrfError(
            f"{out}: the folder holds an earlier run ({left[-1]})",
            fix=f"{hint}`overwrite=True` replaces it",
        )
    check_outputs(out, scene, overwrite=resume or overwrite or record is not None)


def check_outputs(out: Path, scene: Scene, *, overwrite: bool) -> None:
    """Check that all files of a run may be written."""
    views = [f"{VIEWS_FOLDER}/{name}" for name in picture_names(scene.test).values()]
    Outputs(scene=scene, overwrite=overwrite).folder(
        out, [MODEL_FILE, CHECKPOINT_FILE, *PREPARED_FILES, METRICS_FILE, CURVE_FILE, RECORD_FILE, *views]
    )


def check_photos(scene: Scene, cache: PictureCache, progress: Progress) -> None:
    """Check that held-out photos can be read and that masks leave pixels, so that scoring cannot fail after training.

    Training photos are read in the first steps anyway, so one usable training photo is enough here.
    """
    held_out = []
    for done, view in enumerate(scene.test):
        progress(TaskEvent("reading held-out photos", done=done, total=len(scene.test)))
        held_out.append(is_usable(view.load()))
    if held_out and not any(held_out):
        raise _nothing_left(scene, scene.test, "to score")
    progress(TaskEvent("reading photos"))
    if scene.train and not any(is_usable(cache.get(view)) for view in scene.train):
        raise _nothing_left(scene, scene.train, "to train on")


def _nothing_left(scene: Scene, views: list[View], purpose: str) -> HyrfTrainingError:
    return HyrfTrainingError(
        f"{scene.path}: the masks of all {len(views)} photos {purpose} leave no pixels (for example, {views[0].name})",
        fix="check that white means 'use this pixel'",
    )

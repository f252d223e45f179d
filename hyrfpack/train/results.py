"""Write the files of a finished run: the model, then scores, pictures, the training curve and `metrics.json`.

All results but the model can be computed again from the model and the training record. The record is a small file that
is written before the model, and removed once all results are written. So after a full disk or an interruption, nothing
has to be trained again.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import statistics
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import torch

from hyrfpack import format as hyrf_format
from hyrfpack.atomic import remove_if_possible, write_atomic
from hyrfpack.config.train import TrainConfig
from hyrfpack.device import describe_device
from hyrfpack.errors import HyrfError, HyrfTrainingError
from hyrfpack.evaluate import evaluate_model, picture_names
from hyrfpack.evaluate.figures import draw_training_curve
from hyrfpack.format.codec import write_model
from hyrfpack.format.run_folder import CHECKPOINT_FILE, METRICS_FILE, MODEL_FILE
from hyrfpack.model import HybridModel
from hyrfpack.outputs import Outputs
from hyrfpack.progress import Progress, TaskEvent, items_of_progress
from hyrfpack.render import RenderSettings, render_view
from hyrfpack.render.files import unique_stems
from hyrfpack.scene import Scene, evenly_spaced
from hyrfpack.train.checkpoint import names_and_sizes, read_asked_steps
from hyrfpack.train.decisions import chosen_steps, is_budget_open
from hyrfpack.train.provenance import training_provenance
from hyrfpack.train.trainer import Trainer

CURVE_FILE, VIEWS_FOLDER, RECORD_FILE = "curve.png", "views", "training.json"
RECORD_VERSION = 1
MIN_BACKGROUND_LIGHT_SHARE = 1e-3  # A background sphere is removed if every view gets less of its light from it.
MAX_BACKGROUND_VIEWS = 16  # At most this many training views decide whether it is removed.


@dataclass(frozen=True)
class TrainingRecord:
    """The data for `metrics.json` that the model's file does not contain.

    Attributes:
        model: name of the model's file in the run's folder.
        model_sha256: digest of that file, in hexadecimal digits.
        step: optimiser steps taken.
        settings: plain values that determine the model, see `_settings_of`.
        metrics: content of `metrics.json` without the scores.
    """

    model: str
    model_sha256: str
    step: int
    settings: dict[str, Any]
    metrics: dict[str, Any]

    def encode(self) -> bytes:
        """Return the record as JSON."""
        return json.dumps({"version": RECORD_VERSION, **dataclasses.asdict(self)}).encode()


@dataclass(frozen=True)
class Results:
    """The results written after the training.

    Attributes:
        metrics: content of `metrics.json`, without scores if these could not be computed.
        missing: files and folders that could not be written, relative to the run's folder.
        reasons: one sentence for each failure, in the order in which they happened; of pictures only the first.
    """

    metrics: dict[str, Any]
    missing: tuple[str, ...] = ()
    reasons: tuple[str, ...] = ()


def read_record(out: Path) -> TrainingRecord | None:
    """Read the training record of a finished model whose results are incomplete.

    Returns:
        The record; None if there is none, or it is damaged, or it belongs to another model.
    """
    try:
        content = json.loads((out / RECORD_FILE).read_bytes())
        if content.pop("version") != RECORD_VERSION:
            return None
        record = TrainingRecord(**content)
        digest = hashlib.sha256((out / Path(record.model).name).read_bytes()).hexdigest()
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None
    return record if record.model_sha256 == digest and _is_usable(record) else None


def _is_usable(record: TrainingRecord) -> bool:
    """Return whether a record from a run's folder, which may be damaged or hostile, has what its results need."""
    if not isinstance(record.settings, dict) or not isinstance(record.metrics, dict):
        return False
    curve = record.metrics.get("curve")
    if not isinstance(curve, list) or not all(_is_curve_record(entry) for entry in curve):
        return False
    counts = (record.step, record.metrics.get("gaussians"), record.metrics.get("bytes"))
    return Path(record.model).name == record.model and all(type(count) is int for count in counts)


def _is_curve_record(entry: object) -> bool:
    """Return whether an entry of a training curve has finite numbers where one is drawn."""
    if not isinstance(entry, dict):
        return False
    numbers = [entry.get(name) for name in ("step", "loss", "psnr", "gaussians")]
    return all(type(number) in (int, float) and math.isfinite(cast(float, number)) for number in numbers)


def changed_settings(record: TrainingRecord, scene: Scene, config: TrainConfig) -> list[str]:
    """Return the names of settings that differ from those of the finished run, except those that pilots decided."""
    asked = json.loads(json.dumps(_settings_of(scene, config)))
    if is_budget_open(config):
        asked["budget_factor"] = record.settings.get("budget_factor")
    if config.exposure is None:
        asked["exposure"] = record.settings.get("exposure")
    steps = record.settings.get("steps")
    asked["steps"] = chosen_steps(scene, config, steps, read_asked_steps(record.metrics, steps))
    keys = asked.keys() | record.settings.keys()
    return sorted(key for key in keys if asked.get(key) != record.settings.get(key))


def save_model(trainer: Trainer, out: Path, progress: Progress, *, overwrite: bool) -> TrainingRecord:
    """Write the model of a finished run and its training record, and remove results of an earlier model.

    The record is written first, so that a model has its record even if the disk becomes full. If only the record cannot
    be written, the checkpoint is kept instead.

    Args:
        trainer: the trainer of the finished run.
        out: the run's folder.
        progress: called with `TaskEvent`s.
        overwrite: replace and remove files of an earlier run. Without it, a file that appeared at the model's name
            during the run is kept, and the model gets a free name beside it.

    Raises:
        HyrfTrainingError: masks left no pixel to train on in any step.
        HyrfError: the model cannot be written; the checkpoint stays.
    """
    scene, config = trainer.scene, trainer.config
    if not trainer.records:
        raise HyrfTrainingError(
            f"{scene.path}: the masks leave no pixels in the photos of all {trainer.steps:,} steps",
            fix="use at least as many `steps` as there are photos",
        )
    model = _drop_unseen_background(trainer, progress)
    progress(TaskEvent("writing the model"))
    provenance = {
        "steps": config.steps,
        "seed": config.seed,
        "choices": trainer.choices,
        **training_provenance(scene),
        "psnr": statistics.median(record["psnr"] for record in trainer.records[-len(trainer.records) // 10 :]),
    }
    data = hyrf_format.encode_model(model, "raw", provenance)
    metrics = {
        "settings": config.to_dict(),
        "device": describe_device(trainer.device),
        "processes": trainer.ranks.size,
        "scene": scene_facts(scene),
        "choices": trainer.choices,
        "pilots": trainer.pilots,
        "notes": scene.notes,
        "gaussians": len(model),
        "bytes": len(data),
        "seconds": trainer.elapsed,
        "steps_per_second": trainer.steps / max(trainer.elapsed, 1e-9),
        "stage_seconds": {name: round(value, 3) for name, value in sorted(trainer.seconds.items())},
        "curve": trainer.records,
        "log_gains": {} if trainer.exposures is None else trainer.exposures.to_dict(),
    }
    digest = hashlib.sha256(data).hexdigest()
    record = TrainingRecord(MODEL_FILE, digest, trainer.step, _settings_of(scene, config), metrics)
    is_recorded = True
    try:
        write_atomic(out / RECORD_FILE, record.encode())
    except HyrfError:
        is_recorded = False
    try:
        name = Path(write_model(data, out / MODEL_FILE, overwrite=overwrite).file).name
    except HyrfError:
        remove_if_possible(out / RECORD_FILE)
        raise
    if name != record.model:
        record = dataclasses.replace(record, model=name)
        with suppress(HyrfError):
            write_atomic(out / RECORD_FILE, record.encode())
    if overwrite:
        remove_results(out, scene)
    if is_recorded and (overwrite or trainer.saved is not None):
        remove_if_possible(out / CHECKPOINT_FILE)  # This also frees space for the results.
    return record


def remove_results(out: Path, scene: Scene) -> None:
    """Remove results of an earlier run from the folder of a new model, which they would be mistaken for."""
    for result in (*_earlier_pictures(out, scene), METRICS_FILE, CURVE_FILE, *_picture_files(scene)):
        remove_if_possible(out / result)


def write_results(
    record: TrainingRecord,
    scene: Scene,
    out: Path,
    config: TrainConfig,
    device: torch.device,
    progress: Progress,
    *,
    overwrite: bool,
) -> Results:
    """Score the model's file, and write pictures, curve and `metrics.json`; failures are returned, not raised.

    The training record is removed once all results are written.

    Args:
        record: training record of the model in the folder.
        scene: the scene, with the held-out photos.
        out: the run's folder.
        config: settings of the run.
        device: where to render.
        progress: called with `TaskEvent`s.
        overwrite: replace files at the results' names; without it they are kept.
    """
    metrics, missing, reasons = dict(record.metrics), [], []
    is_scored = True
    if scene.test:
        unwritten: list[str] = []
        try:
            # The written file is scored, not the model in memory.
            model = hyrf_format.load_model(out / record.model, device)
            model.precision = config.precision
            scores = evaluate_model(
                model,
                scene.test,
                pictures=out / VIEWS_FOLDER,
                overwrite=overwrite,
                progress=items_of_progress(progress, "scoring held-out photos", len(scene.test)),
                unwritten=unwritten,
            )
            metrics["evaluation"] = scores.to_dict()
        except HyrfError as error:
            is_scored = False
            reasons.append(str(error))
        if unwritten or not is_scored:
            missing.append(VIEWS_FOLDER)
            reasons += unwritten[:1]
    progress(TaskEvent(f"drawing {CURVE_FILE}"))
    try:
        draw_training_curve(metrics["curve"], out / CURVE_FILE, overwrite=overwrite)
    except HyrfError as error:
        missing.append(CURVE_FILE)
        reasons.append(str(error))
    try:
        if is_scored:
            write_atomic(out / METRICS_FILE, json.dumps(metrics, indent=1).encode(), overwrite=overwrite)
        else:
            missing.append(METRICS_FILE)
    except HyrfError as error:
        missing.append(METRICS_FILE)
        reasons.append(str(error))
    if not missing:
        remove_if_possible(out / RECORD_FILE)
    return Results(metrics, tuple(missing), tuple(reasons))


def scene_facts(scene: Scene) -> dict[str, Any]:
    """Return what `metrics.json` states about the photos of a run."""
    return {
        "path": scene.path,
        "layout": scene.layout,
        "train": len(scene.train),
        "test": len(scene.test),
        "max_size": scene.max_size,
        "reading": dict(scene.reading),
    }


def _settings_of(scene: Scene, config: TrainConfig) -> dict[str, Any]:
    """Return the plain values that must be the same when a later call completes the results."""
    held_out = [view.name for view in scene.test]
    return {**config.to_dict(), "views": names_and_sizes(scene.train), "held-out views": held_out}


def _picture_files(scene: Scene) -> list[str]:
    """Return the paths of the pictures of held-out views, relative to the run's folder."""
    return [f"{VIEWS_FOLDER}/{name}" for name in picture_names(scene.test).values()]


def _earlier_pictures(out: Path, scene: Scene) -> list[str]:
    """Return the paths of the pictures of an earlier run that its `metrics.json` lists, relative to the run's folder.

    That file may be damaged or hostile. So there are none if one of them is a photo of the scene, and none outside of
    the folder of pictures.
    """
    try:
        scores = json.loads((out / METRICS_FILE).read_bytes())["evaluation"]
        names = [*(view["name"] for view in scores["views"]), *scores["skipped"]]
        pictures = [f"{VIEWS_FOLDER}/{name}.png" for name in unique_stems(names)]
        Outputs(scene=scene, overwrite=True).folder(out, pictures)
        folder = out.resolve() / VIEWS_FOLDER
        return [picture for picture in pictures if (out / picture).parent.resolve().is_relative_to(folder)]
    except (HyrfError, OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return []


@torch.no_grad()
def _drop_unseen_background(trainer: Trainer, progress: Progress) -> HybridModel:
    """Return the model, without its background sphere if the training cameras get hardly any light from it."""
    model = trainer.model
    if not model.config.background:
        return model
    views = evenly_spaced(trainer.scene.train, MAX_BACKGROUND_VIEWS)
    settings = RenderSettings()
    seen = 0.0
    for done, view in enumerate(views):
        progress(TaskEvent("measuring the share of the background", done=done, total=len(views)))
        transmittance = 1 - render_view(model, view.camera, settings, background=False).alpha
        # Below the threshold a render shows no background. There blending stops early, which leaves up to 0.2 %.
        light = torch.where(transmittance > settings.background_threshold, transmittance, 0)
        seen = max(seen, float(light.mean()))
    if seen >= MIN_BACKGROUND_LIGHT_SHARE:
        trainer.choices["background"] += f"; up to {seen:.1%} of a view's light comes from it"
        return model
    trainer.choices["background"] = (
        f"none: no training view gets more than {MIN_BACKGROUND_LIGHT_SHARE:.1%} of its light from it"
    )
    model.config = dataclasses.replace(model.config, background=False)
    return model

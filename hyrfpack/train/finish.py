"""Finish a run whose model is trained: write its results, and say which are missing."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import torch

from hyrfpack.atomic import remove_if_possible
from hyrfpack.config.train import TrainConfig
from hyrfpack.format.run_folder import CHECKPOINT_FILE, PREPARED_FILES
from hyrfpack.progress import Progress
from hyrfpack.scene import Scene
from hyrfpack.train.log import TrainingLog
from hyrfpack.train.results import Results, TrainingRecord, read_record, write_results

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class TrainResult:
    """The result of a run.

    Attributes:
        complete: False if the run was interrupted; the checkpoint is then in the folder.
        step: optimiser steps taken.
        model: path of the `.hyrf` file; None if interrupted.
        metrics: content of `metrics.json`; empty if interrupted.
        missing: a sentence that names the results that could not be written, as on a full disk, and gives the reason;
            empty if all are written.
    """

    complete: bool
    step: int
    model: Path | None
    metrics: dict
    missing: str = ""


def finish_run(
    record: TrainingRecord,
    scene: Scene,
    out: Path,
    config: TrainConfig,
    device: torch.device,
    progress: Progress,
    log: TrainingLog | None,
    *,
    overwrite: bool,
    owns_checkpoint: bool,
) -> TrainResult:
    """Write the results of a model, remove what a resumed run would need unless they are missing, and end the log.

    Args:
        record, scene, out, config, device, progress, overwrite: see `write_results`.
        log: the run's log.
        owns_checkpoint: whether a checkpoint in the folder belongs to this run.
    """
    if read_record(out) is not None:  # Nobody resumes from them while the training record is there.
        _remove_prepared(out)
    results = write_results(record, scene, out, config, device, progress, overwrite=overwrite)
    missing = _log_missing(results)
    # Without a training record, only the checkpoint and its preparation let a later call complete the results.
    if not results.missing or read_record(out) is not None:
        _remove_prepared(out)
        if owns_checkpoint:
            remove_if_possible(out / CHECKPOINT_FILE)
    if log is not None:
        facts = {name: results.metrics[name] for name in ("gaussians", "bytes")}
        scores = results.metrics.get("evaluation", {})
        facts |= {name: scores[name] for name in ("psnr", "ssim") if name in scores}
        log.end(complete=True, step=record.step, **facts)
    return TrainResult(True, record.step, out / record.model, results.metrics, missing)


def _remove_prepared(out: Path) -> None:
    """Remove what runs before the training itself have left for a resumed run."""
    for name in PREPARED_FILES:
        remove_if_possible(out / name)


def _log_missing(results: Results) -> str:
    """Log which results are missing, if any, and return the logged sentence."""
    if not results.missing:
        return ""
    names = " and ".join(filter(None, [", ".join(results.missing[:-1]), results.missing[-1]]))
    verb = "are" if len(results.missing) > 1 else "is"
    sentence = f"{'; '.join(dict.fromkeys(results.reasons))}; the model is finished, but {names} {verb} missing"
    _LOG.warning(sentence)
    return sentence

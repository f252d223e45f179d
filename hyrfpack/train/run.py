"""Do a complete training run in a folder: train, save the model, score it on held-out views, and report."""

from __future__ import annotations

import dataclasses
import logging
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch

from hyrfpack.checks import check_type
from hyrfpack.config.train import TrainConfig
from hyrfpack.data import PictureCache
from hyrfpack.data.cache import memory_bytes
from hyrfpack.device import choose_own_device
from hyrfpack.errors import HyrfError, HyrfTrainingError
from hyrfpack.evaluate import picture_names
from hyrfpack.format.run_folder import CHECKPOINT_FILE, METRICS_FILE, MODEL_FILE
from hyrfpack.lock import exclusive_folder
from hyrfpack.outputs import Outputs
from hyrfpack.parallel.ranks import SINGLE_PROCESS, Ranks
from hyrfpack.scene import Scene, View
from hyrfpack.train.checkpoint import saved_decisions
from hyrfpack.train.decisions import (
    Decisions,
    decide,
    is_budget_open,
    measures_budget,
    measures_exposure,
    without_pilots,
)
from hyrfpack.train.log import TrainingLog
from hyrfpack.train.pilots import Report, is_usable
from hyrfpack.train.progress import PhaseLine, ProgressLine
from hyrfpack.train.results import (
    CURVE_FILE,
    RECORD_FILE,
    VIEWS_FOLDER,
    Phase,
    Results,
    TrainingRecord,
    changed_settings,
    read_record,
    save_model,
    write_results,
)
from hyrfpack.train.setup import check_target
from hyrfpack.train.trainer import Trainer

__all__ = ["VIEWS_FOLDER", "TrainResult", "is_begun", "resuming", "train_model"]

_LOG = logging.getLogger(__name__)

# These signals end a run early (Windows has no SIGHUP).
STOP_SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
CHOICE_LABELS = {"exposure": "Exposure compensation", "max_gaussians": "Gaussian budget"}
Observer = Callable[[Trainer], None]


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


def train_model(
    scene: Scene,
    out: Path | str,
    config: TrainConfig | None = None,
    *,
    resume: bool = False,
    overwrite: bool = False,
    cache: PictureCache | None = None,
    device: str | torch.device = "auto",
    quiet: bool = False,
    report: Report | None = None,
    phase: Phase | None = None,
    observer: Observer | None = None,
    log: Path | str | None = None,
    ranks: Ranks = SINGLE_PROCESS,
) -> TrainResult:
    """Train a model on a scene and write all results of the run into a folder.

    The folder gets `model.hyrf` (profile raw), `metrics.json`, `curve.png`, `views/` (held-out photos beside their
    renders and error maps) and, while running, `checkpoint.pt`. The first Ctrl-C, SIGTERM or SIGHUP (as when the
    terminal is closed) saves the checkpoint and returns, unless the parent process ignores the signal. Before the first
    step, during pilot runs, there is nothing to save.

    If a result other than the model cannot be written, the run does not fail. A later call with the same settings, with
    or without `resume`, completes the results without training again. The same holds after an interruption while
    results are written.

    Args:
        scene: the scene, from `hyrfpack.load_scene`.
        out: the run's folder, created if missing.
        config: settings of the run; None for the defaults.
        resume: resume from the folder's checkpoint, or complete the results of a finished model. The result equals that
            of an uninterrupted run.
        overwrite: replace an earlier run in the folder. Without it, nothing is replaced. If a file appears at a
            result's name during training, the result gets a free name beside it; `TrainResult.model` has the model's.
        cache: cache of decoded photos; by default one that takes a quarter of the memory.
        device: where to train, see `hyrfpack.device.choose_device`. A run may be resumed on another device. On a GPU
            sums of gradients vary in their last bits from run to run, which may change the measured budget.
        quiet: show no progress.
        report: called after each step with its number (0 during pilot runs), the loss and mean squared error of its
            view (NaN if the view is masked completely) and the number of Gaussians. It replaces the progress line.
        phase: called during all other work with its name ("scoring held-out photos"), the number of items done, and
            that of all items (0 if unknown). It replaces the progress line.
        observer: called after each step with the trainer, whose model it may read and must not change. Of several
            processes only rank 0 calls it. Its time does not count as training time.
        log: a file that gets a line of JSON every few steps, and TensorBoard files beside it if that is installed; see
            `hyrfpack.train.log.TrainingLog`. A resumed run appends to it.
        ranks: processes that train together, from `hyrfpack.parallel.ranks.join_processes`. All of them call this
            function with the same scene and settings. Only rank 0 writes, prints, logs and returns metrics. If the
            launcher restarts the processes, as torchrun does after one has ended, they resume from any checkpoint.

    Raises:
        HyrfError: before the first step, if another call is working in the folder, the folder holds another run, the
            results would replace photos or other files, no photo has a pixel to train on or to score, or a held-out
            photo cannot be read. Later, if training cannot start or continue, or the model cannot be written.
            If a checkpoint cannot be written during training, a warning is logged; for other results see
            `TrainResult.missing`.
        TypeError: `scene` is no Scene or `config` no TrainConfig.

    Example:
        >>> import hyrfpack
        >>> scene = hyrfpack.load_scene("photos/bonsai")
        >>> result = hyrfpack.train_model(scene, "runs/first", hyrfpack.TrainConfig(steps=10), quiet=True)
        >>> result.complete, result.step, result.model.name
        (True, 10, 'model.hyrf')
    """
    check_type("scene", scene, Scene)
    out = Path(out)
    config = TrainConfig() if config is None else config
    check_type("config", config, TrainConfig)
    check_target(scene, config)
    # This check ignores existing results. It runs first, so that no folder is created where nothing may be written.
    ranks.run_on_all(lambda: _check_outputs(out, scene, overwrite=True) if ranks.is_main else None)
    with exclusive_folder(out, ranks=ranks):
        return _train_in_folder(
            scene, out, config, resume=resume, overwrite=overwrite, cache=cache, device=device, quiet=quiet,
            report=report, phase=phase, observer=observer, log=log, ranks=ranks,
        )  # fmt: skip


def _train_in_folder(
    scene: Scene,
    out: Path,
    config: TrainConfig,
    *,
    resume: bool,
    overwrite: bool,
    cache: PictureCache | None,
    device: str | torch.device,
    quiet: bool,
    report: Report | None,
    phase: Phase | None,
    observer: Observer | None,
    log: Path | str | None,
    ranks: Ranks,
) -> TrainResult:
    """Train in a folder that this call has locked; see `train_model`."""
    checkpoint = out / CHECKPOINT_FILE
    device = choose_own_device(device, ranks)
    resume = ranks.broadcast(resume or (ranks.restarts > 0 and is_begun(out)))
    replace = resume or overwrite
    cache = cache or PictureCache(memory_bytes() // 4 // ranks.local_size)
    silent = quiet or report is not None or not ranks.is_main

    def check(config: TrainConfig, phase: Phase) -> TrainingRecord | None:
        if not ranks.is_main:
            return None
        record = read_record(out) if resume or not overwrite else None
        _prepare(out, scene, config, record, resume, overwrite)
        if log is not None:
            Outputs(scene=scene, overwrite=replace or record is not None).file(log)
        if record is None:
            _check_photos(scene, cache, phase)
        return record

    with PhaseLine(silent) as phases:
        report_phase = phase or phases.update
        record = ranks.broadcast(ranks.run_on_all(partial(check, config, report_phase)))
    if record is not None:
        return _complete(record, scene, out, config, device, phase, silent, log, ranks)
    if overwrite and not resume and ranks.is_main:
        (out / RECORD_FILE).unlink(missing_ok=True)  # It belongs to the earlier run, which this one replaces.
    if resume:
        saved = ranks.run_on_all(lambda: _with_saved_decisions(config, checkpoint) if ranks.is_main else config)
        decisions = Decisions(ranks.broadcast(saved), {}, [])
    elif questions := _open_questions(scene, config):
        with PhaseLine(silent) as phases, _stop_requests() as stop:
            if ranks.is_main:
                _LOG.info(f"{questions} with short pilot runs, scored on validation photos")
            report_pilot: Report = _ignore_step if report is None else partial(_report_as_step_zero, report)
            # Every rank runs all pilots, so that no rank waits for another.
            pilots = partial(decide, scene, config, cache, device, report_pilot, stop, phase or phases.update)
            answers = ranks.all_gather(ranks.run_on_all(pilots))
        if answers[0] is None or None in answers:
            return TrainResult(False, 0, None, {})
        decisions = answers[0]
    else:
        decisions = without_pilots(config)
    config = decisions.config
    with PhaseLine(silent) as phases:
        (phase or phases.update)("reading photos and setting up the model", 0, 0)
        trainer = ranks.run_on_all(lambda: Trainer(scene, config, cache, device, ranks=ranks))
    for choice, reason in decisions.reasons.items():
        trainer.choices[choice] += f"; {reason}"
    trainer.pilots = [dataclasses.asdict(score) for score in decisions.scores]
    if resume:
        trainer.load(checkpoint)
    elif ranks.is_main and not ranks.is_single:
        # Restarted processes resume from any checkpoint that they find, so that of an earlier run must not remain.
        checkpoint.unlink(missing_ok=True)
    with ExitStack() as stack:
        with (
            _checkpoint_named_in_errors(trainer, overwrite),
            ProgressLine(trainer.steps, trainer.step, silent, _describe_shortening(device)) as line,
            _stop_requests() as stop,
        ):
            if ranks.is_main:
                for choice in decisions.reasons:
                    _LOG.info(f"{CHOICE_LABELS[choice]}: {trainer.choices[choice]}")
            written = None
            if log is not None and ranks.is_main:
                written = stack.enter_context(TrainingLog(Path(log), trainer.steps, trainer.step, device, replace))
            step_reports = [report or line.update, *([written.step] if written else [])]

            def report_step(trainer: Trainer, loss: float, mse: float) -> None:
                for report_to in step_reports:
                    report_to(trainer.step, loss, mse, len(trainer.model))
                if observer is not None and ranks.is_main:
                    observer(trainer)

            complete = trainer.run(checkpoint=checkpoint, report=report_step, stop=stop, overwrite=replace)
        if not complete or not ranks.is_main:
            if written:
                written.end(complete=complete, step=trainer.step)
            return TrainResult(complete, trainer.step, out / MODEL_FILE if complete else None, {})
        with PhaseLine(silent) as phases:
            report_phase = phase or phases.update
            with _checkpoint_named_in_errors(trainer, overwrite):
                record = save_model(trainer, out, report_phase, overwrite=replace)
            results = write_results(record, scene, out, config, device, report_phase, overwrite=replace)
            missing = _log_missing(results)
        if METRICS_FILE not in results.missing and (replace or trainer.saved is not None):
            checkpoint.unlink(missing_ok=True)
        if written:
            _log_end(written, record.step, results)
    return TrainResult(True, trainer.step, out / record.model, results.metrics, missing)


def _with_saved_decisions(config: TrainConfig, checkpoint: Path) -> TrainConfig:
    """Return the settings, completed by the decisions that the interrupted run made for them."""
    factor, exposure = saved_decisions(checkpoint)
    if is_budget_open(config):
        config = dataclasses.replace(config, budget_factor=factor)
    return config if config.exposure is not None else dataclasses.replace(config, exposure=exposure)


def _open_questions(scene: Scene, config: TrainConfig) -> str:
    """Return what pilot runs have to decide, as the start of a sentence; "" if they decide nothing."""
    questions = ["choosing exposure compensation"] * measures_exposure(scene, config)
    questions += ["estimating the Gaussian budget"] * measures_budget(scene, config)
    return " and ".join(questions)


def is_begun(out: Path) -> bool:
    """Return whether a run in the folder can be resumed, from a checkpoint or from a model with missing results."""
    return (out / CHECKPOINT_FILE).is_file() or read_record(out) is not None


def _complete(
    record: TrainingRecord,
    scene: Scene,
    out: Path,
    config: TrainConfig,
    device: torch.device,
    phase: Phase | None,
    silent: bool,
    log: Path | str | None,
    ranks: Ranks,
) -> TrainResult:
    """Compute and write the missing results of a finished model; only rank 0 does so."""
    if not ranks.is_main:
        return TrainResult(True, record.step, out / MODEL_FILE, {})
    with PhaseLine(silent) as phases, ExitStack() as stack:
        _LOG.info("the model is already trained; computing its scores and pictures")
        written = None
        if log is not None:
            written = stack.enter_context(TrainingLog(Path(log), record.step, record.step, device))
        results = write_results(record, scene, out, config, device, phase or phases.update, overwrite=True)
        if written:
            _log_end(written, record.step, results)
        missing = _log_missing(results)
    if METRICS_FILE not in results.missing:
        (out / CHECKPOINT_FILE).unlink(missing_ok=True)
    return TrainResult(True, record.step, out / record.model, results.metrics, missing)


def _log_missing(results: Results) -> str:
    """Log which results are missing, if any, and return the logged sentence."""
    if not results.missing:
        return ""
    names = " and ".join(filter(None, [", ".join(results.missing[:-1]), results.missing[-1]]))
    verb = "are" if len(results.missing) > 1 else "is"
    sentence = f"{results.reasons[0]}; the model is finished, but {names} {verb} missing"
    _LOG.warning(sentence)
    return sentence


def _log_end(log: TrainingLog, step: int, results: Results) -> None:
    facts = {name: results.metrics[name] for name in ("gaussians", "bytes")}
    scores = results.metrics.get("evaluation", {})
    facts |= {name: scores[name] for name in ("psnr", "ssim") if name in scores}
    log.end(complete=True, step=step, **facts)


def _ignore_step(step: int, loss: float, mse: float, gaussians: int) -> None:
    """Ignore a step of a pilot run, because the progress of pilots is reported as a phase."""


def _report_as_step_zero(report: Report, step: int, loss: float, mse: float, gaussians: int) -> None:
    report(0, loss, mse, gaussians)


def resuming(overwrite: bool) -> str:
    """Describe, as words of a sentence, how to resume a run that was started with or without `overwrite`."""
    return f"the same command with `resume=True`{' instead of `overwrite=True`' if overwrite else ''}"


def _describe_shortening(device: torch.device) -> str:
    """Describe, as words of a sentence, how to shorten a run on a device."""
    ways = ["fewer steps", "smaller photos", "fewer Gaussians"]
    if device.type == "cpu":
        ways.append("a GPU")
    return f"{', '.join(ways[:-1])} or {ways[-1]}"


@contextmanager
def _checkpoint_named_in_errors(trainer: Trainer, overwrite: bool) -> Iterator[None]:
    """Add to the fix of an error of reading or writing that the checkpoint is kept and how to resume from it."""
    try:
        yield
    except HyrfError as error:
        if isinstance(error, HyrfTrainingError) or trainer.saved is None:
            raise
        kept = f"the checkpoint of step {trainer.saved:,} is kept, {resuming(overwrite)} continues from there"
        raise error.with_text(fix=f"{error.fix}; {kept}") from error


def _prepare(
    out: Path, scene: Scene, config: TrainConfig, record: TrainingRecord | None, resume: bool, overwrite: bool
) -> None:
    """Check that the run may be written or resumed; `record` is that of a finished model with missing results."""
    if record is not None:
        if different := changed_settings(record, scene, config):
            raise HyrfTrainingError(
                f"{out}: the folder holds a model that was trained with other settings ({', '.join(different)})",
                fix="use the same ones to complete its results, or replace it with `overwrite=True`",
            )
    elif resume and not (out / CHECKPOINT_FILE).is_file():
        raise HyrfError(f"{out}: there is no checkpoint to resume", fix="leave out `resume=True` to start a run")
    left = [name for name in (MODEL_FILE, CHECKPOINT_FILE) if (out / name).exists()]
    if left and not (resume or overwrite or record is not None):
        hint = "`resume=True` continues it, " if CHECKPOINT_FILE in left else ""
        raise HyrfError(
            f"{out}: the folder holds an earlier run ({left[-1]})",
            fix=f"{hint}`overwrite=True` replaces it",
        )
    _check_outputs(out, scene, overwrite=resume or overwrite or record is not None)


def _check_outputs(out: Path, scene: Scene, *, overwrite: bool) -> None:
    views = [f"{VIEWS_FOLDER}/{name}" for name in picture_names(scene.test).values()]
    Outputs(scene=scene, overwrite=overwrite).folder(
        out, [MODEL_FILE, CHECKPOINT_FILE, METRICS_FILE, CURVE_FILE, RECORD_FILE, *views]
    )


def _check_photos(scene: Scene, cache: PictureCache, phase: Phase) -> None:
    """Check that held-out photos can be read and that masks leave pixels, so that scoring cannot fail after training.

    Training photos are read in the first steps anyway, so one usable training photo is enough here.
    """
    held_out = []
    for done, view in enumerate(scene.test):
        phase("reading held-out photos", done, len(scene.test))
        held_out.append(is_usable(view.load()))
    if held_out and not any(held_out):
        raise _nothing_left(scene, scene.test, "to score")
    phase("reading photos", 0, 0)
    if scene.train and not any(is_usable(cache.get(view)) for view in scene.train):
        raise _nothing_left(scene, scene.train, "to train on")


def _nothing_left(scene: Scene, views: list[View], purpose: str) -> HyrfTrainingError:
    return HyrfTrainingError(
        f"{scene.path}: the masks of all {len(views)} photos {purpose} leave no pixels (for example, {views[0].name})",
        fix="check that white means 'use this pixel'",
    )


@contextmanager
def _stop_requests() -> Iterator:
    """Turn the first Ctrl-C, SIGTERM or SIGHUP into a request to stop; a second Ctrl-C or SIGTERM takes effect at once.

    Signals that the parent process ignores stay ignored: SIGHUP under nohup, Ctrl-C in the background of a script. A
    second SIGHUP has no effect, because closing a terminal sends two: one by the shell and one by the terminal.

    Yields:
        A function that returns whether a stop was requested.
    """
    requested = threading.Event()
    if threading.current_thread() is not threading.main_thread():  # Only the main thread can handle signals.
        yield requested.is_set
        return
    found = {number: signal.getsignal(number) for number in STOP_SIGNALS}
    previous = {number: handler for number, handler in found.items() if handler not in (signal.SIG_IGN, None)}

    def handle(number: int, _frame: object) -> None:
        requested.set()
        if number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, previous[number])

    try:
        for number in previous:
            signal.signal(number, handle)
        yield requested.is_set
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)

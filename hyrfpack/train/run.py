"""A whole training run in a folder: train, save, score on held-out views, report."""

from __future__ import annotations

import dataclasses
import json
import signal
import statistics
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch

from hyrfpack import format as hyrf_format
from hyrfpack.atomic import write_atomic
from hyrfpack.cameras.capture import provenance_of
from hyrfpack.checks import check_type
from hyrfpack.data import PictureCache
from hyrfpack.data.cache import memory_bytes
from hyrfpack.device import choose_own_device, describe_device
from hyrfpack.errors import HyrfError, HyrfTrainingError
from hyrfpack.evaluate import Evaluation, evaluate, picture_names
from hyrfpack.evaluate.figures import training_curve
from hyrfpack.format.run_folder import CHECKPOINT, METRICS, MODEL
from hyrfpack.model import HybridModel
from hyrfpack.outputs import Outputs
from hyrfpack.parallel.ranks import ALONE, Ranks
from hyrfpack.render import render
from hyrfpack.scene import Scene, View, evenly_spaced
from hyrfpack.train.checkpoint import saved_budget_factor
from hyrfpack.train.config import TrainConfig
from hyrfpack.train.log import TrainingLog
from hyrfpack.train.pilots import MOST_STEPS, is_undecided, is_usable, measure_budget, measures_budget
from hyrfpack.train.progress import ProgressLine
from hyrfpack.train.trainer import Trainer

CURVE, VIEWS = "curve.png", "views"
# What ends a run early; Windows has no SIGHUP.
STOPPING = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
Report = Callable[[int, float, float, int], None]  # step, loss, mean squared error, Gaussians
BACKGROUND_SEEN = 1e-3  # a background that gets less than this share of the light is not there


@dataclass(frozen=True)
class TrainResult:
    """What a run came to.

    Attributes:
        complete: False when it was interrupted; the checkpoint is in the folder.
        step: optimiser steps taken.
        model: path of the `.hyrf` file, None when interrupted.
        metrics: what `metrics.json` holds, empty when interrupted.
    """

    complete: bool
    step: int
    model: Path | None
    metrics: dict


def train(
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
    log: Path | str | None = None,
    ranks: Ranks = ALONE,
) -> TrainResult:
    """Train a model on a scene and leave everything about the run in a folder.

    The folder gets `model.hyrf` (profile raw), `metrics.json`, `curve.png`, `views/` (held-out photos beside their
    renders and error maps) and, while running, `checkpoint.pt`. The first Ctrl-C (or SIGTERM, or SIGHUP as when the
    terminal is closed) saves the checkpoint and returns, unless whoever started the program has it ignored; before the
    first step, while short runs measure the budget, there is nothing to save.

    Args:
        scene: from `hyrfpack.load_scene`.
        out: the run's folder, made if missing.
        config: settings, all defaults measured.
        resume: go on from the folder's checkpoint; the result is the one an uninterrupted run gives.
        overwrite: replace what an earlier run left in the folder.
        cache: holds decoded photos; by default a quarter of the memory.
        device: where to train, see `hyrfpack.device.choose_device`. A run may be resumed on another one. On a GPU
            sums of gradients vary in their last bits from run to run, which may tip the measured budget.
        quiet: print nothing.
        report: told after each step its number, the loss and mean squared error of its view (NaN where all of it is
            masked) and how many Gaussians there are, in place of the line that is shown otherwise; 0 for its number
            while pilots run.
        log: a file that gets a line of JSON every few steps, and TensorBoard's files beside it where that is
            installed; see `hyrfpack.train.log.TrainingLog`. A resumed run adds to it.
        ranks: processes that train together, from `hyrfpack.parallel.ranks.joined`: all call this with the same scene
            and settings. Rank 0 alone writes and speaks, and returns metrics. When their launcher starts them anew,
            as torchrun does after one has ended, they go on from the checkpoint if there is one.

    Raises:
        HyrfError: the folder holds another run, training cannot start or go on, no photo has a pixel to train on or to
            score, a held-out photo cannot be read (all of which is found before the first step), or the results would
            replace photos or other files, or cannot be written (a checkpoint that cannot, while training, is a line on
            standard error).
        TypeError: `scene` is no Scene or `config` no TrainConfig.

    Example:
        >>> import hyrfpack
        >>> scene = hyrfpack.load_scene("photos/bonsai")
        >>> result = hyrfpack.train(scene, "runs/first", hyrfpack.TrainConfig(steps=10), quiet=True)
        >>> result.complete, result.step, result.model.name
        (True, 10, 'model.hyrf')
    """
    check_type("scene", scene, Scene)
    out = Path(out)
    config = TrainConfig() if config is None else config
    check_type("config", config, TrainConfig)
    checkpoint = out / CHECKPOINT
    device = choose_own_device(device, ranks)
    resume = ranks.first(resume or (ranks.restarts > 0 and checkpoint.is_file()))
    cache = cache or PictureCache(memory_bytes() // 4 // ranks.local_size)

    def check() -> None:
        if not ranks.leads:
            return
        _prepare(out, scene, resume, overwrite)
        if log is not None:
            Outputs(scene=scene, overwrite=resume or overwrite).file(log)
        _check_photos(scene, cache)

    ranks.agree(check)
    silent = quiet or report is not None or not ranks.leads
    why = ""
    if resume and is_undecided(config):
        saved = ranks.agree(lambda: saved_budget_factor(checkpoint) if ranks.leads else None)
        config = dataclasses.replace(config, budget_factor=ranks.first(saved))
    elif not resume and measures_budget(scene, config):
        with ProgressLine(MOST_STEPS, 0, silent) as line, _stop_requests() as stop:
            line.note("how many Gaussians is the scene worth? Short runs tell")
            tell: Report = line.update if report is None else partial(_as_step_nought, report)
            # Each does it for itself: none waits for another.
            pilots = partial(measure_budget, scene, config, cache, device, tell, stop)
            answers = ranks.told(ranks.agree(pilots))
            measured = None if None in answers else answers[0]
            if measured is None:
                return TrainResult(False, 0, None, {})
            config, why = dataclasses.replace(config, budget_factor=measured[0]), f": {measured[1]}"
    trainer = ranks.agree(lambda: Trainer(scene, config, cache, device, ranks=ranks))
    trainer.choices["max_gaussians"] += why
    if resume:
        trainer.load(checkpoint)
    elif ranks.leads and not ranks.alone:  # one of an earlier run is not what to go on from, should we be started anew
        checkpoint.unlink(missing_ok=True)
    with _naming_the_checkpoint(trainer, overwrite), ExitStack() as stack:
        with (
            ProgressLine(trainer.steps, trainer.step, silent, _shorter(device)) as line,
            _stop_requests() as stop,
        ):
            if why:
                line.note(f"Gaussians at most: {trainer.choices['max_gaussians']}")
            written = None
            if log is not None and ranks.leads:
                written = stack.enter_context(TrainingLog(Path(log), trainer.steps, trainer.step, device, line.note))
            told = [report or line.update, *([written.step] if written else [])]

            def tell_all(trainer: Trainer, loss: float, mse: float) -> None:
                for tell in told:
                    tell(trainer.step, loss, mse, len(trainer.model))

            complete = trainer.run(checkpoint=checkpoint, report=tell_all, stop=stop, warn=line.note)
        metrics = _finish(trainer, out) if complete and ranks.leads else {}
        if written:
            facts = {name: metrics[name] for name in ("gaussians", "bytes") if complete}
            scores = metrics.get("evaluation", {})
            facts |= {name: scores[name] for name in ("psnr", "ssim") if name in scores}
            written.end(complete=complete, step=trainer.step, **facts)
    if not complete:
        return TrainResult(False, trainer.step, None, {})
    if ranks.leads:
        checkpoint.unlink(missing_ok=True)
    return TrainResult(True, trainer.step, out / MODEL, metrics)


def _as_step_nought(report: Report, step: int, loss: float, mse: float, gaussians: int) -> None:
    report(0, loss, mse, gaussians)


def _finish(trainer: Trainer, out: Path) -> dict:
    """Write what a finished run leaves, the model first; returns the metrics."""
    scene, config = trainer.scene, trainer.config
    if not trainer.records:
        raise HyrfTrainingError(
            f"{scene.path}: masks leave no pixel of the photos that the {trainer.steps:,} steps came to; "
            "take more steps than there are photos"
        )

    model = _drop_unseen_background(trainer)
    path = out / MODEL
    provenance = {
        "steps": config.steps,
        "seed": config.seed,
        "choices": trainer.choices,
        **provenance_of(scene, mean_exposure=trainer.exposures is not None),
        "psnr": statistics.median(record["psnr"] for record in trainer.records[-len(trainer.records) // 10 :]),
    }
    report = hyrf_format.save(model, path, profile="raw", provenance=provenance)
    metrics = {
        "settings": config.to_dict(),
        "device": describe_device(trainer.device),
        "processes": trainer.ranks.size,
        "scene": {
            "path": scene.path,
            "layout": scene.layout,
            "train": len(scene.train),
            "test": len(scene.test),
            "max_size": scene.max_size,
            "reading": dict(scene.reading),
        },
        "choices": trainer.choices,
        "notes": scene.notes,
        "gaussians": len(model),
        "bytes": report.bytes_after,
        "seconds": trainer.elapsed,
        "steps_per_second": trainer.steps / max(trainer.elapsed, 1e-9),
        "stage_seconds": {name: round(value, 3) for name, value in sorted(trainer.seconds.items())},
        "curve": trainer.records,
    }
    if scene.test:
        # Scored on the file as it was written, not on what is in memory.
        written = hyrf_format.load(path, trainer.device)
        written.precision = config.precision
        scores: Evaluation = evaluate(written, scene.test, training=scene.train, pictures=out / VIEWS)
        metrics["evaluation"] = scores.to_dict()
    training_curve(trainer.records, out / CURVE)
    write_atomic(out / METRICS, json.dumps(metrics, indent=1).encode())
    return metrics


def resuming(overwrite: bool) -> str:
    """The command that goes on with a run which was started with or without --overwrite."""
    return f"the same command with --resume{' instead of --overwrite' if overwrite else ''}"


def _shorter(device: torch.device) -> str:
    """What makes a run take less time."""
    ways = ["fewer --steps", "smaller photos (--max-size, or --images with smaller copies)", "fewer --max-gaussians"]
    if device.type == "cpu":
        ways.append("a GPU")
    return f"{', '.join(ways[:-1])} or {ways[-1]}"


@contextmanager
def _naming_the_checkpoint(trainer: Trainer, overwrite: bool) -> Iterator[None]:
    """Add to an error of reading or writing what is there to go on from."""
    try:
        yield
    except HyrfError as error:
        if isinstance(error, HyrfTrainingError) or trainer.saved is None:
            raise
        raise type(error)(
            f"{error}; the checkpoint of step {trainer.saved:,} is kept, {resuming(overwrite)} goes on from there"
        ) from error


def _prepare(out: Path, scene: Scene, resume: bool, overwrite: bool) -> None:
    if resume and not (out / CHECKPOINT).is_file():
        raise HyrfError(f"{out}: there is no checkpoint to resume; leave out --resume to start a run")
    left = [name for name in (MODEL, CHECKPOINT) if (out / name).exists()]
    if left and not (resume or overwrite):
        hint = "--resume goes on with it, " if CHECKPOINT in left else ""
        raise HyrfError(f"{out}: the folder holds an earlier run ({left[-1]}); {hint}--overwrite replaces it")
    views = [f"{VIEWS}/{name}" for name in picture_names(scene.test).values()]
    outputs = Outputs(scene=scene, overwrite=resume or overwrite)
    outputs.folder(out, [MODEL, CHECKPOINT, METRICS, CURVE, *views])


def _check_photos(scene: Scene, cache: PictureCache) -> None:
    """Refuse now what would else end the run after its last step: held-out photos that cannot be read, and masks that
    leave nothing. Photos to train on are read in the first steps anyway, so that one that can be used is enough."""
    held_out = [is_usable(view.load()) for view in scene.test]
    if held_out and not any(held_out):
        raise _nothing_left(scene, scene.test, "to score")
    if scene.train and not any(is_usable(cache.get(view)) for view in scene.train):
        raise _nothing_left(scene, scene.train, "to train on")


def _nothing_left(scene: Scene, views: list[View], purpose: str) -> HyrfTrainingError:
    return HyrfTrainingError(
        f"{scene.path}: the masks of all {len(views)} photos {purpose} leave no pixel, {views[0].name} for one; check "
        "that white means 'use this pixel'"
    )


@torch.no_grad()
def _drop_unseen_background(trainer: Trainer) -> HybridModel:
    """The model without its background sphere if hardly any light reaches the training cameras from there."""
    model = trainer.model
    if not model.config.background:
        return model
    views = evenly_spaced(trainer.scene.train, 16)
    seen = max(float((1 - render(model, view.camera, background=False).alpha).mean()) for view in views)
    if seen >= BACKGROUND_SEEN:
        trainer.choices["background"] += f"; up to {seen:.1%} of a view's light comes from it"
        return model
    trainer.choices["background"] = f"none: no training view gets more than {BACKGROUND_SEEN:.1%} of its light from it"
    model.config = dataclasses.replace(model.config, background=False)
    return model


@contextmanager
def _stop_requests() -> Iterator:
    """Turns the first Ctrl-C, SIGTERM or SIGHUP into a request to stop; a second one interrupts at once.

    What whoever started us has ignored stays ignored: SIGHUP under nohup, Ctrl-C in the background of a script. A
    second SIGHUP is no news: a terminal that closes sends it by way of the shell and once more itself.
    """
    requested = threading.Event()
    if threading.current_thread() is not threading.main_thread():  # signals belong to the main thread
        yield requested.is_set
        return
    found = {number: signal.getsignal(number) for number in STOPPING}
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

"""Do a complete training run in a folder: check, decide what the settings leave open, train, and write the results."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch

from hyrfpack.checks import check_type
from hyrfpack.config.train import TrainConfig
from hyrfpack.context import RunContext
from hyrfpack.data import PictureCache
from hyrfpack.data.cache import memory_bytes
from hyrfpack.errors import HyrfError, HyrfTrainingError
from hyrfpack.format.run_folder import (
    BLOCKS_JOURNAL_FILE,
    CHECKPOINT_FILE,
    MODEL_FILE,
    PREPARED_FILES,
    is_prepared,
    read_run_status,
)
from hyrfpack.lock import exclusive_folder
from hyrfpack.outputs import Outputs
from hyrfpack.parallel.ranks import SINGLE_PROCESS, Ranks
from hyrfpack.progress import Progress, StepEvent, TaskEvent
from hyrfpack.scene import Scene
from hyrfpack.train.advice import LongRunAdvice
from hyrfpack.train.checkpoint import saved_decisions
from hyrfpack.train.checks import check_folder, check_outputs, check_photos
from hyrfpack.train.decisions import (
    Decisions,
    chosen_steps,
    decide,
    is_budget_open,
    measures_budget,
    measures_exposure,
    measures_length,
    without_pilots,
)
from hyrfpack.train.finish import TrainResult, finish_run
from hyrfpack.train.log import TrainingLog
from hyrfpack.train.pilot_journal import PilotJournal, read_scores
from hyrfpack.train.results import RECORD_FILE, TrainingRecord, read_record, save_model
from hyrfpack.train.setup import check_target
from hyrfpack.train.stop import TrainingStopped, catch_stop_signals
from hyrfpack.train.teachers import TeacherRuns, describe_virtual_views
from hyrfpack.train.trainer import Trainer

__all__ = ["TrainResult", "is_begun", "resuming", "train_model"]

_LOG = logging.getLogger(__name__)

CHOICE_LABELS = {
    "exposure": "exposure compensation",
    "max_gaussians": "Gaussian budget",
    "steps": "number of steps",
}
Observer = Callable[[Trainer], None]


def train_model(
    scene: Scene,
    out: Path | str,
    config: TrainConfig | None = None,
    *,
    resume: bool = False,
    overwrite: bool = False,
    observer: Observer | None = None,
    log: Path | str | None = None,
    context: RunContext = RunContext(),  # noqa: B008 - frozen
) -> TrainResult:
    """Train a model on a scene and write all results of the run into a folder.

    The folder gets `model.hyrf` (profile raw), `metrics.json`, `curve.png`, `views/` (held-out photos beside their
    renders and error maps) and, while running, `checkpoint.pt`. The first Ctrl-C, SIGTERM or SIGHUP (as when the
    terminal is closed) saves the checkpoint and returns, unless the parent process ignores the signal. Before the first
    step, the folder keeps finished pilot runs in `pilots.json`, the checkpoint of one of at least 1,000 steps in
    `pilot.pt`, and finished teacher runs in `teacher-*.hyrf`.

    If a result other than the model cannot be written, the run does not fail. A later call with the same settings, with
    or without `resume`, completes the results without training again. The same holds after an interruption while
    results are written.

    Args:
        scene: the scene, from `hyrfpack.load_scene`.
        out: the run's folder, created if missing.
        config: settings of the run; None for the defaults.
        resume: resume from the folder's checkpoint, pilot or teacher runs, or complete the results of a finished
            model. The result equals that of an uninterrupted run.
        overwrite: replace an earlier run in the folder. Without it, nothing is replaced. If a file appears at a
            result's name during training, the result gets a free name beside it; `TrainResult.model` has the model's.
        observer: called after each step with the trainer, whose model it may read and must not change; after steps of
            pilot and teacher runs, too, whose trainer has the `kind` "pilot run" or "teacher run". Of several processes
            only rank 0 calls it. Its time does not count as training time.
        log: a file that gets a line of JSON every few steps, and TensorBoard files beside it if that is installed; see
            `hyrfpack.train.log.TrainingLog`. A resumed run appends to it.
        context: device, processes, progress and stop. A run may be resumed on another device; on a GPU sums of
            gradients vary in their last bits from run to run, which may change the measured budget. All ranks
            return when the model is written, and only rank 0 returns metrics. If the launcher restarts the processes,
            as torchrun does after one has ended, they resume from any checkpoint. Each step of the run is a
            `StepEvent`; all other work, such as pilot runs, gives `TaskEvent`s.

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
        >>> quiet = hyrfpack.RunContext(progress=None)
        >>> result = hyrfpack.train_model(scene, "runs/first", hyrfpack.TrainConfig(steps=10), context=quiet)
        >>> result.complete, result.step, result.model.name
        (True, 10, 'model.hyrf')
    """
    check_type("scene", scene, Scene)
    out = Path(out)
    config = TrainConfig() if config is None else config
    check_type("config", config, TrainConfig)
    check_target(scene, config)
    ranks = context.ranks or SINGLE_PROCESS
    # This check ignores existing results. It runs first, so that no folder is created where nothing may be written.
    ranks.run_on_main(lambda: check_outputs(out, scene, overwrite=True))
    with exclusive_folder(out, ranks=ranks):
        device = context.choose_device()
        with context.open_progress(interruptible=False) as progress:
            return _Run(
                scene=scene,
                out=out,
                config=config,
                resume=ranks.broadcast(resume or (ranks.restarts > 0 and is_begun(out))),
                overwrite=overwrite,
                observer=observer,
                log=None if log is None else Path(log),
                context=context,
                ranks=ranks,
                device=device,
                cache=context.cache or PictureCache(memory_bytes() // 4 // ranks.local_size),
                progress=progress,
            ).execute()


def remove_run_files(paths: Iterable[Path]) -> None:
    """Remove files of an earlier run, as far as they exist.

    Raises:
        HyrfError: a file cannot be removed.
    """
    for path in paths:
        try:
            with suppress(FileNotFoundError, NotADirectoryError):
                path.unlink()
        except OSError as error:
            raise HyrfError(
                f"{path}: this file of an earlier run cannot be removed ({error.strerror or error})",
                fix="remove it yourself, or choose another folder",
            ) from error


@dataclass(frozen=True)
class _Run:
    """One call of `train_model`, in a folder that it has locked."""

    scene: Scene
    out: Path
    config: TrainConfig
    resume: bool
    overwrite: bool
    observer: Observer | None
    log: Path | None
    context: RunContext
    ranks: Ranks
    device: torch.device
    cache: PictureCache
    progress: Progress

    def execute(self) -> TrainResult:
        """Do what the folder still lacks: train the model, or complete the results of a finished one."""
        record = self.ranks.broadcast(self.ranks.run_on_all(self._check))
        if record is not None:
            return self._complete(record)
        self.ranks.run_on_all(self._remove_earlier_run)
        decisions = self._decide()
        return TrainResult(False, 0, None, {}) if decisions is None else self._train(decisions)

    @property
    def _checkpoint(self) -> Path:
        return self.out / CHECKPOINT_FILE

    def _has_checkpoint(self) -> bool:
        """Return whether the run is resumed from a checkpoint; all ranks must call this."""
        return self.ranks.broadcast(self.resume and self._checkpoint.is_file())

    @property
    def _replaces(self) -> bool:
        """Return whether files in the folder may be replaced."""
        return self.resume or self.overwrite

    def _check(self) -> TrainingRecord | None:
        """Check folder and photos; return the record of a finished model whose results are incomplete."""
        if not self.ranks.is_main:
            return None
        record = read_record(self.out) if self.resume or not self.overwrite else None
        check_folder(self.out, self.scene, self.config, record, resume=self.resume, overwrite=self.overwrite)
        if self.log is not None:
            Outputs(scene=self.scene, overwrite=self._replaces or record is not None).file(self.log)
        if record is None:
            check_photos(self.scene, self.cache, self.progress)
        return record

    def _remove_earlier_run(self) -> None:
        """Remove files of the run that this one replaces, which would be resumed if this one stopped early."""
        if not self.overwrite or self.resume or not self.ranks.is_main:
            return
        remove_run_files(
            self.out / name for name in (RECORD_FILE, BLOCKS_JOURNAL_FILE, CHECKPOINT_FILE, *PREPARED_FILES)
        )

    def _complete(self, record: TrainingRecord) -> TrainResult:
        """Compute and write the missing results of a finished model; only rank 0 does so."""
        if not self.ranks.is_main:
            return TrainResult(True, record.step, self.out / MODEL_FILE, {})
        _LOG.info("the model is already trained; computing its scores and pictures")
        with ExitStack() as stack:
            log = None
            if self.log is not None:
                log = stack.enter_context(TrainingLog(self.log, record.step, record.step, self.device))
            return finish_run(
                record, self.scene, self.out, self.config, self.device, self.progress, log,
                overwrite=True, owns_checkpoint=True,
            )  # fmt: skip

    def _decide(self) -> Decisions | None:
        """Decide what the settings leave open; None if the pilot runs for it were stopped."""
        if self._has_checkpoint():
            saved = self.ranks.run_on_all(self._with_saved_decisions)
            return Decisions(self.ranks.broadcast(saved), {}, [])
        measured = {
            "exposure": measures_exposure(self.scene, self.config),
            "max_gaussians": measures_budget(self.scene, self.config),
            "steps": measures_length(self.scene, self.config),
        }
        if not any(measured.values()):
            return without_pilots(self.config)
        if self.ranks.is_main:
            labels = [CHOICE_LABELS[choice] for choice, is_measured in measured.items() if is_measured]
            _LOG.info(f"pilot runs, scored on validation photos, choose: {', '.join(labels)}")
        known = self.ranks.broadcast(read_scores(self.out) if self.resume and self.ranks.is_main else {})
        # With several processes, pilots have no checkpoints: one process would resume from it, and wait for the others.
        journal = PilotJournal(self.out if self.ranks.is_main else None, known, checkpoints=self.ranks.is_single)
        with catch_stop_signals(self.context.stop) as stop:
            # Every rank runs all pilots, so that no rank waits for another.
            observer = self.observer if self.ranks.is_main else None
            pilots = partial(
                decide, self.scene, self.config, self.cache, self.device, self.progress, stop, observer, journal
            )
            answers = self.ranks.all_gather(self.ranks.run_on_all(pilots))
        return None if None in answers else answers[0]

    def _with_saved_decisions(self) -> TrainConfig:
        """Return the settings; on rank 0 completed by the decisions that the interrupted run made for them."""
        config = self.config
        if not self.ranks.is_main:
            return config
        saved = saved_decisions(self._checkpoint)
        factor = saved.budget_factor if is_budget_open(config) else config.budget_factor
        exposure = saved.exposure if config.exposure is None else config.exposure
        steps = chosen_steps(self.scene, config, saved.steps, saved.asked_steps)
        return dataclasses.replace(config, budget_factor=factor, exposure=exposure, steps=steps)

    def _set_up(self, decisions: Decisions) -> Trainer | None:
        """Return the trainer, at the step of its checkpoint if there is one; None if teacher runs were stopped."""
        with catch_stop_signals(self.context.stop) as stop:
            teachers = TeacherRuns(
                self.scene, decisions.config, self.out, self.resume, self.cache, self.device, self.ranks, self.progress,
                stop, self.observer if self.ranks.is_main else None,
            )  # fmt: skip
            try:
                virtual = teachers.virtual_views()
            except TrainingStopped:
                return None
            if virtual and any(self.ranks.all_gather(stop())):  # The last teacher was finished nevertheless.
                return None
        self.progress(TaskEvent("reading photos and setting up the model"))
        trainer = self.ranks.run_on_all(
            lambda: Trainer(self.scene, decisions.config, self.cache, self.device, ranks=self.ranks, virtual=virtual)
        )
        if virtual:
            trainer.choices["virtual_views"] = describe_virtual_views(len(virtual))
        for choice, reason in decisions.reasons.items():
            trainer.choices[choice] = "; ".join(filter(None, (trainer.choices.get(choice), reason)))
        trainer.pilots = [dataclasses.asdict(score) for score in decisions.scores]
        if self._has_checkpoint():
            trainer.load(self._checkpoint)
        return trainer

    def _train(self, decisions: Decisions) -> TrainResult:
        """Train, and on rank 0 write the model and the results."""
        trainer = self._set_up(decisions)
        if trainer is None:
            step = read_run_status(self.out).step if self._has_checkpoint() else None
            return TrainResult(False, step or 0, None, {})
        with ExitStack() as stack:
            with _checkpoint_named_in_errors(trainer, self.overwrite):
                if self.ranks.is_main:
                    for choice in decisions.reasons:
                        label = CHOICE_LABELS[choice]
                        _LOG.info(f"{label[0].upper()}{label[1:]}: {trainer.choices[choice]}")
                log = None
                if self.log is not None and self.ranks.is_main:
                    log = stack.enter_context(
                        TrainingLog(self.log, trainer.steps, trainer.step, self.device, self._replaces)
                    )
                complete = self._take_steps(trainer, log)
                if not complete:
                    if log is not None:
                        log.end(complete=False, step=trainer.step)
                    return TrainResult(False, trainer.step, None, {})
                # The other processes wait, because their callers may read the model.
                record = self.ranks.run_on_main(
                    partial(save_model, trainer, self.out, self.progress, overwrite=self._replaces)
                )
            if not self.ranks.is_main:
                return TrainResult(True, record.step, self.out / record.model, {})
            config, owns_checkpoint = trainer.config, self._replaces or trainer.saved is not None
            del trainer  # Its memory is free while results are written, and no frame that others keep holds it.
            return finish_run(
                record, self.scene, self.out, config, self.device, self.progress, log,
                overwrite=self._replaces, owns_checkpoint=owns_checkpoint,
            )  # fmt: skip

    def _take_steps(self, trainer: Trainer, log: TrainingLog | None) -> bool:
        """Take all remaining steps, or those until a request to stop; return whether the run is complete."""
        self.progress(TaskEvent("preparing the first step"))
        reports: list[Callable[[StepEvent], None]] = [self.progress]
        if log is not None:
            reports.append(log.step)
        if self.context.is_shown:
            reports.append(LongRunAdvice(trainer.step, self.device).step)

        def report_step(event: StepEvent) -> None:
            for report in reports:
                report(event)
            if self.observer is not None and self.ranks.is_main:
                self.observer(trainer)

        with catch_stop_signals(self.context.stop) as stop:
            return trainer.run(checkpoint=self._checkpoint, progress=report_step, stop=stop, overwrite=self._replaces)


def is_begun(out: Path) -> bool:
    """Return whether a run in the folder can be resumed, or a model that lacks results can be completed."""
    return (out / CHECKPOINT_FILE).is_file() or is_prepared(out) or read_record(out) is not None


def resuming(overwrite: bool) -> str:
    """Describe, as words of a sentence, how to resume a run that was started with or without `overwrite`."""
    return f"the same command with `resume=True`{' instead of `overwrite=True`' if overwrite else ''}"


def without_resume_hint(error: HyrfError) -> HyrfError:
    """Return an error of `train_model` as it was before a hint how to resume the run was added to its fix."""
    cause = error.__cause__
    return cause if isinstance(cause, HyrfError) and not isinstance(error, HyrfTrainingError) else error


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

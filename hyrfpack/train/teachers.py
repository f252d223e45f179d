"""Teacher runs: short runs on few photos, before the run itself, whose renders are its virtual views."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable
from pathlib import Path

import torch

from hyrfpack import format as hyrf_format
from hyrfpack.atomic import write_atomic
from hyrfpack.config.settings import LARGEST_SEED
from hyrfpack.config.train import TrainConfig
from hyrfpack.data import PictureCache
from hyrfpack.errors import HyrfError
from hyrfpack.format.codec import decode_model, load_with_provenance
from hyrfpack.format.run_folder import TEACHER_FILES
from hyrfpack.model import HybridModel
from hyrfpack.parallel.ranks import Ranks
from hyrfpack.progress import Progress, StepEvent, TaskEvent
from hyrfpack.scene import Scene, View
from hyrfpack.train.pilot_journal import pilot_key
from hyrfpack.train.resolution import PhotoSize
from hyrfpack.train.setup import check_has_photos, usual_steps
from hyrfpack.train.stop import TrainingStopped
from hyrfpack.train.trainer import Trainer
from hyrfpack.train.virtual_views import render_virtual_views

_LOG = logging.getLogger(__name__)

TEACHER_STEPS = 1_000
MAX_VIRTUAL_VIEW_PHOTOS = 16  # With 25, the mean gain is 0.1 dB (docs/research/few-photos.md).
MIN_VIRTUAL_VIEW_PHOTOS = 2  # Virtual views lie between two cameras.
TEACHER_TASK_PREFIX = "teacher run"


def count_teachers(photos: int, size: PhotoSize, config: TrainConfig) -> int:
    """Return the number of teacher runs before a run; 0 if it has none.

    A run has teachers if its settings ask for virtual views, its photos are few, and it takes at least `usual_steps`.
    For a shorter one, they would take most of the time.

    Args:
        photos: number of training photos.
        size: their size.
        config: settings of the run.
    """
    are_few = MIN_VIRTUAL_VIEW_PHOTOS <= photos <= MAX_VIRTUAL_VIEW_PHOTOS
    has_virtual_views = config.virtual_views and are_few and config.steps >= usual_steps(size.pixels)
    return len(TEACHER_FILES) * has_virtual_views


def describe_virtual_views(count: int) -> str:
    """Describe so many virtual views in words, for the run's record."""
    return f"{count}, the mean render of {len(TEACHER_FILES)} runs of {TEACHER_STEPS:,} steps"


@dataclasses.dataclass(frozen=True)
class TeacherRuns:
    """Trains the teachers of a run, or reads those that an interrupted run has left in its folder.

    Attributes:
        scene, config: photos and settings of the run, with all decisions.
        out: the run's folder, where finished teachers are kept until the run ends.
        resume: whether the run is resumed, so that teachers in the folder are those of its first part.
        cache, device, ranks: as `Trainer` takes them.
        progress: called with `TaskEvent`s.
        stop: called after each step; True ends the runs.
        observer: called after each step with the trainer of the teacher run.
    """

    scene: Scene
    config: TrainConfig
    out: Path
    resume: bool
    cache: PictureCache
    device: torch.device
    ranks: Ranks
    progress: Progress
    stop: Callable[[], bool]
    observer: Callable[[Trainer], None] | None

    def virtual_views(self) -> list[View]:
        """Return the virtual views of the run; none if it has no teachers (`count_teachers`).

        Raises:
            TrainingStopped: `stop` returned True.
            HyrfError: as `Trainer.run`.
        """
        check_has_photos(self.scene)
        if not count_teachers(len(self.scene.train), PhotoSize.of_views(self.scene.train), self.config):
            return []
        teachers = [self._teacher(number).to(self.device) for number in range(len(TEACHER_FILES))]
        self.progress(TaskEvent("rendering virtual views"))
        return render_virtual_views(teachers, [view.camera for view in self.scene.train], self.config.seed)

    def _teacher(self, number: int) -> HybridModel:
        """Return a teacher, from the folder or newly trained."""
        settings = dataclasses.replace(
            self.config,
            steps=TEACHER_STEPS,
            seed=(self.config.seed + 1 + number) % (LARGEST_SEED + 1),  # other ones than that of the run
        )
        key, path = pilot_key(settings, self.config.steps, self.scene.train), self.out / TEACHER_FILES[number]
        data = self.ranks.broadcast(_read_teacher(path, key) if self.resume and self.ranks.is_main else None)
        if data is None:
            trained = self._train(number, settings)
            data = self.ranks.broadcast(self.ranks.run_on_main(lambda: _write_teacher(path, key, trained)))
        return decode_model(data)

    def _train(self, number: int, settings: TrainConfig) -> HybridModel:
        """Train a teacher."""
        count = len(TEACHER_FILES)
        name = f"{TEACHER_TASK_PREFIX} {number + 1}/{count}"
        self.progress(TaskEvent(f"{name}: reading photos"))
        trainer = self.ranks.run_on_all(
            lambda: Trainer(self.scene, settings, self.cache, self.device, ranks=self.ranks)
        )
        trainer.kind = "teacher run"

        def report_step(event: StepEvent) -> None:
            share = (number + event.step / event.steps) / count
            self.progress(TaskEvent(f"{name}: training", share, event.step, event.steps))
            if self.observer is not None:
                self.observer(trainer)

        if not trainer.run(progress=report_step, stop=self.stop):
            raise TrainingStopped
        return trainer.model


def _read_teacher(path: Path, key: str) -> bytes | None:
    """Return the file of a teacher; None if there is none with this key, or it is damaged."""
    try:
        _, provenance = load_with_provenance(path)
        return path.read_bytes() if provenance.get("teacher") == key else None
    except (HyrfError, OSError):
        return None


def _write_teacher(path: Path, key: str, model: HybridModel) -> bytes:
    """Write the file of a teacher, and return its bytes. If it cannot be written, a warning is logged."""
    data = hyrf_format.encode_model(model, "raw", {"teacher": key})
    try:
        write_atomic(path, data)
    except HyrfError as error:
        _LOG.warning(f"{error}; training continues, and would repeat this teacher run if it were interrupted")
    return data

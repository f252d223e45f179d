"""A first look: a coarse model of reduced photos, which an observer shows while the exact poses are not yet known."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

from hyrfpack.config.poses import PosesConfig
from hyrfpack.config.train import TrainConfig
from hyrfpack.context import RunContext
from hyrfpack.data import load_scene
from hyrfpack.data.folder import first_readable_photo, list_photos, read_photo_facts
from hyrfpack.data.pictures import fit_size, read_pixels
from hyrfpack.errors import HyrfDataError
from hyrfpack.logs import log_only_errors_of
from hyrfpack.parallel.threads import thread_count
from hyrfpack.progress import Event, Progress, StepEvent, TaskEvent
from hyrfpack.scene import evenly_spaced
from hyrfpack.train import Trainer

_LOG = logging.getLogger(__name__)

MAX_PHOTO_SIZE = 480  # longer side in pixels of the reduced photos
MIN_REDUCTION_RATIO = 1.5  # the exact poses of photos that are less than this many times as large take little longer
MAX_PHOTOS = 40
FIRST_LOOK_STEPS = 200


def show_first_look(
    source: Path,
    folder: Path,
    config: PosesConfig,
    observer: Callable[[Trainer], None],
    context: RunContext,
) -> None:
    """Train a coarse model on reduced photos, and call an observer after each step.

    The poses of at most MAX_PHOTOS evenly spaced photos, reduced to MAX_PHOTO_SIZE pixels, are estimated for it. Photos
    that are hardly larger than that get no first look, because their exact poses are soon known. A failure is logged
    and otherwise ignored, because the exact estimation reports what is wrong with the photos.

    Args:
        source: folder of photos, or a video.
        folder: folder of intermediate results, replaced, and deleted at the end.
        config: settings of the pose estimation.
        observer: called with the trainer after each step; the trainer's `kind` is "first look".
        context: device, progress and cache.
    """
    assert callable(context.progress)
    progress = _prefix_events(context.progress)
    context = replace(context, progress=progress)
    shutil.rmtree(folder, ignore_errors=True)
    try:
        with log_only_errors_of("hyrfpack.poses"):  # the exact estimation logs the same notes again
            photos = _extract_frames(source, folder / "frames", progress) if source.is_file() else source
            if not _reduce_photos(photos, folder / "photos"):
                return
            _train_coarse_model(folder, config, observer, context)
    except Exception as error:  # the scene can be made without a first look, whatever went wrong
        _LOG.info(f"the first look is skipped: {str(error) or type(error).__name__}")
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _extract_frames(video: Path, folder: Path, progress: Progress) -> Path:
    """Write the chosen frames of a video into a new folder, and return the folder."""
    from hyrfpack.poses.frames import choose_frames

    choose_frames(video, folder, max_frames=MAX_PHOTOS, progress=progress)
    return folder


def _reduce_photos(source: Path, folder: Path) -> bool:
    """Write reduced copies of evenly spaced photos into a new folder, and return whether they were written.

    Nothing is written if the photos are hardly larger than their copies would be.
    """
    photos = list_photos(source)
    first = first_readable_photo(photos)
    if first is None or max(first.size) < MIN_REDUCTION_RATIO * MAX_PHOTO_SIZE:
        return False
    selected = evenly_spaced(photos, MAX_PHOTOS)
    targets = [folder / path.parent.relative_to(source) / f"{n:04}.jpg" for n, path in enumerate(selected)]
    for parent in {target.parent for target in targets}:
        parent.mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor(thread_count()) as pool:
        list(pool.map(_reduce_photo, selected, targets))
    return True


def _reduce_photo(path: Path, target: Path) -> None:
    """Write an upright, reduced copy of a photo, unless the photo cannot be read."""
    from PIL import Image

    try:
        facts = read_photo_facts(path)
        pixels, _ = read_pixels(path, fit_size(*facts.size, MAX_PHOTO_SIZE), facts.orientation)
    except HyrfDataError:
        return
    Image.fromarray(pixels).save(target, quality=95)


def _train_coarse_model(
    folder: Path, config: PosesConfig, observer: Callable[[Trainer], None], context: RunContext
) -> None:
    """Estimate the poses of `folder`/photos into `folder`/scene, and train a model on it."""
    from hyrfpack.poses import estimate_poses

    estimate_poses(folder / "photos", folder / "scene", config, context=context)
    scene = load_scene(folder / "scene", test_every=0)
    settings = TrainConfig(steps=FIRST_LOOK_STEPS, seed=config.seed, exposure=False)
    trainer = Trainer(scene, settings, context.cache, context.choose_device())
    trainer.kind = "first look"

    def report_step(event: StepEvent) -> None:
        assert callable(context.progress)
        context.progress(TaskEvent("training", done=event.step, total=event.steps))
        observer(trainer)

    trainer.run(progress=report_step)


def _prefix_events(progress: Progress) -> Progress:
    """Return a progress function that names tasks as parts of the first look and drops their shares."""

    def report(event: Event) -> None:
        if isinstance(event, TaskEvent):
            progress(replace(event, task=f"first look: {event.task}", share=None))

    return report

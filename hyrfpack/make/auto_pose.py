"""Poses on the way to a training run of one's own: `hyrfpack train --poses`."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from hyrfpack.errors import HyrfError
from hyrfpack.format.run_folder import CHECKPOINT_FILE, METRICS_FILE, MODEL_FILE
from hyrfpack.lock import exclusive_folder
from hyrfpack.make.progress import Progress, Reporter
from hyrfpack.make.source import Reading, Source
from hyrfpack.make.stages import SCENE, is_posed
from hyrfpack.make.work import Say, interruptible


def posed(
    photos: Path,
    run: Path,
    *,
    images: str | None = None,
    resume: bool = False,
    overwrite: bool = False,
    report: Callable[[Progress], None] | None = None,
    say: Say = lambda sentence: None,
) -> Path:
    """A scene of photos without poses in the folder of a run, estimated, or as an earlier call left it.

    Args:
        photos: a folder of them or its .zip, or a video.
        run: the run's folder; the scene is `scene/` in it.
        images: folder of them to use.
        resume: the run is gone on with.
        overwrite: poses that are there are estimated anew.
        report: told how far the work is.
        say: told what is going on.

    Raises:
        HyrfError: nothing may or can be written there, another call is at work there, a run is there, or poses cannot
            be estimated.
        KeyboardInterrupt: it was interrupted; the same call goes on.
    """
    scene, source = run / SCENE, Source.of(photos, Reading(images))
    _check(source, run, overwrite=True)
    if Path(os.path.realpath(run)).is_relative_to(os.path.realpath(source.path)):
        raise HyrfError(f"{run}: the run would lie among the photos; name another folder")
    with exclusive_folder(run):
        _check(source, run, overwrite=overwrite or resume)
        _estimate(source.path, scene, overwrite, report, say)
    return scene


def _check(source: Source, run: Path, *, overwrite: bool) -> None:
    for outputs in source.outputs(overwrite):
        outputs.folder(run, [MODEL_FILE, CHECKPOINT_FILE, METRICS_FILE])


def _estimate(photos: Path, scene: Path, overwrite: bool, report: Callable[[Progress], None] | None, say: Say) -> None:
    """Estimate poses into the folder of a scene, unless they are there."""
    from hyrfpack.poses import estimate_poses

    if is_posed(scene) and not overwrite:
        say(f"poses are taken from {scene}, where they were estimated before; `overwrite=True` estimates them anew")
        return
    reporter = Reporter(["poses"], report)
    reporter.begin("poses")
    with interruptible():
        estimate_poses(photos, scene, overwrite=overwrite, report=reporter.tell, say=say)

"""Estimate missing poses before a training run, for `hyrfpack train --poses`."""

from __future__ import annotations

import logging
import os
from contextlib import suppress
from pathlib import Path

from hyrfpack.atomic import write_atomic
from hyrfpack.context import RunContext
from hyrfpack.errors import HyrfError
from hyrfpack.format.run_folder import CHECKPOINT_FILE, METRICS_FILE, MODEL_FILE
from hyrfpack.lock import exclusive_folder
from hyrfpack.make.source import LoadSettings, Source
from hyrfpack.make.stage_cache import interruptible
from hyrfpack.make.stages import SCENE_FOLDER, is_posed
from hyrfpack.make.state import files_digest

# This file in the scene's folder holds the digest of the photos from which its poses were estimated.
SOURCE_DIGEST_NAME = "photos.digest"
_LOG = logging.getLogger(__name__)


def auto_pose(
    photos: Path,
    run: Path,
    *,
    images: str | None = None,
    resume: bool = False,
    overwrite: bool = False,
    context: RunContext = RunContext(),  # noqa: B008 - frozen
) -> Path:
    """Estimate the poses of photos and write the scene into the folder of a training run.

    Poses that an earlier call has estimated from the same photos are reused.

    Args:
        photos: a folder of photos, its .zip, or a video.
        run: folder of the run; the scene is written to `scene/` in it.
        images: sub-folder of the photos to use.
        resume: the run is resumed, so the folder may already hold a run.
        overwrite: estimate the poses again if the scene has some.
        context: progress and stop.

    Returns:
        The folder of the scene.

    Raises:
        HyrfError: the folder may not or cannot be written, is in use by another call, holds a run, or holds poses of
            other or unknown photos; or the poses cannot be estimated.
        KeyboardInterrupt: the estimation was interrupted; the same call resumes it.
    """
    scene, source = run / SCENE_FOLDER, Source.from_path(photos, LoadSettings(images))
    _check_run_folder(source, run, overwrite=True)
    if Path(os.path.realpath(run)).is_relative_to(os.path.realpath(source.path)):
        raise HyrfError(
            f"{run}: the folder of the run would lie among the photos", fix="choose a folder that is not among them"
        )
    with exclusive_folder(run):
        _check_run_folder(source, run, overwrite=overwrite or resume)
        _estimate_unless_posed(source, scene, overwrite, context)
    return scene


def _check_run_folder(source: Source, run: Path, *, overwrite: bool) -> None:
    """Check that the run's folder may be written. Raises HyrfError: it is a folder of the source, or holds a run."""
    source.output_rules(overwrite).folder(run, [MODEL_FILE, CHECKPOINT_FILE, METRICS_FILE])


def _estimate_unless_posed(source: Source, scene: Path, overwrite: bool, context: RunContext) -> None:
    """Estimate poses and write them into the folder of a scene, unless it has poses and `overwrite` is not set.

    Raises:
        HyrfError: the poses there are of other or unknown photos, or the poses cannot be estimated.
    """
    from hyrfpack.poses import estimate_poses

    digest, record = files_digest(source.files(), source.path).encode(), scene / SOURCE_DIGEST_NAME
    was_posed = is_posed(scene)
    if was_posed and not overwrite:
        _check_source_digest(scene, digest)
        _LOG.info(
            f"reusing the poses in {scene}, which an earlier call estimated; `overwrite=True` estimates them again"
        )
        return
    # The process may be killed at any time, and finished poses must never lie beside the digest of other photos. New
    # poses therefore find their digest in place, and poses that are replaced lose theirs first.
    replaced_digest = _read_source_digest(scene) if was_posed else None
    with interruptible():
        if was_posed:
            record.unlink(missing_ok=True)
        else:
            write_atomic(record, digest)
        try:
            estimate_poses(source.path, scene, overwrite=overwrite, context=context)
        except HyrfError:
            if replaced_digest is not None and is_posed(scene):  # the old poses are still in place
                write_atomic(record, replaced_digest)
            elif not was_posed:
                with suppress(OSError):  # the folder stays if it holds other files
                    record.unlink(missing_ok=True)
                    scene.rmdir()
            raise
        if was_posed:
            write_atomic(record, digest)


def _read_source_digest(scene: Path) -> bytes | None:
    """Return the digest of the photos from which the poses of a scene were estimated; None if it cannot be read."""
    try:
        return (scene / SOURCE_DIGEST_NAME).read_bytes()
    except OSError:
        return None


def _check_source_digest(scene: Path, digest: bytes) -> None:
    """Check that the poses of a scene were estimated from the photos with this digest.

    Raises:
        HyrfError: they were not, or it is not known.
    """
    recorded = _read_source_digest(scene)
    if recorded is None:
        raise HyrfError(
            f"{scene}: there are poses, but no record ({SOURCE_DIGEST_NAME}) of the photos that they belong to",
            fix="train on this folder, or estimate the poses again with `overwrite=True`",
        )
    if recorded != digest:
        raise HyrfError(
            f"{scene}: these poses were estimated from other photos, or the photos have changed",
            fix="choose another folder, or estimate them again with `overwrite=True`",
        )

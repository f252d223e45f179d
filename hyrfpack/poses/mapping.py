"""The two mappers: one that poses photos one after the other, one that poses all at once."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pycolmap

from hyrfpack.poses.database import FOUND, Cameras, recalibrate
from hyrfpack.poses.job import Job
from hyrfpack.poses.process import Tell
from hyrfpack.poses.watch import watching_global_mapper

_ROUNDS = (
    3  # of posing all photos at once, each from another start and with the focal lengths that the one before found
)
_MOVED = 0.01  # of a focal length: less needs no other round
_HELD = 20  # points that hold a photo which is added; pycolmap's own 30 leaves out many small photos
_UNLIKELY = 0.35, 4.0  # focal lengths in longer sides that a mapper has lost its way with
THREADS = 1  # of the solver: sums over several vary in their last bits from run to run
SMALLEST = 3  # photos of a piece


def map_globally(job: Job, tell: Tell) -> dict[str, Any]:
    """Pose all photos at once (GLOMAP), several times, and keep all results.

    Pairs of photos are verified with a focal length, and what is verified decides what focal length comes out. So where
    it moved, the pairs are verified anew with the new one. Each run starts elsewhere (places are random at first): in a
    set of two parts that little joins, some runs end with the parts lying wrong to each other.
    """
    names = []
    for turn in range(_ROUNDS):
        name = f"global-{turn}"
        if not job.model(name).exists():
            doing = f"posing all photos at once, run {turn + 1} of {_ROUNDS}"
            tell(doing, turn / _ROUNDS)
            seed, options = (job.seed + turn) % 2**31, pycolmap.GlobalPipelineOptions()
            options.random_seed = options.mapper.random_seed = seed
            options.num_threads = options.mapper.num_threads = THREADS
            options.mapper.global_positioning.random_seed = options.mapper.rotation_averaging.random_seed = seed
            options.min_num_matches, options.min_model_size = FOUND, SMALLEST
            log, told = job.work / "global.log", _within(tell, turn, 0.0, 0.8)
            with _logging_info(), watching_global_mapper(log, doing, told):
                found = pycolmap.global_mapping(job.database, job.images, _scratch(job), options)
            _keep(job, name, found)
        names.append(name)
        pieces = read_pieces(job.model(name))
        if pieces and turn < _ROUNDS - 1:
            recalibrate(job, f"{name}.focal", partial(_better_cameras, pieces[0]), _within(tell, turn, 0.6, 1.0))
    return {"models": names}


def _within(tell: Tell, turn: int, first: float, last: float) -> Tell:
    """Progress of a part of one run, which begins and ends at these shares of that run, as progress of all runs."""
    return lambda doing, share: tell(doing, (turn + first + (last - first) * share) / _ROUNDS)


@contextmanager
def _logging_info() -> Iterator[None]:
    """Have the library write the phases of its work into the log."""
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = 0
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before


def map_incrementally(job: Job, tell: Tell) -> dict[str, Any]:
    """Pose photos one after the other.

    Where the other mapper found poses, its cameras are taken as they are: refined while there are few photos, focal
    lengths can run away. What is chosen in the end is refined with them.
    """
    name = "incremental"
    if not job.model(name).exists():
        options = pycolmap.IncrementalPipelineOptions()
        options.random_seed, options.num_threads = job.seed % 2**31, THREADS
        options.min_num_matches, options.min_model_size = FOUND, SMALLEST
        options.extract_colors = False
        options.mapper.abs_pose_min_num_inliers = _HELD
        if any(read_pieces(folder) for folder in job.work.glob("global-?")):
            options.ba_refine_focal_length = options.ba_refine_extra_params = False
            options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
        count = len(job.names)
        tell(f"posing photos one by one, choosing the first 2 of {count:,}", 0.0)
        pieces = pycolmap.incremental_mapping(
            job.database, job.images, _scratch(job), options, next_image_callback=_photo_counter(count, tell)
        )
        _keep(job, name, pieces)
    return {"models": [name]}


def _photo_counter(count: int, tell: Tell) -> Callable[[], None]:
    """What the incremental mapper calls after each photo. Its end is not known: photos may stay without a pose, and
    what it gives up is begun anew, so that the share stays below 1."""
    posed = 2  # that it begins with

    def next_photo() -> None:
        nonlocal posed
        posed += 1
        tell(f"posing photos one by one, {min(posed, count):,} of {count:,} posed", 0.95 * min(posed / count, 1.0))

    return next_photo


def go_on(job: Job, model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """Complete a reconstruction: more points, more photos where they fit, and all refined together."""
    start, scratch = job.work / "start", _scratch(job)
    shutil.rmtree(start, ignore_errors=True)
    start.mkdir()
    model.write(start)
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed, options.num_threads = job.seed % 2**31, THREADS
    options.min_num_matches = FOUND
    options.multiple_models = options.extract_colors = False
    pieces = pycolmap.incremental_mapping(job.database, job.images, scratch, options, input_path=start)
    shutil.rmtree(start, ignore_errors=True)
    return max(pieces.values(), key=lambda piece: piece.num_reg_images(), default=model)


def add_points(job: Job, model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """A copy with the points, too, that only two photos see: training starts from twice as many."""
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed, options.num_threads = job.seed % 2**31, THREADS
    options.min_num_matches = FOUND
    options.triangulation.ignore_two_view_tracks = False
    options.extract_colors = False
    return pycolmap.triangulate_points(
        pycolmap.Reconstruction(model), job.database, job.images, _scratch(job), clear_points=False, options=options
    )


def read_pieces(folder: Path) -> list[pycolmap.Reconstruction]:
    """The pieces that a mapper left, the one with the most photos first; none where the mapper was not run."""
    if not folder.is_dir():
        return []
    pieces = [pycolmap.Reconstruction(piece) for piece in sorted(folder.iterdir()) if piece.is_dir()]
    return sorted(pieces, key=lambda piece: -piece.num_reg_images())


def _better_cameras(model: pycolmap.Reconstruction, cameras: Cameras) -> Cameras:
    """The cameras of a model whose focal length is likely and not what was known."""
    better = {}
    for number, camera in model.cameras.items():
        focal, longer = camera.focal_length, max(camera.width, camera.height)
        likely = _UNLIKELY[0] < focal / longer < _UNLIKELY[1] and not camera.has_bogus_params(0.1, 10.0, 1.0)
        if likely and abs(focal / cameras[number].focal_length - 1) > _MOVED:
            better[number] = camera
    return better


def _scratch(job: Job) -> Path:
    folder = job.work / "scratch"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    return folder


def _keep(job: Job, name: str, pieces: dict[int, pycolmap.Reconstruction]) -> None:
    """Save all pieces of a mapper at once."""
    folder = _scratch(job)
    for number, piece in pieces.items():
        (folder / str(number)).mkdir()
        piece.write(folder / str(number))
    os.replace(folder, job.model(name))

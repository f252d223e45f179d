"""Run COLMAP's two mappers: incremental and global structure from motion.

A mapper's result consists of pieces: models of photos that are connected by matches, each in a frame of its own.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from hyrfpack.poses.alignment import Poses
from hyrfpack.poses.choose import confirm_each_other
from hyrfpack.poses.database import MIN_PAIR_MATCHES, Cameras, recalibrate
from hyrfpack.poses.job import Job
from hyrfpack.poses.watch import report_global_mapping_phase
from hyrfpack.progress import Progress, TaskEvent, part_of_progress

_GLOBAL_RUNS = 3  # each run starts from other random positions, with the focal lengths that the previous run found
# Pairs are verified again if the mapper changes the focal length by more than this ratio.
_MAPPED_FOCAL_CHANGE_RATIO = 0.01
_MIN_POSE_INLIERS = 20  # pycolmap's own limit of 30 points leaves out many small photos
# A focal length outside these ratios of the longer side means that the mapper has failed.
_MIN_FOCAL_RATIO = 0.35
_MAX_FOCAL_RATIO = 4.0
SOLVER_THREADS = 1  # sums over several threads differ in their last bits from run to run
MIN_PIECE_PHOTOS = 3


def map_globally(job: Job, report_progress: Progress) -> dict[str, Any]:
    """Run the global mapper (GLOMAP) once, and verify all pairs again if it changes a focal length.

    Args:
        job: the estimation.
        report_progress: see `run_stage`.

    Returns:
        "models": the name of the result.
    """
    _run_global_mapper(job, 0, "global", report_progress)
    return {"models": [_global_name(0)]}


def repeat_mapping(job: Job, report_progress: Progress) -> dict[str, Any]:
    """Run the global mapper again from other random positions, and the incremental mapper if focal lengths change.

    Verified pairs depend on the focal length they were verified with, and the resulting focal length depends on the
    verified pairs. So the pairs are verified again if a run changes the focal length. Each run starts from other random
    positions, because some runs misplace two weakly connected parts of a set relative to each other.

    Args:
        job: the estimation.
        report_progress: see `run_stage`.

    Returns:
        "models": the names of the further results.
    """
    repeats = range(1, _GLOBAL_RUNS)
    names, is_recalibrated = [], False
    for index, run_index in enumerate(repeats):
        report_run = part_of_progress(report_progress, index / _GLOBAL_RUNS, (index + 1) / _GLOBAL_RUNS)
        is_recalibrated |= _run_global_mapper(job, run_index, "repeat", report_run)
        names.append(_global_name(run_index))
    if is_recalibrated:
        report_run = part_of_progress(report_progress, len(repeats) / _GLOBAL_RUNS, 1.0)
        names.append(_run_incremental_mapper(job, 1, report_run))
    return {"models": names}


def _global_name(run_index: int) -> str:
    """Return the name of the result of a run of the global mapper."""
    return f"global-{run_index}"


def _run_global_mapper(job: Job, run_index: int, stage: str, report_progress: Progress) -> bool:
    """Run the global mapper with the random positions of run `run_index`, unless its result exists.

    If the run changes a focal length, the pairs are verified again with it, except after the last run.

    Args:
        job: the estimation.
        run_index: index of the run, which determines its random positions.
        stage: name of the stage, into whose log pycolmap writes.
        report_progress: called with `TaskEvent`s, whose share is that of this run.

    Returns:
        Whether pairs were verified again.
    """
    name = _global_name(run_index)
    if not job.model_folder(name).exists():
        task = f"global mapping, run {run_index + 1}/{_GLOBAL_RUNS}" if run_index else "global mapping"
        report_progress(TaskEvent(task, 0.0))
        seed, options = (job.seed + run_index) % 2**31, pycolmap.GlobalPipelineOptions()
        options.random_seed = options.mapper.random_seed = seed
        options.num_threads = options.mapper.num_threads = SOLVER_THREADS
        options.mapper.global_positioning.random_seed = options.mapper.rotation_averaging.random_seed = seed
        options.min_num_matches, options.min_model_size = MIN_PAIR_MATCHES, MIN_PIECE_PHOTOS
        log, report_mapping = job.work / f"{stage}.log", part_of_progress(report_progress, 0.0, 0.8)
        with _info_log_level(), report_global_mapping_phase(log, task, report_mapping):
            mapped = pycolmap.global_mapping(job.database_path, job.images, _make_scratch_folder(job), options)
        _save_pieces(job, name, mapped)
    pieces = read_pieces(job.model_folder(name))
    if not pieces or run_index == _GLOBAL_RUNS - 1:
        return False
    select_better = partial(_select_better_cameras, pieces[0])
    return recalibrate(job, f"{name}.focal", select_better, part_of_progress(report_progress, 0.6, 1.0))


@contextmanager
def _info_log_level() -> Iterator[None]:
    """Let pycolmap write the phases of its work into the log while the block runs."""
    previous_level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = 0
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = previous_level


def map_incrementally(job: Job, report_progress: Progress) -> dict[str, Any]:
    """Run the incremental mapper, and compare its result with that of the global mapper.

    Args:
        job: the estimation.
        report_progress: see `run_stage`.

    Returns:
        "models": the name of the result. "agrees": whether the global mapper's first run has the same poses.
    """
    name = _run_incremental_mapper(job, 0, report_progress)
    first, second = (_read_result(job, result) for result in (_global_name(0), name))
    matched = json.loads(job.matches_path.read_text())["matched"]
    return {"models": [name], "agrees": confirm_each_other(first, second, len(matched))}


def _read_result(job: Job, name: str) -> list[Poses]:
    """Return the poses of each piece of a mapper's result, the largest piece first."""
    return [read_poses(job, piece) for piece in read_pieces(job.model_folder(name))]


def _run_incremental_mapper(job: Job, run_index: int, report_progress: Progress) -> str:
    """Run the incremental mapper, which poses photos one after the other, unless its result exists; return its name.

    If the global mapper found poses, its cameras are kept fixed here, because focal lengths can diverge when they are
    refined with few photos. The result that is chosen in the end is refined together with its cameras.
    """
    name = f"incremental-{run_index}"
    if not job.model_folder(name).exists():
        options = pycolmap.IncrementalPipelineOptions()
        options.random_seed, options.num_threads = job.seed % 2**31, SOLVER_THREADS
        options.min_num_matches, options.min_model_size = MIN_PAIR_MATCHES, MIN_PIECE_PHOTOS
        options.extract_colors = False
        options.mapper.abs_pose_min_num_inliers = _MIN_POSE_INLIERS
        if any(read_pieces(folder) for folder in job.work.glob("global-?")):
            options.ba_refine_focal_length = options.ba_refine_extra_params = False
            options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
        count = len(job.names)
        report_progress(TaskEvent(f"incremental mapping, choosing the first 2/{count} photos", 0.0))
        pieces = pycolmap.incremental_mapping(
            job.database_path,
            job.images,
            _make_scratch_folder(job),
            options,
            next_image_callback=_make_photo_callback(count, report_progress),
        )
        _save_pieces(job, name, pieces)
    return name


def _make_photo_callback(count: int, report_progress: Progress) -> Callable[[], None]:
    """Return the function that the incremental mapper calls after each photo.

    The number of remaining photos is unknown, because some get no pose and discarded models are restarted. So the
    reported ratio stays below 1.
    """
    posed = 2  # the mapper begins with a pair of photos

    def report_next_photo() -> None:
        nonlocal posed
        posed += 1
        task = f"incremental mapping, {min(posed, count)}/{count} photos registered"
        report_progress(TaskEvent(task, 0.95 * min(posed / count, 1.0)))

    return report_next_photo


def complete_model(job: Job, model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """Continue a model with the incremental mapper: add points and photos that fit, and refine the whole model."""
    start, scratch = job.work / "start", _make_scratch_folder(job)
    shutil.rmtree(start, ignore_errors=True)
    start.mkdir()
    model.write(start)
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed, options.num_threads = job.seed % 2**31, SOLVER_THREADS
    options.min_num_matches = MIN_PAIR_MATCHES
    options.multiple_models = options.extract_colors = False
    pieces = pycolmap.incremental_mapping(job.database_path, job.images, scratch, options, input_path=start)
    shutil.rmtree(start, ignore_errors=True)
    return max(pieces.values(), key=lambda piece: piece.num_reg_images(), default=model)


def add_two_view_points(job: Job, model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """Return a copy with added points that only two photos see, so that training starts from about twice as many."""
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed, options.num_threads = job.seed % 2**31, SOLVER_THREADS
    options.min_num_matches = MIN_PAIR_MATCHES
    options.triangulation.ignore_two_view_tracks = False
    options.extract_colors = False
    return pycolmap.triangulate_points(
        pycolmap.Reconstruction(model),
        job.database_path,
        job.images,
        _make_scratch_folder(job),
        clear_points=False,
        options=options,
    )


def read_pieces(folder: Path) -> list[pycolmap.Reconstruction]:
    """Read the pieces of a mapper's result, the one with the most photos first; none if the mapper did not run."""
    if not folder.is_dir():
        return []
    pieces = [pycolmap.Reconstruction(piece) for piece in sorted(folder.iterdir()) if piece.is_dir()]
    return sorted(pieces, key=lambda piece: -piece.num_reg_images())


def read_poses(job: Job, model: pycolmap.Reconstruction) -> Poses:
    """Return the poses of a model by photo name."""
    posed = (image for image in model.images.values() if image.has_pose)
    return {job.names[image.image_id - 1]: np.asarray(image.cam_from_world().matrix()) for image in posed}


def _select_better_cameras(model: pycolmap.Reconstruction, cameras: Cameras) -> Cameras:
    """Select the cameras of a model whose focal length is plausible and differs from the current one."""
    better = {}
    for number, camera in model.cameras.items():
        focal, longer_side = camera.focal_length, max(camera.width, camera.height)
        is_in_limits = _MIN_FOCAL_RATIO < focal / longer_side < _MAX_FOCAL_RATIO
        is_plausible = is_in_limits and not camera.has_bogus_params(0.1, 10.0, 1.0)
        if is_plausible and abs(focal / cameras[number].focal_length - 1) > _MAPPED_FOCAL_CHANGE_RATIO:
            better[number] = camera
    return better


def _make_scratch_folder(job: Job) -> Path:
    """Create an empty folder for temporary files, in place of an earlier one."""
    folder = job.work / "scratch"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    return folder


def _save_pieces(job: Job, name: str, pieces: dict[int, pycolmap.Reconstruction]) -> None:
    """Save all pieces of a mapper's result in one step, so that no incomplete result is ever found."""
    folder = _make_scratch_folder(job)
    for number, piece in pieces.items():
        (folder / str(number)).mkdir()
        piece.write(folder / str(number))
    os.replace(folder, job.model_folder(name))

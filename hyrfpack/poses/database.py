"""Access to the pycolmap database of an estimation: cameras, photos, features and matches."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import pycolmap

from hyrfpack.atomic import write_atomic
from hyrfpack.parallel.threads import thread_count
from hyrfpack.poses.job import Job
from hyrfpack.poses.watch import count_rows, report_new_rows
from hyrfpack.progress import Progress, TaskEvent

pycolmap.logging.minloglevel = 1  # only warnings and errors go into the log of a stage
Cameras = dict[int, pycolmap.Camera]  # cameras by their numbers, which start at 1

MIN_PAIR_MATCHES = 15  # a pair of photos with fewer verified matches is ignored (pycolmap's own default)
# These trials find a calibrated geometry that 30 % of the matches obey with a probability of 99.9 %. Only pairs that
# show different things need as many.
_MAX_RANSAC_TRIALS = 3000
_UNUSABLE_PAIR_KINDS = ("UNDEFINED", "DEGENERATE", "WATERMARK")


@contextmanager
def open_database(job: Job) -> Iterator[pycolmap.Database]:
    """Open the database and close it at the end of the block."""
    database = pycolmap.Database.open(job.database_path)
    try:
        yield database
    finally:
        database.close()


def create_database(job: Job) -> None:
    """Create the database with all cameras and photos, unless it exists.

    Cameras and photos are written in order, so that later results do not depend on the order of threads. Cameras have
    one coefficient of radial distortion. Their focal length counts as known even if it is a guess. So pairs are
    verified by calibrated geometry, or by uncalibrated geometry if that explains more matches.
    """
    if job.database_path.exists():
        return
    unfinished = job.database_path.with_suffix(".new")
    unfinished.unlink(missing_ok=True)
    database = pycolmap.Database.open(unfinished)
    for number, device in enumerate(job.devices, start=1):
        width, height = device.working_size
        camera = pycolmap.Camera.create_from_model_name(number, "SIMPLE_RADIAL", device.working_focal, width, height)
        camera.has_prior_focal_length = True
        database.write_camera(camera, use_camera_id=True)
        rig = pycolmap.Rig()
        rig.rig_id = number
        rig.add_ref_sensor(camera.sensor_id)
        database.write_rig(rig, use_rig_id=True)
    for number, device_index in enumerate(job.device_indices, start=1):
        image = pycolmap.Image(name=job.working_name(number), camera_id=device_index + 1, image_id=number)
        image.frame_id = number
        frame = pycolmap.Frame()
        frame.frame_id = number
        frame.rig_id = device_index + 1
        frame.add_data_id(image.data_id)
        database.write_frame(frame, use_frame_id=True)
        database.write_image(image, use_image_id=True)
    database.close()
    os.replace(unfinished, job.database_path)


def verified_pairs(database: pycolmap.Database) -> Iterator[tuple[int, int, np.ndarray]]:
    """Yield (first image, second image, (M, 2) matches) of each geometrically verified pair."""
    pair_ids, geometries = database.read_two_view_geometries()
    for pair_id, geometry in zip(pair_ids, geometries, strict=True):
        kind = pycolmap.TwoViewGeometryConfiguration(geometry.config).name
        if len(geometry.inlier_matches) >= MIN_PAIR_MATCHES and kind not in _UNUSABLE_PAIR_KINDS:
            first, second = pycolmap.pair_id_to_image_pair(pair_id)
            yield first, second, np.asarray(geometry.inlier_matches)


def read_cameras(database: pycolmap.Database) -> Cameras:
    """Read all cameras, by number."""
    return {camera.camera_id: camera for camera in database.read_all_cameras()}


def recalibrate(job: Job, step_name: str, decide: Callable[[Cameras], Cameras], report_progress: Progress) -> bool:
    """Replace cameras in the database by better ones, and verify the pairs again with them.

    Pairs that failed stay out. They were also tested without focal lengths, by uncalibrated geometry.

    The decision is saved before the database is changed, so that a call after an interruption makes the same
    replacements.

    Args:
        job: the estimation.
        step_name: name of this step, used in the names of its files.
        decide: maps the current cameras to the replacements, both by number.
        report_progress: called with `TaskEvent`s, whose share of this step is in [0.5, 1].

    Returns:
        Whether any camera was replaced.
    """
    decisions_path, done_marker = job.work / f"{step_name}.json", job.work / f"{step_name}.done"
    with open_database(job) as database:
        cameras = read_cameras(database)
    if not decisions_path.exists():
        better_parameters = {number: camera.params.tolist() for number, camera in decide(cameras).items()}
        write_atomic(decisions_path, json.dumps(better_parameters).encode())
    decisions = json.loads(decisions_path.read_text())
    if decisions and not done_marker.exists():
        with open_database(job) as database:
            for number, parameters in decisions.items():
                camera = cameras[int(number)]
                camera.params, camera.has_prior_focal_length = parameters, True
                database.update_camera(camera)
            for first, second, _ in list(verified_pairs(database)):
                database.delete_two_view_geometry(first, second)
        count = count_rows(job, "matches") - count_rows(job, "two_view_geometries")

        def report_done(done: int) -> None:
            share = min(done / max(count, 1), 1.0)
            task = f"verifying pairs with refined focal lengths {min(done, count)}/{count}"
            report_progress(TaskEvent(task, 0.5 + 0.5 * share))

        verifier_options = pycolmap.GeometricVerifierOptions()
        verifier_options.num_threads = thread_count()
        with report_new_rows(job, "two_view_geometries", report_done):
            pycolmap.geometric_verification(
                job.database_path, verifier_options, two_view_geometry_options=verification_options(job.seed)
            )
        done_marker.touch()
    return bool(decisions)


def verification_options(seed: int) -> pycolmap.TwoViewGeometryOptions:
    """Return the settings by which pairs are verified, with a fixed random seed."""
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = seed % 2**31
    options.ransac.max_num_trials = _MAX_RANSAC_TRIALS
    return options

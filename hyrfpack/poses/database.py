"""pycolmap's database of an estimation: cameras, photos, features, matches."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import pycolmap

from hyrfpack.atomic import write_atomic
from hyrfpack.poses.job import Job
from hyrfpack.poses.process import Tell
from hyrfpack.poses.watch import count_rows, watching_rows

pycolmap.logging.minloglevel = 1  # warnings and errors, into the stage's log
Cameras = dict[int, pycolmap.Camera]  # by number

FOUND = 15  # matches that a pair of photos needs to count as one (pycolmap's own default)
_NO_PAIR = ("UNDEFINED", "DEGENERATE", "WATERMARK")


@contextmanager
def opened(job: Job) -> Iterator[pycolmap.Database]:
    """The database, closed in the end."""
    database = pycolmap.Database.open(job.database)
    try:
        yield database
    finally:
        database.close()


def make_database(job: Job) -> None:
    """Make the database with all cameras and photos, in order, for what comes later shall not depend on threads.

    Cameras have one coefficient of radial distortion. Their focal length, or the guess of it, counts as known: pairs of
    photos are verified by calibrated geometry then, and by the uncalibrated one where that fits more.
    """
    if job.database.exists():
        return
    unfinished = job.database.with_suffix(".new")
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
    for number, of in enumerate(job.device_of, start=1):
        image = pycolmap.Image(name=job.working_name(number), camera_id=of + 1, image_id=number)
        image.frame_id = number
        frame = pycolmap.Frame()
        frame.frame_id = number
        frame.rig_id = of + 1
        frame.add_data_id(image.data_id)
        database.write_frame(frame, use_frame_id=True)
        database.write_image(image, use_image_id=True)
    database.close()
    os.replace(unfinished, job.database)


def verified_pairs(database: pycolmap.Database) -> Iterator[tuple[int, int, np.ndarray, str]]:
    """(first photo, second photo, (M, 2) matches, kind of geometry) of each pair that geometry holds together."""
    pair_ids, geometries = database.read_two_view_geometries()
    for pair_id, geometry in zip(pair_ids, geometries, strict=True):
        kind = pycolmap.TwoViewGeometryConfiguration(geometry.config).name
        if len(geometry.inlier_matches) >= FOUND and kind not in _NO_PAIR:
            first, second = pycolmap.pair_id_to_image_pair(pair_id)
            yield first, second, np.asarray(geometry.inlier_matches), kind


def read_cameras(database: pycolmap.Database) -> Cameras:
    """Cameras by their number."""
    return {camera.camera_id: camera for camera in database.read_all_cameras()}


def recalibrate(job: Job, name: str, decide: Callable[[Cameras], Cameras], tell: Tell) -> bool:
    """Give the database better cameras, and check all its pairs by their geometry with these.

    What was decided is kept before anything is changed, so that an interrupted call does the same when it is repeated.

    Args:
        name: of this step, for what is kept.
        decide: cameras as they are -> those to be replaced, by number.
        tell: called with what is going on and the share of this step that is done, from 0.5 on.

    Returns:
        Whether there was a camera to replace.
    """
    decided, done = job.work / f"{name}.json", job.work / f"{name}.done"
    with opened(job) as database:
        cameras = read_cameras(database)
    if not decided.exists():
        better = {number: camera.params.tolist() for number, camera in decide(cameras).items()}
        write_atomic(decided, json.dumps(better).encode())
    kept = json.loads(decided.read_text())
    if kept and not done.exists():
        with opened(job) as database:
            for number, parameters in kept.items():
                camera = cameras[int(number)]
                camera.params, camera.has_prior_focal_length = parameters, True
                database.update_camera(camera)
            database.clear_two_view_geometries()
        count = count_rows(job, "matches")

        def tell_done(done: int) -> None:
            share = min(done / max(count, 1), 1.0)
            tell(f"verifying pairs with better focal lengths, {min(done, count):,} of {count:,}", 0.5 + 0.5 * share)

        with watching_rows(job, "two_view_geometries", tell_done):
            pycolmap.geometric_verification(job.database, two_view_geometry_options=verification(job.seed))
        done.touch()
    return bool(kept)


def verification(seed: int) -> pycolmap.TwoViewGeometryOptions:
    """How pairs are checked, the same way in each run."""
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = seed % 2**31
    return options

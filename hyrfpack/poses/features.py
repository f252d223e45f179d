"""Find the features of each photo in a working copy of limited size."""

from __future__ import annotations

import json
import shutil
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from PIL import Image

from hyrfpack.atomic import write_atomic
from hyrfpack.data.pictures import read_mask, read_pixels
from hyrfpack.data.quality import measure_sharpness
from hyrfpack.errors import HyrfDataError, strip_path
from hyrfpack.parallel.threads import thread_count
from hyrfpack.poses.database import create_database, open_database
from hyrfpack.poses.job import Job, chunks
from hyrfpack.poses.watch import report_new_rows
from hyrfpack.progress import Progress, TaskEvent

_MAX_FEATURES_PER_PHOTO = 8192
_MAX_UPSAMPLED_SIDE_PIXELS = 1000  # in copies up to this size, features are also found at twice the resolution
_PHOTOS_PER_CHUNK = 16  # results are saved after each chunk, so an interruption costs at most one chunk


def find_features(job: Job, report_progress: Progress) -> dict[str, Any]:
    """Find the features of all photos that have none yet in the database.

    Args:
        job: the estimation.
        report_progress: see `run_stage`.

    Returns:
        "sharpness" of each decodable photo by name, "unreadable" with the reason for each other photo, and "keypoints"
        with the number of features of each decodable photo.
    """
    create_database(job)
    facts_path = job.work / "features.json"
    facts: dict[str, Any] = {"sharpness": {}, "unreadable": {}}
    if facts_path.exists():
        facts = json.loads(facts_path.read_text())
    numbers = {name: number for number, name in enumerate(job.names, start=1)}
    known = {*facts["sharpness"], *facts["unreadable"]}
    done = len(known)

    def report_done(done: int) -> None:
        number = min(done + 1, len(job.names))
        report_progress(TaskEvent(f"finding features in photo {number}/{len(job.names)}", done / len(job.names)))

    for camera, device in enumerate(job.devices, start=1):
        camera_photos = [
            name
            for name, device_index in zip(job.names, job.device_indices, strict=True)
            if device_index + 1 == camera and name not in known
        ]
        for names in chunks(camera_photos, _PHOTOS_PER_CHUNK):
            report_done(done)
            folder = job.work / "working"
            shutil.rmtree(folder, ignore_errors=True)
            with ThreadPoolExecutor(thread_count()) as pool:
                write_copy = partial(_write_working_copy, job, folder, device.working_size)
                copies = list(pool.map(write_copy, names, [numbers[name] for name in names]))
            for name, (sharpness, reason) in zip(names, copies, strict=True):
                if reason:
                    facts["unreadable"][name] = reason
                else:
                    facts["sharpness"][name] = sharpness
            readable = [numbers[name] for name, (_, reason) in zip(names, copies, strict=True) if not reason]
            done_before = done + len(names) - len(readable)

            def report_new(new: int, done_before: int = done_before) -> None:
                report_done(done_before + new)

            with report_new_rows(job, "keypoints", report_new):
                _extract_features(job, folder, readable, camera)
            write_atomic(facts_path, json.dumps(facts).encode())
            done += len(names)
    shutil.rmtree(job.work / "working", ignore_errors=True)
    with open_database(job) as database:
        facts["keypoints"] = {
            name: database.num_keypoints_for_image(numbers[name]) for name in job.names if name in facts["sharpness"]
        }
    return facts


def _write_working_copy(job: Job, folder: Path, size: tuple[int, int], name: str, number: int) -> tuple[float, str]:
    """Write the grey working copy of a photo and its mask; return (sharpness, "") or (0, the reason for failure)."""
    try:
        rgb, alpha = read_pixels(job.images / name, size)
    except HyrfDataError as error:
        return 0.0, strip_path(error, job.images / name)
    grey = rgb.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)
    if alpha is not None:
        grey *= alpha.astype(np.float32) / 255
    copy = folder / "photos" / job.working_name(number)
    copy.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray((grey + 0.5).astype(np.uint8)).save(copy, compress_level=1)
    if job.masks:  # if any photo has a mask, pycolmap needs one for each photo
        mask = folder / "masks" / f"{job.working_name(number)}.png"
        mask.parent.mkdir(parents=True, exist_ok=True)
        usable = np.ones(size[::-1], bool)
        if name in job.masks:
            usable = read_mask(Path(job.masks[name]), size[1], size[0])
        Image.fromarray(usable.astype(np.uint8) * 255).save(mask, compress_level=1)
    return float(measure_sharpness(grey / 255)), ""


def _extract_features(job: Job, folder: Path, numbers: list[int], camera: int) -> None:
    """Extract the features of these images, all of one camera, into the database."""
    if not numbers:
        return
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = thread_count()
    options.sift.max_num_features = _MAX_FEATURES_PER_PHOTO
    options.sift.first_octave = -1 if max(job.devices[camera - 1].working_size) <= _MAX_UPSAMPLED_SIDE_PIXELS else 0
    reader_options = pycolmap.ImageReaderOptions()
    reader_options.existing_camera_id = camera
    if (folder / "masks").is_dir():
        reader_options.mask_path = folder / "masks"
    pycolmap.extract_features(
        job.database_path,
        folder / "photos",
        image_names=[job.working_name(number) for number in numbers],
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader_options,
        extraction_options=options,
    )

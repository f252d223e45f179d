"""Features of each photo, found in working copies of a bounded size."""

from __future__ import annotations

import json
import os
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
from hyrfpack.poses.database import make_database, opened
from hyrfpack.poses.job import Job, chunks
from hyrfpack.poses.process import Tell
from hyrfpack.poses.watch import watching_rows

_MOST = 8192  # features of a photo
_SMALL = 1000  # pixels of the longer side up to which features are also found between pixels (twice the resolution)
_CHUNK = 16  # photos between two lines of progress, and that are done again after an interruption, at most


def find_features(job: Job, tell: Tell) -> dict[str, Any]:
    """Find the features of all photos that have none yet.

    Returns:
        "sharpness": of each photo that could be decoded, by name; "unreadable": the reason for each other one.
    """
    make_database(job)
    kept = job.work / "features.json"
    facts: dict[str, Any] = {"sharpness": {}, "unreadable": {}}
    if kept.exists():
        facts = json.loads(kept.read_text())
    numbers = {name: number for number, name in enumerate(job.names, start=1)}
    known = {*facts["sharpness"], *facts["unreadable"]}
    done = len(known)

    def tell_done(done: int) -> None:
        number = min(done + 1, len(job.names))
        tell(f"features of photo {number:,} of {len(job.names):,}", done / len(job.names))

    for camera, device in enumerate(job.devices, start=1):
        mine = [
            name for name, of in zip(job.names, job.device_of, strict=True) if of + 1 == camera and name not in known
        ]
        for names in chunks(mine, _CHUNK):
            tell_done(done)
            folder = job.work / "working"
            shutil.rmtree(folder, ignore_errors=True)
            with ThreadPoolExecutor(os.cpu_count()) as pool:
                make = partial(_make_copy, job, folder, device.working_size)
                copies = list(pool.map(make, names, [numbers[name] for name in names]))
            for name, (sharp, reason) in zip(names, copies, strict=True):
                if reason:
                    facts["unreadable"][name] = reason
                else:
                    facts["sharpness"][name] = sharp
            readable = [numbers[name] for name, (_, reason) in zip(names, copies, strict=True) if not reason]
            first = done + len(names) - len(readable)
            with watching_rows(job, "keypoints", lambda found, first=first: tell_done(first + found)):  # type: ignore[misc]
                _extract(job, folder, readable, camera)
            write_atomic(kept, json.dumps(facts).encode())
            done += len(names)
    shutil.rmtree(job.work / "working", ignore_errors=True)
    with opened(job) as database:
        facts["keypoints"] = {
            name: database.num_keypoints_for_image(numbers[name]) for name in job.names if name in facts["sharpness"]
        }
    return facts


def _make_copy(job: Job, folder: Path, size: tuple[int, int], name: str, number: int) -> tuple[float, str]:
    """Write the grey working copy of a photo, and its mask where it has one; returns its sharpness, or why not."""
    try:
        rgb, alpha = read_pixels(job.images / name, size)
    except HyrfDataError as error:
        return 0.0, strip_path(error, job.images / name).partition(";")[0]
    grey = rgb.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)
    if alpha is not None:
        grey *= alpha.astype(np.float32) / 255
    copy = folder / "photos" / job.working_name(number)
    copy.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray((grey + 0.5).astype(np.uint8)).save(copy, compress_level=1)
    if job.masks:  # where some photos have a mask, pycolmap wants one of each
        mask = folder / "masks" / f"{job.working_name(number)}.png"
        mask.parent.mkdir(parents=True, exist_ok=True)
        usable = np.ones(size[::-1], bool)
        if name in job.masks:
            usable = read_mask(Path(job.masks[name]), size[1], size[0], require_all=True)
        Image.fromarray(usable.astype(np.uint8) * 255).save(mask, compress_level=1)
    return float(measure_sharpness(grey / 255)), ""


def _extract(job: Job, folder: Path, numbers: list[int], camera: int) -> None:
    if not numbers:
        return
    options = pycolmap.FeatureExtractionOptions()
    options.sift.max_num_features = _MOST
    options.sift.first_octave = -1 if max(job.devices[camera - 1].working_size) <= _SMALL else 0
    reader = pycolmap.ImageReaderOptions()
    reader.existing_camera_id = camera
    if (folder / "masks").is_dir():
        reader.mask_path = folder / "masks"
    pycolmap.extract_features(
        job.database,
        folder / "photos",
        image_names=[job.working_name(number) for number in numbers],
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader,
        extraction_options=options,
    )

"""Measurements of photos for their survey: headers, and the sharpness, exposure and thumbnail of each picture."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from hyrfpack.data.archive import display_path
from hyrfpack.data.folder import PhotoFacts, read_photo_facts
from hyrfpack.data.quality import (
    MIN_SHARPNESS_SIDE_PIXELS,
    Exposure,
    measure_exposure,
    measure_sharpness,
    read_gray_and_transparency,
)
from hyrfpack.errors import HyrfDataError, strip_path
from hyrfpack.parallel.threads import thread_count
from hyrfpack.progress import Progress, TaskEvent
from hyrfpack.scene import evenly_spaced

# An evenly spaced selection of larger sets is examined, so that a survey takes seconds and not minutes.
MAX_DECODED_PHOTOS = 150
MAX_OPENED_PHOTOS = 2000
# Ratios of the whole work that are done after the headers are read and after the pixels are measured.
HEADERS_PROGRESS = 0.2
PIXELS_PROGRESS = 0.95
_THUMBNAIL_SIDE_PIXELS = 24


@dataclass(frozen=True)
class PhotoMeasurement:
    """Measurements of the pixels of one photo.

    Attributes:
        path: the photo.
        sharpness: its sharpness; None for a picture that is too small to measure.
        exposure: its luminance and clipping.
        thumbnail: (_THUMBNAIL_SIDE_PIXELS, _THUMBNAIL_SIDE_PIXELS) grey levels in [0, 255].
        is_cut_out: whether some of its pixels are transparent; they are black in the measurements.
    """

    path: Path
    sharpness: float | None
    exposure: Exposure
    thumbnail: np.ndarray
    is_cut_out: bool


def read_header_facts(
    photos: list[Path], folder: Path, report_progress: Progress
) -> tuple[list[PhotoFacts], dict[str, str]]:
    """Read the headers of photos; return their facts, and the reason for each photo that cannot be read, by name."""
    facts, unreadable = [], {}
    chosen = evenly_spaced(photos, MAX_OPENED_PHOTOS)
    for number, photo in enumerate(chosen, start=1):
        try:
            facts.append(read_photo_facts(photo))
        except HyrfDataError as error:
            unreadable[relative_name(photo, folder)] = strip_path(error, display_path(photo))
        task = f"reading the headers of photos {number}/{len(chosen)}"
        report_progress(TaskEvent(task, HEADERS_PROGRESS * number / len(chosen)))
    return facts, unreadable


def measure_pixels(
    photos: list[Path], folder: Path, report_progress: Progress
) -> tuple[list[PhotoMeasurement], dict[str, str]]:
    """Measure the pixels of photos; also return the reason for each undecodable photo, by name."""
    chosen = evenly_spaced(photos, MAX_DECODED_PHOTOS)
    measurements, undecodable = [], {}
    with ThreadPoolExecutor(thread_count()) as pool:
        for index, result in enumerate(pool.map(_measure_one, chosen)):
            if isinstance(result, PhotoMeasurement):
                measurements.append(result)
            else:
                undecodable[relative_name(chosen[index], folder)] = result
            done = (index + 1) / len(chosen)
            share = HEADERS_PROGRESS + (PIXELS_PROGRESS - HEADERS_PROGRESS) * done
            report_progress(TaskEvent(f"measuring photo {index + 1}/{len(chosen)}", share))
    return measurements, undecodable


def _measure_one(path: Path) -> PhotoMeasurement | str:
    """Measure the pixels of a photo; return the reason if it cannot be decoded."""
    try:
        gray, is_cut_out = read_gray_and_transparency(path)
    except HyrfDataError as error:
        return strip_path(error, display_path(path))
    small = Image.fromarray(gray).resize((_THUMBNAIL_SIDE_PIXELS, _THUMBNAIL_SIDE_PIXELS), Image.Resampling.BOX)
    sharpness = measure_sharpness(gray) if min(gray.shape) >= MIN_SHARPNESS_SIDE_PIXELS else None
    return PhotoMeasurement(path, sharpness, measure_exposure(gray), 255 * np.asarray(small), is_cut_out)


def relative_name(path: Path, folder: Path) -> str:
    """Return the path of a photo below its folder; a path elsewhere stays as it is."""
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else str(path)

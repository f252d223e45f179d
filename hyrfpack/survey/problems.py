"""Problems of a set of photos, as sentences for the user: what is wrong, and what to do about it."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Container, Hashable, Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

import numpy as np

from hyrfpack.counts import format_count
from hyrfpack.data.folder import PhotoFacts, choose_original
from hyrfpack.data.masks import find_masks, locate_masks
from hyrfpack.data.quality import MIN_SHARPNESS
from hyrfpack.data.unusable import format_file_names
from hyrfpack.errors import HyrfDataError, suggest_command
from hyrfpack.progress import Progress, TaskEvent
from hyrfpack.scene import DEFAULT_MAX_SIZE, Scene
from hyrfpack.survey.measure import PIXELS_PROGRESS, PhotoMeasurement, relative_name

Key = TypeVar("Key", bound=Hashable)

_MIN_RECOMMENDED_PHOTOS = 20  # fewer photos hardly show an object from all sides
_MAX_EXPOSURE_SPREAD_STOPS = 2.5  # between the 5 % and 95 % quantiles; real sets at one exposure have up to 2
_MIN_SET_LUMINANCE = 0.02  # a set with a lower median of the mean luminances is dark
_DARK_PHOTO_STOPS = 3.0  # a photo this far below the median of its set is dark
_MAX_CLIPPED_PIXEL_RATIO = 0.25
_SAME_ZOOM_TOLERANCE = 0.03  # EXIF rounds focal lengths by up to this ratio
# Files of the same size are compared by samples of this many bytes: at their start, from their middle on, and at their
# end. Longer files whose samples agree are compared as a whole. If a large set has all photos twice, that would take
# minutes, so it is done for a limited number of photos, and the others count as copies.
_SAMPLE_BYTES = 1 << 16
_MAX_HASHED_PHOTOS = 100
_SAME_PICTURE_MAX_LEVELS = 1.0  # thumbnails of the same picture differ by less, in levels of 255 on average


def find_count_problems(count: int, scene: Scene | None, posed: int, path: Path) -> list[str]:
    """Describe too few photos, photos without poses, and missing points."""
    problems = []
    if count < _MIN_RECOMMENDED_PHOTOS:
        problems.append(
            f"there {'is' if count == 1 else 'are'} only {format_count(count, 'photo')}; take "
            f"{_MIN_RECOMMENDED_PHOTOS} or more, from all around and with much overlap"
        )
    if scene is None or scene.layout == "blender":  # only some splits of a Blender set are used
        return problems
    unposed = count - posed
    if posed and unposed > 0:
        of_photos = f"of {count} photos"
        unused = format_count(unposed, f"{of_photos} has no pose and is", f"{of_photos} have no pose and are")
        problems.append(
            f"{unused} not used; take more photos between them and the others, or estimate all poses again with "
            f"{suggest_command('poses', path, '-o', 'SCENE')}"
        )
    if not len(scene.points):
        problems.append(
            "there are no points, so training has to find surfaces without them; add the points of the reconstruction"
        )
    return problems


def find_copy_problems(
    photos: list[Path],
    measurements: list[PhotoMeasurement],
    unreadable: Container[str],
    folder: Path,
    report_progress: Progress,
) -> list[str]:
    """Describe copies of photos, or a set that shows the same picture throughout.

    `unreadable` are the names of photos below `folder` that cannot be read. They are not compared.
    """
    thumbnails = np.stack([measurement.thumbnail for measurement in measurements])
    if len(measurements) > 2 and np.abs(thumbnails - thumbnails[0]).mean(axis=(1, 2)).max() < _SAME_PICTURE_MAX_LEVELS:
        return ["all photos show the same picture; walk around and take photos from many places"]
    readable = [photo for photo in photos if relative_name(photo, folder) not in unreadable]
    by_size = _group_files(readable, lambda photo: photo.stat().st_size)
    middle = (PIXELS_PROGRESS + 1) / 2

    def report_each(files: list[Path], start: float, end: float) -> Iterator[Path]:
        for done, file in enumerate(files):
            task = f"searching for identical photos {done + 1}/{len(files)}"
            report_progress(TaskEvent(task, start + (end - start) * done / len(files)))
            yield file

    by_samples = _group_files(
        report_each(
            [photo for group in by_size.values() if len(group) > 1 for photo in group], PIXELS_PROGRESS, middle
        ),
        lambda photo: (photo.stat().st_size, _digest_samples(photo)),
    )
    to_hash: list[Path] = []
    not_hashed: list[list[Path]] = []
    for (size, _), group in by_samples.items():
        is_compared = size <= 3 * _SAMPLE_BYTES
        if len(group) > 1 and not is_compared and len(to_hash) + len(group) <= _MAX_HASHED_PHOTOS:
            to_hash += group
        else:
            not_hashed.append(group)
    hashed = _group_files(report_each(to_hash, middle, 1.0), lambda photo: hashlib.sha256(photo.read_bytes()).digest())
    originals = [(choose_original(group), group) for group in [*hashed.values(), *not_hashed]]
    copies = [(photo, original) for original, group in originals for photo in group if photo != original]
    if not copies:
        return []
    first, of = (relative_name(item, folder) for item in copies[0])
    return [
        f"{format_count(len(copies), 'photo is a copy of another', 'photos are copies of others')} (such as {first} of "
        f"{of}); remove the copies"
    ]


def _group_files(files: Iterable[Path], describe: Callable[[Path], Key]) -> dict[Key, list[Path]]:
    """Group the files that `describe` gives the same value, and leave out those that cannot be read."""
    groups: dict[Key, list[Path]] = {}
    for file in files:
        with suppress(OSError):  # of large sets, some photos have not been opened before
            groups.setdefault(describe(file), []).append(file)
    return groups


def _digest_samples(file: Path) -> bytes:
    """Return a digest of samples of a file: its start, its middle and its end; of a short file, all of its bytes."""
    size, digest = file.stat().st_size, hashlib.sha256()
    with file.open("rb") as opened:
        for offset in (0, (size - _SAMPLE_BYTES) // 2, size - _SAMPLE_BYTES):
            opened.seek(max(0, offset))
            digest.update(opened.read(_SAMPLE_BYTES))
    return digest.digest()


def find_blur_problems(median_sharpness: float, blurred: list[Path], folder: Path) -> list[str]:
    """Describe a blurred set, or its blurred photos."""
    if not blurred:
        return []
    if median_sharpness < MIN_SHARPNESS:
        return [
            "most photos are blurred; take them again with the camera held still, in more light, and "
            "focused on what you photograph"
        ]
    names = format_file_names([relative_name(item, folder) for item in blurred])
    return [
        f"{format_count(len(blurred), 'photo is', 'photos are')} blurred ({names}); leave out or retake blurred photos"
    ]


def find_light_problems(
    measurements: list[PhotoMeasurement], log_luminances: np.ndarray, stops: float, folder: Path
) -> list[str]:
    """Describe dark, clipped or unevenly exposed photos."""
    if any(measurement.is_cut_out for measurement in measurements):
        return []  # transparent pixels are not dark
    problems = []
    median = float(np.median(log_luminances))
    if 2**median < _MIN_SET_LUMINANCE:
        problems.append("the photos are dark; take them in more light, or with a longer exposure and a tripod")
    dark = [
        relative_name(measurement.path, folder)
        for measurement, value in zip(measurements, log_luminances, strict=True)
        if value < median - _DARK_PHOTO_STOPS
    ]
    if dark:
        problems.append(
            f"{format_count(len(dark), 'photo is', 'photos are')} over {_DARK_PHOTO_STOPS:g} stops darker than "
            f"the others ({format_file_names(dark)}); leave out dark photos"
        )
    bright = [
        relative_name(measurement.path, folder)
        for measurement in measurements
        if measurement.exposure.bright > _MAX_CLIPPED_PIXEL_RATIO
    ]
    if len(bright) > len(measurements) / 4:
        problems.append(
            f"{format_count(len(bright), 'photo is', 'photos are')} overexposed in a quarter or more of the "
            f"pixels ({format_file_names(bright)}); reduce the exposure, and lock it"
        )
    if stops > _MAX_EXPOSURE_SPREAD_STOPS:
        problems.append(
            f"the photos differ by {stops:.1f} stops in brightness; lock exposure and white balance while you take them"
        )
    return problems


def find_zoom_problems(facts: list[PhotoFacts]) -> list[str]:
    """Describe a mixture of focal lengths of one device."""
    lengths: dict[str, set[float]] = {}
    for fact in facts:
        if fact.focal is not None:
            known = lengths.setdefault(fact.device, set())
            relative = fact.focal / max(fact.size)
            if not any(abs(relative / other - 1) < _SAME_ZOOM_TOLERANCE for other in known):
                known.add(relative)
    count = max((len(values) for values in lengths.values()), default=0)
    if count < 2:
        return []
    device = max(lengths, key=lambda name: len(lengths[name]))
    return [
        f"the photos have {count} different focal lengths{f' ({device})' if device else ''}; each gets its own "
        "intrinsics, but poses are less reliable; use one lens, and do not zoom"
    ]


def find_mask_problems(folder: Path, photos: list[Path], facts: Sequence[PhotoFacts]) -> list[str]:
    """Describe masks that fit no photo; for photos with poses, `load_scene` reports them.

    Args:
        folder: the folder of the photos.
        photos: all photos.
        facts: the headers of those that were read, at least one.
    """
    masks = locate_masks(folder)
    if masks is None:
        return []
    sizes = {fact.path: fact.size for fact in facts}  # Those of other photos are not known, and taken for the first.
    named = [(Path(os.path.relpath(photo, folder)).as_posix(), sizes.get(photo, facts[0].size)) for photo in photos]
    try:
        matches = find_masks(masks, named, set())
    except HyrfDataError as error:  # a mask cannot be read
        return [str(error)]
    is_shared = len(set(matches.by_photo.values())) == 1 < len(matches.by_photo)  # noted, but no problem
    return [] if is_shared else matches.notes


def describe_headers(facts: list[PhotoFacts]) -> list[str]:
    """Return notes about rotated, large and panoramic photos."""
    notes = []
    rotated = sum(fact.orientation != 1 for fact in facts)
    if rotated:
        notes.append(
            f"{format_count(rotated, 'photo is', 'photos are')} stored rotated; 'hyrfpack poses' makes upright copies"
        )
    large = sum(max(fact.size) > DEFAULT_MAX_SIZE for fact in facts)
    if large:
        notes.append(
            f"{format_count(large, f'of {len(facts)} photos is', f'of {len(facts)} photos are')} larger than "
            f"{DEFAULT_MAX_SIZE:,} pixels and shrunk to that for training; `max_size` sets another limit"
        )
    wide = sum(fact.size[0] == 2 * fact.size[1] for fact in facts)
    if wide:
        notes.append(
            f"{format_count(wide, 'photo is', 'photos are')} twice as wide as high, like those of 360-degree cameras"
        )
    return notes

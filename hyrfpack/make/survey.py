"""Describe a set of photos or a video before it is used: its properties, its problems, and what to do about them."""

from __future__ import annotations

import hashlib
import shlex
from collections import Counter
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from hyrfpack.data import load_scene, pose_commands
from hyrfpack.data.archive import display_path, is_archive, unpack
from hyrfpack.data.folder import PhotoFacts, list_photos, list_raw_photos, read_photo_facts
from hyrfpack.data.quality import MIN_SHARPNESS, Exposure, is_blurred, measure_exposure, measure_sharpness, read_gray
from hyrfpack.data.unusable import (
    format_file_names,
    format_photo_count,
    no_photos_error,
    raise_if_single_photo,
    raw_photos_notes,
    unreadable_error,
    unreadable_sentences,
)
from hyrfpack.errors import HyrfDataError, HyrfNoPosesError, strip_path
from hyrfpack.outputs import PICTURE_SUFFIXES, VIDEO_SUFFIXES, StrPath
from hyrfpack.parallel.pool import thread_count
from hyrfpack.scene import DEFAULT_MAX_SIZE, Scene, evenly_spaced
from hyrfpack.train.setup import detect_preset

# An evenly spaced selection of larger sets is examined, so that a survey takes seconds and not minutes.
MAX_DECODED_PHOTOS = 150
MAX_OPENED_PHOTOS = 2000

_MIN_RECOMMENDED_PHOTOS = 20  # fewer photos hardly show an object from all sides
_MAX_EXPOSURE_SPREAD_STOPS = 2.5  # between the 5 % and 95 % quantiles; real sets at one exposure have up to 2
_MIN_SET_LUMINANCE = 0.02  # a set with a lower median of the mean luminances is dark
_DARK_PHOTO_STOPS = 3.0  # a photo this far below the median of its set is dark
_MAX_CLIPPED_PIXEL_RATIO = 0.25
_SAME_ZOOM_TOLERANCE = 0.03  # EXIF rounds focal lengths by up to this ratio
_SAME_PICTURE_MAX_LEVELS = 1.0  # thumbnails of the same picture differ by less, in levels of 255 on average
# Ratios of the whole work that are done after the headers are read and after the pixels are measured.
_HEADERS_PROGRESS = 0.2
_PIXELS_PROGRESS = 0.95
_THUMBNAIL_SIDE_PIXELS = 24


@dataclass(frozen=True)
class PhotoSurvey:
    """Description of a set of photos or a video, which `dataclasses.asdict` turns into JSON values.

    Attributes:
        path: the path that was described.
        kind: "photos" or "video".
        photos: number of photos; for a video, number of frames.
        layout: layout of the poses; "" if there are none.
        posed: number of photos with poses.
        points: number of points of the reconstruction.
        preset: the preset that training would use, and why; "" without poses.
        sizes: number of photos by size, such as "4032 x 3024", of upright pictures; the most frequent first.
        cameras: number of photos by camera, such as "Apple iPhone 12, 26 mm", of the photos whose headers were read.
        decoded: number of photos whose pixels were measured; the next four values describe these photos.
        sharpness: median sharpness, about 1 for pictures that are sharp to the pixel; 0 for a video.
        blurred: names of photos that are blurred compared with the others.
        stops: difference in stops between the 5 % and 95 % quantiles of the mean luminance; 0 for a video.
        luminance: median of the mean linear luminance, in [0, 1]; 0 for a video.
        frames: number of frames that would be taken from a video.
        notes: sentences about the set.
        problems: sentences about problems, each with advice.
    """

    path: str
    kind: str
    photos: int
    layout: str
    posed: int
    points: int
    preset: str
    sizes: dict[str, int]
    cameras: dict[str, int]
    decoded: int
    sharpness: float
    blurred: tuple[str, ...]
    stops: float
    luminance: float
    frames: int
    notes: tuple[str, ...]
    problems: tuple[str, ...]


@dataclass(frozen=True)
class _PixelMeasurement:
    """Measurements of the pixels of one photo.

    Attributes:
        path: the photo.
        sharpness: its sharpness.
        exposure: its luminance and clipping.
        thumbnail: (_THUMBNAIL_SIDE_PIXELS, _THUMBNAIL_SIDE_PIXELS) grey levels in [0, 255].
    """

    path: Path
    sharpness: float
    exposure: Exposure
    thumbnail: np.ndarray


def describe_photos(path: StrPath, *, report: Callable[[str, float], None] | None = None) -> PhotoSurvey:
    """Describe a folder of photos, with poses or without, a .zip of one, or a video.

    An evenly spaced selection of a large set is examined: the headers of 2,000 photos and the pixels of 150. A video is
    decoded once. No file is written.

    Args:
        path: the folder or file.
        report: called with a description of the current work and the ratio of the work that is done, in [0, 1].

    Raises:
        HyrfDataError: the path does not exist, or has no photo that can be read.

    Example:
        >>> survey = describe_photos("photos/bonsai")
        >>> survey.photos, survey.posed, survey.layout, survey.sizes
        (10, 10, 'nerfstudio', {'48 x 48': 10})
        >>> survey.problems[0]
        'there are only 10 photos; take 20 or more, from all around and with much overlap'
    """
    path = Path(path)
    report_progress = report or (lambda text, share: None)
    if path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES:
        return _describe_video(path, report_progress)
    raise_if_single_photo(path)
    folder = unpack(path) if is_archive(path) else path
    photos = list_photos(folder)
    report_progress("reading poses", 0.0)
    scene, problems = _load_scene_or_problem(path, folder)
    posed = _posed_files(scene)
    photos = sorted({*photos, *posed})
    if not photos:
        raise no_photos_error(path, folder)
    facts, unreadable = _read_header_facts(photos, folder, report_progress)
    measurements, undecodable = _measure_all_pixels([fact.path for fact in facts], folder, report_progress)
    unreadable |= undecodable
    if not measurements:
        raise unreadable_error(path, unreadable, len(photos))
    blurred = [
        measurement.path
        for measurement, bad in zip(measurements, is_blurred([x.sharpness for x in measurements]), strict=True)
        if bad
    ]
    light = np.log2([max(measurement.exposure.luminance, 1e-6) for measurement in measurements])
    stops = float(np.ptp(np.quantile(light, (0.05, 0.95))))

    problems += _count_problems(len(photos), scene, len(posed), path)
    problems += unreadable_sentences(unreadable, len(photos))
    problems += _copy_problems(photos, measurements, folder, report_progress)
    problems += _blur_problems(measurements, blurred, folder)
    problems += _light_problems(measurements, light, stops, folder, scene)
    if scene is None:
        problems += _zoom_problems(facts) + _mask_problems(folder, photos)
    notes = list(scene.notes) if scene is not None else _header_notes(facts) + raw_photos_notes(list_raw_photos(folder))
    if len(measurements) + len(unreadable) < len(photos):
        notes.append(f"the pixels of {len(measurements)} of {len(photos)} photos were measured, evenly spaced")
    preset = ": ".join(detect_preset(scene)) if scene is not None and scene.train else ""
    report_progress("described", 1.0)
    return PhotoSurvey(
        path=str(path),
        kind="photos",
        photos=len(photos),
        layout=scene.layout if scene is not None else "",
        posed=len(posed) or (len(scene.views) if scene is not None else 0),
        points=len(scene.points) if scene is not None else 0,
        preset=preset,
        sizes=_count_values(f"{fact.size[0]} x {fact.size[1]}" for fact in facts),
        cameras=_count_values(_describe_camera(fact) for fact in facts),
        decoded=len(measurements),
        sharpness=round(float(np.median([measurement.sharpness for measurement in measurements])), 3),
        blurred=tuple(_relative_name(item, folder) for item in blurred),
        stops=round(stops, 2),
        luminance=round(float(2 ** np.median(light)), 4),
        frames=0,
        notes=tuple(notes),
        problems=tuple(problems),
    )


def _describe_video(path: Path, report_progress: Callable[[str, float], None]) -> PhotoSurvey:
    """Describe a video."""
    from hyrfpack.poses.frames import survey_frames

    found, size, looked = survey_frames(path, report=report_progress)
    problems = [f"a video has no poses; {pose_commands(path)}"]
    return PhotoSurvey(
        path=str(path),
        kind="video",
        photos=found.of,
        layout="",
        posed=0,
        points=0,
        preset="",
        sizes={f"{size[0]} x {size[1]}": found.of},
        cameras={},
        decoded=looked,
        sharpness=0.0,
        blurred=(),
        stops=0.0,
        luminance=0.0,
        frames=found.taken,
        notes=(
            f"{found.blurred} frames are blurred and {found.repeated} repeated, and would be skipped",
            *found.notes,
        ),
        problems=tuple(problems),
    )


def _load_scene_or_problem(path: Path, folder: Path) -> tuple[Scene | None, list[str]]:
    """Load the photos with their poses; without poses, return None and sentences about the problem."""
    try:
        return load_scene(folder, test_every=0, max_size=DEFAULT_MAX_SIZE), []
    except HyrfNoPosesError:
        return None, [f"the photos have no poses; {pose_commands(path)}"]
    except HyrfDataError as error:
        if not list_photos(folder):
            return None, []
        return None, [str(error)]


def _posed_files(scene: Scene | None) -> set[Path]:
    """Return the paths of the photos with poses."""
    files = (getattr(view.load, "path", None) for view in scene.views) if scene is not None else ()
    return {Path(file) for file in files if file is not None}


def _read_header_facts(
    photos: list[Path], folder: Path, report_progress: Callable[[str, float], None]
) -> tuple[list[PhotoFacts], dict[str, str]]:
    """Read the headers of photos; return their facts, and the reason for each photo that cannot be read, by name."""
    facts, unreadable = [], {}
    chosen = evenly_spaced(photos, MAX_OPENED_PHOTOS)
    for done, photo in enumerate(chosen):
        try:
            facts.append(read_photo_facts(photo))
        except HyrfDataError as error:
            unreadable[_relative_name(photo, folder)] = strip_path(error, display_path(photo))
        read = f"reading the headers of photos {done + 1}/{len(chosen)}"
        report_progress(read, _HEADERS_PROGRESS * (done + 1) / len(chosen))
    return facts, unreadable


def _measure_all_pixels(
    photos: list[Path], folder: Path, report_progress: Callable[[str, float], None]
) -> tuple[list[_PixelMeasurement], dict[str, str]]:
    """Measure the pixels of photos; also return the reason for each undecodable photo, by name."""
    chosen = evenly_spaced(photos, MAX_DECODED_PHOTOS)
    measurements, undecodable = [], {}
    with ThreadPoolExecutor(thread_count()) as pool:
        for done, found in enumerate(pool.map(_measure_pixels, chosen)):
            if isinstance(found, _PixelMeasurement):
                measurements.append(found)
            else:
                undecodable[_relative_name(chosen[done], folder)] = found
            looked = f"measuring photo {done + 1}/{len(chosen)}"
            report_progress(
                looked, _HEADERS_PROGRESS + (_PIXELS_PROGRESS - _HEADERS_PROGRESS) * (done + 1) / len(chosen)
            )
    return measurements, undecodable


def _measure_pixels(path: Path) -> _PixelMeasurement | str:
    """Measure the pixels of a photo; return the reason if it cannot be decoded."""
    try:
        gray = read_gray(path)
    except HyrfDataError as error:
        return strip_path(error, display_path(path))
    small = Image.fromarray(gray).resize((_THUMBNAIL_SIDE_PIXELS, _THUMBNAIL_SIDE_PIXELS), Image.Resampling.BOX)
    return _PixelMeasurement(path, measure_sharpness(gray), measure_exposure(gray), 255 * np.asarray(small))


def _count_problems(count: int, scene: Scene | None, posed: int, path: Path) -> list[str]:
    """Describe too few photos, photos without poses, and missing points."""
    found = []
    if count < _MIN_RECOMMENDED_PHOTOS:
        found.append(
            f"there {'is' if count == 1 else 'are'} only {format_photo_count(count)}; take {_MIN_RECOMMENDED_PHOTOS} "
            "or more, from all around and with much overlap"
        )
    if scene is None or scene.layout == "blender":  # only some splits of a Blender set are used
        return found
    without = count - posed
    if posed and without > 0:
        found.append(
            f"{without} of {count} photos have no pose and are not used; take more photos between them and the others, "
            f"or estimate all poses again with 'hyrfpack poses {shlex.quote(str(path))} -o SCENE'"
        )
    if not len(scene.points):
        found.append(
            "there are no points, so training starts at random positions; add the points of the reconstruction"
        )
    return found


def _copy_problems(
    photos: list[Path],
    measurements: list[_PixelMeasurement],
    folder: Path,
    report_progress: Callable[[str, float], None],
) -> list[str]:
    """Describe copies of photos, or a set that shows the same picture throughout."""
    thumbnails = np.stack([measurement.thumbnail for measurement in measurements])
    if len(measurements) > 2 and np.abs(thumbnails - thumbnails[0]).mean(axis=(1, 2)).max() < _SAME_PICTURE_MAX_LEVELS:
        return ["all photos show the same picture; walk around and take photos from many places"]
    sizes: dict[int, list[Path]] = {}
    for photo in photos:
        sizes.setdefault(photo.stat().st_size, []).append(photo)
    seen: dict[bytes, Path] = {}
    copies = []
    suspects = [item for group in sizes.values() if len(group) > 1 for item in group]
    for done, photo in enumerate(suspects):
        compared = f"searching for identical photos {done + 1}/{len(suspects)}"
        report_progress(compared, _PIXELS_PROGRESS + (1 - _PIXELS_PROGRESS) * done / len(suspects))
        digest = hashlib.sha256(photo.read_bytes()).digest()
        if digest in seen:
            copies.append((photo, seen[digest]))
        seen.setdefault(digest, photo)
    if not copies:
        return []
    first, of = (_relative_name(item, folder) for item in copies[0])
    return [
        f"{format_photo_count(len(copies))} {_be(len(copies))} a copy of another (such as {first} of {of}); "
        "remove the copies"
    ]


def _blur_problems(measurements: list[_PixelMeasurement], blurred: list[Path], folder: Path) -> list[str]:
    """Describe a blurred set, or its blurred photos."""
    values = [measurement.sharpness for measurement in measurements]
    if np.median(values) < MIN_SHARPNESS:
        return [
            "most photos are blurred; take them again with the camera held still, in more light, and "
            "focused on what you photograph"
        ]
    if not blurred:
        return []
    names = format_file_names([_relative_name(item, folder) for item in blurred])
    return [
        f"{format_photo_count(len(blurred))} {_be(len(blurred))} blurred ({names}); leave out or retake blurred photos"
    ]


def _light_problems(
    measurements: list[_PixelMeasurement], light: np.ndarray, stops: float, folder: Path, scene: Scene | None
) -> list[str]:
    """Describe dark, clipped or unevenly exposed photos."""
    if scene is not None and scene.has_alpha:
        return []  # transparent pixels are not dark
    found = []
    middle = float(np.median(light))
    if 2**middle < _MIN_SET_LUMINANCE:
        found.append("the photos are dark; take them in more light, or with a longer exposure and a tripod")
    dark = [
        _relative_name(measurement.path, folder)
        for measurement, value in zip(measurements, light, strict=True)
        if value < middle - _DARK_PHOTO_STOPS
    ]
    if dark:
        found.append(
            f"{format_photo_count(len(dark))} {_be(len(dark))} over {_DARK_PHOTO_STOPS:g} stops darker than the others "
            f"({format_file_names(dark)}); leave out dark photos"
        )
    bright = [
        _relative_name(measurement.path, folder)
        for measurement in measurements
        if measurement.exposure.bright > _MAX_CLIPPED_PIXEL_RATIO
    ]
    if len(bright) > len(measurements) / 4:
        found.append(
            f"{format_photo_count(len(bright))} {_be(len(bright))} overexposed in a quarter or more of the "
            f"pixels ({format_file_names(bright)}); reduce the exposure, and lock it"
        )
    if stops > _MAX_EXPOSURE_SPREAD_STOPS:
        found.append(
            f"the photos differ by {stops:.1f} stops in brightness; lock exposure and white balance while you take them"
        )
    return found


def _zoom_problems(facts: list[PhotoFacts]) -> list[str]:
    """Describe a mixture of focal lengths of one device."""
    lengths: dict[str, set[float]] = {}
    for fact in facts:
        if fact.focal is not None:
            known = lengths.setdefault(fact.device, set())
            relative = fact.focal / max(fact.size)
            if not any(abs(relative / other - 1) < _SAME_ZOOM_TOLERANCE for other in known):
                known.add(relative)
    most = max((len(values) for values in lengths.values()), default=0)
    if most < 2:
        return []
    device = max(lengths, key=lambda name: len(lengths[name]))
    return [
        f"the photos have {most} different focal lengths{f' ({device})' if device else ''}; each gets its own "
        "intrinsics, but poses are less reliable; use one lens, and do not zoom"
    ]


def _mask_problems(folder: Path, photos: list[Path]) -> list[str]:
    """Describe masks whose names match no photo; for photos with poses, `load_scene` reports them."""
    masks = next((folder / name for name in ("masks", "mask") if (folder / name).is_dir()), None)
    there = [] if masks is None else [file for file in masks.rglob("*") if file.suffix.lower() in PICTURE_SUFFIXES]
    names = {photo.stem for photo in photos} | {photo.name for photo in photos}
    stray = sorted(file.name for file in there if file.stem not in names)
    if not stray:
        return []
    return [
        f"{len(stray)} of {len(there)} masks match no photo ({format_file_names(stray)}); give each the name of its "
        "photo"
    ]


def _header_notes(facts: list[PhotoFacts]) -> list[str]:
    """Describe rotated, large and panoramic photos."""
    notes = []
    turned = sum(fact.orientation != 1 for fact in facts)
    if turned:
        notes.append(
            f"{format_photo_count(turned)} {_be(turned)} stored rotated; 'hyrfpack poses' makes upright copies"
        )
    large = sum(max(fact.size) > DEFAULT_MAX_SIZE for fact in facts)
    if large:
        notes.append(
            f"{large} of {len(facts)} photos are larger than {DEFAULT_MAX_SIZE:,} pixels and are shrunk to that for "
            "training; `max_size` sets another limit"
        )
    round_ = sum(fact.size[0] == 2 * fact.size[1] for fact in facts)
    if round_:
        notes.append(
            f"{format_photo_count(round_)} {_be(round_)} twice as wide as high, like those of 360-degree cameras"
        )
    return notes


def _describe_camera(fact: PhotoFacts) -> str:
    """Return the name of a photo's camera, with its focal length in 35 mm equivalents if known."""
    name = fact.device or "unknown camera"
    return name if fact.focal is None else f"{name}, {fact.focal / np.hypot(*fact.size) * np.hypot(36, 24):.0f} mm"


def _count_values(items: Iterable[str]) -> dict[str, int]:
    return dict(Counter(items).most_common())


def _relative_name(path: Path, folder: Path) -> str:
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else str(path)


def _be(count: int) -> str:
    """Return "is" or "are", by the count."""
    return "is" if count == 1 else "are"

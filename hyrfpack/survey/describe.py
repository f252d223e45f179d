"""Describe a set of photos or a video before it is used: its properties, its problems, and what to do about them."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hyrfpack.context import RunContext
from hyrfpack.data import load_scene, pose_commands
from hyrfpack.data.archive import is_archive, unpack
from hyrfpack.data.folder import PhotoFacts, list_photos, list_raw_photos
from hyrfpack.data.preset import detect_preset
from hyrfpack.data.quality import mark_blurred
from hyrfpack.data.unusable import (
    no_photos_error,
    raise_if_single_photo,
    raw_photos_notes,
    unreadable_error,
    unreadable_sentences,
)
from hyrfpack.errors import HyrfDataError, HyrfNoPosesError
from hyrfpack.outputs import VIDEO_SUFFIXES, StrPath
from hyrfpack.poses.frames import survey_frames
from hyrfpack.progress import Progress, TaskEvent
from hyrfpack.scene import DEFAULT_MAX_SIZE, Scene
from hyrfpack.survey.measure import measure_pixels, read_header_facts, relative_name
from hyrfpack.survey.problems import (
    describe_headers,
    find_blur_problems,
    find_copy_problems,
    find_count_problems,
    find_light_problems,
    find_mask_problems,
    find_zoom_problems,
)


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
        sharpness: median sharpness, about 1 for pictures that are sharp to the pixel; 0 for a video, and for photos
            that are too small to measure.
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


def describe_photos(path: StrPath, *, context: RunContext = RunContext()) -> PhotoSurvey:  # noqa: B008 - frozen
    """Describe a folder of photos, with poses or without, a .zip of one, or a video.

    An evenly spaced selection of a large set is examined: the headers of 2,000 photos and the pixels of 150. A video is
    decoded once. No file is written.

    Args:
        path: the folder or file.
        context: progress and stop.

    Raises:
        HyrfDataError: the path does not exist, or has no photo that can be read.

    Example:
        >>> survey = describe_photos("photos/bonsai")
        >>> survey.photos, survey.posed, survey.layout, survey.sizes
        (10, 10, 'nerfstudio', {'48 x 48': 10})
        >>> survey.problems[0]
        'there are only 10 photos; take 20 or more, from all around and with much overlap'
    """
    with context.open_progress("info") as report_progress:
        return _describe(Path(path), report_progress)


def _describe(path: Path, report_progress: Progress) -> PhotoSurvey:
    """Describe photos or a video as `describe_photos` does."""
    if path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES:
        return _describe_video(path, report_progress)
    raise_if_single_photo(path)
    folder = unpack(path) if is_archive(path) else path
    photos = list_photos(folder)
    report_progress(TaskEvent("reading poses", 0.0))
    scene, problems = _load_scene_or_problem(path, folder)
    posed = _list_posed_files(scene)
    photos = _unite_photos(photos, posed)
    if not photos:
        raise no_photos_error(path, folder)
    facts, unreadable = read_header_facts(photos, folder, report_progress)
    measurements, undecodable = measure_pixels([fact.path for fact in facts], folder, report_progress)
    unreadable |= undecodable
    if not measurements:
        raise unreadable_error(path, unreadable, len(photos))
    sharpness = {item.path: item.sharpness for item in measurements if item.sharpness is not None}
    median_sharpness = float(np.median([*sharpness.values()])) if sharpness else 0.0
    mask = mark_blurred([*sharpness.values()])
    blurred = [path for path, is_blurred in zip(sharpness, mask, strict=True) if is_blurred]
    log_luminances = np.log2([max(measurement.exposure.luminance, 1e-6) for measurement in measurements])
    stops = float(np.ptp(np.quantile(log_luminances, (0.05, 0.95))))

    problems += find_count_problems(len(photos), scene, len(posed), path)
    problems += unreadable_sentences(unreadable, len(photos))
    problems += find_copy_problems(photos, measurements, unreadable, folder, report_progress)
    problems += find_blur_problems(median_sharpness, blurred, folder)
    problems += find_light_problems(measurements, log_luminances, stops, folder)
    if scene is None:
        problems += find_zoom_problems(facts) + find_mask_problems(folder, photos, facts)
    notes = (
        list(scene.notes) if scene is not None else describe_headers(facts) + raw_photos_notes(list_raw_photos(folder))
    )
    if len(measurements) + len(unreadable) < len(photos):
        notes.append(f"the pixels of {len(measurements)} of {len(photos)} photos, evenly spaced, were measured")
    preset = ": ".join(detect_preset(scene)) if scene is not None and scene.train else ""
    report_progress(TaskEvent("described", 1.0))
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
        sharpness=round(median_sharpness, 3),
        blurred=tuple(relative_name(item, folder) for item in blurred),
        stops=round(stops, 2),
        luminance=round(float(2 ** np.median(log_luminances)), 4),
        frames=0,
        notes=tuple(notes),
        problems=tuple(problems),
    )


def _describe_video(path: Path, report_progress: Progress) -> PhotoSurvey:
    """Describe a video."""
    report, size, measured_count = survey_frames(path, progress=report_progress)
    problems = [f"a video has no poses; {pose_commands(path)}"]
    return PhotoSurvey(
        path=str(path),
        kind="video",
        photos=report.of,
        layout="",
        posed=0,
        points=0,
        preset="",
        sizes={f"{size[0]} x {size[1]}": report.of},
        cameras={},
        decoded=measured_count,
        sharpness=0.0,
        blurred=(),
        stops=0.0,
        luminance=0.0,
        frames=report.taken,
        notes=(
            f"{report.blurred} frames are blurred and {report.repeated} repeated, and would be skipped",
            *report.notes,
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


def _list_posed_files(scene: Scene | None) -> set[Path]:
    """Return the paths of the photos with poses."""
    files = (getattr(view.load, "path", None) for view in scene.views) if scene is not None else ()
    return {Path(file) for file in files if file is not None}


def _unite_photos(photos: Iterable[Path], posed: Collection[Path]) -> list[Path]:
    """Return the photos with poses, and those without in the same folders or below, each file under one path.

    Other folders hold other versions of the photos, such as originals before undistortion.
    """
    if not posed:
        return sorted(photos)
    by_file = {os.path.realpath(photo): photo for photo in posed}
    root = os.path.commonpath([os.path.dirname(file) for file in by_file])
    for photo in photos:
        file = os.path.realpath(photo)
        if Path(file).is_relative_to(root):
            by_file.setdefault(file, photo)
    return sorted(by_file.values())


def _describe_camera(fact: PhotoFacts) -> str:
    """Return the name of a photo's camera, with its focal length in 35 mm equivalents if known."""
    name = fact.device or "unknown camera"
    return name if fact.focal is None else f"{name}, {fact.focal / np.hypot(*fact.size) * np.hypot(36, 24):.0f} mm"


def _count_values(items: Iterable[str]) -> dict[str, int]:
    return dict(Counter(items).most_common())

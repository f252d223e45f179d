"""What a set of photos, or a video, is like before anything is made of it, what is wrong with it and what to do."""

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
    explain_no_photos,
    format_file_names,
    format_photo_count,
    raise_if_single_photo,
    raw_photos_notes,
    unreadable_sentences,
)
from hyrfpack.errors import HyrfDataError, HyrfNoPosesError, strip_path
from hyrfpack.outputs import PICTURE_SUFFIXES, VIDEO_SUFFIXES, StrPath
from hyrfpack.parallel.pool import thread_count
from hyrfpack.scene import DEFAULT_MAX_SIZE, Scene, evenly_spaced
from hyrfpack.train.setup import detect_preset

MOST_DECODED, MOST_OPENED = 150, 2000  # photos, spread over larger sets: seconds, not minutes

_FEW = 20  # photos: fewer hardly see a thing from all sides
_UNEVEN = 2.5  # stops between the lightest and the darkest twentieth; real sets at one exposure have up to 2
_DARK, _DARKER = 0.02, 3.0  # mean luminance of a dark set; stops below the median of a dark photo
_CLIPPED = 0.25  # of the pixels
_SAME_ZOOM = 0.03  # relative difference of focal lengths that EXIF rounds to
_SAME_PICTURE = 1.0  # mean difference in levels of 255 of two thumbnails
_HEADERS_SHARE, _LOOKS_SHARE = 0.2, 0.95  # of the work, that is done once headers are read, and pixels looked at
_THUMBNAIL = 24  # pixels a side


@dataclass(frozen=True)
class PhotoSurvey:
    """What a set of photos is like; `dataclasses.asdict` of it goes into JSON.

    Attributes:
        path: what was described.
        kind: "photos" or "video".
        photos: how many there are; of a video, frames.
        layout: of the poses, "" where there are none.
        posed: photos with poses.
        points: of the reconstruction.
        preset: that training would take, and why; "" without poses.
        sizes: "4032 x 3024" -> photos, the most frequent first; of upright pictures.
        cameras: "Apple iPhone 12, 26 mm" -> photos; of those whose headers were read.
        decoded: photos whose pixels were looked at, for what follows.
        sharpness: their median, about 1 where pictures are sharp to the pixel; 0 of a video, as light is.
        blurred: names of those blurred beside the others.
        stops: how far the lightest and the darkest twentieth of them are apart, in stops.
        luminance: the median of their mean linear luminance, in [0, 1].
        frames: of a video, how many would be taken.
        notes: sentences about what is there.
        problems: sentences about what is wrong, each with what to do.
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
class _Look:
    """What the pixels of one photo say."""

    path: Path
    sharpness: float
    exposure: Exposure
    thumbnail: np.ndarray  # (_THUMBNAIL, _THUMBNAIL) in [0, 255]


def describe_photos(path: StrPath, *, report: Callable[[str, float], None] | None = None) -> PhotoSurvey:
    """Describe a folder of photos, with poses or without, a .zip of one, or a video.

    Of large sets a part is looked at, evenly spread: the headers of 2,000 photos and the pixels of 150. A video is
    decoded once, and nothing is written.

    Args:
        path: the folder or file.
        report: called with what is going on and the share of the work that is done, in [0, 1].

    Raises:
        HyrfDataError: there is no such path, there are no photos in it, or none that can be read.

    Example:
        >>> survey = describe_photos("photos/bonsai")
        >>> survey.photos, survey.posed, survey.layout, survey.sizes
        (10, 10, 'nerfstudio', {'48 x 48': 10})
        >>> survey.problems[0]
        'there are only 10 photos; take 20 or more, from all around and with much overlap'
    """
    path = Path(path)
    tell = report or (lambda text, share: None)
    if path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES:
        return _describe_video(path, tell)
    raise_if_single_photo(path)
    folder = unpack(path) if is_archive(path) else path
    photos = list_photos(folder)
    tell("reading poses", 0.0)
    scene, problems = _scene(path, folder)
    posed = _posed_files(scene)
    photos = sorted({*photos, *posed})
    if not photos:
        raise HyrfDataError(explain_no_photos(path, folder))
    facts, unreadable = _headers(photos, folder, tell)
    looks, undecodable = _looks([fact.path for fact in facts], folder, tell)
    unreadable |= undecodable
    if not looks:
        raise HyrfDataError(f"{path}: {'; '.join(unreadable_sentences(unreadable, len(photos)))}")
    blurred = [look.path for look, bad in zip(looks, is_blurred([x.sharpness for x in looks]), strict=True) if bad]
    light = np.log2([max(look.exposure.luminance, 1e-6) for look in looks])
    stops = float(np.ptp(np.quantile(light, (0.05, 0.95))))

    problems += _count_problems(len(photos), scene, len(posed), path)
    problems += unreadable_sentences(unreadable, len(photos))
    problems += _copies(photos, looks, folder, tell)
    problems += _blur_problems(looks, blurred, folder)
    problems += _light_problems(looks, light, stops, folder, scene)
    if scene is None:
        problems += _zoom_problems(facts) + _mask_problems(folder, photos)
    notes = list(scene.notes) if scene is not None else _header_notes(facts) + raw_photos_notes(list_raw_photos(folder))
    if len(looks) + len(unreadable) < len(photos):
        notes.append(f"the pixels of {len(looks)} of {len(photos)} photos were looked at, evenly spread")
    preset = ": ".join(detect_preset(scene)) if scene is not None and scene.train else ""
    tell("described", 1.0)
    return PhotoSurvey(
        path=str(path),
        kind="photos",
        photos=len(photos),
        layout=scene.layout if scene is not None else "",
        posed=len(posed) or (len(scene.views) if scene is not None else 0),
        points=len(scene.points) if scene is not None else 0,
        preset=preset,
        sizes=_counted(f"{fact.size[0]} x {fact.size[1]}" for fact in facts),
        cameras=_counted(_camera(fact) for fact in facts),
        decoded=len(looks),
        sharpness=round(float(np.median([look.sharpness for look in looks])), 3),
        blurred=tuple(_below(item, folder) for item in blurred),
        stops=round(stops, 2),
        luminance=round(float(2 ** np.median(light)), 4),
        frames=0,
        notes=tuple(notes),
        problems=tuple(problems),
    )


def _describe_video(path: Path, tell: Callable[[str, float], None]) -> PhotoSurvey:
    from hyrfpack.poses.frames import survey_frames

    found, size, looked = survey_frames(path, report=tell)
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
            f"{found.blurred} frames are blurred and {found.repeated} repeated, and would not be taken",
            *found.notes,
        ),
        problems=tuple(problems),
    )


def _scene(path: Path, folder: Path) -> tuple[Scene | None, list[str]]:
    """The photos with their poses, or why there are none."""
    try:
        return load_scene(folder, test_every=0, max_size=DEFAULT_MAX_SIZE), []
    except HyrfNoPosesError:
        return None, [f"the photos have no poses; {pose_commands(path)}"]
    except HyrfDataError as error:
        if not list_photos(folder):
            return None, []
        return None, [str(error)]


def _posed_files(scene: Scene | None) -> set[Path]:
    files = (getattr(view.load, "path", None) for view in scene.views) if scene is not None else ()
    return {Path(file) for file in files if file is not None}


def _headers(
    photos: list[Path], folder: Path, tell: Callable[[str, float], None]
) -> tuple[list[PhotoFacts], dict[str, str]]:
    """What the headers of photos say, and why some say nothing."""
    facts, unreadable = [], {}
    chosen = evenly_spaced(photos, MOST_OPENED)
    for done, photo in enumerate(chosen):
        try:
            facts.append(read_photo_facts(photo))
        except HyrfDataError as error:
            unreadable[_below(photo, folder)] = _reason(error, photo)
        read = f"reading the headers of photos, {done + 1:,} of {len(chosen):,}"
        tell(read, _HEADERS_SHARE * (done + 1) / len(chosen))
    return facts, unreadable


def _looks(photos: list[Path], folder: Path, tell: Callable[[str, float], None]) -> tuple[list[_Look], dict[str, str]]:
    """What the pixels of photos say, and why some say nothing."""
    chosen = evenly_spaced(photos, MOST_DECODED)
    looks, undecodable = [], {}
    with ThreadPoolExecutor(thread_count()) as pool:
        for done, found in enumerate(pool.map(_look, chosen)):
            if isinstance(found, _Look):
                looks.append(found)
            else:
                undecodable[_below(chosen[done], folder)] = found
            looked = f"looking at the photos, {done + 1:,} of {len(chosen):,}"
            tell(looked, _HEADERS_SHARE + (_LOOKS_SHARE - _HEADERS_SHARE) * (done + 1) / len(chosen))
    return looks, undecodable


def _look(path: Path) -> _Look | str:
    try:
        gray = read_gray(path)
    except HyrfDataError as error:
        return _reason(error, path)
    small = Image.fromarray(gray).resize((_THUMBNAIL, _THUMBNAIL), Image.Resampling.BOX)
    return _Look(path, measure_sharpness(gray), measure_exposure(gray), 255 * np.asarray(small))


def _reason(error: HyrfDataError, path: Path) -> str:
    return strip_path(error, display_path(path)).partition(";")[0]


def _count_problems(count: int, scene: Scene | None, posed: int, path: Path) -> list[str]:
    found = []
    if count < _FEW:
        found.append(
            f"there {'is' if count == 1 else 'are'} only {format_photo_count(count)}; take {_FEW} or more, from all "
            "around and with much overlap"
        )
    if scene is None or scene.layout == "blender":  # whose splits are used in part
        return found
    without = count - posed
    if posed and without > 0:
        found.append(
            f"{without} of {count} photos have no pose and are not used; take more photos between them and the others, "
            f"or estimate all anew with 'hyrfpack poses {shlex.quote(str(path))} -o SCENE'"
        )
    if not len(scene.points):
        found.append("there are no points, so that training starts at random places; give those of the reconstruction")
    return found


def _copies(photos: list[Path], looks: list[_Look], folder: Path, tell: Callable[[str, float], None]) -> list[str]:
    thumbnails = np.stack([look.thumbnail for look in looks])
    if len(looks) > 2 and np.abs(thumbnails - thumbnails[0]).mean(axis=(1, 2)).max() < _SAME_PICTURE:
        return ["all photos show the same picture; walk around and take photos from many places"]
    sizes: dict[int, list[Path]] = {}
    for photo in photos:
        sizes.setdefault(photo.stat().st_size, []).append(photo)
    seen: dict[bytes, Path] = {}
    copies = []
    suspects = [item for group in sizes.values() if len(group) > 1 for item in group]
    for done, photo in enumerate(suspects):
        compared = f"looking for copies, {done + 1:,} of {len(suspects):,}"
        tell(compared, _LOOKS_SHARE + (1 - _LOOKS_SHARE) * done / len(suspects))
        digest = hashlib.sha256(photo.read_bytes()).digest()
        if digest in seen:
            copies.append((photo, seen[digest]))
        seen.setdefault(digest, photo)
    if not copies:
        return []
    first, of = (_below(item, folder) for item in copies[0])
    return [
        f"{format_photo_count(len(copies))} {_is(len(copies))} a copy of another, {first} of {of} for one; "
        "remove the copies"
    ]


def _blur_problems(looks: list[_Look], blurred: list[Path], folder: Path) -> list[str]:
    values = [look.sharpness for look in looks]
    if np.median(values) < MIN_SHARPNESS:
        return [
            "the photos are blurred, most of them; take them again with the camera held still, in more light, and "
            "focused on what you photograph"
        ]
    if not blurred:
        return []
    names = format_file_names([_below(item, folder) for item in blurred])
    return [
        f"{format_photo_count(len(blurred))} {_is(len(blurred))} blurred ({names}); leave out or retake what is blurred"
    ]


def _light_problems(
    looks: list[_Look], light: np.ndarray, stops: float, folder: Path, scene: Scene | None
) -> list[str]:
    if scene is not None and scene.has_alpha:
        return []  # what is transparent is not dark
    found = []
    middle = float(np.median(light))
    if 2**middle < _DARK:
        found.append("the photos are dark; take them in more light, or with a longer exposure and a tripod")
    dark = [_below(look.path, folder) for look, value in zip(looks, light, strict=True) if value < middle - _DARKER]
    if dark:
        found.append(
            f"{format_photo_count(len(dark))} {_is(len(dark))} far darker than the others ({format_file_names(dark)}); "
            "leave out what is dark"
        )
    bright = [_below(look.path, folder) for look in looks if look.exposure.bright > _CLIPPED]
    if len(bright) > len(looks) / 4:
        found.append(
            f"{format_photo_count(len(bright))} {_is(len(bright))} white over a quarter or more "
            f"({format_file_names(bright)}); expose less, and lock it"
        )
    if stops > _UNEVEN:
        found.append(
            f"the photos differ by {stops:.1f} stops in how light they are; lock exposure and white balance while you "
            "take them"
        )
    return found


def _zoom_problems(facts: list[PhotoFacts]) -> list[str]:
    lengths: dict[str, set[float]] = {}
    for fact in facts:
        if fact.focal is not None:
            known = lengths.setdefault(fact.device, set())
            relative = fact.focal / max(fact.size)
            if not any(abs(relative / other - 1) < _SAME_ZOOM for other in known):
                known.add(relative)
    most = max((len(values) for values in lengths.values()), default=0)
    if most < 2:
        return []
    device = max(lengths, key=lambda name: len(lengths[name]))
    return [
        f"photos of {most} zooms or lenses are mixed{f' ({device})' if device else ''}, which are told apart but posed "
        "less surely; keep one, and do not zoom"
    ]


def _mask_problems(folder: Path, photos: list[Path]) -> list[str]:
    """Masks that are named as no photo is; with poses the reader says so."""
    masks = next((folder / name for name in ("masks", "mask") if (folder / name).is_dir()), None)
    there = [] if masks is None else [file for file in masks.rglob("*") if file.suffix.lower() in PICTURE_SUFFIXES]
    names = {photo.stem for photo in photos} | {photo.name for photo in photos}
    stray = sorted(file.name for file in there if file.stem not in names)
    if not stray:
        return []
    return [
        f"{len(stray)} of {len(there)} masks are of no photo ({format_file_names(stray)}); name each as its photo is"
    ]


def _header_notes(facts: list[PhotoFacts]) -> list[str]:
    notes = []
    turned = sum(fact.orientation != 1 for fact in facts)
    if turned:
        notes.append(
            f"{format_photo_count(turned)} {_is(turned)} stored on the side; 'hyrfpack poses' makes upright copies"
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
            f"{format_photo_count(round_)} {_is(round_)} twice as wide as high, as those of 360-degree cameras are"
        )
    return notes


def _camera(fact: PhotoFacts) -> str:
    name = fact.device or "unknown camera"
    return name if fact.focal is None else f"{name}, {fact.focal / np.hypot(*fact.size) * np.hypot(36, 24):.0f} mm"


def _counted(items: Iterable[str]) -> dict[str, int]:
    return dict(Counter(items).most_common())


def _below(path: Path, folder: Path) -> str:
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else str(path)


def _is(count: int) -> str:
    return "is" if count == 1 else "are"

"""Prepare the photos of a scene: read their headers, drop copies, turn them upright, and cut panoramas into faces."""

from __future__ import annotations

import os
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import compress
from pathlib import Path, PurePosixPath
from typing import TypeVar

import numpy as np
from PIL import Image

from hyrfpack.copying import copy_file
from hyrfpack.data import masks as mask_files
from hyrfpack.data.archive import display_path
from hyrfpack.data.equirectangular import CUBE_FACES, Face, FaceFile, cut_panorama, face_lens, face_size, is_panorama
from hyrfpack.data.folder import PhotoFacts, choose_original, read_photo_facts
from hyrfpack.data.masks import MaskedPhoto, MaskMatches, choose_mask_orientations
from hyrfpack.data.pictures import open_picture, read_header, read_mask, turn_upright
from hyrfpack.data.unusable import INVALID_NAME_REASON
from hyrfpack.errors import HyrfDataError, strip_path
from hyrfpack.outputs import StrPath
from hyrfpack.parallel.threads import thread_count
from hyrfpack.poses.job import Device
from hyrfpack.poses.owned_files import hash_file
from hyrfpack.progress import Progress, TaskEvent, ignore_progress

# Photos with these endings are copied, because other programs that read scenes know these formats.
_COPIED_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp")
_SUFFIXES_WRITTEN_AS_JPEG = (".jpg", ".jpeg", ".heic", ".heif")  # photos with other endings are rewritten as PNG
_JPEG_SAVE_OPTIONS = {"quality": 95, "subsampling": 0}
_PNG_MODES = ("1", "L", "LA", "I;16", "I;16B", "P", "RGB", "RGBA")
_EXIF_ORIENTATION_TAG = 0x0112
_MAX_BURST_GAP_SECONDS = 2.0  # the median gap between the photos of a sequence is at most this long

_FACE_NAME_TAKEN_REASON = "another picture has the name of one of its faces"
_COPYING_TASK = "copying photos"
COPY_REASON_PREFIX = "a copy of"  # the reason for leaving out a copy begins with these words

Item = TypeVar("Item")
Result = TypeVar("Result")


@dataclass(frozen=True)
class Photo:
    """A photo of the scene, or one face of a panorama.

    Attributes:
        name: path relative to the scene's images/.
        facts: header facts of the source file; for a face, facts of the face with the path of the panorama.
        source: path of the source file relative to the folder of photos.
        face: the face of the panorama; None for an ordinary photo.
    """

    name: str
    facts: PhotoFacts
    source: str
    face: Face | None = None

    @property
    def is_usable_unchanged(self) -> bool:
        """Return whether the source file can be used without rewriting it."""
        return self.face is None and self.facts.orientation == 1 and self.facts.path.suffix.lower() in _COPIED_SUFFIXES

    def source_size(self, in_place: bool) -> tuple[int, int]:
        """Return the (width, height) in pixels of the source picture, as stored if it is used `in_place`, else upright.

        The source of a face is the panorama.
        """
        size = self.facts.size if self.face is None else read_header(self.facts.path).size
        return size[::-1] if in_place and self.facts.orientation >= 5 else size

    def with_mask(self, mask: Path, in_place: bool) -> MaskedPhoto:
        """Return the photo with its mask; the source is used as it is stored (`in_place`), or is turned upright."""
        return MaskedPhoto(mask, self.source_size(in_place), 1 if in_place else self.facts.orientation)


def read_headers(
    root: Path, files: Sequence[Path], in_place: bool, progress: Progress = ignore_progress
) -> tuple[list[Photo], dict[str, str]]:
    """Read the headers of all photos; a panorama of the whole sphere becomes six photos, its faces.

    Args:
        root: folder to which names are relative.
        files: photos in that folder.
        in_place: the photos are used where they are, without copying or changing them.
        progress: called with a `TaskEvent` after each file.

    Returns:
        The usable photos, sorted by name with numbers in their order, and the reason for each photo that is left out,
        by its path below `root`. A path that is not valid UTF-8, which pycolmap cannot store, has escapes in place of
        the invalid bytes.

    Raises:
        HyrfDataError: there is a panorama and `in_place` is set.
    """
    photos: list[Photo] = []
    left_out: dict[str, str] = {}
    # Names that faces and rewritten photos must not get. Some file systems ignore letter case.
    taken_names = {path.relative_to(root).as_posix().casefold() for path in files}
    headers = _map_on_threads(_read_facts_or_reason, files, progress, "reading the headers of photos", len(files))
    is_usable = [
        _shown_name(path.relative_to(root)) == str(path.relative_to(root)) and not isinstance(facts, str)
        for path, facts in zip(files, headers, strict=True)
    ]
    originals = _find_copies(compress(files, is_usable))
    for path, facts in zip(files, headers, strict=True):
        source = path.relative_to(root).as_posix()
        shown_name = _shown_name(source)
        if shown_name != source:
            left_out[shown_name] = f"{INVALID_NAME_REASON}; rename it"
            continue
        if isinstance(facts, str):
            left_out[source] = facts
            continue
        if path in originals:
            left_out[source] = f"{COPY_REASON_PREFIX} {originals[path].relative_to(root).as_posix()}"
            continue
        panorama = _is_panorama_or_reason(path)
        if isinstance(panorama, str):
            left_out[source] = panorama
            continue
        if panorama:
            if in_place:
                raise HyrfDataError(
                    f"{path}: this picture is a panorama, which cannot be cut into photos in its own folder",
                    fix="put the panoramas into a folder of their own, and choose another folder for the scene",
                )
            faces = _make_faces(facts, source)
            names = {face.name.casefold() for face in faces}
            if taken_names.isdisjoint(names):
                taken_names |= names
                photos += faces
            else:
                left_out[source] = _FACE_NAME_TAKEN_REASON
            continue
        photo = Photo(source, facts, source)
        if not (in_place or photo.is_usable_unchanged):
            photo = Photo(_rewritten_name(source, taken_names), facts, source)
            taken_names.add(photo.name.casefold())
        photos.append(photo)
    return sorted(photos, key=lambda photo: _natural_key(photo.name)), left_out


def _shown_name(name: StrPath) -> str:
    """Return a name or path as messages show it, without bytes that are not UTF-8."""
    return os.fsencode(name).decode("utf-8", "backslashreplace")


def _find_copies(photos: Iterable[Path]) -> dict[Path, Path]:
    """Return the original of each photo that is a copy of another, byte for byte. Photos of one size are hashed."""
    by_size, by_content = defaultdict(list), defaultdict(list)
    for photo in photos:
        by_size[photo.stat().st_size].append(photo)
    for size, group in by_size.items():
        for photo in group if len(group) > 1 else ():
            by_content[size, hash_file(photo)].append(photo)
    originals = [(choose_original(group), group) for group in by_content.values()]
    return {photo: original for original, group in originals for photo in group if photo != original}


def _natural_key(name: str) -> tuple[list[str | int], str]:
    """Return a key that sorts frame_2 before frame_10, so that neighbours in a sequence of frames stay neighbours."""
    # Texts and numbers alternate, so that only equal kinds are compared.
    parts = [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", name)]
    return parts, name


def select_unreadable(left_out: Mapping[str, str]) -> dict[str, str]:
    """Select the unreadable photos, without copies, from those that `read_headers` leaves out."""
    return {
        name: reason
        for name, reason in left_out.items()
        if not reason.startswith((COPY_REASON_PREFIX, _FACE_NAME_TAKEN_REASON))
    }


def group_by_device(photos: Sequence[Photo], in_place: bool) -> tuple[tuple[Device, ...], tuple[int, ...]]:
    """Group photos by camera: equal folder, EXIF device name, size, and focal length (to 1 % of the longer side).

    Returns:
        The cameras, and for each photo the index of its camera.
    """
    devices: dict[tuple, int] = {}
    distinct: list[Device] = []
    device_indices = []
    for photo in photos:
        facts = photo.facts
        size = facts.size if photo.face else photo.source_size(in_place)
        zoom = None if facts.focal is None else round(facts.focal / max(size), 2)
        key = (str(PurePosixPath(photo.name).parent), facts.device, size, zoom)
        if key not in devices:
            devices[key] = len(distinct)
            distinct.append(Device(size, facts.focal))
        device_indices.append(devices[key])
    return tuple(distinct), tuple(device_indices)


def is_ordered_sequence(photos: Sequence[Photo]) -> bool:
    """Return whether photos form a sequence, such as a burst or video frames, by their EXIF times or file numbers."""
    times = [photo.facts.taken for photo in photos]
    if all(time is not None for time in times):
        gaps = sorted(abs(b - a) for a, b in zip(times, times[1:], strict=False))  # type: ignore[operator]
        return bool(gaps) and gaps[len(gaps) // 2] <= _MAX_BURST_GAP_SECONDS
    if any(photo.facts.device for photo in photos):
        return False
    matches = [re.fullmatch(r"(.*?)(\d+)", PurePosixPath(photo.name).with_suffix("").as_posix()) for photo in photos]
    if not all(matches):
        return False
    stems = {match[1] for match in matches if match}
    numbers = sorted(int(match[2]) for match in matches if match)
    return len(stems) == 1 and len(set(numbers)) == len(numbers)


def make_images(photos: Sequence[Photo], folder: Path, progress: Progress = ignore_progress) -> None:
    """Write photos into a new folder: copies of usable files, upright pictures of others, and faces of panoramas.

    Args:
        photos: photos to write, each under its name.
        folder: the new folder.
        progress: called with `TaskEvent`s.
    """
    for parent in {(folder / photo.name).parent for photo in photos}:
        parent.mkdir(parents=True, exist_ok=True)
    ordinary = [photo for photo in photos if photo.face is None]
    _map_on_threads(
        lambda photo: _write_photo(photo, folder / photo.name), ordinary, progress, _COPYING_TASK, len(photos)
    )
    panoramas = {photo.facts.path: (folder / photo.name).parent for photo in photos if photo.face}
    for number, (path, target_folder) in enumerate(panoramas.items(), start=1):
        cut_panorama(path, target_folder)
        progress(_count_event(_COPYING_TASK, len(ordinary) + number * len(CUBE_FACES), len(photos)))


def find_masks(photos: Sequence[Photo], folder: Path, in_place: bool) -> MaskMatches:
    """Find the mask of each photo that has one, by the name of the photo; a face has the mask of its panorama.

    Args:
        photos: the photos.
        folder: the folder of masks.
        in_place: the photos are used as they are stored, and their masks with them.

    Raises:
        HyrfDataError: a mask has another aspect ratio than its photo, or cannot be read.
    """
    sources = {photo.source: photo for photo in photos}  # one of the faces stands for their panorama
    sizes = {source: photo.source_size(in_place) for source, photo in sources.items()}
    matches = mask_files.find_masks(folder, list(sizes.items()), set())
    choose_mask_orientations([sources[source].with_mask(mask, in_place) for source, mask in matches.by_photo.items()])
    by_name = {photo.name: matches.by_photo[photo.source] for photo in photos if photo.source in matches.by_photo}
    return replace(matches, by_photo=by_name)


def make_masks(photos: Sequence[Photo], masks: dict[str, Path], folder: Path) -> dict[str, Path]:
    """Write upright masks into a new folder, under the photo's name + ".png"; return their paths by photo name."""
    written = {}
    masked = [photo for photo in photos if photo.name in masks]
    orientations = choose_mask_orientations([photo.with_mask(masks[photo.name], in_place=False) for photo in masked])
    for photo, orientation in zip(masked, orientations, strict=True):
        mask, target = masks[photo.name], folder / f"{photo.name}.png"
        target.parent.mkdir(parents=True, exist_ok=True)
        if photo.face is not None:
            usable = FaceFile(
                photo.facts.path, photo.source_size(in_place=False), photo.face, photo.facts.size[0], mask
            )().mask
            assert usable is not None  # a FaceFile with a mask always loads one
        else:
            header = read_header(mask).turned(orientation)
            usable = read_mask(mask, header.height, header.width, orientation=orientation)
        if photo.face is None and orientation == 1 and mask.suffix.lower() == ".png":
            copy_file(mask, target, keep_metadata=True)
        else:
            # Black becomes exactly 0, because a PNG does not show that it was a lossy JPEG.
            Image.fromarray(usable.astype(np.uint8) * 255).save(target)
        written[photo.name] = target
    return written


def _read_facts_or_reason(path: Path) -> PhotoFacts | str:
    """Return the header facts of a photo, or the reason why it cannot be read."""
    try:
        return read_photo_facts(path)
    except HyrfDataError as error:
        return strip_path(error, display_path(path))


def _is_panorama_or_reason(path: Path) -> bool | str:
    """Return whether a picture is a panorama, or the reason why it cannot be read."""
    try:
        return is_panorama(path)
    except HyrfDataError as error:
        return strip_path(error, display_path(path))


def _map_on_threads(
    function: Callable[[Item], Result], items: Sequence[Item], progress: Progress, task: str, count: int
) -> list[Result]:
    """Call a function for each item on threads and report how many of `count` are done; return the results in order."""
    results = []
    with ThreadPoolExecutor(thread_count()) as pool:
        try:
            for number, result in enumerate(pool.map(function, items), start=1):
                progress(_count_event(task, number, count))
                results.append(result)
        except BaseException:  # such as a stop, which `progress` raises
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return results


def _count_event(task: str, done: int, count: int) -> TaskEvent:
    return TaskEvent(f"{task} {done}/{count}", done / count)


def _make_faces(facts: PhotoFacts, source: str) -> list[Photo]:
    """Return the six faces of a panorama as photos."""
    size = face_size(facts.size[0])
    face_facts = replace(facts, size=(size, size), orientation=1, focal=face_lens(size).fx, device="panorama")
    stem = PurePosixPath(source).with_suffix("").as_posix()
    return [Photo(f"{stem}_{face.name}.jpg", face_facts, source, face) for face in CUBE_FACES]


def _rewritten_name(source: str, taken_names: set[str]) -> str:
    """Return a free name, with the ending of its new format, for a rewritten photo; `taken_names` are casefolded."""
    path = PurePosixPath(source)
    ending = ".jpg" if path.suffix.lower() in _SUFFIXES_WRITTEN_AS_JPEG else ".png"
    if path.suffix.lower() in (ending, ".jpeg"):
        return source
    name = path.with_suffix(ending).as_posix()
    while name.casefold() in taken_names:
        source += ending
        name = source
    return name


def _remaining_orientation(image: Image.Image) -> int:
    """Return the EXIF orientation of a decoded picture; 1 if Pillow has applied it, or the tags are damaged."""
    try:
        return int(image.getexif().get(_EXIF_ORIENTATION_TAG, 1))
    except Exception:  # Pillow raises many types of errors for damaged tags
        return 1


def _write_photo(photo: Photo, target: Path) -> None:
    """Copy a photo, or write it upright if it cannot be used unchanged."""
    if photo.is_usable_unchanged:
        copy_file(photo.facts.path, target, keep_metadata=True)
        return
    with open_picture(photo.facts.path) as image:
        try:
            image.load()
        except Exception:  # Pillow's decoders raise many types of errors
            is_decoded = False
        else:
            is_decoded = image.mode != "F"
        if not is_decoded:  # the feature stage leaves it out
            copy_file(photo.facts.path, target, keep_metadata=True)
            return
        upright = turn_upright(image, _remaining_orientation(image))
        if upright.mode == "I":  # PNG has 16 bits
            upright = Image.fromarray(np.clip(np.asarray(upright), 0, 65535).astype(np.uint16))
        jpeg = target.suffix.lower() in (".jpg", ".jpeg")
        modes = ("L", "RGB") if jpeg else _PNG_MODES
        profile = image.info.get("icc_profile")
        if upright.mode not in modes:
            if upright.mode in ("CMYK", "LAB", "YCbCr"):  # the colour profile describes the old mode
                profile = None
            upright = upright.convert("RGB")
        metadata = (
            {"icc_profile": profile} if profile and isinstance(profile, bytes) else {}
        )  # a TIFF may state numbers
        upright.save(target, "JPEG" if jpeg else "PNG", **(_JPEG_SAVE_OPTIONS if jpeg else {}), **metadata)

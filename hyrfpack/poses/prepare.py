"""From files as a camera leaves them to a scene's folder of photos: upright, readable, each once."""

from __future__ import annotations

import hashlib
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import TypeVar

import numpy as np
from PIL import Image, ImageOps

from hyrfpack.data import masks as mask_files
from hyrfpack.data.archive import display_path
from hyrfpack.data.equirectangular import FACES, Face, FaceFile, cut_panorama, face_lens, face_size, is_panorama
from hyrfpack.data.folder import PhotoFacts, read_photo_facts
from hyrfpack.data.pictures import open_picture, read_header
from hyrfpack.errors import HyrfDataError, short_reason, strip_path
from hyrfpack.poses.copying import copy_file
from hyrfpack.poses.job import Device

_AS_IS = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp")  # what other programs that read scenes know, too
_JPEG = (".jpg", ".jpeg", ".heic", ".heif")  # what is written as JPEG where it has to be written anew; others as PNG
_QUALITY = {"quality": 95, "subsampling": 0}
_PNG_MODES = ("1", "L", "LA", "I", "I;16", "I;16B", "P", "RGB", "RGBA")
_ORIENTATION = 0x0112
_BURST = 2.0  # seconds between photos that follow each other

_FACE_TAKEN = "another picture has the name of one of its faces"
COPY_REASON = "a copy of"  # what the reason begins with for which a photo is left out

Item = TypeVar("Item")
Progress = Callable[[int], None]  # told how many photos are done


@dataclass(frozen=True)
class Photo:
    """A photo that is used.

    Attributes:
        name: its path below the scene's images/.
        facts: of the file it comes from.
        source: that file's path below the folder that was named.
        face: of a panorama, which face of it this is; the facts are of the face then, but for the path.
    """

    name: str
    facts: PhotoFacts
    source: str
    face: Face | None = None

    @property
    def kept(self) -> bool:
        """Whether the file can be used as it is."""
        return self.face is None and self.facts.orientation == 1 and self.facts.path.suffix.lower() in _AS_IS


def look_at(
    root: Path, files: Sequence[Path], in_place: bool, progress: Progress = lambda done: None
) -> tuple[list[Photo], dict[str, str]]:
    """Read all headers. A panorama of the whole sphere becomes six photos, its faces.

    Args:
        root: the folder that names are relative to.
        files: in it.
        in_place: they stay where they are, as they are.
        progress: called with the number of files that were read so far.

    Returns:
        Photos that can be used, sorted by name, and the reason for each other one.

    Raises:
        HyrfDataError: there are panoramas among photos that stay where they are.
    """
    photos: list[Photo] = []
    left_out: dict[str, str] = {}
    taken = {path.relative_to(root).as_posix() for path in files}  # names of files that are used as they are
    first_with: dict[tuple[int, str], str] = {}
    sizes = Counter(path.stat().st_size for path in files)
    with ThreadPoolExecutor() as pool:
        found = list(_counted(pool.map(_facts_or_reason, files), progress))
    for path, facts in zip(files, found, strict=True):
        source = path.relative_to(root).as_posix()
        if isinstance(facts, str):
            left_out[source] = facts
            continue
        size = path.stat().st_size
        if sizes[size] > 1:
            original = first_with.setdefault((size, _digest(path)), source)
            if original != source:
                left_out[source] = f"{COPY_REASON} {original}"
                continue
        panorama = _is_panorama_or_reason(path)
        if isinstance(panorama, str):
            left_out[source] = panorama
            continue
        if panorama:
            if in_place:
                raise HyrfDataError(
                    f"{path}: this picture shows all around and cannot be cut into photos where it is; put such "
                    "pictures into a folder, name it, and another one for the scene"
                )
            faces = _faces(facts, source)
            if taken.isdisjoint(face.name for face in faces):
                taken.update(face.name for face in faces)
                photos += faces
            else:
                left_out[source] = _FACE_TAKEN
            continue
        photo = Photo(source, facts, source)
        if not (in_place or photo.kept):
            photo = Photo(_written_name(source, taken), facts, source)
            taken.add(photo.name)
        photos.append(photo)
    return sorted(photos, key=lambda photo: photo.name), left_out


def only_unreadable(left_out: Mapping[str, str]) -> dict[str, str]:
    """Of the photos that `look_at` leaves out, those that cannot be read."""
    return {name: reason for name, reason in left_out.items() if not reason.startswith((COPY_REASON, _FACE_TAKEN))}


def devices_of(photos: Sequence[Photo], in_place: bool) -> tuple[tuple[Device, ...], tuple[int, ...]]:
    """Tell cameras apart: by folder, EXIF's name of the device, size, and focal length to a percent.

    Returns:
        The cameras, and the index of each photo's.
    """
    devices: dict[tuple, int] = {}
    made: list[Device] = []
    of = []
    for photo in photos:
        facts = photo.facts
        turned = in_place and facts.orientation >= 5  # the picture is used as it is stored
        size = facts.size[::-1] if turned else facts.size
        zoom = None if facts.focal is None else round(facts.focal / max(size), 2)
        key = (str(PurePosixPath(photo.name).parent), facts.device, size, zoom)
        if key not in devices:
            devices[key] = len(made)
            made.append(Device(size, facts.focal))
        of.append(devices[key])
    return tuple(made), tuple(of)


def in_order(photos: Sequence[Photo]) -> bool:
    """Whether photos follow each other, as bursts and frames of a video do: by EXIF's time or by running numbers."""
    times = [photo.facts.taken for photo in photos]
    if all(time is not None for time in times):
        gaps = sorted(abs(b - a) for a, b in zip(times, times[1:], strict=False))  # type: ignore[operator]
        return bool(gaps) and gaps[len(gaps) // 2] <= _BURST
    if any(photo.facts.device for photo in photos):
        return False
    found = [re.fullmatch(r"(.*?)(\d+)", PurePosixPath(photo.name).with_suffix("").as_posix()) for photo in photos]
    if not all(found):
        return False
    stems = {match[1] for match in found if match}
    numbers = sorted(int(match[2]) for match in found if match)
    return len(stems) == 1 and len(set(numbers)) == len(numbers)


def make_images(photos: Sequence[Photo], folder: Path, progress: Progress = lambda done: None) -> None:
    """Put the photos into a new folder: copies of files that can be used as they are, upright pictures of others, faces
    of panoramas.

    Args:
        photos: to put there, by their names.
        folder: the new folder.
        progress: called with the number of photos that are there so far.
    """
    for parent in {(folder / photo.name).parent for photo in photos}:
        parent.mkdir(parents=True, exist_ok=True)
    whole = [photo for photo in photos if photo.face is None]
    with ThreadPoolExecutor() as pool:
        list(_counted(pool.map(lambda photo: _put(photo, folder / photo.name), whole), progress))
    panoramas = {photo.facts.path: (folder / photo.name).parent for photo in photos if photo.face}
    for number, (path, place) in enumerate(panoramas.items(), start=1):
        cut_panorama(path, place)
        progress(len(whole) + number * len(FACES))


def find_masks(photos: Sequence[Photo], folder: Path) -> dict[str, Path]:
    """The mask of each photo that has one, by the photo's name."""
    found = mask_files.find_masks(folder, [(photo.source, photo.facts.size) for photo in photos], set())
    by_source = found.by_photo
    return {photo.name: by_source[photo.source] for photo in photos if photo.source in by_source}


def make_masks(photos: Sequence[Photo], masks: dict[str, Path], folder: Path) -> dict[str, Path]:
    """Put masks into a new folder under their photos' names and ".png", upright as these; returns where they are."""
    made = {}
    for photo in photos:
        if photo.name not in masks:
            continue
        mask, target = masks[photo.name], folder / f"{photo.name}.png"
        target.parent.mkdir(parents=True, exist_ok=True)
        if photo.face is not None:
            stored = read_header(photo.facts.path).size
            usable = FaceFile(photo.facts.path, stored, photo.face, photo.facts.size[0], mask)().mask
            assert usable is not None  # one was named
            Image.fromarray(usable.astype(np.uint8) * 255).save(target)
            made[photo.name] = target
            continue
        with open_picture(mask) as image:
            try:
                image.load()
            except Exception as error:  # Pillow's decoders raise whatever they meet
                raise HyrfDataError(
                    f"{mask}: the mask cannot be decoded ({short_reason(error)}); replace it"
                ) from error
            stored = photo.facts.size[::-1] if photo.facts.orientation >= 5 else photo.facts.size
            turned = photo.facts.orientation != 1 and image.size == stored
            if turned:
                image.getexif()[_ORIENTATION] = photo.facts.orientation
                ImageOps.exif_transpose(image).save(target)
            elif mask.suffix.lower() == ".png":
                copy_file(mask, target)
            else:
                image.convert("RGB").save(target)
        made[photo.name] = target
    return made


def _facts_or_reason(path: Path) -> PhotoFacts | str:
    try:
        return read_photo_facts(path)
    except HyrfDataError as error:
        return _reason(error, path)


def _is_panorama_or_reason(path: Path) -> bool | str:
    """Whether a picture is a panorama; why not even that can be told."""
    try:
        return is_panorama(path)
    except HyrfDataError as error:
        return _reason(error, path)


def _reason(error: HyrfDataError, path: Path) -> str:
    """Why a photo cannot be used, without its path and what to do, which is said of all such photos at once."""
    return strip_path(error, display_path(path)).partition(";")[0]


def _counted(items: Iterable[Item], progress: Progress) -> Iterator[Item]:
    """The items; tells how many were taken so far."""
    for number, item in enumerate(items, start=1):
        progress(number)
        yield item


def _digest(path: Path) -> str:
    return hashlib.sha1(path.read_bytes(), usedforsecurity=False).hexdigest()


def _faces(facts: PhotoFacts, source: str) -> list[Photo]:
    """The faces of a panorama, each as a photo."""
    size = face_size(facts.size[0])
    its = replace(facts, size=(size, size), orientation=1, focal=face_lens(size).fx, device="panorama")
    stem = PurePosixPath(source).with_suffix("").as_posix()
    return [Photo(f"{stem}_{face.name}.jpg", its, source, face) for face in FACES]


def _written_name(source: str, taken: set[str]) -> str:
    """What a photo that is written anew is called."""
    path = PurePosixPath(source)
    ending = ".jpg" if path.suffix.lower() in _JPEG else ".png"
    if path.suffix.lower() in (ending, ".jpeg"):
        return source
    name = path.with_suffix(ending).as_posix()
    while name in taken:
        source += ending
        name = source
    return name


def _put(photo: Photo, target: Path) -> None:
    if photo.kept:
        copy_file(photo.facts.path, target)
        return
    with open_picture(photo.facts.path) as image:
        try:
            upright = ImageOps.exif_transpose(image)
        except Exception:  # Pillow's decoders raise whatever they meet
            upright = None
        if upright is None or upright.mode == "F":  # cannot be decoded, or shown: left out when features are found
            copy_file(photo.facts.path, target)
            return
        jpeg = target.suffix.lower() in (".jpg", ".jpeg")
        modes = ("L", "RGB") if jpeg else _PNG_MODES
        profile = image.info.get("icc_profile")
        if upright.mode not in modes:
            profile = None if upright.mode in ("CMYK", "LAB", "YCbCr") else profile  # it is of those colours
            upright = upright.convert("RGB")
        kept = {"icc_profile": profile} if profile else {}
        upright.save(target, "JPEG" if jpeg else "PNG", **(_QUALITY if jpeg else {}), **kept)

"""A folder of photos before anything is known of their poses: which files they are, and what their headers say."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from hyrfpack.data.pictures import is_picture_name, opened, read_header, read_orientation
from hyrfpack.errors import HyrfDataError
from hyrfpack.outputs import RAW_PHOTO_SUFFIXES, StrPath

# Folders of pictures that are no photos: masks, previews, what depth sensors and other programs leave.
_NO_PHOTOS = re.compile(r"masks?(_.*)?|thumb(nail)?s?|depths?(_maps?)?|normals?|confidence", re.IGNORECASE)
_HIDDEN = re.compile(r"\..*|__.*|@eadir", re.IGNORECASE)  # __MACOSX, and the previews of a Synology
_SMALLER = re.compile(r"images_(\d{1,4})", re.IGNORECASE)  # copies of what is in images/
_RESULT = re.compile(r"poses\.json|metrics\.json|.*\.hyrf")  # a folder that holds one of these is of our making
_DIAGONAL_35MM = math.hypot(36, 24)  # mm; what equivalent focal lengths relate to (CIPA DCG-001)
_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # of EXIF's FocalPlaneResolutionUnit
_MAKE, _MODEL, _EXIF = 0x010F, 0x0110, 0x8769
_FOCAL, _FOCAL_35MM, _TAKEN, _SUBSECOND = 0x920A, 0xA405, 0x9003, 0x9291
_PLANE_X, _PLANE_UNIT, _PIXELS_X, _PIXELS_Y = 0xA20E, 0xA210, 0xA002, 0xA003


@dataclass(frozen=True)
class PhotoFacts:
    """What a photo's header says.

    Attributes:
        path: the file.
        size: (width, height) in pixels of the upright picture.
        orientation: EXIF's, 1 to 8; 1 is a picture that is stored upright, 5 to 8 one that is stored on its side.
        focal: focal length in pixels of that picture, or None where the header does not tell.
        device: "Apple iPhone 12"; "" where the header does not tell.
        taken: seconds, by the camera's clock; only differences mean something. None where the header does not tell.
    """

    path: Path
    size: tuple[int, int]
    orientation: int = 1
    focal: float | None = None
    device: str = ""
    taken: float | None = None


def list_photos(folder: StrPath) -> list[Path]:
    """The photos in a folder and the folders in it.

    Left out are hidden files, folders of masks, depth maps and thumbnails, the smaller copies in images_2, images_4
    and so on beside images/, and folders in it that hold results of ours.

    Args:
        folder: to look in. Links to folders are followed.

    Returns:
        Files with a picture's ending in any case, sorted by their paths below the folder; none is opened.

    Raises:
        HyrfDataError: there is no such folder, or it cannot be read.

    Example:
        >>> [path.name for path in list_photos("photos/bonsai")][:2]
        ['0000.png', '0001.png']
    """
    return _listed(Path(folder), is_picture_name, photos=True)


def list_raw_photos(folder: StrPath) -> list[Path]:
    """The raw files of cameras (.CR3, .NEF and so on) where `list_photos` looks for photos; they are never read.

    Args, order and errors are those of `list_photos`.

    Example:
        >>> list_raw_photos("photos/bonsai")
        []
    """
    return _listed(Path(folder), is_raw_name, photos=True)


def list_pictures(folder: StrPath) -> list[Path]:
    """All pictures in a folder and the folders in it, masks, previews and results among them; hidden ones are not.

    Args, order and errors are those of `list_photos`.

    Example:
        >>> [path.name for path in list_pictures("photos/bonsai/images")][:2]
        ['0000.png', '0001.png']
    """
    return _listed(Path(folder), is_picture_name, photos=False)


def is_raw_name(name: str) -> bool:
    """Whether a file is called like a camera's raw photo, and is not hidden."""
    return name.lower().endswith(RAW_PHOTO_SUFFIXES) and not name.startswith(".")


def may_hold_photos(name: str) -> bool:
    """Whether a folder of this name is looked into for photos: not if it is one of masks, previews or depth maps."""
    return not (_HIDDEN.fullmatch(name) or _NO_PHOTOS.fullmatch(name))


def times_smaller(name: str) -> int:
    """How many times smaller the photos in a folder of this name are: 4 for "images_4"; 0 if it is called otherwise."""
    copy = _SMALLER.fullmatch(name)
    return int(copy[1]) if copy else 0


def _listed(root: Path, is_wanted: Callable[[str], bool], photos: bool) -> list[Path]:
    if not os.path.isdir(root):  # Path.is_dir raises where a name is too long
        what = "is a file, not a folder of photos" if os.path.exists(root) else "there is no such folder"
        raise HyrfDataError(f"{root}: {what}; name the folder that holds the photos")
    try:
        found = list(_pictures_below(root, set(), is_wanted, photos))
    except OSError as error:
        raise HyrfDataError(f"{root}: the folder cannot be read ({error.strerror}); check its permissions") from error
    return sorted(found, key=lambda path: path.relative_to(root).as_posix())


def _pictures_below(folder: Path, seen: set[str], is_wanted: Callable[[str], bool], photos: bool) -> Iterator[Path]:
    """Files by their names, in no order; `seen` are the folders that were looked into, which none is twice.

    Args:
        photos: leave out folders that hold no photos.
    """
    place = os.path.realpath(folder)
    with os.scandir(folder) as listing:
        entries = list(listing)
    names = {entry.name.casefold() for entry in entries}
    if place in seen or (photos and seen and any(_RESULT.fullmatch(name) for name in names)):
        return
    seen.add(place)
    folders = []
    for entry in entries:
        if entry.is_dir():
            folders.append(entry)
        elif is_wanted(entry.name) and entry.is_file():
            yield folder / entry.name
    for entry in sorted(folders, key=lambda entry: (entry.is_symlink(), entry.name)):  # by their own names first
        copies = times_smaller(entry.name) and "images" in names
        if _HIDDEN.fullmatch(entry.name) or (photos and (copies or not may_hold_photos(entry.name))):
            continue
        with suppress(PermissionError):
            yield from _pictures_below(folder / entry.name, seen, is_wanted, photos)


def first_readable(photos: Iterable[StrPath]) -> PhotoFacts | None:
    """The facts of the first photo whose header can be read; None where none can.

    Example:
        >>> first_readable(["missing.jpg", "photos/bonsai/images/0000.png"]).size
        (48, 48)
    """
    for photo in photos:
        with suppress(HyrfDataError):
            return photo_facts(photo)
    return None


def photo_facts(path: StrPath) -> PhotoFacts:
    """Read a photo's header: size, orientation, focal length, camera, time. No pixel is decoded.

    The focal length is EXIF's 35 mm equivalent, f = f35 / 43.27 mm * diagonal in pixels, or else the focal length in
    mm times the pixels per mm of the sensor.

    Args:
        path: of the photo.

    Returns:
        Its facts.

    Raises:
        HyrfDataError: the file is missing, empty, or no picture that can be read.

    Example:
        >>> photo_facts("photos/bonsai/images/0000.png").size
        (48, 48)
    """
    path = Path(path)
    orientation, header = read_orientation(path), read_header(path)
    upright = header.turned(orientation).size
    with opened(path) as image:
        try:
            exif = image.getexif()
            tags: dict[int, Any] = {**exif, **exif.get_ifd(_EXIF)}
        except Exception:  # Pillow's parsers raise whatever damaged tags make of them; the picture is good without
            tags = {}
    return PhotoFacts(path, upright, orientation, _focal_in_pixels(tags, *header.size), _device(tags), _time(tags))


def _focal_in_pixels(tags: dict[int, Any], width: int, height: int) -> float | None:
    equivalent, diagonal = _positive(tags.get(_FOCAL_35MM)), math.hypot(width, height)
    if equivalent:
        return equivalent / _DIAGONAL_35MM * diagonal
    focal, density = _positive(tags.get(_FOCAL)), _positive(tags.get(_PLANE_X))
    unit = _UNIT_MM.get(tags.get(_PLANE_UNIT, 2))
    if not (focal and density and unit):
        return None
    # Those of the photo as it was taken: a copy may have been shrunk since.
    taken_wide = max(_positive(tags.get(_PIXELS_X)), _positive(tags.get(_PIXELS_Y))) or max(width, height)
    pixels = focal * density / unit * max(width, height) / taken_wide
    return pixels if 0.1 < pixels / diagonal < 50 else None  # some cameras write densities of prints


def _positive(value: Any) -> float:
    """A tag as a positive number, or 0 where it is none."""
    with suppress(TypeError, ValueError, ZeroDivisionError):
        number = float(value)
        return number if 0 < number < math.inf else 0.0
    return 0.0


def _device(tags: dict[int, Any]) -> str:
    make, model = (str(tags.get(tag) or "").replace("\0", "").strip() for tag in (_MAKE, _MODEL))
    return model if model.lower().startswith(make.lower()) else f"{make} {model}".strip()


def _time(tags: dict[int, Any]) -> float | None:
    with suppress(ValueError, OverflowError):
        seconds = datetime.strptime(str(tags.get(_TAKEN)).strip("\0 "), "%Y:%m:%d %H:%M:%S").timestamp()
        fraction = str(tags.get(_SUBSECOND) or "").strip("\0 ")
        return seconds + (float(f"0.{fraction}") if fraction.isdecimal() else 0.0)
    return None

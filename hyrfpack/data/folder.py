"""List the photos in a folder and read their headers, without poses."""

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

from hyrfpack.data.pictures import is_picture_name, open_picture, read_header, read_orientation
from hyrfpack.errors import HyrfDataError
from hyrfpack.outputs import RAW_PHOTO_SUFFIXES, StrPath

# Folders of pictures that are not photos: masks, previews, and output of depth sensors and other programs.
_NON_PHOTO_FOLDER = re.compile(r"masks?(_.*)?|thumb(nail)?s?|depths?(_maps?)?|normals?|confidence", re.IGNORECASE)
_HIDDEN_FOLDER = re.compile(r"\..*|__.*|@eadir", re.IGNORECASE)  # such as __MACOSX, and @eaDir of Synology
_DOWNSCALED_FOLDER = re.compile(r"images_(\d{1,4})", re.IGNORECASE)  # smaller copies of the photos in images/
_RESULT_FILE = re.compile(r"poses\.json|metrics\.json|.*\.hyrf")  # hyrfpack wrote a folder that holds one of these
_EXPORTED_FILES = ("lod-meta.json", "tileset.json", "hyrf-viewer.js")  # Streamed SOG, 3D Tiles, a player
_FULL_FRAME_DIAGONAL_MM = math.hypot(36, 24)  # equivalent focal lengths refer to it (CIPA DCG-001)
# A focal length in EXIF is used if its ratio to the picture's diagonal lies between these limits, which are 35 mm
# equivalents of 4.3 and 2,163 mm. Some programs write arbitrary numbers, and some cameras state the density of prints.
_MIN_FOCAL_RATIO = 0.1
_MAX_FOCAL_RATIO = 50.0
_MM_PER_RESOLUTION_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # keys are values of EXIF's FocalPlaneResolutionUnit
# Numbers of EXIF tags.
_MAKE_TAG = 0x010F
_MODEL_TAG = 0x0110
_EXIF_IFD_TAG = 0x8769
_FOCAL_LENGTH_TAG = 0x920A
_FOCAL_LENGTH_35MM_TAG = 0xA405
_DATETIME_ORIGINAL_TAG = 0x9003
_SUBSEC_TIME_ORIGINAL_TAG = 0x9291
_FOCAL_PLANE_X_RESOLUTION_TAG = 0xA20E
_FOCAL_PLANE_RESOLUTION_UNIT_TAG = 0xA210
_PIXEL_X_DIMENSION_TAG = 0xA002
_PIXEL_Y_DIMENSION_TAG = 0xA003


@dataclass(frozen=True)
class PhotoFacts:
    """Facts from a photo's header.

    Attributes:
        path: the file.
        size: (width, height) of the upright picture in pixels.
        orientation: EXIF orientation, 1 to 8; 1 means stored upright, 5 to 8 stored on its side.
        focal: focal length in pixels of the upright picture; None if the header does not state it.
        device: for instance "Apple iPhone 12"; "" if the header does not state it.
        taken: time of capture in seconds by the camera's clock; only differences are meaningful. None if the header
            does not state it.
    """

    path: Path
    size: tuple[int, int]
    orientation: int = 1
    focal: float | None = None
    device: str = ""
    taken: float | None = None


def list_photos(folder: StrPath) -> list[Path]:
    """List the photos in a folder and its subfolders.

    These are left out: hidden files, folders of masks, depth maps and thumbnails, smaller copies beside images/
    (images_2, images_4 and so on), and subfolders with results of hyrfpack.

    Args:
        folder: the folder to search. Links to folders are followed.

    Returns:
        Files with the extension of a picture in any letter case, sorted by their paths below the folder. No file is
        opened.

    Raises:
        HyrfDataError: the folder does not exist, cannot be read, or was exported by hyrfpack.

    Example:
        >>> [path.name for path in list_photos("photos/bonsai")][:2]
        ['0000.png', '0001.png']
    """
    for name in _EXPORTED_FILES:
        if os.path.isfile(os.path.join(folder, name)):  # Path.is_file raises if the folder may not be searched
            raise HyrfDataError(
                f"{folder}: this folder was exported ({name}), and its pictures are not photos",
                fix="name the folder of the photos, or the model that was exported",
            )
    return _list_files(Path(folder), is_picture_name, photos_only=True)


def list_raw_photos(folder: StrPath) -> list[Path]:
    """List the raw files of cameras (.CR3, .NEF and so on) in the folders that `list_photos` searches.

    Raw files are never read. Args, order and errors are those of `list_photos`.

    Example:
        >>> list_raw_photos("photos/bonsai")
        []
    """
    return _list_files(Path(folder), is_raw_name, photos_only=True)


def list_pictures(folder: StrPath) -> list[Path]:
    """List all pictures in a folder and its subfolders, including masks, previews and results, but no hidden ones.

    Args, order and errors are those of `list_photos`.

    Example:
        >>> [path.name for path in list_pictures("photos/bonsai/images")][:2]
        ['0000.png', '0001.png']
    """
    return _list_files(Path(folder), is_picture_name, photos_only=False)


def is_raw_name(name: str) -> bool:
    """Return whether a file name has the extension of a camera's raw photo and is not hidden."""
    return name.lower().endswith(RAW_PHOTO_SUFFIXES) and not name.startswith(".")


def may_hold_photos(name: str) -> bool:
    """Return whether a folder of this name may hold photos, unlike those of masks, previews and depth maps."""
    return not (_HIDDEN_FOLDER.fullmatch(name) or _NON_PHOTO_FOLDER.fullmatch(name))


def downscale_factor(name: str) -> int:
    """Return the factor by which a folder's photos are downscaled: 4 for the name "images_4", 0 for other names."""
    match = _DOWNSCALED_FOLDER.fullmatch(name)
    return int(match[1]) if match else 0


def explain_missing_path(path: Path, kind: str) -> str | None:
    """Return the reason why nothing can be read at a path; None if there is a file or folder that can be read.

    Args:
        path: the path.
        kind: what should be there, such as "folder", for the message.
    """
    try:
        os.stat(path)
    except PermissionError as error:
        return f"cannot be read ({error.strerror})"
    except (OSError, ValueError):  # also for names that are too long or have zeros
        return f"no such {kind}"
    return None


def _list_files(root: Path, is_wanted: Callable[[str], bool], photos_only: bool) -> list[Path]:
    """List the files below a folder whose names `is_wanted` accepts, sorted by their relative paths."""
    if not os.path.isdir(root):  # Path.is_dir raises if a name is too long
        what = "is a file, not a folder of photos" if os.path.exists(root) else "there is no such folder"
        raise HyrfDataError(f"{root}: {what}", fix="name the folder that holds the photos")
    try:
        found = list(_walk_files(root, set(), is_wanted, photos_only))
    except OSError as error:
        raise HyrfDataError(
            f"{root}: the folder cannot be read ({error.strerror})",
            fix="check its permissions",
        ) from error
    return sorted(found, key=lambda path: path.relative_to(root).as_posix())


def _walk_files(folder: Path, visited: set[str], is_wanted: Callable[[str], bool], photos_only: bool) -> Iterator[Path]:
    """Yield wanted files of a folder and its subfolders in no particular order.

    Args:
        folder: the folder to search.
        visited: real paths of the folders searched so far, each of which is searched once.
        is_wanted: decides by a file's name.
        photos_only: leave out folders that hold pictures other than photos.
    """
    real_path = os.path.realpath(folder)
    with os.scandir(folder) as listing:
        entries = list(listing)
    names = {entry.name.casefold() for entry in entries}
    if real_path in visited or (photos_only and visited and any(_RESULT_FILE.fullmatch(name) for name in names)):
        return
    visited.add(real_path)
    folders = []
    for entry in entries:
        if _is_folder(entry):
            folders.append(entry)
        elif is_wanted(entry.name) and _is_file(entry):
            yield folder / entry.name
    # Links come last, so that a folder that is reached twice is listed by its real path.
    for entry in sorted(folders, key=lambda entry: (entry.is_symlink(), entry.name)):
        is_downscaled = downscale_factor(entry.name) and "images" in names
        if _HIDDEN_FOLDER.fullmatch(entry.name) or (photos_only and (is_downscaled or not may_hold_photos(entry.name))):
            continue
        with suppress(PermissionError):
            yield from _walk_files(folder / entry.name, visited, is_wanted, photos_only)


def _is_folder(entry: os.DirEntry[str]) -> bool:
    """Return whether an entry is a folder or a link to one; a link that leads nowhere, such as to itself, is not."""
    try:
        return entry.is_dir()
    except OSError:
        return False


def _is_file(entry: os.DirEntry[str]) -> bool:
    """Return whether an entry is a file or a link to one; a link that leads nowhere, such as to itself, is not."""
    try:
        return entry.is_file()
    except OSError:
        return False


def choose_original(copies: Iterable[Path]) -> Path:
    """Return the file of which the others are copies: the shortest name, because programs add to the name of a copy."""
    return min(copies, key=lambda path: len(path.name))


def first_readable_photo(photos: Iterable[StrPath]) -> PhotoFacts | None:
    """Return the facts of the first photo whose header can be read, None if no header can be read.

    Example:
        >>> first_readable_photo(["missing.jpg", "photos/bonsai/images/0000.png"]).size
        (48, 48)
    """
    for photo in photos:
        with suppress(HyrfDataError):
            return read_photo_facts(photo)
    return None


def read_photo_facts(path: StrPath) -> PhotoFacts:
    """Read a photo's size, orientation, focal length, camera and time of capture from its header.

    The focal length follows from EXIF's 35 mm equivalent, f = f35 / 43.27 mm * diagonal in pixels. Without a plausible
    one it is the focal length in mm times the pixels per mm of the sensor. No pixel is decoded.

    Args:
        path: the photo.

    Raises:
        HyrfDataError: the file is missing, empty, or no picture that can be read.

    Example:
        >>> read_photo_facts("photos/bonsai/images/0000.png").size
        (48, 48)
    """
    path = Path(path)
    orientation, header = read_orientation(path), read_header(path)
    upright = header.turned(orientation).size
    with open_picture(path) as image:
        try:
            exif = image.getexif()
            tags: dict[int, Any] = {**exif, **exif.get_ifd(_EXIF_IFD_TAG)}
        except Exception:  # Pillow raises many types for damaged tags, and the picture is usable without tags
            tags = {}
    return PhotoFacts(
        path, upright, orientation, _focal_in_pixels(tags, *header.size), _device_name(tags), _capture_time(tags)
    )


def _focal_in_pixels(tags: dict[int, Any], width: int, height: int) -> float | None:
    """Compute the focal length in pixels from EXIF tags; return None if they state no plausible one."""
    ratios = _focal_ratio_of_equivalent(tags), _focal_ratio_of_sensor(tags, width, height)
    plausible = (ratio * math.hypot(width, height) for ratio in ratios if _MIN_FOCAL_RATIO < ratio < _MAX_FOCAL_RATIO)
    return next(plausible, None)


def _focal_ratio_of_equivalent(tags: dict[int, Any]) -> float:
    """Compute the focal length over the diagonal from its 35 mm equivalent; return 0 if the tags do not state it."""
    return _positive(tags.get(_FOCAL_LENGTH_35MM_TAG)) / _FULL_FRAME_DIAGONAL_MM


def _focal_ratio_of_sensor(tags: dict[int, Any], width: int, height: int) -> float:
    """Compute the focal length over the diagonal from the sensor; return 0 if the tags do not state both."""
    focal, density = _positive(tags.get(_FOCAL_LENGTH_TAG)), _positive(tags.get(_FOCAL_PLANE_X_RESOLUTION_TAG))
    unit = _MM_PER_RESOLUTION_UNIT.get(tags.get(_FOCAL_PLANE_RESOLUTION_UNIT_TAG, 2))
    if not (focal and density and unit):
        return 0.0
    # The density refers to the photo as it was taken, and this file may be a smaller copy.
    dimensions = _positive(tags.get(_PIXEL_X_DIMENSION_TAG)), _positive(tags.get(_PIXEL_Y_DIMENSION_TAG))
    original_side = max(dimensions) or max(width, height)
    return focal * density / unit * max(width, height) / original_side / math.hypot(width, height)


def _positive(value: Any) -> float:
    """Convert a tag to a positive finite number; return 0 if that is not possible."""
    with suppress(TypeError, ValueError, ZeroDivisionError):
        number = float(value)
        return number if 0 < number < math.inf else 0.0
    return 0.0


def _device_name(tags: dict[int, Any]) -> str:
    """Join the make and the model of a camera, without repeating the make."""
    make, model = (str(tags.get(tag) or "").replace("\0", "").strip() for tag in (_MAKE_TAG, _MODEL_TAG))
    return model if model.lower().startswith(make.lower()) else f"{make} {model}".strip()


def _capture_time(tags: dict[int, Any]) -> float | None:
    """Convert the time of capture to seconds, None if the tags do not state it."""
    with suppress(ValueError, OverflowError, OSError):  # OSError: Windows cannot convert times near or before 1970
        seconds = datetime.strptime(str(tags.get(_DATETIME_ORIGINAL_TAG)).strip("\0 "), "%Y:%m:%d %H:%M:%S").timestamp()
        fraction = str(tags.get(_SUBSEC_TIME_ORIGINAL_TAG) or "").strip("\0 ")
        return seconds + (float(f"0.{fraction}") if fraction.isdecimal() else 0.0)
    return None

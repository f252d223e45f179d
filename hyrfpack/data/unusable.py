"""Messages about photos that cannot be used: raw files, unreadable files, and folders without photos."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from hyrfpack.counts import format_count
from hyrfpack.data.folder import list_raw_photos
from hyrfpack.data.pictures import HEIC_REMEDY, HEIC_REQUIREMENT, RAW_REMEDY
from hyrfpack.errors import HyrfDataError
from hyrfpack.outputs import RAW_PHOTO_SUFFIXES, READABLE_PICTURE_SUFFIXES, VIDEO_SUFFIXES

MAX_NAMED_FILES = 3
INVALID_NAME_REASON = "its name is not valid UTF-8"
_REMEDY_BY_REASON_PREFIX = {HEIC_REQUIREMENT: HEIC_REMEDY, INVALID_NAME_REASON: "rename it"}


def format_file_names(names: Sequence[str]) -> str:
    """List the first MAX_NAMED_FILES names and count the others.

    Example:
        >>> format_file_names(["a.jpg", "b.jpg", "c.jpg", "d.jpg", "e.jpg"])
        'a.jpg, b.jpg, c.jpg and 2 more'
    """
    more = len(names) - MAX_NAMED_FILES
    return ", ".join(names[:MAX_NAMED_FILES]) + (f" and {more} more" if more > 0 else "")


def raise_if_single_photo(path: Path) -> None:
    """Raise HyrfDataError if a path is a single photo or raw file and not a folder of photos."""
    ending = path.suffix.lower()
    if ending in RAW_PHOTO_SUFFIXES and path.is_file():
        raise HyrfDataError(f"{path}: raw files are not supported", fix=RAW_REMEDY)
    if ending in READABLE_PICTURE_SUFFIXES and path.is_file():
        raise HyrfDataError(f"{path}: this is one photo, not a folder of photos", fix="name the folder of all photos")


def raw_photos_notes(raw_photos: Sequence[Path]) -> list[str]:
    """Return a list of one note about ignored raw files beside photos; an empty list if there are none."""
    if not raw_photos:
        return []
    noun, verb = ("raw file", "is") if len(raw_photos) == 1 else ("raw files", "are")
    return [
        f"{len(raw_photos):,} {noun} ({_format_extensions(raw_photos)}) {verb} ignored because raw files are "
        "not supported; export those that you want to use as JPEG"
    ]


def unreadable_sentences(reasons: Mapping[str, str], count: int) -> list[str]:
    """Return sentences about photos that cannot be read, one for each remedy.

    Args:
        reasons: maps a photo's name to the reason why it cannot be read.
        count: number of all photos, readable or not.

    Example:
        >>> unreadable_sentences({"a.jpg": "the picture file is empty"}, 40)
        ['1 of 40 photos cannot be read: a.jpg (the picture file is empty); copy it again, or remove it']
    """
    return [f"{problem}; {fix}" for problem, fix in _unreadable_problems(reasons, count)]


def unreadable_error(given: Path, reasons: Mapping[str, str], count: int, consequence: str = "") -> HyrfDataError:
    """Return the error for photos that cannot be read.

    Args:
        given: the path that the user named.
        reasons, count: as in `unreadable_sentences`; at least one reason.
        consequence: last clause of the problem, such as ", and the 2 that can be read are too few".
    """
    (problem, fix), *others = _unreadable_problems(reasons, count)
    more = [f"{other_problem}; {other_fix}" for other_problem, other_fix in others]
    return HyrfDataError(f"{given}: {problem}{consequence}", fix="; ".join([fix, *more]))


def _unreadable_problems(reasons: Mapping[str, str], count: int) -> list[tuple[str, str]]:
    """Return (problem, fix) for each remedy that unreadable photos need."""
    problems, other = [], list(reasons)
    for known_reason, remedy in _REMEDY_BY_REASON_PREFIX.items():
        names = [name for name in other if reasons[name].startswith(known_reason)]
        other = [name for name in other if name not in names]
        if names:
            problems.append((f"{_cannot_be_read(names, count)} ({known_reason})", remedy))
    if other:
        reason, pronoun = reasons[other[0]], "it" if len(other) == 1 else "them"
        if len({reasons[name] for name in other}) > 1:
            reason = f"{other[0]}: {reason}"
        problems.append((f"{_cannot_be_read(other, count)} ({reason})", f"copy {pronoun} again, or remove {pronoun}"))
    return problems


def _cannot_be_read(names: Sequence[str], count: int) -> str:
    """Return the first part of a sentence about unreadable photos."""
    return f"{len(names):,} of {format_count(count, 'photo')} cannot be read: {format_file_names(names)}"


def no_photos_error(given: Path, folder: Path) -> HyrfDataError:
    """Return the error for a folder without a usable photo, with the reason.

    Args:
        given: the path that the user named.
        folder: the folder that was searched: the same path, or the one that an archive was unpacked into.
    """
    videos = sorted(entry.name for entry in folder.iterdir() if entry.suffix.lower() in VIDEO_SUFFIXES)
    if videos:
        return HyrfDataError(
            f"{given}: there are no photos in this folder, but the video {videos[0]}", fix="name the video itself"
        )
    raw_photos = list_raw_photos(folder)
    if raw_photos:
        photos = (
            "the only photo here is a raw file"
            if len(raw_photos) == 1
            else f"all {len(raw_photos):,} photos here are raw files"
        )
        return HyrfDataError(
            f"{given}: {photos} ({_format_extensions(raw_photos)}), and raw files are not supported", fix=RAW_REMEDY
        )
    return HyrfDataError(
        f"{given}: there are no photos here (JPEG, PNG, WebP, TIFF or HEIC)", fix="name the folder that holds them"
    )


def _format_extensions(files: Iterable[Path]) -> str:
    """List the extensions of files, each once."""
    return ", ".join(sorted({file.suffix.upper() for file in files}))

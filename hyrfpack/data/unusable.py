"""Photos that cannot be used: raw files, files that cannot be read, folders without any. Sentences that count and name
them and say what to do."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from hyrfpack.data.folder import list_raw_photos
from hyrfpack.data.pictures import HEIC_NEEDS, HEIC_REMEDY, RAW_REMEDY
from hyrfpack.errors import HyrfDataError
from hyrfpack.outputs import RAW_PHOTO_SUFFIXES, READABLE_PICTURE_SUFFIXES, VIDEO_SUFFIXES

MAX_NAMED_FILES = 3  # in one sentence; the others are counted


def name_files(names: Sequence[str]) -> str:
    """The first names, and how many more there are.

    Example:
        >>> name_files(["a.jpg", "b.jpg", "c.jpg", "d.jpg", "e.jpg"])
        'a.jpg, b.jpg, c.jpg and 2 more'
    """
    more = len(names) - MAX_NAMED_FILES
    return ", ".join(names[:MAX_NAMED_FILES]) + (f" and {more} more" if more > 0 else "")


def count_photos(count: int) -> str:
    """ "1 photo", "2 photos" """
    return "1 photo" if count == 1 else f"{count:,} photos"


def refuse_one_photo(path: Path) -> None:
    """Raises HyrfDataError: a path that was given as photos is one photo, raw or not."""
    ending = path.suffix.lower()
    if ending in RAW_PHOTO_SUFFIXES and path.is_file():
        raise HyrfDataError(f"{path}: raw files are not supported; {RAW_REMEDY}")
    if ending in READABLE_PICTURE_SUFFIXES and path.is_file():
        raise HyrfDataError(f"{path}: this is one photo, not a folder of photos; name the folder of all photos")


def raw_photos_note(raw_photos: Sequence[Path]) -> list[str]:
    """A note about raw files that lie beside photos and are ignored; none where there are none."""
    if not raw_photos:
        return []
    files, are = ("raw file", "is") if len(raw_photos) == 1 else ("raw files", "are")
    return [
        f"{len(raw_photos):,} {files} ({_endings(raw_photos)}) {are} ignored, for raw files are not supported; export "
        "those as JPEG that you want to use"
    ]


def unreadable_sentences(reasons: Mapping[str, str], count: int) -> list[str]:
    """Sentences about photos that cannot be read, one for each remedy.

    Args:
        reasons: by the photo's name, why it cannot be read.
        count: photos in all.

    Example:
        >>> unreadable_sentences({"a.jpg": "the picture file is empty"}, 40)
        ['1 of 40 photos cannot be read: a.jpg (the picture file is empty); copy it again, or remove it']
    """
    heic = [name for name, reason in reasons.items() if reason.startswith(HEIC_NEEDS)]
    other = [name for name in reasons if name not in heic]
    found = []
    if heic:
        found.append(f"{_cannot_be_read(heic, count)} ({HEIC_NEEDS}); {HEIC_REMEDY}")
    if other:
        first, it = reasons[other[0]], "it" if len(other) == 1 else "them"
        reason = first if len({reasons[name] for name in other}) == 1 else f"{other[0]}: {first}"
        found.append(f"{_cannot_be_read(other, count)} ({reason}); copy {it} again, or remove {it}")
    return found


def _cannot_be_read(names: Sequence[str], count: int) -> str:
    return f"{len(names):,} of {count_photos(count)} cannot be read: {name_files(names)}"


def explain_no_photos(given: Path, folder: Path) -> str:
    """Why there is no photo that can be used, and what to do.

    Args:
        given: what the user named.
        folder: that was looked in; the same, or where an archive was unpacked.
    """
    videos = sorted(entry.name for entry in folder.iterdir() if entry.suffix.lower() in VIDEO_SUFFIXES)
    if videos:
        return f"{given}: there are no photos in this folder, but the video {videos[0]}; name the video itself"
    raw_photos = list_raw_photos(folder)
    if raw_photos:
        photos = (
            "the only photo here is a raw file"
            if len(raw_photos) == 1
            else f"all {len(raw_photos):,} photos here are raw files"
        )
        return f"{given}: {photos} ({_endings(raw_photos)}), and raw files are not supported; {RAW_REMEDY}"
    return f"{given}: there are no photos here (JPEG, PNG, WebP, TIFF or HEIC); name the folder that holds them"


def _endings(files: Iterable[Path]) -> str:
    """The endings of files, each once."""
    return ", ".join(sorted({file.suffix.upper() for file in files}))

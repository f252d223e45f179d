"""Which file a listed photo is: other endings, other letter cases, other machines' folders, other spellings of accents.

A name is matched by what is unambiguous and by nothing else: strictest rule first, one file for one name.
"""

from __future__ import annotations

import os
import re
import unicodedata
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cached_property
from pathlib import Path

from hyrfpack.data.folder import is_raw_name, list_photos, list_pictures
from hyrfpack.outputs import PICTURE_SUFFIXES, READABLE_PICTURE_SUFFIXES

_ENDING = re.compile(r"\.[A-Za-z][A-Za-z0-9]{1,4}$")  # what may be left out of a listed name; ".0001" is no ending
_DRIVE = re.compile(r"[A-Za-z]:")
Key = tuple[str, ...]


@dataclass(frozen=True)
class Matches:
    """What a folder's files are to a list of names.

    Attributes:
        folder: that was looked in.
        found: name -> file; no two names have the same.
        loose: names whose file is called otherwise.
        unclear: names that more than one file, or whose file more than one name, would fit; not in `found`.
    """

    folder: Path
    found: dict[str, Path]
    loose: list[str]
    unclear: list[str]

    @property
    def notes(self) -> list[str]:
        """Sentences for the user about what was matched loosely or not at all."""
        notes = []
        if self.loose:
            first = self.loose[0]
            file = Path(os.path.relpath(self.found[first], self.folder)).as_posix()
            accents = " in another form of Unicode" if _composed(file) == _composed(first) else ""
            notes.append(
                f"{len(self.loose)} of {len(self.found)} photos are called otherwise than the poses say and were "
                f"matched by what fits one file alone: {first} is {file}{accents}"
            )
        if self.unclear:
            notes.append(
                f"{len(self.unclear)} photos fit more than one file, or their file more than one name, and were not "
                f"matched, {self.unclear[0]} first; name the files as the poses do"
            )
        return notes


class PictureIndex:
    """The pictures below a folder, to be found by names that others gave them.

    Nothing is read from the folder while names fit exactly; the first that does not has it walked, once.

    Example:
        >>> index = PictureIndex(Path("photos/bonsai/images"))
        >>> index.find("C:\\\\bonsai\\\\images\\\\0001.JPG").name
        '0001.png'
    """

    def __init__(self, folder: Path, *, photos: bool = True) -> None:
        """
        Args:
            folder: may be missing, which holds no picture then.
            photos: leave out masks, thumbnails and what else `list_photos` does.
        """
        self.folder = folder
        self._photos = photos

    @cached_property
    def files(self) -> list[Path]:
        """All pictures, sorted."""
        if not os.path.isdir(self.folder):
            return []
        return list_photos(self.folder) if self._photos else list_pictures(self.folder)

    def find(self, name: str) -> Path | None:
        """The one file that a name stands for, None where there is none or more than one."""
        return self.match([name]).found.get(name)

    def match(self, names: Iterable[str]) -> Matches:
        """Find files for all names together, so that none is given away twice.

        In this order: the very path; the same path in other letter cases or another form of Unicode; that without its
        ending; the name whose path ends in the file's path, or the other way round, and of several the longest.
        """
        open_names = list(dict.fromkeys(names))
        found = {name: file for name in open_names if (file := self._exact(name)) is not None}
        exact = set(found)
        unclear: set[str] = set()
        for rule in () if len(found) == len(open_names) else self._rules:
            fits = {name: rule(name) for name in open_names if name not in found and name not in unclear}
            taken = set(found.values())
            fits = {name: [file for file in files if file not in taken] for name, files in fits.items()}
            claims = Counter(file for files in fits.values() for file in files)
            for name, files in fits.items():
                if len(files) == 1 and claims[files[0]] == 1:
                    found[name] = files[0]
                elif files:
                    unclear.add(name)
        loose = [name for name in open_names if name in found and name not in exact]
        return Matches(self.folder, found, loose, [name for name in open_names if name in unclear])

    def name_of(self, file: Path, listed: str) -> str:
        """The name of a photo: its path below the folder, or what is safe of the listed one where it lies elsewhere."""
        if file.is_relative_to(self.folder) and ".." not in file.relative_to(self.folder).parts:
            return file.relative_to(self.folder).as_posix()
        return safe_name(listed)

    def _exact(self, name: str) -> Path | None:
        path = self.folder / name.replace("\\", "/")
        if is_raw_name(path.name):  # a picture of another ending may be there that was exported from it
            return None
        candidates = [path] if path.name.lower().endswith(PICTURE_SUFFIXES) else [path, *_with_endings(path)]
        return next((candidate for candidate in candidates if os.path.isfile(candidate)), None)

    @cached_property
    def _rules(self) -> list[Callable[[str], list[Path]]]:
        """From strict to loose; each gives the files that a name may stand for."""
        whole, stems, ends = defaultdict(list), defaultdict(list), defaultdict(list)
        for file in self.files:
            key = _key(file.relative_to(self.folder).as_posix())
            stem = _without_ending(key, READABLE_PICTURE_SUFFIXES)
            whole[key].append(file)
            stems[stem].append(file)
            for length in range(1, len(stem) + 1):
                ends[stem[-length:]].append(file)

        def by_end(key: Key) -> list[Path]:
            """Files whose path the name ends, or else the file that ends the name, the longest first."""
            shorter = (stems[key[-length:]] for length in range(len(key) - 1, 0, -1) if key[-length:] in stems)
            return ends.get(key) or next(shorter, [])

        return [
            lambda name: whole.get(_key(name), []),
            lambda name: stems.get(_key(name), []),  # "a.jpg" is "a.jpg.png"
            lambda name: stems.get(_without_ending(_key(name)), []),
            lambda name: by_end(_key(name)),
            lambda name: by_end(_without_ending(_key(name))),
        ]


def safe_name(text: str) -> str:
    """A photo's name as a relative path that stays below the folder it is joined to, from any system's paths."""
    return "/".join(parts_of(text))


def parts_of(name: str) -> tuple[str, ...]:
    """The parts of a path as any system writes it, without a drive, root or steps upwards."""
    parts = [part for part in name.replace("\\", "/").split("/") if part not in ("", ".", "..")]
    return tuple(parts[1:] if parts and _DRIVE.fullmatch(parts[0]) else parts)


def nearest(name: str, files: Iterable[Path]) -> Path | None:
    """The file whose name is most like that of a photo, None where there is none."""
    called = {_folded(file.name): file for file in files}
    key = _key(name)
    close = get_close_matches(key[-1], called, 1, cutoff=0) if key else []
    return called[close[0]] if close else None


def _key(name: str) -> Key:
    """What two spellings of one path share: NFC, letter case folded."""
    return tuple(_folded(part) for part in parts_of(name))


def _folded(text: str) -> str:
    """In small letters and NFC, which folding may take apart again."""
    return _composed(_composed(text).casefold())


def _composed(text: str) -> str:
    return unicodedata.normalize("NFC", text)


def _without_ending(key: Key, endings: tuple[str, ...] | None = None) -> Key:
    """The key without the last part's ending: one of these, or whatever looks like one."""
    if not key:
        return key
    last = key[-1]
    if endings is None:
        stem = _ENDING.sub("", last)
    else:
        stem = next((last[: -len(ending)] for ending in endings if last.endswith(ending)), last)
    return (*key[:-1], stem or last)


def _with_endings(path: Path) -> list[Path]:
    return [Path(f"{path}{ending}") for suffix in READABLE_PICTURE_SUFFIXES for ending in (suffix, suffix.upper())]

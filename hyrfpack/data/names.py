"""Match listed photo names to files with another extension, letter case, folder, or Unicode form.

Only unambiguous matches are accepted. The strictest rule is tried first, and each file matches at most one name.
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

from hyrfpack.counts import format_count
from hyrfpack.data.folder import is_raw_name, list_photos, list_pictures
from hyrfpack.outputs import PICTURE_SUFFIXES, READABLE_PICTURE_SUFFIXES

_EXTENSION_PATTERN = re.compile(r"\.[A-Za-z][A-Za-z0-9]{1,4}$")  # does not match ".0001", which is part of a name
_DRIVE_PATTERN = re.compile(r"[A-Za-z]:")
Key = tuple[str, ...]


@dataclass(frozen=True)
class NameMatches:
    """Files of a folder that match a list of names.

    Attributes:
        folder: the folder that was searched.
        found: maps names to files; no two names have the same file.
        inexact: names in `found` whose file has another name.
        ambiguous: names not in `found` that fit several files, or whose file fits several names.
    """

    folder: Path
    found: dict[str, Path]
    inexact: list[str]
    ambiguous: list[str]

    @property
    def notes(self) -> list[str]:
        """Sentences for the user about inexact and ambiguous matches."""
        notes = []
        if self.inexact:
            first = self.inexact[0]
            file = Path(os.path.relpath(self.found[first], self.folder)).as_posix()
            unicode_note = (
                " in another form of Unicode" if _normalize_unicode(file) == _normalize_unicode(first) else ""
            )
            of = f"of {len(self.found)} photos"
            differ = "other names than in the poses and"
            notes.append(
                f"{format_count(len(self.inexact), f'{of} has {differ} was', f'{of} have {differ} were')} "
                f"matched to the only file that fits (such as {first} to {file}{unicode_note})"
            )
        if self.ambiguous:
            notes.append(
                f"{format_count(len(self.ambiguous), 'photo was', 'photos were')} not matched (such as "
                f"{self.ambiguous[0]}), because they fit more than one file, or their file more than one name; use the "
                "same file names as the poses"
            )
        return notes


class PictureIndex:
    """An index of the pictures below a folder, which finds them by names from other programs or machines.

    The folder is listed once, when the first name does not match a path exactly.

    Example:
        >>> index = PictureIndex(Path("photos/bonsai/images"))
        >>> index.find("C:\\\\bonsai\\\\images\\\\0001.JPG").name
        '0001.png'
    """

    def __init__(self, folder: Path, *, photos: bool = True) -> None:
        """Create the index without reading the folder.

        Args:
            folder: the folder; one that does not exist has no pictures.
            photos: leave out masks, thumbnails and other pictures, as `list_photos` does.
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
        """Find the file of a name, None if no file or more than one matches."""
        return self.match([name]).found.get(name)

    def match(self, names: Iterable[str]) -> NameMatches:
        """Find the files of all names together, so that no file is matched twice.

        These rules apply in order: the exact path; a path that lacks only the extension; the same path in other letter
        cases or another Unicode form; the path without its extension; a name that ends with the file's path or vice
        versa, the longest match first.
        """
        wanted_names = list(dict.fromkeys(names))
        found = {name: path for name in wanted_names if (path := self._find_exact(name)) is not None}
        ambiguous: set[str] = set()

        def apply(rule: Callable[[str], list[Path]]) -> dict[str, list[Path]]:
            """Apply a rule to the names that are left; return the files that each may refer to and no other has."""
            known, taken = {*found, *ambiguous}, set(found.values())
            return {
                name: [file for file in rule(name) if file not in taken] for name in wanted_names if name not in known
            }

        completed = apply(self._find_with_extension)
        found |= {name: files[0] for name, files in completed.items() if len(files) == 1}
        exact = set(found)
        ambiguous |= {name for name, files in completed.items() if len(files) > 1}
        for rule in () if len(found) + len(ambiguous) == len(wanted_names) else self._rules:
            fits = apply(rule)
            claims = Counter(file for files in fits.values() for file in files)
            for name, files in fits.items():
                if len(files) == 1 and claims[files[0]] == 1:
                    found[name] = files[0]
                elif files:
                    ambiguous.add(name)
        inexact = [name for name in wanted_names if name in found and name not in exact]
        return NameMatches(self.folder, found, inexact, [name for name in wanted_names if name in ambiguous])

    def photo_name(self, file: Path, listed: str) -> str:
        """Return a photo's name: its path below the folder, or its listed name made safe if it lies elsewhere."""
        if file.is_relative_to(self.folder) and ".." not in file.relative_to(self.folder).parts:
            return file.relative_to(self.folder).as_posix()
        return safe_name(listed)

    def _path_of(self, name: str) -> Path:
        """Return the path of a name in the folder."""
        return self.folder / name.replace("\\", "/")

    def _find_exact(self, name: str) -> Path | None:
        """Find the file at exactly this path."""
        path = self._path_of(name)
        # Raw files are not read; the rules may find a picture that was exported from this one.
        return path if os.path.isfile(path) and not is_raw_name(path.name) else None

    def _find_with_extension(self, name: str) -> list[Path]:
        """Find the files whose paths have a picture's extension added to this one, which has none."""
        path = self._path_of(name)
        if is_raw_name(path.name) or path.name.lower().endswith(PICTURE_SUFFIXES):
            return []
        files = [candidate for candidate in _with_extensions(path) if os.path.isfile(candidate)]
        # A disk that ignores letter case has the same file under both spellings of an extension.
        return [file for i, file in enumerate(files) if not any(os.path.samefile(file, other) for other in files[:i])]

    @cached_property
    def _rules(self) -> list[Callable[[str], list[Path]]]:
        """Return the matching rules, the strictest first; each rule returns the files that a name may refer to."""
        paths, stems, suffixes = defaultdict(list), defaultdict(list), defaultdict(list)
        for file in self.files:
            key = _key(file.relative_to(self.folder).as_posix())
            stem = _without_extension(key, READABLE_PICTURE_SUFFIXES)
            paths[key].append(file)
            stems[stem].append(file)
            for length in range(1, len(stem) + 1):
                suffixes[stem[-length:]].append(file)

        def by_suffix(key: Key) -> list[Path]:
            """Return the files whose path ends with the name, or else those with the longest path that ends it."""
            shorter = (stems[key[-length:]] for length in range(len(key) - 1, 0, -1) if key[-length:] in stems)
            return suffixes.get(key) or next(shorter, [])

        return [
            lambda name: paths.get(_key(name), []),
            lambda name: stems.get(_key(name), []),  # "a.jpg" matches "a.jpg.png"
            lambda name: stems.get(_without_extension(_key(name)), []),
            lambda name: by_suffix(_key(name)),
            lambda name: by_suffix(_without_extension(_key(name))),
        ]


def safe_name(text: str) -> str:
    """Convert a listed name to a relative path that stays below the folder it is joined to."""
    return "/".join(path_parts(text))


def path_parts(name: str) -> tuple[str, ...]:
    """Split a path of any operating system into its parts, without a drive, a root, "." or ".."."""
    parts = [part for part in name.replace("\\", "/").split("/") if part not in ("", ".", "..")]
    return tuple(parts[1:] if parts and _DRIVE_PATTERN.fullmatch(parts[0]) else parts)


def find_similar_file(name: str, files: Iterable[Path]) -> Path | None:
    """Find the file whose name is most similar to a photo's, None if there are no files."""
    by_name = {_fold_case(file.name): file for file in files}
    key = _key(name)
    close = get_close_matches(key[-1], by_name, 1, cutoff=0) if key else []
    return by_name[close[0]] if close else None


def _key(name: str) -> Key:
    """Return the parts of a path with letter case folded and in Unicode form NFC, to compare spellings."""
    return tuple(_fold_case(part) for part in path_parts(name))


def _fold_case(text: str) -> str:
    """Fold the letter case, and normalise to NFC before and after, because folding may decompose characters."""
    return _normalize_unicode(_normalize_unicode(text).casefold())


def _normalize_unicode(text: str) -> str:
    """Convert a text to Unicode form NFC."""
    return unicodedata.normalize("NFC", text)


def _without_extension(key: Key, extensions: tuple[str, ...] | None = None) -> Key:
    """Remove the extension of a path's last part: one of `extensions`, or anything that looks like an extension."""
    if not key:
        return key
    last = key[-1]
    if extensions is None:
        stem = _EXTENSION_PATTERN.sub("", last)
    else:
        stem = next((last[: -len(extension)] for extension in extensions if last.endswith(extension)), last)
    return (*key[:-1], stem or last)


def _with_extensions(path: Path) -> list[Path]:
    """Append each extension of a readable picture to a path, in lower and in upper case."""
    return [
        Path(f"{path}{extension}") for suffix in READABLE_PICTURE_SUFFIXES for extension in (suffix, suffix.upper())
    ]

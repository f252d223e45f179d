"""The `.hyrf` container, version 1: named byte sections behind a checked table of contents.

    header (48 bytes) | table of contents (40 bytes a section) | section, zero padding to 8 bytes | section, ...

The layout is canonical: sections follow each other in the order of the table with no gaps, and nothing follows the
last, so every byte of a file is either checked or covered by a checksum. `docs/format.md` specifies each byte. What a
payload means is the codec's business (`hyrfpack.format.codec`); here it is opaque.
"""

from __future__ import annotations

import os
import re
import stat
import struct
import zlib
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import partial
from typing import BinaryIO

from hyrfpack.errors import HyrfFormatError
from hyrfpack.format.run_folder import find_model

MAGIC = b"\x89HYRF\r\n\n"
MAJOR, MINOR = 1, 2

# A file that breaks one of these is refused before anything is read or allocated for it.
MAX_SECTIONS = 1024
MAX_FILE_BYTES = 1 << 34
MAX_RAW_BYTES = 1 << 34
# Decoded bytes a file may promise: deflate, the densest common coder, tops out at 1032:1; the constant lets a
# small file hold large tables of which little is read.
MAX_EXPANSION = 1024
FREE_RAW_BYTES = 3 << 24

_HEADER = struct.Struct("<8sHHIQQIII")
_CHECKSUM = struct.Struct("<I")
_ENTRY = struct.Struct("<4sHHQQQII")
_TOC_OFFSET = _HEADER.size + _CHECKSUM.size
_VERSION = struct.Struct("<HH")
_REQUIRED = 1
_TYPE = re.compile(r"[A-Za-z0-9_]{4}")

ReadAt = Callable[[int, int], "bytes | memoryview"]


@dataclass(frozen=True)
class Section:
    """One payload with what is needed to decode it.

    Attributes:
        type: four letters, digits or underscores, unique in a file.
        codec: 0 to 65535, how `data` is coded; meaningful to the codec only.
        data: the stored bytes.
        raw_length: bytes that `data` decodes to.
        required: a reader that does not know `type` must refuse the file; otherwise it skips the section.
    """

    type: str
    codec: int
    data: bytes | memoryview
    raw_length: int
    required: bool = True


@dataclass(frozen=True)
class Entry:
    """One line of the table of contents; fields as in `Section`, place and length of the stored bytes, CRC-32."""

    type: str
    codec: int
    required: bool
    offset: int
    length: int
    raw_length: int
    checksum: int

    @property
    def end(self) -> int:
        """Where the section ends, padding included."""
        return self.offset + _padded(self.length)


class Container:
    """A `.hyrf` file whose header and table of contents have been checked; payloads are read on demand.

    Made by `read_container` (bytes) or `Container.open` (path; use it in a `with` statement).

    Attributes:
        name: what error messages call the file.
        length: its bytes, as the header says.
        available: how many of them, from the first on, are there and may be used.
        version: (major, minor) of its format.
        entries: the whole table of contents by type, in file order, unknown optional sections included.

    `"POSI" in container` tells whether a section is there whole; `container["POSI"]` reads it and checks its bytes.
    Read from one thread at a time; decode sections on as many as you like.
    """

    def __init__(
        self,
        read_at: ReadAt,
        length: int,
        known: Collection[str] | None = None,
        name: str = "the data",
        fraction: float | None = None,
    ) -> None:
        """Check header and table of contents, nothing more.

        Args:
            read_at: `read_at(offset, count)` returns exactly `count` bytes; never called past `length`.
            length: bytes there are.
            known: section types the caller can decode; None accepts any.
            name: what error messages call the file.
            fraction: use only this part of the file, from its first byte, 0 to 1; the rest may be missing. None wants
                the whole file.

        Raises:
            HyrfFormatError: not a `.hyrf` file, a newer version, an unknown required section, damage or forgery.
        """
        if fraction is not None and not 0 <= fraction <= 1:
            raise HyrfFormatError(f"{name}: there is no part of {fraction} of a file; ask for 0 to 1")
        self._read_at = read_at
        self.name = name
        self.length = self.available = length
        self._fraction = fraction
        self._known = known
        self._close: Callable[[], None] = lambda: None
        self.version, toc, count = self._read_header()
        self.entries = self._check_toc(toc, count)

    @classmethod
    def open(
        cls, path: str | os.PathLike[str], known: Collection[str] | None = None, fraction: float | None = None
    ) -> Container:
        """Open a file, or the model of a run's folder, reading its header and table of contents only.

        Args:
            path: see `find_model`; the others as the constructor's.

        Raises:
            HyrfFormatError: as the constructor, and where there is no readable file at `path`.
        """
        path = find_model(path)
        name = os.fspath(path)
        try:
            # Asked before opening: opening a named pipe would wait for a writer.
            mode = os.stat(path).st_mode
            if not stat.S_ISREG(mode):
                raise HyrfFormatError(f"{name}: this is not a regular file; copy its content to a .hyrf file first")
            file = open(path, "rb")
        except (OSError, ValueError) as error:
            raise _unreadable(name, error) from error
        try:
            size = os.fstat(file.fileno()).st_size
            container = cls(partial(_read_file_at, file, name), size, known, name, fraction)
        except BaseException:
            file.close()
            raise
        container._close = file.close
        return container

    @property
    def sections(self) -> list[Section]:
        """Every section of a known type, in file order, read and verified."""
        return [self[tag] for tag in self.entries if tag in self]

    def __contains__(self, tag: str) -> bool:
        entry = self.entries.get(tag)
        return entry is not None and (self._known is None or tag in self._known) and self._reaches(entry)

    def __getitem__(self, tag: str) -> Section:
        """Read one section and verify its checksum and padding.

        Raises:
            HyrfFormatError: the file has no such section, or its bytes are damaged.
        """
        if tag not in self.entries or (self._known is not None and tag not in self._known):
            raise HyrfFormatError(f"{self.name}: there is no section '{tag}'; the file is incomplete, write it again")
        entry = self.entries[tag]
        if not self._reaches(entry):
            raise HyrfFormatError(
                f"{self.name}: section '{tag}' ends at byte {entry.end:,} and only {self.available:,} of the "
                f"file's {self.length:,} bytes are there or allowed; take more of the file"
            )
        stored = memoryview(self._read_at(entry.offset, _padded(entry.length)))
        data = stored[: entry.length]
        if zlib.crc32(data) != entry.checksum:
            raise self._damaged(f"the checksum of section '{tag}' does not match its bytes")
        if any(stored[entry.length :]):
            raise self._damaged(f"the padding after section '{tag}' is not zero")
        return Section(tag, entry.codec, data, entry.raw_length, entry.required)

    def _reaches(self, entry: Entry) -> bool:
        return entry.end <= self.available

    def close(self) -> None:
        """Release the file; sections read before stay valid."""
        self._close()

    def __enter__(self) -> Container:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _read_header(self) -> tuple[tuple[int, int], bytes | memoryview, int]:
        """Check the header; returns the version, the verified bytes of the table of contents and its line count."""
        length = self.length
        start = bytes(self._read_at(0, min(length, _TOC_OFFSET)))
        if not start:
            raise self._damaged("the file is empty")
        if start[: len(MAGIC)] != MAGIC[: len(start)]:
            raise HyrfFormatError(f"{self.name}: this is not a .hyrf file; check the path, or write it again")
        # The version comes first: another major version may lay out everything after it anew.
        if len(start) >= len(MAGIC) + _VERSION.size:
            major, minor = _VERSION.unpack_from(start, len(MAGIC))
            if major != MAJOR:
                raise HyrfFormatError(
                    f"{self.name}: this file has format version {major}.{minor} and this hyrfpack reads version "
                    f"{MAJOR}; update hyrfpack"
                )
        if len(start) < _TOC_OFFSET:
            raise self._damaged(f"the file ends after {len(start)} bytes, within its header")
        (checksum,) = _CHECKSUM.unpack_from(start, _HEADER.size)
        if zlib.crc32(start[: _HEADER.size]) != checksum:
            raise self._damaged("the checksum of the header does not match its bytes")

        _, major, minor, flags, file_length, toc_offset, toc_length, count, toc_checksum = _HEADER.unpack_from(start)
        if flags:
            raise HyrfFormatError(
                f"{self.name}: the header sets flags {flags:#x} that this hyrfpack does not know; update hyrfpack"
            )
        if file_length > length and self._fraction is None:
            raise HyrfFormatError(
                f"{self.name}: the header says {file_length:,} bytes and there are {length:,}; the file is truncated, "
                f"copy or write it again"
            )
        if file_length < length:
            raise self._damaged(f"the header says {file_length:,} bytes and there are {length:,}")
        if file_length > MAX_FILE_BYTES:
            raise HyrfFormatError(
                f"{self.name}: {file_length:,} bytes are more than a .hyrf file may have ({MAX_FILE_BYTES:,}); "
                f"compress the model"
            )
        if count > MAX_SECTIONS:
            raise self._damaged(f"the header says {count:,} sections, more than the {MAX_SECTIONS:,} a file may have")
        if toc_offset != _TOC_OFFSET or toc_length != count * _ENTRY.size or toc_offset + toc_length > file_length:
            raise self._damaged("the header misplaces the table of contents")
        self.length = file_length
        if self._fraction is not None:
            self.available = min(length, int(self._fraction * file_length))
        if toc_offset + toc_length > length:
            raise self._damaged(f"the file ends after {length} bytes, within its table of contents")
        toc = self._read_at(toc_offset, toc_length)
        if zlib.crc32(toc) != toc_checksum:
            raise self._damaged("the checksum of the table of contents does not match its bytes")
        return (major, minor), toc, count

    def _check_toc(self, toc: bytes | memoryview, count: int) -> dict[str, Entry]:
        """Parse the table of contents; every place and length in the result lies inside the file."""
        length = self.length
        entries: dict[str, Entry] = {}
        end = _TOC_OFFSET + len(toc)
        for index in range(count):
            entry = _ENTRY.unpack_from(toc, index * _ENTRY.size)
            letters, codec, flags, offset, stored, raw, checksum, reserved = entry
            tag = letters.decode("latin-1")
            if not _TYPE.fullmatch(tag):
                raise self._damaged(f"section {index} has the malformed type {letters!r}")
            if tag in entries:
                raise self._damaged(f"section '{tag}' occurs twice")
            required = bool(flags & _REQUIRED)
            if required and self._known is not None and tag not in self._known:
                raise HyrfFormatError(
                    f"{self.name}: section '{tag}' is required and this hyrfpack does not know it (the file has "
                    f"format version {self.version[0]}.{self.version[1]}); update hyrfpack"
                )
            if flags & ~_REQUIRED or reserved:
                raise self._damaged(f"section '{tag}' sets reserved bits")
            if offset != end:
                raise self._damaged(
                    f"section '{tag}' says it starts at {offset:,} and the one before it ends at {end:,}"
                )
            if stored > length - offset:
                raise self._damaged(f"section '{tag}' says {stored:,} bytes and {length - offset:,} are left")
            end = offset + _padded(stored)
            entries[tag] = Entry(tag, codec, required, offset, stored, raw, checksum)
        if end != length:
            raise self._damaged(f"the sections end at {end:,} and the file at {length:,}")
        # What is not there can be promised without paying for it: it does not count.
        limit = raw_limit(min(length, self.available))
        raw = sum(entry.raw_length for entry in entries.values() if self._reaches(entry))
        if raw > limit:
            raise self._damaged(f"the sections say they decode to {raw:,} bytes, more than {limit:,}")
        return entries

    def _damaged(self, what: str) -> HyrfFormatError:
        return HyrfFormatError(f"{self.name}: {what}; the file is damaged, copy or write it again")


def write_container(sections: Sequence[Section], minor: int) -> bytes:
    """Lay sections out as a `.hyrf` file: same sections, same bytes.

    Args:
        sections: in file order.
        minor: the lowest minor version of the format that has all these sections and codecs, 0 to MINOR.

    Raises:
        ValueError: what `read_container` would refuse: a malformed or repeated type, a number out of range, too
            many sections, or more decoded bytes than `raw_limit` allows.
    """
    if not 0 <= minor <= MINOR:
        raise ValueError(f"format version {MAJOR}.{minor} cannot be written; the newest is {MAJOR}.{MINOR}")
    if len(sections) > MAX_SECTIONS:
        raise ValueError(f"{len(sections)} sections are more than {MAX_SECTIONS}")
    types = [section.type for section in sections]
    if len(set(types)) != len(types):
        raise ValueError(f"section types repeat: {', '.join(types)}")
    offset = _TOC_OFFSET + _ENTRY.size * len(sections)
    toc: list[bytes] = []
    payloads: list[bytes | memoryview] = []
    for section in sections:
        if not _TYPE.fullmatch(section.type):
            raise ValueError(f"section type '{section.type}' is not four letters, digits or underscores")
        if not (0 <= section.codec < 1 << 16 and 0 <= section.raw_length <= MAX_RAW_BYTES):
            raise ValueError(f"section '{section.type}': codec {section.codec}, raw length {section.raw_length}")
        data = _as_bytes(section.data)
        flags = _REQUIRED if section.required else 0
        letters = section.type.encode("ascii")
        checksum = zlib.crc32(data)
        toc.append(_ENTRY.pack(letters, section.codec, flags, offset, len(data), section.raw_length, checksum, 0))
        payloads += [data, bytes(_padded(len(data)) - len(data))]
        offset += _padded(len(data))
    raw = sum(section.raw_length for section in sections)
    if offset > MAX_FILE_BYTES or raw > raw_limit(offset):
        raise ValueError(f"{offset} bytes that decode to {raw} exceed the format's limits")
    table = b"".join(toc)
    header = _HEADER.pack(MAGIC, MAJOR, minor, 0, offset, _TOC_OFFSET, len(table), len(sections), zlib.crc32(table))
    return header + _CHECKSUM.pack(zlib.crc32(header)) + table + b"".join(payloads)


def read_container(
    data: bytes | memoryview,
    known: Collection[str] | None = None,
    name: str = "the data",
    fraction: float | None = None,
) -> Container:
    """Read a `.hyrf` file held in memory; sections are views into `data`, not copies.

    Arguments and errors as `Container`.
    """
    view = _as_bytes(data).toreadonly()
    return Container(lambda offset, count: view[offset : offset + count], len(view), known, name, fraction)


def raw_limit(file_length: int) -> int:
    """Most bytes that all sections of a file of `file_length` bytes may decode to."""
    return min(MAX_RAW_BYTES, MAX_EXPANSION * file_length + FREE_RAW_BYTES)


def _as_bytes(data: bytes | memoryview) -> memoryview:
    view = memoryview(data)
    return view.cast("B") if view.nbytes else memoryview(b"")  # an empty view of several dimensions cannot be cast


def _padded(length: int) -> int:
    return length + -length % 8


def _read_file_at(file: BinaryIO, name: str, offset: int, count: int) -> bytes:
    try:
        file.seek(offset)
        data = file.read(count)
    except OSError as error:
        raise _unreadable(name, error) from error
    if len(data) != count:
        raise HyrfFormatError(f"{name}: the file became shorter while it was read; read it again once it is complete")
    return data


def _unreadable(name: str, error: OSError | ValueError) -> HyrfFormatError:
    if isinstance(error, FileNotFoundError):
        return HyrfFormatError(f"{name}: there is no such file; check the path")
    reason = getattr(error, "strerror", None) or error
    return HyrfFormatError(f"{name}: the file cannot be read ({reason}); check the path and its permissions")

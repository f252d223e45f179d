"""The `.hyrf` container, version 1: named byte sections behind a checked table of contents.

    header (48 bytes) | table of contents (40 bytes a section) | section, zero padding to 8 bytes | section, ...

The layout is canonical: sections follow each other in the order of the table with no gaps, and nothing follows the
last. So every byte of a file is checked or covered by a checksum. `docs/reference/format.md` specifies each byte. This
module treats payloads as opaque bytes; `hyrfpack.format.codec` decodes them.
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
from typing import Any, BinaryIO

from hyrfpack.errors import HyrfFormatError
from hyrfpack.format.run_folder import find_model, is_scene_manifest

MAGIC = b"\x89HYRF\r\n\n"
MAJOR_VERSION = 1
MINOR_VERSION = 6

# A file beyond one of these limits is rejected before anything is read or allocated for it.
MAX_SECTIONS = 1024
MAX_FILE_BYTES = 1 << 34
MAX_RAW_BYTES = 1 << 34
# A file may declare this many decoded bytes for each of its bytes, since deflate, the densest common coder, reaches at
# most 1032:1. The extra bytes allow a small file to hold large hash tables of which few rows are read.
MAX_RAW_BYTES_PER_FILE_BYTE = 1024
EXTRA_RAW_BYTES_PER_FILE = 3 << 24

_HEADER_STRUCT = struct.Struct("<8sHHIQQIII")
_CHECKSUM_STRUCT = struct.Struct("<I")
_ENTRY_STRUCT = struct.Struct("<4sHHQQQII")
_TOC_OFFSET = _HEADER_STRUCT.size + _CHECKSUM_STRUCT.size
_VERSION_STRUCT = struct.Struct("<HH")
_REQUIRED_FLAG = 1
_SECTION_TYPE_PATTERN = re.compile(r"[A-Za-z0-9_]{4}")

ReadAt = Callable[[int, int], "bytes | memoryview"]


@dataclass(frozen=True)
class Section:
    """A payload together with its type, codec and decoded length.

    Attributes:
        type: four letters, digits or underscores, unique in a file.
        codec: number of the codec of `data`, 0 to 65535; the container does not interpret it.
        data: the stored bytes.
        raw_length: bytes that `data` decodes to.
        required: whether a reader that does not know `type` must reject the file; otherwise it skips the section.
    """

    type: str
    codec: int
    data: bytes | memoryview
    raw_length: int
    required: bool = True


@dataclass(frozen=True)
class Entry:
    """One line of the table of contents: fields as in `Section`, offset and length of the stored bytes, CRC-32."""

    type: str
    codec: int
    required: bool
    offset: int
    length: int
    raw_length: int
    checksum: int

    @property
    def end(self) -> int:
        """Return the offset at which the section ends, padding included."""
        return self.offset + _padded_length(self.length)


class Container:
    """A `.hyrf` file whose header and table of contents have been checked; payloads are read on demand.

    `read_container` (bytes) and `Container.open` (path; use it in a `with` statement) create it.

    `"POSI" in container` is true if all bytes of a section are available. `container["POSI"]` reads it and verifies
    its checksum. Read sections from one thread at a time; they may be decoded in several threads.

    Attributes:
        name: name of the file in error messages.
        length: bytes of the file, as the header declares.
        stored: bytes of the file that exist; fewer than `length` if the file is truncated.
        available: bytes from the start of the file that exist and may be used.
        version: (major, minor) version of the format.
        entries: the whole table of contents by type, in file order, unknown optional sections included.
        open_file: opens another file of the same folder by its name; None if there is no folder.
        parsed: what readers have parsed of sections, by the type of the section, so that they parse it once.
    """

    open_file: Callable[[str], Container] | None = None

    def __init__(
        self,
        read_at: ReadAt,
        length: int,
        known: Collection[str] | None = None,
        name: str = "the data",
        fraction: float | None = None,
    ) -> None:
        """Read and check the header and the table of contents; payloads are not read.

        Args:
            read_at: `read_at(offset, count)` returns exactly `count` bytes; never called past `length`.
            length: bytes that exist.
            known: section types the caller can decode; None accepts any.
            name: name of the file in error messages.
            fraction: use only this fraction of the file, 0 to 1, from its first byte; the rest may be missing. None
                requires the whole file.

        Raises:
            HyrfFormatError: this is not a `.hyrf` file, its version is newer, a required section is unknown, or the
                file is damaged.
        """
        if fraction is not None and not 0 <= fraction <= 1:
            raise HyrfFormatError(f"{name}: the fraction {fraction} of a file is out of range", fix="use 0 to 1")
        self._read_at = read_at
        self.name = name
        self.length = self.available = self.stored = length
        self._fraction = fraction
        self._known = known
        self._close: Callable[[], None] = lambda: None
        self._siblings: dict[str, Container] = {}
        self.parsed: dict[str, Any] = {}
        self.version, toc, count = self._read_header()
        self.entries = self._check_toc(toc, count)

    @classmethod
    def open(
        cls, path: str | os.PathLike[str], known: Collection[str] | None = None, fraction: float | None = None
    ) -> Container:
        """Open a `.hyrf` file, or the model in the folder of a training run, and read its table of contents.

        The other arguments are those of the constructor.

        Args:
            path: the file or the folder, see `find_model`.

        Raises:
            HyrfFormatError: there is no readable file at `path`, or an error of the constructor.
        """
        path = find_model(path)
        name = os.fspath(path)
        if is_scene_manifest(path):
            raise HyrfFormatError(
                f"{name}: this is a scene of several files, and one file is needed",
                fix="join it with 'hyrfpack decompress' first",
            )
        try:
            file = open_regular_file(path)
        except (OSError, ValueError) as error:
            raise _unreadable_error(name, error) from error
        try:
            size = os.fstat(file.fileno()).st_size
            container = cls(partial(_read_file_at, file, name), size, known, name, fraction)
        except BaseException:
            file.close()
            raise
        container._close = file.close
        container.open_file = lambda other: cls.open(path.with_name(other), known)
        return container

    @property
    def sections(self) -> list[Section]:
        """Read and verify every section of a known type, in file order."""
        return [self[tag] for tag in self.entries if tag in self]

    def __contains__(self, tag: str) -> bool:
        entry = self.entries.get(tag)
        return entry is not None and (self._known is None or tag in self._known) and self._is_available(entry)

    def __getitem__(self, tag: str) -> Section:
        """Read one section and verify its checksum and padding.

        Raises:
            HyrfFormatError: the file lacks this section, or its bytes are damaged.
        """
        if tag not in self.entries or (self._known is not None and tag not in self._known):
            raise HyrfFormatError(
                f"{self.name}: there is no section '{tag}'",
                fix="the file is incomplete, write it again",
            )
        entry = self.entries[tag]
        if not self._is_available(entry):
            raise HyrfFormatError(
                f"{self.name}: section '{tag}' ends at byte {entry.end:,}, but only {self.available:,} of the file's "
                f"{self.length:,} bytes are available or allowed",
                fix="read a larger part of the file",
            )
        stored = memoryview(self._read_at(entry.offset, _padded_length(entry.length)))
        data = stored[: entry.length]
        if zlib.crc32(data) != entry.checksum:
            raise self._damaged_error(f"the checksum of section '{tag}' does not match its bytes")
        if any(stored[entry.length :]):
            raise self._damaged_error(f"the padding after section '{tag}' is not zero")
        return Section(tag, entry.codec, data, entry.raw_length, entry.required)

    def read_bytes(self) -> bytes:
        """Return all bytes of the file, after a check of every section of a known type.

        Raises:
            HyrfFormatError: a section is damaged.
        """
        for tag in self.entries:
            if tag in self:
                self[tag]
        return bytes(self._read_at(0, self.length))

    @property
    def partial_file_fix(self) -> str:
        """Return the `fix` of an error about a part of a file that can only be read as a whole."""
        return "leave out `fraction`" if self.stored >= self.length else "copy the whole file again"

    def _is_available(self, entry: Entry) -> bool:
        return entry.end <= self.available

    def open_sibling(self, name: str) -> Container:
        """Open another file of the same folder once; closing this file closes it, too.

        Raises:
            HyrfFormatError: there is no such file, or an error of the constructor.
        """
        if self.open_file is None:
            raise HyrfFormatError(
                f"{self.name}: it needs the file {name} of its folder, and only the bytes of one file are given",
                fix="open it by its path, with the whole folder of its scene",
            )
        if name not in self._siblings:
            self._siblings[name] = self.open_file(name)
        return self._siblings[name]

    def close(self) -> None:
        """Close the file. Sections that were read before stay valid."""
        for sibling in self._siblings.values():
            sibling.close()
        self._close()

    def __enter__(self) -> Container:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _read_header(self) -> tuple[tuple[int, int], bytes | memoryview, int]:
        """Check the header; return the version, the verified bytes of the table of contents and its line count."""
        length = self.length
        start = bytes(self._read_at(0, min(length, _TOC_OFFSET)))
        self._check_magic_and_version(start)
        if len(start) < _TOC_OFFSET:
            raise self._damaged_error(f"the file ends after {len(start)} bytes, within its header")
        (checksum,) = _CHECKSUM_STRUCT.unpack_from(start, _HEADER_STRUCT.size)
        if zlib.crc32(start[: _HEADER_STRUCT.size]) != checksum:
            raise self._damaged_error("the checksum of the header does not match its bytes")

        _, major, minor, flags, file_length, toc_offset, toc_length, count, toc_checksum = _HEADER_STRUCT.unpack_from(
            start
        )
        if flags:
            raise HyrfFormatError(
                f"{self.name}: the header sets flags {flags:#x} that this hyrfpack does not know",
                fix="update hyrfpack",
            )
        if file_length > length and self._fraction is None:
            raise HyrfFormatError(
                f"{self.name}: the header says {file_length:,} bytes and there are {length:,}",
                fix="the file is truncated, copy or write it again",
            )
        if file_length < length:
            raise self._damaged_error(f"the header says {file_length:,} bytes and there are {length:,}")
        if file_length > MAX_FILE_BYTES:
            raise HyrfFormatError(
                f"{self.name}: {file_length:,} bytes are more than a .hyrf file may have ({MAX_FILE_BYTES:,})",
                fix="compress the model",
            )
        if count > MAX_SECTIONS:
            raise self._damaged_error(
                f"the header says {count:,} sections, more than the {MAX_SECTIONS:,} a file may have"
            )
        if (
            toc_offset != _TOC_OFFSET
            or toc_length != count * _ENTRY_STRUCT.size
            or toc_offset + toc_length > file_length
        ):
            raise self._damaged_error("the header misplaces the table of contents")
        self.length = file_length
        if self._fraction is not None:
            self.available = min(length, int(self._fraction * file_length))
        if toc_offset + toc_length > length:
            raise self._damaged_error(f"the file ends after {length} bytes, within its table of contents")
        toc = self._read_at(toc_offset, toc_length)
        if zlib.crc32(toc) != toc_checksum:
            raise self._damaged_error("the checksum of the table of contents does not match its bytes")
        return (major, minor), toc, count

    def _check_magic_and_version(self, start: bytes) -> None:
        """Check the first bytes of a file, which may end within its header.

        The version is checked before the rest of the header, because another major version may change the layout of
        everything after it.
        """
        if not start:
            raise self._damaged_error("the file is empty")
        if start[: len(MAGIC)] != MAGIC[: len(start)]:
            raise HyrfFormatError(
                f"{self.name}: this is not a .hyrf file",
                fix="check the path; files that were exported for other programs are not read",
            )
        if len(start) >= len(MAGIC) + _VERSION_STRUCT.size:
            major, minor = _VERSION_STRUCT.unpack_from(start, len(MAGIC))
            if major != MAJOR_VERSION:
                raise HyrfFormatError(
                    f"{self.name}: this file has format version {major}.{minor} and this hyrfpack reads version "
                    f"{MAJOR_VERSION}",
                    fix="update hyrfpack",
                )

    def _check_toc(self, toc: bytes | memoryview, count: int) -> dict[str, Entry]:
        """Parse the table of contents; every offset and length in the result lies inside the file."""
        length = self.length
        entries: dict[str, Entry] = {}
        end = _TOC_OFFSET + len(toc)
        for index in range(count):
            entry = _ENTRY_STRUCT.unpack_from(toc, index * _ENTRY_STRUCT.size)
            letters, codec, flags, offset, stored, raw, checksum, reserved = entry
            tag = letters.decode("latin-1")
            if not _SECTION_TYPE_PATTERN.fullmatch(tag):
                raise self._damaged_error(f"section {index} has the malformed type {letters!r}")
            if tag in entries:
                raise self._damaged_error(f"section '{tag}' occurs twice")
            required = bool(flags & _REQUIRED_FLAG)
            if required and self._known is not None and tag not in self._known:
                raise HyrfFormatError(
                    f"{self.name}: section '{tag}' is required and this hyrfpack does not know it (the file has "
                    f"format version {self.version[0]}.{self.version[1]})",
                    fix="update hyrfpack",
                )
            if flags & ~_REQUIRED_FLAG or reserved:
                raise self._damaged_error(f"section '{tag}' sets reserved bits")
            if offset != end:
                raise self._damaged_error(
                    f"section '{tag}' says it starts at {offset:,} and the one before it ends at {end:,}"
                )
            if stored > length - offset:
                raise self._damaged_error(f"section '{tag}' says {stored:,} bytes and {length - offset:,} are left")
            end = offset + _padded_length(stored)
            entries[tag] = Entry(tag, codec, required, offset, stored, raw, checksum)
        if end != length:
            raise self._damaged_error(f"the sections end at {end:,} and the file at {length:,}")
        # Sections beyond the available bytes do not count, because they will not be decoded.
        limit = raw_bytes_limit(min(length, self.available))
        raw = sum(entry.raw_length for entry in entries.values() if self._is_available(entry))
        if raw > limit:
            raise self._damaged_error(f"the sections say they decode to {raw:,} bytes, more than {limit:,}")
        return entries

    def _damaged_error(self, problem: str) -> HyrfFormatError:
        return HyrfFormatError(f"{self.name}: {problem}", fix="the file is damaged, copy or write it again")


def write_container(sections: Sequence[Section], minor: int) -> bytes:
    """Return the bytes of a `.hyrf` file with the given sections. The same sections give the same bytes.

    Args:
        sections: the sections, in file order.
        minor: the lowest minor version of the format that has all these sections and codecs, 0 to MINOR_VERSION.

    Raises:
        ValueError: `read_container` would reject the file: a type is malformed or repeated, a number is out of range,
            there are too many sections, or more decoded bytes than `raw_bytes_limit` allows.
    """
    if not 0 <= minor <= MINOR_VERSION:
        raise ValueError(
            f"format version {MAJOR_VERSION}.{minor} cannot be written; the newest is {MAJOR_VERSION}.{MINOR_VERSION}"
        )
    if len(sections) > MAX_SECTIONS:
        raise ValueError(f"{len(sections)} sections are more than {MAX_SECTIONS}")
    types = [section.type for section in sections]
    if len(set(types)) != len(types):
        raise ValueError(f"section types repeat: {', '.join(types)}")
    offset = _TOC_OFFSET + _ENTRY_STRUCT.size * len(sections)
    toc: list[bytes] = []
    payloads: list[bytes | memoryview] = []
    for section in sections:
        if not _SECTION_TYPE_PATTERN.fullmatch(section.type):
            raise ValueError(f"section type '{section.type}' is not four letters, digits or underscores")
        if not (0 <= section.codec < 1 << 16 and 0 <= section.raw_length <= MAX_RAW_BYTES):
            raise ValueError(
                f"section '{section.type}' has codec {section.codec} and decodes to {section.raw_length} bytes; codecs "
                f"are 0 to 65535, and a section may decode to {MAX_RAW_BYTES} bytes"
            )
        data = _as_bytes(section.data)
        flags = _REQUIRED_FLAG if section.required else 0
        letters = section.type.encode("ascii")
        checksum = zlib.crc32(data)
        toc.append(
            _ENTRY_STRUCT.pack(letters, section.codec, flags, offset, len(data), section.raw_length, checksum, 0)
        )
        payloads += [data, bytes(_padded_length(len(data)) - len(data))]
        offset += _padded_length(len(data))
    raw = sum(section.raw_length for section in sections)
    if offset > MAX_FILE_BYTES or raw > raw_bytes_limit(offset):
        raise ValueError(f"{offset} bytes that decode to {raw} exceed the format's limits")
    table = b"".join(toc)
    header = _HEADER_STRUCT.pack(
        MAGIC, MAJOR_VERSION, minor, 0, offset, _TOC_OFFSET, len(table), len(sections), zlib.crc32(table)
    )
    return header + _CHECKSUM_STRUCT.pack(zlib.crc32(header)) + table + b"".join(payloads)


def read_container(
    data: bytes | memoryview,
    known: Collection[str] | None = None,
    name: str = "the data",
    fraction: float | None = None,
) -> Container:
    """Read a `.hyrf` file in memory. Its sections are views into `data`, not copies.

    Arguments and errors are those of `Container`.
    """
    view = _as_bytes(data).toreadonly()
    return Container(lambda offset, count: view[offset : offset + count], len(view), known, name, fraction)


def open_regular_file(path: os.PathLike[str]) -> BinaryIO:
    """Open a file for reading.

    Raises:
        HyrfFormatError: it is a named pipe, a device or another special file.
        OSError: the system cannot open it.
        ValueError: the path holds a NUL character.
    """
    # The mode is checked before opening, because opening a named pipe would wait for a writer.
    if not stat.S_ISREG(os.stat(path).st_mode):
        raise HyrfFormatError(f"{path}: this is not a regular file", fix="copy its content to a file first")
    return open(path, "rb")


def raw_bytes_limit(file_length: int) -> int:
    """Return the largest number of bytes that all sections of a file of `file_length` bytes may decode to."""
    return min(MAX_RAW_BYTES, MAX_RAW_BYTES_PER_FILE_BYTE * file_length + EXTRA_RAW_BYTES_PER_FILE)


def _as_bytes(data: bytes | memoryview) -> memoryview:
    view = memoryview(data)
    # An empty view of several dimensions cannot be cast.
    return view.cast("B") if view.nbytes else memoryview(b"")


def _padded_length(length: int) -> int:
    """Round a length up to a multiple of 8 bytes."""
    return length + -length % 8


def _read_file_at(file: BinaryIO, name: str, offset: int, count: int) -> bytes:
    """Read exactly `count` bytes at `offset`, or raise HyrfFormatError."""
    try:
        file.seek(offset)
        data = file.read(count)
    except OSError as error:
        raise _unreadable_error(name, error) from error
    if len(data) != count:
        raise HyrfFormatError(
            f"{name}: the file became shorter while it was read",
            fix="read it again once it is complete",
        )
    return data


def _unreadable_error(name: str, error: OSError | ValueError) -> HyrfFormatError:
    """Return the error for a file that the system could not open or read."""
    if isinstance(error, FileNotFoundError):
        return HyrfFormatError(f"{name}: there is no such file", fix="check the path")
    reason = getattr(error, "strerror", None) or error
    return HyrfFormatError(f"{name}: the file cannot be read ({reason})", fix="check the path and its permissions")

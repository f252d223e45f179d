"""Sections that several files share: each file refers to one file in its folder, which holds them.

The chunks of a scene folder have the fields and the exposure map in common. Each chunk refers to them by section codec
12, so that they are stored once. `docs/reference/format.md` specifies the bytes.
"""

from __future__ import annotations

import re
import struct
from copy import deepcopy
from dataclasses import replace
from functools import partial

from hyrfpack.errors import HyrfFormatError
from hyrfpack.format.container import Container, Entry, Section, write_container
from hyrfpack.format.metadata import CODEC_DEFLATED, read_metadata
from hyrfpack.format.sections import DECODER_SECTIONS, EXPOSURE, METADATA, TABLE_SECTIONS
from hyrfpack.format.versions import lowest_minor_version

CODEC_SHARED = 12
SHARED_SECTIONS = (EXPOSURE, *DECODER_SECTIONS, *TABLE_SECTIONS)
MAX_FILE_NAME_LENGTH = 64
_FILE_NAME_PATTERN = re.compile(rf"(?=.{{1,{MAX_FILE_NAME_LENGTH}}}\Z)[A-Za-z0-9_][A-Za-z0-9_.-]*\.hyrf", re.ASCII)
_CHECKSUM_STRUCT = struct.Struct("<I")


def is_file_name(name: object) -> bool:
    """Return whether `name` may name another `.hyrf` file of the same folder: it leads to no other folder."""
    return isinstance(name, str) and _FILE_NAME_PATTERN.fullmatch(name) is not None


def refer_to_section(entry: Entry, file_name: str) -> Section:
    """Return a section that refers to the section `entry` of the file `file_name` in the same folder."""
    if not is_file_name(file_name) or entry.type not in SHARED_SECTIONS:
        raise ValueError(f"section '{entry.type}' of {file_name!r} cannot be shared")
    data = _CHECKSUM_STRUCT.pack(entry.checksum) + file_name.encode("ascii")
    return Section(entry.type, CODEC_SHARED, data, len(data), entry.required)


def has_shared_sections(container: Container) -> bool:
    """Return whether sections of a file lie in another file."""
    return any(map(partial(_is_reference, container), SHARED_SECTIONS))


def open_shared(container: Container) -> Container:
    """Return the file that holds the fields of a file: the file that its sections refer to, or the file itself.

    Every reference is checked. The result need not be closed apart from `container`.

    Raises:
        HyrfFormatError: a reference is damaged, the other file is missing, or it is another one than was referred to.
    """
    references = {
        tag: _read_reference(container, tag)
        for tag in container.entries
        if _is_reference(container, tag) and tag in container
    }
    if not references:
        return container
    names = {name for name, _ in references.values()}
    if len(names) > 1:
        raise _damaged_error(container, f"its sections refer to several files, {', '.join(sorted(names))}")
    (name,) = names
    shared = container.open_sibling(name)
    for tag, (_, checksum) in references.items():
        entry = shared.entries.get(tag)
        if entry is None or entry.codec == CODEC_SHARED or entry.checksum != checksum:
            raise HyrfFormatError(
                f"{shared.name}: section '{tag}' is not the one that {container.name} refers to",
                fix="copy the whole folder again",
            )
    return shared


def read_section(container: Container, tag: str) -> Section:
    """Read a section of a file, or the section of another file that it refers to."""
    return (open_shared(container) if _is_reference(container, tag) else container)[tag]


def read_provenance(container: Container) -> dict:
    """Return the provenance of a file. A chunk of a scene has that of the file with its shared sections, too."""
    provenance = deepcopy(read_metadata(container).provenance)
    if not has_shared_sections(container):
        return provenance
    return {**deepcopy(read_metadata(open_shared(container)).provenance), **provenance}


def self_contained_bytes(container: Container) -> bytes:
    """Return the bytes of a file, with copies of the sections that it shares with others.

    Optional sections of unknown types are left out of a file that changes.
    """
    if not has_shared_sections(container):
        return container.read_bytes()
    metadata = replace(read_metadata(container), provenance=read_provenance(container))
    sections = [
        metadata.to_section(deflate=entry.codec == CODEC_DEFLATED) if tag == METADATA else read_section(container, tag)
        for tag, entry in container.entries.items()
        if tag in container
    ]
    return write_container(sections, minor=lowest_minor_version(sections, metadata.config))


def _is_reference(container: Container, tag: str) -> bool:
    """Return whether a file has a section that refers to another file; other types are skipped, or refused if read."""
    return tag in SHARED_SECTIONS and tag in container.entries and container.entries[tag].codec == CODEC_SHARED


def _read_reference(container: Container, tag: str) -> tuple[str, int]:
    """Return the name of the file that a section refers to, and the checksum of the section there."""
    section = container[tag]
    data = bytes(section.data)
    name = data[_CHECKSUM_STRUCT.size :].decode("latin-1")
    if section.raw_length != len(data) or not is_file_name(name):
        raise _damaged_error(container, f"section '{tag}' refers to no file of its folder")
    return name, _CHECKSUM_STRUCT.unpack_from(data)[0]


def _damaged_error(container: Container, problem: str) -> HyrfFormatError:
    return HyrfFormatError(f"{container.name}: {problem}", fix="the file is damaged, copy or write it again")

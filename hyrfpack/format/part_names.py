"""The names of a merged file's parts, and its part files. It imports neither torch nor numpy."""

from __future__ import annotations

import json
from collections.abc import Sequence

from hyrfpack.checks import has_control_characters, remove_control_characters
from hyrfpack.errors import HyrfFormatError
from hyrfpack.format.container import Container, Section, raw_bytes_limit, read_container
from hyrfpack.format.metadata import gaussian_limit, read_metadata
from hyrfpack.format.sections import MAX_PARTS, PART_NAMES, SECTION_CONTENTS, part_section
from hyrfpack.format.shared import has_shared_sections

# The name of the only part of a file that is not merged.
ONE_PART_NAME = "scene"
CODEC_PART_NAMES = 0
CODEC_PART_FILE = 10
MAX_PART_NAME_LENGTH = 64
MAX_PART_NAMES_BYTES = 1 << 16


def check_part_names(names: Sequence[object]) -> None:
    """Raise ValueError unless a merged file may have parts of these names.

    They must be 1 to MAX_PARTS different texts of 1 to MAX_PART_NAME_LENGTH characters without control characters.
    """
    if not 1 <= len(names) <= MAX_PARTS:
        raise ValueError(f"there are {len(names)} parts; a file holds 1 to {MAX_PARTS}")
    for name in names:
        if not isinstance(name, str) or not 1 <= len(name) <= MAX_PART_NAME_LENGTH or has_control_characters(name):
            raise ValueError(
                f"{name!r:.80} cannot be the name of a part; it must have 1 to {MAX_PART_NAME_LENGTH} characters, none "
                "of them a control character"
            )
    if len(set(names)) != len(names):
        raise ValueError("two parts have the same name")


def write_part_names(names: Sequence[str]) -> Section:
    """Return the section with the names of the parts."""
    check_part_names(names)
    data = json.dumps({"names": list(names)}, separators=(",", ":")).encode("ascii")
    return Section(PART_NAMES, CODEC_PART_NAMES, data, len(data))


def read_part_names(container: Container) -> list[str]:
    """Read the names of a merged file's parts.

    Raises:
        HyrfFormatError: the names are damaged, or a part is missing.
    """
    name, entry = container.name, container.entries[PART_NAMES]
    if entry.codec != CODEC_PART_NAMES or entry.raw_length != entry.length or entry.length > MAX_PART_NAMES_BYTES:
        raise HyrfFormatError(f"{name}: the names of its parts cannot be read", fix="update hyrfpack")
    try:
        text = bytes(container[PART_NAMES].data).decode("utf-8")
        names = json.loads(text, parse_constant=reject_constant)["names"]
        if not isinstance(names, list):
            raise ValueError("the names are not a list")
        check_part_names(names)
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise HyrfFormatError(
            f"{name}: the names of its parts are not valid ({error!s:.160})", fix="write the file again"
        ) from error
    return names


def clean_part_name(name: str) -> str:
    """Return a valid name of a part: `name` without control characters, short enough for a number after it."""
    return remove_control_characters(name)[: MAX_PART_NAME_LENGTH - 3] or "part"


def reject_constant(name: str) -> None:
    """Raise ValueError for a constant of JSON, NaN or infinity, that Python's parser accepts."""
    raise ValueError(f"the number {name} is not finite")


def open_parts(
    container: Container, limits_fix: str = "the file is damaged, copy or write it again"
) -> list[tuple[str, Container]]:
    """Return name and container of each part of a merged file, after a check of all that the parts declare together.

    Args:
        container: the merged file.
        limits_fix: what the error says to do if the parts together exceed the limits of a file.

    Raises:
        HyrfFormatError: a part is missing or damaged, is itself a merged file, the parts declare too many bytes or
            Gaussians, or some of them are antialiased and others are not; or only a part of the file is available.
    """
    if container.available < container.length:
        raise HyrfFormatError(
            f"{container.name}: a merged file can only be read whole, but only {container.available:,} of its "
            f"{container.length:,} bytes are available or allowed",
            fix=container.partial_file_fix,
        )
    parts = []
    for number, part_name in enumerate(read_part_names(container)):
        section = container[part_section(number)]
        if section.codec != CODEC_PART_FILE or section.raw_length != len(section.data):
            raise HyrfFormatError(
                f"{container.name}: section '{section.type}' has the unknown codec {section.codec}, or a wrong size",
                fix="update hyrfpack",
            )
        part = read_container(section.data, SECTION_CONTENTS, f"{container.name}: part '{part_name}'")
        if PART_NAMES in part.entries:
            raise HyrfFormatError(f"{part.name}: a part must be one model", fix="write the file again")
        if has_shared_sections(part):
            raise HyrfFormatError(f"{part.name}: a part cannot refer to another file", fix="write the file again")
        parts.append((part_name, part))
    declared = sum(entry.raw_length for _, part in parts for entry in part.entries.values())
    if declared > (limit := raw_bytes_limit(container.length)):
        raise HyrfFormatError(
            f"{container.name}: the parts say they decode to {declared:,} bytes, more than {limit:,}", fix=limits_fix
        )
    metadata = [read_metadata(part) for _, part in parts]
    count = sum(facts.gaussians for facts in metadata)
    if count > (limit := gaussian_limit(container.length)):
        raise HyrfFormatError(
            f"{container.name}: its parts claim {count:,} Gaussians, but the size of the file allows at most {limit:,}",
            fix=limits_fix,
        )
    if len({facts.config["antialiased"] for facts in metadata}) > 1:
        raise HyrfFormatError(
            f"{container.name}: some of its parts are antialiased and others are not",
            fix="train all of them with the same `antialiased`, and merge them again",
        )
    return parts


def list_parts(container: Container) -> list[tuple[str, Container]]:
    """Return name and container of each part of a merged file (see `open_parts`), or of the one model of a file."""
    return open_parts(container) if PART_NAMES in container.entries else [(ONE_PART_NAME, container)]

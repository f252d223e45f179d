"""Copies of `.hyrf` files that differ in their metadata alone."""

from __future__ import annotations

from dataclasses import replace

from hyrfpack.format.container import Container, read_container, write_container
from hyrfpack.format.metadata import CODEC_DEFLATED, read_metadata, writer_name
from hyrfpack.format.sections import METADATA, SECTION_CONTENTS
from hyrfpack.format.shared import self_contained_bytes
from hyrfpack.format.versions import lowest_minor_version
from hyrfpack.model.config import ModelConfig


def with_metadata(container: Container, config: ModelConfig, provenance: dict) -> bytes:
    """Return the bytes of a file of one model with another configuration and provenance.

    Args:
        container: the file. All sections but its metadata keep their bytes; optional ones of unknown types are left
            out, because they may depend on what changes.
        config: the configuration; hash grids and decoders must be those of the file.
        provenance: as for `hyrfpack.save_model`.

    Raises:
        HyrfFormatError: the file is damaged.
    """
    container = read_container(self_contained_bytes(container), SECTION_CONTENTS, container.name)
    metadata = replace(read_metadata(container), config=config.to_dict(), provenance=provenance, writer=writer_name())
    sections = [
        metadata.to_section(deflate=entry.codec == CODEC_DEFLATED) if entry.type == METADATA else container[entry.type]
        for entry in container.entries.values()
        if entry.type in container
    ]
    return write_container(sections, minor=lowest_minor_version(sections, metadata.config))

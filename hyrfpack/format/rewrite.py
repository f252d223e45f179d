"""Copies of `.hyrf` files that differ in their metadata alone."""

from __future__ import annotations

import os
from dataclasses import replace

from hyrfpack.format.codec import write_model
from hyrfpack.format.container import Container, write_container
from hyrfpack.format.info import FileReport
from hyrfpack.format.metadata import CODEC_DEFLATED, read_metadata, writer_name
from hyrfpack.format.sections import METADATA
from hyrfpack.format.versions import lowest_minor_version
from hyrfpack.model.config import ModelConfig


def rewrite_metadata(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    config: ModelConfig,
    provenance: dict,
    *,
    overwrite: bool = True,
) -> FileReport:
    """Copy a file with another configuration and provenance. All other sections keep their bytes.

    Args:
        source: the file, or the folder of a run.
        target: the file to write.
        config: the configuration; hash grids and decoders must be those of the file.
        provenance: as for `hyrfpack.save_model`.
        overwrite: as for `hyrfpack.save_model`.

    Raises:
        HyrfFormatError: `source` is damaged, or of a newer format version.
        HyrfError: the file cannot be written.
    """
    with Container.open(source) as container:
        data = with_metadata(container, config, provenance)
    return write_model(data, target, overwrite=overwrite)


def with_metadata(container: Container, config: ModelConfig, provenance: dict) -> bytes:
    """Return the bytes of a file of one model with another configuration and provenance; see `rewrite_metadata`."""
    metadata = replace(read_metadata(container), config=config.to_dict(), provenance=provenance, writer=writer_name())
    sections = [
        metadata.to_section(deflate=entry.codec == CODEC_DEFLATED) if entry.type == METADATA else container[entry.type]
        for entry in container.entries.values()
    ]
    return write_container(sections, minor=lowest_minor_version(sections, metadata.config))

"""Compression of merged files: each part by itself."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

from hyrfpack.format.container import Container
from hyrfpack.format.info import FileReport, describe_file, section_sizes
from hyrfpack.format.part_names import open_parts
from hyrfpack.format.parts import write_parts
from hyrfpack.format.sections import PART_NAMES, SECTION_CONTENTS
from hyrfpack.outputs import StrPath
from hyrfpack.progress import Progress, part_of_progress


def is_merged(path: Path) -> bool:
    """Return whether a file holds several models."""
    with Container.open(path, SECTION_CONTENTS) as container:
        return PART_NAMES in container.entries


def compress_parts(
    source: Path,
    target: StrPath,
    compress_part: Callable[[Path, Path, Progress], FileReport],
    progress: Progress,
    *,
    overwrite: bool,
) -> FileReport:
    """Compress each part of a merged file, and write a merged file of the results.

    Args:
        source: the merged file.
        target: the file to write.
        compress_part: compresses the file of one model, the first path, to the second path, and reports its progress.
        progress: called with `TaskEvent`s.
        overwrite: replace a file at `target`.
    """
    parts, bytes_before = [], 0
    with Container.open(source, SECTION_CONTENTS) as container, tempfile.TemporaryDirectory() as folder:
        models = open_parts(container)
        for number, (name, part) in enumerate(models):
            loose, packed = Path(folder, "part.hyrf"), Path(folder, "packed.hyrf")
            loose.write_bytes(part.read_bytes())
            share = part_of_progress(progress, number / len(models), (number + 1) / len(models))
            bytes_before += compress_part(loose, packed, share).bytes_before
            parts.append((name, packed.read_bytes()))
    written = write_parts(parts, target, overwrite=overwrite)
    facts = describe_file(written)
    with Container.open(written, SECTION_CONTENTS) as container:
        sizes = section_sizes(container)
    return FileReport(written, facts["profile"], facts["gaussians"], bytes_before, facts["bytes"], sizes)

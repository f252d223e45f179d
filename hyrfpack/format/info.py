"""What a `.hyrf` file holds, told from its first kilobytes. Imports neither torch nor numpy."""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass

from hyrfpack.errors import HyrfFormatError
from hyrfpack.format.container import Container
from hyrfpack.format.exposure_head import read_exposure_head
from hyrfpack.format.metadata import read_metadata
from hyrfpack.format.sections import EXPOSURE, SECTIONS


@dataclass(frozen=True)
class SectionSize:
    """Bytes of one section.

    Attributes:
        type, holds: its four letters, and what they stand for.
        before: bytes of its content as float32 (of the metadata and the exposure map: as it is).
        after: bytes stored.
    """

    type: str
    holds: str
    before: int
    after: int


def section_sizes(container: Container) -> list[SectionSize]:
    """Sizes of all sections in file order, unknown optional ones included."""
    return [
        SectionSize(tag, SECTIONS.get(tag, "unknown"), entry.raw_length, entry.length)
        for tag, entry in container.entries.items()
    ]


def describe(path: str | os.PathLike[str], fraction: float | None = None) -> dict:
    """Say what a `.hyrf` file holds without decoding it: header, table of contents and metadata are read, no more.

    Args:
        path: of the file, or of the folder of a run, see `hyrfpack.format.find_model`.
        fraction: how much of the file must be there, see `hyrfpack.load`; None for all.

    Returns:
        A dictionary ready for JSON: `bytes` (of the file), `version` ("1.0"), and the metadata's `writer`, `profile`,
        `gaussians`, `config` (frame, grids, background, rules of the model), `rules`, `settings`, `provenance`;
        `exposure` of a file with an exposure map: its number of `centers` and the lowest and the highest exposure of
        renders in `stops`, mean of the three channels (null without one, or where its bytes are not there);
        `bits_per_gaussian` of the whole file (null without Gaussians), and `sections`: for each `type`, `holds`,
        `before` (bytes as float32), `after` (bytes stored) and `bits_per_gaussian`.

    Raises:
        HyrfFormatError: there is no such file, or its header, table of contents, metadata or exposure map is damaged.

    Example:
        >>> import hyrfpack
        >>> facts = hyrfpack.describe("bonsai.hyrf")
        >>> facts["profile"], facts["version"], facts["sections"][0]["type"]
        ('compact', '1.1', 'META')
    """
    with Container.open(path, SECTIONS, fraction) as container:
        metadata = read_metadata(container)
        sizes = section_sizes(container)
        exposure = _describe_exposure(container)
        length, version = container.length, ".".join(map(str, container.version))
    count = metadata.gaussians

    def bits(length: int) -> float | None:
        return 8 * length / count if count else None

    return {
        "bytes": length,
        "version": version,
        **asdict(metadata),
        "exposure": exposure,
        "bits_per_gaussian": bits(length),
        "sections": [{**asdict(size), "bits_per_gaussian": bits(size.after)} for size in sizes],
    }


def _describe_exposure(container: Container) -> dict | None:
    if EXPOSURE not in container:
        return None
    section = container[EXPOSURE]
    try:
        head, _ = read_exposure_head(section.codec, section.data, section.raw_length)
    except HyrfFormatError as error:
        raise HyrfFormatError(f"{container.name}: section '{EXPOSURE}': {error}") from error
    return {"centers": head.centers, "stops": list(head.stops)}

"""Description of a `.hyrf` file from its header and metadata. It imports neither torch nor numpy."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace

from hyrfpack.errors import HyrfFormatError
from hyrfpack.format.container import Container
from hyrfpack.format.exposure_header import read_exposure_header
from hyrfpack.format.metadata import read_metadata
from hyrfpack.format.part_names import open_parts
from hyrfpack.format.scene_folder import SceneFolder, is_scene, refuse_fraction
from hyrfpack.format.sections import EXPOSURE, NON_PARAMETER_SECTIONS, PART_NAMES, SECTION_CONTENTS, group_and_layer
from hyrfpack.format.shared import read_provenance, read_section


@dataclass(frozen=True)
class SectionSize:
    """Type, content and size of one section.

    Attributes:
        type: four letters of the section's type.
        holds: the content that the type stands for.
        before: bytes of the decoded content, numbers as float32 (metadata and exposure map: as stored).
        after: stored bytes.
    """

    type: str
    holds: str
    before: int
    after: int

    @property
    def parameters(self) -> int:
        """Return the number of the model's parameters in the section; 0 for metadata and exposure map."""
        return 0 if self.type in NON_PARAMETER_SECTIONS else self.before // 4


@dataclass(frozen=True)
class FileReport:
    """Contents and size of a file that was written.

    Attributes:
        file: path of the file.
        profile: "raw", "paper" or "compact".
        gaussians: number of Gaussians in the file.
        bytes_before: bytes of all parameters as float32.
        bytes_after: bytes of the file.
        sections: bytes of each section before and after; header, table of contents and padding are the rest.
    """

    file: str
    profile: str
    gaussians: int
    bytes_before: int
    bytes_after: int
    sections: list[SectionSize]

    def to_dict(self) -> dict:
        """Return the report as numbers, strings, lists and dictionaries for JSON."""
        return asdict(self)


def section_sizes(container: Container) -> list[SectionSize]:
    """Return the sizes of all sections in file order, unknown optional ones included."""
    return [
        SectionSize(tag, SECTION_CONTENTS.get(tag, "unknown"), entry.raw_length, entry.length)
        for tag, entry in container.entries.items()
    ]


def sum_layers(sections: Iterable[SectionSize]) -> list[SectionSize]:
    """Return the sizes with the layers of each section added up, in the order of the first layers."""
    groups: dict[str, SectionSize] = {}
    for part in sections:
        tag = group_and_layer(part.type)[0]
        group = groups.get(tag, SectionSize(tag, SECTION_CONTENTS.get(tag, part.holds), 0, 0))
        groups[tag] = replace(group, before=group.before + part.before, after=group.after + part.after)
    return list(groups.values())


def describe_file(path: str | os.PathLike[str], fraction: float | None = None) -> dict:
    """Describe a `.hyrf` file from its header, table of contents, metadata and exposure, without decoding the model.

    Args:
        path: the file, or the folder of a training run, see `hyrfpack.format.find_model`.
        fraction: fraction of the file that must exist, see `hyrfpack.load_model`; None for the whole file.

    Returns:
        A dictionary ready for JSON: `bytes` (of the file), `version` ("1.0"), and the metadata's `writer`, `profile`,
        `gaussians`, `config` (frame, grids, background, rules of the model), `rules`, `settings`, `provenance`;
        `exposure` of a file with an exposure map: its number of `centers`, and in `stops` the lowest and the highest
        exposure of renders, as means of the three channels (null without a map, or if its bytes are missing);
        `bits_per_gaussian` of the whole file (null without Gaussians); and `sections`, each with `type`, `holds`,
        `before` (bytes as float32), `after` (stored bytes) and `bits_per_gaussian`. A merged file has the description
        of its first part, the scene, with the `bytes`, `version`, `gaussians`, `bits_per_gaussian` and `sections` of
        the whole file; and `parts`, each with its `name` and its own description. A scene folder has the description of
        its shared file, with the `bytes` and `gaussians` of the whole folder, and its chunks in `scene`; if it has
        several parts, it has `parts`, too, whose `bytes` and `gaussians` are those of their chunks at all levels and at
        the finest.

    Raises:
        HyrfFormatError: the file does not exist, or its header, table of contents, metadata or exposure map is damaged.

    Example:
        >>> import hyrfpack
        >>> facts = hyrfpack.describe_file("bonsai.hyrf")
        >>> facts["profile"], facts["version"], next(section["type"] for section in facts["sections"])
        ('compact', '1.1', 'META')
    """
    if is_scene(path):
        refuse_fraction(path, fraction)
        return describe_scene(path)
    with Container.open(path, SECTION_CONTENTS, fraction) as container:
        if PART_NAMES not in container.entries:
            return _describe_model(container)
        parts = [{"name": name, **_describe_model(part)} for name, part in open_parts(container)]
        count = sum(part["gaussians"] for part in parts)
        scene = {key: value for key, value in parts[0].items() if key != "name"}
        return {**scene, **_describe_sizes(container, count), "gaussians": count, "parts": parts}


def describe_scene(path: str | os.PathLike[str]) -> dict:
    """Describe a scene folder: its shared file, with the `bytes` and `gaussians` of all, and its manifest as `scene`.

    A folder of several parts has the description of the first one, and `parts` as a merged file has.

    Raises:
        HyrfFormatError: the manifest is damaged, or a file is missing or has another size.
    """
    scene = SceneFolder(path)
    scene.check_files()
    manifest = scene.manifest
    parts = []
    for number, part in enumerate(manifest.parts):
        chunks = [chunk for chunk in manifest.chunks if chunk.part == number]
        size = part.bytes + sum(level.bytes for chunk in chunks for level in chunk.levels)
        count = sum(chunk.levels[0].gaussians for chunk in chunks)
        with scene.open_file(part) as shared:
            parts.append({**_describe_model(shared), **_describe_totals(size, count)})
    keys = ("title", "licence", "error_radii", "shared", "parts", "chunks")
    listed = {key: value for key, value in manifest.to_dict().items() if key in keys}
    facts = {**parts[0], **_describe_totals(manifest.total_bytes, manifest.gaussians), "scene": listed}
    if len(parts) > 1:
        facts["parts"] = [
            {"name": part.name, **facts_of_part} for part, facts_of_part in zip(manifest.parts, parts, strict=True)
        ]
    return facts


def _describe_totals(size: int, gaussians: int) -> dict:
    """Return the totals of several files."""
    return {"bytes": size, "gaussians": gaussians, "bits_per_gaussian": 8 * size / gaussians if gaussians else None}


def _describe_model(container: Container) -> dict:
    metadata = replace(read_metadata(container), provenance=read_provenance(container))
    exposure = _describe_exposure(container)
    return {**asdict(metadata), "exposure": exposure, **_describe_sizes(container, metadata.gaussians)}


def _describe_sizes(container: Container, gaussians: int) -> dict:
    def bits(length: int) -> float | None:
        return 8 * length / gaussians if gaussians else None

    return {
        "bytes": container.length,
        "version": ".".join(map(str, container.version)),
        "bits_per_gaussian": bits(container.length),
        "sections": [{**asdict(size), "bits_per_gaussian": bits(size.after)} for size in section_sizes(container)],
    }


def _describe_exposure(container: Container) -> dict | None:
    if EXPOSURE not in container:
        return None
    section = read_section(container, EXPOSURE)
    try:
        header, _ = read_exposure_header(section.codec, section.data, section.raw_length)
    except HyrfFormatError as error:
        raise error.with_text(f"{container.name}: section '{EXPOSURE}': {error.problem}") from error
    return {"centers": header.centers, "stops": list(header.stops)}

"""Place copies of a scene folder side by side in a new one, to make a larger scene without a split that takes hours.

    python -m tools.studies.tile_scene runs/million-scene --copies 5 --out runs/5m-scene

Each copy is a part of its own, shifted along a square grid on the ground by the longest side of its frame. Its chunks
are those of the scene, with their measured errors, so views in which copies hide each other have smaller errors than
predicted.

Its scenes are measured in docs/research/levels.md.
"""

from __future__ import annotations

import argparse
import math
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np

import hyrfpack
from hyrfpack.cameras.paths import Viewpoint
from hyrfpack.cameras.placement import Placement
from hyrfpack.edit.transform import move_frame, move_provenance
from hyrfpack.errors import HyrfError
from hyrfpack.format.arrays import parse_config
from hyrfpack.format.container import Container, Section, read_container, write_container
from hyrfpack.format.metadata import CODEC_DEFLATED, read_metadata
from hyrfpack.format.scene_manifest import MANIFEST_NAME, Chunk, ChunkLevel, ScenePart
from hyrfpack.format.sections import METADATA, SECTION_CONTENTS
from hyrfpack.format.shared import CODEC_SHARED, refer_to_section
from hyrfpack.format.versions import lowest_minor_version
from tools.command import positive_integer, run_command


def list_offsets(copies: int, first: np.ndarray, second: np.ndarray) -> list[np.ndarray]:
    """Return the places of a square grid that are nearest to the first one; `first` and `second` are its sides."""
    side = math.ceil(math.sqrt(copies))
    cells = sorted(((row, column) for row in range(side) for column in range(side)), key=lambda cell: sum(cell))
    return [row * first + column * second for row, column in cells[:copies]]


def move_file(container: Container, placement: Placement, shared: Container | None, shared_name: str) -> bytes:
    """Return the bytes of a chunk or a shared file that is placed elsewhere, with references to `shared`."""
    metadata = read_metadata(container)
    frame = move_frame(placement, parse_config(metadata.config).frame)
    config = replace(parse_config(metadata.config), frame=frame).to_dict()
    metadata = replace(metadata, config=config, provenance=move_provenance(placement, metadata.provenance))
    sections: list[Section] = []
    for tag, entry in container.entries.items():
        if tag == METADATA:
            sections.append(metadata.to_section(deflate=entry.codec == CODEC_DEFLATED))
        elif entry.codec == CODEC_SHARED and shared is not None:
            sections.append(refer_to_section(shared.entries[tag], shared_name))
        else:
            sections.append(container[tag])
    return write_container(sections, minor=lowest_minor_version(sections, config))


def write_file(path: Path, data: bytes) -> tuple[str, int, str]:
    """Write a file; return its name, size and checksum for the manifest."""
    path.write_bytes(data)
    return path.name, len(data), f"{zlib.crc32(data):08x}"


def tile(source: hyrfpack.SceneFolder, out: Path, copies: int) -> None:
    """Write the folder of `copies` copies of a scene of one part.

    Raises:
        HyrfError: the scene has several parts, or there is something at `out`.
    """
    manifest = source.manifest
    if len(manifest.parts) != 1:
        raise HyrfError(f"the scene has {len(manifest.parts)} parts", fix="split a model of one part")
    if out.exists():
        raise HyrfError(f"{out}: it exists already", fix="name a new folder with `out`, or remove this one")
    (part,) = manifest.parts
    viewpoint = Viewpoint.from_json(manifest.viewpoint)
    up = np.asarray(viewpoint.up) / np.linalg.norm(viewpoint.up)
    first = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    first *= 2 * manifest.frame["scale"] * max(manifest.frame["half_extent"]) / np.linalg.norm(first)
    out.mkdir(parents=True)
    parts: list[ScenePart] = []
    chunks: list[Chunk] = []
    for copy, offset in enumerate(list_offsets(copies, first, np.cross(up, first))):
        placement = Placement.translation(offset)
        name = f"shared-{copy:02d}.hyrf"
        shared_data = move_file(source.open_file(part), placement, None, name)
        parts.append(ScenePart(*write_file(out / name, shared_data), f"copy {copy}"))
        shared = read_container(shared_data, SECTION_CONTENTS)
        for chunk in manifest.chunks:
            levels = []
            for level, item in enumerate(chunk.levels):
                path = out / f"chunk-{len(chunks):04d}-{level}.hyrf"
                data = move_file(source.open_file(item), placement, shared, name)
                levels.append(ChunkLevel(*write_file(path, data), item.gaussians, item.errors))
            low, high = (tuple(placement.move_point(corner).tolist()) for corner in (chunk.low, chunk.high))
            chunks.append(Chunk(low, high, tuple(levels), copy))
    larger = replace(manifest, gaussians=copies * manifest.gaussians, parts=tuple(parts), chunks=tuple(chunks))
    (out / MANIFEST_NAME).write_bytes(larger.to_json())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, help="scene folder of one part")
    parser.add_argument("--copies", type=positive_integer, required=True, help="number of copies")
    parser.add_argument("--out", type=Path, required=True, help="the new scene folder")
    arguments = parser.parse_args()
    tile(hyrfpack.SceneFolder(arguments.scene), arguments.out, arguments.copies)


if __name__ == "__main__":
    run_command(main)

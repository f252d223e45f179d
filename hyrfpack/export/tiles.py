"""Export of a scene folder as 3D Tiles 1.1: tileset.json, and a .glb file for each level of each chunk.

Source: the OGC Community Standard 3D Tiles 1.1 (22-025r4).

    root                    draws the background, and adds its children to it
      ...                   a binary tree of boxes without content
        chunk, coarsest     replaced by its child if its error in the picture is too large
          chunk, finer      and so on, down to the finest level

CesiumJS 1.145 draws splats only if they are SPZ in glTF, by the draft of an extension that the tileset requires. It
stops with an error at plain glTF with KHR_gaussian_splatting.

The content of a tile is glTF, with y up. A client turns it to the axes of 3D Tiles, where z is up:

    (x, y, z) -> (x, -z, y)

Contents hold the scene turned by 180 degrees about x, as SPZ files do, relative to a common origin. So the boxes of
tiles are in axes that are the scene's turned by CONTENT_TURN, and the transform of the root turns the scene upright and
moves it to its place.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np

from hyrfpack.export.baked_scene import SplatsWithBackground
from hyrfpack.export.boxes import Box, BoxTree
from hyrfpack.export.kinds import SPZ_TILES_FOLDER, TILES_FOLDER
from hyrfpack.export.levels import BakedChunk, BakedLevels
from hyrfpack.format.metadata import writer_name
from hyrfpack.format.scene_manifest import Chunk, Manifest
from hyrfpack.outputs.indexed_folder import IndexedFolder
from hyrfpack.progress import Progress, TaskEvent
from hyrfpack.splats.formats import gltf
from hyrfpack.splats.placement import choose_local_origin, upright_rotation
from hyrfpack.splats.splats import Splats, concatenate
from hyrfpack.splats.table import FileKind

INDEX_NAME = TILES_FOLDER.ending
CONTENT_FOLDER = "tiles"
HALF_TURN = np.diag([1.0, -1.0, -1.0])
CONTENT_TURN = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]) @ HALF_TURN
TILES_UP = (0.0, 0.0, 1.0)
GLTF_CONTENT_EXTENSION = "3DTILES_content_gltf"
# The error of a tile at which clients replace it, in pixels: the default of CesiumJS and of Cesium for Unreal.
MAX_SCREEN_SPACE_ERROR_PIXELS = 16.0
# A client with this setting draws a level as long as the squared error that it adds to the picture is at most that of a
# disc of this radius whose pixels are wrong by the full range of colours.
MAX_ERROR_DISC_RADIUS_PIXELS = 4.0


def write_tiles(
    kind: FileKind, baked: BakedLevels, target: Path, overwrite: bool, progress: Progress
) -> tuple[int, SplatsWithBackground]:
    """Write the levels of a scene as 3D Tiles.

    Args:
        kind: TILES_FOLDER for contents in plain glTF, or SPZ_TILES_FOLDER for SPZ in glTF.
        baked: the baked levels.
        target: the folder.
        overwrite: replace existing files; those with other names stay.
        progress: called with `TaskEvent`s.

    Returns:
        The bytes of all files, and the finest level with the background, as read back.

    Raises:
        HyrfError: a file cannot be written, or it exists and may not be replaced.
    """
    compressed = kind is SPZ_TILES_FOLDER
    loaded, manifest = baked.finest.source, baked.scene.manifest
    origin = choose_local_origin(baked.finest.splats.positions)
    with IndexedFolder(target, INDEX_NAME, overwrite) as folder:
        contents = _ContentWriter(folder, origin, compressed)
        chunks, finest_parts = [], []
        for number, chunk in enumerate(baked.chunks):
            progress(TaskEvent(f"writing chunk {number + 1}/{len(baked.chunks)}", number / len(baked.chunks)))
            tile, finest = _write_chunk(contents, chunk, manifest)
            chunks.append(tile)
            finest_parts.append(finest)
        boxes = [_read_box(tile) for tile in chunks]
        root = _make_tree(BoxTree.build(boxes), chunks)
        if baked.background is not None:
            # All contents have the same degree, because a client may draw them together.
            background = baked.background.with_degree(baked.finest.degree)
            root, splats = _add_background(contents, root, background)
            finest_parts.append(splats)
        upright = upright_rotation(loaded.up, np.array(TILES_UP))
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = upright @ CONTENT_TURN.T, upright @ origin
        root["transform"] = matrix.T.ravel().tolist()  # column by column
        used = [gltf.SPLATTING_EXTENSION, *([gltf.SPZ_EXTENSION] if compressed else [])]
        content_extensions = {"extensionsUsed": used, **({"extensionsRequired": used} if compressed else {})}
        tileset = {
            "asset": {"version": "1.1", "extras": {"generator": writer_name()}},
            "extensionsUsed": [GLTF_CONTENT_EXTENSION],
            "extensions": {GLTF_CONTENT_EXTENSION: content_extensions},
            "geometricError": root["geometricError"],
            "root": root,
        }
        folder.write(INDEX_NAME, json.dumps(tileset, separators=(",", ":"), allow_nan=False).encode("ascii"))
    return folder.bytes, (concatenate(finest_parts), None)


def compute_geometric_errors(chunk: Chunk, radii: Sequence[float]) -> list[float]:
    """Return the geometric error of each level of a chunk, in world units.

    A client draws a tile with the geometric error g as long as g f / d <= MAX_SCREEN_SPACE_ERROR_PIXELS, with the focal
    length f in pixels and the distance d. The chunk, of radius r, then has the projected radius R = f r / d, and the
    level adds the squared error pi R^2 error(R) to the picture. So

        g = MAX_SCREEN_SPACE_ERROR_PIXELS r / R,    with    R sqrt(error(R)) = MAX_ERROR_DISC_RADIUS_PIXELS

    for the smallest such R. Errors never fall from a level to a coarser one; the finest one has none.
    """
    limits = [_find_radius_limit(level.errors, radii) for level in chunk.levels[1:]]
    return list(accumulate([0.0, *(MAX_SCREEN_SPACE_ERROR_PIXELS * chunk.radius / limit for limit in limits)], max))


def _find_radius_limit(errors: Sequence[float], radii: Sequence[float]) -> float:
    """Return the smallest R with R sqrt(error(R)) = MAX_ERROR_DISC_RADIUS_PIXELS; infinite if there is none.

    Args:
        errors: mean squared error of a pixel at each projected radius, interpolated linearly in its logarithm.
        radii: the projected radii, in pixels.
    """
    logs = np.log(radii)

    def is_beyond(log: float) -> bool:
        return math.exp(log) * math.sqrt(np.interp(log, logs, errors)) >= MAX_ERROR_DISC_RADIUS_PIXELS

    if errors[0] > 0 and is_beyond(logs[0]):  # the error is constant up to the first radius
        return MAX_ERROR_DISC_RADIUS_PIXELS / math.sqrt(errors[0])
    for low, high in zip(logs, logs[1:], strict=False):
        if is_beyond(high):
            for _ in range(50):  # bisection
                middle = (low + high) / 2
                low, high = (low, middle) if is_beyond(middle) else (middle, high)
            return math.exp(high)
    return MAX_ERROR_DISC_RADIUS_PIXELS / math.sqrt(errors[-1]) if errors[-1] > 0 else math.inf


class _ContentWriter:
    """Writes contents of tiles, relative to a common origin."""

    def __init__(self, folder: IndexedFolder, origin: np.ndarray, compressed: bool) -> None:
        self.folder, self.origin, self.compressed = folder, origin, compressed

    def write(self, name: str, splats: Splats) -> tuple[dict[str, Any], Splats, Box]:
        """Write splats, and return the content of a tile, the splats as read back and their box in the tile's axes."""
        uri = f"{CONTENT_FOLDER}/{name}.glb"
        relative = replace(splats, positions=splats.positions - self.origin)
        if self.compressed:
            data, decoded = gltf.encode_compressed(relative)
        else:
            data = gltf.encode_at(relative, np.zeros(3), HALF_TURN)
            decoded = gltf.decode(data, uri)
        self.folder.write(uri, data)
        box = Box.of_splats(decoded, CONTENT_TURN)
        return {"uri": uri}, replace(decoded, positions=decoded.positions + self.origin), box


def _write_chunk(contents: _ContentWriter, chunk: BakedChunk, manifest: Manifest) -> tuple[dict[str, Any], Splats]:
    """Write the levels of a chunk, and return its coarsest tile, with finer ones below it, and its finest splats."""
    described = manifest.chunks[chunk.number]
    errors = compute_geometric_errors(described, manifest.error_radii)
    tile: dict[str, Any] = {}
    for level, splats in enumerate(chunk.levels):
        if not len(splats):
            continue
        content, decoded, box = contents.write(f"{chunk.number:04d}-{level}", splats)
        if level == 0:
            finest = decoded
        children = {"children": [tile]} if tile else {}
        bounds = Box.around([box, _read_box(tile)]) if tile else box
        tile = {**_make_tile(bounds, errors[level]), "content": content, **children}
    return {**tile, "refine": "REPLACE"}, finest  # tiles below inherit it


def _make_tree(node: BoxTree, chunks: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the tile of a node, whose children are added to it.

    A tile without content shows nothing, so it has to be refined as soon as it is seen as more than a dot: its
    geometric error is its diagonal.
    """
    nodes = [node] if node.leaf is not None else node.children
    children = [_make_tree(child, chunks) if child.leaf is None else chunks[child.leaf] for child in nodes]
    error = max(node.box.diagonal, *(child["geometricError"] for child in children))
    return {**_make_tile(node.box, error), "refine": "ADD", "children": children}


def _add_background(
    contents: _ContentWriter, root: dict[str, Any], background: Splats
) -> tuple[dict[str, Any], Splats]:
    """Write the background as the content of the root; return the root with a larger box, and the splats."""
    content, decoded, box = contents.write("background", background)
    bounds = Box.around([box, _read_box(root)])
    error = max(bounds.diagonal, root["geometricError"])
    return {**root, **_make_tile(bounds, error), "content": content}, decoded


def _make_tile(box: Box, error: float) -> dict[str, Any]:
    sides = np.diag(box.half_sides).ravel().tolist()
    return {"boundingVolume": {"box": [*box.center.tolist(), *sides]}, "geometricError": error}


def _read_box(tile: dict[str, Any]) -> Box:
    values = np.array(tile["boundingVolume"]["box"])
    half = values[[3, 7, 11]]
    return Box(values[:3] - half, values[:3] + half)

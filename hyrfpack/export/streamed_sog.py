"""Export of a scene folder as PlayCanvas' Streamed SOG: lod-meta.json and unbundled SOGs of several chunks each.

Source: the PlayCanvas user manual, "The Streamed SOG Format", version 1 (developer.playcanvas.com).

    lod-meta.json       a binary tree of boxes. A leaf names the file, the first Gaussian and the number of Gaussians
                        of each of its levels, and the error of each level
    0_0/meta.json ...   a SOG: the chunks of level 0 one after the other, each in the order of a Morton curve
    env/meta.json ...   the background, which is always drawn
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np

from hyrfpack.export.baked_scene import SplatsWithBackground
from hyrfpack.export.boxes import Box, BoxTree
from hyrfpack.export.kinds import STREAMED_SOG_FOLDER
from hyrfpack.export.levels import BakedLevels
from hyrfpack.format.metadata import writer_name
from hyrfpack.format.scene_manifest import Chunk
from hyrfpack.outputs.indexed_folder import IndexedFolder
from hyrfpack.progress import Progress, TaskEvent
from hyrfpack.splats.formats import sog
from hyrfpack.splats.splats import Splats, concatenate

INDEX_NAME = STREAMED_SOG_FOLDER.ending
ENVIRONMENT_NAME = "env"
FORMAT_VERSION = 1
# A file is the unit that a program loads. A SOG has at most 16,384 rows of harmonics, one for 4 Gaussians up to here.
MAX_FILE_GAUSSIANS = 65_536
_MIN_BOX_DIAGONAL = 1e-30  # The logarithm of the diagonal of a box of one point would not be finite.


@dataclass
class _Leaf:
    """What the index says about a chunk.

    Attributes:
        ranges: by level, the number of the file, the first Gaussian in it and the number of Gaussians.
        boxes: boxes of the Gaussians of each level, as read back from its file.
    """

    ranges: dict[int, tuple[int, int, int]] = field(default_factory=dict)
    boxes: list[Box] = field(default_factory=list)


def write_streamed_sog(
    baked: BakedLevels, target: Path, overwrite: bool, progress: Progress
) -> tuple[int, SplatsWithBackground]:
    """Write the levels of a scene as Streamed SOG.

    Args:
        baked: the baked levels.
        target: the folder.
        overwrite: replace existing files; those with other names stay.
        progress: called with `TaskEvent`s.

    Returns:
        The bytes of all files, and the finest level with the background, as read back.

    Raises:
        HyrfError: a file cannot be written, or it exists and may not be replaced.
    """
    order = list(BoxTree.build([Box.of_splats(chunk.levels[0]) for chunk in baked.chunks]).leaves())
    level_count = max(len(chunk.levels) for chunk in baked.chunks)
    files = [(level, group) for level in range(level_count) for group in _group_chunks(baked, order, level)]
    leaves = [_Leaf() for _ in baked.chunks]
    names, finest_parts, counts = [], [], [0] * level_count
    with IndexedFolder(target, INDEX_NAME, overwrite) as folder:
        for number, (level, group) in enumerate(files):
            progress(TaskEvent(f"writing file {number + 1}/{len(files)}", number / len(files)))
            name = f"{level}_{sum(1 for file_level, _ in files[:number] if file_level == level)}"
            parts = [baked.chunks[chunk].levels[level] for chunk in group]
            group_sizes = [len(part) for part in parts]
            splats = _write_sog(folder, name, concatenate(parts), group_sizes)
            names.append(f"{name}/{sog.META_NAME}")
            counts[level] += len(splats)
            finest_parts += [splats] if level == 0 else []
            for chunk, start, count in zip(group, accumulate(group_sizes, initial=0), group_sizes, strict=False):
                leaves[chunk].ranges[level] = (number, start, count)
                leaves[chunk].boxes.append(Box.of_splats(splats[start : start + count]))
        if baked.background is not None:
            finest_parts.append(_write_sog(folder, ENVIRONMENT_NAME, baked.background, ()))
        index = {
            "version": FORMAT_VERSION,
            "asset": {"generator": writer_name()},
            "count": sum(counts),
            "counts": counts,
            "lodLevels": level_count,
            "lodErrors": True,
            **({"environment": f"{ENVIRONMENT_NAME}/{sog.META_NAME}"} if baked.background is not None else {}),
            "filenames": names,
            "tree": _make_tree(baked, leaves, level_count),
        }
        folder.write(INDEX_NAME, json.dumps(index, separators=(",", ":"), allow_nan=False).encode("ascii"))
    return folder.bytes, (concatenate(finest_parts), None)


def compute_level_errors(chunk: Chunk, level_count: int) -> list[float]:
    """Return an error for each level: the mean of the chunk's `errors` over all radii, raised so that none falls.

    These are mean squared errors of a pixel that shows the chunk. A program that spends its budget by the error that a
    finer level saves, times the pixels that the chunk covers, therefore reduces the squared error of the picture.
    """
    means = [float(np.mean(level.errors)) for level in chunk.levels]
    raised = list(accumulate(means, max))
    return raised + raised[-1:] * (level_count - len(raised))


def _group_chunks(baked: BakedLevels, order: Sequence[int], level: int) -> Iterator[list[int]]:
    """Yield groups of neighbouring chunks that share a file at a level, of at most MAX_FILE_GAUSSIANS if they can."""
    group: list[int] = []
    size = 0
    for number in order:
        levels = baked.chunks[number].levels
        count = len(levels[level]) if level < len(levels) else 0
        if not count:
            continue
        if group and size + count > MAX_FILE_GAUSSIANS:
            yield group
            group, size = [], 0
        group, size = [*group, number], size + count
    if group:
        yield group


def _write_sog(folder: IndexedFolder, name: str, splats: Splats, group_sizes: Sequence[int]) -> Splats:
    """Write an unbundled SOG, its meta.json last, and return its splats as read back."""
    files = sog.encode_files(splats, group_sizes)
    for file in (*(file for file in files if file != sog.META_NAME), sog.META_NAME):
        folder.write(f"{name}/{file}", files[file])
    return sog.decode_files(files, str(folder.path / name))


def _make_tree(baked: BakedLevels, leaves: Sequence[_Leaf], level_count: int) -> dict[str, Any]:
    """Return the tree of boxes as the index describes it, with the ranges of Gaussians and the errors of each leaf."""
    chunks = baked.scene.manifest.chunks

    def describe(node: BoxTree) -> dict[str, Any]:
        bound = _describe_bound(node.box)
        if node.leaf is None:
            return {"bound": bound, "children": [describe(child) for child in node.children]}
        ranges = sorted(leaves[node.leaf].ranges.items())
        lods = {str(level): {"file": file, "offset": start, "count": count} for level, (file, start, count) in ranges}
        errors = compute_level_errors(chunks[baked.chunks[node.leaf].number], level_count)
        return {"bound": bound, "lods": lods, "errors": _round_digits(errors)}

    return describe(BoxTree.build([Box.around(leaf.boxes) for leaf in leaves]))


def _describe_bound(box: Box) -> dict[str, list[float]]:
    """Return the corners of a box, rounded to 7 digits of its diagonal.

    The format asks for 7 digits. Those of the coordinates themselves would not tell the corners of a box apart that is
    far from the origin.
    """
    decimals = 6 - math.floor(math.log10(max(box.diagonal, _MIN_BOX_DIAGONAL)))
    return {name: np.round(corner, decimals).tolist() for name, corner in (("min", box.low), ("max", box.high))}


def _round_digits(values: Sequence[float] | np.ndarray) -> list[float]:
    """Round to the 7 digits that the format asks for."""
    return [float(f"{value:.7g}") for value in values]

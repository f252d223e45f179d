"""Bake of a scene folder: splats of each chunk at each level of detail, for formats that stream them."""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hyrfpack.config.export import ExportConfig
from hyrfpack.errors import HyrfError, suggest_command
from hyrfpack.export.baked_scene import BakedScene, bake_scene
from hyrfpack.export.source import Source
from hyrfpack.format.scene_folder import SceneFolder, is_scene
from hyrfpack.format.scene_manifest import Chunk
from hyrfpack.model.merged import scene_of
from hyrfpack.progress import Progress, TaskEvent, part_of_progress
from hyrfpack.splats.splats import Splats
from hyrfpack.splats.table import FileKind

_LOG = logging.getLogger(__name__)

_FINEST_SHARE = 0.6  # of the progress


@dataclass(frozen=True)
class BakedChunk:
    """A chunk of a scene folder, baked.

    Attributes:
        number: its number in the manifest.
        levels: splats of each level, the finest first; a coarse level is empty if no camera sees its Gaussians.
    """

    number: int
    levels: tuple[Splats, ...]


@dataclass(frozen=True)
class BakedLevels:
    """A scene folder, baked.

    Attributes:
        scene: the scene folder.
        finest: the finest levels of all chunks, with the background.
        chunks: the chunks that have Gaussians.
    """

    scene: SceneFolder
    finest: BakedScene
    chunks: list[BakedChunk]

    @property
    def level_gaussians(self) -> list[int]:
        """Gaussians of all chunks at each level, the finest first."""
        count = max(len(chunk.levels) for chunk in self.chunks)
        return [
            sum(len(chunk.levels[level]) for chunk in self.chunks if level < len(chunk.levels))
            for level in range(count)
        ]

    @property
    def background(self) -> Splats | None:
        """The splats of the background, of degree 0; None without a background."""
        count = self.finest.background_count
        return self.finest.splats[-count:].with_degree(0) if count else None


def open_levels(source: str | os.PathLike[str]) -> SceneFolder:
    """Open the scene folder that an export of levels of detail needs.

    Raises:
        HyrfError: the source is something else.
    """
    if not is_scene(source):
        raise HyrfError(
            f"{source}: this model has no levels of detail to stream",
            fix=f"split it first with {suggest_command('split', source, '-o', 'scene')}, and export the folder 'scene'",
        )
    return SceneFolder(source)


def bake_levels(
    loaded: Source, scene: SceneFolder, kind: FileKind, config: ExportConfig, progress: Progress
) -> BakedLevels:
    """Bake all levels of a scene folder, each as a whole, so that its Gaussians hide each other as in pictures.

    All levels have the degree of harmonics that is chosen for the finest one.

    Args:
        loaded: the finest levels of all chunks as one model, with its cameras.
        scene: the scene folder.
        kind: kind of the files.
        config: settings of the export.
        progress: called with `TaskEvent`s.

    Raises:
        HyrfError: the settings leave no Gaussian, or a file of the scene is damaged.
    """
    chunks = scene.manifest.chunks
    finest = bake_scene(loaded, kind, config, part_of_progress(progress, 0.0, _FINEST_SHARE))
    count = len(finest.splats) - finest.background_count
    levels = [_divide(finest.splats[:count], finest.index, chunks, [0] * len(chunks))]
    level_count = max(len(chunk.levels) for chunk in chunks)
    settings = replace(config, degree=finest.degree, background=False)
    for level in range(1, level_count):
        start, end = (_FINEST_SHARE + (1 - _FINEST_SHARE) * (level + e - 1) / (level_count - 1) for e in (0, 1))
        _LOG.info(f"baking level {level}")
        progress(TaskEvent(f"reading level {level}", start))
        chosen = [min(level, len(chunk.levels) - 1) for chunk in chunks]
        model = scene.load(chosen)
        # Without views to measure at, splats of another exposure are not baked for comparison.
        coarse = bake_scene(
            replace(loaded, model=scene_of(model), all_parts=model, measured_views=[]),
            kind,
            settings,
            part_of_progress(progress, start, end),
        )
        levels.append(_divide(coarse.splats, coarse.index, chunks, chosen))
    baked = [
        BakedChunk(number, tuple(level[number] for level in levels[: len(chunk.levels)]))
        for number, chunk in enumerate(chunks)
        if len(levels[0][number])
    ]
    return BakedLevels(scene, finest, baked)


def _divide(splats: Splats, index: np.ndarray, chunks: Sequence[Chunk], levels: Sequence[int]) -> list[Splats]:
    """Divide splats among chunks.

    Args:
        splats: the splats.
        index: for each of them, the index of its Gaussian in a model of all chunks, which holds one part of the scene
            after the other.
        chunks: the chunks.
        levels: level of each chunk in the model.
    """
    order = sorted(range(len(chunks)), key=lambda number: chunks[number].part)
    sizes = [chunks[number].levels[levels[number]].gaussians for number in order]
    edges = np.searchsorted(index, np.concatenate(([0], np.cumsum(sizes)))).tolist()
    row_ranges = dict(zip(order, zip(edges, edges[1:], strict=False), strict=True))
    return [splats[slice(*row_ranges[number])] for number in range(len(chunks))]

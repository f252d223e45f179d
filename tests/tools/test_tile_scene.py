"""Copies of a scene folder are one scene of several parts, each of which lies elsewhere."""

from __future__ import annotations

import numpy as np

import hyrfpack
from hyrfpack.model.merged import parts_of, world_positions
from tools.safety.make_golden import GOLDEN_SCENE_FOLDER
from tools.studies.tile_scene import tile


def test_copies_lie_side_by_side(tmp_path):
    source = hyrfpack.SceneFolder(GOLDEN_SCENE_FOLDER)
    tile(source, tmp_path / "tiled", 3)
    tiled = hyrfpack.SceneFolder(tmp_path / "tiled")
    tiled.check_files()
    assert tiled.manifest.gaussians == 3 * source.manifest.gaussians

    first, *others = (world_positions(part) for part in parts_of(tiled.load()))
    np.testing.assert_allclose(first, world_positions(source.load()))
    offsets = [np.unique((other - first).round(4), axis=0) for other in others]
    assert all(len(offset) == 1 for offset in offsets)
    up = np.array(source.manifest.viewpoint["up"])
    side = 2 * source.manifest.frame["scale"] * max(source.manifest.frame["half_extent"])
    for (offset,) in offsets:
        np.testing.assert_allclose((np.linalg.norm(offset), offset @ up), (side, 0), atol=1e-3 * side)

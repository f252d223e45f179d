"""A small scene folder with levels of detail, for tests of exports."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scenes import ring, shift_cameras, small_model

from hyrfpack.cameras.capture import provenance_cameras
from hyrfpack.cameras.paths import Viewpoint
from hyrfpack.config.split import SplitConfig
from hyrfpack.context import RunContext
from hyrfpack.format import save_model
from hyrfpack.lod import split, split_model
from hyrfpack.model import Frame
from hyrfpack.rotations import quaternion_from_matrix

SCENE_CENTER = (5.0, -2.0, 1.0)
SCENE_SCALE = 2.0


def write_level_scene(folder: Path) -> Path:
    """Write a model, turned, scaled and moved, with a background, and split it; return the path of the scene folder.

    The model, model.hyrf, has 256 Gaussians. The scene has four chunks of three levels.
    """
    turn = quaternion_from_matrix(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    frame = Frame(SCENE_CENTER, SCENE_SCALE, (1.0, 1.0, 1.0), tuple(turn.tolist()))
    positions = np.random.default_rng(0).uniform(-0.6, 0.6, (256, 3))
    model = small_model(positions, frame=frame, fields=2.0, background=True)
    cameras = shift_cameras(ring(4, radius=3 * SCENE_SCALE, elevation=SCENE_SCALE), SCENE_CENTER)
    kept = {"cameras": provenance_cameras(cameras), "viewpoint": Viewpoint.from_cameras(cameras).to_json()}
    save_model(model, folder / "model.hyrf", provenance=kept)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(split, "REFIT_CAMERAS_PER_PART", 1)
        patch.setattr(split, "MEASURED_VIEWS_PER_PART", 2)
        config = SplitConfig(chunk_gaussians=64, levels=3, refit_steps=1)
        split_model(folder / "model.hyrf", folder / "scene", config, context=RunContext(progress=None))
    return folder / "scene"

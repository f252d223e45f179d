"""tools/studies/planted_floaters.py: where floaters are planted."""

from __future__ import annotations

import numpy as np
import torch
from scenes import ball_scene, small_model

from tools.studies.planted_floaters import plant_floaters


def test_floaters_are_planted_near_all_cameras():
    scene = ball_scene(views=8, points=400, side=24)
    cameras = [view.camera for view in scene.train]
    scale_logits = torch.linspace(-4, -2, len(scene.points))[:, None]
    model = small_model(scene.points, scale_logits=scale_logits).requires_grad_(False)
    planted, is_planted = plant_floaters(model, cameras, 0.5, seed=0)
    assert is_planted.sum() == 200 and not is_planted[:400].any()
    floaters = planted.gaussians.positions[400:].numpy()
    distances = np.linalg.norm(floaters[:, None] - np.array([camera.position for camera in cameras]), axis=2)
    near, free = distances[:100], distances[100:]
    assert set(near.argmin(axis=1)) == set(range(len(cameras)))
    assert near.min(axis=1).mean() < free.min(axis=1).mean()

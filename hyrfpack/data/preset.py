"""Detection of the preset, the kind of scene that photos show, from their cameras."""

from __future__ import annotations

import numpy as np

from hyrfpack.cameras.paths import common_direction
from hyrfpack.scene import Scene


def detect_preset(scene: Scene) -> tuple[str, str]:
    """Choose the preset (the paper's regime) that fits a scene; return it and the reason in words.

    - "synthetic": photos with transparency (an object without a background);
    - "large": the cameras look in one direction and move across it (aerial surveys);
    - "street": the cameras look in one direction and move along it;
    - "standard": everything else.
    """
    if scene.has_alpha or scene.layout == "blender":
        return "synthetic", "the photos have transparency" if scene.has_alpha else "the layout is NeRF-synthetic's"
    cameras = [view.camera for view in scene.train]
    axis = common_direction(cameras)
    if axis is None or len(scene.points) == 0:
        return "standard", "the cameras look in different directions" if axis is None else "the scene has no points"
    positions = np.array([camera.position for camera in cameras])
    offsets = positions - positions.mean(0)
    along = float(np.ptp(offsets @ axis))
    across = float(np.linalg.norm(np.ptp(offsets - np.outer(offsets @ axis, axis), axis=0)))
    depth = float(np.median((scene.points - positions.mean(0)) @ axis))
    if along > 2 * across and along > depth:
        return "street", "the cameras move along the direction they look in"
    if across > 0.5 * abs(depth):
        return "large", "the cameras look the same way and fly across it"
    return "standard", "the cameras look the same way from nearly one place"

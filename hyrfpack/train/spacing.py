"""The distance between neighbouring Gaussians in photos, which the learning rate of positions follows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hyrfpack.model import HybridModel
from hyrfpack.scene import View, evenly_spaced

MAX_MEASURED_VIEWS = 100
MAX_MEASURED_GAUSSIANS = 10_000
DEFAULT_SPACING = 0.01  # in local units, about the median of twelve sets


def gaussian_spacing(model: HybridModel, views: Sequence[View], count: int) -> float:
    """Return the typical distance between Gaussians that are neighbours in a photo, in local units.

    N Gaussians that are spread evenly over a photo of W x H pixels are sqrt(W H / N) pixels apart. At depth z, a pixel
    of a camera with focal length f (in pixels) is z / f wide. N is the number of Gaussians that the photo shows,
    occluded ones too, if `count` Gaussians are where those of the model are. The result is the median over all
    Gaussians in all photos; of many photos and Gaussians, some are measured.

    Args:
        model: the model that is to be trained.
        views: the training photos.
        count: number of Gaussians to assume. Training assumes the budget that pixels and steps suggest
            (`usual_budget_for`): rates that followed the budgets of pilot runs scored lower where these are small.

    Returns:
        The distance; DEFAULT_SPACING if no photo shows a Gaussian.
    """
    local = model.gaussians.positions.detach().cpu().numpy()
    every = max(1, -(-len(local) // MAX_MEASURED_GAUSSIANS))
    points = model.config.frame.to_world(local[::every])
    distances = [np.zeros(0)]
    for camera in (view.camera for view in evenly_spaced(views, MAX_MEASURED_VIEWS)):
        x, y, z = camera.project(points)
        is_shown = camera.in_picture(x, y, z)
        if is_shown.any():
            shown = is_shown.mean() * count
            pixels = np.sqrt(camera.width * camera.height / shown)
            distances.append(pixels * z[is_shown] / np.sqrt(camera.fx * camera.fy))
    measured = np.concatenate(distances)
    return float(np.median(measured)) / model.config.frame.scale if len(measured) else DEFAULT_SPACING

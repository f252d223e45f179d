"""Brings renders to the exposure of the photos taken near a camera."""

from __future__ import annotations

from torch import Tensor

from hyrfpack.model import HybridModel
from hyrfpack.model.exposure import apply_exposure_gains, clamp_colors
from hyrfpack.ops.transfer import tensor_like
from hyrfpack.scene import Camera


def apply_exposure_map(model: HybridModel, camera: Camera, rgb: Tensor) -> Tensor:
    """Apply the exposure map to a render of the consistent exposure, as `render_view` does for "as-photographed".

    Args:
        model: the model that was rendered.
        camera: the camera that it was rendered from, in world units.
        rgb: (..., 3) rendered with `RenderSettings(exposure="consistent")`. Colours above 1, which colour residuals can
            cause, become 1, because the gains are not defined there.

    Returns:
        (..., 3) in [0, 1]; `rgb` itself if the model has no exposure map. Differentiable in `rgb`.
    """
    if model.exposure is None:
        return rgb
    gains = model.exposure.predict_gains(model.config.frame.local_pose(camera))
    return apply_exposure_gains(clamp_colors(rgb), tensor_like(gains.tolist(), rgb))

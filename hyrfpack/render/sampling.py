"""Samples a scene no more finely than its photos did, so that enlarged views and close-ups show no dots.

Training widens each projected Gaussian by a low-pass filter as wide as a pixel of the photos. In a larger picture, or
from nearer, a filter as wide as a pixel of that picture is narrower than the one of training, and small Gaussians
become visible as dots. Mip-Splatting (2024) describes the effect, and a filter in space against it.
"""

from __future__ import annotations

from math import floor

import torch
from torch import Tensor

from hyrfpack.cameras.sampling import MAX_BACKGROUND_STRIDE
from hyrfpack.ops.rasterize import Gaussians3D
from hyrfpack.ops.transfer import tensor_like
from hyrfpack.ops.viewport import Viewport

# Variance, in px^2 of the photo, of the filter for views that sample more finely. Of 0.3 to 1, 0.4 scored best.
SAMPLING_VARIANCE = 0.4
_STRIDE_TOLERANCE = 0.01  # Files round focal lengths.


def widen_to_photos(
    gaussians: Gaussians3D, pixel_sizes: Tensor, viewport: Viewport, *, antialiased: bool
) -> Gaussians3D:
    """Widen Gaussians that the view samples more finely than any photo did.

        scales' = sqrt(scales^2 + a),  a = 0.4 max(0, q^2 - (z / f)^2)

    with the pixel size q, the depth z and the focal length f. So the filter of a view at the photos' distance and at k
    times their size has a variance of 0.3 + 0.4 (k^2 - 1) px^2. If `antialiased`, opacities are multiplied by
    r_1 r_2, where r = scale / scale' of the two longest axes.

    Args:
        gaussians: n Gaussians in local units.
        pixel_sizes: (n,) q, in local units.
        viewport: the camera, in local units.
        antialiased: whether the model dims Gaussians that the low-pass filter widens.

    Returns:
        The Gaussians, differentiable in all their properties except that a is a constant.
    """
    row = tensor_like(viewport.pose[2].tolist(), gaussians.means)
    depths = gaussians.means.detach() @ row[:3] + row[3]
    footprint = depths / max(viewport.intrinsics[:2])
    added = SAMPLING_VARIANCE * (pixel_sizes.square() - footprint.square()).clamp_min(0)[:, None]
    smallest = torch.finfo(added.dtype).tiny  # The gradient of a square root is infinite at zero.
    scales = (gaussians.scales.square() + added).clamp_min(smallest).sqrt()
    opacities = gaussians.opacities
    if antialiased:
        ratios = gaussians.scales / scales
        opacities = opacities * ratios.sort(dim=-1).values[:, 1:].prod(dim=-1)
    return gaussians._replace(scales=scales, opacities=opacities)


def background_stride(spacing: float, viewport: Viewport) -> int:
    """Return the pixels between nodes of the background, which are as far apart as in training, or nearer.

    Args:
        spacing: the spacing of training, see `hyrfpack.cameras.sampling.PhotoCameras.background_spacing`.
        viewport: the camera.
    """
    pixels = floor(min(spacing * max(viewport.intrinsics[:2]), MAX_BACKGROUND_STRIDE) + _STRIDE_TOLERANCE)
    return max(1, pixels)

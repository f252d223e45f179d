"""Choose at which pixels of a render the background is evaluated."""

from __future__ import annotations

import torch
from torch import Tensor

from hyrfpack.model import HybridModel
from hyrfpack.ops.viewport import Viewport

COARSER_STRIDES = (2, 4)
MIN_PREDICTED_PSNR = 60.0  # dB, of the picture with an interpolated background against that with an exact one
SAMPLED_PIXELS = 512
MIN_SHOWN_PIXELS = 16 * SAMPLED_PIXELS  # Fewer take less time than samples: each takes 5 or 10 evaluations.
_GOLDEN_RATIO = 0.6180339887498949  # Multiples of it, modulo 1, are evenly spread, and fall on all columns of a grid.


@torch.no_grad()
def choose_background_stride(model: HybridModel, transmittance: Tensor, viewport: Viewport, *, threshold: float) -> int:
    """Return the largest stride, of 1, 2 and 4, whose predicted interpolation error is invisible.

    At a sample of the pixels that show the background, its colour B is compared with B', interpolated between the nodes
    around. The prediction is the mean of (T (B - B'))^2 over all pixels of the picture.

    Args:
        model: the model, with a background sphere.
        transmittance: (H, W) T, the share of light that passes all Gaussians.
        viewport: the camera, in local units.
        threshold: the transmittance above which a pixel shows the background.
    """
    light = transmittance.reshape(-1)
    shown = torch.nonzero(light > threshold)[:, 0]
    if len(shown) < MIN_SHOWN_PIXELS:
        return 1
    spread = torch.arange(SAMPLED_PIXELS, dtype=torch.float64, device=light.device) * _GOLDEN_RATIO
    sampled = shown[(spread % 1 * len(shown)).long()]
    pixels = torch.stack((sampled % viewport.width, sampled // viewport.width), dim=-1)
    max_error = 10 ** (-MIN_PREDICTED_PSNR / 10) * len(light) / len(shown)  # mean of the pixels that are sampled from
    chosen = 1
    for stride in COARSER_STRIDES:
        first = pixels // stride * stride
        corners = [first + first.new_tensor(step) * stride for step in ((0, 0), (1, 0), (0, 1), (1, 1))]
        points = torch.cat((pixels, *corners)).to(light.dtype) + 0.5
        exact, *nodes = model.decode_background(points, viewport).split(SAMPLED_PIXELS)
        right, down = ((pixels - first).to(light.dtype) / stride)[:, None].unbind(-1)
        between = torch.lerp(torch.lerp(nodes[0], nodes[1], right), torch.lerp(nodes[2], nodes[3], right), down)
        if not float((light[sampled, None] * (between - exact)).square().mean()) <= max_error:
            break
        chosen = stride
    return chosen

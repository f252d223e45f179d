"""Computes the median depth of an image: where a ray has lost half of its light."""

from __future__ import annotations

import torch
from torch import Tensor

from hyrfpack.ops.dispatch import choose_implementation
from hyrfpack.ops.rasterize.inputs import Gaussians3D, RasterSettings, check_shapes
from hyrfpack.ops.rasterize.reference import ALPHA_MAX, ALPHA_MIN, Projected, depth_slopes, project
from hyrfpack.ops.viewport import Viewport

MEDIAN_TRANSMITTANCE = 0.5
# A plane's depth is limited to the depth of the Gaussian's centre divided and multiplied by this ratio. Beyond it, as
# on needles that point at the camera, the affine projection does not hold.
MAX_PLANE_DEPTH_RATIO = 2.0
_MAX_PIXEL_PAIRS_PER_CHUNK = 1 << 21


@torch.no_grad()
def median_depth(
    gaussians: Gaussians3D,
    viewport: Viewport,
    settings: RasterSettings = RasterSettings(),  # noqa: B008 - frozen
    *,
    implementation: str = "auto",
) -> Tensor:
    """Compute the depth at which each pixel's transmittance falls to 1/2 or below. Not differentiable.

    Gaussians are projected, sorted and blended as by `rasterize`. The depth is that of the Gaussian at which the
    transmittance falls, in the plane in which this Gaussian lies (`depth_slopes`), and not its centre's: large flat
    Gaussians would otherwise become steps. In contrast to an expected depth, it never lies between two surfaces.

    Args:
        gaussians: N Gaussians.
        viewport: the camera.
        settings: near plane, antialiasing and low-pass filter; the others have no effect.
        implementation: "auto", "reference" or "cpu".

    Returns:
        (H, W) camera z in world units; 0 where more than half of the light passes all Gaussians.

    Example:
        >>> shape = torch.tensor([[0.0, 0.0, 2.0]]), torch.tensor([[1.0, 0.0, 0.0, 0.0]]), torch.full((1, 3), 0.1)
        >>> viewport = Viewport(torch.eye(4), (32.0, 32.0, 16.0, 16.0), 32, 32)
        >>> depth = median_depth(Gaussians3D(*shape, torch.tensor([0.9])), viewport)
        >>> round(depth[16, 16].item(), 3), depth[0, 0].item()
        (2.0, 0.0)
    """
    check_shapes(gaussians)
    if choose_implementation("median_depth", implementation, ("reference", "cpu"), *gaussians) == "cpu":
        from hyrfpack.ops.rasterize import cpu

        # Slopes of needles cancel in float32.
        precise = Gaussians3D(*(tensor.double() for tensor in gaussians))
        projected = project(precise, viewport, settings)
        planes = torch.zeros_like(gaussians.means)
        planes[projected.index, :2] = depth_slopes(precise, viewport, projected).to(planes.dtype)
        return cpu.median_depth(gaussians, planes, MAX_PLANE_DEPTH_RATIO, viewport, settings)
    projected = project(gaussians, viewport, settings)
    slopes = depth_slopes(gaussians, viewport, projected)
    order = torch.argsort(projected.depths.float(), stable=True)
    projected, slopes = projected.select(order), slopes[order]
    height, width = viewport.height, viewport.width
    rows = torch.arange(height, device=slopes.device, dtype=slopes.dtype) + 0.5
    columns = torch.arange(width, device=slopes.device, dtype=slopes.dtype) + 0.5
    pixels = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), -1).view(-1, 2)
    chunks = pixels.split(max(1, _MAX_PIXEL_PAIRS_PER_CHUNK // max(1, len(slopes))))
    return torch.cat([_median_at(projected, slopes, chunk) for chunk in chunks]).view(height, width)


def _median_at(projected: Projected, slopes: Tensor, pixels: Tensor) -> Tensor:
    """Return the median depth (P,) at pixels (P, 2), given Gaussians in depth order with their slopes (M, 2)."""
    if not len(slopes):
        return pixels.new_zeros(len(pixels))
    offsets = pixels[:, None] - projected.means2d
    dx, dy = offsets.unbind(-1)
    a, b, c = projected.conics.unbind(-1)
    alphas = projected.opacities * torch.exp((-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy).clamp_max(0))
    alphas = torch.where(alphas >= ALPHA_MIN, alphas.clamp_max(ALPHA_MAX), 0)
    dark = (1 - alphas).cumprod(-1) <= MEDIAN_TRANSMITTANCE
    first = dark.to(torch.uint8).argmax(-1)
    centers = projected.depths[first]
    depths = centers + (slopes * offsets).sum(-1).gather(1, first[:, None])[:, 0]
    depths = depths.clamp(centers / MAX_PLANE_DEPTH_RATIO, centers * MAX_PLANE_DEPTH_RATIO)
    return torch.where(dark[:, -1], depths, 0)

"""Implements rasterisation in plain torch for any device, in float32 or float64, differentiable by autograd.

This reference defines the correct result: every faster implementation must compute what `project` and `blend` compute.
`rasterize` applies them tile by tile to bound memory. Tiles never affect the result, since a Gaussian is skipped in a
tile only if its alpha is below 1/255 on the whole tile.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from hyrfpack.ops.rasterize.inputs import TRANSMITTANCE_MIN, Gaussians3D, RasterSettings
from hyrfpack.ops.viewport import Viewport

TILE_SIZE = 16  # Tiles are squares; this is the side in pixels.
ALPHA_MAX = 0.99
ALPHA_MIN = 1 / 255
# Lower bound of det(Sigma) / det(Sigma + v I) in the compensation of opacities for the low-pass.
DETERMINANT_RATIO_MIN = 2.5e-5
QUAT_NORM_MIN = 1e-12
_MAX_PIXEL_PAIRS_PER_CHUNK = 1 << 21


@dataclass(frozen=True)
class Projected:
    """The M Gaussians in front of the camera, projected to the image, in the order of the input.

    Attributes:
        index: (M,) the index of each Gaussian in the input.
        means2d: (M, 2) pixels.
        covs2d: (M, 3) xx, xy, yy in px^2, low-pass included.
        conics: (M, 3) xx, xy, yy of the inverse covariance in 1/px^2.
        depths: (M,) camera z in world units.
        opacities: (M,) compensated for the low-pass when antialiased.
    """

    index: Tensor
    means2d: Tensor
    covs2d: Tensor
    conics: Tensor
    depths: Tensor
    opacities: Tensor

    def select(self, which: Tensor) -> Projected:
        """Return the Gaussians at the given positions, in the given order."""
        return Projected(*(getattr(self, name)[which] for name in self.__dataclass_fields__))


def jacobian_limits(viewport: Viewport) -> tuple[float, float, float, float]:
    """Return the ranges of x/z (min, max) and y/z (min, max) to which the projection's Jacobian is clamped.

    They are the field of view, widened by 0.15 of its size on each side (the 3DGS rule, about the principal point).
    """
    fx, fy, cx, cy = viewport.intrinsics
    width, height = viewport.width, viewport.height
    slack_x, slack_y = 0.15 * width / fx, 0.15 * height / fy
    return -cx / fx - slack_x, (width - cx) / fx + slack_x, -cy / fy - slack_y, (height - cy) / fy + slack_y


def project(gaussians: Gaussians3D, viewport: Viewport, settings: RasterSettings) -> Projected:
    """Project 3D Gaussians to 2D Gaussians (EWA splatting).

    The 2D covariance is J R Q diag(s^2) Q^T R^T J^T + v I, where v is `low_pass_variance`. Here J is the Jacobian of
    the pinhole projection at the mean in the camera's frame, p = R m + t, evaluated with x/z and y/z clamped to
    `jacobian_limits`. Gaussians at z <= near are dropped. The arguments are those of
    `hyrfpack.ops.rasterize.rasterize`.
    """
    means, quats, scales, opacities = gaussians
    fx, fy, cx, cy = viewport.intrinsics
    # Far from the origin R m and t are large and cancel, so float64 is used where it exists (Apple's GPUs have none).
    exact = torch.float32 if means.device.type == "mps" else torch.float64
    camera = viewport.pose.to(exact).to(means.device)
    in_camera = means.to(exact) @ camera[:3, :3].T + camera[:3, 3]
    index = torch.nonzero(in_camera[:, 2] > settings.near)[:, 0]
    x, y, z = in_camera[index].to(means.dtype).unbind(-1)
    x_z, y_z = x / z, y / z
    axes = camera[:3, :3].to(means.dtype) @ quats_to_rotations(quats[index]) * scales[index, None, :]
    half = _projection_jacobian(x_z, y_z, z, viewport) @ axes

    xx, xy, yy = (half[:, 0] ** 2).sum(-1), (half[:, 0] * half[:, 1]).sum(-1), (half[:, 1] ** 2).sum(-1)
    # |a x b|^2 = |a|^2 |b|^2 - (a . b)^2 without the cancellation that needles suffer from.
    determinant = torch.linalg.cross(half[:, 0], half[:, 1]).square().sum(-1)
    low_pass = settings.low_pass_variance
    filtered = determinant + low_pass * (xx + yy) + low_pass**2
    opacities = opacities[index]
    if settings.antialiased:
        opacities = opacities * (determinant / filtered).clamp_min(DETERMINANT_RATIO_MIN).sqrt()
    xx, yy = xx + low_pass, yy + low_pass
    return Projected(
        index=index,
        means2d=torch.stack([fx * x_z + cx, fy * y_z + cy], -1),
        covs2d=torch.stack([xx, xy, yy], -1),
        conics=torch.stack([yy, -xy, xx], -1) / filtered[:, None],
        depths=z,
        opacities=opacities,
    )


def depth_slopes(gaussians: Gaussians3D, viewport: Viewport, projected: Projected) -> Tensor:
    """Return the slopes (M, 2) of the planes in which projected Gaussians lie: dz / d(pixel) along x and y.

    With the local affine projection, image position and depth are jointly Gaussian. The mean of z given an offset d
    from the 2D centre is z + s . d, with s = Cov(z, image) Sigma^-1 and Sigma the 2D covariance, low-pass included.
    """
    index = projected.index
    rotation = viewport.pose[:3, :3].to(gaussians.means)
    axes = rotation @ quats_to_rotations(gaussians.quats[index]) * gaussians.scales[index, None, :]
    fx, fy, cx, cy = viewport.intrinsics
    x_z, y_z = (projected.means2d[:, 0] - cx) / fx, (projected.means2d[:, 1] - cy) / fy
    half = _projection_jacobian(x_z, y_z, projected.depths, viewport) @ axes
    covariance_x, covariance_y = (half @ axes[:, 2, :, None])[..., 0].unbind(-1)
    xx, xy, yy = projected.conics.unbind(-1)
    return torch.stack([xx * covariance_x + xy * covariance_y, xy * covariance_x + yy * covariance_y], -1)


def _projection_jacobian(x_z: Tensor, y_z: Tensor, z: Tensor, viewport: Viewport) -> Tensor:
    """Return the Jacobians (M, 2, 3) of the projection to pixels, with x/z and y/z clamped to `jacobian_limits`."""
    fx, fy, *_ = viewport.intrinsics
    left, right, top, bottom = jacobian_limits(viewport)
    clamped_x, clamped_y = x_z.clamp(left, right), y_z.clamp(top, bottom)
    zero = torch.zeros_like(z)
    return torch.stack([fx / z, zero, -fx * clamped_x / z, zero, fy / z, -fy * clamped_y / z], -1).view(-1, 2, 3)


def blend(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    values: Tensor,
    pixels: Tensor,
    on_grad: Callable[[Tensor], None] | None = None,
    transmittance_min: float = TRANSMITTANCE_MIN,
) -> tuple[Tensor, Tensor, Tensor]:
    """Blend 2D Gaussians front to back at the given pixels.

        alpha_i = min(0.99, opacity_i exp(-1/2 d^T conic_i d)), skipped below 1/255
        T_i = product over j < i of (1 - alpha_j);  a pixel is finished once T_i <= transmittance_min

    No gradient passes through an alpha that is clamped to 0.99.

    Args:
        means2d, conics, opacities: (M, 2), (M, 3), (M,) in depth order.
        values: (M, C) the values to blend.
        pixels: (P, 2) pixel centres.
        on_grad: called in backward with dL/d means2d of each pixel separately, (P, M, 2).
        transmittance_min: T at which a pixel is finished, in [0, 1).

    Returns:
        (P, C) sum of T_i alpha_i values_i; (P,) remaining transmittance; (P, M) whether alpha_i >= 1/255.
    """
    centers = means2d.expand(len(pixels), -1, -1)
    if on_grad is not None and centers.requires_grad:
        centers.register_hook(on_grad)
    dx, dy = (centers - pixels[:, None]).unbind(-1)
    a, b, c = conics.unbind(-1)
    power = (-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy).clamp_max(0)
    alphas = (opacities * torch.exp(power)).clamp_max(ALPHA_MAX)
    hits = alphas >= ALPHA_MIN
    alphas = torch.where(hits, alphas, 0)
    before = _transmittances(alphas.detach())[:, :-1]
    alphas = torch.where(before > transmittance_min, alphas, 0)
    transmittances = _transmittances(alphas)
    return (transmittances[:, :-1] * alphas) @ values, transmittances[:, -1], hits


def _transmittances(alphas: Tensor) -> Tensor:
    """Return the transmittances (P, M + 1) before each of the Gaussians' alphas (P, M) and after the last."""
    return torch.cat([alphas.new_ones(len(alphas), 1), (1 - alphas).cumprod(-1)], -1)


def rasterize(
    gaussians: Gaussians3D, colors: Tensor, viewport: Viewport, settings: RasterSettings, absgrad: Tensor | None
) -> tuple[Tensor, Tensor, Tensor | None, Tensor, int, dict[str, float]]:
    """Compute `hyrfpack.ops.rasterize.rasterize`; the result is a tuple of the fields of `Rasterization` in order."""
    started = perf_counter()
    projected = project(gaussians, viewport, settings)
    ended_project = perf_counter()
    # Depths are sorted in float32, so that the order is the same in every precision; ties keep the input's order.
    projected = projected.select(torch.argsort(projected.depths.detach().float(), stable=True))
    with torch.no_grad():
        # The extent along each axis is that of the ellipse opacity exp(-r^2 / 2) = 1/255, plus a safety margin.
        reach = 2 * torch.log(255 * projected.opacities).clamp_min(0) + 1e-3
        extent = (reach[:, None] * projected.covs2d[:, [0, 2]]).sqrt() + 0.01
        lower, upper = projected.means2d - extent, projected.means2d + extent
        above_alpha_min = projected.opacities >= ALPHA_MIN
    values = torch.cat([colors[projected.index], projected.depths.detach()[:, None]], -1)
    ended_sort = perf_counter()

    means, width, height = gaussians.means, viewport.width, viewport.height
    visible = torch.zeros(len(means), dtype=torch.bool, device=means.device)
    pairs = 0
    strips = []
    for top in range(0, height, TILE_SIZE):
        tiles = []
        for left in range(0, width, TILE_SIZE):
            right, bottom = min(left + TILE_SIZE, width), min(top + TILE_SIZE, height)
            first, last = means.new_tensor([left, top]), means.new_tensor([right, bottom])
            candidates = torch.nonzero(above_alpha_min & (lower <= last).all(-1) & (upper >= first).all(-1))[:, 0]
            tile, touched = _blend_tile(
                projected.select(candidates),
                values[candidates],
                left,
                top,
                right,
                bottom,
                absgrad,
                settings.transmittance_min,
            )
            tiles.append(tile)
            visible[projected.index[candidates[touched]]] = True
            pairs += int(touched.sum())
        strips.append(torch.cat(tiles, 1))
    picture = torch.cat(strips)
    rgb, depth_sum, transmittance = picture[..., :3], picture[..., 3].detach(), picture[..., 4]
    weight = 1 - transmittance.detach()
    depths = torch.where(weight > 0, depth_sum / weight, 0) if settings.depth else None
    ended = perf_counter()
    seconds = {"project": ended_project - started, "sort": ended_sort - ended_project, "bin": 0.0}
    seconds["blend"] = ended - ended_sort
    return rgb, transmittance, depths, visible, pairs, seconds


def _blend_tile(
    splats: Projected,
    values: Tensor,
    left: int,
    top: int,
    right: int,
    bottom: int,
    absgrad: Tensor | None,
    transmittance_min: float,
) -> tuple[Tensor, Tensor]:
    """Blend one tile.

    Returns:
        (h, w, C + 1) blended values and transmittance; (M,) whether each Gaussian reaches alpha 1/255 in the tile.
    """
    columns = torch.arange(left, right, device=values.device, dtype=values.dtype) + 0.5
    rows = torch.arange(top, bottom, device=values.device, dtype=values.dtype) + 0.5
    pixels = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), -1).view(-1, 2)

    def add_absgrad(grad: Tensor) -> None:
        assert absgrad is not None
        absgrad.index_add_(0, splats.index, grad.detach().abs().sum(0).to(absgrad.dtype))

    on_grad = None if absgrad is None else add_absgrad
    parts = []
    touched = torch.zeros(len(values), dtype=torch.bool, device=values.device)
    for chunk in pixels.split(max(1, _MAX_PIXEL_PAIRS_PER_CHUNK // max(1, len(values)))):
        # Blending is recomputed in backward, so that memory never holds the pixel pairs of the whole image.
        blended, transmittance, hits = checkpoint(
            blend,
            splats.means2d,
            splats.conics,
            splats.opacities,
            values,
            chunk,
            on_grad,
            transmittance_min,
            use_reentrant=False,
        )
        parts.append(torch.cat([blended, transmittance[:, None]], -1))
        touched |= hits.any(0)
    return torch.cat(parts).view(len(rows), len(columns), -1), touched


def quats_to_rotations(quats: Tensor) -> Tensor:
    """Return rotation matrices (M, 3, 3) of quaternions (M, 4) wxyz of any length; the identity for length zero."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1, eps=QUAT_NORM_MIN).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    ]
    return torch.stack(rows, -1).view(-1, 3, 3)

"""The definition of right for rasterising: plain torch, any device, float32 or float64, differentiable by autograd.

`project` and `blend` say what every faster implementation must compute. `rasterize` puts them together tile by tile,
so that memory stays bounded, and never lets a tile decide anything: a Gaussian is left out of a tile only where its
alpha is below 1/255 on all of the tile.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

TILE = 16
LOW_PASS = 0.3  # px^2 added to the diagonal of every 2D covariance
ALPHA_MAX = 0.99
ALPHA_MIN = 1 / 255
TRANSMITTANCE_MIN = 1 / 512  # half a step of 8 bits
COMPENSATION_MIN = 2.5e-5  # of the determinant ratio under `antialiased`
QUAT_NORM_MIN = 1e-12
_PIXEL_PAIRS_AT_ONCE = 1 << 21


@dataclass(frozen=True)
class Projected:
    """Gaussians in front of the camera, as seen in the picture. M of them, in the order of the input.

    Attributes:
        index: (M,) which input Gaussian each one is.
        means2d: (M, 2) pixels.
        covs2d: (M, 3) xx, xy, yy in px^2, low-pass included.
        conics: (M, 3) the inverse covariance, likewise.
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
        """Those of the given positions, in the given order."""
        return Projected(*(getattr(self, name)[which] for name in self.__dataclass_fields__))


def jacobian_limits(
    intrinsics: tuple[float, float, float, float], width: int, height: int
) -> tuple[float, float, float, float]:
    """The x/z (least, most) and y/z (least, most) that the projection's Jacobian is taken at, at most.

    It is the field of view widened by 0.15 of its size on each side (the 3DGS rule, about the principal point).
    """
    fx, fy, cx, cy = intrinsics
    slack_x, slack_y = 0.15 * width / fx, 0.15 * height / fy
    return -cx / fx - slack_x, (width - cx) / fx + slack_x, -cy / fy - slack_y, (height - cy) / fy + slack_y


def project(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    camera_from_world: Tensor,
    intrinsics: tuple[float, float, float, float],
    width: int,
    height: int,
    near: float,
    antialiased: bool,
) -> Projected:
    """Project 3D Gaussians to 2D Gaussians (EWA splatting).

    With p = R m + t the mean in the camera and J the Jacobian of the pinhole projection at p, the picture's
    covariance is J R Q diag(s^2) Q^T R^T J^T + 0.3 I. J is taken with x/z and y/z clamped to `jacobian_limits`.
    Gaussians at z <= near are dropped. Arguments as in `hyrfpack.ops.rasterize.rasterize`.
    """
    fx, fy, cx, cy = intrinsics
    # In float64 where there is one (Apple's GPUs have none): far from the origin, R m and t are large and cancel.
    exact = torch.float32 if means.device.type == "mps" else torch.float64
    camera = camera_from_world.to(exact).to(means.device)
    seen = means.to(exact) @ camera[:3, :3].T + camera[:3, 3]
    index = torch.nonzero(seen[:, 2] > near)[:, 0]
    x, y, z = seen[index].to(means.dtype).unbind(-1)
    x_z, y_z = x / z, y / z

    left, right, top, bottom = jacobian_limits(intrinsics, width, height)
    clamped_x, clamped_y = x_z.clamp(left, right), y_z.clamp(top, bottom)
    zero = torch.zeros_like(z)
    jacobian = torch.stack([fx / z, zero, -fx * clamped_x / z, zero, fy / z, -fy * clamped_y / z], -1).view(-1, 2, 3)
    half = jacobian @ camera[:3, :3].to(means.dtype) @ _rotations(quats[index]) * scales[index, None, :]

    xx, xy, yy = (half[:, 0] ** 2).sum(-1), (half[:, 0] * half[:, 1]).sum(-1), (half[:, 1] ** 2).sum(-1)
    # |a x b|^2 = |a|^2 |b|^2 - (a . b)^2 without the cancellation that needles suffer from.
    determinant = torch.linalg.cross(half[:, 0], half[:, 1]).square().sum(-1)
    filtered = determinant + LOW_PASS * (xx + yy) + LOW_PASS**2
    opacities = opacities[index]
    if antialiased:
        opacities = opacities * (determinant / filtered).clamp_min(COMPENSATION_MIN).sqrt()
    xx, yy = xx + LOW_PASS, yy + LOW_PASS
    return Projected(
        index=index,
        means2d=torch.stack([fx * x_z + cx, fy * y_z + cy], -1),
        covs2d=torch.stack([xx, xy, yy], -1),
        conics=torch.stack([yy, -xy, xx], -1) / filtered[:, None],
        depths=z,
        opacities=opacities,
    )


def blend(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    values: Tensor,
    pixels: Tensor,
    on_grad: Callable[[Tensor], None] | None = None,
    transmittance_min: float = TRANSMITTANCE_MIN,
) -> tuple[Tensor, Tensor, Tensor]:
    """Blend 2D Gaussians, nearest first, at some pixels.

        alpha_i = min(0.99, opacity_i exp(-1/2 d^T conic_i d)), left out below 1/255
        T_i = product over j < i of (1 - alpha_j);  a pixel is finished once T_i <= transmittance_min

    No gradient passes through an alpha that is cut at 0.99.

    Args:
        means2d, conics, opacities: (M, 2), (M, 3), (M,) in depth order.
        values: (M, C) what to blend.
        pixels: (P, 2) pixel centres.
        on_grad: called in backward with dL/d means2d apart for each pixel, (P, M, 2).
        transmittance_min: in [0, 1).

    Returns:
        (P, C) sum of T_i alpha_i values_i; (P,) transmittance left; (P, M) whether alpha_i >= 1/255.
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
    """(P, M + 1) what light is left before each of the Gaussians (P, M), and after the last."""
    return torch.cat([alphas.new_ones(len(alphas), 1), (1 - alphas).cumprod(-1)], -1)


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    camera_from_world: Tensor,
    intrinsics: tuple[float, float, float, float],
    width: int,
    height: int,
    *,
    near: float,
    antialiased: bool,
    transmittance_min: float,
    depth: bool,
    absgrad: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor | None, Tensor, int, dict[str, float]]:
    """Arguments and results (a tuple in the order of the fields) as in `hyrfpack.ops.rasterize.rasterize`."""
    started = perf_counter()
    projected = project(
        means, quats, scales, opacities, camera_from_world, intrinsics, width, height, near, antialiased
    )
    ended_project = perf_counter()
    # float32 depths decide the order, so that it is one and the same in every precision; ties keep the input's order.
    projected = projected.select(torch.argsort(projected.depths.detach().float(), stable=True))
    with torch.no_grad():
        # Where opacity exp(-r^2 / 2) = 1/255, along each axis, with a little to spare.
        reach = 2 * torch.log(255 * projected.opacities).clamp_min(0) + 1e-3
        extent = (reach[:, None] * projected.covs2d[:, [0, 2]]).sqrt() + 0.01
        lower, upper = projected.means2d - extent, projected.means2d + extent
        possible = projected.opacities >= ALPHA_MIN
    values = torch.cat([colors[projected.index], projected.depths.detach()[:, None]], -1)
    ended_sort = perf_counter()

    visible = torch.zeros(len(means), dtype=torch.bool, device=means.device)
    pairs = 0
    strips = []
    for top in range(0, height, TILE):
        tiles = []
        for left in range(0, width, TILE):
            right, bottom = min(left + TILE, width), min(top + TILE, height)
            first, last = means.new_tensor([left, top]), means.new_tensor([right, bottom])
            reaches = torch.nonzero(possible & (lower <= last).all(-1) & (upper >= first).all(-1))[:, 0]
            tile, touched = _blend_tile(
                projected.select(reaches), values[reaches], left, top, right, bottom, absgrad, transmittance_min
            )
            tiles.append(tile)
            visible[projected.index[reaches[touched]]] = True
            pairs += int(touched.sum())
        strips.append(torch.cat(tiles, 1))
    picture = torch.cat(strips)
    rgb, depth_sum, transmittance = picture[..., :3], picture[..., 3].detach(), picture[..., 4]
    weight = 1 - transmittance.detach()
    depths = torch.where(weight > 0, depth_sum / weight, 0) if depth else None
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
    """(h, w, C + 1) blended values and transmittance of one tile; (M,) which Gaussians reach alpha 1/255 in it."""
    columns = torch.arange(left, right, device=values.device, dtype=values.dtype) + 0.5
    rows = torch.arange(top, bottom, device=values.device, dtype=values.dtype) + 0.5
    pixels = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), -1).view(-1, 2)

    def add_absgrad(grad: Tensor) -> None:
        assert absgrad is not None
        absgrad.index_add_(0, splats.index, grad.detach().abs().sum(0).to(absgrad.dtype))

    on_grad = None if absgrad is None else add_absgrad
    parts = []
    touched = torch.zeros(len(values), dtype=torch.bool, device=values.device)
    for some in pixels.split(max(1, _PIXEL_PAIRS_AT_ONCE // max(1, len(values)))):
        # Recomputed in backward, so that the whole picture's pairs never lie in memory at once.
        blended, transmittance, hits = checkpoint(
            blend,
            splats.means2d,
            splats.conics,
            splats.opacities,
            values,
            some,
            on_grad,
            transmittance_min,
            use_reentrant=False,
        )
        parts.append(torch.cat([blended, transmittance[:, None]], -1))
        touched |= hits.any(0)
    return torch.cat(parts).view(len(rows), len(columns), -1), touched


def _rotations(quats: Tensor) -> Tensor:
    """(M, 3, 3) rotation matrices of quaternions (M, 4) wxyz of any length; the identity for a length of zero."""
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

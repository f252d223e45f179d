"""The background sphere in plain torch around the operations it needs: the definition of right."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from hyrfpack.ops.contraction import contract
from hyrfpack.ops.hash_encode import hash_encode
from hyrfpack.ops.mlp import mlp
from hyrfpack.ops.poses import camera_center
from hyrfpack.ops.shade.directions import encode_directions

RADIUS = 100.0  # local units, around the frame's centre


def sphere_points(origin: Tensor, directions: Tensor) -> Tensor:
    """Where rays leave the background sphere.

        p = q + sqrt(max(R^2 - |q|^2, 0)) d,  q = o - (o.d) d the ray's point nearest to the centre

    A ray from outside that misses the sphere gives q, so every ray has a finite answer. The textbook root
    -(o.d) + sqrt((o.d)^2 - |o|^2 + R^2) subtracts squares of the distance: from 1e5 away float32 would miss by R / 4.

    Args:
        origin: (3,) the camera, local units.
        directions: (N, 3) unit vectors.

    Returns:
        (N, 3) local units.
    """
    nearest = origin - (directions @ origin)[:, None] * directions
    inside = (RADIUS**2 - nearest.square().sum(-1)).clamp_min(0)
    return nearest + inside.sqrt()[:, None] * directions


def pixel_directions(points: Tensor, intrinsics: tuple[float, float, float, float], pose: Tensor) -> Tensor:
    """Unit viewing directions through points of the picture.

    Args:
        points: (N, 2) x and y in pixels; the first pixel's centre is (0.5, 0.5).
        intrinsics: (fx, fy, cx, cy) in pixels.
        pose: (4, 4) camera_from_local.

    Returns:
        (N, 3) unit vectors in local axes.
    """
    fx, fy, cx, cy = intrinsics
    x, y = (points[:, 0] - cx) / fx, (points[:, 1] - cy) / fy
    directions = torch.stack((x, y, torch.ones_like(x)), dim=-1) @ pose[:3, :3]
    return directions / torch.linalg.vector_norm(directions, dim=-1, keepdim=True)


def background_colors(
    points: Tensor,
    *,
    pose: Tensor,
    intrinsics: tuple[float, float, float, float],
    half_extent: tuple[float, float, float],
    table: Tensor,
    resolutions: tuple[int, ...],
    log2_table_size: int,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    encoding: str,
    mixed: bool,
) -> Tensor:
    """Colours (N, 3) of the sphere at points (N, 2) of the picture, in pixels; the rest as in `background_grid`.

    sigmoid(mlp([hash_encode(contract(p / half_extent)), e(d)])),  p where the ray along d leaves the sphere
    """
    pose = pose.to(table, non_blocking=table.is_cuda)
    directions = pixel_directions(points, intrinsics, pose)
    coords = contract(sphere_points(camera_center(pose), directions), half_extent)
    encoded = encode_directions(directions, encoding)
    return field_colors(coords, encoded, table, resolutions, log2_table_size, weights, biases, mixed)


def field_colors(
    coords: Tensor,
    encoded: Tensor,
    table: Tensor,
    resolutions: tuple[int, ...],
    log2_table_size: int,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    mixed: bool,
) -> Tensor:
    """Colours (N, 3) that the field has at coords (N, 3) of the cube, seen along directions encoded as (N, E)."""
    features = hash_encode(coords, table, resolutions, log2_table_size)
    # Hash features are stored by columns, and joined so.
    inputs = torch.cat((features.T, encoded.T)).T
    return torch.sigmoid(mlp(inputs, weights, biases, mixed=mixed))


def grid_size(height: int, width: int, stride: int) -> tuple[int, int]:
    """Rows and columns of nodes, the last at or past the picture's edge."""
    return -(-(height - 1) // stride) + 1, -(-(width - 1) // stride) + 1


def background_grid(transmittance: Tensor, *, threshold: float, stride: int, **sphere) -> Tensor:
    """As `hyrfpack.ops.background.background_grid`; `sphere` is what `background_colors` takes."""
    height, width = transmittance.shape
    rows, columns = grid_size(height, width, stride)
    # A node is needed when light passes at any pixel nearer to it than the next nodes.
    reach = stride - 1
    padded = torch.nn.functional.pad(
        transmittance.detach()[None], (reach, columns * stride - width, reach, rows * stride - height)
    )
    light = torch.nn.functional.max_pool2d(padded, kernel_size=2 * stride - 1, stride=stride)[0]
    nodes = torch.nonzero(light.reshape(-1) > threshold).squeeze(-1)
    colors = transmittance.new_zeros(rows * columns, 3)
    if len(nodes):
        places = torch.stack((nodes % columns, torch.div(nodes, columns, rounding_mode="floor")), dim=-1)
        points = places.to(transmittance.dtype) * stride + 0.5
        colors = colors.index_put((nodes,), background_colors(points, **sphere))
    return colors.T.reshape(3, rows, columns).permute(1, 2, 0)

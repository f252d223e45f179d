"""Implements the background sphere in plain torch, on top of other operations.

This reference defines the correct result.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from hyrfpack.ops.contraction import contract
from hyrfpack.ops.hash_encode import hash_encode
from hyrfpack.ops.mlp import mlp
from hyrfpack.ops.poses import camera_center
from hyrfpack.ops.shade.directions import encode_directions
from hyrfpack.ops.viewport import Viewport

# Radius of the background sphere around the frame's centre, in local units.
BACKGROUND_RADIUS = 100.0


@dataclass(frozen=True)
class BackgroundField:
    """The radiance field that colours the background sphere.

    Attributes:
        half_extent: half-axes of the box that the contraction maps linearly, local units.
        table, resolutions, log2_table_size: the hash grid, as in `hash_encode`.
        weights, biases: the decoder, as in `mlp`; three outputs.
        encoding: the encoding of directions, "frequency" or "sh", see `encode_directions`.
        mixed: as in `mlp`.
    """

    half_extent: tuple[float, float, float]
    table: Tensor
    resolutions: tuple[int, ...]
    log2_table_size: int
    weights: Sequence[Tensor]
    biases: Sequence[Tensor]
    encoding: str
    mixed: bool = False


def sphere_points(origin: Tensor, directions: Tensor) -> Tensor:
    """Compute the points where rays leave the background sphere.

        p = q + sqrt(max(R^2 - |q|^2, 0)) d,  q = o - (o.d) d the ray's point nearest to the centre

    For a ray from outside that misses the sphere, p = q, so that every ray has a finite result. The textbook root
    -(o.d) + sqrt((o.d)^2 - |o|^2 + R^2) is not used, because it subtracts squares of the distance: from 1e5 away its
    error in float32 would be R / 4.

    Args:
        origin: (3,) the camera, local units.
        directions: (N, 3) unit vectors.

    Returns:
        (N, 3) local units.
    """
    nearest = origin - (directions @ origin)[:, None] * directions
    inside = (BACKGROUND_RADIUS**2 - nearest.square().sum(-1)).clamp_min(0)
    return nearest + inside.sqrt()[:, None] * directions


def pixel_directions(points: Tensor, viewport: Viewport) -> Tensor:
    """Compute unit viewing directions through points of the image.

    Args:
        points: (N, 2) x and y in pixels; the first pixel's centre is (0.5, 0.5).
        viewport: the camera, with its pose in the dtype and on the device of the points.

    Returns:
        (N, 3) unit vectors in world axes.
    """
    fx, fy, cx, cy = viewport.intrinsics
    x, y = (points[:, 0] - cx) / fx, (points[:, 1] - cy) / fy
    directions = torch.stack((x, y, torch.ones_like(x)), dim=-1) @ viewport.pose[:3, :3]
    return directions / torch.linalg.vector_norm(directions, dim=-1, keepdim=True)


def camera_rays(viewport: Viewport, stride: int) -> tuple[tuple[float, ...], ...]:
    """Return the first node's ray, its increments per column and per row, and the origin, as tuples of 3 numbers."""
    fx, fy, cx, cy = viewport.intrinsics
    pose = viewport.pose.detach().cpu().double()
    in_camera = [[(0.5 - cx) / fx, (0.5 - cy) / fy, 1], [stride / fx, 0, 0], [0, stride / fy, 0]]
    rays = torch.tensor(in_camera, dtype=torch.float64) @ pose[:3, :3]
    return tuple(map(tuple, (*rays.tolist(), camera_center(pose).tolist())))


def background_colors(points: Tensor, viewport: Viewport, field: BackgroundField) -> Tensor:
    """Compute the colours (N, 3) of the sphere at points (N, 2) of the image, in pixels.

        color = sigmoid(mlp([hash_encode(contract(p / half_extent)), e(d)]))

    The ray of a point leaves the sphere at p along d.
    """
    pose = viewport.pose.to(field.table, non_blocking=field.table.is_cuda)
    directions = pixel_directions(points, replace(viewport, pose=pose))
    coords = contract(sphere_points(camera_center(pose), directions), field.half_extent)
    return field_colors(coords, encode_directions(directions, field.encoding), field)


def field_colors(coords: Tensor, encoded: Tensor, field: BackgroundField, used: Tensor | None = None) -> Tensor:
    """Compute the field's colours (N, 3) at coords (N, 3) of the cube for encoded directions (N, E).

    `used` is the number of rows in use, see `hyrfpack.ops.rows`; None if all are.
    """
    features = hash_encode(coords, field.table, field.resolutions, field.log2_table_size, used=used)
    # Hash features are stored planar, so concatenating along the first axis is a plain copy.
    inputs = torch.cat((features.T, encoded.T)).T
    return torch.sigmoid(mlp(inputs, field.weights, field.biases, mixed=field.mixed, used=used))


def grid_size(height: int, width: int, stride: int) -> tuple[int, int]:
    """Return the rows and columns of the grid of nodes, whose last ones lie at or past the image's edge."""
    return -(-(height - 1) // stride) + 1, -(-(width - 1) // stride) + 1


def background_grid(
    transmittance: Tensor, viewport: Viewport, field: BackgroundField, *, threshold: float, stride: int
) -> Tensor:
    """Compute `hyrfpack.ops.background.background_grid`."""
    height, width = transmittance.shape
    rows, columns = grid_size(height, width, stride)
    # A node is needed if light passes at any pixel that is nearer to it than its neighbouring nodes are.
    reach = stride - 1
    padded = torch.nn.functional.pad(
        transmittance.detach()[None], (reach, columns * stride - width, reach, rows * stride - height)
    )
    light = torch.nn.functional.max_pool2d(padded, kernel_size=2 * stride - 1, stride=stride)[0]
    nodes = torch.nonzero(light.reshape(-1) > threshold).squeeze(-1)
    colors = transmittance.new_zeros(rows * columns, 3)
    if len(nodes):
        columns_and_rows = torch.stack((nodes % columns, torch.div(nodes, columns, rounding_mode="floor")), dim=-1)
        points = columns_and_rows.to(transmittance.dtype) * stride + 0.5
        colors = colors.index_put((nodes,), background_colors(points, viewport, field))
    return colors.T.reshape(3, rows, columns).permute(1, 2, 0)

"""The background sphere: where a ray leaves the scene."""

from __future__ import annotations

import torch
from torch import Tensor

RADIUS = 100.0  # local units, around the frame's centre


def sphere_points(origin: Tensor, directions: Tensor) -> Tensor:
    """Where rays leave the background sphere.

        p = o + t d,  t = -(o.d) + sqrt(max((o.d)^2 - |o|^2 + R^2, 0))

    A ray from outside that misses the sphere gives its point nearest to the centre, so every ray has a finite
    answer.

    Args:
        origin: (3,) the camera, local units.
        directions: (N, 3) unit vectors.

    Returns:
        (N, 3) local units.
    """
    along = directions @ origin
    inside = (along * along - origin @ origin + RADIUS**2).clamp_min(0)
    return origin + (inside.sqrt() - along)[:, None] * directions


def pixel_directions(pixels: Tensor, width: int, intrinsics: tuple[float, float, float, float], pose: Tensor) -> Tensor:
    """Unit viewing directions through pixel centres.

    Args:
        pixels: (N,) flat indices, row * width + column.
        width: picture width.
        intrinsics: (fx, fy, cx, cy) in pixels.
        pose: (4, 4) camera_from_local.

    Returns:
        (N, 3) unit vectors in local axes.
    """
    fx, fy, cx, cy = intrinsics
    x = ((pixels % width).to(pose.dtype) + (0.5 - cx)) / fx
    y = (torch.div(pixels, width, rounding_mode="floor").to(pose.dtype) + (0.5 - cy)) / fy
    directions = torch.stack((x, y, torch.ones_like(x)), dim=-1) @ pose[:3, :3]
    return directions / torch.linalg.vector_norm(directions, dim=-1, keepdim=True)

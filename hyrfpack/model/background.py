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

"""The background sphere: where a ray leaves the scene."""

from __future__ import annotations

import torch
from torch import Tensor

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

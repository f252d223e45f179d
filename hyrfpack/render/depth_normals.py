"""Estimates normals from a depth map."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from hyrfpack.scene import Camera

# The window is a square of 15 x 15 samples, about 1/16 of the picture wide: median depths jump between Gaussians, whose
# size grows with the picture. Of 11, 15 and 19 samples, 15 had the lowest error on the built-in scene.
WINDOW_RADIUS = 7
SAMPLED_SIDE_PIXELS = 240
# Pixels belong to other surfaces if their inverse depth differs by more than this share, and by more than that of a
# plane with this slope against the picture.
MAX_INVERSE_DEPTH_CHANGE = 0.03
MAX_SLOPE = 2.0
MAX_BAND_PIXELS = 1 << 18  # bounds memory
_REGULARIZATION = 1e-6  # for windows with one pixel or one row


@torch.no_grad()
def normals_from_depth(depth: Tensor, camera: Camera) -> Tensor:
    """Estimate unit normals (H, W, 3), in camera axes, from a depth map.

    The inverse depth of a plane is affine in the pixel's position,

        1/z = a (u - u_0) + b (v - v_0) + c,  with the normal (a fx, b fy, c - a (u_0 - cx) - b (v_0 - cy)),

    so that a plane is fitted to each pixel's window by least squares, without a bias. Pixels at about the same depth as
    the middle one count alike, others do not count.

    Args:
        depth: (H, W) float64 depth along the view axis, 0 where there is no surface.
        camera: the camera.

    Returns:
        (H, W, 3) float64, of length 1 and facing the camera; (0, 0, 0) where there is no depth.
    """
    inverse = torch.where(depth > 0, 1 / depth.clamp_min(torch.finfo(depth.dtype).tiny), 0)
    inverse = inverse / inverse.max().clamp_min(torch.finfo(depth.dtype).tiny)  # the normal has no scale
    height, width = depth.shape
    step = max(1, max(height, width) // SAMPLED_SIDE_PIXELS)
    margin = WINDOW_RADIUS * step
    padded = torch.nn.functional.pad(inverse, (margin,) * 4)
    band = max(1, MAX_BAND_PIXELS // width)
    parts = [_fit_planes(padded, row, min(row + band, height), step, camera) for row in range(0, height, band)]
    normals = torch.nn.functional.normalize(torch.cat(parts), dim=-1)
    return torch.where(depth[..., None] > 0, normals, 0)


def _fit_planes(padded: Tensor, first: int, last: int, step: int, camera: Camera) -> Tensor:
    """Return vectors (last - first, W, 3) along the normals of rows, given inverse depth with a margin.

    They face the camera, because 1/z > 0 on a plane means that its vector in `normals_from_depth` points away from it.
    """
    margin, height = WINDOW_RADIUS * step, last - first
    width = padded.shape[1] - 2 * margin
    inverse = padded[margin + first : margin + last, margin : margin + width]
    moments, sums = inverse.new_zeros(6, height, width), inverse.new_zeros(3, height, width)
    offsets = range(-WINDOW_RADIUS, WINDOW_RADIUS + 1)
    for y in offsets:
        top = margin + first + y * step
        for x in offsets:
            left = margin + x * step
            other = padded[top : top + height, left : left + width]
            change = other - inverse
            slope_limit = MAX_SLOPE * step * math.hypot(x / camera.fx, y / camera.fy)
            # A sample without depth or outside the picture is no surface at infinity, however large the slope limit is.
            counts = (other > 0) & (change.abs() < (MAX_INVERSE_DEPTH_CHANGE + slope_limit) * inverse)
            change = torch.where(counts, change, 0)
            for index, factor in enumerate((x * x, x * y, y * y, x, y, 1)):
                if factor:
                    moments[index].add_(counts, alpha=factor)
            for index, factor in enumerate((x, y, 1)):
                if factor:
                    sums[index].add_(change, alpha=factor)
    xx, xy, yy, x1, y1, count = moments
    matrix = torch.stack([xx, xy, x1, xy, yy, y1, x1, y1, count], dim=-1).view(height, width, 3, 3)
    matrix = matrix + _REGULARIZATION * torch.eye(3, dtype=matrix.dtype)
    a, b, c = torch.linalg.solve(matrix, sums.movedim(0, -1)).unbind(-1)
    a, b, c = a / step, b / step, c + inverse
    u = torch.arange(width, dtype=a.dtype) + 0.5 - camera.cx
    v = (torch.arange(first, last, dtype=a.dtype) + 0.5 - camera.cy)[:, None]
    return -torch.stack([a * camera.fx, b * camera.fy, c - a * u - b * v], dim=-1)


def unit_rays(camera: Camera) -> Tensor:
    """Return the directions (H, W, 3) float64 of the pixels' rays, in camera axes."""
    u = (torch.arange(camera.width, dtype=torch.float64) + 0.5 - camera.cx) / camera.fx
    v = (torch.arange(camera.height, dtype=torch.float64) + 0.5 - camera.cy)[:, None] / camera.fy
    rays = torch.stack(torch.broadcast_tensors(u, v, torch.ones((), dtype=torch.float64)), dim=-1)
    return torch.nn.functional.normalize(rays, dim=-1)

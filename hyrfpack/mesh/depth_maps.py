"""Depth maps: the surfaces that a model shows to its cameras, with the pixels that can be trusted."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import median_filter, minimum_filter

from hyrfpack.cameras.view_sampling import shrink_camera
from hyrfpack.model import HybridModel
from hyrfpack.model.merged import MergedModel
from hyrfpack.render import RenderSettings, render_view
from hyrfpack.render.surface import render_median_depth
from hyrfpack.scene import Camera

MAX_MAP_SIDE_PIXELS = 800  # bounds memory: a map takes 8 bytes a pixel
# Pixels are rejected where the surface is seen at a smaller cosine, or where depth bends by more than this number of
# pixel sizes: there lies an edge, at which a depth belongs to the surface in front or to the one behind.
MIN_COSINE = 0.15
MAX_BEND_PIXELS = 3.0
# A median depth jumps where neighbouring pixels cross 1/2 at different Gaussians. A median over this square of pixels
# removes such jumps and keeps edges.
MEDIAN_FILTER_PIXELS = 5
# Space is empty along rays through pixels that Gaussians cover less than this, at least EMPTY_MARGIN_PIXELS from other
# pixels. Nearer to a silhouette such rays would shrink round objects, whose true distance they pass is small.
MAX_EMPTY_COVERAGE = 0.1
EMPTY_MARGIN_PIXELS = 8


@dataclass(frozen=True)
class DepthMap:
    """The surface that a camera sees.

    Attributes:
        camera: the camera, of the maps' size.
        depth: (H, W) float32 depth along the view axis in world units; infinite where space is empty.
        weight: (H, W) uint8 confidence, 255 for an opaque surface seen face on; 0 for pixels that are rejected.
        colors: (H, W, 3) uint8 sRGB.
    """

    camera: Camera
    depth: np.ndarray
    weight: np.ndarray
    colors: np.ndarray

    def surface_points(self, stride: int = 1) -> np.ndarray:
        """Return the world points (n, 3) float64 of every stride-th pixel in both directions that shows a surface."""
        rows, columns = np.nonzero(((self.weight > 0) & np.isfinite(self.depth))[::stride, ::stride])
        rows, columns = stride * rows, stride * columns
        z = self.depth[rows, columns].astype(np.float64)
        return self.camera.unproject(columns + 0.5, rows + 0.5, z)


@torch.no_grad()
def render_depth_maps(
    model: HybridModel | MergedModel,
    cameras: Sequence[Camera],
    exposure: str,
) -> Iterator[DepthMap]:
    """Render a model's depth maps one after the other.

    Args:
        model: a model on the CPU.
        cameras: cameras in world units; larger pictures are shrunk to MAX_MAP_SIDE_PIXELS.
        exposure: exposure of the colours, as in `RenderSettings`.
    """
    decoded, settings = model.decode(), RenderSettings(exposure=exposure)
    black = torch.zeros(3)
    for camera in cameras:
        small = shrink_camera(camera, MAX_MAP_SIDE_PIXELS)
        rendered = render_view(model, small, settings, decoded=decoded, solid=black, background=False)
        depth = render_median_depth(model, small, decoded, rendered.indices[rendered.visible], settings).numpy()
        alpha = rendered.alpha.numpy()
        colors = rendered.rgb.numpy() / np.maximum(alpha, 0.5)[..., None]
        yield make_depth_map(small, depth, alpha, np.round(255 * colors.clip(0, 1)).astype(np.uint8))


def make_depth_map(camera: Camera, depth: np.ndarray, alpha: np.ndarray, colors: np.ndarray) -> DepthMap:
    """Weigh the pixels of a view by opacity and by the angle at which they see the surface.

    Args:
        camera: the camera.
        depth: (H, W) median depth, 0 where there is none.
        alpha: (H, W) coverage by Gaussians.
        colors: (H, W, 3) uint8 sRGB.
    """
    is_whole = minimum_filter(depth > 0, MEDIAN_FILTER_PIXELS, mode="nearest")
    depth = np.where(is_whole, median_filter(depth, MEDIAN_FILTER_PIXELS, mode="nearest"), depth)
    cosine = _compute_surface_cosines(camera, depth)
    trusted = (depth > 0) & (cosine >= MIN_COSINE)
    weight = np.round(255 * np.where(trusted, alpha * cosine, 0).clip(0, 1)).astype(np.uint8)
    side = 2 * EMPTY_MARGIN_PIXELS + 1
    is_empty = minimum_filter(alpha <= MAX_EMPTY_COVERAGE, side, mode="nearest")
    return DepthMap(
        camera,
        np.where(is_empty, np.inf, depth).astype(np.float32),
        np.where(is_empty, np.uint8(255), weight),
        colors,
    )


def _compute_surface_cosines(camera: Camera, depth: np.ndarray) -> np.ndarray:
    """Return the cosine (H, W) between the rays and the surface's normals; 0 at edges and at the picture's border."""
    height, width = depth.shape
    cosine = np.zeros((height, width))
    if min(height, width) < 3:
        return cosine
    x = (np.arange(width) + 0.5 - camera.cx) / camera.fx
    y = ((np.arange(height) + 0.5 - camera.cy) / camera.fy)[:, None]
    rays = np.stack(np.broadcast_arrays(x, y, 1.0), axis=-1)
    points = rays * depth[..., None].astype(np.float64)
    middle = points[1:-1, 1:-1]
    normal = np.cross(points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1])
    lengths = np.linalg.norm(normal, axis=-1) * np.linalg.norm(middle, axis=-1)
    inner = np.abs((normal * middle).sum(axis=-1)) / np.maximum(lengths, 1e-300)
    z = depth.astype(np.float64)
    limit = MAX_BEND_PIXELS * z[1:-1, 1:-1]
    bends = (
        np.abs(z[1:-1, 2:] + z[1:-1, :-2] - 2 * z[1:-1, 1:-1]) * camera.fx > limit,
        np.abs(z[2:, 1:-1] + z[:-2, 1:-1] - 2 * z[1:-1, 1:-1]) * camera.fy > limit,
    )
    cosine[1:-1, 1:-1] = np.where(bends[0] | bends[1], 0, inner)
    return cosine

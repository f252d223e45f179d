"""Export of the background sphere, as distant splats or as a picture, for programs that draw Gaussians only.

Only a learnt background is exported. A solid background colour is the colour with which another program clears its
picture, and is left to its user.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from hyrfpack.cameras.view_sampling import shrink_camera
from hyrfpack.export.bake import TRANSMITTANCE_STRIDE_PIXELS, CameraVisibility, check_finite, compute_visibility
from hyrfpack.export.exposure import average_log_gains, predict_camera_log_gains
from hyrfpack.model import BACKGROUND_RADIUS, Frame, HybridModel
from hyrfpack.model.exposure import apply_exposure_gains
from hyrfpack.ops.background import pixel_directions, sphere_points
from hyrfpack.ops.poses import camera_center
from hyrfpack.ops.rasterize.reference import ALPHA_MAX
from hyrfpack.ops.shade import encode_directions
from hyrfpack.ops.viewport import Viewport
from hyrfpack.parallel.pool import torch_on_one_thread
from hyrfpack.render import RenderSettings
from hyrfpack.scene import Camera
from hyrfpack.splats.harmonics import SH_C0
from hyrfpack.splats.splats import Splats

# The sphere is divided into the six faces of a cube, and each face at level l into 2^l cells along each side.
MIN_CELL_LEVEL = 3
MAX_CELL_LEVEL = 9
# Where cameras see light, a cell's side is at most this share of the angle from a picture's middle to its nearest edge.
MAX_LIT_CELL_VIEW_RATIO = 0.4
# Weight of each direction of an even grid, which matters only where no camera sees light. A pixel that no Gaussian
# covers has weight 1.
UNSEEN_COLOR_WEIGHT = 1e-6

MIN_SPLAT_BUDGET = 1000
SPLAT_BUDGET_PER_GAUSSIAN = 0.1
MIN_DIVIDED_COLOR_STD = 1 / 512  # half a step of 8-bit colours
SPLAT_SCALE_PER_CELL_SIDE = 0.7
# Ratio of each level's radius to that of the next finer level, so that finer splats are drawn over coarser ones.
RADIUS_RATIO_PER_LEVEL = 1.1

GAIN_SMOOTHING_RADIANS = math.pi / 2 / 2**MIN_CELL_LEVEL  # the side of a coarse cell

MAX_PICTURE_ROWS = 1024
# Directions are evaluated in batches to limit the memory.
COLOR_BATCH_DIRECTIONS = 1 << 18
GAIN_BATCH_DIRECTIONS = 1 << 14


@torch_on_one_thread()
@torch.no_grad()
def make_background_splats(
    model: HybridModel,
    cameras: Sequence[Camera],
    largest_scale: float = math.inf,
    visibility: Sequence[CameraVisibility] | None = None,
) -> Splats:
    """Represent the background as round splats of one colour each (degree 0) around the scene, world units.

    The splats tile a sphere of `BACKGROUND_RADIUS` about the frame's centre; coarse ones lie somewhat farther away.
    They overlap, so that they let 1 % of the light pass, and 10 % in some corners.

    All cells are coarse at first. Where cameras see light through the scene, cells are divided into four, in the order
    of their error in the pictures: the sum of squared differences of their colours from the mean, weighted by the
    squared transmittance. The division ends at SPLAT_BUDGET_PER_GAUSSIAN times the model's Gaussians, but not below
    MIN_SPLAT_BUDGET. A model's exposure map is applied as described at `BackgroundGains`.

    Args:
        model: a model on the CPU.
        cameras: cameras from which the model was photographed, world units. Without any, cells are divided where
            colours differ.
        largest_scale: largest allowed scale of a splat, world units. The sphere is shrunk until all splats comply.
        visibility: result of `compute_visibility` for the cameras, if it is known already.

    Returns:
        Splats to be drawn together with the model's; none if the model has no learnt background.

    Raises:
        HyrfError: a number of the background, or of the Gaussians before it, is NaN, infinite or beyond float32.
    """
    if not model.config.background:
        none = np.zeros((0, 3))
        return Splats(none, none, np.zeros((0, 4)), np.zeros(0), none[:, None], model.config.antialiased)
    visibility = compute_visibility(model, cameras) if visibility is None else visibility
    sums, largest = _accumulate_colors(model, cameras, visibility)
    directions, sides, levels, colors = _divide_sphere(
        sums, largest, max(MIN_SPLAT_BUDGET, int(SPLAT_BUDGET_PER_GAUSSIAN * len(model)))
    )
    gains = BackgroundGains.predict(model, cameras, visibility)
    if gains is not None:
        direction_tensor = torch.from_numpy(directions).float()
        colors = apply_exposure_gains(torch.from_numpy(colors), gains.evaluate(direction_tensor).double()).numpy()
    radii = BACKGROUND_RADIUS * RADIUS_RATIO_PER_LEVEL ** (levels.max() - levels)
    count, frame = len(colors), model.config.frame
    shrink = min(1.0, largest_scale / (SPLAT_SCALE_PER_CELL_SIDE * sides * radii * frame.scale).max())
    radii = shrink * radii
    scales = SPLAT_SCALE_PER_CELL_SIDE * sides * radii * frame.scale
    return Splats(
        frame.to_world(directions * radii[:, None]),
        np.repeat(scales[:, None], 3, axis=1),  # round, so that a splat looks like a circle from everywhere
        np.tile((1.0, 0.0, 0.0, 0.0), (count, 1)),
        np.full(count, ALPHA_MAX),
        ((colors - 0.5) / SH_C0)[:, None],
        model.config.antialiased,
    )


def compute_background_reach(frame: Frame) -> float:
    """Return the largest absolute coordinate that background splats can have, world units."""
    farthest = BACKGROUND_RADIUS * RADIUS_RATIO_PER_LEVEL ** (MAX_CELL_LEVEL - MIN_CELL_LEVEL)
    return float(np.abs(frame.center).max()) + farthest * frame.scale


@torch_on_one_thread()
@torch.no_grad()
def render_background_picture(
    model: HybridModel,
    height: int | None = None,
    cameras: Sequence[Camera] = (),
    visibility: Sequence[CameraVisibility] | None = None,
) -> np.ndarray:
    """Render the background as an equirectangular picture seen from the frame's centre.

    The pixel in row v and column u of H x W, W = 2 H, looks along the world direction

        d = (cos b sin a, -sin b, cos b cos a),   a = 2 pi (u + 0.5) / W - pi,   b = pi / 2 - pi (v + 0.5) / H

    With y down, as in most reconstructions, the top row is up and the picture's middle looks along +z.

    Args:
        model: a model with a learnt background.
        height: number of rows H. By default a pixel of the middle row is as wide as a cell of the finest hash grid,
            with at most MAX_PICTURE_ROWS rows.
        cameras: cameras from which the model was photographed, world units. An exposure map is applied as described at
            `BackgroundGains`.
        visibility: result of `compute_visibility` for the cameras, if it is known already.

    Returns:
        (H, 2H, 3) float32 in [0, 1], display-referred sRGB.

    Raises:
        ValueError: the model has no learnt background, or `height` is less than 1.
        HyrfError: a colour is NaN.
    """
    # The sphere is nearly as large as the grid's cube, so its half circle is pi / 2 times as long as the cube's side.
    if height is None:
        height = min(MAX_PICTURE_ROWS, math.ceil(math.pi / 2 * model.config.radiance.finest))
    if not model.config.background or height < 1:
        raise ValueError(
            f"no picture of {height} rows can be made of a model with background={model.config.background}"
        )
    across, down = (torch.arange(count, dtype=torch.float64) + 0.5 for count in (2 * height, height))
    longitudes, latitudes = torch.pi * across / height - torch.pi, torch.pi / 2 - torch.pi * down / height
    latitudes, longitudes = torch.meshgrid(latitudes, longitudes, indexing="ij")
    level = latitudes.cos()
    directions = torch.stack((level * longitudes.sin(), -latitudes.sin(), level * longitudes.cos()), -1)
    flat_directions = (directions.reshape(-1, 3) @ torch.from_numpy(model.config.frame.axes)).float()  # local axes
    colors = _evaluate_sphere_colors(model, flat_directions)
    gains = BackgroundGains.predict(model, cameras, visibility)
    if gains is not None:
        colors = torch.cat(
            [
                apply_exposure_gains(batch_colors, gains.evaluate(batch_directions))
                for batch_colors, batch_directions in zip(
                    colors.split(GAIN_BATCH_DIRECTIONS), flat_directions.split(GAIN_BATCH_DIRECTIONS), strict=True
                )
            ]
        )
    return colors.reshape(height, 2 * height, 3).numpy()


@dataclass(frozen=True)
class BackgroundGains:
    """Gains of the background as a smooth function of the direction, from the cameras that see it there.

    The log gain along a direction d is a weighted mean over the cells of the sphere that cameras see. The weight of a
    cell is the light that cameras see of it, times exp(-|d - c|^2 / (2 s^2)), with c the cell's centre and
    s = GAIN_SMOOTHING_RADIANS. Directions that no camera sees thus get the gains of the nearest cells, without a step.

    Attributes:
        directions: (n, 3) float32 unit vectors to the centres of the cells that cameras see, in local axes.
        log_light: (n,) float32 logarithm of the light that cameras see of each cell.
        log_gains: (n, 3) float32 mean log gains of the cells.
    """

    directions: Tensor
    log_light: Tensor
    log_gains: Tensor

    @classmethod
    def predict(
        cls, model: HybridModel, cameras: Sequence[Camera], visibility: Sequence[CameraVisibility] | None = None
    ) -> BackgroundGains | None:
        """Predict the gains of a model's background by its exposure map; None for a model without one.

        Args:
            model: a model on the CPU.
            cameras: cameras from which the model was photographed, world units. Without any, or if none sees light of
                the sphere, the gains are the same in all directions; see `average_log_gains`.
            visibility: result of `compute_visibility` for the cameras, if it is known already.
        """
        if model.exposure is None:
            return None
        logs = predict_camera_log_gains(model, model.exposure, cameras)
        centers = compute_cell_centers(np.arange(6 * 4**MIN_CELL_LEVEL), MIN_CELL_LEVEL)[0]
        light, sums = np.zeros(len(centers)), np.zeros((len(centers), 3))
        visibility = compute_visibility(model, cameras) if visibility is None else visibility
        for log, pixels in zip(logs, _iterate_seen_pixels(model, cameras, visibility), strict=True):
            cells = find_cells(pixels.surface_points.double().numpy(), MIN_CELL_LEVEL)
            received = np.bincount(cells, pixels.weights, len(centers))
            light += received
            sums += received[:, None] * log
        if not light.any():
            light, sums = np.ones(len(centers)), np.tile(average_log_gains(model.exposure, logs), (len(centers), 1))
        is_seen = light > 0
        centers, light, means = centers[is_seen], light[is_seen], sums[is_seen] / light[is_seen, None]
        return cls(*(torch.from_numpy(array).float() for array in (centers, np.log(light), means)))

    def evaluate(self, directions: Tensor) -> Tensor:
        """Evaluate the gains (N, 3) along unit vectors (N, 3) from the sphere's centre, in local axes."""
        cosines = directions @ self.directions.T  # |d - c|^2 = 2 - 2 cos
        weights = (cosines / GAIN_SMOOTHING_RADIANS**2 + self.log_light).softmax(1)
        return (weights @ self.log_gains).exp()


def _evaluate_sphere_colors(model: HybridModel, directions: Tensor) -> Tensor:
    """Evaluate the colours (N, 3) of the sphere along unit vectors (N, 3) from its centre, in local axes."""
    encoding = model.config.direction_encoding
    colors = torch.cat(
        [
            model.radiance(model.cube_coords(BACKGROUND_RADIUS * batch), encode_directions(batch, encoding)).sigmoid()
            for batch in directions.split(COLOR_BATCH_DIRECTIONS)
        ]
    )
    check_finite("background", colors)
    return colors


class _SeenPixels(NamedTuple):
    """The pixels at which a camera sees light of the sphere.

    Attributes:
        viewport: the camera of `shrink_camera`, in local units.
        pixel_points: (n, 2) pixel coordinates in its picture.
        surface_points: (n, 3) points of the sphere that these pixels show, local units.
        weights: (n,) float64 squared transmittances.
    """

    viewport: Viewport
    pixel_points: Tensor
    surface_points: Tensor
    weights: np.ndarray


def _iterate_seen_pixels(
    model: HybridModel, cameras: Sequence[Camera], visibility: Sequence[CameraVisibility]
) -> Iterator[_SeenPixels]:
    """Yield the pixels at which each camera sees the sphere, from every TRANSMITTANCE_STRIDE_PIXELS-th of both axes."""
    threshold = RenderSettings().background_threshold
    for camera, camera_visibility in zip(map(shrink_camera, cameras), visibility, strict=True):
        check_finite("Gaussians", camera_visibility.transmittance)
        rows, columns = torch.nonzero(camera_visibility.transmittance > threshold).unbind(1)
        viewport = model.config.frame.local_viewport(camera)
        pixel_points = torch.stack((columns, rows), -1) * TRANSMITTANCE_STRIDE_PIXELS + 0.5
        surface_points = sphere_points(camera_center(viewport.pose), pixel_directions(pixel_points, viewport))
        yield _SeenPixels(
            viewport,
            pixel_points,
            surface_points,
            camera_visibility.transmittance[rows, columns].double().square().numpy(),
        )


def _accumulate_colors(
    model: HybridModel, cameras: Sequence[Camera], visibility: Sequence[CameraVisibility]
) -> tuple[np.ndarray, float]:
    """Accumulate the colours that cameras see of the sphere, in its finest cells.

    Returns:
        sums: (6 * 4^MAX_CELL_LEVEL, 5) sums of w, w red, w green, w blue and w |color|^2 for each cell. They run over
            pixels, with w = T^2 the squared transmittance, and over an even grid of directions, with
            w = UNSEEN_COLOR_WEIGHT.
        largest: largest acceptable side, in radians, of a cell whose light is seen.
    """
    sums = np.zeros((6 * 4**MAX_CELL_LEVEL, 5))

    def add(points: Tensor, colors: Tensor, weights: np.ndarray) -> None:
        values = colors.double().numpy()
        # Few of the cells are in one picture, so sums over all of them would take longer than the picture.
        cells, rows = np.unique(find_cells(points.double().numpy(), MAX_CELL_LEVEL), return_inverse=True)
        columns = np.column_stack((np.ones(len(values)), values, (values**2).sum(1)))
        sums[cells] += np.column_stack([np.bincount(rows, weights * column, len(cells)) for column in columns.T])

    even_level = MIN_CELL_LEVEL + 2
    even_directions = torch.from_numpy(compute_cell_centers(np.arange(6 * 4**even_level), even_level)[0]).float()
    even_colors = _evaluate_sphere_colors(model, even_directions)
    add(even_directions, even_colors, np.full(len(even_directions), UNSEEN_COLOR_WEIGHT))
    largest = math.inf
    for camera, seen in zip(map(shrink_camera, cameras), _iterate_seen_pixels(model, cameras, visibility), strict=True):
        if len(seen.pixel_points):
            colors = model.decode_background(seen.pixel_points, seen.viewport)
            check_finite("background", colors)
            add(seen.surface_points, colors, seen.weights)
            narrow = math.atan(min(camera.width / camera.fx, camera.height / camera.fy) / 2)
            largest = min(largest, MAX_LIT_CELL_VIEW_RATIO * narrow)
    return sums, largest


def _divide_sphere(
    sums: np.ndarray, largest: float, budget: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Divide the sphere into at most `budget` cells.

    Args:
        sums: sums of colours in the finest cells, see `_accumulate_colors`.
        largest: cells with larger sides, in radians, are divided first where light is seen.
        budget: maximum number of cells.

    Returns:
        Directions (n, 3), sides (n,) in radians, levels (n,) and colours (n, 3) of the cells.
    """
    pyramid = [sums]
    for _ in range(MAX_CELL_LEVEL - MIN_CELL_LEVEL):
        pyramid.insert(0, pyramid[0].reshape(-1, 4, 5).sum(1))
    errors = []
    for level, cells in enumerate(pyramid[:-1], MIN_CELL_LEVEL):
        weights, colors, squares = cells[:, 0], cells[:, 1:4], cells[:, 4]
        spread = np.maximum(squares - (colors**2).sum(1) / np.maximum(weights, UNSEEN_COLOR_WEIGHT), 0)
        is_too_large = (weights > 1) & (math.pi / 2 / 2**level > largest)
        errors.append(np.where(is_too_large, np.inf, np.where(spread > MIN_DIVIDED_COLOR_STD**2 * weights, spread, 0)))
    # A cell's error is at least the sum of its parts' errors, so sorting by error puts parents before their parts.
    all_errors = np.concatenate(errors)
    order = np.argsort(-all_errors, kind="stable")
    order = order[all_errors[order] > 0][: (budget - len(pyramid[0])) // 3]
    is_divided = np.zeros(len(all_errors), bool)
    is_divided[order] = True
    divided = [*np.split(is_divided, np.cumsum([len(level) for level in errors])[:-1]), np.zeros(len(sums), bool)]

    cells_by_level = []
    index, parent_colors = np.arange(len(pyramid[0])), np.full((len(pyramid[0]), 3), 0.5)
    for level, (cells, is_parent) in enumerate(zip(pyramid, divided, strict=True), MIN_CELL_LEVEL):
        weights = cells[index, :1]
        colors = np.where(weights > 0, cells[index, 1:4] / np.where(weights > 0, weights, 1), parent_colors)
        is_leaf, is_split = ~is_parent[index], is_parent[index]
        cells_by_level.append(
            (*compute_cell_centers(index[is_leaf], level), np.full(is_leaf.sum(), level), colors[is_leaf])
        )
        index, parent_colors = (4 * index[is_split][:, None] + np.arange(4)).ravel(), colors[is_split].repeat(4, axis=0)
    directions, sides, levels, colors = (np.concatenate(columns) for columns in zip(*cells_by_level, strict=True))
    return directions, sides, levels, colors


def find_cells(points: np.ndarray, level: int) -> np.ndarray:
    """Find the cells (N,) that contain the directions from the origin to points (N, 3).

    The number of a cell is face 4^level + the interleaved bits of i and j, with the bit of i before that of j. The face
    is 2 axis, plus 1 on the negative side; i and j count steps of equal angles along the next two axes. A cell's number
    divided by 4, rounded down, is therefore the number of its parent.
    """
    rows = np.arange(len(points))
    axis = np.abs(points).argmax(1)
    main = points[rows, axis]
    cells = 2 * axis + (main < 0)
    angles = [np.arctan2(points[rows, (axis + turn) % 3], np.abs(main)) for turn in (1, 2)]
    i, j = (np.clip((2 * angle / np.pi + 0.5) * 2**level, 0, 2**level - 1).astype(np.int64) for angle in angles)
    for bit in reversed(range(level)):
        cells = 4 * cells + 2 * (i >> bit & 1) + (j >> bit & 1)
    return cells


def compute_cell_centers(cells: np.ndarray, level: int) -> tuple[np.ndarray, np.ndarray]:
    """Return unit vectors (N, 3) to the centres of cells (N,) of a level >= 1, and sides (N,) of the cells.

    The side of a cell is the square root of its solid angle, in radians.
    """
    rows, face = np.arange(len(cells)), cells >> 2 * level
    i, j = (sum((cells >> 2 * bit + odd & 1) << bit for bit in range(level)) for odd in (1, 0))
    x, y = (np.tan(np.pi / 2 * ((step + 0.5) / 2**level - 0.5)) for step in (i, j))
    directions = np.empty((len(cells), 3))
    for turn, values in enumerate((1 - 2 * (face & 1), x, y)):
        directions[rows, (face // 2 + turn) % 3] = values
    lengths = np.sqrt(1 + x**2 + y**2)
    sides = np.sqrt((1 + x**2) * (1 + y**2) / lengths**3) * np.pi / 2 / 2**level
    return directions / lengths[:, None], sides

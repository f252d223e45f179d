"""The background sphere for programs that draw Gaussians only: as distant splats, or as a picture.

Only a learnt background is put into them. What a model with a solid colour has behind it is the colour that another
program clears its picture with: a choice of whoever looks at it.
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
from hyrfpack.export.bake import STRIDE, Sight, refuse_nonfinite, sights_of
from hyrfpack.export.exposure import camera_log_gains, typical_log_gains
from hyrfpack.model import BACKGROUND_RADIUS, Frame, HybridModel
from hyrfpack.model.exposure import apply_exposure_gains
from hyrfpack.ops.background import pixel_directions, sphere_points
from hyrfpack.ops.poses import camera_center
from hyrfpack.ops.shade import encode_directions
from hyrfpack.parallel.pool import torch_on_one_thread
from hyrfpack.render import RenderSettings
from hyrfpack.scene import Camera
from hyrfpack.splats.harmonics import SH_C0
from hyrfpack.splats.splats import Splats

# The sphere is a cube's six faces, each halved in both directions again and again: 2^level cells along a side.
COARSEST, FINEST = 3, 9
LARGEST_CELL = 0.4  # where light was seen: of the angle from a picture's middle to its nearest edge
UNSEEN = 1e-6  # weight of each of the colours where no camera saw light, against 1 for a pixel

LEAST_SPLATS, MOST_SHARE = 1000, 0.1  # the share is of the model's Gaussians
EVEN = 1 / 512  # cells whose colours differ less from their mean, root mean square, are not divided
OPACITY = 0.99  # what drawing limits it to anyway
SPREAD = 0.7  # standard deviation, in sides of a cell
RECEDE = 1.1  # coarser splats lie further away by this for each level, so that finer ones are drawn over them

GAIN_SMOOTHING_RADIANS = math.pi / 2 / 2**COARSEST  # standard deviation; a coarse cell's side

MOST_ROWS = 1024
POINTS_AT_ONCE, GAINS_AT_ONCE = 1 << 18, 1 << 14


@torch_on_one_thread()
@torch.no_grad()
def background_splats(
    model: HybridModel,
    cameras: Sequence[Camera],
    largest_scale: float = math.inf,
    sights: Sequence[Sight] | None = None,
) -> Splats:
    """The background as round splats of one colour each (degree 0) around the scene, world units.

    They tile a sphere of `BACKGROUND_RADIUS` about the frame's centre, or somewhat larger where they are coarse, and
    overlap to a layer that lets a hundredth of the light through, a tenth in some corners. All around, cells are
    coarse; where cameras see light come through the scene, cells are divided into four, those first whose colours
    differ most from their mean (squared differences, each weighed by the squared transmittance: what they make in the
    pictures), until there are as many as a tenth of the model's Gaussians, but at least 1,000. A model's exposure map
    is applied as `BackgroundGains` tells.

    Args:
        model: on the CPU.
        cameras: from where it was photographed, world units; without any, cells are divided where colours differ.
        largest_scale: that the splats may have, world units: where they would be larger, the whole sphere is smaller.
        sights: what `sights_of` told of the cameras, where it is known already.

    Returns:
        Splats to be drawn together with the model's; none when the model has no learnt background.

    Raises:
        HyrfError: a number of the background, or of the Gaussians before it, is NaN, infinite or beyond float32.
    """
    if not model.config.background:
        none = np.zeros((0, 3))
        return Splats(none, none, np.zeros((0, 4)), np.zeros(0), none[:, None], model.config.antialiased)
    sights = sights_of(model, cameras) if sights is None else sights
    sums, largest = _seen(model, cameras, sights)
    directions, sides, levels, colors = _tile(sums, largest, max(LEAST_SPLATS, int(MOST_SHARE * len(model))))
    gains = BackgroundGains.of(model, cameras, sights)
    if gains is not None:
        towards = torch.from_numpy(directions).float()
        colors = apply_exposure_gains(torch.from_numpy(colors), gains.along(towards).double()).numpy()
    radii = BACKGROUND_RADIUS * RECEDE ** (levels.max() - levels)
    count, frame = len(colors), model.config.frame
    shrink = min(1.0, largest_scale / (SPREAD * sides * radii * frame.scale).max())
    radii = shrink * radii
    scales = SPREAD * sides * radii * frame.scale
    return Splats(
        frame.to_world(directions * radii[:, None]),
        np.repeat(scales[:, None], 3, axis=1),  # a ball is seen as a circle on the sphere from everywhere
        np.tile((1.0, 0.0, 0.0, 0.0), (count, 1)),
        np.full(count, OPACITY),
        ((colors - 0.5) / SH_C0)[:, None],
        model.config.antialiased,
    )


def background_reach(frame: Frame) -> float:
    """How far from the world's origin, along an axis, splats of the background may lie: world units."""
    farthest = BACKGROUND_RADIUS * RECEDE ** (FINEST - COARSEST)
    return float(np.abs(frame.center).max()) + farthest * frame.scale


@torch_on_one_thread()
@torch.no_grad()
def background_picture(
    model: HybridModel,
    height: int | None = None,
    cameras: Sequence[Camera] = (),
    sights: Sequence[Sight] | None = None,
) -> np.ndarray:
    """The background all around, as seen from the frame's centre: an equirectangular picture.

    The pixel in row v and column u of H x W, W = 2 H, looks along the world direction

        d = (cos b sin a, -sin b, cos b cos a),   a = 2 pi (u + 0.5) / W - pi,   b = pi / 2 - pi (v + 0.5) / H

    With y down, as in most reconstructions, the top row is up and the picture's middle looks along +z.

    Args:
        model: with a learnt background.
        height: rows H. By default a pixel along the middle row is as wide as a cell of the finest hash grid, but there
            are at most 1,024 rows.
        cameras: from where it was photographed, world units: an exposure map is applied as `BackgroundGains` tells.
        sights: what `sights_of` returns for the cameras, where it is known already.

    Returns:
        (H, 2H, 3) float32 in [0, 1], display-referred sRGB.

    Raises:
        ValueError: the model has no learnt background, or no rows are asked for.
        HyrfError: a colour is NaN.
    """
    if height is None:  # the sphere is nearly as large as the grids' cube: pi / 2 cells from pole to pole for each
        height = min(MOST_ROWS, math.ceil(math.pi / 2 * model.config.radiance.finest))
    if not model.config.background or height < 1:
        raise ValueError(
            f"no picture of {height} rows can be made of a model with background={model.config.background}"
        )
    across, down = (torch.arange(count, dtype=torch.float64) + 0.5 for count in (2 * height, height))
    longitudes, latitudes = torch.pi * across / height - torch.pi, torch.pi / 2 - torch.pi * down / height
    latitudes, longitudes = torch.meshgrid(latitudes, longitudes, indexing="ij")
    level = latitudes.cos()
    directions = torch.stack((level * longitudes.sin(), -latitudes.sin(), level * longitudes.cos()), -1)
    towards = directions.reshape(-1, 3).float()
    colors = _sphere_colors(model, towards)
    gains = BackgroundGains.of(model, cameras, sights)
    if gains is not None:
        colors = torch.cat(
            [
                apply_exposure_gains(some, gains.along(there))
                for some, there in zip(colors.split(GAINS_AT_ONCE), towards.split(GAINS_AT_ONCE), strict=True)
            ]
        )
    return colors.reshape(height, 2 * height, 3).numpy()


@dataclass(frozen=True)
class BackgroundGains:
    """Gains of the background by the direction: of the cameras that see it there.

    Log gains are means over cells of the sphere, weighted by the light that cameras see of them and, from direction d
    to the middle c of a cell, by exp(-|d - c|^2 / (2 s^2)), s = GAIN_SMOOTHING_RADIANS. So directions that no camera
    sees have the gains of the nearest that one does, and nowhere there is a step.

    Attributes:
        directions: (n, 3) float32 unit vectors to the middles of the cells that cameras see.
        log_light: (n,) float32 log of the light of each cell.
        log_gains: (n, 3) float32 mean log gains of the cells.
    """

    directions: Tensor
    log_light: Tensor
    log_gains: Tensor

    @classmethod
    def of(
        cls, model: HybridModel, cameras: Sequence[Camera], sights: Sequence[Sight] | None = None
    ) -> BackgroundGains | None:
        """Predict the gains of a model's background by its exposure map; None for a model without one.

        Args:
            model: on the CPU.
            cameras: from where it was photographed, world units. Without any, or where none sees light of the sphere,
                the gains are the same in all directions, see `typical_log_gains`.
            sights: what `sights_of` returns for the cameras, where it is known already.
        """
        if model.exposure is None:
            return None
        logs = camera_log_gains(model, model.exposure, cameras)
        middles = cell_centers(np.arange(6 * 4**COARSEST), COARSEST)[0]
        light, sums = np.zeros(len(middles)), np.zeros((len(middles), 3))
        sights = sights_of(model, cameras) if sights is None else sights
        for log, seen in zip(logs, _seen_pixels(model, cameras, sights), strict=True):
            cells = cells_of(seen.places.double().numpy(), COARSEST)
            received = np.bincount(cells, seen.weights, len(middles))
            light += received
            sums += received[:, None] * log
        if not light.any():
            light, sums = np.ones(len(middles)), np.tile(typical_log_gains(model.exposure, logs), (len(middles), 1))
        lit = light > 0
        middles, light, means = middles[lit], light[lit], sums[lit] / light[lit, None]
        return cls(*(torch.from_numpy(some).float() for some in (middles, np.log(light), means)))

    def along(self, directions: Tensor) -> Tensor:
        """Gains (N, 3) along unit vectors (N, 3) from the sphere's centre."""
        cosines = directions @ self.directions.T  # |d - c|^2 = 2 - 2 cos
        weights = (cosines / GAIN_SMOOTHING_RADIANS**2 + self.log_light).softmax(1)
        return (weights @ self.log_gains).exp()


def _sphere_colors(model: HybridModel, directions: Tensor) -> Tensor:
    """(N, 3) colours of the sphere along unit vectors (N, 3) from its centre."""
    encoding = model.config.direction_encoding
    colors = torch.cat(
        [
            model.radiance(model.cube_coords(BACKGROUND_RADIUS * some), encode_directions(some, encoding)).sigmoid()
            for some in directions.split(POINTS_AT_ONCE)
        ]
    )
    refuse_nonfinite("background", colors)
    return colors


class _SeenPixels(NamedTuple):
    """Where a camera sees light of the sphere.

    Attributes:
        pose: (4, 4) camera_from_local.
        points: (n, 2) pixels of `shrink_camera`.
        places: (n, 3) what they show of the sphere, local units.
        weights: (n,) float64, squared transmittances.
    """

    pose: Tensor
    points: Tensor
    places: Tensor
    weights: np.ndarray


def _seen_pixels(model: HybridModel, cameras: Sequence[Camera], sights: Sequence[Sight]) -> Iterator[_SeenPixels]:
    """Yield what each camera sees of the sphere, at every STRIDE-th pixel of both axes."""
    threshold = RenderSettings().background_threshold
    for camera, sight in zip(map(shrink_camera, cameras), sights, strict=True):
        refuse_nonfinite("Gaussians", sight.passed)
        rows, columns = torch.nonzero(sight.passed > threshold).unbind(1)
        pose = torch.as_tensor(model.config.frame.local_pose(camera), dtype=torch.float32)
        points = torch.stack((columns, rows), -1) * STRIDE + 0.5
        places = sphere_points(camera_center(pose), pixel_directions(points, camera.intrinsics, pose))
        yield _SeenPixels(pose, points, places, sight.passed[rows, columns].double().square().numpy())


def _seen(model: HybridModel, cameras: Sequence[Camera], sights: Sequence[Sight]) -> tuple[np.ndarray, float]:
    """What cameras see of the sphere.

    Returns:
        For each of the finest cells the sums of w, w red, w green, w blue and w |color|^2 over pixels and, with the
        weight UNSEEN, over an even net of directions; w = T^2 is the squared transmittance. And the largest cell's
        side, in radians, that is fine where light is seen.
    """
    sums = np.zeros((6 * 4**FINEST, 5))

    def add(points: Tensor, colors: Tensor, weights: np.ndarray) -> None:
        values, cells = colors.double().numpy(), cells_of(points.double().numpy(), FINEST)
        columns = np.column_stack((np.ones(len(values)), values, (values**2).sum(1)))
        for total, column in zip(sums.T, columns.T, strict=True):
            total += np.bincount(cells, weights * column, len(sums))

    net = torch.from_numpy(cell_centers(np.arange(6 * 4 ** (COARSEST + 2)), COARSEST + 2)[0]).float()
    add(net, _sphere_colors(model, net), np.full(len(net), UNSEEN))
    largest = math.inf
    for camera, seen in zip(map(shrink_camera, cameras), _seen_pixels(model, cameras, sights), strict=True):
        if len(seen.points):
            colors = model.decode_background(seen.points, camera.intrinsics, seen.pose)
            refuse_nonfinite("background", colors)
            add(seen.places, colors, seen.weights)
            narrow = math.atan(min(camera.width / camera.fx, camera.height / camera.fy) / 2)
            largest = min(largest, LARGEST_CELL * narrow)
    return sums, largest


def _tile(sums: np.ndarray, largest: float, budget: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Divide the sphere into at most `budget` cells.

    Args:
        sums: of the finest cells, see `_seen`.
        largest: cells with larger sides, in radians, are divided first where light is seen.

    Returns:
        Directions (n, 3), sides (n,) in radians, levels (n,) and colours (n, 3) of the cells.
    """
    pyramid = [sums]
    for _ in range(FINEST - COARSEST):
        pyramid.insert(0, pyramid[0].reshape(-1, 4, 5).sum(1))
    errors = []
    for level, cells in enumerate(pyramid[:-1], COARSEST):
        weights, colors, squares = cells[:, 0], cells[:, 1:4], cells[:, 4]
        spread = np.maximum(squares - (colors**2).sum(1) / np.maximum(weights, UNSEEN), 0)
        must = (weights > 1) & (math.pi / 2 / 2**level > largest)
        errors.append(np.where(must, np.inf, np.where(spread > EVEN**2 * weights, spread, 0)))
    # A cell's error is at least the sum of its parts', so in the order of errors cells come after those they are in.
    every = np.concatenate(errors)
    order = np.argsort(-every, kind="stable")
    order = order[every[order] > 0][: (budget - len(pyramid[0])) // 3]
    chosen = np.zeros(len(every), bool)
    chosen[order] = True
    divided = [*np.split(chosen, np.cumsum([len(level) for level in errors])[:-1]), np.zeros(len(sums), bool)]

    found = []
    index, above = np.arange(len(pyramid[0])), np.full((len(pyramid[0]), 3), 0.5)
    for level, (cells, parted) in enumerate(zip(pyramid, divided, strict=True), COARSEST):
        weights = cells[index, :1]
        colors = np.where(weights > 0, cells[index, 1:4] / np.where(weights > 0, weights, 1), above)
        kept, parts = ~parted[index], parted[index]
        found.append((*cell_centers(index[kept], level), np.full(kept.sum(), level), colors[kept]))
        index, above = (4 * index[parts][:, None] + np.arange(4)).ravel(), colors[parts].repeat(4, axis=0)
    directions, sides, levels, tones = (np.concatenate(columns) for columns in zip(*found, strict=True))
    return directions, sides, levels, tones


def cells_of(points: np.ndarray, level: int) -> np.ndarray:
    """The cells (N,) in which points (N, 3), seen from the origin, lie.

    Cell = face 4^level + the bits of i and j in turns, i before j, for face 2 axis + (1 where negative) and steps i, j
    of equal angles along the next two axes. So a cell's number over 4 is the next coarser level's.
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


def cell_centers(cells: np.ndarray, level: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors (N, 3) to the middles of cells (N,) of a level >= 1, and the roots (N,) of their solid angles."""
    rows, face = np.arange(len(cells)), cells >> 2 * level
    i, j = (sum((cells >> 2 * bit + odd & 1) << bit for bit in range(level)) for odd in (1, 0))
    x, y = (np.tan(np.pi / 2 * ((step + 0.5) / 2**level - 0.5)) for step in (i, j))
    directions = np.empty((len(cells), 3))
    for turn, values in enumerate((1 - 2 * (face & 1), x, y)):
        directions[rows, (face // 2 + turn) % 3] = values
    lengths = np.sqrt(1 + x**2 + y**2)
    sides = np.sqrt((1 + x**2) * (1 + y**2) / lengths**3) * np.pi / 2 / 2**level
    return directions / lengths[:, None], sides

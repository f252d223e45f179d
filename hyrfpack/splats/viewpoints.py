"""Sampling of cameras for splats that have none: cameras that see much of the scene from unobstructed positions."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hyrfpack.cameras.paths import look_at
from hyrfpack.cameras.view_sampling import shrink_camera
from hyrfpack.errors import HyrfDataError
from hyrfpack.model import Frame
from hyrfpack.parallel.pool import parallel_map
from hyrfpack.scene import Camera
from hyrfpack.splats.draw import Drawable, draw
from hyrfpack.splats.splats import Splats

# Distances in RADII are multiples of `WeightedSplats.radius`, half the diagonal of the box around the scene.
FRAME_QUANTILES = 0.01, 0.99
MAX_AREA_QUANTILE = 0.99
OUTSIDE_DISTANCE_RANGE_RADII = 0.5, 2.2
OUTSIDE_FIELD_OF_VIEW_DEGREES = 50.0
INSIDE_FIELD_OF_VIEW_DEGREES = 75.0
CLEARANCE_RADII = 0.12
ROOM_CLEARANCE_RADII = 0.25
MAX_CLUTTER = 0.1
MIN_COVERAGE = 0.3
MIN_ENCLOSED_COVERAGE = 0.75
INSIDE_REGION_RATIO = 0.55
ENCLOSURE_CANDIDATES = 256
MAX_ENCLOSURE_TESTS = 8
CANDIDATES_PER_CAMERA = 6
MAX_SAMPLED_SPLATS = 30_000
THUMBNAIL_SIDE_PIXELS = 24


@dataclass(frozen=True)
class WeightedSplats:
    """Splats with the weights by which viewpoints are sampled.

    Attributes:
        splats: the splats.
        areas: (N,) float64 opacity times the product of the two larger scales, squared world units, limited to their
            MAX_AREA_QUANTILE.
        detail_weights: (N,) float64 opacity times min(1, m / a), with a the product of the splat's two larger scales
            and m the median of a. Large splats weigh less, because they represent distant things, such as a sky.
        frame: the box between the FRAME_QUANTILES of the detail weights along each axis.
        target_weights: (N,) float64 areas / max(1, d)^4, with d the largest coordinate in units of the box's half-axes.
            Distant splats weigh less, because a sky is large and far away.
    """

    splats: Splats
    areas: np.ndarray
    detail_weights: np.ndarray
    frame: Frame
    target_weights: np.ndarray

    @classmethod
    def from_splats(cls, splats: Splats, name: str) -> WeightedSplats:
        """Compute the weights of splats.

        Args:
            splats: the splats.
            name: the file's name in error messages.

        Raises:
            HyrfDataError: there are no splats, none is visible because each has opacity 0 or no area, or all lie at
                one place.
        """
        check_not_empty(splats, name)
        sides = np.sort(splats.scales.astype(np.float64), axis=1)
        discs = sides[:, 1] * sides[:, 2]
        areas = splats.opacities * discs
        if not (areas > 0).any():
            raise HyrfDataError(
                f"{name}: no Gaussian is visible, because all are transparent or without size",
                fix="give another file",
            )
        is_visible = areas > 0
        typical = np.median(discs[is_visible])
        detail_weights = np.where(is_visible, splats.opacities * (typical / np.maximum(discs, typical)), 0.0)
        areas = np.minimum(areas, np.quantile(areas[is_visible], MAX_AREA_QUANTILE))
        low, high = _compute_quantile_box(
            splats.positions[is_visible], sides[is_visible, 2], detail_weights[is_visible]
        )
        if not (high > low).any():
            raise HyrfDataError(
                f"{name}: all Gaussians lie at one place, and are too small there for float32", fix="give another file"
            )
        frame = Frame.from_box(low, high)
        boxes_away = np.abs(frame.to_local(splats.positions) / frame.half_extent).max(axis=1)
        return cls(splats, areas, detail_weights, frame, areas / np.maximum(boxes_away, 1) ** 4)

    @property
    def radius(self) -> float:
        """Half the diagonal of the frame's box, world units."""
        return float(np.linalg.norm(self.frame.half_extent)) * self.frame.scale

    def estimate_clutter(self, position: np.ndarray, reach: float = CLEARANCE_RADII) -> float:
        """Estimate the share of the sphere around a place (3,) that splats within `reach` radii cover."""
        stride = _choose_stride(len(self.areas))
        squares = ((self.splats.positions[::stride] - position) ** 2).sum(axis=1)
        is_near = squares < (reach * self.radius) ** 2
        areas, squares = self.areas[::stride][is_near], squares[is_near]
        # A disc with standard deviations a and b and opacity o blocks an area of 2 pi a b o of distant light.
        return stride * float((areas / (2 * squares + areas)).sum())


def check_not_empty(splats: Splats, name: str) -> None:
    """Raise HyrfDataError, with the file's name, if there are no splats."""
    if not len(splats):
        raise HyrfDataError(f"{name}: there is no Gaussian in it", fix="name another file")


def _compute_quantile_box(
    positions: np.ndarray, sizes: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of the box between the weighted FRAME_QUANTILES of each axis.

    Each splat counts at both ends of its extent, its position minus and plus its size.
    """
    ends = np.concatenate((positions - sizes[:, None], positions + sizes[:, None]))
    order = np.argsort(ends, axis=0, kind="stable")
    shares = np.cumsum(np.tile(weights, 2)[order], axis=0)
    rows = [[np.searchsorted(column / column[-1], share) for column in shares.T] for share in FRAME_QUANTILES]
    low, high = (np.array([ends[order[row, axis], axis] for axis, row in enumerate(part)]) for part in rows)
    return low, high


def sample_viewpoints(
    weighted: WeightedSplats, drawable: Drawable, count: int, size: int, seed: int, inside: bool | None = None
) -> list[Camera]:
    """Sample cameras around the scene, or inside it where splats surround the clear places, as in a room.

    Cameras outside stand in all directions and at distances spread evenly in their logarithm. They look at splats
    sampled by `target_weights`. Cameras inside look at splats sampled by `detail_weights`, because walls and skies
    would fill most of the pictures otherwise. In both cases, near splats cover at most MAX_CLUTTER of the sphere around
    a camera, and splats cover at least MIN_COVERAGE of its picture. If CANDIDATES_PER_CAMERA times `count` candidates
    contain too few such views, the next best are used.

    Args:
        weighted: the splats with their weights.
        drawable: the same splats in the frame's units.
        count: number of cameras.
        size: sides of the square pictures, pixels.
        seed: random seed; other seeds give other cameras of the same kind.
        inside: whether cameras stand inside; None lets `has_enclosed_places` decide.
    """
    rng = np.random.default_rng(seed)
    inside = has_enclosed_places(weighted, drawable) if inside is None else inside
    accepted: list[Camera] = []
    rejected: list[tuple[float, Camera]] = []

    def measure_unobstructed_coverage(camera: Camera) -> float:
        return -1.0 if weighted.estimate_clutter(camera.position) > MAX_CLUTTER else measure_coverage(drawable, camera)

    field_of_view = INSIDE_FIELD_OF_VIEW_DEGREES if inside else OUTSIDE_FIELD_OF_VIEW_DEGREES
    for _ in range(CANDIDATES_PER_CAMERA):
        lines_of_sight = [
            _sample_inside_view(weighted, rng) if inside else _sample_outside_view(weighted, rng) for _ in range(count)
        ]
        cameras = [_make_camera(position, target, size, field_of_view) for position, target in lines_of_sight]
        coverages = parallel_map(measure_unobstructed_coverage, cameras, drawable.device)
        for share, camera in zip(coverages, cameras, strict=True):
            if share >= MIN_COVERAGE:
                accepted.append(camera)
            else:
                rejected.append((share, camera))
        if len(accepted) >= count:
            return accepted[:count]
    rejected.sort(key=lambda pair: -pair[0])
    return accepted + [camera for _, camera in rejected[: count - len(accepted)]]


def measure_coverage(drawable: Drawable, camera: Camera) -> float:
    """Measure the share of a camera's picture that splats cover, 0 to 1, in a small picture of every n-th splat."""
    stride = _choose_stride(len(drawable.positions))
    # All splats, n times as many, would let the n-th power of this transmittance through.
    picture = draw(drawable[::stride], shrink_camera(camera, THUMBNAIL_SIDE_PIXELS), black=True)
    return 1 - float((picture.transmittance**stride).mean())


def _choose_stride(count: int) -> int:
    """Return the smallest n for which every n-th of `count` splats gives at most MAX_SAMPLED_SPLATS splats."""
    return max(1, -(-count // MAX_SAMPLED_SPLATS))


def has_enclosed_places(weighted: WeightedSplats, drawable: Drawable) -> bool:
    """Return whether the box has places without near splats from which splats are seen in nearly all directions.

    The clearest of ENCLOSURE_CANDIDATES places are tested. From at least half of them, splats have to cover
    MIN_ENCLOSED_COVERAGE of all directions.
    """
    rng = np.random.default_rng(0)
    positions = [_sample_inside_view(weighted, rng)[0] for _ in range(ENCLOSURE_CANDIDATES)]
    clutter = np.array(
        parallel_map(lambda position: weighted.estimate_clutter(position, ROOM_CLEARANCE_RADII), positions)
    )
    coverages = []
    for index in np.argsort(clutter, kind="stable")[:MAX_ENCLOSURE_TESTS]:
        if clutter[index] <= MAX_CLUTTER:
            axes = np.concatenate((np.eye(3), -np.eye(3)))
            cameras = [
                _make_camera(positions[index], positions[index] + axis * weighted.radius, THUMBNAIL_SIDE_PIXELS, 90.0)
                for axis in axes
            ]
            shares = parallel_map(lambda camera: measure_coverage(drawable, camera), cameras, drawable.device)
            coverages.append(np.mean(shares))
    return len(coverages) > 0 and float(np.median(coverages)) >= MIN_ENCLOSED_COVERAGE


def _sample_inside_view(weighted: WeightedSplats, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Sample a place in the middle of the box, and the position of the splat that a camera there looks at."""
    frame = weighted.frame
    position = (
        np.array(frame.center)
        + rng.uniform(-INSIDE_REGION_RATIO, INSIDE_REGION_RATIO, 3) * np.array(frame.half_extent) * frame.scale
    )
    return position, _sample_position(weighted, weighted.detail_weights, rng)


def _sample_outside_view(weighted: WeightedSplats, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Sample the position of a splat to look at, and a place at some distance from it; returns place, target."""
    target = _sample_position(weighted, weighted.target_weights, rng)
    log_min_distance, log_max_distance = np.log(OUTSIDE_DISTANCE_RANGE_RADII)
    distance = weighted.radius * math.exp(rng.uniform(log_min_distance, log_max_distance))
    return target + distance * _sample_direction(rng), target


def _sample_position(weighted: WeightedSplats, weights: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Sample the position (3,) of a splat with probability proportional to weights (N,)."""
    shares = np.cumsum(weights)
    return weighted.splats.positions[np.searchsorted(shares, rng.random() * shares[-1])]


def _sample_direction(rng: np.random.Generator) -> np.ndarray:
    """Sample a unit vector (3,) uniformly from the sphere."""
    height, angle = rng.uniform(-1, 1), rng.uniform(0, 2 * math.pi)
    side = math.sqrt(1 - height * height)
    return np.array([side * math.cos(angle), height, side * math.sin(angle)])


def _make_camera(position: np.ndarray, target: np.ndarray, size: int, degrees: float) -> Camera:
    focal = size / 2 / math.tan(math.radians(degrees / 2))
    pose = look_at(position, target, np.array([0.0, -1.0, 0.0]))
    return Camera(size, size, focal, focal, size / 2, size / 2, pose)

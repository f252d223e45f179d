"""Where splats are looked at from when nobody says: cameras that see much of them and stand in nobody's way."""

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

INSIDE = 0.01, 0.99  # of what is there, along each axis, the part that the frame's box spans
LARGEST = 0.99  # of the splats' areas: what is larger counts as no larger
DISTANCES = 0.5, 2.2  # of outside views from what they look at, in half diagonals of the box; evenly in their logarithm
FIELD_OF_VIEW = 50.0, 75.0  # degrees across, of views from outside and from inside
CLEAR, ROOMY = 0.12, 0.25  # half diagonals around cameras that are free of splats, and around those in a room
CLUTTER = 0.1  # the most of the sphere around a camera that splats so near may cover, about
COVERED = 0.3  # the least of a picture that splats cover
ENCLOSED = 0.75  # of all directions from the clearest places: where so many end at splats, views stand inside
MIDDLE = 0.55  # of the box, along each axis, that views from inside stand in
PLACES, CLEAREST = 256, 8  # that are looked at to tell
TRIED = 6  # cameras for each that is wanted
ENOUGH = 30_000  # splats that tell what a place is like; of more, every n-th
THUMBNAIL = 24  # pixels a side, to see how much a picture shows


@dataclass(frozen=True)
class Weighted:
    """Splats with what they matter by.

    Attributes:
        areas: (N,) float64 opacity times the product of the two larger scales, squared world units.
        details: (N,) float64 opacity, times the typical area over the splat's own where that is larger: what is far
            from all cameras, as a sky, is made of few large splats.
        frame: the box around nearly all details.
        targets: (N,) float64 areas, beyond the box by the fourth power less: a sky is large and far away.
    """

    splats: Splats
    areas: np.ndarray
    details: np.ndarray
    frame: Frame
    targets: np.ndarray

    @classmethod
    def of(cls, splats: Splats, name: str) -> Weighted:
        """Weigh splats.

        Raises:
            HyrfDataError: none of them can be seen.
        """
        sides = np.sort(splats.scales.astype(np.float64), axis=1)
        discs = sides[:, 1] * sides[:, 2]
        areas = splats.opacities * discs
        if not (areas > 0).any():
            raise HyrfDataError(
                f"{name}: there is no Gaussian in it that could be seen (of some size and opacity); name another file"
            )
        seen = areas > 0
        typical = np.median(discs[seen])
        details = np.where(seen, splats.opacities * (typical / np.maximum(discs, typical)), 0.0)
        areas = np.minimum(areas, np.quantile(areas[seen], LARGEST))
        frame = Frame.from_box(*_box(splats.positions[seen], sides[seen, 2], details[seen]))
        boxes_away = np.abs(frame.to_local(splats.positions) / frame.half_extent).max(axis=1)
        return cls(splats, areas, details, frame, areas / np.maximum(boxes_away, 1) ** 4)

    @property
    def radius(self) -> float:
        """Half the diagonal of the box, world units."""
        return float(np.linalg.norm(self.frame.half_extent)) * self.frame.scale

    def clutter(self, place: np.ndarray, reach: float = CLEAR) -> float:
        """About how much of the sphere around a place (3,) splats within `reach` half diagonals cover."""
        every = _every(len(self.areas))
        squares = ((self.splats.positions[::every] - place) ** 2).sum(axis=1)
        near = squares < (reach * self.radius) ** 2
        areas, squares = self.areas[::every][near], squares[near]
        # A disc of standard deviations a and b lets 2 pi a b o of light from far behind it disappear.
        return every * float((areas / (2 * squares + areas)).sum())


def _box(positions: np.ndarray, sizes: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The corners between the quantiles INSIDE, by weight, of each axis; each splat lies at its two ends."""
    ends = np.concatenate((positions - sizes[:, None], positions + sizes[:, None]))
    order = np.argsort(ends, axis=0, kind="stable")
    shares = np.cumsum(np.tile(weights, 2)[order], axis=0)
    rows = [[np.searchsorted(column / column[-1], share) for column in shares.T] for share in INSIDE]
    low, high = (np.array([ends[order[row, axis], axis] for axis, row in enumerate(part)]) for part in rows)
    return low, high


def viewpoints(
    weighted: Weighted, drawable: Drawable, count: int, size: int, seed: int, inside: bool | None = None
) -> list[Camera]:
    """Cameras all around, near and far, or inside where splats surround.

    Views from outside look at splats, drawn as `Weighted.targets`, from all directions. Where the clearest places of
    the box have splats all around, as in a room, views stand there instead and look at splats drawn by details, for
    walls and skies would take most of the pictures. Either kind keeps clear of splats right before the camera and has
    some of them in the picture, as long as such views are found.

    Args:
        drawable: the splats in the frame's units.
        count: how many.
        size: pixels a side.
        seed: of what is drawn; other seeds give other cameras of the same kind.
        inside: whether views stand inside; `surrounds` says, if it is not said here.
    """
    rng = np.random.default_rng(seed)
    inside = surrounds(weighted, drawable) if inside is None else inside
    found: list[Camera] = []
    others: list[tuple[float, Camera]] = []

    def covered(camera: Camera) -> float:
        return -1.0 if weighted.clutter(camera.position) > CLUTTER else coverage(drawable, camera)

    for _ in range(TRIED):
        ends = [_inside(weighted, rng) if inside else _outside(weighted, rng) for _ in range(count)]
        cameras = [_camera(place, target, size, FIELD_OF_VIEW[inside]) for place, target in ends]
        for share, camera in zip(parallel_map(covered, cameras, drawable.device), cameras, strict=True):
            if share >= COVERED:
                found.append(camera)
            else:
                others.append((share, camera))
        if len(found) >= count:
            return found[:count]
    others.sort(key=lambda pair: -pair[0])
    return found + [camera for _, camera in others[: count - len(found)]]


def coverage(drawable: Drawable, camera: Camera) -> float:
    """How much of a camera's picture splats cover, 0 to 1, from a picture of THUMBNAIL pixels."""
    every = _every(len(drawable.positions))
    # Of n times as many, each like these, the n-th power gets through.
    seen = draw(drawable[::every], shrink_camera(camera, THUMBNAIL), black=True).transmittance ** every
    return 1 - float(seen.mean())


def _every(count: int) -> int:
    return max(1, -(-count // ENOUGH))


def surrounds(weighted: Weighted, drawable: Drawable) -> bool:
    """Whether there are places in the box with room around them and splats all around."""
    rng = np.random.default_rng(0)
    places = [_inside(weighted, rng)[0] for _ in range(PLACES)]
    clutter = np.array(parallel_map(lambda place: weighted.clutter(place, ROOMY), places))
    seen = []
    for index in np.argsort(clutter, kind="stable")[:CLEAREST]:
        if clutter[index] <= CLUTTER:
            axes = np.concatenate((np.eye(3), -np.eye(3)))
            cameras = [_camera(places[index], places[index] + axis * weighted.radius, THUMBNAIL, 90.0) for axis in axes]
            shares = parallel_map(lambda camera: coverage(drawable, camera), cameras, drawable.device)
            seen.append(np.mean(shares))
    return len(seen) > 0 and float(np.median(seen)) >= ENCLOSED


def _inside(weighted: Weighted, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A place in the middle of the box, and the splat that it looks at."""
    frame = weighted.frame
    place = np.array(frame.center) + rng.uniform(-MIDDLE, MIDDLE, 3) * np.array(frame.half_extent) * frame.scale
    return place, _drawn(weighted, weighted.details, rng)


def _outside(weighted: Weighted, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A place some way off, and the splat that it looks at."""
    target = _drawn(weighted, weighted.targets, rng)
    near, far = np.log(DISTANCES)
    return target + weighted.radius * math.exp(rng.uniform(near, far)) * _direction(rng), target


def _drawn(weighted: Weighted, weights: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The place (3,) of a splat, drawn by weights (N,)."""
    shares = np.cumsum(weights)
    return weighted.splats.positions[np.searchsorted(shares, rng.random() * shares[-1])]


def _direction(rng: np.random.Generator) -> np.ndarray:
    """(3,) a unit vector, all directions alike."""
    height, angle = rng.uniform(-1, 1), rng.uniform(0, 2 * math.pi)
    side = math.sqrt(1 - height * height)
    return np.array([side * math.cos(angle), height, side * math.sin(angle)])


def _camera(place: np.ndarray, target: np.ndarray, size: int, degrees: float) -> Camera:
    focal = size / 2 / math.tan(math.radians(degrees / 2))
    pose = look_at(place, target, np.array([0.0, -1.0, 0.0]))
    return Camera(size, size, focal, focal, size / 2, size / 2, pose)

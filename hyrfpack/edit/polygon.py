"""Read polygons on the ground from files, and find the positions inside them."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from hyrfpack.config.edit import CropPolygon
from hyrfpack.errors import HyrfDataError, HyrfError

_KEYS = ("points", "min_height", "max_height")


def read_polygon(path: str | os.PathLike[str]) -> CropPolygon:
    """Read a polygon from a JSON file.

    The file holds a list of points, `[[x, y, z], ...]` in world units, or an object with the list as "points" and with
    "min_height" and "max_height", which may be left out.

    Raises:
        HyrfDataError: the file cannot be read, or does not hold such a polygon.
    """
    try:
        content = json.loads(Path(path).read_bytes())
    except OSError as error:
        raise HyrfDataError(
            f"{path}: the polygon cannot be read ({error.strerror or error})", fix="check the path"
        ) from error
    except (ValueError, RecursionError) as error:
        raise HyrfDataError(f"{path}: this is not JSON ({error!s:.160})", fix="name a JSON file of points") from error
    try:
        return _parse_polygon(content)
    except (TypeError, ValueError, OverflowError) as error:
        raise HyrfDataError(
            f"{path}: this is not a polygon ({error!s:.160})",
            fix='write [[x, y, z], ...] or {"points": [[x, y, z], ...], "min_height": -1, "max_height": 2}',
        ) from error


def _parse_polygon(content: Any) -> CropPolygon:
    """Convert the content of a file to a polygon.

    Raises:
        TypeError, ValueError, OverflowError: the content is not a polygon.
    """
    entries = content if isinstance(content, dict) else {"points": content}
    if unknown := [key for key in entries if key not in _KEYS]:
        raise ValueError(f"there is no key '{unknown[0]}'; the keys are {', '.join(_KEYS)}")
    points = entries.get("points")
    if not isinstance(points, list) or not all(isinstance(point, list) and len(point) == 3 for point in points):
        raise ValueError("the points must be a list of [x, y, z]")
    heights = {key: _parse_number(entries[key]) for key in _KEYS[1:] if entries.get(key) is not None}
    return CropPolygon(tuple((_parse_number(x), _parse_number(y), _parse_number(z)) for x, y, z in points), **heights)


def _parse_number(value: Any) -> float:
    """Convert a number of a JSON file to a float; texts and true or false are no numbers."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{json.dumps(value):.40} is not a number")
    return float(value)


def inside_mask(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return a mask (N,) of points (N, 2) inside a polygon with corners (M, 2), by the parity of crossings of a ray.

    Points on a side may count either way.
    """
    inside = np.zeros(len(points), bool)
    x, y = points.T
    for (ax, ay), (bx, by) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        crosses = (ay > y) != (by > y)
        inside[crosses] ^= x[crosses] < ax + (y[crosses] - ay) / (by - ay) * (bx - ax)
    return inside


def find_distinct_corners(corners: np.ndarray) -> np.ndarray:
    """Return the indices (M,) of the corners of a polygon (N, 2) that do not repeat the one before or close it.

    Raises:
        HyrfError: fewer than three corners are left, or two sides of the polygon meet.
    """
    kept = [0]
    for index in range(1, len(corners)):
        if (corners[index] != corners[kept[-1]]).any():
            kept.append(index)
    while len(kept) > 1 and (corners[kept[-1]] == corners[0]).all():
        kept.pop()
    if len(kept) < 3:
        raise HyrfError("seen from above, the polygon has fewer than three corners", fix="give three or more")
    if (sides := _find_meeting_sides(corners[kept])) is not None:
        first, second = (kept[side] + 1 for side in sides)
        raise HyrfError(
            f"seen from above, the side after point {first} of the polygon meets the side after point {second}",
            fix="give the points in their order around the polygon",
        )
    return np.array(kept)


def _find_meeting_sides(corners: np.ndarray) -> tuple[int, int] | None:
    """Return the indices of two sides of a closed polygon that share more than a common corner, or None.

    Side i leads from corner i to the next one.
    """
    count, ends = len(corners), np.roll(corners, -1, axis=0)
    indices = np.arange(count)
    for side in range(count):
        a, b = corners[side], ends[side]
        following = ends[(side + 1) % count]
        if _cross(b - a, following - b) == 0 and (b - a) @ (following - b) < 0:  # the next side leads back
            return side, (side + 1) % count
        others = (indices > side + 1) & ((indices + 1) % count != side)
        c, d = corners[others], ends[others]
        # Two segments meet if each has its ends on both sides of the other's line. If all four are in one line, their
        # bounds overlap.
        sides_of_ab = _cross(b - a, c - a) * _cross(b - a, d - a)
        sides_of_cd = _cross(d - c, a - c) * _cross(d - c, b - c)
        overlap = (np.minimum(c, d) <= np.maximum(a, b)) & (np.maximum(c, d) >= np.minimum(a, b))
        meets = (sides_of_ab <= 0) & (sides_of_cd <= 0) & overlap.all(axis=1)
        if meets.any():
            return side, int(indices[others][meets.argmax()])
    return None


def _cross(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return the z component of the cross product of vectors (..., 2)."""
    return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]

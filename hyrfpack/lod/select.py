"""Choose the levels of detail of a scene's chunks for a view and a budget."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hyrfpack.checks import check_type
from hyrfpack.format.scene_manifest import Manifest
from hyrfpack.scene import Camera

# The error of leaving a chunk out, relative to the error of its coarsest level, and the smallest error of the pixels
# that a left-out chunk covers (docs/research/levels.md).
LEFT_OUT_RATIO = 3.0
MIN_LEFT_OUT_MSE = 0.003
# The area that a chunk covers is an estimate. So leaving out a chunk that seems to be outside the picture has a small
# error, and the chunk gets its coarsest level if the budget allows.
UNSEEN_MSE = 1e-12


@dataclass(frozen=True)
class LevelSelection:
    """Levels of detail chosen for a view.

    Attributes:
        levels: level of each chunk, 0 for the finest; None for a chunk that is left out.
        gaussians: number of Gaussians of these levels.
        bytes: size of their files and of the shared files.
        predicted_mse: predicted mean squared error of the view against the finest levels.
        max_gap: bound on how much lower the error of the best choice within the budget can be; 0 if all upgrades fit.
    """

    levels: list[int | None]
    gaussians: int
    bytes: int
    predicted_mse: float
    max_gap: float


def select_levels(
    manifest: Manifest, camera: Camera, *, gaussians: int | None = None, bytes: int | None = None
) -> LevelSelection:
    """Choose a level for each chunk so that the predicted error of a view is small within a budget.

    Every chunk is left out at first. Then the upgrades along the lower convex hull of each chunk's costs and errors
    are taken in the order of falling error reduction per cost, as long as they fit (a greedy knapsack). The error
    exceeds that of the best choice by less than the gain of the first upgrade that does not fit, `max_gap`: with a
    fraction of this upgrade, the choice before it would be the optimum of the linear relaxation, which bounds all
    choices.

    Args:
        manifest: the manifest of a scene folder.
        camera: the view, in world units.
        gaussians: maximum number of Gaussians; None for no limit.
        bytes: maximum size of the files, including the shared files; None for no limit. Only one of both limits may be
            given.

    Raises:
        ValueError: both limits are given.
        TypeError: the manifest or the camera has another type.

    Example:
        >>> import hyrfpack
        >>> report = hyrfpack.split_model("bonsai.hyrf", "scene", hyrfpack.SplitConfig(levels=2, refit_steps=1))
        >>> camera = hyrfpack.load_scene("photos/bonsai").test[0].camera
        >>> choice = hyrfpack.select_levels(hyrfpack.SceneFolder("scene").manifest, camera)
        >>> choice.gaussians == report.gaussians, choice.predicted_mse
        (True, 0.0)
    """
    check_type("manifest", manifest, Manifest)
    check_type("camera", camera, Camera)
    if gaussians is not None and bytes is not None:
        raise ValueError("both a number of Gaussians and a size limit the view; give one of them")
    count_bytes = bytes is not None
    budget = gaussians if bytes is None else bytes
    limit = math.inf if budget is None else budget
    base_cost = manifest.shared_bytes if count_bytes else 0
    costs = [
        [*(level.bytes if count_bytes else level.gaussians for level in chunk.levels), 0] for chunk in manifest.chunks
    ]
    errors = [[*own, left_out + UNSEEN_MSE] for *own, left_out in predict_errors(manifest, camera)]
    chosen, max_gap = choose_levels(costs, errors, limit - base_cost)
    levels = [
        level if level < len(chunk.levels) else None for chunk, level in zip(manifest.chunks, chosen, strict=True)
    ]
    files = [chunk.levels[level] for chunk, level in zip(manifest.chunks, levels, strict=True) if level is not None]
    return LevelSelection(
        levels,
        sum(file.gaussians for file in files),
        manifest.shared_bytes + sum(file.bytes for file in files),
        sum(each[level] for each, level in zip(errors, chosen, strict=True)),
        max_gap,
    )


def choose_levels(
    costs: Sequence[Sequence[float]], errors: Sequence[Sequence[float]], limit: float
) -> tuple[list[int], float]:
    """Choose one level of each item with a low total error and a total cost of at most `limit`, see `select_levels`.

    Returns:
        The level of each item, and a bound on how much lower the total error of the best choice can be. If not even the
        cheapest levels fit, these are returned, with the bound 0.
    """
    hulls = [_lower_hull(*item) for item in zip(costs, errors, strict=True)]
    chosen = [hull[0] for hull in hulls]
    spent = sum(each[level] for each, level in zip(costs, chosen, strict=True))
    if spent > limit:
        return chosen, 0.0
    upgrades = []
    for item, hull in enumerate(hulls):
        for place, (worse, better) in enumerate(zip(hull, hull[1:], strict=False)):
            gain = errors[item][worse] - errors[item][better]
            upgrades.append((-gain / (costs[item][better] - costs[item][worse]), item, place, worse, better))
    max_gap, is_full = 0.0, set()
    for _, item, _, worse, better in sorted(upgrades):
        cost = costs[item][better] - costs[item][worse]
        if item not in is_full and spent + cost <= limit:
            chosen[item], spent = better, spent + cost
        else:
            max_gap = max_gap or errors[item][worse] - errors[item][better]
            is_full.add(item)
    return chosen, max_gap


def _lower_hull(costs: Sequence[float], errors: Sequence[float]) -> list[int]:
    """Return the levels on the lower convex hull of (cost, error), from the cheapest, as far as the error falls."""
    hull: list[int] = []
    for level in sorted(range(len(costs)), key=lambda level: (costs[level], errors[level])):
        if hull and errors[level] >= errors[hull[-1]]:
            continue
        while len(hull) > 1:
            a, b = hull[-2:]
            rises = (errors[b] - errors[a]) * (costs[level] - costs[a])
            if rises < (errors[level] - errors[a]) * (costs[b] - costs[a]):
                break
            hull.pop()
        hull.append(level)
    return hull


def predict_errors(manifest: Manifest, camera: Camera) -> list[list[float]]:
    """Predict the mean squared error that each level of each chunk adds to a view, and last that of leaving it out."""
    pixels = camera.width * camera.height
    result = []
    for chunk in manifest.chunks:
        radius, area = project_sphere(chunk.center, chunk.radius, camera)
        errors = [_interpolate(manifest.error_radii, level.errors, radius) for level in chunk.levels]
        errors.append(max(LEFT_OUT_RATIO * errors[-1], MIN_LEFT_OUT_MSE))
        result.append([area / pixels * error for error in errors])
    return result


def project_sphere(center: Sequence[float], radius: float, camera: Camera) -> tuple[float, float]:
    """Return the radius in pixels of a sphere's projection, and its area within the picture in square pixels.

    The radius is f r / max(distance, r) with the focal length f. The area is that of the disc, times the share of its
    bounding square that lies in the picture. If the camera is inside the sphere, the area is the whole picture; if the
    sphere is wholly behind the camera, it is 0.
    """
    x, y, z = (camera.rotation @ (np.asarray(center) - camera.position)).tolist()
    distance, focal = math.hypot(x, y, z), math.sqrt(camera.fx * camera.fy)
    pixels = float(camera.width * camera.height)
    projected = focal * radius / max(distance, radius, 1e-30)
    if distance <= radius:
        return projected, pixels
    if z <= 0 and -z >= radius:
        return projected, 0.0
    depth = max(z, 1e-3 * distance)
    u, v = camera.cx + camera.fx * x / depth, camera.cy + camera.fy * y / depth
    half = focal * radius / depth
    width = min(u + half, camera.width) - max(u - half, 0)
    height = min(v + half, camera.height) - max(v - half, 0)
    return projected, min(math.pi / 4 * max(width, 0.0) * max(height, 0.0), pixels)


def _interpolate(radii: Sequence[float], errors: Sequence[float], radius: float) -> float:
    """Interpolate errors linearly in the logarithm of the radius; beyond the first and the last they are constant."""
    return float(np.interp(math.log(max(radius, 1e-30)), np.log(radii), errors))

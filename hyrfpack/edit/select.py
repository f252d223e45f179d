"""Decide which Gaussians an action keeps."""

from __future__ import annotations

from functools import singledispatch
from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from hyrfpack.cameras.placement import Placement
from hyrfpack.compress.removals import measure_removals
from hyrfpack.config.edit import (
    CropBox,
    CropCameras,
    CropMasks,
    CropPolygon,
    CropSphere,
    KeepGaussians,
    MaxScale,
    MinOpacity,
    Remove,
    RemoveFloaters,
)
from hyrfpack.data.masks import assign_masks
from hyrfpack.edit.floaters import find_floaters
from hyrfpack.edit.masks import share_of_light_in_masks
from hyrfpack.edit.polygon import find_distinct_corners, inside_mask
from hyrfpack.edit.state import EditState
from hyrfpack.errors import HyrfError
from hyrfpack.model.merged import MergedModel, parts_of, scene_of


@singledispatch
def keep_mask(action: object, state: EditState) -> np.ndarray:
    """Return a mask (N,) of the Gaussians that an action of selection keeps.

    Raises:
        HyrfError: the cameras of the scene are not known or surround nothing, the sides of a polygon meet, or there are
            no photos or masks that the action needs.
    """
    raise TypeError(f"{action!r} selects no Gaussians")


@keep_mask.register
def _(action: CropBox, state: EditState) -> np.ndarray:
    positions = state.world_positions()
    if action.degrees:
        center = (np.array(action.low) + action.high) / 2
        turn = Placement.rotation_about_axis(state.up, action.degrees).rotation
        positions = (positions - center) @ turn + center  # the inverse rotation, into the axes of the box
    return np.asarray(((positions >= action.low) & (positions <= action.high)).all(axis=1))


@keep_mask.register
def _(action: CropSphere, state: EditState) -> np.ndarray:
    distances = np.linalg.norm(state.world_positions() - action.center, axis=1)
    return np.asarray(distances <= action.radius)


@keep_mask.register
def _(action: CropCameras, state: EditState) -> np.ndarray:
    east, north = _horizontal_axes(state.up)
    plan = np.stack((east, north), axis=1)
    corners = (
        np.array([camera.position for camera in state.photo_cameras("to which the model could be cropped")]) @ plan
    )
    try:
        hull = ConvexHull(corners)
    except (QhullError, ValueError):
        raise HyrfError(
            f"the cameras of the scene ({len(corners)}) stand at one place or in a row, so they surround nothing",
            fix="crop to a box or a sphere instead",
        ) from None
    center = corners[hull.vertices].mean(axis=0)
    # A point p is inside if normal . p + offset <= 0 for each side; the margin moves sides away from the centre.
    points = (state.world_positions() @ plan - center) / (1 + action.margin) + center
    normals, offsets = hull.equations[:, :2], hull.equations[:, 2]
    return (points @ normals.T + offsets <= 0).all(axis=1)


@keep_mask.register
def _(action: CropPolygon, state: EditState) -> np.ndarray:
    plan, up = np.stack(_horizontal_axes(state.up), axis=1), state.up / np.linalg.norm(state.up)
    points, positions = np.array(action.points, np.float64), state.world_positions()
    corners = points[find_distinct_corners((points - points[0]) @ plan)]
    middle = corners.mean(axis=0)  # coordinates relative to the polygon stay precise far from the origin
    heights = (positions - middle) @ up
    inside = inside_mask((positions - middle) @ plan, (corners - middle) @ plan)
    return inside & (heights >= action.min_height) & (heights <= action.max_height)


@keep_mask.register
def _(action: CropMasks, state: EditState) -> np.ndarray:
    if not state.photos:
        raise HyrfError("masks belong to photos, but no photos are given", fix="name the photos with `data`")
    if isinstance(state.model, MergedModel):
        raise HyrfError(
            "masks of photos select Gaussians of one model, and this file holds several",
            fix="take a part out with `part`, crop it, and merge again",
        )
    views = assign_masks(state.photos, Path(action.folder), state.held_out)
    return share_of_light_in_masks(state.model, views, state.progress) >= action.min_light_share


@keep_mask.register
def _(action: Remove, state: EditState) -> np.ndarray:
    return ~keep_mask(action.crop, state)


@keep_mask.register
def _(action: MinOpacity, state: EditState) -> np.ndarray:
    return state.model.decode_geometry().opacities.numpy() >= action.opacity


@keep_mask.register
def _(action: MaxScale, state: EditState) -> np.ndarray:
    longest = [
        part.decode_geometry().scales.amax(dim=1).numpy() * part.config.frame.scale for part in parts_of(state.model)
    ]
    return np.concatenate(longest) <= action.scale


@keep_mask.register
def _(action: RemoveFloaters, state: EditState) -> np.ndarray:
    if not state.photos:
        raise HyrfError(
            "floaters are found by comparing the model with its photos, but no photos are given",
            fix="name the photos with `data`",
        )
    keep = np.ones(len(state.model), bool)
    if state.has_scene:
        scene = scene_of(state.model)
        keep[: len(scene)] = ~find_floaters(scene, state.photos, action.min_opacity_share, state.progress)
    return keep


@keep_mask.register
def _(action: KeepGaussians, state: EditState) -> np.ndarray:
    keep = np.ones(len(state.model), bool)
    if action.count < len(keep):
        removals = measure_removals(state.model, state.cameras, progress=state.progress)
        keep[np.argsort(-removals, kind="stable")[action.count :]] = False
    return keep


def _horizontal_axes(up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two unit vectors that are perpendicular to `up` (3,) and to each other."""
    east = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    east /= np.linalg.norm(east)
    return east, np.cross(up, east) / np.linalg.norm(up)

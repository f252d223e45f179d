"""Moves of a scene. Only the frame, the stored cameras and the stored placement of a model change."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace
from typing import Any

from hyrfpack.cameras.capture import PLACEMENT_KEY
from hyrfpack.cameras.files import camera_from_numbers, camera_to_numbers
from hyrfpack.cameras.paths import Viewpoint
from hyrfpack.cameras.placement import Placement
from hyrfpack.config.edit import Move, Rotate, Scale, Translate
from hyrfpack.errors import HyrfError
from hyrfpack.model import HybridModel
from hyrfpack.model.frame import Frame
from hyrfpack.rotations import IDENTITY, quaternion_from_matrix
from hyrfpack.scene import MAX_WORLD_COORDINATE

CAMERA_KEYS = ("cameras", "coarse_cameras")
# A scene whose frame is turned by less has been turned back, and gets the file of one that was never turned.
MIN_TURN_RADIANS = 1e-12
# Poses and centres are float64, which at this multiple of a scene's half size still hold a ten-thousandth of it.
MAX_DISTANCE_RATIO = 1e12
MIN_FRAME_SCALE = 1e-30  # sizes are float32 in files and pictures, see MAX_WORLD_COORDINATE


def placement_of(move: Move) -> Placement:
    """Return the map of a move.

    Raises:
        TypeError: the argument is not a move.
    """
    if isinstance(move, Translate):
        return Placement.translation(move.offset)
    if isinstance(move, Rotate):
        return Placement.rotation_about_axis(move.axis, move.degrees)
    if isinstance(move, Scale):
        return Placement(move.factor)
    raise TypeError(f"{move!r} is not a move; use Translate, Rotate or Scale of hyrfpack.config.edit")


def move_frame(placement: Placement, frame: Frame) -> Frame:
    """Return the frame of a moved model.

    Raises:
        HyrfError: the moved scene is too far away, too large or too small for the numbers that hold it.
    """
    x, y, z = placement.move_point(frame.center).tolist()
    scale = placement.factor * frame.scale
    reach = max(abs(x), abs(y), abs(z), scale)
    if not (MIN_FRAME_SCALE <= scale and reach <= MAX_WORLD_COORDINATE):
        raise HyrfError(
            f"moves take the scene's centre to ({x:g}, {y:g}, {z:g}) and its half size to {scale:g}; sizes must be "
            f"at least {MIN_FRAME_SCALE:g} and coordinates at most {MAX_WORLD_COORDINATE:g}",
            fix="move and scale it by less",
        )
    if reach > MAX_DISTANCE_RATIO * scale:
        raise HyrfError(
            f"moves take the scene's centre to ({x:g}, {y:g}, {z:g}), {reach / scale:.2g} times its half size from the "
            f"origin; beyond {MAX_DISTANCE_RATIO:g} times, float64 cannot hold its shape precisely enough",
            fix="move it by less",
        )
    w, i, j, k = (quaternion_from_matrix(placement.rotation @ frame.axes) + 0.0).tolist()  # + 0.0 turns -0.0 into 0.0
    rotation = IDENTITY if 2 * math.hypot(i, j, k) < MIN_TURN_RADIANS else (w, i, j, k)
    return Frame((x, y, z), scale, frame.half_extent, rotation)


def move_model(placement: Placement, model: HybridModel) -> HybridModel:
    """Return the moved model, which shares all parameters with `model`: only its frame differs."""
    return replace_config(model, frame=move_frame(placement, model.config.frame))


def move_provenance(placement: Placement, provenance: dict) -> dict:
    """Return a provenance with moved cameras, viewpoint and placement. Entries that cannot be read are left out."""
    moved = {PLACEMENT_KEY: Placement().to_json(), **provenance}
    for key in (*CAMERA_KEYS, "viewpoint", PLACEMENT_KEY):
        if key in moved:
            entry = moved.pop(key)
            with suppress(TypeError, ValueError, ArithmeticError, KeyError):
                moved[key] = _move_entry(placement, key, entry)
    return moved


def _move_entry(placement: Placement, key: str, entry: Any) -> Any:
    if key in CAMERA_KEYS:
        return [camera_to_numbers(placement.move_camera(camera_from_numbers(numbers))) for numbers in entry]
    if key == PLACEMENT_KEY:
        return Placement.from_json(entry).then(placement).to_json()
    viewpoint = Viewpoint.from_json(entry)
    return replace(
        viewpoint,
        center=placement.move_point(viewpoint.center),
        up=placement.move_direction(viewpoint.up),
        camera=placement.move_camera(viewpoint.camera),
    ).to_json()


def replace_config(model: HybridModel, **changes: Any) -> HybridModel:
    """Return a model with changed fields of its configuration; it shares all parameters with `model`."""
    changed = HybridModel(replace(model.config, **changes), model.gaussians)
    changed.geometry, changed.radiance = model.geometry, model.radiance
    changed.copy_settings(model)
    return changed

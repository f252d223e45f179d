"""Read and write cameras in JSON. Every JSON layout of cameras in this package is defined and checked here."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from hyrfpack.errors import HyrfDataError
from hyrfpack.scene import Camera, rigid_pose

MAX_IMAGE_SIDE_PIXELS = 16384  # a larger number in a file is treated as a mistake, and larger photos are refused
MAX_SIGNIFICANT_DIGITS = 17  # of a float64
INTRINSICS_KEYS = ("width", "height", "fx", "fy", "cx", "cy")
_FOCAL_KEYS = ("fl_x", "fl_y", "camera_angle_x", "camera_angle_y")


def camera_to_json(camera: Camera) -> dict[str, Any]:
    """Convert a camera to a dictionary of its intrinsics (INTRINSICS_KEYS) and "camera_from_world" (4 rows)."""
    numbers = dict(zip(INTRINSICS_KEYS, (camera.width, camera.height, *camera.intrinsics), strict=True))
    return {**numbers, "camera_from_world": camera.camera_from_world.tolist()}


def camera_from_json(item: Mapping[str, Any]) -> Camera:
    """Convert an untrusted dictionary of the layout that `camera_to_json` writes to a camera.

    "fy" defaults to "fx", and "cx" and "cy" default to the picture's centre. Other keys are ignored.

    Raises:
        KeyError: another key is missing.
        TypeError, ValueError, OverflowError: a value is not valid.
    """
    width, height, fx = _side_length(item["width"]), _side_length(item["height"]), _focal_length(item["fx"])
    fy = _focal_length(item.get("fy", fx))
    cx, cy = _finite_float(item.get("cx", width / 2)), _finite_float(item.get("cy", height / 2))
    return Camera(width, height, fx, fy, cx, cy, item["camera_from_world"])


def camera_to_numbers(camera: Camera, decimals: tuple[int, int] | None = None) -> list[float]:
    """Convert a camera to 18 rounded numbers: width, height, fx, fy, cx, cy and the 3 x 4 camera_from_world.

    Args:
        camera: the camera.
        decimals: decimal places of the rotation (at least 4, otherwise it is no longer rigid) and of the translation;
            intrinsics are rounded to one place. None rounds intrinsics by `round_number` and the pose by `round_pose`.
    """
    pose = camera.camera_from_world[:3].tolist()
    if decimals is None:
        rounded = round_pose(pose)
        return [camera.width, camera.height, *map(round_number, camera.intrinsics), *chain(*rounded)]
    rotation, translation = decimals
    rows = ([*(round(x, rotation) for x in row[:3]), round(row[3], translation)] for row in pose)
    lens = (round(number, 1) for number in camera.intrinsics)
    # Adding 0.0 turns -0.0 into 0.0.
    return [camera.width, camera.height, *lens, *(x + 0.0 for row in rows for x in row)]


def camera_from_numbers(numbers: Sequence[Any]) -> Camera:
    """Convert the numbers that `camera_to_numbers` gives to a camera.

    Raises:
        TypeError, ValueError, OverflowError: a number is missing or not valid.
    """
    check_json_numbers(numbers)
    width, height, fx, fy, cx, cy, *pose = numbers
    lens = dict(zip(INTRINSICS_KEYS, (width, height, fx, fy, cx, cy), strict=True))
    return camera_from_json({**lens, "camera_from_world": np.reshape(pose, (3, 4))})


def cameras_to_json(cameras: Sequence[tuple[str, Camera]]) -> str:
    """Write named cameras as the JSON text that `cameras_from_json` reads."""
    return json.dumps([{"name": name, **camera_to_json(camera)} for name, camera in cameras], indent=1)


def cameras_from_json(path: str | os.PathLike[str]) -> list[tuple[str, Camera]]:
    """Read named cameras from a JSON file.

    Three layouts are accepted:

    - that of `cameras_to_json`, a list: `[{"name": "0001", "width": 800, "height": 600, "fx": 700, "fy": 700,
      "cx": 400, "cy": 300, "camera_from_world": [[4 x 4]]}, ...]`, OpenCV axes (x right, y down, z forward). `name`,
      `fy` (then equal to `fx`), `cx` and `cy` (then the picture's centre) are optional;
    - `cameras.json` of 3DGS training: also a list, with "position" (of the camera), "rotation" (3 x 3
      world_from_camera) and "img_name" in place of "camera_from_world" and "name";
    - `transforms.json` of nerfstudio and instant-ngp: an object with `frames`, each with a `transform_matrix`
      (world_from_camera, OpenGL axes) and, here or for all frames, `w`, `h` and a focal length, see `focal_entries` and
      `focal_lengths`. Lens distortion is left out: renders are pinhole pictures.

    Raises:
        HyrfDataError: the file cannot be read, or a camera is incomplete or impossible; the message names the camera.
    """
    try:
        content = json.loads(Path(path).read_bytes())
    except OSError as error:
        raise HyrfDataError(
            f"{path}: the cameras cannot be read ({error.strerror or error})",
            fix="check the path",
        ) from error
    except (ValueError, RecursionError) as error:
        raise HyrfDataError(f"{path}: this is not JSON ({error})", fix="name a JSON file of cameras") from error
    parse: Callable[[dict[str, Any], dict[str, Any], str], tuple[str, Camera]]
    if isinstance(content, dict) and isinstance(content.get("frames"), list):
        parse, items, shared = _parse_transforms_frame, content["frames"], content
    elif isinstance(content, list):
        parse, items, shared = _parse_camera, content, {}
    else:
        raise HyrfDataError(
            f"{path}: the file holds neither a list of cameras nor 'frames'",
            fix="see the help of 'hyrfpack render'",
        )
    cameras = []
    for number, item in enumerate(items):
        try:
            cameras.append(parse(dict(item), shared, f"{number:04d}"))
        except KeyError as error:
            raise HyrfDataError(f"{path}: camera {number} has no {error}", fix="add it") from error
        except (TypeError, ValueError, ArithmeticError) as error:
            raise HyrfDataError(f"{path}: camera {number} is not valid ({error!s:.160})", fix="correct it") from error
    if not cameras:
        raise HyrfDataError(f"{path}: there is no camera in it", fix="add at least one")
    return cameras


def _parse_camera(item: dict[str, Any], _: dict[str, Any], name: str) -> tuple[str, Camera]:
    """Parse a camera as `camera_to_json` writes it, or as 3DGS training does, by position and rotation."""
    if "camera_from_world" in item or "rotation" not in item:
        return str(item.get("name", name)), camera_from_json(item)
    rotation = np.asarray(item["rotation"], np.float64).reshape(3, 3)
    pose = np.eye(4)
    pose[:3] = np.column_stack((rotation.T, -rotation.T @ np.asarray(item["position"], np.float64).reshape(3)))
    return str(item.get("img_name", name)), camera_from_json({**item, "camera_from_world": rigid_pose(pose)})


def focal_entries(frame: Mapping[str, Any], shared: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of a transforms.json that state a frame's focal lengths, without null.

    They are the frame's own, then those for all frames. If the frame has a field of view, all are its own.
    """
    of_frame, of_all = (
        {key: values[key] for key in _FOCAL_KEYS if values.get(key) is not None} for values in (frame, shared)
    )
    return of_frame if of_frame.keys() & {"camera_angle_x", "camera_angle_y"} else of_all | of_frame


def focal_lengths(entries: Mapping[str, float], from_angle: Callable[[str], float]) -> tuple[float, float] | None:
    """Return fx and fy from `focal_entries`, None without any; one that is not stated equals the other.

    Args:
        entries: focal lengths in pixels (fl_x, fl_y) and fields of view in radians (camera_angle_x, camera_angle_y),
            which count only without fl_x.
        from_angle: returns the focal length for the field of view of a name.
    """
    fx, fy = entries.get("fl_x"), entries.get("fl_y")
    if fy is None and fx is None and "camera_angle_y" in entries:
        fy = from_angle("camera_angle_y")
    if fx is None and "camera_angle_x" in entries:
        fx = from_angle("camera_angle_x")
    fx, fy = fy if fx is None else fx, fx if fy is None else fy
    return None if fx is None or fy is None else (fx, fy)


def _parse_transforms_frame(frame: dict[str, Any], shared: dict[str, Any], name: str) -> tuple[str, Camera]:
    """Parse a frame of a transforms.json, whose camera has OpenGL axes."""
    item = {key: value for values in (shared, frame) for key, value in values.items() if value is not None}
    sides = {"camera_angle_x": item["w"], "camera_angle_y": item["h"]}
    entries = {key: _finite_float(value) for key, value in focal_entries(frame, shared).items()}
    focal = focal_lengths(entries, lambda key: sides[key] / (2 * math.tan(entries[key] / 2)))
    if focal is None:
        raise KeyError("camera_angle_x")
    world_from_camera = rigid_pose(item["transform_matrix"]) @ np.diag([1.0, -1.0, -1.0, 1.0])
    size = {"width": item["w"], "height": item["h"], "fx": focal[0], "fy": focal[1]}
    camera = camera_from_json({**item, **size, "camera_from_world": np.linalg.inv(world_from_camera)})
    return str(item.get("file_path", name)), camera


def check_json_numbers(values: Iterable[Any]) -> None:
    """Raise TypeError unless all values are numbers of JSON: `float` also converts texts and booleans."""
    for value in values:
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise TypeError(f"{value!r:.100} is not a number")


def _finite_float(value: Any) -> float:
    """Convert a value to a float and check that it is finite."""
    value = float(value)
    if not math.isfinite(value):
        raise ValueError(f"the number {value}")
    return value


def _side_length(value: Any) -> int:
    """Check that a side of a picture is a whole number of pixels that can be rendered."""
    if value != int(value) or not 1 <= value <= MAX_IMAGE_SIDE_PIXELS:
        raise ValueError(f"a side of {value} pixels; 1 to {MAX_IMAGE_SIDE_PIXELS} are allowed")
    return int(value)


def _focal_length(value: Any) -> float:
    """Check that a focal length is finite and positive."""
    value = _finite_float(value)
    if not value > 0:
        raise ValueError(f"a focal length of {value} pixels")
    return value


def round_pose(rows: Sequence[Sequence[float]]) -> list[list[float]]:
    """Round a pose of rows (3 or 4) x 4, so that the position of its camera keeps six decimal places.

    The translation is rounded by `round_number`. The rotation has nine significant digits, and as many more as the
    distance d of the camera from the world's origin has digits above 1,000, because its rounding moves the camera in
    proportion to d.
    """
    distance = math.hypot(*(row[3] for row in rows[:3]))
    digits = 9 if distance < 1000 else min(7 + math.ceil(math.log10(distance)), MAX_SIGNIFICANT_DIGITS)
    return [[*(float(f"{x:.{digits}g}") for x in row[:3]), round_number(row[3])] for row in rows]


def round_number(number: float) -> float:
    """Round a number to nine significant digits, or to six decimal places if its magnitude is 1,000 or more.

    Large map coordinates thus keep six decimal places.
    """
    return float(f"{number:.9g}") if abs(number) < 1000 else round(float(number), 6)

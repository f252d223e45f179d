"""Cameras to render from, in JSON files."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hyrfpack.errors import HyrfDataError
from hyrfpack.scene import Camera, rigid_pose

MAX_SIDE = 16384  # pixels; more is a mistake in the file


def cameras_to_json(cameras: Sequence[tuple[str, Camera]]) -> str:
    """Named cameras as the JSON text that `cameras_from_json` reads."""
    return json.dumps(
        [
            {
                "name": name,
                "width": camera.width,
                "height": camera.height,
                "fx": camera.fx,
                "fy": camera.fy,
                "cx": camera.cx,
                "cy": camera.cy,
                "camera_from_world": camera.camera_from_world.tolist(),
            }
            for name, camera in cameras
        ],
        indent=1,
    )


def cameras_from_json(path: str | os.PathLike[str]) -> list[tuple[str, Camera]]:
    """Read named cameras.

    Two forms are understood:

    - ours, a list: `[{"name": "0001", "width": 800, "height": 600, "fx": 700, "fy": 700, "cx": 400, "cy": 300,
      "camera_from_world": [[4 x 4]]}, ...]`, OpenCV axes (x right, y down, z forward). `name` may be left out, `fy`
      then equals `fx`, and `cx`, `cy` the picture's middle;
    - `transforms.json` of nerfstudio and instant-ngp: an object with `frames`, each with a `transform_matrix`
      (world_from_camera, OpenGL axes) and, here or for all frames, `w`, `h` and `fl_x` or `camera_angle_x`. Lens
      distortion is left out: renders are pinhole pictures.

    Raises:
        HyrfDataError: the file cannot be read, or a camera is incomplete or impossible; it is named.
    """
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise HyrfDataError(
            f"{path}: the cameras cannot be read ({error.strerror or error}); check the path"
        ) from error
    except (ValueError, RecursionError) as error:
        raise HyrfDataError(f"{path}: this is not JSON ({error}); name a JSON file of cameras") from error
    if isinstance(content, dict) and isinstance(content.get("frames"), list):
        parse, items, shared = _from_transforms, content["frames"], content
    elif isinstance(content, list):
        parse, items, shared = _from_ours, content, {}
    else:
        raise HyrfDataError(
            f"{path}: there is neither a list of cameras nor 'frames' in it; see `hyrfpack render --help`"
        )
    cameras = []
    for number, item in enumerate(items):
        try:
            cameras.append(parse({**shared, **item}, f"{number:04d}"))
        except KeyError as error:
            raise HyrfDataError(f"{path}: camera {number} has no {error}; add it") from error
        except (TypeError, ValueError, ArithmeticError) as error:
            raise HyrfDataError(f"{path}: camera {number} makes no sense ({error!s:.160}); correct it") from error
    if not cameras:
        raise HyrfDataError(f"{path}: there is no camera in it; add at least one")
    return cameras


def _from_ours(item: dict[str, Any], name: str) -> tuple[str, Camera]:
    width, height = side_length(item["width"]), side_length(item["height"])
    fx = focal_length(item["fx"])
    fy = focal_length(item.get("fy", fx))
    cx, cy = _finite(item.get("cx", width / 2)), _finite(item.get("cy", height / 2))
    return str(item.get("name", name)), Camera(width, height, fx, fy, cx, cy, item["camera_from_world"])


def _from_transforms(item: dict[str, Any], name: str) -> tuple[str, Camera]:
    width, height = side_length(item["w"]), side_length(item["h"])
    if "fl_x" in item:
        fx = focal_length(item["fl_x"])
    else:
        fx = focal_length(width / (2 * math.tan(_finite(item["camera_angle_x"]) / 2)))
    fy = focal_length(item.get("fl_y", fx))
    cx, cy = _finite(item.get("cx", width / 2)), _finite(item.get("cy", height / 2))
    world_from_camera = rigid_pose(item["transform_matrix"]) @ np.diag([1.0, -1.0, -1.0, 1.0])
    name = str(item.get("file_path", name))
    return name, Camera(width, height, fx, fy, cx, cy, np.linalg.inv(world_from_camera))


def side_length(value: Any) -> int:
    """A picture side in whole pixels. Raises ValueError unless it can be rendered."""
    if value != int(value) or not 1 <= value <= MAX_SIDE:
        raise ValueError(f"a side of {value} pixels; 1 to {MAX_SIDE} can be rendered")
    return int(value)


def focal_length(value: Any) -> float:
    """A focal length in pixels. Raises ValueError unless it is positive and finite."""
    value = _finite(value)
    if not value > 0:
        raise ValueError(f"a focal length of {value} pixels")
    return value


def _finite(value: Any) -> float:
    value = float(value)
    if not math.isfinite(value):
        raise ValueError(f"the number {value}")
    return value

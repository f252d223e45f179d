"""What the layouts that keep poses in JSON share: the file, its numbers, its poses."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from hyrfpack.errors import HyrfDataError


def read_object(path: Path) -> dict[str, Any]:
    """Read a JSON file that holds an object.

    Raises:
        HyrfDataError: not to be read, not JSON, or not an object.
    """
    try:
        content = json.loads(path.read_bytes())
    except OSError as error:
        raise HyrfDataError(f"{path}: cannot be read ({error.strerror}); restore the file") from error
    except (ValueError, RecursionError) as error:
        raise HyrfDataError(f"{path}: not valid JSON ({str(error)[:120]}); the file is damaged") from error
    if not isinstance(content, dict):
        raise HyrfDataError(f"{path}: not a JSON object; the file is damaged, or of another program")
    return content


def read_json(path: Path) -> dict[str, Any]:
    """Read a transforms file and check that it has a list of frames, each with a path, which gets slashes.

    Raises:
        HyrfDataError: not to be read, not JSON, or without usable frames.
    """
    content = read_object(path)
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames:
        raise HyrfDataError(f"{path}: has no list of 'frames'; it is not a transforms file, or it is empty")
    for index, frame in enumerate(frames):
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
            raise HyrfDataError(f"{path}: frame {index} has no 'file_path'; correct or remove the frame")
        frame["file_path"] = slashed(frame["file_path"])
    return content


def slashed(path: str) -> str:
    """A path of a file that may have been written on Windows: with slashes in place of backslashes."""
    return path.replace("\\", "/")


def number(entries: dict[str, Any], key: str, path: Path) -> float | None:
    """The finite number under `key`, None where the key is absent."""
    value = entries.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not _is_finite(value):
        raise HyrfDataError(f"{path}: '{key}' is {str(value)[:40]!r} and not a finite number; correct the entry")
    return float(value)


def focal_from_angle(angle: float, size: int, path: Path) -> float:
    """Focal length in pixels of a picture `size` pixels wide that spans `angle` radians: size / (2 tan(angle / 2))."""
    if not 0 < angle < math.pi or 0.5 * angle == 0:  # half of the smallest number is 0
        raise HyrfDataError(
            f"{path}: a field of view of {angle:g} radians is outside (0, pi); correct 'camera_angle_x'"
        )
    return 0.5 * size / math.tan(0.5 * angle)


def pose_from_opengl(frame: dict[str, Any], path: Path) -> np.ndarray:
    """(4, 4) OpenCV camera_from_world of a frame, whose `transform_matrix` is OpenGL's world_from_camera
    (x right, y up, z backward)."""
    try:
        matrix = np.array(frame["transform_matrix"], dtype=np.float64)
    except (KeyError, TypeError, ValueError, OverflowError):
        matrix = np.empty(0)
    if matrix.shape not in ((3, 4), (4, 4)):
        raise HyrfDataError(
            f"{path}: frame {frame['file_path'][:80]} has no 4 x 4 'transform_matrix' of numbers; correct or remove it"
        )
    with np.errstate(invalid="ignore", over="ignore"):
        return inverted(matrix[:3, :3] * (1, -1, -1), matrix[:3, 3])


def inverted(rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    """(4, 4) camera_from_world of a camera with OpenCV axes in the columns of `rotation` that stands at `position`.

    Transposing inverts a rotation, if it is one: `make_scene` refuses a pose that is not.
    """
    pose = np.eye(4)
    with np.errstate(invalid="ignore", over="ignore"):
        pose[:3, :3] = rotation.T
        pose[:3, 3] = -rotation.T @ position
    return pose


def _is_finite(value: float) -> bool:
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer beyond float64
        return False

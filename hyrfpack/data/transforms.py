"""Read JSON files of poses, their numbers and lenses, and convert poses from OpenGL axes; shared by several readers."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from hyrfpack.cameras.files import focal_entries, focal_lengths
from hyrfpack.data.pictures import PictureHeader
from hyrfpack.data.undistort import Lens, brown_coefficients
from hyrfpack.errors import HyrfDataError

_PERSPECTIVE_MODELS = ("OPENCV", "FULL_OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
_FISHEYE_MODELS = ("OPENCV_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_RADIAL_FISHEYE")
_DENOMINATOR_KEYS = ("k4", "k5", "k6")


def read_json_object(path: Path) -> dict[str, Any]:
    """Read a JSON file that holds an object.

    Raises:
        HyrfDataError: the file cannot be read, is not JSON, or does not hold an object.
    """
    try:
        content = json.loads(path.read_bytes())
    except OSError as error:
        raise HyrfDataError(f"{path}: cannot be read ({error.strerror})", fix="restore the file") from error
    except (ValueError, RecursionError) as error:
        raise HyrfDataError(
            f"{path}: not valid JSON ({str(error)[:120]})",
            fix="the file is damaged, restore it",
        ) from error
    if not isinstance(content, dict):
        raise HyrfDataError(f"{path}: not a JSON object", fix="the file is damaged or of another program, restore it")
    return content


def read_transforms(path: Path) -> dict[str, Any]:
    """Read a transforms file and check that it has a list of frames with paths.

    Backslashes in `file_path` are replaced by forward slashes.

    Raises:
        HyrfDataError: the file cannot be read, is not JSON, or has no usable frames.
    """
    content = read_json_object(path)
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames:
        raise HyrfDataError(
            f"{path}: there is no list of 'frames', so this is not a transforms file or it is empty",
            fix="export it again",
        )
    for index, frame in enumerate(frames):
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
            raise HyrfDataError(f"{path}: frame {index} has no 'file_path'", fix="correct or remove the frame")
        frame["file_path"] = with_forward_slashes(frame["file_path"])
    return content


def with_forward_slashes(path: str) -> str:
    """Replace backslashes in a path, which a program on Windows may have written."""
    return path.replace("\\", "/")


def finite_number(entries: dict[str, Any], key: str, path: Path) -> float | None:
    """Return the number under `key`, None if the key is absent.

    Raises:
        HyrfDataError: the value is not a finite number; the message names `path`.
    """
    value = entries.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not _is_finite(value):
        raise HyrfDataError(f"{path}: '{key}' is {str(value)[:40]!r} and not a finite number", fix="correct the entry")
    return float(value)


def focal_from_angle(angle: float, size: int, path: Path, key: str) -> float:
    """Convert a field of view to a focal length in pixels: size / (2 tan(angle / 2)).

    Args:
        angle: field of view in radians.
        size: pixels that the field of view covers.
        path, key: the file and the angle's key in it, for the error message.

    Raises:
        HyrfDataError: the angle is not between 0 and pi.
    """
    if not 0 < angle < math.pi or 0.5 * angle == 0:  # half of the smallest positive float is 0
        raise HyrfDataError(
            f"{path}: a field of view of {angle:g} radians is outside (0, pi)",
            fix=f"correct '{key}'",
        )
    return 0.5 * size / math.tan(0.5 * angle)


def frame_lens(content: dict[str, Any], frame: dict[str, Any], header: PictureHeader, file: Path) -> Lens:
    """Return the lens of a frame, from the frame's own intrinsics or otherwise from those of the file.

    Without a stated size, principal point or distortion, the lens has the size of the picture, its centre and none.

    Raises:
        HyrfDataError: there is no focal length, a number is not usable, or the camera model is not supported.
    """

    def value(key: str) -> float | None:
        own = finite_number(frame, key, file)
        return own if own is not None else finite_number(content, key, file)

    where = f"{file}: frame {frame['file_path'][:80]}"
    width, height = int(value("w") or header.width), int(value("h") or header.height)
    stated = focal_entries(frame, content)
    entries = {key: number for key in stated if (number := finite_number(stated, key, file)) is not None}
    sides = {"camera_angle_x": width, "camera_angle_y": height}
    focal = focal_lengths(entries, lambda key: focal_from_angle(entries[key], sides[key], file, key))
    if focal is None:
        raise HyrfDataError(f"{where} has neither 'fl_x' nor 'camera_angle_x'", fix="add its focal length")
    fx, fy = focal
    cx, cy = value("cx"), value("cy")
    pinhole = (width, height, fx, fy, width / 2 if cx is None else cx, height / 2 if cy is None else cy)

    model = frame.get("camera_model", content.get("camera_model", "OPENCV"))
    if frame.get("is_fisheye", content.get("is_fisheye", False)):
        model = "OPENCV_FISHEYE"
    k1, k2, k3, k4, k5, k6, p1, p2 = (value(key) or 0.0 for key in ("k1", "k2", "k3", *_DENOMINATOR_KEYS, "p1", "p2"))
    if model in _FISHEYE_MODELS:
        return Lens(*pinhole, "fisheye", (k1, k2, k3, k4))
    if model not in _PERSPECTIVE_MODELS:
        raise HyrfDataError(
            f"{where} has camera model {str(model)[:40]!r}, which is not supported",
            fix="undistort the photos first",
        )
    if model in ("PINHOLE", "SIMPLE_PINHOLE"):
        return Lens(*pinhole)
    if model != "FULL_OPENCV" and (k4 or k5 or k6):
        raise HyrfDataError(
            f"{where} has 'k4' or more, which camera model {model} does not define",
            fix="use camera model FULL_OPENCV (rational) or OPENCV_FISHEYE, or set it to 0",
        )
    return Lens(*pinhole, "brown", brown_coefficients(k1, k2, p1, p2, k3, k4, k5, k6))


def pose_from_opengl(frame: dict[str, Any], path: Path) -> np.ndarray:
    """Return the (4, 4) OpenCV camera_from_world of a frame.

    Its `transform_matrix` is a world_from_camera with OpenGL axes (x right, y up, z backward).

    Raises:
        HyrfDataError: the frame has no such matrix.
    """
    try:
        matrix = np.array(frame["transform_matrix"], dtype=np.float64)
    except (KeyError, TypeError, ValueError, OverflowError):
        matrix = np.empty(0)
    if matrix.shape not in ((3, 4), (4, 4)):
        raise HyrfDataError(
            f"{path}: frame {frame['file_path'][:80]} has no 4 x 4 'transform_matrix' of numbers",
            fix="correct or remove it",
        )
    with np.errstate(invalid="ignore", over="ignore"):
        return pose_from_camera_axes(matrix[:3, :3] * (1, -1, -1), matrix[:3, 3])


def pose_from_camera_axes(axes: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Return the (4, 4) camera_from_world of a camera from its axes and its position in the world.

    The axes are inverted by transposition, without a check that they are orthonormal. `assemble_scene` rejects poses
    that are not rigid.

    Args:
        axes: (3, 3) matrix whose columns are the camera's OpenCV axes.
        position: (3,) centre of projection.
    """
    pose = np.eye(4)
    with np.errstate(invalid="ignore", over="ignore"):
        pose[:3, :3] = axes.T
        pose[:3, 3] = -axes.T @ position
    return pose


def _is_finite(value: float) -> bool:
    """Return whether a number is finite as a float64."""
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer beyond float64
        return False

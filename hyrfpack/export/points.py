"""Export of the centres of splats as coloured points, with the cameras as frusta, for any 3D program."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from hyrfpack.errors import HyrfDataError
from hyrfpack.scene import Camera
from hyrfpack.splats.glb import GLTF_UP, LINES_MODE, POINTS_MODE, Shape, encode_shapes, linear_from_srgb
from hyrfpack.splats.placement import choose_local_origin, subtract_origin, upright_rotation
from hyrfpack.splats.splats import Splats

_CAMERA_COLOR = (255, 106, 0, 255)  # orange, because it is rare in photos
_FRUSTUM_DEPTH_PER_CAMERA_DISTANCE = 0.06
_DOTS_PER_EDGE = 16
# One stroke through these vertices draws a frustum: 0 is the apex, 1 to 4 are the corners clockwise from the top left,
# and 5 is a tip that shows which side is up.
_FRUSTUM_STROKE = (4, 0, 1, 2, 3, 4, 1, 5, 2, 0, 3)


def encode_points(splats: Splats, cameras: Sequence[Camera], extension: Literal["glb", "ply"], up: np.ndarray) -> bytes:
    """Encode splats and cameras as points and lines, in the input's axes and units.

    A .glb holds two geometries, the points "gaussians" and the lines "cameras". Their nodes turn them upright, and
    translate them if the scene lies far from the origin compared to its size. A .ply holds vertices only, because few
    programs draw its edges: dotted frusta follow the points, and positions are float64 where float32 would be too
    coarse. Colours are those of degree 0, with the opacity as alpha. The same input gives the same bytes.

    Args:
        splats: splats whose centres become points.
        cameras: any number of cameras.
        extension: format of the file.
        up: (3,) unit vector in world axes that points up in the scene.

    Raises:
        HyrfDataError: there is nothing to show, or positions are beyond float32.
    """
    if not len(splats) and not cameras:
        raise HyrfDataError("there are neither points nor cameras to export", fix="name a model that has some")
    frusta = _make_frusta(cameras, splats.positions)
    origin = choose_local_origin(np.concatenate((splats.positions, frusta.reshape(-1, 3))))
    return _encode_glb(splats, frusta, origin, up) if extension == "glb" else _encode_ply(splats, frusta, origin)


def _encode_glb(splats: Splats, frusta: np.ndarray, origin: np.ndarray, up: np.ndarray) -> bytes:
    shapes = []
    if len(splats):
        colors = np.column_stack((linear_from_srgb(splats.base_colors), splats.opacities)).astype(np.float32)
        points = {"POSITION": subtract_origin(splats, origin), "COLOR_0": colors}
        shapes.append(Shape("gaussians", POINTS_MODE, points))
    if len(frusta):
        ends = np.stack((_FRUSTUM_STROKE[:-1], _FRUSTUM_STROKE[1:]), axis=1).ravel()
        positions = (frusta[:, ends] - origin).reshape(-1, 3).astype(np.float32)
        colors = np.tile(np.array(_CAMERA_COLOR, np.uint8), (len(positions), 1))
        shapes.append(Shape("cameras", LINES_MODE, {"POSITION": positions, "COLOR_0": colors}))
    return encode_shapes(shapes, upright_rotation(up, np.array(GLTF_UP)), origin)


def _encode_ply(splats: Splats, frusta: np.ndarray, origin: np.ndarray) -> bytes:
    ends = frusta[:, _FRUSTUM_STROKE, None]  # (cameras, corners along the stroke, 1, 3)
    steps = np.arange(_DOTS_PER_EDGE)[:, None] / _DOTS_PER_EDGE
    dots = (ends[:, :-1] * (1 - steps) + ends[:, 1:] * steps).reshape(-1, 3)
    number = "double" if origin.any() else "float"
    kind = [("position", "<f8" if origin.any() else "<f4", 3), ("color", "u1", 4)]
    vertices = np.empty(len(splats) + len(dots), kind)
    vertices["position"] = np.concatenate((splats.positions, dots))
    vertices["color"][: len(splats)] = np.round(255 * np.column_stack((splats.base_colors, splats.opacities)))
    vertices["color"][len(splats) :] = _CAMERA_COLOR
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += [f"property {number} {axis}" for axis in "xyz"]
    header += [f"property uchar {channel}" for channel in ("red", "green", "blue", "alpha")]
    return "\n".join((*header, "end_header", "")).encode() + vertices.tobytes()


def _make_frusta(cameras: Sequence[Camera], positions: np.ndarray) -> np.ndarray:
    """Return the world positions (cameras, 6, 3) of each frustum's apex, corners and tip; see _FRUSTUM_STROKE."""
    if not cameras:
        return np.zeros((0, 6, 3))
    centers = np.stack([camera.position for camera in cameras])
    middle = np.median(positions if len(positions) else centers, axis=0)
    depth = (
        _FRUSTUM_DEPTH_PER_CAMERA_DISTANCE * float(np.median(np.linalg.norm(centers - middle, axis=1)))
        or _FRUSTUM_DEPTH_PER_CAMERA_DISTANCE
    )
    frusta = np.empty((len(cameras), 6, 3))
    for frustum, camera in zip(frusta, cameras, strict=True):
        width, height = camera.width, camera.height
        pixels = np.array([(0, 0), (width, 0), (width, height), (0, height), (width / 2, -height / 4)])
        rays = np.column_stack(((pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy), np.ones(len(pixels))))
        frustum[0], frustum[1:] = camera.position, camera.position + depth * rays @ camera.rotation
    return frusta

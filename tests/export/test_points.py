from __future__ import annotations

import io

import numpy as np
import pytest
import trimesh
from scenes import look_at

from hyrfpack.errors import HyrfDataError
from hyrfpack.export.points import encode_points
from hyrfpack.scene import Camera
from hyrfpack.splats.splats import Splats

POSES = [look_at((0, -4, 1), (0, 0, 0)), look_at((3, 2, 1), (0, 0, 0))]
CAMERAS = [Camera(64, 48, 60.0, 60.0, 30.0, 25.0, pose) for pose in POSES]
UP = np.array([0.0, 1.0, 0.0])  # as in glTF: nothing is turned
SQRT_PI = np.sqrt(np.pi)


def grey(count: int = 100, shift=(0.0, 0.0, 0.0)) -> Splats:
    """Of grey levels and opacities 0, 1/255, 2/255, ..."""
    rng = np.random.default_rng(3)
    levels = np.arange(count) / 255
    harmonics = np.repeat((levels[:, None, None] - 0.5) * 2 * SQRT_PI, 3, axis=2)
    quats = np.tile((1.0, 0, 0, 0), (count, 1))
    return Splats(rng.normal(size=(count, 3)) + shift, np.full((count, 3), 0.01), quats, levels, harmonics)


def loaded(data: bytes, extension: str):
    return trimesh.load_scene(io.BytesIO(data), file_type=extension)


def pixels_of(camera: Camera, points: np.ndarray) -> np.ndarray:
    x, y, depth = camera.rotation @ points.T + camera.camera_from_world[:3, 3:]
    return np.stack((camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy), axis=1)


def test_ply_holds_positions_and_colours_in_the_inputs_axes():
    splats = grey()
    cloud = loaded(encode_points(splats, CAMERAS, "ply", UP), "ply").to_geometry()
    np.testing.assert_allclose(cloud.vertices[:100], splats.positions, atol=1e-6)
    np.testing.assert_array_equal(cloud.colors[:100], np.repeat(np.arange(100)[:, None], 4, axis=1))


def test_glb_holds_points_with_linear_colours_and_cameras_as_lines():
    splats = grey()
    scene = loaded(encode_points(splats, CAMERAS, "glb", UP), "glb")
    cloud, lines = scene.geometry["gaussians"], scene.geometry["cameras"]
    assert set(scene.geometry) == {"gaussians", "cameras"}
    np.testing.assert_allclose(cloud.vertices, splats.positions, atol=1e-6)
    np.testing.assert_allclose(cloud.colors[99], [round(255 * ((99 / 255 + 0.055) / 1.055) ** 2.4)] * 3 + [99])
    assert isinstance(lines, trimesh.path.Path3D)


@pytest.mark.parametrize("number", [0, 1])
def test_a_frustum_starts_at_its_camera_and_ends_at_the_corners_of_its_picture(number):
    camera = CAMERAS[number]
    scene = loaded(encode_points(grey(), [camera], "glb", UP), "glb")
    corners = scene.geometry["cameras"].vertices
    away = np.linalg.norm(corners - camera.position, axis=1)
    assert away.min() < 1e-6 and 0.05 < away.max() < 1
    seen = pixels_of(camera, corners[away > 1e-3]).round(3)
    expected = {(0, 0), (64, 0), (64, 48), (0, 48), (32, -12)}  # and the tip above the picture
    assert {tuple(pixel) for pixel in seen + 0.0} == expected


def test_the_dots_of_a_ply_lie_on_the_frusta():
    camera = CAMERAS[0]
    dots = loaded(encode_points(grey(), [camera], "ply", UP), "ply").to_geometry().vertices[100:]
    depths = (dots - camera.position) @ camera.forward
    seen = pixels_of(camera, dots[depths > 1e-3 * depths.max()])
    assert len(dots) == 160 and (seen[:, 1] > -12.1).all()
    inside = (seen[:, 1] > 0.1) & (seen[:, 1] < 47.9) & (seen[:, 0] > 0.1) & (seen[:, 0] < 63.9)
    assert not inside.any()  # edges and sides, nothing across the picture


@pytest.mark.parametrize("extension", ["glb", "ply"])
def test_a_scene_far_away_keeps_its_precision(extension):
    splats = grey(shift=(5e5, -4e6, 100.0))
    scene = loaded(encode_points(splats, [], extension, UP), extension)
    if extension == "glb":
        place, _ = scene.graph["gaussians"]
        points = scene.geometry["gaussians"].vertices + place[:3, 3]
    else:
        points = scene.to_geometry().vertices
    np.testing.assert_allclose(points, splats.positions, rtol=0, atol=2e-6)


@pytest.mark.parametrize("extension", ["glb", "ply"])
def test_the_same_input_makes_the_same_bytes(extension):
    assert encode_points(grey(), CAMERAS, extension, UP) == encode_points(grey(), CAMERAS, extension, UP)


def test_cameras_alone_are_drawn_and_nothing_is_refused():
    assert set(loaded(encode_points(grey(0), CAMERAS, "glb", UP), "glb").geometry) == {"cameras"}
    with pytest.raises(HyrfDataError, match="neither points nor cameras"):
        encode_points(grey(0), [], "ply", UP)


def test_a_glb_stands_upright():
    splats = grey(shift=(0.0, 0.0, 50.0))
    scene = loaded(encode_points(splats, CAMERAS, "glb", np.array([0.0, 0.0, 1.0])), "glb")
    for name in ("gaussians", "cameras"):
        place, _ = scene.graph[name]
        np.testing.assert_allclose(place[:3, :3] @ (0, 0, 1), (0, 1, 0), atol=1e-7)
    place, _ = scene.graph["gaussians"]
    points = scene.geometry["gaussians"].vertices @ place[:3, :3].T + place[:3, 3]
    np.testing.assert_allclose(points[:, 1], splats.positions[:, 2], rtol=0, atol=1e-5)

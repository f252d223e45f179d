from __future__ import annotations

import io

import numpy as np
import pytest
import trimesh
from glb_arrays import read_attribute, srgb_from_linear
from scenes import look_at

from hyrfpack.errors import HyrfDataError
from hyrfpack.export.points import encode_points
from hyrfpack.scene import Camera
from hyrfpack.splats.splats import Splats

CAMERA_POSES = [look_at((0, -4, 1), (0, 0, 0)), look_at((3, 2, 1), (0, 0, 0))]
TEST_CAMERAS = [Camera(64, 48, 60.0, 60.0, 30.0, 25.0, pose) for pose in CAMERA_POSES]
UP_DIRECTION = np.array([0.0, 1.0, 0.0])  # the up axis of glTF, so that nothing is rotated
SQRT_PI = np.sqrt(np.pi)


def grey_splats(count: int = 100, shift=(0.0, 0.0, 0.0)) -> Splats:
    """Return splats with grey levels and opacities of 0, 1/255, 2/255, ..."""
    rng = np.random.default_rng(3)
    levels = np.arange(count) / 255
    harmonics = np.repeat((levels[:, None, None] - 0.5) * 2 * SQRT_PI, 3, axis=2)
    quats = np.tile((1.0, 0, 0, 0), (count, 1))
    return Splats(rng.normal(size=(count, 3)) + shift, np.full((count, 3), 0.01), quats, levels, harmonics)


def load_with_trimesh(data: bytes, extension: str):
    return trimesh.load_scene(io.BytesIO(data), file_type=extension)


def project_points(camera: Camera, points: np.ndarray) -> np.ndarray:
    x, y, depth = camera.rotation @ points.T + camera.camera_from_world[:3, 3:]
    return np.stack((camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy), axis=1)


def test_ply_contains_positions_and_colors_in_the_input_axes():
    splats = grey_splats()
    cloud = load_with_trimesh(encode_points(splats, TEST_CAMERAS, "ply", UP_DIRECTION), "ply").to_geometry()
    np.testing.assert_allclose(cloud.vertices[:100], splats.positions, atol=1e-6)
    np.testing.assert_array_equal(cloud.colors[:100], np.repeat(np.arange(100)[:, None], 4, axis=1))


def test_glb_contains_points_with_linear_colors_and_cameras_as_lines():
    splats = grey_splats()
    data = encode_points(splats, TEST_CAMERAS, "glb", UP_DIRECTION)
    scene = load_with_trimesh(data, "glb")
    cloud, lines = scene.geometry["gaussians"], scene.geometry["cameras"]
    assert set(scene.geometry) == {"gaussians", "cameras"}
    np.testing.assert_allclose(cloud.vertices, splats.positions, atol=1e-6)
    np.testing.assert_allclose(cloud.colors[99], [round(255 * ((99 / 255 + 0.055) / 1.055) ** 2.4)] * 3 + [99])
    colors = read_attribute(data, "COLOR_0")
    np.testing.assert_array_equal(np.round(255 * srgb_from_linear(colors[:, 0])), np.arange(100))
    np.testing.assert_allclose(read_attribute(data, "COLOR_0", mesh=1)[0], np.array([255, 106, 0, 255]) / 255)
    assert isinstance(lines, trimesh.path.Path3D)


@pytest.mark.parametrize("number", [0, 1])
def test_a_frustum_starts_at_its_camera_and_ends_at_the_corners_of_its_picture(number):
    camera = TEST_CAMERAS[number]
    scene = load_with_trimesh(encode_points(grey_splats(), [camera], "glb", UP_DIRECTION), "glb")
    corners = scene.geometry["cameras"].vertices
    away = np.linalg.norm(corners - camera.position, axis=1)
    assert away.min() < 1e-6 and 0.05 < away.max() < 1
    seen = project_points(camera, corners[away > 1e-3]).round(3)
    expected = {(0, 0), (64, 0), (64, 48), (0, 48), (32, -12)}  # the last point is the tip above the picture
    assert {tuple(pixel) for pixel in seen + 0.0} == expected


def test_the_camera_points_of_a_ply_lie_on_the_frusta():
    camera = TEST_CAMERAS[0]
    dots = (
        load_with_trimesh(encode_points(grey_splats(), [camera], "ply", UP_DIRECTION), "ply")
        .to_geometry()
        .vertices[100:]
    )
    depths = (dots - camera.position) @ camera.forward
    seen = project_points(camera, dots[depths > 1e-3 * depths.max()])
    assert len(dots) == 160 and (seen[:, 1] > -12.1).all()
    inside = (seen[:, 1] > 0.1) & (seen[:, 1] < 47.9) & (seen[:, 0] > 0.1) & (seen[:, 0] < 63.9)
    assert not inside.any()  # points lie on edges and sides, none across the picture


@pytest.mark.parametrize("extension", ["glb", "ply"])
def test_a_scene_far_away_keeps_its_precision(extension):
    splats = grey_splats(shift=(5e5, -4e6, 100.0))
    scene = load_with_trimesh(encode_points(splats, [], extension, UP_DIRECTION), extension)
    if extension == "glb":
        place, _ = scene.graph["gaussians"]
        points = scene.geometry["gaussians"].vertices + place[:3, 3]
    else:
        points = scene.to_geometry().vertices
    np.testing.assert_allclose(points, splats.positions, rtol=0, atol=2e-6)


@pytest.mark.parametrize("extension", ["glb", "ply"])
def test_encoding_is_deterministic(extension):
    assert encode_points(grey_splats(), TEST_CAMERAS, extension, UP_DIRECTION) == encode_points(
        grey_splats(), TEST_CAMERAS, extension, UP_DIRECTION
    )


def test_cameras_alone_are_encoded_and_an_empty_scene_is_refused():
    assert set(load_with_trimesh(encode_points(grey_splats(0), TEST_CAMERAS, "glb", UP_DIRECTION), "glb").geometry) == {
        "cameras"
    }
    with pytest.raises(HyrfDataError, match="neither points nor cameras"):
        encode_points(grey_splats(0), [], "ply", UP_DIRECTION)


def test_a_glb_is_upright():
    splats = grey_splats(shift=(0.0, 0.0, 50.0))
    scene = load_with_trimesh(encode_points(splats, TEST_CAMERAS, "glb", np.array([0.0, 0.0, 1.0])), "glb")
    for name in ("gaussians", "cameras"):
        place, _ = scene.graph[name]
        np.testing.assert_allclose(place[:3, :3] @ (0, 0, 1), (0, 1, 0), atol=1e-7)
    place, _ = scene.graph["gaussians"]
    points = scene.geometry["gaussians"].vertices @ place[:3, :3].T + place[:3, 3]
    np.testing.assert_allclose(points[:, 1], splats.positions[:, 2], rtol=0, atol=1e-5)

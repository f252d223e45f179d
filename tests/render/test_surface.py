"""Depth and normals of surfaces: closed forms of planes, spheres and discs, and a scene of known geometry."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scenes import camera_at
from scipy.spatial.transform import Rotation

from hyrfpack.cameras.capture import Capture
from hyrfpack.config.render import GeometryConfig
from hyrfpack.format import describe_file, load_model
from hyrfpack.model import Frame
from hyrfpack.ops.rasterize import Gaussians3D
from hyrfpack.render import RenderSettings
from hyrfpack.render.depth_normals import normals_from_depth
from hyrfpack.render.files import make_renderer
from hyrfpack.render.surface import render_surface
from hyrfpack.scene import Camera
from tools.studies.mesh_error import compute_demo_depth, find_nearest_surface

RAW_FILE = Path(__file__).parents[1] / "golden" / "trained" / "demo.hyrf"
CAMERA = Camera(40, 30, 35.0, 38.0, 18.0, 16.0, np.eye(4))

RASTER_SETTINGS = RenderSettings().raster_settings(antialiased=False)


def rays_of(camera: Camera) -> np.ndarray:
    """Return rays (H, W, 3), camera axes, whose length along the view axis is 1."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5 - camera.cx, np.arange(camera.height) + 0.5 - camera.cy)
    return np.stack((x / camera.fx, y / camera.fy, np.ones(x.shape)), axis=-1)


def plane_depth(camera: Camera, normal: np.ndarray, distance: float) -> np.ndarray:
    """Return the depth (H, W) of the plane n . x = distance, 0 where no ray hits it."""
    along = rays_of(camera) @ normal
    return np.where(along * distance > 1e-9, distance / np.where(along == 0, 1, along), 0)


def angles(normals: np.ndarray, exact: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos(np.clip((normals * exact).sum(axis=-1), -1, 1)))


# -- normals from depth -----------------------------------------------------------------------------------------------


@given(st.floats(-0.7, 0.7), st.floats(-0.7, 0.7), st.floats(1e-3, 1e6))
def test_the_normals_of_a_plane_are_exact_up_to_the_border(tilt_x, tilt_y, distance):
    normal = np.array([tilt_x, tilt_y, 1.0]) / np.linalg.norm([tilt_x, tilt_y, 1.0])
    depth = plane_depth(CAMERA, normal, distance)
    found = normals_from_depth(torch.from_numpy(depth), CAMERA).numpy()
    rays = rays_of(CAMERA)
    is_slanted = np.abs(rays @ normal) < 0.45 * np.linalg.norm(rays, axis=-1)
    assert is_slanted.mean() < 0.7 and np.abs(found + normal)[~is_slanted].max() < 1e-4


@pytest.mark.parametrize("side", [3, 16, 24, 32])
def test_the_normals_of_a_plane_in_a_small_picture_are_exact(side):
    """There the slope limit is so large that it would let samples without depth count."""
    camera, normal = Camera(side, side, side / 2, side / 2, side / 2, side / 2, np.eye(4)), np.array([-0.3, 0, 1.0])
    normal /= np.linalg.norm(normal)

    found = normals_from_depth(torch.from_numpy(plane_depth(camera, normal, 2.0)), camera).numpy()

    assert np.abs(found + normal).max() < 1e-4


def test_the_normals_of_a_sphere_are_those_of_its_surface():
    camera = Camera(160, 120, 140.0, 140.0, 80.0, 60.0, np.eye(4))
    rays = rays_of(camera)
    a, b, c = (rays**2).sum(-1), rays[..., 2] * 5, 24.0  # a unit sphere at (0, 0, 5)
    root = b * b - a * c
    depth = np.where(root > 0, (b - np.sqrt(np.maximum(root, 0))) / a, 0)
    found = normals_from_depth(torch.from_numpy(depth), camera).numpy()
    exact = rays * depth[..., None] - (0, 0, 5)
    facing = (depth > 0) & (-(exact * rays).sum(-1) / np.linalg.norm(rays, axis=-1) > 0.5)
    assert facing.sum() > 50
    assert np.median(angles(found, exact)[facing]) < 5
    assert (found[depth == 0] == 0).all()


def test_surfaces_at_different_depths_do_not_mix():
    left, right = np.array([0.3, 0.0, 1.0]), np.array([-0.5, 0.2, 1.0])
    left, right = left / np.linalg.norm(left), right / np.linalg.norm(right)
    depth = np.where(np.arange(40) < 20, plane_depth(CAMERA, left, 2.0), plane_depth(CAMERA, right, 5.0))
    found = normals_from_depth(torch.from_numpy(depth), CAMERA).numpy()
    assert angles(found[:, :20], -left).max() < 0.1 and angles(found[:, 20:], -right).max() < 0.1


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (7, 1), (2, 2), (700, 3)])
def test_pictures_of_any_size_have_unit_normals_that_face_the_camera(size):
    camera = Camera(*size, 50.0, 50.0, size[0] / 2, size[1] / 2, np.eye(4))
    found = normals_from_depth(torch.full(size[::-1], 3.0, dtype=torch.float64), camera)
    assert torch.allclose(found, torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64), atol=1e-6)


def test_bands_of_rows_do_not_change_the_normals(monkeypatch):
    depth = torch.from_numpy(np.random.default_rng(0).uniform(2, 2.1, (30, 40)))
    whole = normals_from_depth(depth, CAMERA)
    monkeypatch.setattr("hyrfpack.render.depth_normals.MAX_BAND_PIXELS", 100)
    assert torch.allclose(normals_from_depth(depth, CAMERA), whole, atol=1e-12)


# -- surfaces of Gaussians --------------------------------------------------------------------------------------------


def sheet(normal: np.ndarray, count: int = 4000, half: float = 2.0) -> Gaussians3D:
    """Return flat discs that lie in the plane through the origin with a unit normal."""
    across = np.linalg.qr(np.column_stack((normal, np.eye(3)[:, :2])))[0][:, 1:]
    means = np.random.default_rng(0).uniform(-half, half, (count, 2)) @ across.T
    # The quaternion that turns z to the normal.
    quat = np.array([1 + normal[2], -normal[1], normal[0], 0.0])
    return Gaussians3D(
        torch.tensor(means, dtype=torch.float32),
        torch.tensor(quat / np.linalg.norm(quat), dtype=torch.float32).expand(count, 4),
        torch.tensor([0.1, 0.12, 1e-4]).expand(count, 3),
        torch.full((count,), 0.9),
    )


@pytest.mark.parametrize(
    "rotation", [(1.0, 0.0, 0.0, 0.0), (0.8, 0.0, 0.36, 0.48)], ids=["world axes", "rotated frame"]
)
def test_a_sheet_of_discs_has_its_depth_and_normal_in_world_units_and_axes(rotation):
    local_normal = np.array([0.36, -0.48, 0.8])
    frame = Frame((10.0, -20.0, 30.0), 7.0, (1.0, 1.0, 1.0), rotation)
    to_world = Rotation.from_quat(rotation, scalar_first=True)
    normal = to_world.apply(local_normal)
    center = np.array(frame.center)
    camera = camera_at(center + to_world.apply((4, 3, 14)), center, width=48, height=48, focal=90.0)
    depth, normals = render_surface(
        sheet(local_normal, half=1.5), frame, camera, RenderSettings().raster_settings(True), normals=True
    )
    in_camera = camera.rotation @ normal
    exact = plane_depth(camera, in_camera, float(in_camera @ (camera.rotation @ (center - camera.position))))
    assert normals is not None and bool((depth > 0).all())
    assert np.abs(depth.numpy() / exact - 1).max() < 0.02
    assert angles(normals.numpy(), normal).max() < 2
    assert np.abs(np.linalg.norm(normals.numpy(), axis=-1) - 1).max() < 1e-5


def test_where_gaussians_are_too_faint_there_is_neither_depth_nor_normal():
    gaussians = sheet(np.array([0.0, 0.0, 1.0]), count=40, half=0.2)
    camera = camera_at((0, 0, 3), up=(0, 1, 0), width=48, height=48, focal=30.0)
    frame = Frame((0.0, 0.0, 0.0), 1.0, (1.0, 1.0, 1.0))
    depth, normals = render_surface(gaussians, frame, camera, RASTER_SETTINGS, normals=True)
    assert normals is not None and 0 < (depth > 0).sum() < depth.numel()
    assert bool((normals[depth == 0] == 0).all()) and bool((normals[depth > 0].norm(dim=-1) > 0.99).all())


def test_round_gaussians_take_their_normals_from_depth():
    gaussians = sheet(np.array([0.0, 0.0, 1.0]))
    gaussians = gaussians._replace(scales=torch.full((len(gaussians.means), 3), 0.1))
    camera = camera_at((1, 0.5, 4), up=(0, 1, 0), width=48, height=48, focal=80.0)
    frame = Frame((0.0, 0.0, 0.0), 1.0, (1.0, 1.0, 1.0))
    _, normals = render_surface(gaussians, frame, camera, RASTER_SETTINGS, normals=True)
    assert normals is not None
    assert np.median(angles(normals.numpy(), np.array([0.0, 0.0, 1.0]))) < 10


def test_depth_and_normals_of_a_trained_scene_are_near_the_true_ones():
    model = load_model(RAW_FILE)
    draw = make_renderer(model, geometry=GeometryConfig("exr", "exr"))
    depth_errors, normal_errors = [], []
    for camera in Capture(describe_file(RAW_FILE)).cameras[:3]:
        picture, exact = draw(camera), compute_demo_depth(camera)
        assert picture.depth is not None and picture.normals is not None
        near = (exact < 6) & (picture.depth.numpy() > 0)
        points = (rays_of(camera) * exact[..., None])[near]
        _, normals = find_nearest_surface((points - camera.camera_from_world[:3, 3]) @ camera.rotation)
        depth_errors.append(np.abs(picture.depth.numpy() - exact)[near] / exact[near])
        normal_errors.append(angles(picture.normals.numpy()[near], normals))
    assert np.median(np.concatenate(depth_errors)) < 0.04
    assert np.median(np.concatenate(normal_errors)) < 25

"""Splats that JavaScript fits to a model solve the documented least squares and look like the model."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scenes import ball_points, ring, small_model
from web.fields.test_fields import random_model
from web.scripts import run_script

import hyrfpack
from hyrfpack.cameras.files import camera_to_json
from hyrfpack.cameras.paths import Viewpoint, orbit
from hyrfpack.cameras.placement import Placement
from hyrfpack.cameras.view_sampling import shrink_camera
from hyrfpack.edit.transform import move_model
from hyrfpack.export.bake import RIDGE_WEIGHT, SPHERE_DIRECTIONS, SPHERE_WEIGHT, bake
from hyrfpack.export.measure import measure_psnr
from hyrfpack.model import Frame, HybridModel
from hyrfpack.ops.harmonics import harmonics_basis, num_sh_bases
from hyrfpack.ops.rasterize.cull import frustum_cull
from hyrfpack.ops.shade import encode_directions
from hyrfpack.render import RenderSettings
from hyrfpack.scene import Camera
from hyrfpack.splats.harmonics import SH_C0, fibonacci_sphere
from hyrfpack.splats.splats import Splats

FIT_SCRIPT = Path(__file__).parent / "fit.mjs"


def fit_in_node(model: HybridModel, cameras: list[Camera] | None, degree: int, tmp_path: Path) -> tuple[Splats, dict]:
    """Fit splats in node; return them in world units, with the JSON object that the script prints.

    `cameras` None uses the cameras of the file.
    """
    file, viewpoints, out = tmp_path / "model.hyrf", tmp_path / "cameras.json", tmp_path / "splats"
    hyrfpack.save_model(model, file)
    viewpoints.write_text(json.dumps(None if cameras is None else [camera_to_json(camera) for camera in cameras]))
    facts: dict[str, Any] = run_script(FIT_SCRIPT, file, viewpoints, degree, out)
    count, others, data = facts["count"], num_sh_bases(degree) - 1, out.read_bytes()
    numbers = np.frombuffer(data, "<f4", 14 * count)
    packed = np.frombuffer(data, np.uint8, offset=56 * count).reshape(count, others, 3)
    positions, scales, quats, opacities, colors = np.split(numbers, np.cumsum([3, 3, 4, 1]) * count)
    harmonics = np.empty((count, others + 1, 3), np.float32)
    harmonics[:, 0] = (colors.reshape(count, 3) - 0.5) / SH_C0
    harmonics[:, 1:] = (packed - np.float32(128)) / 128 * facts["range"]
    splats = Splats(
        positions.reshape(count, 3).astype(np.float64) * facts["unit"] + facts["center"],
        scales.reshape(count, 3) * np.float32(facts["unit"]),
        quats.reshape(count, 4).copy(),
        opacities.copy(),
        harmonics,
        facts["antialiased"],
    )
    return splats, facts


def solve_least_squares(model: HybridModel, cameras: list[Camera], degree: int) -> np.ndarray:
    """Solve for the expected harmonics (N, K, 3) in float64."""
    model = model.double()
    positions, count = model.gaussians.positions.detach(), len(model)
    with torch.no_grad():
        scales = model.decode_geometry().scales.sort(dim=1).values
    sphere = fibonacci_sphere(SPHERE_DIRECTIONS)
    weights = torch.zeros(count, len(cameras), dtype=torch.float64)
    directions = torch.zeros(count, len(cameras), 3, dtype=torch.float64)
    settings = RenderSettings()
    for number, camera in enumerate(cameras):
        viewport = model.config.frame.local_viewport(camera, torch.float64)
        pose = viewport.pose
        seen = frustum_cull(positions, viewport, settings.near, settings.cull_tolerance)
        depths = positions @ pose[2, :3] + pose[2, 3]
        area = 2 * torch.pi * (camera.fx * camera.fy * scales[:, 1] * scales[:, 2] / depths.square() + 0.3)
        weights[seen, number] = area.clamp_max(camera.width * camera.height)[seen]
        directions[:, number] = positions + pose[:3, :3].T @ pose[:3, 3]
    directions /= directions.norm(dim=-1, keepdim=True)
    weights /= weights.sum(1, keepdim=True).clamp_min(1e-300)
    directions = torch.cat((directions, sphere.expand(count, -1, -1)), 1)
    weights = torch.cat((weights, torch.full((count, len(sphere)), SPHERE_WEIGHT / len(sphere))), 1).double()
    solved = np.empty((count, num_sh_bases(degree), 3))
    coords, penalty = model.cube_coords(positions), RIDGE_WEIGHT**0.5 * np.eye(num_sh_bases(degree))[1:]
    for i in range(count):
        encoded = encode_directions(directions[i], model.config.direction_encoding)
        with torch.no_grad():
            logits = model.radiance(coords[i].expand(len(encoded), 3), encoded) + model.gaussians.color_logits[i]
        roots = weights[i].sqrt().numpy()[:, None]
        rows = np.concatenate((harmonics_basis(directions[i], degree).numpy() * roots, penalty))
        wanted = np.concatenate(((torch.sigmoid(logits).numpy() - 0.5) * roots, np.zeros((len(penalty), 3))))
        solved[i] = np.linalg.lstsq(rows, wanted, rcond=None)[0]
    return solved


@pytest.mark.parametrize("degree", [3, *(pytest.param(degree, marks=pytest.mark.acceptance) for degree in (0, 1, 2))])
def test_harmonics_solve_the_least_squares_over_views_and_sphere(degree: int, tmp_path: Path) -> None:
    model = random_model(300, antialiased=True)
    at = np.array(model.config.frame.center)
    cameras = ring(9, radius=6.0, target=(0, 0, 0), width=50, height=40)
    cameras = [Camera(50, 40, *c.intrinsics, move_pose(c, at)) for c in cameras]

    splats, facts = fit_in_node(model, cameras, degree, tmp_path)
    expected = solve_least_squares(random_model(300, antialiased=True), cameras, degree)

    np.testing.assert_allclose(splats.harmonics[:, 0], expected[:, 0], atol=2e-5)
    most = facts["range"]
    inside = np.clip(expected[:, 1:], -most, most * 127 / 128)
    np.testing.assert_allclose(splats.harmonics[:, 1:], inside, atol=most / 255)
    assert (np.abs(expected[:, 1:]) > most).sum() <= 2e-3 * expected[:, 1:].size
    assert splats.antialiased and facts["degree"] == degree


def test_splats_of_a_rotated_model_are_those_of_the_straight_one_in_its_axes(tmp_path: Path) -> None:
    model, cameras = random_model(300), ring(9, radius=6.0, target=(0, 0, 0), width=50, height=40)
    step = Placement.rotation_about_axis((0.3, -1.0, 0.4), 130)

    before, _ = fit_in_node(model, cameras, 2, tmp_path)
    after, facts = fit_in_node(move_model(step, model), [step.move_camera(camera) for camera in cameras], 2, tmp_path)

    np.testing.assert_allclose(Frame((0, 0, 0), 1.0, (1, 1, 1), tuple(facts["rotation"])).axes, step.rotation)
    np.testing.assert_allclose(facts["center"], step.move_point(model.config.frame.center), rtol=1e-9)
    np.testing.assert_array_equal(after.quats, before.quats)
    np.testing.assert_allclose(
        after.positions - facts["center"], before.positions - model.config.frame.center, rtol=0, atol=1e-13
    )
    np.testing.assert_allclose(after.harmonics, before.harmonics, atol=facts["range"] / 100)


def move_pose(camera: Camera, offset: np.ndarray) -> np.ndarray:
    """Return the camera's pose after a translation by `offset` in world units."""
    pose = camera.camera_from_world.copy()
    pose[:3, 3] -= pose[:3, :3] @ offset
    return pose


def test_shapes_equal_the_model_and_coarse_colors_those_of_the_first_view(tmp_path: Path) -> None:
    model, cameras = random_model(600), ring(3)

    splats, facts = fit_in_node(model, cameras, 1, tmp_path)

    frame = model.config.frame
    geometry = model.double().decode_geometry()
    np.testing.assert_allclose(splats.positions, frame.to_world(model.gaussians.positions.detach().numpy()), rtol=1e-6)
    np.testing.assert_allclose(splats.scales, geometry.scales.detach().numpy() * frame.scale, rtol=1e-6)
    np.testing.assert_allclose(splats.opacities, geometry.opacities.detach().numpy(), rtol=1e-6)
    assert facts["progress"] == sorted(facts["progress"]) and facts["progress"][-1] == 1
    place = (torch.from_numpy(cameras[0].position) - torch.tensor(frame.center)) / frame.scale
    seen = model.decode_colors(place).detach().numpy()[:10]
    np.testing.assert_allclose(np.reshape(facts["coarse"]["colors"], (10, 3)), seen, atol=1e-5)
    assert facts["coarse"]["after"] == len(facts["progress"]) // 2


def ball_model() -> HybridModel:
    points, colors = ball_points(800)
    logits = np.log(colors / (1 - colors).clip(1e-3)).astype(np.float32)
    return small_model(points, fields=0.6, color_logits=logits, scale_logits=-2.5)


def test_fitted_splats_match_the_model_as_well_as_splats_baked_in_python(tmp_path: Path) -> None:
    cameras = ring(24, width=64, height=48)

    splats, _ = fit_in_node(ball_model(), cameras, 3, tmp_path)

    model = ball_model()
    contenders = {"page": (splats, None), "bake": (bake(model, cameras, (3,))[3], None)}
    views = [(camera, None) for camera in ring(7, elevation=0.8, width=64, height=48)]
    scores = measure_psnr(model, contenders, views, sphere=False)
    assert scores["page"].model > scores["bake"].model - 0.5
    assert scores["page"].model > 35


def test_a_file_without_cameras_is_fitted_from_an_orbit(tmp_path: Path) -> None:
    splats, _ = fit_in_node(ball_model(), None, 2, tmp_path)

    model = ball_model()
    around = orbit(Viewpoint.from_frame(model.config.frame.center, model.config.frame.scale), 7)
    views = [(shrink_camera(camera, 64), None) for camera in around]
    assert measure_psnr(model, {"page": (splats, None)}, views, sphere=False)["page"].model > 35


def test_a_model_without_gaussians_has_no_splats(tmp_path: Path) -> None:
    splats, facts = fit_in_node(small_model(np.zeros((0, 3))), ring(2), 3, tmp_path)
    assert len(splats) == 0 and facts["coarse"] is None


def test_a_model_with_infinite_scales_is_refused(tmp_path: Path) -> None:
    model = random_model(5)
    with torch.no_grad():
        model.gaussians.positions.fill_(3e38)  # with a half-axis of 1/4, scales exceed float32
    with pytest.raises(AssertionError, match=r"HyrfFormatError: The shape of a Gaussian is not a finite number.*"):
        fit_in_node(model, ring(2), 1, tmp_path)

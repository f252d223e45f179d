"""The adapter for three.js adds a file's splats to a scene, where they look as in `hyrfpack.render_view`."""

from __future__ import annotations

import io
import json
import shutil
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from scenes import ball_points, ring, small_model
from scipy.spatial.transform import Rotation
from web.fields.test_harmonics import fit_in_node
from web.pages import wait_until
from web.scripts import run_script
from web.served import serve_project

import hyrfpack
from hyrfpack.cameras.capture import provenance_cameras
from hyrfpack.cameras.paths import Viewpoint
from hyrfpack.edit.transform import replace_config
from hyrfpack.evaluate.metrics import psnr
from hyrfpack.model import Frame, HybridModel
from hyrfpack.render import render_view
from hyrfpack.scene import Camera
from tools.browser.chromium import Chromium, find_program

PROJECT_FOLDER = Path(__file__).parents[3]
NODE_MODULES = PROJECT_FOLDER / "tests" / "node" / "node_modules"
MODEL_CENTER, MODEL_SCALE = np.array([40.0, -3.0, 7.0]), 2.0
PICTURE_SIZE_PIXELS = 256


@pytest.fixture(scope="module")
def app_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Copy the example and install three and hyrf.js beside it."""
    if not (NODE_MODULES / "three").is_dir():
        pytest.skip("three is not installed (npm ci --prefix tests/node)")
    app_folder = shutil.copytree(PROJECT_FOLDER / "examples" / "three", tmp_path_factory.mktemp("three") / "app")
    shutil.copy(Path(__file__).with_name("describe.mjs"), app_folder)
    (app_folder / "node_modules").mkdir()
    (app_folder / "node_modules" / "three").symlink_to(NODE_MODULES / "three")
    (app_folder / "node_modules" / "hyrf.js").symlink_to(PROJECT_FOLDER / "hyrfpack" / "web" / "hyrf")
    return app_folder


def make_model(count: int = 1200, **settings: Any) -> HybridModel:
    points, colors = ball_points(count)
    logits = np.log(colors / (1 - colors).clip(1e-3)).astype(np.float32)
    frame = Frame(tuple(MODEL_CENTER), MODEL_SCALE, (1.0, 1.0, 1.0))
    settings = {"scale_logits": -3.0, "opacity_logits": 3.0, "antialiased": True, **settings}
    return small_model(points, frame=frame, fields=0.5, color_logits=logits, **settings)


def cameras_around_model(count: int) -> list[Camera]:
    """Return cameras on a ring around the model, with z up."""
    cameras = []
    for camera in ring(
        count,
        radius=3.0 * MODEL_SCALE,
        elevation=1.2 * MODEL_SCALE,
        width=PICTURE_SIZE_PIXELS,
        height=PICTURE_SIZE_PIXELS,
    ):
        pose = camera.camera_from_world.copy()
        pose[:3, 3] -= pose[:3, :3] @ MODEL_CENTER
        cameras.append(Camera(PICTURE_SIZE_PIXELS, PICTURE_SIZE_PIXELS, *camera.intrinsics, pose))
    return cameras


def save_model(model: HybridModel, file: Path) -> Path:
    cameras = cameras_around_model(10)
    provenance = {"cameras": provenance_cameras(cameras), "viewpoint": Viewpoint.from_cameras(cameras).to_json()}
    hyrfpack.save_model(model, file, provenance=provenance)
    return file


def describe_in_node(app_folder: Path, file: Path, degree: int) -> dict:
    return run_script(app_folder / "describe.mjs", file, degree)


@pytest.mark.parametrize("degree", [3, *(pytest.param(degree, marks=pytest.mark.acceptance) for degree in (0, 1))])
def test_a_loaded_file_has_the_fitted_splats(app_folder: Path, tmp_path: Path, degree: int) -> None:
    found = describe_in_node(app_folder, save_model(make_model(), tmp_path / "scene.hyrf"), degree)

    splats, facts = fit_in_node(make_model(), cameras_around_model(10), degree, tmp_path)
    assert found["meshes"] == 1 and found["early"] == 1
    assert found["progress"] == sorted(found["progress"]) and found["progress"][-1] == 1
    np.testing.assert_allclose(found["places"], splats.positions, rtol=1e-6)
    assert found["unit"] == pytest.approx(MODEL_SCALE)
    turn = torch.from_numpy(splats.quats).double()
    w, x, y, z = turn.T.numpy()
    rows = [[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]]  # fmt: skip
    axes = np.moveaxis(np.array(rows), -1, 0) * (splats.scales / MODEL_SCALE)[:, None, :]
    covariances = (axes @ axes.transpose(0, 2, 1))[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    np.testing.assert_allclose(np.reshape(found["covariances"], (-1, 6)), covariances, rtol=1e-4, atol=1e-9)
    colors = np.reshape(found["colors"], (-1, 4)) / 255
    np.testing.assert_allclose(colors[:, :3], splats.base_colors, atol=0.51 / 255)
    np.testing.assert_allclose(colors[:, 3], splats.opacities, atol=0.51 / 255)
    for band in (1, 2, 3):
        packed = np.array(found["bands"][band - 1], np.float64)
        if band > degree:
            assert not packed.size
            continue
        wanted = splats.harmonics[:, band**2 : (band + 1) ** 2].reshape(len(splats), -1)
        read = (packed.reshape(len(splats), -1)[:, : wanted.shape[1]] - 128) / 128
        np.testing.assert_allclose(read, np.clip(wanted, -1, 1), atol=1 / 127)
    assert facts["count"] == 1200


def test_splats_and_camera_of_a_rotated_model_are_in_the_axes_of_the_world(app_folder: Path, tmp_path: Path) -> None:
    model, quat = make_model(40), (0.5, -0.1, 0.7, 0.5)
    rotated = replace_config(model, frame=replace(model.config.frame, rotation=quat))
    found = describe_in_node(app_folder, save_model(rotated, tmp_path / "scene.hyrf"), 0)

    turn = Rotation.from_quat([*quat[1:], quat[0]]).as_matrix()
    local = model.gaussians.positions.detach().double().numpy()
    np.testing.assert_allclose(found["places"], MODEL_CENTER + MODEL_SCALE * local @ turn.T, atol=1e-4)
    np.testing.assert_allclose(found["eye"], cameras_around_model(10)[0].position, rtol=1e-5)


def test_the_camera_of_three_is_the_first_camera_of_the_file(app_folder: Path, tmp_path: Path) -> None:
    found = describe_in_node(app_folder, save_model(make_model(9), tmp_path / "scene.hyrf"), 0)

    camera = cameras_around_model(10)[0]
    np.testing.assert_allclose(found["eye"], camera.position, rtol=1e-5)
    np.testing.assert_allclose(found["forward"], camera.forward, atol=1e-5)
    np.testing.assert_allclose(found["up"], [0, 1, 0], atol=1e-6)
    assert found["fov"] == pytest.approx(np.degrees(2 * np.arctan(PICTURE_SIZE_PIXELS / 2 / camera.fy)))
    assert found["sphere"] is None


@pytest.mark.acceptance
def test_a_background_becomes_a_sphere_with_the_same_colors(app_folder: Path, tmp_path: Path) -> None:
    model = make_model(5, background=True)
    found = describe_in_node(app_folder, save_model(model, tmp_path / "scene.hyrf"), 0)

    pixels = np.reshape(found["sphere"], (512, 1024, 4)) / 255
    forward = np.array([0.0, 1.0, 0.0])  # from the centre along y, the top of three's sphere
    pose = np.eye(4)
    pose[:3, :3] = [[1, 0, 0], [0, 0, -1], forward]
    pose[:3, 3] = -pose[:3, :3] @ MODEL_CENTER
    camera = Camera(1, 1, 5e4, 5e4, 0.5, 0.5, pose)
    seen = (
        render_view(small_model(np.zeros((0, 3)), **field_settings()), camera, background=True)
        .rgb[0, 0]
        .detach()
        .numpy()
    )
    np.testing.assert_allclose(pixels[-1, :, :3].mean(0), seen, atol=0.02)


def field_settings() -> dict[str, Any]:
    return {"frame": Frame(tuple(MODEL_CENTER), MODEL_SCALE, (1.0, 1.0, 1.0)), "fields": 0.5, "background": True}


@pytest.mark.acceptance
@pytest.mark.skipif(find_program() is None, reason="there is no Chromium on this machine")
def test_the_example_page_shows_the_rendered_picture(app_folder: Path, tmp_path: Path) -> None:
    save_model(make_model(), app_folder / "scene.hyrf")
    flags = ("--enable-unsafe-swiftshader", "--use-angle=swiftshader")
    with serve_project(app_folder) as address, Chromium(*flags) as browser:
        browser.resize(PICTURE_SIZE_PIXELS, PICTURE_SIZE_PIXELS)
        browser.open(f"{address}/own/harmonics.html?webgl&file=scene.hyrf")
        ends = time.monotonic() + 60
        while (status := browser.evaluate("document.getElementById('status').textContent")) != "" or browser.evaluate(
            "!document.querySelector('canvas')"
        ):
            assert time.monotonic() < ends, (status, browser.list_errors())
            time.sleep(0.2)
        time.sleep(1.5)  # lets the page draw some frames
        picture = np.array(Image.open(io.BytesIO(browser.screenshot())).convert("RGB"), np.float32) / 255
        complaints = browser.list_errors()
        browser.resize(PICTURE_SIZE_PIXELS, PICTURE_SIZE_PIXELS, pixel_ratio=2)  # as on another screen
        wait_until(browser, f"document.querySelector('canvas').width === {2 * PICTURE_SIZE_PIXELS}")

    own = render_view(make_model(), cameras_around_model(10)[0]).rgb.detach()
    assert not [line for line in complaints if "WebGPU" not in line], json.dumps(complaints)
    assert psnr(torch.from_numpy(picture), own) > 28
    assert psnr(own.mean((0, 1)).expand_as(own), own) < 20  # the picture is not nearly uniform

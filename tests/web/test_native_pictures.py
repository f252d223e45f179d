"""Native pages, with a `.hyrf` file inside, draw the same pictures as `hyrfpack.render_view`, at any valid camera."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from web.native_models import (
    MODEL_FRAME,
    ONE_LEVEL_GRID,
    SCENE_CENTER,
    SIXTEEN_LEVEL_GRID,
    UP_DIRECTION,
    encode_with_photos,
    load_page,
    make_cameras,
    make_model_page,
    random_model,
    read_texture,
    read_typed_array,
    render_reference,
)
from web.pages import Browser, psnr, render_in_page

from hyrfpack.cameras.capture import provenance_cameras
from hyrfpack.cameras.files import camera_from_json
from hyrfpack.format.codec import decode_model, encode_model
from hyrfpack.model import HybridModel
from hyrfpack.render import RenderSettings
from hyrfpack.scene import Camera
from hyrfpack.web.html import encode_model_page

MODEL_SETTINGS = {
    "usual": {},
    "harmonics, product, solid": {"direction_encoding": "sh", "scale_rule": "product", "background": False},
    "sixteen levels, antialiased": {
        "geometry": SIXTEEN_LEVEL_GRID,
        "radiance": SIXTEEN_LEVEL_GRID,
        "antialiased": True,
    },
    "one level, 3 hidden": {"geometry": ONE_LEVEL_GRID, "radiance": ONE_LEVEL_GRID, "hidden": 3},
    "100 hidden, even scales": {"hidden": 100, "scale_grows": False, "direction_encoding": "sh"},
    "residuals": {"residual_degree": 3},
    "residuals of one harmonic, antialiased": {"residual_degree": 0, "antialiased": True},
}


@pytest.mark.in_turn
@pytest.mark.parametrize(
    "case",
    [pytest.param("usual", marks=pytest.mark.smoke), *(name for name in MODEL_SETTINGS if name != "usual")],
)
def test_pictures_geometry_and_colors_equal_those_of_the_model(browser: Browser, tmp_path: Path, case: str):
    model = random_model(**MODEL_SETTINGS[case])
    load_page(browser, tmp_path, make_model_page(model), complete=False)
    camera = make_cameras()[0]
    render_in_page(browser, camera)
    check_geometry_and_colors(browser, model, camera)
    scores = [psnr(render_in_page(browser, camera), render_reference(model, camera)) for camera in make_cameras()]
    assert min(scores) > 45 and browser.list_errors() == [], scores


def test_a_page_of_a_rotated_model_shows_it_from_cameras_in_world_axes(browser: Browser, tmp_path: Path):
    """The pixel sizes, the background, links, picked points and the window's camera all depend on the rotation."""
    model = random_model(frame=replace(MODEL_FRAME, rotation=(0.5, -0.1, 0.7, 0.5)))
    cameras = make_cameras()
    data = encode_model(model, provenance={"cameras": provenance_cameras(cameras)})
    model = decode_model(data)  # it has pixel sizes
    load_page(browser, tmp_path, make_model_page(model, data))
    near = replace(cameras[2], fx=150.0, fy=150.0)

    scores = [psnr(render_in_page(browser, camera), render_reference(model, camera)) for camera in (*cameras, near)]

    assert min(scores) > 45, scores
    render_in_page(browser, cameras[0])
    shown = camera_from_json(browser.evaluate("hyrfpack.camera()"))
    np.testing.assert_allclose(shown.camera_from_world, cameras[0].camera_from_world, rtol=0, atol=1e-5)
    up = browser.evaluate("hyrfpack.player.eye.up")
    np.testing.assert_allclose(model.config.frame.axes @ up, UP_DIRECTION, rtol=0, atol=1e-12)
    target = browser.evaluate("hyrfpack.player.eye.center")
    np.testing.assert_allclose(model.config.frame.to_world(np.array(target)), SCENE_CENTER, rtol=0, atol=1e-9)
    assert browser.list_errors() == []


def check_geometry_and_colors(browser: Browser, model: HybridModel, camera: Camera) -> None:
    """Compare the textures of the page, which has shown this camera alone, with the model."""
    count = len(model)
    places, shapes = (read_texture(browser, name, 2048, 4)[:count] for name in ("places", "shapes"))
    halves = np.ascontiguousarray(read_texture(browser, "colors", 2048, 2)[:count]).view(np.float16)[:, :3]
    with torch.no_grad():
        geometry = model.decode_geometry()
        eye = torch.tensor(model.config.frame.to_local(camera.position), dtype=torch.float32)
        colors = model.decode_colors(eye).numpy()
    np.testing.assert_array_equal(places[:, :3].copy().view(np.float32), model.gaussians.positions.detach().numpy())
    packed = np.stack((shapes[:, 2] & 0xFFFF, shapes[:, 2] >> 16, places[:, 3] >> 16), -1)
    np.testing.assert_allclose(packed / 65535 * 44 - 22, geometry.scales.log().numpy(), atol=1e-3)
    np.testing.assert_allclose((places[:, 3] & 0xFFFF) / 65535, geometry.opacities.numpy(), atol=1e-4)
    quats = np.ascontiguousarray(shapes[:, :2]).view(np.int16) / 32767
    expected = torch.nn.functional.normalize(geometry.quats, dim=-1).numpy()
    np.testing.assert_allclose(quats, expected, atol=1e-4)
    seen = halves.any(axis=1)  # Gaussians outside the picture get no colours
    assert seen.mean() > 0.5
    np.testing.assert_allclose(halves[seen].astype(np.float32), colors[seen], atol=1e-3)


@pytest.mark.in_turn
def test_a_model_without_gaussians_shows_its_background(browser: Browser, tmp_path: Path):
    model = random_model(0)
    load_page(browser, tmp_path, make_model_page(model))
    for camera in make_cameras():  # 8 bits allow 58.9 dB
        assert psnr(render_in_page(browser, camera), render_reference(model, camera)) > 57


@pytest.mark.in_turn
def test_the_window_at_rest_has_the_exact_background(browser: Browser, tmp_path: Path):
    model = random_model(300)
    load_page(browser, tmp_path, make_model_page(model))
    window = "hyrfpack.player.renderer.read(hyrfpack.player.view(), [1, 1, 1])"
    shown = read_typed_array(browser, window, np.uint8)
    camera = camera_from_json(browser.evaluate("hyrfpack.camera()"))
    assert psnr(shown.reshape(camera.height, camera.width, 3), render_reference(model, camera)) > 50


@pytest.mark.parametrize("is_antialiased", [False, True])
def test_pictures_larger_than_the_photos_show_no_finer_detail(browser: Browser, tmp_path: Path, is_antialiased: bool):
    model = random_model(4000, antialiased=is_antialiased)
    model.gaussians.scale_logits.data -= 2
    data = encode_with_photos(model, background_stride=1)
    load_page(browser, tmp_path, make_model_page(model, data), complete=False)
    settings, filtered = RenderSettings(background_threshold=0.0), decode_model(data)
    for camera in make_cameras()[:2]:
        shown = render_in_page(browser, camera)
        assert psnr(shown, render_reference(filtered, camera, settings)) > 55
        assert psnr(shown, render_reference(model, camera)) < 40
    sizes = np.ascontiguousarray(read_texture(browser, "shapes", 2048, 4)[: len(model), 3]).view(np.float32)
    assert filtered.gaussians.pixel_sizes is not None
    np.testing.assert_allclose(sizes, filtered.gaussians.pixel_sizes.numpy(), rtol=1e-5)


@pytest.mark.in_turn
@pytest.mark.parametrize("stride", [1, 3, 40])
def test_the_background_is_interpolated_between_nodes_as_far_apart_as_in_training(
    browser: Browser, tmp_path: Path, stride: int
):
    model = random_model(30)
    data = encode_with_photos(model, background_stride=stride)
    load_page(browser, tmp_path, make_model_page(model, data))
    browser.evaluate("hyrfpack.player.pause()")  # frames of the window have another stride
    for camera in make_cameras():
        expected = render_reference(decode_model(data), camera, RenderSettings(background_threshold=0.0))
        assert psnr(render_in_page(browser, camera), expected) > 55
    assert browser.evaluate("hyrfpack.player.renderer.content.sky.stride") == min(64, 3 * stride)


INVALID_CAMERA_FIELDS = {
    "needs width": "camera_from_world: [camera_from_world.slice(0, 3).flat()]",
    "fx and fy": "fx: -100",
    "rotation": "camera_from_world: camera_from_world.map((row) => row.map((value) => 2 * value))",
    "be a rotation": "camera_from_world: camera_from_world.map((row, r) => (r ? row : row.map((value) => -value)))",
    "pixels at most": "width: 8193",
}


@pytest.mark.parametrize("sentence", INVALID_CAMERA_FIELDS)
def test_invalid_cameras_are_refused(one_browser: Browser, tmp_path: Path, sentence: str):
    load_page(one_browser, tmp_path, make_model_page(random_model(50)))
    before = one_browser.evaluate("JSON.stringify(hyrfpack.camera())")
    show = "(({ camera_from_world, ...rest }) => hyrfpack.player.show({ ...rest, camera_from_world, %s }))"
    script = f"{show % INVALID_CAMERA_FIELDS[sentence]}(hyrfpack.camera()).then(() => '', (error) => error.message)"
    assert sentence in one_browser.evaluate(script)
    assert one_browser.evaluate("JSON.stringify(hyrfpack.camera())") == before


def test_cameras_may_be_larger_than_the_largest_picture(one_browser: Browser, tmp_path: Path):
    model = random_model(50)
    large = [replace(camera, width=12000, height=9000) for camera in make_cameras()]
    facts = {"count": 50, "frame": MODEL_FRAME, "solid": model.config.solid, "up": UP_DIRECTION, "center": SCENE_CENTER}
    load_page(one_browser, tmp_path, encode_model_page(encode_model(model), title="large", cameras=large, **facts))
    assert one_browser.evaluate("hyrfpack.player.cameras[0].width") == 12000

"""Pages play merged files: several models in one order of depth, each with its own exposure."""

from __future__ import annotations

import base64
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from exposures import map_with_gains
from web.native_models import (
    MODEL_FRAME,
    SCENE_CENTER,
    UP_DIRECTION,
    load_page,
    make_cameras,
    make_near_parts,
    random_model,
    render_reference,
    with_frame,
)
from web.pages import Browser, camera_json, psnr, render_in_page

from hyrfpack.format import encode_model
from hyrfpack.format.parts import encode_parts
from hyrfpack.model import Frame, HybridModel
from hyrfpack.model.merged import MergedModel
from hyrfpack.render import RenderSettings
from hyrfpack.scene import Camera
from hyrfpack.web.html import encode_model_page

EXACT = RenderSettings(background_threshold=0.0, background_stride=1, transmittance_min=0.0)
# Beside the scene, larger, and turned by 120 degrees about the diagonal.
OTHER_FRAME = Frame((16.0, -18.0, 6.0), 5.0, (1.0, 0.7, 1.0), (0.5, 0.5, 0.5, 0.5))


def make_parts(*, exposures: bool = False) -> MergedModel:
    """Return a scene with a background sphere and two other models of other sizes, one among its Gaussians."""
    scene = random_model(2600)
    # More than a row of the textures, and another shape of the fields.
    beside = random_model(2100, seed=1, hidden=8, direction_encoding="sh", background=False)
    beside = with_frame(beside, OTHER_FRAME)
    inside = random_model(50, seed=2, residual_degree=1)
    inside = with_frame(inside, Frame(MODEL_FRAME.center, 3.0, (1.0, 1.0, 1.0)))
    if exposures:
        for model, gain in ((scene, 0.8), (beside, 1.7)):
            gains = np.linspace(gain, gain + 0.4, len(make_cameras()))[:, None]
            model.exposure = map_with_gains(make_cameras(), model.config.frame, gains)
    return MergedModel(("scene", "beside", "inside"), (scene, beside, inside))


def make_page(model: MergedModel, cameras: list[Camera], **more: Any) -> bytes:
    data = encode_parts(list(zip(model.names, map(encode_model, model.parts), strict=True)))
    config = model.scene.config
    facts = {"count": len(model), "frame": config.frame, "solid": config.solid, "title": "parts"}
    return encode_model_page(data, cameras=cameras, up=UP_DIRECTION, center=SCENE_CENTER, **facts, **more)


@pytest.mark.parametrize("exposures", [False, True])
def test_pictures_equal_those_of_the_merged_model(browser: Browser, tmp_path: Path, exposures: bool):
    model = make_parts(exposures=exposures)
    load_page(browser, tmp_path, make_page(model, make_cameras()))

    scores = []
    for camera in make_cameras():
        scores.append(psnr(render_in_page(browser, camera), render_reference(model, camera, EXACT)))

    assert min(scores) > 45 and browser.list_errors() == [], scores
    assert browser.evaluate("hyrfpack.player.hasExposureMap") is exposures


def test_near_gaussians_are_culled_in_the_units_of_their_part(browser: Browser, tmp_path: Path):
    model, camera = make_near_parts(scale=0.05, depth=0.004)
    load_page(browser, tmp_path, make_page(model, [camera]))
    reference = render_reference(model, camera, EXACT)
    assert psnr(reference, render_reference(model.scene, camera, EXACT)) < 20  # The part is in the picture.
    assert psnr(render_in_page(browser, camera), reference) > 45


def test_the_consistent_exposure_ignores_the_maps_of_all_parts(browser: Browser, tmp_path: Path):
    model = make_parts(exposures=True)
    load_page(browser, tmp_path, make_page(model, make_cameras()))
    browser.evaluate("void (hyrfpack.player.exposure = 'consistent')")
    camera, settings = make_cameras()[0], replace(EXACT, exposure="consistent")

    consistent = render_reference(model, camera, settings)
    assert psnr(render_in_page(browser, camera), consistent) > 45
    assert psnr(render_reference(model, camera, EXACT), consistent) < 35


def test_a_point_is_picked_on_the_nearest_part(browser: Browser, tmp_path: Path):
    scene = random_model(2600)
    with torch.no_grad():
        scene.gaussians.opacity_logits.fill_(-20)
    wall = make_opaque_gaussian(with_frame(random_model(1), Frame((10.0, -20.0, 5.0), 2.0, (1.0, 1.0, 1.0))))
    camera = make_cameras()[0]
    load_page(browser, tmp_path, make_page(MergedModel(("scene", "wall"), (scene, wall)), [camera]))
    browser.evaluate(f"hyrfpack.player.show({camera_json(camera)}).then(() => true)")

    point = browser.evaluate(
        "(({player}) => { const {canvas, scene} = player;"
        " const p = player.findPoint(canvas.clientWidth / 2, canvas.clientHeight / 2);"
        " return p && p.map((value, axis) => scene.center[axis] + scene.unit * value); })(hyrfpack)"
    )

    depth = camera.rotation @ np.array(wall.config.frame.center) + camera.camera_from_world[:3, 3]
    picked = camera.rotation @ np.array(point) + camera.camera_from_world[:3, 3]
    assert abs(picked[2] - depth[2]) < 0.1 * depth[2]


def make_opaque_gaussian(model: HybridModel) -> HybridModel:
    """Turn a model of one Gaussian into a large opaque one at the centre of its frame."""
    with torch.no_grad():
        model.gaussians.positions.zero_()
        model.gaussians.opacity_logits.fill_(20)
        model.gaussians.scale_logits.fill_(0)
    return model


def test_damage_in_a_part_is_reported(browser: Browser, tmp_path: Path):
    model = make_parts()
    load_page(browser, tmp_path, make_page(model, make_cameras()))
    damaged = bytearray(encode_parts(list(zip(model.names, map(encode_model, model.parts), strict=True))))
    damaged[-200] ^= 1
    text = base64.b64encode(damaged).decode()

    message = browser.evaluate(
        f"""(() => {{
            const bytes = Uint8Array.from(atob("{text}"), (letter) => letter.charCodeAt(0));
            const stream = (async function* () {{ yield bytes; }})();
            return hyrfpack.player.open({{ name: "x.hyrf", stream }}).then(() => "", (error) => error.message);
        }})()"""
    )

    assert "checksum" in message and "x.hyrf" in message

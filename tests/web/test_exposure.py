"""The player draws both exposures as `hyrfpack.render_view` does, and its control switches between them."""

from __future__ import annotations

import base64
import dataclasses
import io
from pathlib import Path

import numpy as np
import pytest
import torch
from exposures import random_map
from PIL import Image
from web.native_models import (
    EXACT_SETTINGS,
    MODEL_FRAME,
    load_page,
    lose_and_restore_device,
    make_cameras,
    make_model_page,
    random_model,
    run_statements,
    store_file_in_page,
    wait_until_complete,
)  # fmt: skip
from web.pages import (
    Browser,
    make_splats_page,
    open_page,
    psnr,
    random_splats,
    render_in_page,
    wait_for_message,
    wait_until,
    window_camera,
)
from web.test_sources import Site, serve_site

from hyrfpack.cameras.capture import provenance_cameras
from hyrfpack.choices import AS_PHOTOGRAPHED, CONSISTENT_EXPOSURE, RENDER_EXPOSURES
from hyrfpack.export import export_model
from hyrfpack.format import encode_model, save_model
from hyrfpack.format.container import read_container
from hyrfpack.model import HybridModel
from hyrfpack.model.exposure import ExposureMap
from hyrfpack.render import render_view
from hyrfpack.scene import Camera
from hyrfpack.web.player import encode_element_script, encode_player
from tools.safety.synthetic_encoding import encode

MAX_LOG_GAIN = 1.0
BUTTON_PRESSED_JS = "document.getElementById('exposure').getAttribute('aria-pressed')"
CONTROLS_SHOWN_JS = "[...document.querySelectorAll('[data-needs-map]')].every((part) => !part.hidden)"
CONTROLS_HIDDEN_JS = "[...document.querySelectorAll('[data-needs-map]')].every((part) => part.hidden)"
EXPOSURE_JS = "hyrfpack.player.exposure"


def visible_map(seed: int = 4) -> ExposureMap:
    """Return a random map whose gains differ widely between viewpoints and channels."""
    exposure = random_map(seed, 30)
    limits = np.array([[-MAX_LOG_GAIN] * 3, [MAX_LOG_GAIN] * 3], np.float32)
    return dataclasses.replace(
        exposure,
        box=np.array([[-2.0] * 3, [2.0] * 3], np.float32),
        lengths=np.array([0.8, 0.8], np.float32),
        limits=limits,
        steps=np.full(3, 1e-3, np.float32),
    )


def random_model_with_map(count: int = 2600, **config: object) -> HybridModel:
    model = random_model(count, **config)
    model.exposure = visible_map()
    return model


def render_reference(model: HybridModel, camera: Camera, exposure: str) -> np.ndarray:
    """Return the picture of `hyrfpack.render_view`, (H, W, 3) in 0 to 255."""
    with torch.no_grad():
        settings = dataclasses.replace(EXACT_SETTINGS, exposure=exposure)
        return render_view(model, camera, settings).rgb.clamp(0, 1).numpy() * 255


def set_exposure(browser: Browser, exposure: str) -> None:
    run_statements(browser, f"{EXPOSURE_JS} = '{exposure}';")


def open_complete_page(browser: Browser, tmp_path: Path, page: bytes, address: str = "") -> Browser:
    """Open a page in the browser and wait until its picture is complete."""
    open_page(browser, tmp_path, page, address)
    wait_until_complete(browser)
    return browser


# ---- pictures


ROTATED_FRAME = dataclasses.replace(MODEL_FRAME, rotation=(0.5, -0.1, 0.7, 0.5))


@pytest.mark.parametrize(
    "config", [{}, {"background": False}, {"frame": ROTATED_FRAME}], ids=["background", "solid", "rotated"]
)
def test_both_exposures_look_as_in_hyrfpack_render(browser: Browser, tmp_path: Path, config: dict):
    model = random_model_with_map(**config)
    load_page(browser, tmp_path, make_model_page(model))
    assert browser.evaluate(EXPOSURE_JS) == AS_PHOTOGRAPHED
    pictures = {}
    for exposure in RENDER_EXPOSURES:
        set_exposure(browser, exposure)
        pictures[exposure] = [render_in_page(browser, camera) for camera in make_cameras()]
        pairs = zip(pictures[exposure], make_cameras(), strict=True)
        scores = [psnr(picture, render_reference(model, camera, exposure)) for picture, camera in pairs]
        assert min(scores) > 45, (exposure, scores)
    apart = [psnr(one.astype(float), other) for one, other in zip(*pictures.values(), strict=True)]
    assert max(apart) < 25, "the map of this test changes too little"
    assert browser.list_errors() == []


@pytest.mark.in_turn
def test_a_consistent_picture_equals_that_of_the_model_without_its_map(browser: Browser, tmp_path: Path):
    model = random_model_with_map()
    load_page(browser, tmp_path, make_model_page(model))
    set_exposure(browser, CONSISTENT_EXPOSURE)
    with_map = [render_in_page(browser, camera) for camera in make_cameras()]
    model.exposure = None
    load_page(browser, tmp_path, make_model_page(model))
    np.testing.assert_array_equal([render_in_page(browser, camera) for camera in make_cameras()], with_map)


@pytest.mark.in_turn
def test_gains_follow_the_viewpoint_of_the_window(browser: Browser, tmp_path: Path):
    model = random_model_with_map(200)
    load_page(browser, tmp_path, make_model_page(model))
    seen = []
    for end in [(121, 90), (200, 110), (40, 160)]:
        browser.drag((120, 90), end)
        pose = model.config.frame.local_pose(window_camera(browser))
        gains = browser.evaluate("hyrfpack.player.exposureOf(hyrfpack.player.view()).gains")
        np.testing.assert_allclose(gains, model.exposure.predict_gains(pose), rtol=1e-9)
        seen.append(gains)
    assert np.ptp(seen, axis=0).max() > 0.05


@pytest.mark.in_turn
def test_moving_and_switching_decode_nothing_and_a_still_picture_draws_nothing(browser: Browser, tmp_path: Path):
    load_page(browser, tmp_path, make_model_page(random_model_with_map(200)))
    run_statements(
        browser,
        "const { player } = hyrfpack; window.content = player.renderer.content; window.messages = [];"
        "const { worker } = player.loader.connection.shared, post = worker.postMessage.bind(worker);"
        "worker.postMessage = (data, ...rest) => (messages.push(...Object.keys(data)), post(data, ...rest));",
    )
    browser.drag((120, 90), (200, 110))
    wait_until_complete(browser)
    browser.press("x")
    wait_until_complete(browser)
    assert browser.evaluate("hyrfpack.player.renderer.content === content")
    assert set(browser.evaluate("messages")) == {"reader", "sort"}
    frames = browser.evaluate("hyrfpack.frames()")
    browser.evaluate("new Promise((done) => setTimeout(done, 400))")
    assert browser.evaluate("hyrfpack.frames()") == frames


def read_saved_picture(browser: Browser) -> np.ndarray:
    """Return the picture that the page saves of its window, (H, W, 3)."""
    text = "((bytes) => btoa(Array.from(bytes, (byte) => String.fromCharCode(byte)).join('')))"
    bytes_of = (
        f"hyrfpack.player.capture().then((blob) => blob.arrayBuffer()).then((all) => {text}(new Uint8Array(all)))"
    )
    with Image.open(io.BytesIO(base64.b64decode(browser.evaluate(bytes_of)))) as picture:
        return np.asarray(picture.convert("RGB"), np.float64)


@pytest.mark.in_turn
@pytest.mark.parametrize("exposure", RENDER_EXPOSURES)
def test_saved_pictures_and_the_window_have_the_chosen_exposure(browser: Browser, tmp_path: Path, exposure: str):
    model = random_model_with_map()
    browser.prefer(reduced_motion=True)  # so that the canvas appears at once
    open_complete_page(browser, tmp_path, make_model_page(model), "?noui")  # so that no notes cover the canvas
    set_exposure(browser, exposure)
    wait_until_complete(browser)
    saved, camera = read_saved_picture(browser), window_camera(browser)
    assert psnr(saved, render_reference(model, camera, exposure)) > 40
    with Image.open(io.BytesIO(browser.screenshot())) as window:
        on_screen = np.asarray(window.convert("RGB"), np.float64)
    browser.prefer()
    assert psnr(on_screen, saved) > 40


@pytest.mark.in_turn
def test_fitted_harmonics_of_weak_devices_use_the_exposure_map(browser: Browser, tmp_path: Path):
    model = random_model_with_map(400, frame=ROTATED_FRAME)
    with torch.no_grad():  # degree 3 can represent such colours
        model.radiance.weights[0][:, model.radiance.grid.feature_count :] *= 0.1
    load_page(browser, tmp_path, make_model_page(model).replace(b'{"kind": "hyrf"', b'{"plain": true, "kind": "hyrf"'))
    assert browser.evaluate("Boolean(hyrfpack.player.renderer.content.harmonics)")
    for exposure in RENDER_EXPOSURES:
        set_exposure(browser, exposure)
        scores = [
            psnr(render_in_page(browser, camera), render_reference(model, camera, exposure))
            for camera in make_cameras()
        ]
        assert min(scores) > 26, (exposure, scores)


@pytest.mark.in_turn
def test_the_map_survives_the_loss_of_the_device(browser: Browser, tmp_path: Path):
    model = random_model_with_map(300)
    load_page(browser, tmp_path, make_model_page(model))
    lose_and_restore_device(browser)
    camera = make_cameras()[0]
    assert psnr(render_in_page(browser, camera), render_reference(model, camera, AS_PHOTOGRAPHED)) > 45


@pytest.mark.in_turn
def test_the_first_layer_of_a_file_is_shown_with_its_map(browser: Browser, tmp_path: Path):
    model = random_model_with_map(14000)
    data = encode(model, "compact")
    entries = read_container(data).entries
    first = max(entry.end for tag, entry in entries.items() if tag[-1].isalpha())
    load_page(browser, tmp_path, make_model_page(random_model(50)))
    store_file_in_page(browser, data)
    run_statements(
        browser,
        "window.contents = []; const { player } = hyrfpack; player.addEventListener('loaded', () => {"
        "  contents.push([player.renderer.content.count, player.exposureOf(player.view()).gains]);"
        "  window.sendRest?.(); });",
    )
    browser.evaluate(
        "hyrfpack.player.open({ name: 'x.hyrf', stream: (async function* () {"
        f"  yield file.slice(0, {first + 8}); await new Promise((resolve) => (window.sendRest = resolve));"
        f"  yield file.slice({first + 8}); }})() }}).then(() => true)"
    )
    (count, gains), *_ = browser.evaluate("contents")
    pose = model.config.frame.local_pose(window_camera(browser))
    assert count < 14000
    np.testing.assert_allclose(gains, model.exposure.predict_gains(pose), rtol=1e-9)


# ---- control


@pytest.fixture
def wide_browser(browser: Browser):
    browser.resize(1280, 800)
    yield browser
    browser.resize(240, 180)


@pytest.mark.in_turn
def test_key_and_button_switch_the_exposure_and_announce_it(wide_browser: Browser, tmp_path: Path):
    open_complete_page(wide_browser, tmp_path, make_model_page(random_model_with_map(100)))
    assert wide_browser.evaluate(CONTROLS_SHOWN_JS) and wide_browser.evaluate(BUTTON_PRESSED_JS) == "true"
    wide_browser.evaluate("document.getElementById('menu').click()")
    button = "document.getElementById('exposure')"
    assert wide_browser.evaluate(f"{button}.checkVisibility() && {button}.textContent") == "Exposure as photographed"
    heard = "document.getElementById('status').textContent"

    wide_browser.press("x")
    assert (wide_browser.evaluate(EXPOSURE_JS), wide_browser.evaluate(BUTTON_PRESSED_JS)) == (
        CONSISTENT_EXPOSURE,
        "false",
    )
    assert wide_browser.evaluate(heard) == "Exposure: consistent"
    wide_browser.evaluate(f"{button}.focus()")
    wide_browser.press("Enter")
    assert (wide_browser.evaluate(EXPOSURE_JS), wide_browser.evaluate(BUTTON_PRESSED_JS)) == (AS_PHOTOGRAPHED, "true")
    assert wide_browser.evaluate(heard) == "Exposure: as photographed"
    wide_browser.press("?")
    assert wide_browser.evaluate(
        "[...document.querySelectorAll('#help dd[data-needs-map]')].every((entry) => entry.checkVisibility())"
    )
    wide_browser.press("Escape")


@pytest.mark.in_turn
def test_a_finger_switches_the_exposure(wide_browser: Browser, tmp_path: Path):
    wide_browser.resize(390, 844, phone=True)
    open_complete_page(wide_browser, tmp_path, make_model_page(random_model_with_map(100)))
    wide_browser.evaluate("document.getElementById('menu').click()")
    box = wide_browser.evaluate(
        "(({ left, right, top, bottom }) => [left, right, top, bottom])"
        "(document.getElementById('exposure').getBoundingClientRect())"
    )
    left, right, top, bottom = box
    wide_browser.touch("touchStart", ((left + right) / 2, (top + bottom) / 2))
    wide_browser.touch("touchEnd")
    wait_until(wide_browser, f"{EXPOSURE_JS} === '{CONSISTENT_EXPOSURE}' && {BUTTON_PRESSED_JS} === 'false'")


@pytest.mark.in_turn
def test_files_without_a_map_offer_no_control(browser: Browser, tmp_path: Path):
    for page in (make_model_page(random_model(50)), make_splats_page(random_splats(50))):
        open_complete_page(browser, tmp_path, page)
        assert browser.evaluate(CONTROLS_HIDDEN_JS) and not browser.evaluate("hyrfpack.player.hasExposureMap")
        browser.press("x")
        assert browser.evaluate(EXPOSURE_JS) == AS_PHOTOGRAPHED


@pytest.mark.in_turn
def test_the_control_depends_on_the_opened_file_and_the_choice_is_kept(browser: Browser, tmp_path: Path):
    model = random_model_with_map(50)
    open_complete_page(browser, tmp_path, make_model_page(model))
    set_exposure(browser, CONSISTENT_EXPOSURE)
    opening = "hyrfpack.player.open({ name: 'x.hyrf', stream: (async function* () { yield file.slice(); })() })"
    store_file_in_page(browser, encode_model(random_model(60)))
    browser.evaluate(f"{opening}.then(() => true)")
    assert browser.evaluate(CONTROLS_HIDDEN_JS)
    store_file_in_page(browser, encode_model(model))
    browser.evaluate(f"{opening}.then(() => true)")
    assert browser.evaluate(CONTROLS_SHOWN_JS) and browser.evaluate(BUTTON_PRESSED_JS) == "false"


@pytest.mark.in_turn
def test_scripts_cannot_set_an_unknown_exposure(browser: Browser, tmp_path: Path):
    open_complete_page(browser, tmp_path, make_model_page(random_model_with_map(50)))
    script = f"(() => {{ try {{ {EXPOSURE_JS} = 'bright'; return ''; }} catch (error) {{ return error.message; }} }})()"
    assert browser.evaluate(script) == "The exposure must be as-photographed or consistent, not bright."
    assert browser.evaluate(EXPOSURE_JS) == AS_PHOTOGRAPHED


# ---- addresses and other pages


@pytest.mark.acceptance
@pytest.mark.in_turn
@pytest.mark.parametrize("exposure", RENDER_EXPOSURES)
def test_the_address_chooses_the_exposure(browser: Browser, tmp_path: Path, exposure: str):
    model = random_model_with_map(300)
    open_complete_page(browser, tmp_path, make_model_page(model), f"?exposure={exposure}")
    assert browser.evaluate(EXPOSURE_JS) == exposure
    camera = make_cameras()[1]
    assert psnr(render_in_page(browser, camera), render_reference(model, camera, exposure)) > 45


@pytest.mark.in_turn
def test_an_unknown_exposure_in_the_address_is_reported_and_the_scene_is_shown(browser: Browser, tmp_path: Path):
    open_complete_page(browser, tmp_path, make_model_page(random_model_with_map(50)), "?exposure=bright")
    assert wait_for_message(browser) == "The exposure in the address must be as-photographed or consistent, not bright."
    assert browser.evaluate(EXPOSURE_JS) == AS_PHOTOGRAPHED


@pytest.mark.in_turn
def test_a_shared_link_contains_the_chosen_exposure(browser: Browser, tmp_path: Path):
    page = make_model_page(random_model_with_map(50))
    open_complete_page(browser, tmp_path, page, "?noui&title=mine")
    for exposure, search in (
        (CONSISTENT_EXPOSURE, "?noui=&title=mine&exposure=consistent"),
        (AS_PHOTOGRAPHED, "?noui=&title=mine"),
    ):
        browser.press("x")
        browser.press("l")
        wait_until(browser, f"location.hash.startsWith('#camera=') && location.search === '{search}'")
        link = browser.evaluate("location.search + location.hash")
        open_complete_page(browser, tmp_path, page, link)
        assert browser.evaluate(EXPOSURE_JS) == exposure and browser.evaluate("document.title") == "mine"


@pytest.mark.in_turn
def test_a_shared_link_of_a_file_without_a_map_contains_no_exposure(browser: Browser, tmp_path: Path):
    open_complete_page(browser, tmp_path, make_model_page(random_model(50)), "?exposure=consistent")
    browser.press("l")
    wait_until(browser, "location.hash.startsWith('#camera=') && location.search === ''")


@pytest.fixture
def host():
    """Serve a player beside a file with an exposure map."""
    with serve_site() as server:
        server.files = {
            "/index.html": encode_player("player"),
            "/scene.hyrf": encode_model(random_model_with_map(60)),
            "/hyrf-viewer.js": encode_element_script(),
        }
        yield server


@pytest.mark.in_turn
def test_the_element_has_an_exposure_attribute(browser: Browser, host: Site):
    host.files["/post.html"] = (
        b"<!DOCTYPE html><script src=hyrf-viewer.js></script>"
        b'<hyrf-viewer frame src="scene.hyrf" exposure="consistent"></hyrf-viewer>'
    )
    element = "document.querySelector('hyrf-viewer')"
    inside = f"{element}.shadowRoot.querySelector('iframe').contentWindow.hyrfpack?.player"
    browser.open(f"{host.address}/post.html")
    wait_until(browser, f"{inside}?.loaded && {inside}.hasExposureMap && {inside}.exposure === '{CONSISTENT_EXPOSURE}'")
    browser.evaluate(f"{element}.removeAttribute('exposure')")
    wait_until(browser, f"{inside}?.loaded && {inside}.exposure === '{AS_PHOTOGRAPHED}'")


# ---- exported pages


@pytest.mark.in_turn
@pytest.mark.parametrize("target", ["page.html", "player"])
def test_an_exported_page_contains_the_map_and_its_poster_is_as_photographed(
    browser: Browser, tmp_path: Path, host: Site, target: str
):
    model, kept = random_model_with_map(200), make_cameras()
    save_model(model, tmp_path / "model.hyrf", provenance={"cameras": provenance_cameras(kept)})
    export_model(tmp_path / "model.hyrf", tmp_path / target)
    folder = tmp_path / target if target == "player" else tmp_path
    host.files = {f"/{path.name}": path.read_bytes() for path in folder.iterdir() if path.is_file()}
    browser.open(f"{host.address}/{'index.html' if target == 'player' else target}")
    browser.evaluate("hyrfpack.ready")
    assert browser.evaluate(CONTROLS_SHOWN_JS)
    pictures = [render_in_page(browser, camera) for camera in kept]
    assert min(psnr(p, render_reference(model, c, AS_PHOTOGRAPHED)) for p, c in zip(pictures, kept, strict=True)) > 45

    if target == "player":
        poster = np.asarray(Image.open(folder / "poster.jpg").convert("RGB"), np.float64)
        first = dict(
            zip(
                RENDER_EXPOSURES,
                (render_reference(model, kept[0], exposure) for exposure in RENDER_EXPOSURES),
                strict=True,
            )
        )
        assert poster.shape == first[AS_PHOTOGRAPHED].shape
        assert psnr(poster, first[AS_PHOTOGRAPHED]) > psnr(poster, first[CONSISTENT_EXPOSURE]) + 5

"""The exposure map in the player: the pictures of `hyrfpack.render_view` at both exposures, and the control."""

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
from web.pages import Browser, cloud, eye, message, opened, psnr, shown, until
from web.pages import page_of as page_of_splats
from web.test_native import (
    EXACT,
    cameras,
    keep_file,
    loaded,
    made_up,
    page_of,
    run,
    settled,
    taken_away,
)  # fmt: skip
from web.test_sources import Site, site

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

LARGEST_LOG_GAIN = 1.0
PRESSED = "document.getElementById('exposure').getAttribute('aria-pressed')"
OFFERED = "[...document.querySelectorAll('[data-needs-map]')].every((part) => !part.hidden)"
HIDDEN = "[...document.querySelectorAll('[data-needs-map]')].every((part) => part.hidden)"
MODE = "hyrfpack.player.exposure"


def visible_map(seed: int = 4) -> ExposureMap:
    """A random map whose gains differ widely between viewpoints and channels."""
    exposure = random_map(seed, 30)
    limits = np.array([[-LARGEST_LOG_GAIN] * 3, [LARGEST_LOG_GAIN] * 3], np.float32)
    return dataclasses.replace(
        exposure,
        box=np.array([[-2.0] * 3, [2.0] * 3], np.float32),
        lengths=np.array([0.8, 0.8], np.float32),
        limits=limits,
        steps=np.full(3, 1e-3, np.float32),
    )


def mapped(count: int = 2600, **config: object) -> HybridModel:
    model = made_up(count, **config)
    model.exposure = visible_map()
    return model


def expected(model: HybridModel, camera: Camera, exposure: str) -> np.ndarray:
    """(H, W, 3) by hyrfpack.render_view, in 0 to 255."""
    with torch.no_grad():
        settings = dataclasses.replace(EXACT, exposure=exposure)
        return render_view(model, camera, settings).rgb.clamp(0, 1).numpy() * 255


def choose(browser: Browser, exposure: str) -> None:
    run(browser, f"{MODE} = '{exposure}';")


def reopened(browser: Browser, tmp_path: Path, page: bytes, address: str = "") -> Browser:
    """The page in the browser, its picture complete."""
    opened(browser, tmp_path, page, address)
    settled(browser)
    return browser


# ---- pictures


@pytest.mark.parametrize("config", [{}, {"background": False}], ids=["background", "solid"])
def test_both_exposures_look_as_hyrfpack_renders_them(browser: Browser, tmp_path: Path, config: dict):
    model = mapped(**config)
    loaded(browser, tmp_path, page_of(model))
    assert browser.evaluate(MODE) == AS_PHOTOGRAPHED
    pictures = {}
    for exposure in RENDER_EXPOSURES:
        choose(browser, exposure)
        pictures[exposure] = [shown(browser, camera) for camera in cameras()]
        pairs = zip(pictures[exposure], cameras(), strict=True)
        scores = [psnr(picture, expected(model, camera, exposure)) for picture, camera in pairs]
        assert min(scores) > 45, (exposure, scores)
    apart = [psnr(one.astype(float), other) for one, other in zip(*pictures.values(), strict=True)]
    assert max(apart) < 25, "the map of this test changes too little"
    assert browser.list_errors() == []


@pytest.mark.in_turn
def test_a_consistent_picture_is_that_of_the_model_without_its_map(browser: Browser, tmp_path: Path):
    model = mapped()
    loaded(browser, tmp_path, page_of(model))
    choose(browser, CONSISTENT_EXPOSURE)
    with_map = [shown(browser, camera) for camera in cameras()]
    model.exposure = None
    loaded(browser, tmp_path, page_of(model))
    np.testing.assert_array_equal([shown(browser, camera) for camera in cameras()], with_map)


@pytest.mark.in_turn
def test_gains_are_those_of_the_viewpoint_of_the_window_and_follow_it(browser: Browser, tmp_path: Path):
    model = mapped(200)
    loaded(browser, tmp_path, page_of(model))
    seen = []
    for end in [(121, 90), (200, 110), (40, 160)]:
        browser.drag((120, 90), end)
        pose = model.config.frame.local_pose(eye(browser))
        gains = browser.evaluate("hyrfpack.player.gains(hyrfpack.player.view())")
        np.testing.assert_allclose(gains, model.exposure.predict_gains(pose), rtol=1e-9)
        seen.append(gains)
    assert np.ptp(seen, axis=0).max() > 0.05


@pytest.mark.in_turn
def test_moving_and_switching_decode_nothing_again_and_a_still_picture_costs_nothing(browser: Browser, tmp_path: Path):
    loaded(browser, tmp_path, page_of(mapped(200)))
    run(
        browser,
        "const { player } = hyrfpack; window.content = player.renderer.content; window.asked = [];"
        "const { worker } = player.loader, post = worker.postMessage.bind(worker);"
        "worker.postMessage = (data, ...more) => (asked.push(...Object.keys(data)), post(data, ...more));",
    )
    browser.drag((120, 90), (200, 110))
    settled(browser)
    browser.press("x")
    settled(browser)
    assert browser.evaluate("hyrfpack.player.renderer.content === content")
    assert set(browser.evaluate("asked")) == {"sort"}
    frames = browser.evaluate("hyrfpack.frames()")
    browser.evaluate("new Promise((done) => setTimeout(done, 400))")
    assert browser.evaluate("hyrfpack.frames()") == frames


def saved_picture(browser: Browser) -> np.ndarray:
    """What the page's capture of the window holds, (H, W, 3)."""
    text = "((bytes) => btoa(Array.from(bytes, (byte) => String.fromCharCode(byte)).join('')))"
    bytes_of = (
        f"hyrfpack.player.capture().then((blob) => blob.arrayBuffer()).then((all) => {text}(new Uint8Array(all)))"
    )
    with Image.open(io.BytesIO(base64.b64decode(browser.evaluate(bytes_of)))) as picture:
        return np.asarray(picture.convert("RGB"), np.float64)


@pytest.mark.in_turn
@pytest.mark.parametrize("exposure", RENDER_EXPOSURES)
def test_saved_pictures_and_the_window_have_the_chosen_exposure(browser: Browser, tmp_path: Path, exposure: str):
    model = mapped()
    browser.prefer(less_motion=True)  # the canvas appears at once
    reopened(browser, tmp_path, page_of(model), "?noui")  # without notes in front of it
    choose(browser, exposure)
    settled(browser)
    saved, camera = saved_picture(browser), eye(browser)
    assert psnr(saved, expected(model, camera, exposure)) > 40
    with Image.open(io.BytesIO(browser.screenshot())) as window:
        on_screen = np.asarray(window.convert("RGB"), np.float64)
    browser.prefer()
    assert psnr(on_screen, saved) > 40


@pytest.mark.in_turn
def test_fitted_harmonics_of_weak_devices_are_exposed_too(browser: Browser, tmp_path: Path):
    model = mapped(400)
    with torch.no_grad():  # colours that degree 3 can hold
        model.radiance.weights[0][:, model.radiance.grid.feature_count :] *= 0.1
    loaded(browser, tmp_path, page_of(model).replace(b'{"kind": "hyrf"', b'{"plain": true, "kind": "hyrf"'))
    assert browser.evaluate("Boolean(hyrfpack.player.renderer.content.harmonics)")
    for exposure in RENDER_EXPOSURES:
        choose(browser, exposure)
        scores = [psnr(shown(browser, camera), expected(model, camera, exposure)) for camera in cameras()]
        assert min(scores) > 26, (exposure, scores)


@pytest.mark.in_turn
def test_the_map_survives_the_loss_of_the_device(browser: Browser, tmp_path: Path):
    model = mapped(300)
    loaded(browser, tmp_path, page_of(model))
    taken_away(browser)
    camera = cameras()[0]
    assert psnr(shown(browser, camera), expected(model, camera, AS_PHOTOGRAPHED)) > 45


@pytest.mark.in_turn
def test_the_first_layer_of_a_file_is_shown_with_its_map(browser: Browser, tmp_path: Path):
    model = mapped(14000)
    data = encode(model, "compact")
    entries = read_container(data).entries
    first = max(entry.end for tag, entry in entries.items() if tag[-1].isalpha())
    loaded(browser, tmp_path, page_of(made_up(50)))
    keep_file(browser, data)
    run(
        browser,
        "window.seen = []; const { player } = hyrfpack; player.addEventListener('loaded', () => {"
        "  seen.push([player.renderer.content.count, player.gains(player.view())]); window.rest?.(); });",
    )
    browser.evaluate(
        "hyrfpack.player.open({ name: 'x.hyrf', stream: (async function* () {"
        f"  yield file.slice(0, {first + 8}); await new Promise((resolve) => (window.rest = resolve));"
        f"  yield file.slice({first + 8}); }})() }}).then(() => true)"
    )
    (count, gains), *_ = browser.evaluate("seen")
    pose = model.config.frame.local_pose(eye(browser))
    assert count < 14000
    np.testing.assert_allclose(gains, model.exposure.predict_gains(pose), rtol=1e-9)


# ---- the control


@pytest.fixture
def wide(browser: Browser):
    browser.resize(1280, 800)
    yield browser
    browser.resize(240, 180)


@pytest.mark.in_turn
def test_key_and_button_switch_the_exposure_and_say_so(wide: Browser, tmp_path: Path):
    reopened(wide, tmp_path, page_of(mapped(100)))
    assert wide.evaluate(OFFERED) and wide.evaluate(PRESSED) == "true"
    button = "document.getElementById('exposure')"
    assert wide.evaluate(f"{button}.checkVisibility() && {button}.textContent") == "Exposure as photographed"
    heard = "document.getElementById('status').textContent"

    wide.press("x")
    assert (wide.evaluate(MODE), wide.evaluate(PRESSED)) == (CONSISTENT_EXPOSURE, "false")
    assert wide.evaluate(heard) == "Exposure: consistent"
    wide.evaluate(f"{button}.focus()")
    wide.press("Enter")
    assert (wide.evaluate(MODE), wide.evaluate(PRESSED)) == (AS_PHOTOGRAPHED, "true")
    assert wide.evaluate(heard) == "Exposure: as photographed"
    wide.press("?")
    assert wide.evaluate(
        "[...document.querySelectorAll('#help dd[data-needs-map]')].every((it) => it.checkVisibility())"
    )
    wide.press("Escape")


@pytest.mark.in_turn
def test_a_finger_switches_the_exposure(wide: Browser, tmp_path: Path):
    wide.resize(390, 844, phone=True)
    reopened(wide, tmp_path, page_of(mapped(100)))
    wide.evaluate("document.getElementById('toggle').click()")
    box = wide.evaluate(
        "(({ left, right, top, bottom }) => [left, right, top, bottom])"
        "(document.getElementById('exposure').getBoundingClientRect())"
    )
    left, right, top, bottom = box
    wide.touch("touchStart", ((left + right) / 2, (top + bottom) / 2))
    wide.touch("touchEnd")
    until(wide, f"{MODE} === '{CONSISTENT_EXPOSURE}' && {PRESSED} === 'false'")


@pytest.mark.in_turn
def test_files_without_a_map_offer_no_control(browser: Browser, tmp_path: Path):
    for page in (page_of(made_up(50)), page_of_splats(cloud(50))):
        reopened(browser, tmp_path, page)
        assert browser.evaluate(HIDDEN) and not browser.evaluate("hyrfpack.player.hasExposureMap")
        browser.press("x")
        assert browser.evaluate(MODE) == AS_PHOTOGRAPHED


@pytest.mark.in_turn
def test_the_control_follows_the_file_that_is_opened_and_the_choice_stays(browser: Browser, tmp_path: Path):
    model = mapped(50)
    reopened(browser, tmp_path, page_of(model))
    choose(browser, CONSISTENT_EXPOSURE)
    opening = "hyrfpack.player.open({ name: 'x.hyrf', stream: (async function* () { yield file.slice(); })() })"
    keep_file(browser, encode_model(made_up(60)))
    browser.evaluate(f"{opening}.then(() => true)")
    assert browser.evaluate(HIDDEN)
    keep_file(browser, encode_model(model))
    browser.evaluate(f"{opening}.then(() => true)")
    assert browser.evaluate(OFFERED) and browser.evaluate(PRESSED) == "false"


@pytest.mark.in_turn
def test_scripts_cannot_ask_for_an_unknown_exposure(browser: Browser, tmp_path: Path):
    reopened(browser, tmp_path, page_of(mapped(50)))
    ask = f"(() => {{ try {{ {MODE} = 'bright'; return ''; }} catch (error) {{ return error.message; }} }})()"
    assert browser.evaluate(ask) == "The exposure must be as-photographed or consistent, not bright."
    assert browser.evaluate(MODE) == AS_PHOTOGRAPHED


# ---- addresses and other pages


@pytest.mark.in_turn
@pytest.mark.parametrize("exposure", RENDER_EXPOSURES)
def test_the_address_chooses_the_exposure(browser: Browser, tmp_path: Path, exposure: str):
    model = mapped(300)
    reopened(browser, tmp_path, page_of(model), f"?exposure={exposure}")
    assert browser.evaluate(MODE) == exposure
    camera = cameras()[1]
    assert psnr(shown(browser, camera), expected(model, camera, exposure)) > 45


@pytest.mark.in_turn
def test_an_unknown_exposure_in_the_address_is_one_sentence_and_the_scene_is_there(browser: Browser, tmp_path: Path):
    reopened(browser, tmp_path, page_of(mapped(50)), "?exposure=bright")
    assert message(browser) == "The exposure in the address must be as-photographed or consistent, not bright."
    assert browser.evaluate(MODE) == AS_PHOTOGRAPHED


@pytest.mark.in_turn
def test_a_shared_link_has_the_exposure_that_is_shown(browser: Browser, tmp_path: Path):
    page = page_of(mapped(50))
    reopened(browser, tmp_path, page, "?noui&title=mine")
    for exposure, search in (
        (CONSISTENT_EXPOSURE, "?noui=&title=mine&exposure=consistent"),
        (AS_PHOTOGRAPHED, "?noui=&title=mine"),
    ):
        browser.press("x")
        browser.press("l")
        until(browser, f"location.hash.startsWith('#camera=') && location.search === '{search}'")
        link = browser.evaluate("location.search + location.hash")
        reopened(browser, tmp_path, page, link)
        assert browser.evaluate(MODE) == exposure and browser.evaluate("document.title") == "mine"


@pytest.mark.in_turn
def test_a_shared_link_of_a_file_without_a_map_names_no_exposure(browser: Browser, tmp_path: Path):
    reopened(browser, tmp_path, page_of(made_up(50)), "?exposure=consistent")
    browser.press("l")
    until(browser, "location.hash.startsWith('#camera=') && location.search === ''")


@pytest.fixture
def host():
    """A player to be hosted, beside a file with a map."""
    with site() as here:
        here.files = {
            "/index.html": encode_player("player"),
            "/scene.hyrf": encode_model(mapped(60)),
            "/hyrf-viewer.js": encode_element_script(),
        }
        yield here


@pytest.mark.in_turn
def test_the_element_has_an_exposure(browser: Browser, host: Site):
    host.files["/post.html"] = (
        b"<!DOCTYPE html><script src=hyrf-viewer.js></script>"
        b'<hyrf-viewer src="scene.hyrf" exposure="consistent"></hyrf-viewer>'
    )
    element = "document.querySelector('hyrf-viewer')"
    inside = f"{element}.shadowRoot.querySelector('iframe').contentWindow.hyrfpack?.player"
    browser.open(f"{host.address}/post.html")
    until(browser, f"{inside}?.loaded && {inside}.hasExposureMap && {inside}.exposure === '{CONSISTENT_EXPOSURE}'")
    browser.evaluate(f"{element}.removeAttribute('exposure')")
    until(browser, f"{inside}?.loaded && {inside}.exposure === '{AS_PHOTOGRAPHED}'")


# ---- exported pages


@pytest.mark.in_turn
@pytest.mark.parametrize("target", ["page.html", "player"])
def test_an_exported_page_brings_the_map_and_its_poster_is_as_photographed(
    browser: Browser, tmp_path: Path, host: Site, target: str
):
    model, kept = mapped(200), cameras()
    save_model(model, tmp_path / "model.hyrf", provenance={"cameras": provenance_cameras(kept)})
    export_model(tmp_path / "model.hyrf", tmp_path / target)
    folder = tmp_path / target if target == "player" else tmp_path
    host.files = {f"/{path.name}": path.read_bytes() for path in folder.iterdir() if path.is_file()}
    browser.open(f"{host.address}/{'index.html' if target == 'player' else target}")
    browser.evaluate("hyrfpack.ready")
    assert browser.evaluate(OFFERED)
    pictures = [shown(browser, camera) for camera in kept]
    assert min(psnr(p, expected(model, c, AS_PHOTOGRAPHED)) for p, c in zip(pictures, kept, strict=True)) > 45

    if target == "player":
        poster = np.asarray(Image.open(folder / "poster.jpg").convert("RGB"), np.float64)
        first = dict(
            zip(RENDER_EXPOSURES, (expected(model, kept[0], exposure) for exposure in RENDER_EXPOSURES), strict=True)
        )
        assert poster.shape == first[AS_PHOTOGRAPHED].shape
        assert psnr(poster, first[AS_PHOTOGRAPHED]) > psnr(poster, first[CONSISTENT_EXPOSURE]) + 5

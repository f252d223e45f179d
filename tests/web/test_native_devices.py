"""Native pages on graphics devices that are weak or get lost, and what they leave on a device."""

from __future__ import annotations

import base64
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from web.native_models import (
    SIXTEEN_LEVEL_GRID,
    load_page,
    lose_and_restore_device,
    make_cameras,
    make_model_page,
    open_file_error,
    random_model,
    render_reference,
    run_statements,
    store_file_in_page,
    wait_until_complete,
)
from web.pages import Browser, camera_json, psnr, render_in_page, wait_until

from hyrfpack.format.codec import encode_model
from tools.safety.synthetic_encoding import encode


def test_decoder_weights_are_in_a_uniform_block_on_devices_that_support_it(browser: Browser, tmp_path: Path):
    model = random_model(600)
    script = "const proto = WebGL2RenderingContext.prototype, { getParameter } = proto; proto.getParameter = "
    script += "function (name) { return name === this.RENDERER ? 'a device' : getParameter.call(this, name); }"
    with browser.before_every_page(script):
        load_page(browser, tmp_path, make_model_page(model))
        assert browser.evaluate("hyrfpack.player.renderer.content.radiance.block")
        camera = make_cameras()[0]
        assert psnr(render_in_page(browser, camera), render_reference(model, camera)) > 45


def test_a_restored_device_shows_the_same_view(browser: Browser, tmp_path: Path):
    model = random_model(300)
    load_page(browser, tmp_path, make_model_page(model))
    run_statements(browser, "window.device = hyrfpack.player.renderer.gl.getExtension('WEBGL_lose_context');")
    browser.drag((120, 90), (160, 100))
    wait_until_complete(browser)
    before = browser.evaluate("JSON.stringify(hyrfpack.camera())")
    run_statements(
        browser, "window.remarks = []; hyrfpack.player.addEventListener('remark', ({detail}) => remarks.push(detail));"
    )
    made = []
    for _ in range(8):
        browser.evaluate(
            "new Promise((resolve) => { const { player } = hyrfpack, back = () => device.restoreContext();"
            "player.canvas.addEventListener('webglcontextlost', () => setTimeout(back, 0), {once: true});"
            "player.addEventListener('loaded', () => resolve(true), {once: true});"
            "device.loseContext(); })"
        )
        wait_until_complete(browser)
        assert browser.evaluate("JSON.stringify(hyrfpack.camera())") == before
        sizes = "hyrfpack.player.renderer.graphics.made.size, hyrfpack.player.renderer.content.graphics.made.size"
        made.append(browser.evaluate(f"[{sizes}]"))
    assert "was lost" in browser.evaluate("remarks[0]") and browser.evaluate("remarks.at(-1)") == ""
    # The counts must not grow. They vary a little, because the last picture may need more or fewer objects.
    assert all(last - first < 5 for first, last in zip(made[0], made[-1], strict=True)), made
    camera = make_cameras()[0]
    assert psnr(render_in_page(browser, camera), render_reference(model, camera)) > 45


def test_a_picture_is_not_complete_while_the_device_is_lost(browser: Browser, tmp_path: Path):
    load_page(browser, tmp_path, make_model_page(random_model(300)))
    run_statements(
        browser,
        "const { player } = hyrfpack; window.device = player.renderer.gl.getExtension('WEBGL_lose_context');"
        "window.settled = []; device.loseContext();"
        "player.settled.then(() => settled.push('at once'));"
        "player.canvas.addEventListener('webglcontextlost', () => {"
        "  player.settled.then(() => settled.push('after the event')); player.redraw(); }, {once: true});",
    )
    browser.evaluate("new Promise((done) => setTimeout(done, 600))")
    assert browser.evaluate("settled") == []
    run_statements(browser, "device.restoreContext();")
    wait_until(browser, "settled.length === 2")


@pytest.mark.in_turn
def test_opening_many_files_leaks_no_webgl_objects(browser: Browser, tmp_path: Path):
    model = random_model(200)
    load_page(browser, tmp_path, make_model_page(model))
    file = base64.b64encode(encode_model(model)).decode()
    run_statements(
        browser,
        f"window.file = Uint8Array.from(atob('{file}'), (c) => c.charCodeAt(0));"
        "window.count = 0; for (const kind of ['Texture', 'Buffer', 'Framebuffer', 'Program']) {"
        "  const proto = WebGL2RenderingContext.prototype;"
        "  const make = proto['create' + kind], free = proto['delete' + kind];"
        "  proto['create' + kind] = function () { window.count++; return make.call(this); };"
        "  proto['delete' + kind] = function (object) { if (object) window.count--; return free.call(this, object); };"
        "}",
    )
    open_once = "hyrfpack.player.open({name: 'x.hyrf', stream: (async function* () { yield file.slice(); })()})"
    counts = []
    for _ in range(5):
        browser.evaluate(f"{open_once}.then(() => hyrfpack.player.settled).then(() => true)")
        counts.append(browser.evaluate("window.count"))
    assert len(set(counts[1:])) == 1
    assert browser.evaluate("hyrfpack.player.scene.count") == 200


WEBGL_PROTOTYPE_JS = "const proto = WebGL2RenderingContext.prototype; "


SMALL_TEXTURES_JS = WEBGL_PROTOTYPE_JS + (
    "const { getParameter } = proto; proto.getParameter = function (name) { "
    "  return name === this.MAX_TEXTURE_SIZE ? 128 : getParameter.call(this, name); }"
)


OUT_OF_MEMORY_JS = WEBGL_PROTOTYPE_JS + (
    "const { texStorage3D, getError } = proto; let calls = 0; "
    "proto.texStorage3D = function (...values) { calls += values[3] > 1; texStorage3D.apply(this, values); }; "
    "proto.getError = function () { return calls === 1 && calls++ ? 0x0505 : getError.call(this); };"
)


SHADER_ERROR_JS = WEBGL_PROTOTYPE_JS + (
    "const { shaderSource } = proto; proto.shaderSource = function (shader, text) {"
    "  shaderSource.call(this, shader, text.includes('u_half_extent') ? 'no' : text); };"
)


RECORD_REMARK_JS = (
    "; { const proto = EventTarget.prototype, { dispatchEvent } = proto; proto.dispatchEvent = function (event) {"
    "  if (event.type === 'remark') window.lastRemark = event.detail; return dispatchEvent.call(this, event); }; }"
)


@pytest.mark.parametrize(
    "script", ["", SMALL_TEXTURES_JS, OUT_OF_MEMORY_JS, SHADER_ERROR_JS], ids=["requested", "rows", "memory", "shader"]
)
def test_a_weak_device_draws_fitted_harmonics(browser: Browser, tmp_path: Path, script: str):
    # SMALL_TEXTURES_JS allows 128 rows, fewer than this table needs.
    wide = {"radiance": replace(SIXTEEN_LEVEL_GRID, log2_table_size=15)} if script == SMALL_TEXTURES_JS else {}
    model = random_model(400, **wide)
    with torch.no_grad():  # degree 3 can represent such colours
        model.radiance.weights[0][:, model.radiance.grid.feature_count :] *= 0.1
    page_bytes = make_model_page(model)
    if not script:
        page_bytes = page_bytes.replace(b'{"kind": "hyrf"', b'{"plain": true, "kind": "hyrf"')
    with browser.before_every_page(script + RECORD_REMARK_JS):
        load_page(browser, tmp_path, page_bytes)
        assert not script or browser.evaluate("lastRemark").startswith("Drawn with harmonics: ")
        if script:  # the remark appears again after the device was lost
            lose_and_restore_device(browser)
            assert browser.evaluate("lastRemark").startswith("Drawn with harmonics: ")
        assert browser.evaluate("Boolean(hyrfpack.player.renderer.content.harmonics)")
        scores = [psnr(render_in_page(browser, camera), render_reference(model, camera)) for camera in make_cameras()]
    assert min(scores) > 28 and browser.list_errors() == [], scores


LOSSES_JS = {
    "after 300 ms": (
        "addEventListener('DOMContentLoaded', () =>"
        " setTimeout(lose, 300, canvas().getContext('webgl2', { antialias: false })));"  # as the player does
    ),
    "when it is asked for its limits": (
        "const { prototype } = WebGL2RenderingContext, { getParameter } = prototype; let count = 0;"
        "prototype.getParameter = function (name) {"
        "  if (name === this.MAX_TEXTURE_SIZE && ++count === 2) lose(this);"  # the renderer has asked before
        "  return getParameter.call(this, name); };"
    ),
}


@pytest.mark.parametrize("moment", LOSSES_JS)
def test_a_device_lost_while_a_file_is_loading_is_restored(browser: Browser, tmp_path: Path, moment: str):
    model = random_model(3000)
    file = tmp_path / "page.html"
    file.write_bytes(make_model_page(model))
    script = (
        "const canvas = () => document.getElementById('view');"
        "const lose = (gl) => { const device = gl.getExtension('WEBGL_lose_context');"
        "  canvas().addEventListener('webglcontextlost', () => setTimeout(() => device.restoreContext(), 50));"
        "  canvas().addEventListener('webglcontextrestored', () => { window.restored = true; });"
        "  device.loseContext(); };"
    )
    with browser.before_every_page(script + LOSSES_JS[moment]):
        browser.open(file.as_uri())
        browser.evaluate("hyrfpack.ready")
        wait_until(browser, "window.restored === true")  # because a small file may be loaded before the loss
        wait_until_complete(browser)
        camera = make_cameras()[0]
        assert psnr(render_in_page(browser, camera), render_reference(model, camera)) > 45


@pytest.mark.in_turn
def test_scripts_may_dispose_of_a_player(browser: Browser, tmp_path: Path):
    load_page(browser, tmp_path, make_model_page(random_model(50)))
    browser.evaluate("hyrfpack.player.dispose()")
    assert browser.evaluate("hyrfpack.player.renderer.gl.isContextLost()")
    assert browser.list_errors() == []


def test_a_partly_loaded_scene_survives_the_loss_of_the_device(one_browser: Browser, tmp_path: Path):
    load_page(one_browser, tmp_path, make_model_page(random_model(50)))
    store_file_in_page(one_browser, encode(random_model(14000), "compact"))
    run_statements(
        one_browser, "window.loaded = new Promise((resolve) => hyrfpack.player.addEventListener('loaded', resolve));"
    )
    message = open_file_error(
        one_browser,
        "yield file.slice(0, Math.floor(0.9 * file.length)); await loaded; throw new Error('the connection broke');",
    )
    assert "the connection broke" in message
    wait_until_complete(one_browser)
    count = one_browser.evaluate("hyrfpack.player.renderer.content.count")
    lose_and_restore_device(one_browser)
    assert one_browser.evaluate("hyrfpack.player.renderer.content.count") == count < 14000


def test_a_device_lost_and_restored_between_two_checks_is_noticed(one_browser: Browser, tmp_path: Path):
    file = tmp_path / "page.html"
    file.write_bytes(make_model_page(random_model(3000)))
    script = (
        "const wait = setTimeout; window.setTimeout = (work, ms) => wait(work, ms === 4 ? 100 : ms);"
        "addEventListener('DOMContentLoaded', () => { const canvas = document.getElementById('view'), "
        "device = canvas.getContext('webgl2').getExtension('WEBGL_lose_context'); "
        "canvas.addEventListener('webglcontextlost', () => wait(() => device.restoreContext(), 0)); "
        "const { fenceSync } = WebGL2RenderingContext.prototype; WebGL2RenderingContext.prototype.fenceSync = "
        "function () { const fence = fenceSync.apply(this, arguments); WebGL2RenderingContext.prototype.fenceSync = "
        "fenceSync; window.lost = true; wait(() => device.loseContext(), 10); return fence; }; })"
    )
    with one_browser.before_every_page(script):
        one_browser.open(file.as_uri())
        one_browser.evaluate("hyrfpack.ready")
        assert one_browser.evaluate("window.lost")


def test_a_large_picture_releases_its_memory(one_browser: Browser, tmp_path: Path):
    load_page(one_browser, tmp_path, make_model_page(random_model(50)))
    camera = replace(make_cameras()[0], width=1200, height=900)
    one_browser.evaluate(f"hyrfpack.show({camera_json(camera)}).then(() => true)")
    wait_until_complete(one_browser)
    assert max(one_browser.evaluate("hyrfpack.player.renderer.surfaces.colors.size")) < 900

"""Native pages open files: layer by layer, damaged ones, and several at a time."""

from __future__ import annotations

import base64
import time
from pathlib import Path

import pytest
from web.native_models import (
    load_page,
    make_cameras,
    make_model_page,
    open_file_error,
    random_model,
    render_reference,
    run_statements,
    store_file_in_page,
    wait_until_complete,
)
from web.pages import Browser, psnr, render_in_page

from hyrfpack.format.codec import encode_model
from tools.safety.synthetic_encoding import encode


@pytest.mark.smoke
@pytest.mark.in_turn
def test_the_first_layer_is_shown_while_the_rest_is_loading(browser: Browser, tmp_path: Path):
    model, data = random_model(200), encode(random_model(14000), "compact")
    load_page(browser, tmp_path, make_model_page(model))
    file = base64.b64encode(data).decode()
    run_statements(
        browser,
        f"window.file = Uint8Array.from(atob('{file}'), (c) => c.charCodeAt(0));"
        "window.counts = []; window.parts = []; window.sendRest = null; const { player } = hyrfpack;"
        "player.addEventListener('progress', ({ detail }) => (window.part = detail.part));"
        "player.addEventListener('loaded', () => { counts.push(player.renderer.content.count); parts.push(part);"
        " sendRest?.(); sendRest = null; });"
        "player.addEventListener('count', ({ detail }) => (window.counted = detail.count));",
    )
    browser.evaluate(
        "hyrfpack.player.open({ name: 'x.hyrf', stream: (async function* () {"
        "  const cut = Math.floor(0.9 * file.length); yield file.slice(0, 3000); yield file.slice(3000, cut);"
        "  await new Promise((resolve) => (window.sendRest = resolve)); yield file.slice(cut); })() }).then(() => true)"
    )
    first, last = browser.evaluate("counts")
    assert 0 < first < last == 14000
    first, last = browser.evaluate("parts")
    assert first < last == 1
    wait_until_complete(browser)
    assert browser.evaluate("hyrfpack.player.whole") and browser.evaluate("counted") == 14000


@pytest.mark.in_turn
def test_a_damaged_file_is_refused_with_one_sentence(browser: Browser, tmp_path: Path):
    data = bytearray(encode_model(random_model(50)))
    data[-20] ^= 1
    file = tmp_path / "page.html"
    file.write_bytes(make_model_page(random_model(50), bytes(data)))
    browser.open(file.as_uri())
    message = browser.evaluate("hyrfpack.ready.then(() => '', (error) => error.message)")
    assert "cannot be shown" in message and "\n" not in message


def test_a_file_with_an_invalid_header_is_refused_before_the_rest_arrives(one_browser: Browser, tmp_path: Path):
    data = encode_model(random_model(50))
    load_page(one_browser, tmp_path, make_model_page(random_model(50)))
    store_file_in_page(one_browser, data[:20] + bytes([data[20] ^ 1]) + data[21:])
    assert "checksum of the header" in open_file_error(one_browser, "yield file; await new Promise(() => {});")
    store_file_in_page(one_browser, data + bytes(8))
    assert "bytes and there are" in open_file_error(one_browser, "yield file; await new Promise(() => {});")
    store_file_in_page(one_browser, data)
    run_statements(one_browser, "window.ended = new Promise((resolve) => (window.end = resolve));")
    endless = (
        "try { for (;;) { yield file.slice(); await new Promise((resolve) => setTimeout(resolve, 10)); } }"
        " finally { end(); }"
    )
    assert "bytes and there are" in open_file_error(one_browser, endless)
    one_browser.evaluate("ended.then(() => true)")
    assert one_browser.evaluate("hyrfpack.player.scene.count") == 50


def test_a_file_in_many_pieces_is_joined_in_linear_time(one_browser: Browser, tmp_path: Path):
    load_page(one_browser, tmp_path, make_model_page(random_model(50)))
    began = time.monotonic()
    message = open_file_error(one_browser, "for (let k = 0; k < 1024; k++) yield new Uint8Array(1 << 16);", "x.splat")
    assert ".hyrf files only" in message and time.monotonic() - began < 4


def test_a_file_that_cannot_be_shown_leaves_the_scene_unchanged(one_browser: Browser, tmp_path: Path):
    model = random_model(300)
    load_page(one_browser, tmp_path, make_model_page(model))
    store_file_in_page(one_browser, encode_model(random_model(500)))
    run_statements(
        one_browser,
        "window.camera = JSON.stringify(hyrfpack.camera()); window.loader = hyrfpack.player.loader;",
    )
    # The player tries the fields first, then the harmonics that replace them; both fail.
    run_statements(one_browser, "hyrfpack.player.renderer.stage = () => { throw new Error('no memory'); };")
    assert "no memory" in open_file_error(one_browser, "yield file;")
    assert one_browser.evaluate("hyrfpack.player.scene.count === 300 && hyrfpack.player.loader === loader")
    assert one_browser.evaluate("JSON.stringify(hyrfpack.camera()) === camera && hyrfpack.player.next === null")
    assert one_browser.evaluate("document.getElementById('remark').hidden")
    run_statements(one_browser, "delete hyrfpack.player.renderer.stage;")
    camera = make_cameras()[0]
    assert psnr(render_in_page(one_browser, camera), render_reference(model, camera)) > 45


def test_the_pages_own_scene_is_shown_when_another_file_fails_to_open(one_browser: Browser, tmp_path: Path):
    file = tmp_path / "page.html"
    file.write_bytes(make_model_page(random_model(3000)))
    script = (
        "const open = () => { if (!globalThis.hyrfpack?.player) return setTimeout(open, 1);"
        "window.bad = hyrfpack.player.open("
        "{ name: 'bad.hyrf', stream: (async function* () { yield new Uint8Array(100); })() })"
        ".then(() => '', (error) => error.message); }; open();"
    )
    with one_browser.before_every_page(script):
        one_browser.open(file.as_uri())
        one_browser.evaluate("hyrfpack.ready")
        wait_until_complete(one_browser)
        assert "bad.hyrf cannot be opened" in one_browser.evaluate("bad")
        assert one_browser.evaluate("hyrfpack.player.renderer.content.count") == 3000


def test_a_file_opened_before_the_pages_own_scene_is_loaded_replaces_it(one_browser: Browser, tmp_path: Path):
    file = tmp_path / "page.html"
    file.write_bytes(make_model_page(random_model(3000)))
    other = base64.b64encode(encode_model(random_model(70))).decode()
    script = (
        f"const other = Uint8Array.from(atob('{other}'), (c) => c.charCodeAt(0));"
        "const open = () => { if (!globalThis.hyrfpack?.player) return setTimeout(open, 1);"
        "window.good = hyrfpack.player.open("
        "{ name: 'good.hyrf', stream: (async function* () { yield other; })() }).then(() => true); }; open();"
    )
    with one_browser.before_every_page(script):
        one_browser.open(file.as_uri())
        one_browser.evaluate("hyrfpack.ready")  # raises no error
        assert one_browser.evaluate("good")
        wait_until_complete(one_browser)
        assert one_browser.evaluate("hyrfpack.player.renderer.content.count") == 70


def test_pictures_requested_while_another_file_is_loading_finish(one_browser: Browser, tmp_path: Path):
    load_page(one_browser, tmp_path, make_model_page(random_model(300)))
    store_file_in_page(one_browser, encode_model(random_model(200)))
    opening = "hyrfpack.player.open({ name: 'x.hyrf', stream: (async function* () { yield file; })() })"
    show = "hyrfpack.player.show(camera).then(() => 'drawn', (error) => error.message)"
    run_statements(one_browser, f"window.answers = []; window.camera = hyrfpack.camera(); window.opening = {opening};")
    many = f"(async () => {{ for (let k = 0; k < 40; k++) answers.push(await {show}); return answers; }})()"
    assert set(one_browser.evaluate(many)) <= {"drawn", one_browser.evaluate("answers.find((a) => a !== 'drawn')")}
    one_browser.evaluate("opening.then(() => true)")
    sort = "const { player } = hyrfpack, sorted = player.loader.sort(player.view(), player.scene);"
    assert one_browser.evaluate(f"(() => {{ {sort} player.loader.dispose(); return sorted; }})()") is None

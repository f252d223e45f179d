"""Pages with a `.hyrf` file inside: the browser decodes it and draws what `hyrfpack.render_view` draws."""

from __future__ import annotations

import base64
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scenes import camera_at, shift_cameras
from web.pages import Browser, json_of, psnr, shown, until

from hyrfpack.format.codec import encode_model
from hyrfpack.model import Frame, HashGridConfig, HybridModel, ModelConfig
from hyrfpack.model.gaussians import Gaussians
from hyrfpack.render import RenderSettings, render_view
from hyrfpack.scene import Camera
from hyrfpack.web.html import encode_model_page
from tools.safety.synthetic_encoding import encode

FRAME = Frame((10.0, -20.0, 5.0), 7.0, (1.0, 0.5, 0.8))
EXACT = RenderSettings(background_threshold=0.0, background_stride=1)
UP, CENTER = np.array([0.0, 0.0, 1.0]), np.array(FRAME.center)
PLACES = [(0.4, -2.4, 0.7), (-2.0, 0.3, 0.2), (0.1, 0.1, 0.05), (3.5, 2.0, -1.5)]

SMALL = HashGridConfig(log2_table_size=9, levels=4, base=4, finest=40)
SIXTEEN = HashGridConfig(log2_table_size=11, levels=16, base=4, finest=256)
ONE = HashGridConfig(log2_table_size=12, levels=1, base=12, finest=12)
CASES = {
    "usual": {},
    "harmonics, product, solid": {"direction_encoding": "sh", "scale_rule": "product", "background": False},
    "sixteen levels, antialiased": {"geometry": SIXTEEN, "radiance": SIXTEEN, "antialiased": True},
    "one level, 3 hidden": {"geometry": ONE, "radiance": ONE, "hidden": 3},
    "100 hidden, even scales": {"hidden": 100, "scale_grows": False, "direction_encoding": "sh"},
}


def made_up(count: int = 2600, seed: int = 0, **config: object) -> HybridModel:
    """A model whose fields say much: Gaussians of all shapes and colours, inside the frame's box and far out."""
    shape = {"geometry": SMALL, "radiance": SMALL, "hidden": 16, "solid": (0.2, 0.3, 0.1), **config}
    generator = torch.Generator().manual_seed(seed)

    def normal(*size: int) -> torch.Tensor:
        return torch.randn(*size, generator=generator)

    positions = normal(count, 3) * 0.4 * torch.exp(normal(count, 1) * 0.5)
    gaussians = Gaussians(positions, normal(count, 3), normal(count, 1) * 0.5 - 3, normal(count, 1) + 1)
    model = HybridModel(ModelConfig(frame=FRAME, **shape), gaussians, generator)
    with torch.no_grad():
        for field in (model.geometry, model.radiance):
            field.grid.table.copy_(normal(*field.grid.table.shape))
            for bias in field.biases:
                bias.copy_(normal(*bias.shape) * 0.3)
        # The background is seen along directions from the middle; models that are not made up hardly tell them apart.
        model.radiance.weights[0][:, model.radiance.grid.feature_count :] *= 0.5
    return model


def cameras(width: int = 120, height: int = 90) -> list[Camera]:
    """Around, among and away from the Gaussians, in the world."""
    local = [camera_at(place, up=UP, width=width, height=height, focal=100.0) for place in PLACES]
    return shift_cameras([replace(camera, camera_from_world=_scaled(camera)) for camera in local], CENTER)


def _scaled(camera: Camera) -> np.ndarray:
    pose = camera.camera_from_world.copy()
    pose[:3, 3] *= FRAME.scale
    return pose


def page_of(model: HybridModel, data: bytes | None = None) -> bytes:
    data = encode_model(model) if data is None else data
    facts = {"count": len(model), "frame": model.config.frame, "solid": model.config.solid}
    return encode_model_page(data, title="a model", cameras=cameras(), up=UP, center=CENTER, **facts)


def rendered(model: HybridModel, camera: Camera) -> np.ndarray:
    """(H, W, 3) by our renderer, in 0 to 255."""
    with torch.no_grad():
        return render_view(model, camera, EXACT).rgb.clamp(0, 1).numpy() * 255


def loaded(browser: Browser, tmp_path: Path, page: bytes, complete: bool = True) -> Browser:
    """The page in the browser, its picture complete."""
    file = tmp_path / "page.html"
    file.write_bytes(page)
    browser.open(file.as_uri())
    browser.evaluate("hyrfpack.ready")
    if complete:
        settled(browser)
    return browser


def run(browser: Browser, statements: str) -> None:
    """Statements of JavaScript; what they keep, they keep in the window."""
    browser.evaluate(f"(() => {{ {statements} }})()")


def settled(browser: Browser) -> None:
    browser.evaluate("hyrfpack.player.settled.then(() => true)")


def numbers(browser: Browser, expression: str, kind: type) -> np.ndarray:
    """A typed array of the page."""
    text = f"((a) => btoa(Array.from(new Uint8Array(a.buffer), (b) => String.fromCharCode(b)).join('')))({expression})"
    return np.frombuffer(base64.b64decode(browser.evaluate(text)), kind)


def texels(browser: Browser, name: str, width: int, words: int) -> np.ndarray:
    """(height, 2048, 4) uint32 of a texture of what is drawn, of which the first `words` are in use."""
    script = f"""(() => {{
        const {{ gl, content }} = hyrfpack.player.renderer, height = content.height;
        const target = gl.createFramebuffer(), words = new Uint32Array(4 * {width} * height);
        gl.bindFramebuffer(gl.FRAMEBUFFER, target);
        gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, content.{name}, 0);
        gl.readPixels(0, 0, {width}, height, gl.RGBA_INTEGER, gl.UNSIGNED_INT, words);
        gl.deleteFramebuffer(target);
        return words;
    }})()"""
    return numbers(browser, script, np.uint32).reshape(-1, 4)[:, :words]


@pytest.mark.parametrize("case", CASES)
def test_pictures_geometry_and_colours_are_those_of_the_model(browser: Browser, tmp_path: Path, case: str):
    model = made_up(**CASES[case])
    loaded(browser, tmp_path, page_of(model), complete=False)
    camera = cameras()[0]
    shown(browser, camera)
    check_geometry_and_colours(browser, model, camera)
    scores = [psnr(shown(browser, camera), rendered(model, camera)) for camera in cameras()]
    assert min(scores) > 45 and browser.list_errors() == [], scores


def check_geometry_and_colours(browser: Browser, model: HybridModel, camera: Camera) -> None:
    """What lies in the textures of the page, which shows this camera alone."""
    count = len(model)
    places, shapes = (texels(browser, name, 2048, 4)[:count] for name in ("places", "shapes"))
    halves = np.ascontiguousarray(texels(browser, "colors", 2048, 2)[:count]).view(np.float16)[:, :3]
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
    seen = halves.any(axis=1)  # rows out of the picture are not coloured
    assert seen.mean() > 0.5
    np.testing.assert_allclose(halves[seen].astype(np.float32), colors[seen], atol=1e-3)


def test_decoders_lie_in_a_block_of_uniforms_where_a_device_reads_them(browser: Browser, tmp_path: Path):
    model = made_up(600)
    script = "const proto = WebGL2RenderingContext.prototype, ask = proto.getParameter; proto.getParameter = "
    script += "function (name) { return name === this.RENDERER ? 'a device' : ask.call(this, name); }"
    with browser.before_every_page(script):
        loaded(browser, tmp_path, page_of(model))
        assert browser.evaluate("hyrfpack.player.renderer.content.radiance.block")
        camera = cameras()[0]
        assert psnr(shown(browser, camera), rendered(model, camera)) > 45


@pytest.mark.in_turn
def test_a_model_without_gaussians_shows_its_background(browser: Browser, tmp_path: Path):
    model = made_up(0)
    loaded(browser, tmp_path, page_of(model))
    camera = cameras()[2]
    assert psnr(shown(browser, camera), rendered(model, camera)) > 40


@pytest.mark.in_turn
def test_the_window_shows_what_scripts_are_given_and_then_rests(browser: Browser, tmp_path: Path):
    loaded(browser, tmp_path, page_of(made_up()))
    frames = browser.evaluate("hyrfpack.frames()")
    run(browser, "window.asked = 0; const ask = requestAnimationFrame;"
                 "window.requestAnimationFrame = (frame) => (window.asked++, ask(frame));")  # fmt: skip
    time.sleep(0.5)
    assert browser.evaluate("hyrfpack.frames()") == frames and browser.evaluate("window.asked") == 0


@pytest.mark.in_turn
def test_colours_follow_the_view_while_it_moves_and_are_complete_when_it_stands(browser: Browser, tmp_path: Path):
    model = made_up()
    loaded(browser, tmp_path, page_of(model))
    browser.drag((120, 90), (200, 110), steps=8)
    settled(browser)
    rows = "hyrfpack.player.renderer.content.rows"
    turned = browser.evaluate(
        f"Array.from({{length: {rows}.count}}, (_, r) => Math.hypot(...[0, 1, 2].map("
        f"(k) => {rows}.eyes[3 * r + k] - hyrfpack.player.view().eye[k])))"
    )
    assert max(turned) < 0.05


def test_a_lost_device_comes_back_with_the_same_view(browser: Browser, tmp_path: Path):
    model = made_up(300)
    loaded(browser, tmp_path, page_of(model))
    run(browser, "window.device = hyrfpack.player.renderer.gl.getExtension('WEBGL_lose_context');")
    browser.drag((120, 90), (160, 100))
    settled(browser)
    before = browser.evaluate("JSON.stringify(hyrfpack.camera())")
    run(browser, "window.said = []; hyrfpack.player.addEventListener('remark', ({detail}) => said.push(detail));")
    made = []
    for _ in range(8):
        browser.evaluate(
            "new Promise((resolve) => { const { player } = hyrfpack, back = () => device.restoreContext();"
            "player.canvas.addEventListener('webglcontextlost', () => setTimeout(back, 0), {once: true});"
            "player.addEventListener('loaded', () => resolve(true), {once: true});"
            "device.loseContext(); })"
        )
        settled(browser)
        assert browser.evaluate("JSON.stringify(hyrfpack.camera())") == before
        sizes = "hyrfpack.player.renderer.graphics.made.size, hyrfpack.player.renderer.content.graphics.made.size"
        made.append(browser.evaluate(f"[{sizes}]"))
    assert "taken away" in browser.evaluate("said[0]") and browser.evaluate("said.at(-1)") == ""
    # Nothing is left behind; how much is there when it is asked differs by what the last picture needed.
    assert all(last - first < 5 for first, last in zip(made[0], made[-1], strict=True)), made
    camera = cameras()[0]
    assert psnr(shown(browser, camera), rendered(model, camera)) > 45


def taken_away(browser: Browser) -> None:
    """The device is taken away and comes back."""
    browser.evaluate(
        "new Promise((resolve) => { const { player } = hyrfpack;"
        "const device = player.renderer.gl.getExtension('WEBGL_lose_context'), back = () => device.restoreContext();"
        "player.canvas.addEventListener('webglcontextlost', () => setTimeout(back, 0), {once: true});"
        "player.addEventListener('loaded', () => resolve(true), {once: true});"
        "device.loseContext(); })"
    )
    settled(browser)


@pytest.mark.in_turn
def test_many_files_opened_one_after_the_other_leave_nothing_behind(browser: Browser, tmp_path: Path):
    model = made_up(200)
    loaded(browser, tmp_path, page_of(model))
    file = base64.b64encode(encode_model(model)).decode()
    run(
        browser,
        f"window.file = Uint8Array.from(atob('{file}'), (c) => c.charCodeAt(0));"
        "window.count = 0; for (const kind of ['Texture', 'Buffer', 'Framebuffer', 'Program']) {"
        "  const proto = WebGL2RenderingContext.prototype;"
        "  const make = proto['create' + kind], free = proto['delete' + kind];"
        "  proto['create' + kind] = function () { window.count++; return make.call(this); };"
        "  proto['delete' + kind] = function (it) { if (it) window.count--; return free.call(this, it); };"
        "}",
    )
    open_once = "hyrfpack.player.open({name: 'x.hyrf', stream: (async function* () { yield file.slice(); })()})"
    counts = []
    for _ in range(5):
        browser.evaluate(f"{open_once}.then(() => true)")
        counts.append(browser.evaluate("window.count"))
    assert len(set(counts[1:])) == 1
    assert browser.evaluate("hyrfpack.player.scene.count") == 200


PATCHED = "const proto = WebGL2RenderingContext.prototype; "
NO_TEXELS = PATCHED + (
    "const ask = proto.getParameter; "
    "proto.getParameter = function (name) { return name === this.MAX_TEXTURE_SIZE ? 128 : ask.call(this, name); }"
)
NO_MEMORY = PATCHED + (
    "const { texStorage3D, getError } = proto; let times = 0; "
    "proto.texStorage3D = function (...all) { times += all[3] > 1; texStorage3D.apply(this, all); }; "
    "proto.getError = function () { return times === 1 && times++ ? 0x0505 : getError.call(this); };"
)
REFUSED = PATCHED + (
    "const { shaderSource } = proto; proto.shaderSource = function (shader, text) {"
    "  shaderSource.call(this, shader, text.includes('u_half_extent') ? 'no' : text); };"
)
SAYING = (
    "; { const tell = EventTarget.prototype.dispatchEvent; EventTarget.prototype.dispatchEvent = function (event) {"
    "  if (event.type === 'remark') window.said = event.detail; return tell.call(this, event); }; }"
)


@pytest.mark.parametrize("script", ["", NO_TEXELS, NO_MEMORY, REFUSED], ids=["asked", "texels", "memory", "driver"])
def test_a_weak_device_draws_fitted_harmonics(browser: Browser, tmp_path: Path, script: str):
    wide = {"radiance": replace(SIXTEEN, log2_table_size=15)} if script == NO_TEXELS else {}  # more than 128 rows
    model = made_up(400, **wide)
    with torch.no_grad():  # colours that degree 3 can hold
        model.radiance.weights[0][:, model.radiance.grid.feature_count :] *= 0.1
    page_bytes = page_of(model)
    if not script:
        page_bytes = page_bytes.replace(b'{"kind": "hyrf"', b'{"plain": true, "kind": "hyrf"')
    with browser.before_every_page(script + SAYING):
        loaded(browser, tmp_path, page_bytes)
        assert not script or browser.evaluate("said").startswith("Drawn with harmonics: ")
        if script:  # and it is said again when the device was gone
            taken_away(browser)
            assert browser.evaluate("said").startswith("Drawn with harmonics: ")
        assert browser.evaluate("Boolean(hyrfpack.player.renderer.content.harmonics)")
        scores = [psnr(shown(browser, camera), rendered(model, camera)) for camera in cameras()]
    assert min(scores) > 28 and browser.list_errors() == [], scores


@pytest.mark.in_turn
def test_the_first_layer_is_seen_while_the_rest_comes(browser: Browser, tmp_path: Path):
    model, data = made_up(200), encode(made_up(14000), "compact")
    loaded(browser, tmp_path, page_of(model))
    file = base64.b64encode(data).decode()
    run(
        browser,
        f"window.file = Uint8Array.from(atob('{file}'), (c) => c.charCodeAt(0));"
        "window.seen = []; window.rest = null; const { player } = hyrfpack;"
        "player.addEventListener('loaded', () => { seen.push(player.renderer.content.count);"
        " rest?.(); rest = null; });"
        "player.addEventListener('count', ({ detail }) => (window.counted = detail.count));",
    )
    browser.evaluate(
        "hyrfpack.player.open({ name: 'x.hyrf', stream: (async function* () {"
        "  const most = Math.floor(0.9 * file.length); yield file.slice(0, 3000); yield file.slice(3000, most);"
        "  await new Promise((resolve) => (window.rest = resolve)); yield file.slice(most); })() }).then(() => true)"
    )
    first, last = browser.evaluate("seen")
    assert 0 < first < last == 14000
    settled(browser)
    assert browser.evaluate("hyrfpack.player.whole") and browser.evaluate("counted") == 14000


def test_a_device_lost_while_a_file_comes_in_is_made_up_for(browser: Browser, tmp_path: Path):
    model = made_up(3000)
    file = tmp_path / "page.html"
    file.write_bytes(page_of(model))
    script = (
        "addEventListener('DOMContentLoaded', () => { const canvas = document.getElementById('view'), "
        "device = canvas.getContext('webgl2').getExtension('WEBGL_lose_context'); "
        "canvas.addEventListener('webglcontextlost', () => setTimeout(() => device.restoreContext(), 50)); "
        "canvas.addEventListener('webglcontextrestored', () => { window.restored = true; }); "
        "setTimeout(() => device.loseContext(), 300); })"
    )
    with browser.before_every_page(script):
        browser.open(file.as_uri())
        browser.evaluate("hyrfpack.ready")
        until(browser, "window.restored === true")  # a small file may be loaded before the device is lost
        settled(browser)
        camera = cameras()[0]
        assert psnr(shown(browser, camera), rendered(model, camera)) > 45


@pytest.mark.in_turn
def test_scripts_may_dispose_of_a_player(browser: Browser, tmp_path: Path):
    loaded(browser, tmp_path, page_of(made_up(50)))
    browser.evaluate("hyrfpack.player.dispose()")
    assert browser.evaluate("hyrfpack.player.renderer.gl.isContextLost()")
    assert browser.list_errors() == []


@pytest.mark.in_turn
def test_a_damaged_file_is_refused_in_a_sentence(browser: Browser, tmp_path: Path):
    data = bytearray(encode_model(made_up(50)))
    data[-20] ^= 1
    file = tmp_path / "page.html"
    file.write_bytes(page_of(made_up(50), bytes(data)))
    browser.open(file.as_uri())
    said = browser.evaluate("hyrfpack.ready.then(() => '', (error) => error.message)")
    assert "cannot be unpacked" in said and "\n" not in said


def keep_file(browser: Browser, data: bytes) -> None:
    file = base64.b64encode(data).decode()
    run(browser, f"window.file = Uint8Array.from(atob('{file}'), (c) => c.charCodeAt(0));")


def failing(browser: Browser, stream: str, name: str = "x.hyrf") -> str:
    """With what a file fails, the statements of a generator giving its bytes; "" if it does not."""
    opening = f"hyrfpack.player.open({{ name: '{name}', stream: (async function* () {{ {stream} }})() }})"
    return browser.evaluate(f"{opening}.then(() => '', (error) => error.message)")


def test_what_is_drawn_of_a_broken_download_survives_the_loss_of_the_device(one_browser: Browser, tmp_path: Path):
    loaded(one_browser, tmp_path, page_of(made_up(50)))
    keep_file(one_browser, encode(made_up(14000), "compact"))
    run(one_browser, "window.seen = new Promise((resolve) => hyrfpack.player.addEventListener('loaded', resolve));")
    said = failing(
        one_browser,
        "yield file.slice(0, Math.floor(0.9 * file.length)); await seen; throw new Error('the connection broke');",
    )
    assert "the connection broke" in said
    settled(one_browser)
    count = one_browser.evaluate("hyrfpack.player.renderer.content.count")
    taken_away(one_browser)
    assert one_browser.evaluate("hyrfpack.player.renderer.content.count") == count < 14000


def test_a_file_is_refused_as_soon_as_its_header_makes_no_sense(one_browser: Browser, tmp_path: Path):
    data = encode_model(made_up(50))
    loaded(one_browser, tmp_path, page_of(made_up(50)))
    keep_file(one_browser, data[:20] + bytes([data[20] ^ 1]) + data[21:])
    assert "checksum of the header" in failing(one_browser, "yield file; await new Promise(() => {});")
    keep_file(one_browser, data + bytes(8))
    assert "bytes and there are" in failing(one_browser, "yield file; await new Promise(() => {});")
    keep_file(one_browser, data)
    run(one_browser, "window.ended = new Promise((resolve) => (window.end = resolve));")
    endless = (
        "try { for (;;) { yield file.slice(); await new Promise((go) => setTimeout(go, 10)); } } finally { end(); }"
    )
    assert "bytes and there are" in failing(one_browser, endless)
    one_browser.evaluate("ended.then(() => true)")
    assert one_browser.evaluate("hyrfpack.player.scene.count") == 50


def test_files_in_many_pieces_are_joined_once(one_browser: Browser, tmp_path: Path):
    loaded(one_browser, tmp_path, page_of(made_up(50)))
    began = time.monotonic()
    said = failing(one_browser, "for (let k = 0; k < 1024; k++) yield new Uint8Array(1 << 16);", "x.splat")
    assert ".hyrf files only" in said and time.monotonic() - began < 4


def test_a_file_that_cannot_be_shown_leaves_all_as_it_was(one_browser: Browser, tmp_path: Path):
    model = made_up(300)
    loaded(one_browser, tmp_path, page_of(model))
    keep_file(one_browser, encode_model(made_up(500)))
    run(
        one_browser,
        "const { player } = hyrfpack; window.kept = JSON.stringify(hyrfpack.camera());window.Loaded = player.loader;",
    )
    # The fields are refused, then the harmonics in their place.
    run(one_browser, "const { renderer } = hyrfpack.player, no = () => { throw new Error('no memory'); };"
                     "renderer.stage = no;")  # fmt: skip
    assert "no memory" in failing(one_browser, "yield file;")
    assert one_browser.evaluate("hyrfpack.player.scene.count === 300 && hyrfpack.player.loader === Loaded")
    assert one_browser.evaluate("JSON.stringify(hyrfpack.camera()) === kept && hyrfpack.player.next === null")
    assert one_browser.evaluate("document.getElementById('remark').hidden")
    run(one_browser, "delete hyrfpack.player.renderer.stage;")
    camera = cameras()[0]
    assert psnr(shown(one_browser, camera), rendered(model, camera)) > 45


def test_the_pages_own_scene_comes_when_a_file_that_was_opened_meanwhile_fails(one_browser: Browser, tmp_path: Path):
    file = tmp_path / "page.html"
    file.write_bytes(page_of(made_up(3000)))
    script = (
        "addEventListener('DOMContentLoaded', () => setTimeout(() => { window.bad = hyrfpack.player.open("
        "{ name: 'bad.hyrf', stream: (async function* () { yield new Uint8Array(100); })() })"
        ".then(() => '', (error) => error.message); }, 50))"
    )
    with one_browser.before_every_page(script):
        one_browser.open(file.as_uri())
        one_browser.evaluate("hyrfpack.ready")
        settled(one_browser)
        assert "bad.hyrf cannot be opened" in one_browser.evaluate("bad")
        assert one_browser.evaluate("hyrfpack.player.renderer.content.count") == 3000


def test_a_file_opened_before_the_pages_own_is_there_takes_its_place(one_browser: Browser, tmp_path: Path):
    file = tmp_path / "page.html"
    file.write_bytes(page_of(made_up(3000)))
    other = base64.b64encode(encode_model(made_up(70))).decode()
    script = (
        f"const other = Uint8Array.from(atob('{other}'), (c) => c.charCodeAt(0));"
        "addEventListener('DOMContentLoaded', () => setTimeout(() => { window.good = hyrfpack.player.open("
        "{ name: 'good.hyrf', stream: (async function* () { yield other; })() }).then(() => true); }, 50))"
    )
    with one_browser.before_every_page(script):
        one_browser.open(file.as_uri())
        one_browser.evaluate("hyrfpack.ready")  # no error
        assert one_browser.evaluate("good")
        settled(one_browser)
        assert one_browser.evaluate("hyrfpack.player.renderer.content.count") == 70


def test_a_device_that_was_away_between_two_looks_at_it_is_noticed(one_browser: Browser, tmp_path: Path):
    file = tmp_path / "page.html"
    file.write_bytes(page_of(made_up(3000)))
    script = (
        "const wait = setTimeout; window.setTimeout = (work, ms) => wait(work, ms === 4 ? 100 : ms);"
        "addEventListener('DOMContentLoaded', () => { const canvas = document.getElementById('view'), "
        "device = canvas.getContext('webgl2').getExtension('WEBGL_lose_context'); "
        "canvas.addEventListener('webglcontextlost', () => wait(() => device.restoreContext(), 0)); "
        "const { fenceSync } = WebGL2RenderingContext.prototype; WebGL2RenderingContext.prototype.fenceSync = "
        "function (...all) { const fence = fenceSync.apply(this, all); WebGL2RenderingContext.prototype.fenceSync = "
        "fenceSync; window.lost = true; wait(() => device.loseContext(), 10); return fence; }; })"
    )
    with one_browser.before_every_page(script):
        one_browser.open(file.as_uri())
        one_browser.evaluate("hyrfpack.ready")
        assert one_browser.evaluate("window.lost")


def test_pictures_asked_for_while_another_file_comes_end(one_browser: Browser, tmp_path: Path):
    loaded(one_browser, tmp_path, page_of(made_up(300)))
    keep_file(one_browser, encode_model(made_up(200)))
    opening = "hyrfpack.player.open({ name: 'x.hyrf', stream: (async function* () { yield file; })() })"
    ask = "hyrfpack.player.show(camera).then(() => 'drawn', (error) => error.message)"
    run(one_browser, f"window.answers = []; window.camera = hyrfpack.camera(); window.opening = {opening};")
    many = f"(async () => {{ for (let k = 0; k < 40; k++) answers.push(await {ask}); return answers; }})()"
    assert set(one_browser.evaluate(many)) <= {"drawn", one_browser.evaluate("answers.find((a) => a !== 'drawn')")}
    one_browser.evaluate("opening.then(() => true)")
    sort = "const { player } = hyrfpack, sorted = player.loader.sort(player.view(), player.scene);"
    assert one_browser.evaluate(f"(() => {{ {sort} player.loader.dispose(); return sorted; }})()") is None


WRONG = {
    "needs width": "camera_from_world: [camera_from_world.slice(0, 3).flat()]",
    "fx and fy": "fx: -100",
    "rotation": "camera_from_world: camera_from_world.map((row) => row.map((value) => 2 * value))",
    "be a rotation": "camera_from_world: camera_from_world.map((row, r) => (r ? row : row.map((value) => -value)))",
    "pixels at most": "width: 8193",
}


@pytest.mark.parametrize("sentence", WRONG)
def test_cameras_that_make_no_sense_are_refused(one_browser: Browser, tmp_path: Path, sentence: str):
    loaded(one_browser, tmp_path, page_of(made_up(50)))
    before = one_browser.evaluate("JSON.stringify(hyrfpack.camera())")
    ask = "(({ camera_from_world, ...more }) => hyrfpack.player.show({ ...more, camera_from_world, %s }))"
    said = f"{ask % WRONG[sentence]}(hyrfpack.camera()).then(() => '', (error) => error.message)"
    assert sentence in one_browser.evaluate(said)
    assert one_browser.evaluate("JSON.stringify(hyrfpack.camera())") == before


def test_photos_may_be_larger_than_pictures_that_are_drawn(one_browser: Browser, tmp_path: Path):
    model = made_up(50)
    large = [replace(camera, width=12000, height=9000) for camera in cameras()]
    facts = {"count": 50, "frame": FRAME, "solid": model.config.solid, "up": UP, "center": CENTER}
    loaded(one_browser, tmp_path, encode_model_page(encode_model(model), title="large", cameras=large, **facts))
    assert one_browser.evaluate("hyrfpack.player.cameras[0].width") == 12000


def test_a_large_picture_keeps_no_memory(one_browser: Browser, tmp_path: Path):
    loaded(one_browser, tmp_path, page_of(made_up(50)))
    camera = replace(cameras()[0], width=1200, height=900)
    one_browser.evaluate(f"hyrfpack.show({json_of(camera)}).then(() => true)")
    settled(one_browser)
    assert max(one_browser.evaluate("hyrfpack.player.renderer.reserved")) < 900

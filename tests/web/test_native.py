"""Pages with a `.hyrf` file inside decode it in the browser and draw the same pictures as `hyrfpack.render_view`."""

from __future__ import annotations

import base64
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scenes import camera_at, shift_cameras
from web.pages import Browser, camera_json, psnr, render_in_page, wait_until

from hyrfpack.cameras.capture import provenance_cameras
from hyrfpack.cameras.files import camera_from_json
from hyrfpack.cameras.view_sampling import shrink_camera
from hyrfpack.format.codec import decode_model, encode_model
from hyrfpack.model import Frame, HashGridConfig, HybridModel, ModelConfig
from hyrfpack.model.gaussians import Gaussians
from hyrfpack.render import RenderSettings, render_view
from hyrfpack.scene import Camera
from hyrfpack.web.html import encode_model_page
from tools.safety.synthetic_encoding import encode

MODEL_FRAME = Frame((10.0, -20.0, 5.0), 7.0, (1.0, 0.5, 0.8))
EXACT_SETTINGS = RenderSettings(background_threshold=0.0, background_stride=1)
UP_DIRECTION, SCENE_CENTER = np.array([0.0, 0.0, 1.0]), np.array(MODEL_FRAME.center)
CAMERA_POSITIONS = [(0.4, -2.4, 0.7), (-2.0, 0.3, 0.2), (0.1, 0.1, 0.05), (3.5, 2.0, -1.5)]

SMALL_GRID = HashGridConfig(log2_table_size=9, levels=4, base=4, finest=40)
SIXTEEN_LEVEL_GRID = HashGridConfig(log2_table_size=11, levels=16, base=4, finest=256)
ONE_LEVEL_GRID = HashGridConfig(log2_table_size=12, levels=1, base=12, finest=12)
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
}


def random_model(count: int = 2600, seed: int = 0, **config: object) -> HybridModel:
    """Return a model with large random fields and Gaussians of all shapes and colours, inside and outside the frame."""
    shape = {"geometry": SMALL_GRID, "radiance": SMALL_GRID, "hidden": 16, "solid": (0.2, 0.3, 0.1), **config}
    generator = torch.Generator().manual_seed(seed)

    def normal(*size: int) -> torch.Tensor:
        return torch.randn(*size, generator=generator)

    positions = normal(count, 3) * 0.4 * torch.exp(normal(count, 1) * 0.5)
    gaussians = Gaussians(positions, normal(count, 3), normal(count, 1) * 0.5 - 3, normal(count, 1) + 1)
    model = HybridModel(ModelConfig(**{"frame": MODEL_FRAME, **shape}), gaussians, generator)
    with torch.no_grad():
        for field in (model.geometry, model.radiance):
            field.grid.table.copy_(normal(*field.grid.table.shape))
            for bias in field.biases:
                bias.copy_(normal(*bias.shape) * 0.3)
        # The background is evaluated along directions from the centre; trained models hardly depend on these.
        model.radiance.weights[0][:, model.radiance.grid.feature_count :] *= 0.5
    return model


def make_cameras(width: int = 120, height: int = 90) -> list[Camera]:
    """Return cameras around, among and far from the Gaussians, in world units."""
    local = [camera_at(place, up=UP_DIRECTION, width=width, height=height, focal=100.0) for place in CAMERA_POSITIONS]
    return shift_cameras([replace(camera, camera_from_world=_scale_pose(camera)) for camera in local], SCENE_CENTER)


def _scale_pose(camera: Camera) -> np.ndarray:
    pose = camera.camera_from_world.copy()
    pose[:3, 3] *= MODEL_FRAME.scale
    return pose


def make_model_page(model: HybridModel, data: bytes | None = None) -> bytes:
    data = encode_model(model) if data is None else data
    facts = {"count": len(model), "frame": model.config.frame, "solid": model.config.solid}
    return encode_model_page(
        data, title="a model", cameras=make_cameras(), up=UP_DIRECTION, center=SCENE_CENTER, **facts
    )


def render_reference(model: HybridModel, camera: Camera, settings: RenderSettings = EXACT_SETTINGS) -> np.ndarray:
    """Return the picture of `hyrfpack.render_view`, (H, W, 3) in 0 to 255."""
    with torch.no_grad():
        return render_view(model, camera, settings).rgb.clamp(0, 1).numpy() * 255


def load_page(browser: Browser, tmp_path: Path, page: bytes, complete: bool = True) -> Browser:
    """Open a page in the browser and, if `complete`, wait until its picture is complete."""
    file = tmp_path / "page.html"
    file.write_bytes(page)
    browser.open(file.as_uri())
    browser.evaluate("hyrfpack.ready")
    if complete:
        wait_until_complete(browser)
    return browser


def run_statements(browser: Browser, statements: str) -> None:
    """Run JavaScript statements in the page. Properties of `window` keep values for later calls."""
    browser.evaluate(f"(() => {{ {statements} }})()")


def wait_until_complete(browser: Browser) -> None:
    browser.evaluate("hyrfpack.player.settled.then(() => true)")


def read_typed_array(browser: Browser, expression: str, kind: type) -> np.ndarray:
    """Return the value of a JavaScript expression, a typed array whose element type is `kind`."""
    text = f"((a) => btoa(Array.from(new Uint8Array(a.buffer), (b) => String.fromCharCode(b)).join('')))({expression})"
    return np.frombuffer(base64.b64decode(browser.evaluate(text)), kind)


def read_texture(browser: Browser, name: str, width: int, words: int) -> np.ndarray:
    """Return the first `words` components of each texel of a content's texture, (texels, words) uint32."""
    script = f"""(() => {{
        const {{ gl, content }} = hyrfpack.player.renderer, height = content.height;
        const target = gl.createFramebuffer(), words = new Uint32Array(4 * {width} * height);
        gl.bindFramebuffer(gl.FRAMEBUFFER, target);
        gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, content.{name}, 0);
        gl.readPixels(0, 0, {width}, height, gl.RGBA_INTEGER, gl.UNSIGNED_INT, words);
        gl.deleteFramebuffer(target);
        return words;
    }})()"""
    return read_typed_array(browser, script, np.uint32).reshape(-1, 4)[:, :words]


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


def test_decoder_weights_are_in_a_uniform_block_on_devices_that_support_it(browser: Browser, tmp_path: Path):
    model = random_model(600)
    script = "const proto = WebGL2RenderingContext.prototype, { getParameter } = proto; proto.getParameter = "
    script += "function (name) { return name === this.RENDERER ? 'a device' : getParameter.call(this, name); }"
    with browser.before_every_page(script):
        load_page(browser, tmp_path, make_model_page(model))
        assert browser.evaluate("hyrfpack.player.renderer.content.radiance.block")
        camera = make_cameras()[0]
        assert psnr(render_in_page(browser, camera), render_reference(model, camera)) > 45


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


def encode_with_photos(model: HybridModel, width: int = 40, **more: object) -> bytes:
    """Encode a model with cameras of smaller photos, from the same places as `make_cameras`."""
    cameras = [shrink_camera(camera, width) for camera in make_cameras()]
    return encode_model(model, provenance={"cameras": provenance_cameras(cameras), **more})


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
    for camera in make_cameras():
        expected = render_reference(decode_model(data), camera, RenderSettings(background_threshold=0.0))
        assert psnr(render_in_page(browser, camera), expected) > 55
    assert browser.evaluate("hyrfpack.player.renderer.content.sky.stride") == min(64, 3 * stride)


@pytest.mark.in_turn
def test_a_still_window_requests_no_frames(browser: Browser, tmp_path: Path):
    load_page(browser, tmp_path, make_model_page(random_model()))
    frames = browser.evaluate("hyrfpack.frames()")
    run_statements(browser, "window.requests = 0; const request = requestAnimationFrame;"
                 "window.requestAnimationFrame = (frame) => (window.requests++, request(frame));")  # fmt: skip
    time.sleep(0.5)
    assert browser.evaluate("hyrfpack.frames()") == frames and browser.evaluate("window.requests") == 0


@pytest.mark.in_turn
def test_colors_are_complete_for_the_view_after_a_drag(browser: Browser, tmp_path: Path):
    model = random_model()
    load_page(browser, tmp_path, make_model_page(model))
    browser.drag((120, 90), (200, 110), steps=8)
    wait_until_complete(browser)
    rows = "hyrfpack.player.renderer.content.rows"
    turned = browser.evaluate(
        f"Array.from({{length: {rows}.count}}, (_, r) => Math.hypot(...[0, 1, 2].map("
        f"(k) => {rows}.eyes[3 * r + k] - hyrfpack.player.view().eye[k])))"
    )
    assert max(turned) < 0.05


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


def lose_and_restore_device(browser: Browser) -> None:
    """Lose and restore the WebGL device, and wait until the picture is complete."""
    browser.evaluate(
        "new Promise((resolve) => { const { player } = hyrfpack;"
        "const device = player.renderer.gl.getExtension('WEBGL_lose_context'), back = () => device.restoreContext();"
        "player.canvas.addEventListener('webglcontextlost', () => setTimeout(back, 0), {once: true});"
        "player.addEventListener('loaded', () => resolve(true), {once: true});"
        "device.loseContext(); })"
    )
    wait_until_complete(browser)


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


@pytest.mark.smoke
@pytest.mark.in_turn
def test_the_first_layer_is_shown_while_the_rest_is_loading(browser: Browser, tmp_path: Path):
    model, data = random_model(200), encode(random_model(14000), "compact")
    load_page(browser, tmp_path, make_model_page(model))
    file = base64.b64encode(data).decode()
    run_statements(
        browser,
        f"window.file = Uint8Array.from(atob('{file}'), (c) => c.charCodeAt(0));"
        "window.counts = []; window.sendRest = null; const { player } = hyrfpack;"
        "player.addEventListener('loaded', () => { counts.push(player.renderer.content.count);"
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
    wait_until_complete(browser)
    assert browser.evaluate("hyrfpack.player.whole") and browser.evaluate("counted") == 14000


def test_a_device_lost_while_a_file_is_loading_is_restored(browser: Browser, tmp_path: Path):
    model = random_model(3000)
    file = tmp_path / "page.html"
    file.write_bytes(make_model_page(model))
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


@pytest.mark.in_turn
def test_a_damaged_file_is_refused_with_one_sentence(browser: Browser, tmp_path: Path):
    data = bytearray(encode_model(random_model(50)))
    data[-20] ^= 1
    file = tmp_path / "page.html"
    file.write_bytes(make_model_page(random_model(50), bytes(data)))
    browser.open(file.as_uri())
    message = browser.evaluate("hyrfpack.ready.then(() => '', (error) => error.message)")
    assert "cannot be unpacked" in message and "\n" not in message


def store_file_in_page(browser: Browser, data: bytes) -> None:
    file = base64.b64encode(data).decode()
    run_statements(browser, f"window.file = Uint8Array.from(atob('{file}'), (c) => c.charCodeAt(0));")


def open_file_error(browser: Browser, stream: str, name: str = "x.hyrf") -> str:
    """Open a file whose bytes these statements of a generator yield; return the error message, or "" on success."""
    opening = f"hyrfpack.player.open({{ name: '{name}', stream: (async function* () {{ {stream} }})() }})"
    return browser.evaluate(f"{opening}.then(() => '', (error) => error.message)")


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
        "addEventListener('DOMContentLoaded', () => setTimeout(() => { window.bad = hyrfpack.player.open("
        "{ name: 'bad.hyrf', stream: (async function* () { yield new Uint8Array(100); })() })"
        ".then(() => '', (error) => error.message); }, 50))"
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
        "addEventListener('DOMContentLoaded', () => setTimeout(() => { window.good = hyrfpack.player.open("
        "{ name: 'good.hyrf', stream: (async function* () { yield other; })() }).then(() => true); }, 50))"
    )
    with one_browser.before_every_page(script):
        one_browser.open(file.as_uri())
        one_browser.evaluate("hyrfpack.ready")  # raises no error
        assert one_browser.evaluate("good")
        wait_until_complete(one_browser)
        assert one_browser.evaluate("hyrfpack.player.renderer.content.count") == 70


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


def test_a_large_picture_releases_its_memory(one_browser: Browser, tmp_path: Path):
    load_page(one_browser, tmp_path, make_model_page(random_model(50)))
    camera = replace(make_cameras()[0], width=1200, height=900)
    one_browser.evaluate(f"hyrfpack.show({camera_json(camera)}).then(() => true)")
    wait_until_complete(one_browser)
    assert max(one_browser.evaluate("hyrfpack.player.renderer.reserved")) < 900

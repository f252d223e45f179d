"""WebGPU draws the same pictures as WebGL 2, and WebGL 2 draws where WebGPU cannot."""

from __future__ import annotations

import json
from collections.abc import Iterator

import numpy as np
import pytest
from web.native_models import make_cameras, random_model, read_typed_array, render_reference, run_statements
from web.pages import Browser, camera_json, psnr, random_splats, wait_until
from web.site import Site, serve_site
from web.test_exposure import visible_map
from web.test_merged import make_parts
from web.test_native_pictures import MODEL_SETTINGS
from web.viewer_pages import serve_modules, viewer_page

from hyrfpack.format.codec import encode_model
from hyrfpack.format.parts import encode_parts
from hyrfpack.model.merged import MergedModel
from hyrfpack.splats.formats import spz
from hyrfpack.splats.formats.hints import Hints
from tools.browser import chromium

pytestmark = pytest.mark.acceptance
MIN_PSNR_DB = 50  # of the pictures of WebGPU and WebGL 2
TWO_BOXES_HTML = '<div id="first" class="box"></div><div id="second" class="box"></div>'
PAGE_JS = """
const { WebgpuRenderer } = await import("/viewer/webgpu/renderer.js");
const { setShaderSource } = await import("/viewer/webgpu/shaders.js");
setShaderSource((name) => texts[name]);
window.viewers = { webgl: createViewer({ container: "#first" }) };
viewers.webgpu = createViewer({ container: "#second", renderer: WebgpuRenderer });
"""
OBSERVED_DEVICE_JS = """
const prototype = GPUAdapter.prototype, { requestDevice } = prototype;
window.devices = [];
prototype.requestDevice = async function (options) {
  const device = await requestDevice.call(this, options);
  const observed = { device, live: 0, lose: null };
  const lost = new Promise((resolve) => (observed.lose = () => { device.destroy(); resolve({ reason: "unknown" }); }));
  Object.defineProperty(device, "lost", { value: lost });
  for (const name of ["createBuffer", "createTexture"]) {
    const create = device[name].bind(device);
    device[name] = (description) => {
      const object = create(description), destroy = object.destroy.bind(object);
      observed.live++;
      object.destroy = () => { observed.live--; destroy(); };
      return object;
    };
  }
  devices.push(observed);
  return device;
};
"""
FAILURES_JS = {
    "a refused shader": """
const prototype = GPUDevice.prototype, { createShaderModule } = prototype;
prototype.createShaderModule = function ({ code }) {
  return createShaderModule.call(this, { code: code.includes("residuals: array") ? "no shader" : code });
};
""",
    "too little memory": """
const prototype = GPUDevice.prototype, { createBuffer } = prototype;
prototype.createBuffer = function (description) {
  const error = new GPUOutOfMemoryError("full");
  if (description.size > 3e4) this.dispatchEvent(new GPUUncapturedErrorEvent("uncapturederror", { error }));
  return createBuffer.call(this, description);
};
""",
    "an error while it draws": """
const prototype = GPURenderPassEncoder.prototype, { drawIndirect } = prototype;
let draws = 0;
prototype.drawIndirect = function (buffer, offset) {
  drawIndirect.call(this, buffer, ++draws === 2 ? 1 : offset);
};
""",
    "no adapter": "navigator.gpu.requestAdapter = async () => null;",
}
SORT_JS = """
async (cases) => {
  const { DeviceObjects, openDevice } = await import("/viewer/webgpu/device.js");
  const { RadixSort } = await import("/viewer/webgpu/radix_sort.js");
  const device = await openDevice(() => {}), objects = new DeviceObjects(device), results = {};
  const pipelines = await RadixSort.compile(objects), { COPY_DST, MAP_READ } = GPUBufferUsage;
  const read = async (source) => {
    const { size } = source, copy = device.createBuffer({ size, usage: COPY_DST | MAP_READ });
    const encoder = device.createCommandEncoder();
    encoder.copyBufferToBuffer(source, 0, copy, 0, size);
    device.queue.submit([encoder.finish()]);
    await copy.mapAsync(GPUMapMode.READ);
    return new Uint32Array(copy.getMappedRange());
  };
  for (const [name, keys] of Object.entries(cases)) {
    const sort = new RadixSort(objects, pipelines, objects.upload(new Uint32Array(keys)), keys.length);
    const encoder = device.createCommandEncoder(), pass = encoder.beginComputePass();
    sort.encode(pass);
    pass.end();
    device.queue.submit([encoder.finish()]);
    const [vertices, instances] = await read(sort.drawArguments), pairs = await read(sort.order);
    results[name] = { vertices, instances, indices: [...pairs.filter((_, place) => place % 2).slice(0, vertices / 6)] };
  }
  device.destroy();
  return results;
}
"""


@pytest.fixture(scope="module")
def webgpu_browser() -> Iterator[Browser]:
    if chromium.find_program() is None:
        pytest.skip("there is no Chromium here, or no Playwright to drive it")
    with chromium.Chromium(*chromium.WEBGPU_FLAGS) as browser:
        browser.resize(240, 400)
        with serve_site() as site:  # only pages of servers have `navigator.gpu`
            site.files["/empty.html"] = b"<!DOCTYPE html>"
            browser.open(f"{site.address}/empty.html")
            if not browser.evaluate("navigator.gpu?.requestAdapter().then(Boolean) ?? false"):
                pytest.skip("this Chromium has no software adapter for WebGPU")
        yield browser


@pytest.fixture
def page(webgpu_browser: Browser, host: Site) -> Browser:
    """Return a page with two viewers, `viewers.webgl` and `viewers.webgpu`."""
    serve_modules(host)
    return open_page(webgpu_browser, host)


def open_page(browser: Browser, host: Site) -> Browser:
    host.files["/page.html"] = viewer_page(PAGE_JS, TWO_BOXES_HTML)
    browser.open(f"{host.address}/page.html")
    wait_until(browser, "window.isPageReady")
    return browser


def load(page: Browser, host: Site, data: bytes, name: str = "scene.hyrf", kinds: str = "webgl webgpu") -> None:
    """Load a file in viewers and wait until their pictures are complete."""
    host.files[f"/{name}"] = data
    for kind in kinds.split():
        viewer = f"viewers.{kind}"
        page.evaluate(f"{viewer}.load('/{name}').then(() => {viewer}.player.settled).then(() => true)")


def is_on_device(page: Browser) -> bool:
    return page.evaluate("viewers.webgpu.player.renderer.isOnDevice")


def draw(page: Browser, kind: str, index: int = 0) -> np.ndarray:
    """Return the picture of a viewer for one of `make_cameras`, (H, W, 3) uint8."""
    camera = make_cameras()[index]
    pixels = read_typed_array(page, f"viewers.{kind}.player.show({camera_json(camera)})", np.uint8)
    return pixels.reshape(camera.height, camera.width, 3)


def psnr_between_renderers(page: Browser, index: int = 0) -> float:
    """Return the PSNR in dB of the pictures of both viewers for one of `make_cameras`."""
    return psnr(draw(page, "webgl", index).astype(float), draw(page, "webgpu", index).astype(float))


SMOKE_CASE = "harmonics, product, solid"  # it has no background, whose evaluation takes long


@pytest.mark.parametrize(
    "case",
    [pytest.param(SMOKE_CASE, marks=pytest.mark.smoke), *(name for name in MODEL_SETTINGS if name != SMOKE_CASE)],
)
def test_pictures_equal_those_of_webgl_and_of_render(page: Browser, host: Site, case: str):
    model = random_model(**MODEL_SETTINGS[case])
    load(page, host, encode_model(model))
    assert is_on_device(page)
    for index, camera in enumerate(make_cameras()):
        picture = draw(page, "webgpu", index)
        assert psnr(picture, draw(page, "webgl", index).astype(float)) > MIN_PSNR_DB
        assert psnr(picture, render_reference(model, camera)) > 45
    assert page.list_errors() == []


def test_a_pick_outside_of_the_canvas_is_null_and_webgpu_goes_on(page: Browser, host: Site):
    load(page, host, encode_model(random_model(300)), kinds="webgpu")
    assert page.evaluate("[viewers.webgpu.pick(-5, 20), viewers.webgpu.pick(20, 1e5)]") == [None, None]
    assert is_on_device(page) and page.evaluate("viewers.webgpu.player.lost") is False
    assert page.list_errors() == []


@pytest.mark.parametrize("exposure", ["as-photographed", "consistent"])
def test_exposures_equal_those_of_webgl(page: Browser, host: Site, exposure: str):
    model = random_model(600)
    model.exposure = visible_map()
    run_statements(page, f"for (const viewer of Object.values(viewers)) viewer.exposure = '{exposure}';")
    load(page, host, encode_model(model))
    scores = [psnr_between_renderers(page, index) for index in range(len(make_cameras()))]
    assert is_on_device(page) and min(scores) > MIN_PSNR_DB, scores


FRAME_JS = """(async () => {
  const { player } = viewers.KIND, { renderer, canvas, scene } = player, { width, height } = canvas;
  player.pause();
  MOVE
  const view = player.view(), flat = new OffscreenCanvas(width, height).getContext("2d");
  await player.sortFor(view);
  renderer.draw(view, SCALE, player.exposureOf(view));
  renderer.present();
  flat.drawImage(canvas, 0, 0);
  return flat.getImageData(0, 0, width, height).data;
})()"""
# The device is so quick that it evaluates all tiles of the panorama, or the background of the view itself.
MOVE_JS = """
  const { content } = renderer;
  player.eye.orbit(0.3, 0.1);
  content.panorama.pace.unit = 1e-6;
  content.recolor(player.view(), scene.tolerance, 1e6, FOLLOWS);
"""
FRAMES = {
    "at rest": ("1", ""),
    "at rest at a lower resolution": ("0.4", ""),
    "moving, with the panorama": ("0.5", MOVE_JS.replace("FOLLOWS", "false")),
    "moving, with the background of the view": ("0.5", MOVE_JS.replace("FOLLOWS", "true")),
}


@pytest.mark.parametrize("case", FRAMES)
def test_frames_of_the_window_equal_those_of_webgl(page: Browser, host: Site, case: str):
    load(page, host, encode_model(random_model(600)))
    scale, move = FRAMES[case]
    script = FRAME_JS.replace("MOVE", move).replace("SCALE", scale)
    pictures = [read_typed_array(page, script.replace("KIND", kind), np.uint8) for kind in ("webgl", "webgpu")]
    assert psnr(*(picture.astype(float) for picture in pictures)) > MIN_PSNR_DB and pictures[0].std() > 10


def test_points_are_picked_as_with_webgl(page: Browser, host: Site):
    load(page, host, encode_model(random_model(2600)))
    points = [page.evaluate(f"viewers.{kind}.pick(120, 90)") for kind in ("webgl", "webgpu")]
    np.testing.assert_allclose(*points, atol=2e-2)


def test_a_model_without_gaussians_shows_its_background_and_nothing_is_picked(page: Browser, host: Site):
    model = random_model(0)
    load(page, host, encode_model(model))
    assert is_on_device(page) and page.evaluate("viewers.webgpu.pick(120, 90)") is None
    assert psnr(draw(page, "webgpu"), render_reference(model, make_cameras()[0])) > MIN_PSNR_DB


SKIPPED_KEY = 0xFFFFFFFF
KEY_RANDOM = np.random.default_rng(5)
KEYS_TO_SORT = {
    "no keys": [],
    "one key": [7],
    "all are skipped": [SKIPPED_KEY] * 700,
    "equal keys of several blocks": [12] * 4500,
    "a whole block": KEY_RANDOM.integers(0, 2**32 - 1, 2048).tolist(),
    "one more than two blocks": KEY_RANDOM.integers(0, 2**32 - 1, 4097).tolist(),
    "few values, some skipped": KEY_RANDOM.choice([0, 1, 255, 256, 2**31, SKIPPED_KEY - 1, SKIPPED_KEY], 5000).tolist(),
}


def test_the_order_is_that_of_a_stable_sort_with_larger_indices_first(page: Browser):
    found = page.evaluate(f"({SORT_JS})({json.dumps(KEYS_TO_SORT)})")
    for case, values in KEYS_TO_SORT.items():
        keys = np.array(values, np.int64)
        indices = np.lexsort((-np.arange(len(keys)), keys))
        expected = indices[keys[indices] != SKIPPED_KEY].tolist()
        assert found[case] == {"vertices": 6 * len(expected), "instances": 1, "indices": expected}, case


def encode_merged(model: MergedModel) -> bytes:
    return encode_parts(list(zip(model.names, map(encode_model, model.parts), strict=True)))


OTHER_SCENES = {
    "splats": ("cloud.spz", lambda: spz.encode(random_splats(300), Hints(spz_version=3))),
    "merged models": ("merged.hyrf", lambda: encode_merged(make_parts())),
}


@pytest.mark.parametrize("kind", OTHER_SCENES)
def test_other_scenes_are_drawn_with_webgl_in_the_same_canvas(page: Browser, host: Site, kind: str):
    name, encode = OTHER_SCENES[kind]
    data = encode_model(random_model(300))
    load(page, host, data, kinds="webgpu")
    before = draw(page, "webgpu")
    assert is_on_device(page)
    load(page, host, encode(), name, kinds="webgpu")
    assert not is_on_device(page)
    load(page, host, data, kinds="webgpu")
    assert is_on_device(page)
    np.testing.assert_array_equal(draw(page, "webgpu"), before)
    assert page.list_errors() == []


def test_webgl_draws_after_the_device_is_lost(webgpu_browser: Browser, host: Site):
    serve_modules(host)
    with webgpu_browser.before_every_page(OBSERVED_DEVICE_JS):
        page = open_page(webgpu_browser, host)
        load(page, host, encode_model(random_model(600)))
        run_statements(
            page,
            "window.remarks = []; const { player } = viewers.webgpu;"
            "player.addEventListener('remark', ({ detail }) => remarks.push(detail));"
            "player.addEventListener('loaded', () => (window.isShownAgain = true)); devices[0].lose();",
        )
        wait_until(page, "window.isShownAgain")
        page.evaluate("viewers.webgpu.player.settled.then(() => true)")
        assert not is_on_device(page)
        assert "was lost" in page.evaluate("remarks[0]") and page.evaluate("remarks.at(-1)") == ""
        np.testing.assert_array_equal(draw(page, "webgpu"), draw(page, "webgl"))


@pytest.mark.parametrize("failure", FAILURES_JS)
def test_webgl_draws_the_model_after(webgpu_browser: Browser, host: Site, failure: str):
    serve_modules(host)
    with webgpu_browser.before_every_page(FAILURES_JS[failure]):
        page = open_page(webgpu_browser, host)
        load(page, host, encode_model(random_model(300)))
        wait_until(page, "!viewers.webgpu.player.renderer.isOnDevice")
        page.evaluate("viewers.webgpu.player.settled.then(() => true)")
        assert page.evaluate("viewers.webgpu.scene.kind") == "hyrf"
        np.testing.assert_array_equal(draw(page, "webgpu"), draw(page, "webgl"))


def test_buffers_are_freed_with_their_scene_and_the_device_with_the_viewer(webgpu_browser: Browser, host: Site):
    serve_modules(host)
    with webgpu_browser.before_every_page(OBSERVED_DEVICE_JS):
        page = open_page(webgpu_browser, host)
        counts = []
        for _ in range(4):
            load(page, host, encode_model(random_model(300)), kinds="webgpu")
            counts.append(page.evaluate("devices[0].live"))
        assert len(set(counts[1:])) == 1, counts
        script = "const { destroy } = GPUDevice.prototype; window.ended = [];"
        script += "GPUDevice.prototype.destroy = function () { ended.push(this); destroy.call(this); };"
        run_statements(page, script + "viewers.webgpu.destroy(); viewers.webgl.destroy();")
        assert page.evaluate("ended.length === 1 && ended[0] === devices[0].device")


def test_two_viewers_draw_with_webgpu_side_by_side(page: Browser, host: Site):
    data = encode_model(random_model(300))
    load(page, host, data)
    run_statements(
        page, "const { constructor } = viewers.webgpu.player.renderer; viewers.webgl.destroy();"
        "viewers.webgl = createViewer({ container: '#first', renderer: constructor });"
    )  # fmt: skip
    before = draw(page, "webgpu")
    load(page, host, data, kinds="webgl")
    assert page.evaluate("viewers.webgl.player.renderer.isOnDevice")
    np.testing.assert_array_equal(draw(page, "webgl"), before)
    np.testing.assert_array_equal(draw(page, "webgpu"), before)


def test_an_unknown_renderer_is_refused(page: Browser):
    script = "try { createViewer({ container: '#first', renderer: 'webgpu' }); return ''; }"
    assert "hyrf-viewer/webgpu" in page.evaluate(f"(() => {{ {script} catch (error) {{ return error.message; }} }})()")

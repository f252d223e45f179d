"""`createViewer` shows scenes in elements of other pages, which control it by a typed interface."""

from __future__ import annotations

import base64
import io
import re
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from web.pages import Browser, psnr, wait_until
from web.site import Site
from web.viewer_pages import serve_modules, viewer_page

import hyrfpack
from hyrfpack.render import render_view
from hyrfpack.web.assets import read_web_file

pytestmark = [pytest.mark.in_turn, pytest.mark.usefixtures("reset_window")]
REPOSITORY_ROOT = Path(__file__).parents[2]
GOLDEN_FILE = REPOSITORY_ROOT / "tests" / "golden" / "v1.1_compact.hyrf"
CREATE_JS = "window.viewer = createViewer({ container: '#box', src: 'some scene.hyrf' });"
READY_JS = "viewer.isReady"
PAUSE_SECONDS = 5


@pytest.fixture
def site(host: Site) -> Site:
    serve_modules(host)
    return host


def open_viewer(browser: Browser, site: Site, script: str = CREATE_JS, body: str | None = None) -> None:
    site.files["/post.html"] = viewer_page(script) if body is None else viewer_page(script, body)
    browser.open(f"{site.address}/post.html")
    wait_until(browser, "window.isPageReady")


def error_of(browser: Browser, expression: str) -> str:
    return browser.evaluate(f"(async () => {expression})().then(() => '', (error) => error.message)")


def test_a_viewer_draws_what_render_draws_from_the_same_camera(browser: Browser, site: Site):
    open_viewer(browser, site)
    wait_until(browser, READY_JS)
    address = browser.evaluate(
        "viewer.screenshot().then((blob) => new Promise((done) => { const reader = new FileReader();"
        " reader.onload = () => done(reader.result); reader.readAsDataURL(blob); }))"
    )
    picture = np.asarray(Image.open(io.BytesIO(base64.b64decode(address.partition(",")[2]))).convert("RGB"), float)
    camera = hyrfpack.Camera(**{
        name: np.array(value) if name == "camera_from_world" else value
        for name, value in browser.evaluate("viewer.camera").items()
    })  # fmt: skip
    assert picture.shape == (camera.height, camera.width, 3)
    expected = render_view(hyrfpack.load_model(GOLDEN_FILE), camera).rgb.clamp(0, 1).numpy() * 255
    assert psnr(picture, expected) > 45
    assert browser.list_errors() == []


def test_a_viewer_whose_worker_fails_is_not_ready_and_takes_no_screenshot(browser: Browser, site: Site):
    open_viewer(browser, site)
    wait_until(browser, READY_JS)
    browser.evaluate("viewer.screenshot().then(() => viewer.on('error', ({ error }) => (window.failure = error)), 0)")
    browser.evaluate(
        "viewer.player.loader.connection.shared.worker.dispatchEvent(new ErrorEvent('error', { message: 'no memory' }))"
    )
    assert "no memory" in browser.evaluate("failure.message") and not browser.evaluate(READY_JS)
    assert error_of(browser, "viewer.screenshot()") == browser.evaluate("failure.message")
    assert "gone.hyrf" in error_of(browser, "viewer.load('gone.hyrf')") and not browser.evaluate(READY_JS)


def test_events_report_progress_that_never_falls_then_ready_with_the_scene(browser: Browser, site: Site):
    script = (
        CREATE_JS + "window.parts = []; viewer.on('progress', ({ progress }) => parts.push(progress));"
        "waitFor(viewer, 'ready').then(({ scene }) => { window.scene = scene; });"
    )
    open_viewer(browser, site, script)
    wait_until(browser, "window.scene")
    parts = browser.evaluate("parts")
    assert parts == sorted(parts) and parts[-1] == 1 and browser.evaluate("viewer.progress") == 1
    model = hyrfpack.load_model(GOLDEN_FILE)
    assert browser.evaluate("[scene.kind, scene.count, scene.title]") == ["hyrf", len(model), "some scene.hyrf"]
    assert browser.evaluate("scene.cameras.length") > 0


def pose_of(camera: dict) -> tuple[np.ndarray, np.ndarray]:
    """Return the rotation and the centre of a camera in world units."""
    pose = np.array(camera["camera_from_world"])[:3]
    return pose[:, :3], -pose[:, :3].T @ pose[:, 3]


def is_same_pose(first: dict, second: dict) -> bool:
    (turn, center), (other_turn, other_center) = pose_of(first), pose_of(second)
    return np.allclose(turn, other_turn, atol=1e-5) and np.allclose(center, other_center, rtol=0, atol=1e-3)


def test_a_camera_that_was_set_is_read_back_and_reported(browser: Browser, site: Site):
    open_viewer(browser, site)
    wait_until(browser, READY_JS)
    browser.evaluate("window.moves = 0, viewer.on('camera', () => { window.moves++; }), 0")
    first = browser.evaluate("viewer.camera")
    chosen = browser.evaluate(
        "((camera) => { camera.camera_from_world[2][3] += 0.25; viewer.camera = camera; return camera; })"
        "(viewer.camera)"
    )
    assert is_same_pose(browser.evaluate("viewer.camera"), chosen) and not is_same_pose(first, chosen)
    wait_until(browser, "moves > 0")
    text = browser.evaluate("viewer.cameraText")
    browser.evaluate("(viewer.camera = 0, 0)")
    assert not is_same_pose(browser.evaluate("viewer.camera"), chosen)
    browser.evaluate(f"(viewer.camera = {text!r}, 0)")
    assert is_same_pose(browser.evaluate("viewer.camera"), chosen)


def test_move_to_glides_and_ends_at_the_camera(browser: Browser, site: Site):
    open_viewer(browser, site)
    wait_until(browser, READY_JS)
    moved = browser.evaluate(
        "(() => { const camera = viewer.camera, depth = camera.camera_from_world[2][3];"
        " camera.camera_from_world[2][3] += 0.5; window.end = depth + 0.5; viewer.moveTo(camera, { seconds: 0.3 });"
        " return viewer.camera.camera_from_world[2][3] - depth; })()"
    )
    assert moved == pytest.approx(0, abs=1e-3), "it jumped"
    wait_until(browser, "Math.abs(viewer.camera.camera_from_world[2][3] - end) < 1e-4")


def test_pick_returns_the_visible_point_in_world_units(browser: Browser, site: Site):
    open_viewer(browser, site)
    wait_until(browser, READY_JS)
    point = np.array(browser.evaluate("viewer.screenshot().then(() => viewer.pick(120, 90))"))
    camera = browser.evaluate("viewer.camera")
    seen = np.array(camera["camera_from_world"])[:3] @ [*point, 1]
    scale = camera["width"] / 240
    assert seen[2] > 0
    assert camera["fx"] * seen[0] / seen[2] + camera["cx"] == pytest.approx(120 * scale, abs=0.6)
    assert camera["fy"] * seen[1] / seen[2] + camera["cy"] == pytest.approx(90 * scale, abs=0.6)


def test_pick_returns_null_outside_of_the_canvas(browser: Browser, site: Site):
    open_viewer(browser, site)
    wait_until(browser, READY_JS)
    for place in ("-1, 90", "120, -1", "240, 90", "120, 180", "NaN, 90"):
        assert browser.evaluate(f"viewer.pick({place})") is None, place


SOURCES_JS = {
    "a URL": "new URL('some scene.hyrf', document.baseURI)",
    "a Blob": "await (await fetch('some scene.hyrf')).blob()",
    "an ArrayBuffer": "await (await fetch('some scene.hyrf')).arrayBuffer()",
    "bytes": "new Uint8Array(await (await fetch('some scene.hyrf')).arrayBuffer())",
    "shared memory": "shareBytes(new Uint8Array(await (await fetch('some scene.hyrf')).arrayBuffer()))",
    "a stream": "(await fetch('some scene.hyrf')).body",
}


SHARE_BYTES_JS = """window.shareBytes = (bytes) => {
  const { buffer } = new WebAssembly.Memory({ initial: 8, maximum: 8, shared: true });
  const shared = new Uint8Array(buffer, 0, bytes.length);
  shared.set(bytes);
  return shared;
};
"""


@pytest.mark.parametrize("kind", SOURCES_JS)
def test_scenes_are_loaded_from(browser: Browser, site: Site, kind: str):
    open_viewer(
        browser, site, SHARE_BYTES_JS + "window.viewer = createViewer({ container: document.getElementById('box') });"
    )
    browser.evaluate(f"(async () => {{ window.src = {SOURCES_JS[kind]}; await viewer.load(src); }})()")
    assert browser.evaluate("viewer.scene.kind") == "hyrf"
    if "bytes" in kind or "shared" in kind:
        assert browser.evaluate("src.length") > 0, "the caller's bytes were taken away"


def test_the_decoder_reads_merged_files_and_manifests_in_shared_memory(browser: Browser, site: Site):
    golden = REPOSITORY_ROOT / "tests" / "golden"
    site.files["/merged.hyrf"] = (golden / "merged" / "v1.4_merged.hyrf").read_bytes()
    site.files["/scene.json"] = (golden / "scene" / "scene.json").read_bytes()
    open_viewer(browser, site, SHARE_BYTES_JS)
    browser.evaluate(
        "(async () => { const { readParts } = await import('/hyrf/index.js');"
        " const { parseManifest } = await import('/hyrf/manifest.js');"
        " const load = async (name) => shareBytes(new Uint8Array(await (await fetch(name)).arrayBuffer()));"
        " window.counts = [(await readParts(await load('merged.hyrf'))).length,"
        " parseManifest(await load('scene.json')).gaussians]; })()"
    )
    merged = hyrfpack.load_merged_model(golden / "merged" / "v1.4_merged.hyrf")
    manifest = hyrfpack.SceneFolder(golden / "scene").manifest
    assert browser.evaluate("counts") == [len(merged.parts), manifest.gaussians]


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("'gone.hyrf'", "gone.hyrf could not be fetched (404"),
        ("new Blob(['no scene'])", "the scene cannot be opened: "),
        ("42", "A scene is an address, a Blob"),
        ("'http://['", "is no address of a file"),
    ],
)
def test_a_failed_load_rejects_and_fires_one_error(browser: Browser, site: Site, source: str, words: str):
    open_viewer(browser, site, CREATE_JS + "window.errors = []; viewer.on('error', ({ error }) => errors.push(error));")
    wait_until(browser, READY_JS)
    assert words in error_of(browser, f"viewer.load({source})")
    assert browser.evaluate("errors.length") == 1 and words in browser.evaluate("errors[0].message")
    assert browser.evaluate("viewer.scene.kind") == "hyrf", "the earlier scene stays"


def test_a_load_that_is_replaced_rejects_with_an_abort_error_and_fires_nothing(browser: Browser, site: Site):
    open_viewer(
        browser,
        site,
        "window.viewer = createViewer({ container: '#box' }); window.errors = [];"
        "viewer.on('error', ({ error }) => errors.push(error.message));"
        "window.first = viewer.load('some scene.hyrf').then(() => 'shown', ({ name }) => name);"
        "window.second = viewer.load('cloud.spz').then(() => 'shown', ({ name }) => name);",
    )
    assert browser.evaluate("Promise.all([first, second])") == ["AbortError", "shown"]
    assert browser.evaluate("[viewer.scene.count, errors]") == [300, []]


def test_a_scene_that_still_loads_is_not_shown_when_the_next_one_is_missing(browser: Browser, site: Site):
    open_viewer(
        browser,
        site,
        "window.viewer = createViewer({ container: '#box' }); const source = new ReadableStream({"
        " start: (controller) => { window.controller = controller; } });"
        "window.first = viewer.load(source).then(() => 'shown', ({ name }) => name);"
        "window.bytes = new Uint8Array(await (await fetch('some scene.hyrf')).arrayBuffer());",
    )
    browser.evaluate("controller.enqueue(bytes.slice(0, 500)), new Promise((done) => setTimeout(done, 50))")
    assert "404" in error_of(browser, "viewer.load('gone.hyrf')")
    assert browser.evaluate("Promise.race([first, new Promise((done) => setTimeout(done, 2000))])") == "AbortError"
    browser.evaluate("viewer.load('cloud.spz')")
    assert browser.evaluate("[viewer.isReady, viewer.scene.count]") == [True, 300]


def test_a_scene_of_which_a_part_is_shown_becomes_ready_when_the_next_one_is_missing(browser: Browser, site: Site):
    open_viewer(
        browser,
        site,
        "window.viewer = createViewer({ container: '#box' }); window.fired = 0;"
        "viewer.on('ready', () => { window.fired++; });"
        "window.bytes = new Uint8Array(await (await fetch('some scene.hyrf')).arrayBuffer());"
        "window.first = viewer.load(bytes);",
    )
    # While the scene is shown, its loader has not ended.
    browser.evaluate(
        "(async () => { const { player } = viewer, open = player.open.bind(player); await first; window.fired = 0;"
        " player.open = (file) => open(file).then(() => new Promise((done) => { window.end = done; }));"
        " window.second = viewer.load(bytes).then(() => 'shown', ({ name }) => name); })()"
    )
    wait_until(browser, "Boolean(window.end)")
    assert "404" in error_of(browser, "viewer.load('gone.hyrf')")
    browser.evaluate("end(), second")
    assert browser.evaluate("[viewer.isReady, window.fired]") == [True, 1]


def test_the_time_of_a_pause_is_not_that_of_a_frame(browser: Browser, site: Site):
    open_viewer(browser, site)
    wait_until(browser, READY_JS)
    browser.evaluate(
        "((player) => { window.times = []; player.measure = (took) => times.push(took);"
        " window.turn = () => { player.eye.orbit(0.1, 0); player.changed(); }; turn(); })(viewer.player)"
    )
    wait_until(browser, "viewer.player.began !== null")
    browser.evaluate("viewer.player.pause(), 0")
    time.sleep(PAUSE_SECONDS)
    browser.evaluate("viewer.player.resume(), turn(), 0")
    wait_until(browser, "(viewer.player.began === null && turn(), times.length > 0)")
    assert max(browser.evaluate("times")) < 1000 * PAUSE_SECONDS


def test_frames_wait_for_their_own_order_after_a_preview(browser: Browser, site: Site):
    open_viewer(browser, site)
    wait_until(browser, READY_JS)
    browser.evaluate("viewer.player.settled.then(() => true)")
    browser.evaluate(
        "((renderer, { read } = renderer) => { window.sorted = []; renderer.read = (...all) => {"
        " queueMicrotask(() => sorted.push(renderer.isSorted)); return read.apply(renderer, all); }; })"
        "(viewer.player.renderer)"
    )
    size = browser.evaluate("viewer.player.preview([viewer.player.view()]).then((pictures) => pictures?.length ?? 0)")
    assert size == 1 and browser.evaluate("sorted") == [False]


DELAYED_LOAD_JS = (
    "window.viewer = createViewer({ container: '#box' }); window.fired = 0;"
    "viewer.on('ready', () => { window.fired++; });"
    "window.stateOf = (promise) => promise.then(() => 'shown', ({ name }) => name);"
    "window.startStream = () => new ReadableStream({ start: (controller) => { window.controller = controller; } });"
    "window.bytes = new Uint8Array(await (await fetch('some scene.hyrf')).arrayBuffer());"
    # While the scene is shown, its loader has not ended.
    "const { player } = viewer, open = player.open.bind(player);"
    "player.open = (file) => open(file).then(() => new Promise((done) => { window.end = done; }));"
    "window.first = stateOf(viewer.load(bytes));"
)


def test_a_scene_that_is_complete_before_the_next_load_fails_becomes_ready(browser: Browser, site: Site):
    open_viewer(browser, site, DELAYED_LOAD_JS)
    wait_until(browser, "Boolean(window.end)")
    browser.evaluate("(window.second = stateOf(viewer.load(startStream())), 0)")
    assert browser.evaluate("end(), first") == "AbortError"
    assert browser.evaluate("[viewer.isReady, fired]") == [False, 0], "the second scene is still being loaded"
    assert browser.evaluate("controller.error(new Error('broken')), second") == "Error"
    assert browser.evaluate("[viewer.isReady, viewer.progress, fired]") == [True, 1, 1]
    assert "404" in error_of(browser, "viewer.load('gone.hyrf')")
    assert browser.evaluate("[viewer.isReady, viewer.progress, fired]") == [True, 1, 1], "it is reported once"


def test_a_scene_of_which_a_part_is_shown_becomes_ready_after_two_later_loads(browser: Browser, site: Site):
    open_viewer(browser, site, DELAYED_LOAD_JS)
    wait_until(browser, "Boolean(window.end)")
    browser.evaluate("(window.second = stateOf(viewer.load(startStream())), 0)")
    wait_until(browser, "viewer.player.next !== null")
    assert "404" in error_of(browser, "viewer.load('gone.hyrf')")
    assert browser.evaluate("second") == "AbortError"
    assert browser.evaluate("[viewer.isReady, fired]") == [False, 0]
    assert browser.evaluate("end(), first") == "shown"
    assert browser.evaluate("[viewer.isReady, viewer.progress, fired]") == [True, 1, 1]


def test_a_viewer_that_turns_stands_still_for_a_screenshot_and_turns_on(browser: Browser, site: Site):
    open_viewer(browser, site, CREATE_JS.replace(" });", ", autorotate: true });"))
    wait_until(browser, READY_JS)
    late = "new Promise((done) => setTimeout(done, 20000, 'never'))"
    picture = "viewer.screenshot().then(({ type }) => type)"
    assert browser.evaluate(f"Promise.race([{picture}, {late}])") == "image/png"
    text = browser.evaluate("viewer.cameraText")
    wait_until(browser, f"viewer.cameraText !== {text!r}")


def test_a_screenshot_is_completed_out_of_the_window(browser: Browser, site: Site):
    open_viewer(browser, site)
    wait_until(browser, READY_JS)
    browser.evaluate(
        "Object.defineProperty(viewer.player, 'settled', { get: () => new Promise((r) => { window.settle = r; }) }),"
        "window.picture = viewer.screenshot(), viewer.watch(false)"
    )
    assert not browser.evaluate("viewer.player.paused")
    assert browser.evaluate("settle(), picture.then(({ type }) => type)") == "image/png"
    assert browser.evaluate("viewer.player.paused")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("{}", "needs a container"),
        ("{ container: '#missing' }", "needs a container"),
        ("{ container: '#box', exposure: 'dark' }", "exposure must be as-photographed, consistent, not dark"),
        ("{ container: '#box', loading: 'later' }", "loading must be eager, lazy, not later"),
        ("{ container: '#box', interaction: true }", "interaction must be"),
        ("{ container: '#box', maxGaussians: 0 }", "maxGaussians must be a whole number of at least 1, not 0"),
        ("{ container: '#box', maxGaussians: NaN }", "maxGaussians must be a whole number of at least 1, not NaN"),
        ("{ container: '#box', workerUrl: 'http://[' }", "workerUrl must be the address of the worker's script"),
    ],
)
def test_invalid_options_are_refused_by_name(browser: Browser, site: Site, options: str, words: str):
    open_viewer(browser, site, "")
    assert words in error_of(browser, f"createViewer({options})")
    assert browser.evaluate("document.querySelectorAll('canvas').length") == 0


def test_an_invalid_camera_is_refused(browser: Browser, site: Site):
    open_viewer(browser, site)
    assert "has no scene yet" in error_of(browser, "viewer.moveTo(0)")
    wait_until(browser, READY_JS)
    assert "There is no camera 99" in error_of(browser, "viewer.moveTo(99)")
    assert error_of(browser, "viewer.moveTo('99')").startswith("The camera 99 cannot be used: there is no camera 99")
    assert "camera_from_world" in error_of(browser, "viewer.moveTo({ width: 3 })")
    for camera in ("undefined", "null", "true"):
        assert f"A camera is a number, a text or an object, not {camera}" in error_of(
            browser, f"viewer.moveTo({camera})"
        )
    assert "seconds must be a finite number" in error_of(browser, "viewer.moveTo(0, { seconds: Infinity })")
    assert browser.evaluate("viewer.screenshot().then(({ type }) => type)") == "image/png"


def test_a_container_may_be_in_a_frame(browser: Browser, site: Site):
    script = (
        "const frame = document.createElement('iframe'); document.body.append(frame);"
        "frame.contentDocument.body.innerHTML = '<div style=\"height: 100px\"></div>';"
        "window.viewer = createViewer({ container: frame.contentDocument.querySelector('div'), src: 'cloud.spz' });"
    )
    open_viewer(browser, site, script)
    wait_until(browser, READY_JS)
    assert browser.evaluate("viewer.screenshot().then(({ size }) => size)") > 1000


# ---- several viewers

TWO_BOXES_HTML = '<div id="box" class="box"></div><div style="height: 3000px"></div><div id="low" class="box"></div>'


def test_a_lazy_viewer_loads_nothing_until_it_is_near_the_window(browser: Browser, site: Site):
    script = CREATE_JS + "window.low = createViewer({ container: '#low', src: 'cloud.spz', loading: 'lazy' });"
    open_viewer(browser, site, script, TWO_BOXES_HTML)
    wait_until(browser, READY_JS)
    assert not any(path == "/cloud.spz" for path, _ in site.requests)
    browser.evaluate("document.getElementById('low').scrollIntoView()")
    wait_until(browser, "low.isReady")
    assert browser.evaluate("low.scene.count") == 300


def test_a_viewer_is_ready_again_if_the_next_scene_cannot_be_loaded(browser: Browser, site: Site):
    open_viewer(browser, site, CREATE_JS + "window.fails = createViewer({ container: '#box', src: 'gone.hyrf' });")
    wait_until(browser, READY_JS)
    assert "404" in error_of(browser, "viewer.load('gone.hyrf')")
    assert browser.evaluate("[viewer.isReady, viewer.progress]") == [True, 1]
    assert browser.evaluate("[fails.isReady, fails.progress, fails.scene]") == [False, 0, None]


def test_viewers_off_screen_and_paused_ones_draw_no_frames(browser: Browser, site: Site):
    script = CREATE_JS + "window.low = createViewer({ container: '#low', src: 'cloud.spz', autorotate: true });"
    open_viewer(browser, site, script, TWO_BOXES_HTML)
    wait_until(browser, f"{READY_JS} && low.isReady")
    wait = "new Promise((done) => setTimeout(done, 300))"
    frames = browser.evaluate("low.player.frames")
    browser.evaluate(wait)
    assert browser.evaluate("low.player.frames") == frames, "drawn below the fold"
    browser.evaluate("document.getElementById('low').scrollIntoView()")
    wait_until(browser, f"low.player.frames > {frames + 2}")
    browser.evaluate("low.pause()")
    frames = browser.evaluate("low.player.frames")
    browser.evaluate(wait)
    assert browser.evaluate("low.player.frames") == frames
    browser.evaluate("low.resume()")
    wait_until(browser, f"low.player.frames > {frames}")


COUNT_WORKERS_JS = (
    "(() => { const Real = Worker; window.workers = { started: 0, alive: 0 };"
    " window.Worker = class extends Real {"
    "   constructor(...all) { super(...all); workers.started++; workers.alive++; }"
    "   terminate() { workers.alive--; super.terminate(); } }; })()"
)


def test_viewers_share_workers_and_the_last_one_ends_them(browser: Browser, site: Site):
    boxes = "".join(f'<div class="box" id="box{k}"></div>' for k in range(6))
    script = (
        "window.all = [0, 1, 2, 3, 4, 5].map((k) =>"
        " createViewer({ container: `#box${k}`, src: k % 2 ? 'cloud.spz' : 'some scene.hyrf' }));"
    )
    with browser.before_every_page(COUNT_WORKERS_JS):
        open_viewer(browser, site, script, boxes)
    wait_until(browser, "all.every((viewer) => viewer.isReady)", 60)
    assert browser.evaluate("workers.started <= 4")
    counts = browser.evaluate("all.map((viewer) => viewer.scene.kind)")
    assert counts == ["hyrf", "splats"] * 3
    browser.evaluate("all.slice(1).forEach((viewer) => viewer.destroy())")
    browser.evaluate("(all[0].camera = 0, all[0].screenshot().then(() => 0))")  # the others' end leaves it working
    browser.evaluate("all[0].destroy()")
    assert browser.evaluate("workers.alive") == 0
    assert browser.evaluate("document.querySelectorAll('canvas').length") == 0
    assert browser.list_errors() == []


def test_destroy_ends_everything_and_can_be_repeated(browser: Browser, site: Site):
    with browser.before_every_page(COUNT_WORKERS_JS):
        open_viewer(browser, site)
    wait_until(browser, READY_JS)
    browser.evaluate("window.pending = viewer.load('cloud.spz').then(() => '', ({ message }) => message), 0")
    browser.evaluate("window.gl = viewer.player.renderer.gl, viewer.destroy(), viewer.destroy(), 0")
    assert "the viewer was destroyed" in browser.evaluate("pending")
    assert browser.evaluate("gl.isContextLost() && workers.alive === 0 && !document.querySelector('canvas')")
    assert "destroyed" in error_of(browser, "viewer.load('cloud.spz')")
    assert "destroyed" in error_of(browser, "viewer.moveTo(0)")
    state = "[viewer.isReady, viewer.progress, viewer.scene, viewer.camera, viewer.cameraText]"
    assert browser.evaluate(state) == [False, 0, None, None, None]
    browser.evaluate("dispatchEvent(new Event('resize'))")
    assert browser.list_errors() == []


# ---- input


def test_the_page_scrolls_over_a_viewer_until_it_is_clicked(browser: Browser, site: Site):
    script = CREATE_JS + "window.kinds = []; viewer.on('ignored', ({ kind }) => kinds.push(kind));"
    open_viewer(browser, site, script, TWO_BOXES_HTML)
    wait_until(browser, READY_JS)
    depth = browser.evaluate("viewer.player.eye.depth")
    browser.wheel(120, 90, 100)
    wait_until(browser, "kinds.includes('wheel') && scrollY > 0")
    assert browser.evaluate("viewer.player.eye.depth") == depth
    browser.evaluate("scrollTo(0, 0)")
    browser.click(120, 90)
    browser.wheel(120, 90, 100)
    wait_until(browser, f"viewer.player.eye.depth > {depth}")
    assert browser.evaluate("scrollY") == 0


def test_keys_move_only_the_viewer_that_has_the_focus(browser: Browser, site: Site):
    script = CREATE_JS + "window.low = createViewer({ container: '#low', src: 'some scene.hyrf' });"
    body = TWO_BOXES_HTML.replace('<div style="height: 3000px"></div>', "<input id=field>")
    open_viewer(browser, site, script, body)
    wait_until(browser, f"{READY_JS} && low.isReady")
    before = browser.evaluate("[viewer.cameraText, low.cameraText]")
    browser.evaluate("document.getElementById('field').focus()")
    browser.press("w", seconds=0.1)
    assert browser.evaluate("[viewer.cameraText, low.cameraText]") == before
    browser.evaluate("low.canvas.focus()")
    browser.press("w", seconds=0.1)
    wait_until(browser, f"low.cameraText !== {before[1]!r}")
    assert browser.evaluate("viewer.cameraText") == before[0]


def test_without_interaction_the_canvas_is_a_picture(browser: Browser, site: Site):
    open_viewer(browser, site, CREATE_JS.replace(" });", ", interaction: 'none', title: 'A room' });"))
    wait_until(browser, READY_JS)
    before = browser.evaluate("viewer.cameraText")
    browser.drag((100, 90), (160, 90))
    assert browser.evaluate("viewer.cameraText") == before
    assert browser.evaluate("[viewer.canvas.role ?? viewer.canvas.getAttribute('role'), viewer.canvas.tabIndex]") == [
        "img",
        -1,
    ]
    assert browser.evaluate("viewer.canvas.getAttribute('aria-label')") == "A room"


# ---- security policies


def test_a_policy_of_self_allows_a_viewer_with_its_workers_address(browser: Browser, site: Site):
    site.files["/page.js"] = re.findall(r'<script type="module">(.*)</script>', viewer_page(CREATE_JS).decode(), re.S)[
        0
    ].encode()
    site.files["/strict.html"] = b'<!DOCTYPE html><div id="box"></div><script type="module" src="page.js"></script>'
    site.headers = {"Content-Security-Policy": "default-src 'self'"}
    browser.open(f"{site.address}/strict.html")
    wait_until(browser, "window.isPageReady")
    assert "worker-src" in error_of(browser, "viewer.load('some scene.hyrf')")
    browser.evaluate("viewer.destroy()")
    create = "createViewer({ container: '#box', workerUrl: 'player-worker.js' })"
    browser.evaluate(f"(window.viewer = {create}).load('some scene.hyrf')")
    assert browser.evaluate("viewer.scene.kind") == "hyrf"
    missing = create.replace("player-", "missing-")
    assert "missing-worker.js cannot be started" in error_of(browser, f"{missing}.load('some scene.hyrf')")


def test_the_declarations_name_what_the_viewer_has():
    declared = (REPOSITORY_ROOT / "npm" / "hyrf-viewer" / "index.d.ts").read_text()
    source = read_web_file("viewer/viewer.js")
    public = ["load", "moveTo", "pick", "screenshot", "pause", "resume", "destroy", "on", "off"]
    assert all(re.search(rf"^  (?:async )?{name}\(", source, re.M) for name in public)
    assert all(re.search(rf"^  {name}[(<]", declared, re.M) for name in public)
    for name in ["camera", "cameraText", "exposure", "scene", "autorotate"]:
        assert re.search(rf"^  get {name}\(", source, re.M) and re.search(
            rf"^  (?:readonly |get )?{name}[:(]", declared, re.M
        )

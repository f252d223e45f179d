"""HyrfObject draws a file's model in three.js, among meshes, as `hyrfpack.render_view` draws it."""

from __future__ import annotations

import base64
import io
import shutil
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from web.pages import camera_json, psnr, wait_until
from web.served import serve_project
from web.three.test_three import app_folder, cameras_around_model, make_model, save_model

import hyrfpack
from hyrfpack.edit.transform import Placement
from hyrfpack.format.codec import load_with_provenance
from hyrfpack.render import RenderSettings, render_view
from hyrfpack.scene import Camera
from tools.browser.chromium import Chromium, find

GOLDEN_FILE = Path(__file__).parents[2] / "golden" / "trained" / "demo_compact.hyrf"
EXACT_SETTINGS = RenderSettings(background_threshold=0, transmittance_min=0, exposure="consistent")
SIZE_PIXELS = 240
MIN_PSNR_DB = 50
MIN_BACKGROUND_PSNR_DB = 45  # the background is a picture of its sphere, not interpolated between pixels of the view
__all__ = ["app_folder"]


@pytest.fixture(scope="module")
def three_browser() -> Iterator[Chromium]:
    if find() is None:
        pytest.skip("there is no Chromium on this machine")
    with Chromium("--enable-unsafe-swiftshader", "--use-angle=swiftshader", timeout_seconds=180) as browser:
        yield browser


@pytest.fixture(scope="module")
def address(app_folder: Path) -> Iterator[str]:
    for name in ("native.html", "native.js"):
        shutil.copy(Path(__file__).with_name(name), app_folder)
    shutil.copy(GOLDEN_FILE, app_folder / "golden.hyrf")
    save_model(make_model(), app_folder / "balls.hyrf")
    model, provenance = load_with_provenance(GOLDEN_FILE)
    step = Placement.rotation_about_axis((0.4, 1.0, -0.3), 77)
    hyrfpack.save_model(step.move_model(model), app_folder / "rotated.hyrf", "raw", step.move_provenance(provenance))
    with serve_project(app_folder) as address:
        yield f"{address}/own"


@pytest.fixture
def page(three_browser: Chromium, address: str) -> Iterator[Chromium]:
    three_browser.resize(2 * SIZE_PIXELS, 2 * SIZE_PIXELS)
    three_browser.open(f"{address}/native.html")
    wait_until(three_browser, "Boolean(globalThis.page)")
    yield three_browser
    errors = three_browser.list_errors()
    three_browser.open("about:blank")
    assert errors == []


def first_camera(page: Chromium, number: int = 0) -> Camera:
    """Return a camera of the loaded file with a square picture of SIZE_PIXELS."""
    stored = page.evaluate(f"page.object.userData.hyrf.cameras[{number}]")
    scale = SIZE_PIXELS / stored["width"]
    intrinsics = [scale * stored[name] for name in ("fx", "fy", "cx", "cy")]
    return Camera(SIZE_PIXELS, SIZE_PIXELS, *intrinsics, np.array(stored["camera_from_world"]))


def read(page: Chromium, camera: Camera) -> np.ndarray:
    data = base64.b64decode(page.evaluate("page.read()"))
    return np.frombuffer(data, np.uint8).reshape(camera.height, camera.width, 3).astype(np.float64)


def draw(page: Chromium, camera: Camera) -> np.ndarray:
    page.evaluate(f"page.show({camera_json(camera)})")
    return read(page, camera)


def render(file: Path, camera: Camera) -> np.ndarray:
    rgb = render_view(hyrfpack.load_model(file), camera, EXACT_SETTINGS).rgb
    return 255 * rgb.clamp(0, 1).detach().numpy().astype(np.float64)


@pytest.mark.acceptance
def test_pictures_of_a_golden_model_are_those_of_the_exact_render(page: Chromium, address: str):
    page.evaluate("page.load('golden.hyrf')")
    camera = first_camera(page)
    cameras = [
        camera,
        first_camera(page, 3),
        replace(camera, cx=0.3 * SIZE_PIXELS, cy=0.6 * SIZE_PIXELS),
        replace(camera, width=SIZE_PIXELS // 2, fx=0.7 * camera.fx),
    ]
    for number, camera in enumerate(cameras):
        picture, reference = draw(page, camera), render(GOLDEN_FILE, camera)
        assert psnr(picture, reference) > MIN_BACKGROUND_PSNR_DB, number
        assert psnr(reference.mean((0, 1)), reference) < 25, "the picture is nearly uniform"


@pytest.mark.acceptance
def test_pictures_of_a_rotated_model_are_those_of_the_exact_render(page: Chromium, app_folder: Path):
    page.evaluate("page.load('rotated.hyrf')")
    for camera in (first_camera(page), first_camera(page, 3)):
        picture, reference = draw(page, camera), render(app_folder / "rotated.hyrf", camera)
        assert psnr(picture, reference) > MIN_BACKGROUND_PSNR_DB
        assert psnr(reference.mean((0, 1)), reference) < 25, "the picture is nearly uniform"


@pytest.mark.acceptance
def test_a_turned_moved_and_scaled_object_looks_the_same_from_the_same_place(page: Chromium):
    page.evaluate("page.load('balls.hyrf')")
    camera = first_camera(page)
    plain = draw(page, camera)
    page.evaluate(
        "page.object.quaternion.set(0.1, 0.7, -0.2, 0.3).normalize(); page.object.position.set(4, -2, 9);"
        "page.object.scale.setScalar(3.5)"
    )
    assert psnr(draw(page, camera), plain) > 48


@pytest.mark.acceptance
def test_tone_mapping_and_render_targets_change_no_color(page: Chromium, app_folder: Path):
    page.evaluate("page.load('balls.hyrf')")
    camera, reference = first_camera(page), None
    reference = render(app_folder / "balls.hyrf", camera)
    page.evaluate("page.renderer.toneMapping = page.THREE.ACESFilmicToneMapping")
    assert psnr(draw(page, camera), reference) > MIN_PSNR_DB
    floats = page.evaluate("page.readLinear()")
    linear = np.reshape(floats, (SIZE_PIXELS, SIZE_PIXELS, 4))[::-1, :, :3]
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0) ** (1 / 2.4) - 0.055)
    covered = reference.max(-1) > 128  # three.js blends edges in linear light there
    assert covered.mean() > 0.1
    assert np.abs(255 * encoded - reference)[covered].mean() < 2


@pytest.mark.acceptance
def test_a_mesh_in_front_hides_gaussians_and_one_behind_is_covered(page: Chromium):
    page.evaluate("page.load('balls.hyrf')")
    camera = first_camera(page)
    plain = draw(page, camera)
    target = np.array(page.evaluate("page.object.userData.hyrf.target"))
    to_eye = camera.position - target
    balls = {
        "front": camera.position - 0.5 * to_eye,
        "behind": camera.position - 1.5 * to_eye,
        "inside": target,
    }
    pictures = {}
    for name, place in balls.items():
        page.evaluate(f"void (globalThis.ball = page.addBall({place.tolist()}, 0.3, 0x00ff00))")
        page.evaluate("page.draw()")
        pictures[name] = read(page, camera)
        page.evaluate("void ball.removeFromParent()")
    middle = slice(SIZE_PIXELS // 2 - 4, SIZE_PIXELS // 2 + 4)
    assert np.abs(pictures["front"][middle, middle] - [0, 255, 0]).max() == 0
    for name in ("behind", "inside"):
        assert np.abs(pictures[name][middle, middle] - plain[middle, middle]).max() < 16, name
    page.evaluate("page.draw()")
    assert np.array_equal(read(page, camera), plain), "the meshes left a trace"


@pytest.mark.acceptance
def test_materials_and_the_renderer_are_left_as_they_were(page: Chromium):
    page.evaluate("page.load('balls.hyrf')")
    camera = first_camera(page)
    page.evaluate("void (globalThis.ball = page.addBall([40, -3, 7], 0.3, 0x00ff00))")
    state = """JSON.stringify([ball.material.visible, ball.material.colorWrite, page.renderer.autoClear,
        page.renderer.getClearAlpha(), page.renderer.info.autoReset, page.renderer.shadowMap.autoUpdate,
        page.renderer.getRenderTarget(), page.scene.matrixWorldAutoUpdate, page.scene.overrideMaterial])"""
    before = page.evaluate(state)
    draw(page, camera)
    assert page.evaluate(state) == before


@pytest.mark.acceptance
def test_a_resized_viewport_draws_its_part_of_the_canvas(page: Chromium):
    page.evaluate("page.load('balls.hyrf')")
    camera = first_camera(page)
    whole = draw(page, camera)
    half = SIZE_PIXELS // 2
    page.evaluate(
        f"page.renderer.setViewport({half}, {half}, {half}, {half}); page.renderer.setScissor({half}, {half}, {half}, "
        f"{half}); page.renderer.setScissorTest(true)"
    )
    page.evaluate("page.draw()")
    part = read(page, camera)[:half, half:]
    reduced = whole.reshape(half, 2, half, 2, 3).mean((1, 3))
    assert psnr(part, reduced) > 25
    assert psnr(reduced.mean((0, 1)), reduced) < 22


@pytest.mark.acceptance
def test_events_tell_when_a_frame_changes_and_when_it_is_complete(page: Chromium):
    page.evaluate("page.load('golden.hyrf')")
    page.evaluate(
        """void (globalThis.events = []);
        for (const type of ["change", "complete", "error"]) {
          page.object.addEventListener(type, () => events.push(type));
        }"""
    )
    draw(page, first_camera(page))
    events = page.evaluate("events")
    assert events.count("complete") == 1 and events.count("change") > 2 and "error" not in events


@pytest.mark.acceptance
def test_dispose_ends_the_worker_and_frees_the_graphics_memory(page: Chromium):
    page.evaluate("page.load('golden.hyrf')")
    draw(page, first_camera(page))
    assert [worker.rpartition("/")[2] for worker in page.list_workers()] == ["remote_worker.js"]
    page.evaluate("page.object.dispose()")
    page.evaluate("page.renderer.render(page.scene, page.camera)")
    ends = time.monotonic() + 10
    while page.list_workers():
        assert time.monotonic() < ends, "the worker still runs"
        time.sleep(0.05)
    memory = page.evaluate("page.renderer.info.memory")
    assert memory["textures"] == 0 and memory["geometries"] == 0


@pytest.mark.acceptance
def test_a_file_that_cannot_be_read_rejects_with_a_sentence(page: Chromium, app_folder: Path):
    (app_folder / "cut.hyrf").write_bytes(GOLDEN_FILE.read_bytes()[:1000])
    message = page.evaluate("page.load('cut.hyrf').catch((error) => error.message)")
    assert message.startswith("cut.hyrf: The file")


@pytest.mark.acceptance
def test_the_example_page_shows_the_model_without_blocking(three_browser: Chromium, address: str, app_folder: Path):
    three_browser.resize(SIZE_PIXELS, SIZE_PIXELS)
    three_browser.open(f"{address}/index.html?file=balls.hyrf")
    wait_until(three_browser, "document.getElementById('status').textContent === ''", 60)
    picture, previous = None, None
    for _ in range(60):
        previous, picture = picture, three_browser.screenshot()
        if picture == previous:
            break
        three_browser.evaluate("new Promise((resolve) => setTimeout(resolve, 500))")
    shown = np.array(Image.open(io.BytesIO(picture)).convert("RGB"), np.float64)
    camera = save_model_camera()
    assert psnr(shown, render(app_folder / "balls.hyrf", camera)) > 40
    assert three_browser.list_errors() == []


def save_model_camera() -> Camera:
    """Return the first camera of the file of balls, with a picture of SIZE_PIXELS."""
    first = cameras_around_model(10)[0]
    scale = SIZE_PIXELS / first.width
    return Camera(SIZE_PIXELS, SIZE_PIXELS, *(scale * np.array(first.intrinsics)), first.camera_from_world)

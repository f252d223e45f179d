"""HyrfObject draws a file's model in three.js, among meshes, as `hyrfpack.render_view` draws it."""

from __future__ import annotations

import base64
import io
import itertools
import math
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from web.pages import camera_json, psnr, wait_until
from web.served import serve_project
from web.test_exposure import visible_map
from web.three.test_three import app_folder, cameras_around_model, make_model, save_model

import hyrfpack
from hyrfpack.cameras.placement import Placement
from hyrfpack.config.edit import Rotate, Scale, Translate
from hyrfpack.edit import merge_models
from hyrfpack.edit.transform import move_model, move_provenance
from hyrfpack.format.codec import load_with_provenance
from hyrfpack.model import HybridModel
from hyrfpack.ops.background.reference import (
    BACKGROUND_RADIUS,
    field_colors,
    pixel_directions,
    sphere_points,
)
from hyrfpack.ops.contraction import contract
from hyrfpack.ops.poses import camera_center
from hyrfpack.ops.shade.directions import encode_directions
from hyrfpack.ops.viewport import Viewport
from hyrfpack.render import RenderSettings, render_view
from hyrfpack.render.renderer import apply_exposure_map
from hyrfpack.scene import Camera
from tools.browser.chromium import Chromium, find_program

GOLDEN_FILE = Path(__file__).parents[2] / "golden" / "trained" / "demo_compact.hyrf"
EXACT_SETTINGS = RenderSettings(background_threshold=0, transmittance_min=0, exposure="consistent")
SIZE_PIXELS = 240
MIN_PSNR_DB = 50
__all__ = ["app_folder"]


@pytest.fixture(scope="module")
def three_browser() -> Iterator[Chromium]:
    if find_program() is None:
        pytest.skip("there is no Chromium on this machine")
    with Chromium("--enable-unsafe-swiftshader", "--use-angle=swiftshader", timeout_seconds=180) as browser:
        yield browser


def write_page(app_folder: Path, *scripts: str) -> None:
    """Write the page of these tests with scripts of this folder, and the files that it shows."""
    for name in ("native.html", "native.js", *scripts):
        shutil.copy(Path(__file__).with_name(name), app_folder)
    shutil.copy(GOLDEN_FILE, app_folder / "golden.hyrf")
    save_model(make_model(), app_folder / "balls.hyrf")


@contextmanager
def opened_page(browser: Chromium, url: str, is_ready: str, seconds: float = 10.0) -> Iterator[Chromium]:
    """Show the page in a small window in a `with` block, after which it must have no errors."""
    browser.resize(2 * SIZE_PIXELS, 2 * SIZE_PIXELS)
    browser.open(url)
    wait_until(browser, is_ready, seconds)
    yield browser
    errors = browser.list_errors()
    browser.open("about:blank")
    assert errors == []


@pytest.fixture(scope="module")
def address(app_folder: Path) -> Iterator[str]:
    write_page(app_folder)
    model, provenance = load_with_provenance(GOLDEN_FILE)
    step = Placement.rotation_about_axis((0.4, 1.0, -0.3), 77)
    hyrfpack.save_model(move_model(step, model), app_folder / "rotated.hyrf", "raw", move_provenance(step, provenance))
    with serve_project(app_folder) as address:
        yield f"{address}/own"


@pytest.fixture
def page(three_browser: Chromium, address: str) -> Iterator[Chromium]:
    with opened_page(three_browser, f"{address}/native.html", "Boolean(globalThis.page)") as page:
        yield page


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


@torch.no_grad()
def render(file: Path, camera: Camera) -> np.ndarray:
    rgb = render_view(hyrfpack.load_model(file), camera, EXACT_SETTINGS).rgb
    return 255 * rgb.clamp(0, 1).numpy().astype(np.float64)


@torch.no_grad()
def render_with_sphere(model: HybridModel, camera: Camera, height: int) -> np.ndarray:
    """Render a view with a background that is interpolated between the nodes of an equirectangular picture."""
    front = render_view(model, camera, EXACT_SETTINGS, background=False, solid=torch.zeros(3))
    viewport = model.config.frame.local_viewport(camera, torch.float32)
    behind = sample_sphere(sphere_picture(model, camera_center(viewport.pose), height), viewport)
    rgb = apply_exposure_map(model, camera, (front.rgb + (1 - front.alpha[..., None]) * behind).clamp(0, 1))
    return 255 * rgb.numpy().astype(np.float64)


def sphere_picture(model: HybridModel, eye: torch.Tensor, height: int) -> torch.Tensor:
    """Return the background's colours (height, 2 height, 3) that an eye sees, at the nodes of view_evaluator.js."""
    field = model._background_field()
    longitudes = (torch.arange(2 * height) + 0.5) * math.pi / height - math.pi
    latitudes = math.pi / 2 - (torch.arange(height) + 0.5) * math.pi / height
    latitude, longitude = torch.meshgrid(latitudes, longitudes, indexing="ij")
    level = latitude.cos()
    sphere = torch.stack((level * longitude.sin(), -latitude.sin(), level * longitude.cos()), -1).reshape(-1, 3)
    directions = torch.nn.functional.normalize(BACKGROUND_RADIUS * sphere - eye.float(), dim=-1)
    coords = contract(BACKGROUND_RADIUS * sphere, field.half_extent)
    colors = field_colors(coords, encode_directions(directions, field.encoding), field)
    return colors.reshape(height, 2 * height, 3)


def sample_sphere(picture: torch.Tensor, viewport: Viewport) -> torch.Tensor:
    """Interpolate a picture of `sphere_picture` bilinearly where the pixels of a view see it; return (H, W, 3)."""
    rows, columns = torch.meshgrid(torch.arange(viewport.height), torch.arange(viewport.width), indexing="ij")
    pixels = torch.stack((columns, rows), -1).reshape(-1, 2).double() + 0.5
    seen = sphere_points(camera_center(viewport.pose).double(), pixel_directions(pixels, as_double(viewport)))
    x, y, z = (seen / BACKGROUND_RADIUS).unbind(-1)
    height, width, _ = picture.shape
    column = (0.5 + torch.atan2(x, z) / (2 * math.pi)) * width - 0.5
    row = (0.5 + torch.asin(y.clamp(-1, 1)) / math.pi) * height - 0.5
    left, top = column.floor(), row.floor()
    found = torch.zeros(len(seen), 3, dtype=torch.float64)
    for right, below in itertools.product((0, 1), (0, 1)):
        weights = (column - left if right else 1 - column + left) * (row - top if below else 1 - row + top)
        at = (top + below).clamp(0, height - 1).long(), (left + right).long() % width
        found += weights[:, None] * picture[at]
    return found.reshape(viewport.height, viewport.width, 3).float()


def as_double(viewport: Viewport) -> Viewport:
    return replace(viewport, pose=viewport.pose.double())


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
        picture = draw(page, camera)
        height = page.evaluate("page.object.model.sky.height")
        reference = render_with_sphere(hyrfpack.load_model(GOLDEN_FILE), camera, height)
        assert psnr(picture, reference) > MIN_PSNR_DB, number
        assert psnr(reference.mean((0, 1)), reference) < 25, "the picture is nearly uniform"


@pytest.mark.acceptance
def test_pictures_of_a_rotated_model_are_those_of_the_exact_render(page: Chromium, app_folder: Path):
    page.evaluate("page.load('rotated.hyrf')")
    model = hyrfpack.load_model(app_folder / "rotated.hyrf")
    for camera in (first_camera(page), first_camera(page, 3)):
        picture = draw(page, camera)
        reference = render_with_sphere(model, camera, page.evaluate("page.object.model.sky.height"))
        assert psnr(picture, reference) > MIN_PSNR_DB
        assert psnr(reference.mean((0, 1)), reference) < 25, "the picture is nearly uniform"


@pytest.mark.acceptance
def test_the_exposure_map_applies_to_gaussians_and_background(page: Chromium, app_folder: Path):
    model = hyrfpack.load_model(GOLDEN_FILE)
    model.exposure = visible_map()
    provenance = hyrfpack.describe_file(GOLDEN_FILE)["provenance"]
    hyrfpack.save_model(model, app_folder / "exposed.hyrf", provenance=provenance)
    page.evaluate("page.load('exposed.hyrf')")
    height = page.evaluate("page.object.model.sky.height")
    for number in (0, 3):
        camera = first_camera(page, number)
        assert psnr(draw(page, camera), render_with_sphere(model, camera, height)) > MIN_PSNR_DB
    page.evaluate("page.object.exposure = 'consistent'")
    picture, model.exposure = draw(page, camera), None
    assert psnr(picture, render_with_sphere(model, camera, height)) > MIN_PSNR_DB
    message = page.evaluate(
        "(() => { try { page.object.exposure = 'no'; } catch (error) { return error.message; } })()"
    )
    assert message == "exposure must be as-photographed or consistent, not no."


@pytest.mark.acceptance
@pytest.mark.parametrize(("exposed", "least_psnr"), [(False, 44), (True, 38)])
def test_pictures_of_a_merged_file_are_those_of_all_its_parts(exposed, least_psnr, page: Chromium, app_folder: Path):
    """A Gaussian at a time is exposed, where the render exposes the blended picture."""
    toy, provenance = load_with_provenance(GOLDEN_FILE)
    toy.exposure = visible_map() if exposed else None
    hyrfpack.save_model(toy, app_folder / "toy.hyrf", provenance=provenance)
    settings = replace(EXACT_SETTINGS, exposure="as-photographed")
    moves = {"toy": [Rotate((1.0, 2.0, 0.5), 40), Scale(0.4), Translate((0.3, -0.2, 1.2))]}
    merge_models([app_folder / "golden.hyrf", app_folder / "toy.hyrf"], app_folder / "both.hyrf", moves)
    merged = hyrfpack.load_merged_model(app_folder / "both.hyrf")
    page.evaluate("page.load('both.hyrf')")
    assert page.evaluate("page.object.userData.hyrf.count") == len(merged)
    for number in (0, 3):
        camera = first_camera(page, number)
        picture = draw(page, camera)
        front = render_view(merged, camera, settings, background=False, solid=torch.zeros(3))
        height = page.evaluate("page.object.model.sky.height")
        frame = merged.scene.config.frame
        viewport = frame.local_viewport(camera, torch.float32)
        behind = sample_sphere(sphere_picture(merged.scene, camera_center(viewport.pose), height), viewport)
        reference = 255 * (front.rgb + (1 - front.alpha[..., None]) * behind).clamp(0, 1).numpy().astype(np.float64)
        assert psnr(picture, reference) > least_psnr
        alone = render_with_sphere(merged.scene, camera, height)
        assert psnr(alone, reference) < 35, "the other part is not in view"


@pytest.mark.acceptance
def test_near_gaussians_of_a_part_with_a_smaller_unit_are_drawn(page: Chromium, app_folder: Path):
    shutil.copy(GOLDEN_FILE, app_folder / "tiny.hyrf")
    parts = [app_folder / "golden.hyrf", app_folder / "tiny.hyrf"]
    merge_models(parts, app_folder / "small.hyrf", {"tiny": [Scale(0.001)]})
    scene, part = hyrfpack.load_merged_model(app_folder / "small.hyrf").parts
    page.evaluate("page.load('small.hyrf')")
    nearest = page.evaluate("[page.object.userData.hyrf.near, page.object.shapeView.u_near.value]")
    ratio = part.config.frame.scale / scene.config.frame.scale
    assert ratio < 1 and nearest == pytest.approx([0.01 * part.config.frame.scale, 0.01 * ratio])


@pytest.mark.acceptance
def test_colors_above_1_are_white_where_the_exposure_darkens(page: Chromium, app_folder: Path):
    toy, provenance = load_with_provenance(GOLDEN_FILE)
    toy.exposure = visible_map()
    hyrfpack.save_model(toy, app_folder / "dark.hyrf", provenance=provenance)
    merge_models([app_folder / "golden.hyrf", app_folder / "dark.hyrf"], app_folder / "bright.hyrf")
    page.evaluate(
        "(({ prototype }) => { const { receiveRow } = prototype; prototype.receiveRow = function (row) {"
        " row.colors = row.colors.map((value, k) => (k % 4 === 3 ? value : 3)); receiveRow.call(this, row); };"
        " prototype.gains = () => [0.3, 0.3, 0.3]; })(page.Kind)"
    )
    page.evaluate("page.load('bright.hyrf')")
    camera = first_camera(page)
    merged = hyrfpack.load_merged_model(app_folder / "bright.hyrf")
    opaque = render_view(merged, camera, EXACT_SETTINGS).alpha.numpy() > 0.999
    assert opaque.mean() > 0.01 and draw(page, camera)[opaque].min() > 250


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
    three_browser.resize(SIZE_PIXELS, SIZE_PIXELS, pixel_ratio=2)  # as on another screen
    wait_until(three_browser, f"document.querySelector('canvas').width === {2 * SIZE_PIXELS}")
    assert three_browser.list_errors() == []


def save_model_camera() -> Camera:
    """Return the first camera of the file of balls, with a picture of SIZE_PIXELS."""
    first = cameras_around_model(10)[0]
    scale = SIZE_PIXELS / first.width
    return Camera(SIZE_PIXELS, SIZE_PIXELS, *(scale * np.array(first.intrinsics)), first.camera_from_world)

"""The player shows scene folders as their chunks arrive, and says in one sentence which files it cannot show."""

from __future__ import annotations

import base64
import itertools
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scenes import shift_cameras
from web.native_models import MODEL_FRAME, lose_and_restore_device, make_near_parts, random_model, render_reference
from web.pages import Browser, psnr, render_in_page, wait_for_message, wait_until, window_camera
from web.site import Site
from web.test_element import ELEMENT_JS, LOADED_JS, open_element

import hyrfpack
from hyrfpack.config.edit import Rotate, Scale, Translate
from hyrfpack.config.split import SplitConfig
from hyrfpack.context import RunContext
from hyrfpack.format import encode_model
from hyrfpack.format.parts import encode_parts
from hyrfpack.lod import split, split_model
from hyrfpack.model import HybridModel
from hyrfpack.model.merged import MergedModel
from hyrfpack.scene import Camera
from hyrfpack.web import view as view_module
from hyrfpack.web.player import encode_player
from hyrfpack.web.serve import serve_in_thread
from tools.browser.frames import frame_observer_script

pytestmark = [pytest.mark.in_turn, pytest.mark.usefixtures("reset_window")]
SCENE_FOLDER = Path(__file__).parents[1] / "golden" / "scene"
PARTS_FOLDER = SCENE_FOLDER.with_name("parts_scene")
TRAINED_FILE = SCENE_FOLDER.parent / "trained" / "demo_compact.hyrf"
SHARED_PATH, MANIFEST_PATH = "/scene/shared.hyrf", "/scene/scene.json"
MIN_PSNR_DB = 45  # WebGL evaluates the fields with smaller numbers
MIN_NEIGHBOUR_PSNR_DB = 30  # between two frames of a fade
KEEP_FRAME_JS = 'rgba => keptFrames.push(btoa(Array.from(rgba, byte => String.fromCharCode(byte)).join("")))'


@pytest.fixture
def scene_host(host: Site) -> Site:
    host.files |= {f"/scene/{file.name}": file.read_bytes() for file in SCENE_FOLDER.iterdir()}
    return host


@pytest.fixture
def parts_host(host: Site) -> Site:
    """Serve a scene of three parts."""
    host.files |= {f"/scene/{file.name}": file.read_bytes() for file in PARTS_FOLDER.iterdir()}
    return host


def open_scene(browser: Browser, host: Site) -> None:
    browser.open(f"{host.address}/index.html?content=scene/scene.json")


def test_a_scene_folder_is_drawn_as_python_renders_it(browser: Browser, scene_host: Site):
    scene = hyrfpack.SceneFolder(SCENE_FOLDER)
    viewpoint = scene.manifest.viewpoint
    camera = Camera(120, 90, 129.0, 129.0, 60.0, 45.0, np.array(viewpoint["camera_from_world"]))
    open_scene(browser, scene_host)
    browser.evaluate("hyrfpack.ready")
    picture = render_in_page(browser, camera)
    reference = np.clip(np.asarray(hyrfpack.render_view(scene.load(), camera).rgb) * 255, 0, 255)
    assert psnr(picture.astype(float), reference) > MIN_PSNR_DB
    assert browser.evaluate("document.title").startswith(scene.manifest.title)


def test_a_scene_folder_offers_no_editing(browser: Browser, scene_host: Site):
    scene_host.files["/index.html"] = encode_player("a scene", editable=True)
    open_scene(browser, scene_host)
    browser.evaluate("hyrfpack.ready")
    wait_until(browser, "hyrfpack.player.whole")
    assert not browser.evaluate("document.getElementById('edit-button').checkVisibility()")


def reference_picture(model, camera: Camera) -> np.ndarray:
    return np.clip(np.asarray(hyrfpack.render_view(model, camera).rgb) * 255, 0, 255)


def scene_camera(folder: Path) -> Camera:
    pose = hyrfpack.SceneFolder(folder).manifest.viewpoint["camera_from_world"]
    return Camera(120, 90, 129.0, 129.0, 60.0, 45.0, np.array(pose))


def test_a_scene_of_several_parts_is_drawn_as_python_renders_it(browser: Browser, parts_host: Site):
    camera = scene_camera(PARTS_FOLDER)
    open_scene(browser, parts_host)
    browser.evaluate("hyrfpack.ready")
    wait_until_complete(browser)
    picture = render_in_page(browser, camera)
    assert (
        psnr(picture.astype(float), reference_picture(hyrfpack.load_merged_model(PARTS_FOLDER), camera)) > MIN_PSNR_DB
    )
    assert browser.list_errors() == []


def test_without_the_shared_file_of_a_part_the_other_parts_are_shown(browser: Browser, parts_host: Site):
    camera, merged = scene_camera(PARTS_FOLDER), hyrfpack.load_merged_model(PARTS_FOLDER)
    rest = MergedModel(merged.names[::2], merged.parts[::2])
    del parts_host.files["/scene/shared-01.hyrf"]
    open_scene(browser, parts_host)
    message = "shared-01.hyrf cannot be shown: it is missing; the rest of the scene is shown."
    wait_until(browser, f"document.getElementById('remark').textContent.includes('{message}')")
    assert psnr(render_in_page(browser, camera).astype(float), reference_picture(rest, camera)) > MIN_PSNR_DB
    assert browser.evaluate("document.getElementById('message').hidden")


def test_view_streams_a_scene_folder(browser: Browser, monkeypatch: pytest.MonkeyPatch):
    served: dict = {}
    monkeypatch.setattr(view_module, "serve", lambda page, files, **_: served.update(page=page, files=files))
    view_module.view(SCENE_FOLDER, open_browser=False, on_ready=print)
    with serve_in_thread(**served) as address:
        browser.open(address)
        browser.evaluate("hyrfpack.ready")
        gaussians = browser.evaluate("hyrfpack.player.loader.state.gaussians")
    assert gaussians == hyrfpack.SceneFolder(SCENE_FOLDER).manifest.gaussians


def test_a_missing_shared_file_is_named(browser: Browser, scene_host: Site):
    del scene_host.files[SHARED_PATH]
    open_scene(browser, scene_host)
    assert wait_for_message(browser) == "scene.json cannot be opened: shared.hyrf: it is missing"


def test_a_file_with_another_size_than_the_manifest_says_is_named(browser: Browser, scene_host: Site):
    manifest = json.loads(scene_host.files[MANIFEST_PATH])
    manifest["chunks"][0]["levels"][0]["bytes"] -= 8
    scene_host.files[MANIFEST_PATH] = json.dumps(manifest).encode()
    open_scene(browser, scene_host)
    wait_until(browser, "document.getElementById('remark').textContent.includes('it is longer than the 1,208 bytes')")
    assert browser.evaluate("document.getElementById('message').hidden")


@pytest.fixture(scope="module")
def levels_folder(tmp_path_factory) -> hyrfpack.SceneFolder:
    """Return a scene folder of four chunks at two levels."""
    path = tmp_path_factory.mktemp("stream") / "demo-scene"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(split, "REFIT_CAMERAS_PER_PART", 1)
        patch.setattr(split, "MEASURED_VIEWS_PER_PART", 2)
        config = SplitConfig(chunk_gaussians=400, levels=2, refit_steps=3)
        split_model(TRAINED_FILE, path, config, context=RunContext(progress=None))
    return hyrfpack.SceneFolder(path)


@pytest.fixture(scope="module")
def parts_folder(tmp_path_factory) -> hyrfpack.SceneFolder:
    """Return a scene folder of two parts, each of two chunks at two levels; the second part is turned and larger."""
    path = tmp_path_factory.mktemp("stream-parts")
    moves = {"other": [Rotate((0.0, 0.0, 1.0), 40.0), Scale(1.5), Translate((0.3, 0.1, 0.0))]}
    (path / "other.hyrf").write_bytes(TRAINED_FILE.read_bytes())
    hyrfpack.merge_models([TRAINED_FILE, path / "other.hyrf"], path / "both.hyrf", moves)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(split, "REFIT_CAMERAS_PER_PART", 1)
        patch.setattr(split, "MEASURED_VIEWS_PER_PART", 1)
        config = SplitConfig(chunk_gaussians=800, levels=2, refit_steps=3)
        split_model(path / "both.hyrf", path / "scene", config, context=RunContext(progress=None))
    return hyrfpack.SceneFolder(path / "scene")


def serve_levels(host: Site, folder: hyrfpack.SceneFolder) -> None:
    host.files |= {f"/levels/{file.name}": file.read_bytes() for file in folder.path.iterdir()}


def open_levels(browser: Browser, host: Site, budget: int) -> None:
    """Open the served scene folder with a budget of Gaussians, and wait for the first picture."""
    browser.open(f"{host.address}/index.html?content=levels/scene.json&gaussians={budget}")
    browser.evaluate("hyrfpack.ready")


def wait_until_complete(browser: Browser) -> dict:
    wait_until(browser, "Boolean(hyrfpack.player.loader.state?.isComplete)", 60)
    return browser.evaluate("hyrfpack.player.loader.state")


def count_gaussians(folder: hyrfpack.SceneFolder, level: int) -> int:
    return sum(chunk.levels[level].gaussians for chunk in folder.manifest.chunks)


@pytest.mark.acceptance
def test_the_budget_decides_which_levels_are_drawn(browser: Browser, host: Site, levels_folder):
    coarsest, finest = (count_gaussians(levels_folder, level) for level in (-1, 0))
    budget = (coarsest + finest) // 2
    serve_levels(host, levels_folder)
    open_levels(browser, host, budget)
    state = wait_until_complete(browser)
    chosen = hyrfpack.select_levels(levels_folder.manifest, window_camera(browser), gaussians=budget)
    assert coarsest < state["gaussians"] == chosen.gaussians <= budget
    assert not state["problem"]
    sizes = {f"/levels/{file.name}": file.stat().st_size for file in levels_folder.path.iterdir()}
    requested = {path for path, _ in host.requests}
    read, total = sum(size for path, size in sizes.items() if path in requested), sum(sizes.values())
    drawn, loaded = (browser.evaluate(f"document.getElementById('{name}').textContent") for name in ("count", "loaded"))
    assert drawn == f"{chosen.gaussians:,} of {finest:,} Gaussians"
    assert re.fullmatch(rf"{read / 1e6:.1f} of {total / 1e6:.1f} MB loaded, (low|medium|high) detail here", loaded)


@pytest.mark.acceptance
def test_neighbouring_frames_of_a_switch_of_levels_are_alike(browser: Browser, host: Site, levels_folder):
    coarsest, finest = (count_gaussians(levels_folder, level) for level in (-1, 0))
    serve_levels(host, levels_folder)
    open_levels(browser, host, finest)
    wait_until_complete(browser)
    browser.evaluate("hyrfpack.player.settled.then(() => true)")
    browser.evaluate("void (window.keptFrames = [])")
    browser.evaluate(frame_observer_script(KEEP_FRAME_JS))
    browser.evaluate("hyrfpack.player.redraw()")
    wait_until(browser, "keptFrames.length > 0")
    browser.evaluate(f"hyrfpack.player.loader.post({{ gaussians: {coarsest} }})")
    wait_until(browser, f"hyrfpack.player.loader.state.gaussians === {coarsest}")
    wait_until_complete(browser)
    kept = [np.frombuffer(base64.b64decode(frame), np.uint8) for frame in browser.evaluate("keptFrames")]
    frames = [frame.reshape(-1, 4)[:, :3].astype(float) for frame in kept]
    assert psnr(frames[0], frames[-1]) < MIN_NEIGHBOUR_PSNR_DB - 3
    assert min(psnr(first, second) for first, second in itertools.pairwise(frames)) > MIN_NEIGHBOUR_PSNR_DB


@pytest.mark.acceptance
@pytest.mark.parametrize("padding", [0, 200_000])
def test_levels_of_all_parts_are_drawn_as_python_renders_them(browser: Browser, host: Site, parts_folder, padding: int):
    """After a long manifest, the first picture waits for one chunk alone, and a part arrives after it."""
    finest = count_gaussians(parts_folder, 0)
    serve_levels(host, parts_folder)
    host.files["/levels/scene.json"] += b" " * padding
    open_levels(browser, host, finest)
    state = wait_until_complete(browser)
    camera = Camera(120, 90, 129.0, 129.0, 60.0, 45.0, window_camera(browser).camera_from_world)
    picture = render_in_page(browser, camera).astype(float)
    assert state["gaussians"] == finest and not state["problem"]
    assert psnr(picture, reference_picture(parts_folder.load(), camera)) > MIN_PSNR_DB
    assert browser.list_errors() == []


def test_residuals_of_chunks_are_drawn_as_python_renders_them(browser: Browser, host: Site, tmp_path: Path):
    """Parts have residuals of different degrees, or none, and chunks of several levels arrive before and after them."""
    files = [tmp_path / f"{name}.hyrf" for name in ("degree-2", "none", "degree-0")]
    for seed, (path, degree) in enumerate(zip(files, (2, None, 0), strict=True)):
        hyrfpack.save_model(random_model(300, seed, residual_degree=degree), path)
    moves = {"none": [Translate((0.3, 0.0, 0.0))], "degree-0": [Rotate((0.0, 0.0, 1.0), 40.0), Scale(1.2)]}
    hyrfpack.merge_models(files, tmp_path / "all.hyrf", moves)
    config = SplitConfig(chunk_gaussians=160, levels=2, refit_steps=0)
    split_model(tmp_path / "all.hyrf", tmp_path / "scene", config, context=RunContext(progress=None))
    folder = hyrfpack.SceneFolder(tmp_path / "scene")
    serve_levels(host, folder)
    open_levels(browser, host, count_gaussians(folder, 0))
    state = wait_until_complete(browser)
    camera = Camera(120, 90, 129.0, 129.0, 60.0, 45.0, window_camera(browser).camera_from_world)
    picture = render_in_page(browser, camera).astype(float)
    assert state["gaussians"] == 900 and not state["problem"]
    assert psnr(picture, reference_picture(folder.load(), camera)) > MIN_PSNR_DB
    assert browser.list_errors() == []


HELD_FIELDS_JS = """[...hyrfpack.player.renderer.content.further.values()]
  .filter(({ graphics, radiance }) => graphics.made.has(radiance.table)).length"""


def split_parts(path: Path, models: list[HybridModel], config: SplitConfig) -> hyrfpack.SceneFolder:
    """Return a scene folder of parts."""
    parts = [(f"part {number}", encode_model(model)) for number, model in enumerate(models)]
    (path / "all.hyrf").write_bytes(encode_parts(parts))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(split, "MEASURED_VIEWS_PER_PART", 1)
        split_model(path / "all.hyrf", path / "scene", config, context=RunContext(progress=None))
    return hyrfpack.SceneFolder(path / "scene")


@pytest.mark.parametrize("is_lost", [False, True])
def test_fields_that_were_dropped_are_loaded_again(browser: Browser, host: Site, tmp_path: Path, is_lost: bool):
    """A budget of 400 Gaussians leaves memory for the fields of two further parts."""
    models = [random_model(400, seed) for seed in range(5)]
    folder = split_parts(tmp_path, models, SplitConfig(chunk_gaussians=200, levels=2, refit_steps=0))
    serve_levels(host, folder)
    open_levels(browser, host, 400)
    wait_until_complete(browser)
    wait_until(browser, f"{HELD_FIELDS_JS} === 2")
    if is_lost:
        lose_and_restore_device(browser)
        browser.evaluate("hyrfpack.ready")
    browser.evaluate("hyrfpack.player.loader.post({ gaussians: 1e6 })")
    wait_until(browser, "hyrfpack.player.loader.state.gaussians === 2000", 60)
    wait_until_complete(browser)
    wait_until(browser, f"{HELD_FIELDS_JS} === 2")
    camera = Camera(120, 90, 129.0, 129.0, 60.0, 45.0, window_camera(browser).camera_from_world)
    picture = render_in_page(browser, camera).astype(float)
    assert psnr(picture, reference_picture(folder.load(), camera)) > MIN_PSNR_DB
    assert browser.list_errors() == []


def test_gaussians_out_of_view_are_evaluated_before_their_fields_are_dropped(
    browser: Browser, host: Site, tmp_path: Path
):
    """All Gaussians come with the first picture, and the budget leaves the fields of two further parts. The last part
    is far to the side."""
    shift = np.array([500.0, 0.0, 0.0])
    far = replace(MODEL_FRAME, center=tuple(np.array(MODEL_FRAME.center) + shift))
    models = [*(random_model(80, seed) for seed in range(4)), random_model(80, 4, frame=far)]
    folder = split_parts(tmp_path, models, SplitConfig(levels=1))
    serve_levels(host, folder)
    open_levels(browser, host, 400)
    wait_until(browser, f"{HELD_FIELDS_JS} === 2")
    [camera] = shift_cameras([scene_camera(folder.path)], shift)
    picture = render_in_page(browser, camera).astype(float)
    assert picture.std() > 10
    assert psnr(picture, reference_picture(folder.load(), camera)) > MIN_PSNR_DB


@pytest.mark.acceptance
@pytest.mark.parametrize(("scale", "depth"), [(0.05, 0.004), (5.0, 0.03)])
def test_near_gaussians_are_culled_in_the_units_of_their_part(
    browser: Browser, host: Site, tmp_path: Path, scale: float, depth: float
):
    model, camera = make_near_parts(scale, depth)
    parts = list(zip(model.names, map(encode_model, model.parts), strict=True))
    (tmp_path / "both.hyrf").write_bytes(encode_parts(parts))
    split_model(tmp_path / "both.hyrf", tmp_path / "scene", SplitConfig(levels=1), context=RunContext(progress=None))
    serve_levels(host, hyrfpack.SceneFolder(tmp_path / "scene"))
    open_levels(browser, host, 1000)
    wait_until_complete(browser)
    assert psnr(render_in_page(browser, camera).astype(float), render_reference(model, camera)) > MIN_PSNR_DB


@pytest.mark.acceptance
def test_a_restored_device_draws_all_parts_again(browser: Browser, host: Site, parts_folder):
    finest = count_gaussians(parts_folder, 0)
    serve_levels(host, parts_folder)
    open_levels(browser, host, finest)
    wait_until_complete(browser)
    camera = Camera(120, 90, 129.0, 129.0, 60.0, 45.0, window_camera(browser).camera_from_world)
    lose_and_restore_device(browser)
    browser.evaluate("hyrfpack.ready")
    wait_until(browser, f"hyrfpack.player.loader.state.gaussians === {finest}", 60)
    wait_until_complete(browser)
    picture = render_in_page(browser, camera).astype(float)
    assert psnr(picture, reference_picture(parts_folder.load(), camera)) > MIN_PSNR_DB


@pytest.mark.acceptance
def test_a_part_that_the_device_cannot_draw_is_named_and_left_out(browser: Browser, host: Site, tmp_path: Path):
    scene, wide = hyrfpack.load_model(TRAINED_FILE), random_model(50, hidden=272, background=False)
    parts = [("scene", TRAINED_FILE.read_bytes()), ("wide", encode_model(wide))]
    (tmp_path / "both.hyrf").write_bytes(encode_parts(parts))
    split_model(tmp_path / "both.hyrf", tmp_path / "scene", SplitConfig(levels=1), context=RunContext(progress=None))
    serve_levels(host, hyrfpack.SceneFolder(tmp_path / "scene"))
    open_levels(browser, host, 2000)
    message = "shared-01.hyrf cannot be shown: the decoders are too wide for this device; the rest of the scene"
    wait_until(browser, f"document.getElementById('remark').textContent.includes('{message}')", 60)
    camera = Camera(120, 90, 129.0, 129.0, 60.0, 45.0, window_camera(browser).camera_from_world)
    assert psnr(render_in_page(browser, camera).astype(float), reference_picture(scene, camera)) > MIN_PSNR_DB


class DyingServer(dict):
    """Files of a server whose connections break from the first request of a finest level on."""

    def __init__(self, host: Site) -> None:
        super().__init__(host.files)
        self.host = host

    def get(self, path: str, default: bytes | None = None) -> bytes | None:
        if path.endswith("-0.hyrf"):
            self.host.breaks, self.host.always = 0, True
        return super().get(path, default)


@pytest.mark.acceptance
def test_a_connection_that_is_lost_after_the_first_picture_is_named_and_found_again(
    browser: Browser, host: Site, levels_folder
):
    finest = count_gaussians(levels_folder, 0)
    serve_levels(host, levels_folder)
    host.files = DyingServer(host)
    open_levels(browser, host, finest)
    wait_until(browser, "document.getElementById('remark').textContent.includes('loading goes on when it is back')")
    assert browser.evaluate("hyrfpack.player.loader.state.gaussians") == count_gaussians(levels_folder, -1)
    host.files, host.breaks, host.always = dict(host.files), None, False
    wait_until(browser, f"hyrfpack.player.loader.state.gaussians === {finest}", 60)
    assert not wait_until_complete(browser)["problem"]


@pytest.mark.acceptance
def test_the_element_streams_a_scene_folder(browser: Browser, host: Site, levels_folder):
    serve_levels(host, levels_folder)
    open_element(browser, host, 'src="levels/scene.json"')
    wait_until(browser, LOADED_JS, 30)
    wait_until(browser, f"{ELEMENT_JS}.viewer.player.loader.state?.isComplete === true", 60)
    state = browser.evaluate(f"{ELEMENT_JS}.viewer.player.loader.state")
    assert state["gaussians"] == browser.evaluate(f"{ELEMENT_JS}.viewer.scene.count")
    assert browser.list_errors() == []

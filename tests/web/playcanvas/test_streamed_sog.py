"""The engine of PlayCanvas streams the Streamed SOG that an export writes, and draws it as we do."""

from __future__ import annotations

import io
import json
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

import numpy as np
import pytest
from level_scenes import SCENE_CENTER, SCENE_SCALE, write_level_scene
from PIL import Image
from scenes import camera_at
from web.pages import camera_json, psnr, wait_until
from web.served import serve_project

import hyrfpack
from hyrfpack.context import RunContext
from hyrfpack.model import Frame
from hyrfpack.scene import Camera
from hyrfpack.splats.draw import Drawable, draw
from hyrfpack.splats.files import read_splats
from hyrfpack.splats.splats import concatenate
from tools.browser.chromium import Chromium, find_program

pytestmark = pytest.mark.acceptance
NODE_MODULES = Path(__file__).parents[2] / "bundlers" / "node_modules"
SIZE_PIXELS = 200
MIN_PSNR_DB = 30  # PlayCanvas rounds colours of its work buffer, and blends in another order where depths are close
AMPLE_BUDGET = 1_000_000
SETTLING_FRAMES = 30


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the page, the engine and an export of three levels: 256, 64 and 16 Gaussians."""
    if not (NODE_MODULES / "playcanvas").is_dir():
        pytest.skip("playcanvas is not installed (npm ci --prefix tests/bundlers)")
    folder = tmp_path_factory.mktemp("playcanvas")
    for name in ("streamed.html", "streamed.js"):
        shutil.copy(Path(__file__).with_name(name), folder)
    (folder / "node_modules").mkdir()
    (folder / "node_modules" / "playcanvas").symlink_to(NODE_MODULES / "playcanvas")
    scene = write_level_scene(folder)
    config = hyrfpack.ExportConfig(streamed_sog=True, degree=1)
    hyrfpack.export_model(scene, folder / "streamed", config, context=RunContext(progress=None))
    return folder


@pytest.fixture(scope="module")
def engine() -> Iterator[Chromium]:
    if find_program() is None:
        pytest.skip("there is no Chromium on this machine")
    with Chromium("--enable-unsafe-swiftshader", "--use-angle=swiftshader", timeout_seconds=180) as browser:
        browser.resize(SIZE_PIXELS, SIZE_PIXELS)
        yield browser


def make_camera() -> Camera:
    position = np.array(SCENE_CENTER) + SCENE_SCALE * np.array((1.5, 1.2, 0.9))
    return camera_at(position, target=SCENE_CENTER, width=SIZE_PIXELS, height=SIZE_PIXELS)


def stream(engine: Chromium, folder: Path, budget: int, expected_count: int) -> np.ndarray:
    """Return the picture (N, N, 3) of the engine once it draws `expected_count` Gaussians."""
    with serve_project(folder) as address:
        camera = quote(camera_json(make_camera()))
        engine.open(f"{address}/own/streamed.html?index=streamed/lod-meta.json&budget={budget}&camera={camera}")
        wait_until(engine, "globalThis.page?.failed || page.drawn() > 0", 60)
        assert engine.evaluate("page.failed") is None
        wait_until(engine, f"page.drawn() === {expected_count}", 60)
        frames = engine.evaluate("page.frames")
        wait_until(engine, f"page.frames > {frames + SETTLING_FRAMES}", 60)
        assert engine.evaluate("page.drawn()") == expected_count
        time.sleep(0.5)  # the picture of the last frame reaches the window
        picture = np.asarray(Image.open(io.BytesIO(engine.screenshot())).convert("RGB"))
        assert engine.list_errors() == []
        engine.open("about:blank")
    return picture.astype(np.float64)


def draw_levels(folder: Path, level: int) -> np.ndarray:
    index = json.loads((folder / "streamed" / "lod-meta.json").read_text())
    names = [name for name in index["filenames"] if name.startswith(f"{level}_")]
    parts = [read_splats((folder / "streamed" / name).parent) for name in (*names, index["environment"])]
    drawable = Drawable.from_splats(concatenate(parts), Frame(SCENE_CENTER, SCENE_SCALE, (1.0, 1.0, 1.0)))
    return 255 * draw(drawable, make_camera()).rgb.clamp(0, 1).numpy()


def count_background(folder: Path) -> int:
    return len(read_splats(folder / "streamed" / "env"))


def test_the_engine_draws_the_finest_levels_and_the_background_within_an_ample_budget(engine, folder):
    picture = stream(engine, folder, AMPLE_BUDGET, 256 + count_background(folder))
    assert psnr(picture, draw_levels(folder, 0)) > MIN_PSNR_DB


def test_the_engine_draws_the_coarsest_levels_within_the_smallest_budget(engine, folder):
    picture = stream(engine, folder, 1, 16 + count_background(folder))
    assert psnr(picture, draw_levels(folder, 2)) > MIN_PSNR_DB
    assert psnr(picture, draw_levels(folder, 0)) < psnr(picture, draw_levels(folder, 2)) - 3

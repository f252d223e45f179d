"""HyrfSplats draws a file's model among the splats of Spark, sorted with them and with meshes."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from web.pages import psnr
from web.served import serve_project
from web.test_exposure import visible_map
from web.three.test_native import (
    EXACT_SETTINGS,
    GOLDEN_FILE,
    SIZE_PIXELS,
    draw,
    first_camera,
    opened_page,
    read,
    render,
    three_browser,
    write_page,
)
from web.three.test_three import PROJECT_FOLDER, app_folder

import hyrfpack
from hyrfpack.render import render_view
from tools.browser.chromium import Chromium

SPARK_FOLDER = PROJECT_FOLDER / "tests" / "bundlers" / "node_modules" / "@sparkjsdev" / "spark"
__all__ = ["app_folder", "three_browser"]
pytestmark = pytest.mark.acceptance


@pytest.fixture(scope="module")
def address(app_folder: Path) -> Iterator[str]:
    if not SPARK_FOLDER.is_dir():
        pytest.skip("Spark is not here; run `npm ci` in tests/bundlers")
    write_page(app_folder, "spark.js")
    (app_folder / "node_modules" / "@sparkjsdev").mkdir()
    (app_folder / "node_modules" / "@sparkjsdev" / "spark").symlink_to(SPARK_FOLDER)
    with serve_project(app_folder) as address:
        yield f"{address}/own"


@pytest.fixture
def page(three_browser: Chromium, address: str) -> Iterator[Chromium]:
    with opened_page(three_browser, f"{address}/native.html?spark", "Boolean(globalThis.page?.addSplat)", 60) as page:
        yield page


@pytest.mark.parametrize(("file", "least_psnr"), [("golden.hyrf", 42), ("balls.hyrf", 52)])
def test_pictures_are_those_of_the_exact_render(file, least_psnr, page: Chromium, app_folder: Path):
    """The balls have no background, and opacities compensated for the low-pass filter."""
    page.evaluate(f"page.load('{file}')")
    for number in (0, 3):
        camera = first_camera(page, number)
        reference = render(app_folder / file, camera)
        assert psnr(draw(page, camera), reference) > least_psnr, number
        assert psnr(reference.mean((0, 1)), reference) < 25, "the picture is nearly uniform"


def test_the_exposure_applies_and_can_be_turned_off(page: Chromium, app_folder: Path):
    model = hyrfpack.load_model(GOLDEN_FILE)
    model.exposure = visible_map()
    hyrfpack.save_model(
        model, app_folder / "exposed.hyrf", provenance=hyrfpack.describe_file(GOLDEN_FILE)["provenance"]
    )
    page.evaluate("page.load('exposed.hyrf')")
    camera = first_camera(page)
    settings = replace(EXACT_SETTINGS, exposure="as-photographed")
    exposed = 255 * render_view(model, camera, settings).rgb.detach().clamp(0, 1).numpy().astype(np.float64)
    assert psnr(draw(page, camera), exposed) > 36
    page.evaluate("page.object.exposure = 'consistent'")
    assert psnr(draw(page, camera), render(app_folder / "golden.hyrf", camera)) > 42


def test_splats_of_spark_and_meshes_are_sorted_with_the_gaussians(page: Chromium):
    page.evaluate("page.load('balls.hyrf')")
    camera = first_camera(page)
    plain = draw(page, camera)
    target = np.array(page.evaluate("page.object.userData.hyrf.target"))
    to_eye = camera.position - target
    middle = slice(SIZE_PIXELS // 2 - 4, SIZE_PIXELS // 2 + 4)
    for add, color in (("page.addSplat({}, 0.3, [0, 1, 0])", 128), ("page.addBall({}, 0.3, 0x00ff00)", 255)):
        pictures = {}
        for name, place in (("front", target + 0.5 * to_eye), ("behind", target - 0.5 * to_eye)):
            page.evaluate(f"void (globalThis.added = {add.format(place.tolist())})")
            page.evaluate("page.draw()")
            pictures[name] = read(page, camera)
            page.evaluate("void added.removeFromParent()")
        assert pictures["front"][middle, middle, 1].min() >= color, add
        assert pictures["front"][middle, middle, 0].max() < 64, add
        assert np.abs(pictures["behind"][middle, middle] - plain[middle, middle]).max() < 16, add


def test_dispose_ends_the_worker_and_empties_the_picture(page: Chromium):
    page.evaluate("page.load('golden.hyrf')")
    draw(page, first_camera(page))
    assert "remote_worker.js" in [worker.rpartition("/")[2] for worker in page.list_workers()]
    page.evaluate("void page.object.dispose()")
    ends = time.monotonic() + 10
    while "remote_worker.js" in [worker.rpartition("/")[2] for worker in page.list_workers()]:
        assert time.monotonic() < ends, "the worker still runs"
        time.sleep(0.05)
    page.evaluate("page.draw()")
    assert read(page, replace(first_camera(page), width=SIZE_PIXELS)).max() == 0

"""The comparison page in a browser: slider, keys and difference."""

from __future__ import annotations

import shutil
import subprocess
import time
from importlib.resources import files
from pathlib import Path

import pytest
from PIL import Image

from hyrfpack.report.comparison_page import encode_comparison
from hyrfpack.report.curves import LINE_COLORS, LINE_DASHES, choose_line_style
from hyrfpack.report.run import Record, Run, Score
from hyrfpack.report.views import ComparedView
from tools.browser import chromium

RUN_NAMES = ["first", 'the "other"']


def make_run(psnr: float) -> Run:
    curve = [Record(step, psnr - 1 / step, 100 * step, float(step)) for step in range(1, 9)]
    return Run(
        *(Path(), {"model.hyrf": 10}, 5, 1.0, {"steps": 8, "seed": 0}, {}, "cpu", 1, {}, [], curve, psnr, 0.5, None),
        *([Score("one.png", psnr, 0.5, None), Score("two.png", psnr, 0.5, None)], [], {}, None),
    )


def uniform_image(level: int) -> Image.Image:
    return Image.new("RGB", (40, 30), (level, level, level))


@pytest.fixture
def page(tmp_path: Path) -> Path:
    """A page of two views in uniform grey: photo 100, renders 110 and 160; 50 in all of the second view."""
    views = [
        ComparedView("one.png", uniform_image(100), [uniform_image(110), uniform_image(160)], True),
        ComparedView("two.png", uniform_image(50), [uniform_image(50), uniform_image(50)], True),
    ]
    path = tmp_path / "page.html"
    path.write_bytes(encode_comparison([make_run(20), make_run(30)], RUN_NAMES, views, []))
    return path


def wait_until(browser: chromium.Chromium, expression: str) -> None:
    ends = time.monotonic() + 30
    while not browser.evaluate(expression):
        assert time.monotonic() < ends, f"never: {expression}"
        time.sleep(0.02)


@pytest.mark.acceptance
def test_pictures_can_be_chosen_split_by_keys_and_pointer_and_subtracted(page: Path, tmp_path: Path):
    if chromium.find_program() is None:
        pytest.skip("there is no Chromium here")
    with chromium.Chromium() as browser:
        browser.resize(900, 700)
        browser.open(page.as_uri())
        messages = "document.getElementById('difference-name').textContent"
        wait_until(browser, f"{messages}.includes('10.00 levels')")
        assert "brightest 51 of 255" in browser.evaluate(messages)
        assert browser.evaluate("document.getElementById('over').alt") == "one.png, photo"

        browser.evaluate("right.value = 2, right.dispatchEvent(new Event('change'))")
        wait_until(browser, f"{messages}.includes('60.00 levels')")
        assert browser.evaluate("document.getElementById('right-name').textContent") == f"right: {RUN_NAMES[1]}"
        brightest = "[...difference.getContext('2d').getImageData(5, 5, 1, 1).data]"
        assert browser.evaluate(brightest) == [252, 255, 164, 255]  # the last colour of the inferno colour map
        assert "30.00" in browser.evaluate("document.getElementById('scores').textContent")

        browser.evaluate("stage.scrollIntoView(), cut.focus({ preventScroll: true })")
        browser.press("End")
        assert browser.evaluate("stage.style.getPropertyValue('--cut')") == "100%"
        box = browser.evaluate("(() => { const b = stage.getBoundingClientRect(); return [b.x, b.y, b.width]; })()")
        browser.drag((box[0] + box[2] / 2, box[1] + 5), (box[0] + box[2] / 4, box[1] + 5))
        assert float(browser.evaluate("cut.value")) == pytest.approx(25, abs=1)

        browser.evaluate("view.value = 1, view.dispatchEvent(new Event('change'))")
        wait_until(browser, f"{messages}.includes('is 0.00 levels')")
        assert browser.list_errors() == []


def test_node_can_parse_the_script_and_a_page_can_embed_it(tmp_path: Path):
    script = files("hyrfpack.report").joinpath("views.js").read_text("utf-8")
    assert "</script" not in script.lower() and "<!--" not in script
    if shutil.which("node") is None:
        pytest.skip("node is not on this machine")
    (tmp_path / "views.js").write_text(script)
    subprocess.run(["node", "--check", str(tmp_path / "views.js")], check=True, timeout=60)


def test_lines_of_many_runs_can_be_distinguished():
    styles = [choose_line_style(number) for number in range(len(LINE_COLORS) * len(LINE_DASHES))]
    assert len(set(styles)) == len(styles) == 18

"""The page of a comparison in a browser: slider, keys, difference."""

from __future__ import annotations

import shutil
import subprocess
import time
from importlib.resources import files
from pathlib import Path

import pytest
from PIL import Image

from hyrfpack.compare.curves import LINE_COLORS, LINE_DASHES, line_style
from hyrfpack.compare.page import encode_comparison
from hyrfpack.compare.run import Record, Run, Score
from hyrfpack.compare.views import ComparedView
from tools.browser import chromium

NAMES = ["first", 'the "other"']


def run(psnr: float) -> Run:
    curve = [Record(step, psnr - 1 / step, 100 * step, float(step)) for step in range(1, 9)]
    return Run(
        *(Path(), {"model.hyrf": 10}, 5, 1.0, {"steps": 8, "seed": 0}, {}, "cpu", {}, [], curve, psnr, 0.5, None),
        *([Score("one.png", psnr, 0.5, None), Score("two.png", psnr, 0.5, None)], [], {}, None),
    )


def flat(level: int) -> Image.Image:
    return Image.new("RGB", (40, 30), (level, level, level))


@pytest.fixture
def page(tmp_path: Path) -> Path:
    """Two views of even grey: the photo 100, the renders 110 and 160, and of the second view all 50."""
    views = [
        ComparedView("one.png", flat(100), [flat(110), flat(160)], True),
        ComparedView("two.png", flat(50), [flat(50), flat(50)], True),
    ]
    path = tmp_path / "page.html"
    path.write_bytes(encode_comparison([run(20), run(30)], NAMES, views, []))
    return path


def until(browser: chromium.Chromium, expression: str) -> None:
    ends = time.monotonic() + 10
    while not browser.evaluate(expression):
        assert time.monotonic() < ends, f"never: {expression}"
        time.sleep(0.02)


def test_pictures_are_chosen_cut_by_keys_and_pointer_and_their_difference_drawn(page: Path, tmp_path: Path):
    if chromium.find() is None:
        pytest.skip("there is no Chromium here")
    with chromium.Chromium(tmp_path / "profile") as browser:
        browser.resize(900, 700)
        browser.open(page.as_uri())
        told = "document.getElementById('difference-name').textContent"
        until(browser, f"{told}.includes('10.00 levels')")
        assert "brightest 51 of 255" in browser.evaluate(told)
        assert browser.evaluate("document.getElementById('over').alt") == "one.png, photo"

        browser.evaluate("right.value = 2, right.dispatchEvent(new Event('change'))")
        until(browser, f"{told}.includes('60.00 levels')")
        assert browser.evaluate("document.getElementById('right-name').textContent") == f"right: {NAMES[1]}"
        brightest = "[...difference.getContext('2d').getImageData(5, 5, 1, 1).data]"
        assert browser.evaluate(brightest) == [252, 255, 164, 255]  # inferno's last colour
        assert "30.00" in browser.evaluate("document.getElementById('scores').textContent")

        browser.evaluate("stage.scrollIntoView(), cut.focus({ preventScroll: true })")
        browser.press("End")
        assert browser.evaluate("stage.style.getPropertyValue('--cut')") == "100%"
        box = browser.evaluate("(() => { const b = stage.getBoundingClientRect(); return [b.x, b.y, b.width]; })()")
        browser.drag((box[0] + box[2] / 2, box[1] + 5), (box[0] + box[2] / 4, box[1] + 5))
        assert float(browser.evaluate("cut.value")) == pytest.approx(25, abs=1)

        browser.evaluate("view.value = 1, view.dispatchEvent(new Event('change'))")
        until(browser, f"{told}.includes('is 0.00 levels')")
        assert browser.list_errors() == []


def test_the_script_is_one_that_node_reads_and_a_page_can_hold(tmp_path: Path):
    script = files("hyrfpack.compare").joinpath("script.js").read_text("utf-8")
    assert "</script" not in script.lower() and "<!--" not in script
    if shutil.which("node") is None:
        pytest.skip("node is not on this machine")
    (tmp_path / "script.js").write_text(script)
    subprocess.run(["node", "--check", str(tmp_path / "script.js")], check=True, timeout=60)


def test_lines_of_many_runs_can_be_told_apart():
    styles = [line_style(number) for number in range(len(LINE_COLORS) * len(LINE_DASHES))]
    assert len(set(styles)) == len(styles) == 18

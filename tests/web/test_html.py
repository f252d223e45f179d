"""The web page: one file, safe and whole; in browsers it draws what our rasteriser draws."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from web.pages import CASES, UP, Browser, camera, cloud, drawn, opened, page_of, psnr, shown, sky, sky_seen

from hyrfpack.cameras.paths import look_at
from hyrfpack.model import Frame
from hyrfpack.splats.formats import ply
from hyrfpack.web.html import decode_splats_page


def test_pictures_are_those_of_our_rasterizer(browser: Browser, tmp_path: Path):
    splats = cloud()
    page = page_of(splats, sky())
    opened(browser, tmp_path, page)
    for case, at in CASES.items():
        picture = shown(browser, at)
        assert psnr(picture, drawn(decode_splats_page(page, "page")[0], at, sky_seen(at))) > 45, case
        assert psnr(picture, drawn(splats, at, sky_seen(at))) > 38, case
    assert browser.list_errors() == []


def test_a_scene_of_another_program_looks_as_our_rasterizer_draws_it(
    browser: Browser, tmp_path: Path, shared_data: Path
):
    splats = ply.decode((shared_data / "trained_models" / "inria_sh3_small.ply").read_bytes(), "small.ply")
    middle = np.median(splats.positions, axis=0)
    size = float(np.percentile(np.abs(splats.positions - middle), 90))
    at = replace(camera(), camera_from_world=look_at(middle - 2 * size * np.array([0.0, 0.3, 0.95]), middle, UP))
    page = page_of(splats, cameras=[at], near=0.01 * size)
    frame = Frame(tuple(middle), size, (1.0, 1.0, 1.0))
    picture = shown(opened(browser, tmp_path, page), at)
    assert psnr(picture, drawn(decode_splats_page(page, "page")[0], at, frame=frame)) > 45
    assert psnr(picture, drawn(splats, at, frame=frame)) > 38


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_lower_degrees_and_compensated_opacities_look_right(browser: Browser, tmp_path: Path, degree: int):
    page = page_of(replace(cloud(400, degree), antialiased=degree != 1))
    opened(browser, tmp_path, page)
    assert psnr(shown(browser, camera(6.0)), drawn(decode_splats_page(page, "page")[0], camera(6.0))) > 50


def test_where_targets_of_floats_are_missing_eight_bits_serve(browser: Browser, tmp_path: Path):
    script = "WebGL2RenderingContext.prototype.getExtension = () => null"
    with browser.before_every_page(script):
        page = page_of(cloud())
        opened(browser, tmp_path, page)
        assert psnr(shown(browser, camera()), drawn(decode_splats_page(page, "page")[0], camera())) > 35


def test_a_page_without_splats_shows_its_background(browser: Browser, tmp_path: Path):
    opened(browser, tmp_path, page_of(cloud(0), sky()))
    assert psnr(shown(browser, camera()), 255 * sky_seen(camera())) > 40

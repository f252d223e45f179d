"""The web page of splats draws in browsers what our rasteriser draws."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from web.pages import (
    CAMERA_CASES,
    UP_DIRECTION,
    Browser,
    make_camera,
    make_splats_page,
    open_page,
    psnr,
    random_splats,
    rasterize_reference,
    render_in_page,
    sky_panorama,
    sky_picture,
)

from hyrfpack.cameras.paths import look_at
from hyrfpack.model import Frame
from hyrfpack.splats.formats import ply
from hyrfpack.web.html import decode_splats_page


@pytest.mark.smoke
@pytest.mark.in_turn
def test_pictures_equal_those_of_our_rasterizer(browser: Browser, tmp_path: Path):
    splats = random_splats()
    page = make_splats_page(splats, sky_panorama())
    open_page(browser, tmp_path, page)
    for case, at in CAMERA_CASES.items():
        picture = render_in_page(browser, at)
        assert psnr(picture, rasterize_reference(decode_splats_page(page, "page")[0], at, sky_picture(at))) > 45, case
        assert psnr(picture, rasterize_reference(splats, at, sky_picture(at))) > 38, case
    assert browser.list_errors() == []


def test_splats_of_another_program_look_as_in_our_rasterizer(browser: Browser, tmp_path: Path, shared_data: Path):
    splats = ply.decode((shared_data / "trained_models" / "inria_sh3_small.ply").read_bytes(), "small.ply")
    middle = np.median(splats.positions, axis=0)
    size = float(np.percentile(np.abs(splats.positions - middle), 90))
    at = replace(
        make_camera(), camera_from_world=look_at(middle - 2 * size * np.array([0.0, 0.3, 0.95]), middle, UP_DIRECTION)
    )
    page = make_splats_page(splats, cameras=[at], near=0.01 * size)
    frame = Frame(tuple(middle), size, (1.0, 1.0, 1.0))
    picture = render_in_page(open_page(browser, tmp_path, page), at)
    assert psnr(picture, rasterize_reference(decode_splats_page(page, "page")[0], at, frame=frame)) > 45
    assert psnr(picture, rasterize_reference(splats, at, frame=frame)) > 38


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_lower_degrees_and_antialiased_splats_look_as_in_our_rasterizer(browser: Browser, tmp_path: Path, degree: int):
    page = make_splats_page(replace(random_splats(400, degree), antialiased=degree != 1))
    open_page(browser, tmp_path, page)
    assert (
        psnr(
            render_in_page(browser, make_camera(6.0)),
            rasterize_reference(decode_splats_page(page, "page")[0], make_camera(6.0)),
        )
        > 50
    )


def test_eight_bit_targets_are_used_where_float_targets_are_missing(browser: Browser, tmp_path: Path):
    script = "WebGL2RenderingContext.prototype.getExtension = () => null"
    with browser.before_every_page(script):
        page = make_splats_page(random_splats())
        open_page(browser, tmp_path, page)
        assert (
            psnr(
                render_in_page(browser, make_camera()),
                rasterize_reference(decode_splats_page(page, "page")[0], make_camera()),
            )
            > 35
        )


def test_a_page_without_splats_shows_its_background(browser: Browser, tmp_path: Path):
    open_page(browser, tmp_path, make_splats_page(random_splats(0), sky_panorama()))
    assert psnr(render_in_page(browser, make_camera()), 255 * sky_picture(make_camera())) > 40

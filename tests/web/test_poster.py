"""The poster lies where the first frame shows the same things, and only the first view of the page's file has it."""

from __future__ import annotations

import io
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from web.pages import (
    CAMERA_CASES,
    SCENE_CENTER,
    UP_DIRECTION,
    Browser,
    make_camera,
    make_splats_page,
    open_page,
    random_splats,
    rasterize_reference,
    wait_for_message,
    wait_until,
)  # fmt: skip
from web.site import Site, drop_file

from hyrfpack.cameras.view_sampling import shrink_camera
from hyrfpack.scene import Camera
from hyrfpack.splats.splats import Splats
from hyrfpack.web.html import encode_views
from hyrfpack.web.player import encode_element_script, encode_player

pytestmark = [pytest.mark.in_turn, pytest.mark.usefixtures("reset_window")]
WINDOW_SIZES = [(1280, 800), (390, 844), (300, 200)]
POSTER_JS = "document.getElementById('poster')"
NO_WEBGL_JS = "HTMLCanvasElement.prototype.getContext = () => null"


def three_balls(camera: Camera) -> Splats:
    """Return a red, a green and a blue ball that the camera sees near the centre of its picture."""
    balls = random_splats(3, 0)
    places = np.array([[-0.25, 0.1, 2.5], [0.2, 0.15, 2.5], [0.05, -0.2, 2.4]])
    positions = camera.position + places @ camera.rotation
    harmonics = np.full_like(balls.harmonics, -1.8) + 3.5 * np.eye(3, dtype=np.float32)[:, None]
    return replace(
        balls, positions=positions, scales=np.full((3, 3), 0.04, np.float32), opacities=np.full(3, 0.99, np.float32),
        harmonics=harmonics,
    )  # fmt: skip


def make_poster(splats: Splats, camera: Camera) -> bytes:
    camera = replace(
        camera, width=4 * camera.width, height=4 * camera.height, fx=4 * camera.fx, fy=4 * camera.fy,
        cx=4 * camera.cx, cy=4 * camera.cy,
    )  # fmt: skip
    file = io.BytesIO()
    Image.fromarray(rasterize_reference(splats, shrink_camera(camera, 480)).astype(np.uint8)).save(file, "WEBP")
    return file.getvalue()


def ball_centers(browser: Browser) -> np.ndarray:
    """Wait until the window shows all three balls; return their centres (3, 2) in CSS pixels."""
    ends = time.monotonic() + 10
    while (weights := ball_weights(browser)).sum((1, 2)).min() < 10:
        assert time.monotonic() < ends, "a ball is not visible"
    v, u = np.mgrid[: weights.shape[1], : weights.shape[2]] + 0.5
    return np.array([[(weight * u).sum(), (weight * v).sum()] / weight.sum() for weight in weights])


def ball_weights(browser: Browser) -> np.ndarray:
    """Return the pixels (3, H, W) of the window that show each ball, as 1, and the others as 0."""
    with Image.open(io.BytesIO(browser.screenshot())) as picture:
        seen = np.asarray(picture.convert("RGB"), np.float64)
    return np.array([seen[..., k] - np.delete(seen, k, axis=-1).max(-1) > 90 for k in range(3)], np.float64)


@pytest.mark.parametrize("size", WINDOW_SIZES, ids=str)
@pytest.mark.parametrize("case", ["as photographed", "oblong pixels", "off-centre"])
def test_the_poster_lies_where_the_first_frame_shows_the_same_things(
    browser: Browser, tmp_path: Path, size: tuple[int, int], case: str
):
    browser.resize(*size)
    camera = CAMERA_CASES[case] if case != "off-centre" else replace(make_camera(), cx=70.0, cy=35.0)
    balls = three_balls(camera)
    page = make_splats_page(balls, cameras=[camera], poster=make_poster(balls, camera))
    (tmp_path / "page.html").write_bytes(page)
    with browser.before_every_page(NO_WEBGL_JS):  # so that the poster stays
        browser.open((tmp_path / "page.html").as_uri() + "?noui")
        wait_for_message(browser)
        browser.press("Escape")
        browser.evaluate("(document.getElementById('message').hidden = true, 0)")
        wait_until(browser, f"{POSTER_JS}.classList.contains('placed')")
        on_poster = ball_centers(browser)
    open_page(browser, tmp_path, page, "?noui")
    browser.evaluate("hyrfpack.player.settled.then(() => true)")
    wait_until(browser, f"!{POSTER_JS} && !document.getElementById('backdrop')")
    assert np.abs(on_poster - ball_centers(browser)).max() < 3


def test_the_poster_of_the_element_lies_where_the_scene_is_drawn(browser: Browser, host: Site):
    camera = make_camera()
    balls = three_balls(camera)
    host.files["/poster.webp"] = make_poster(balls, camera)
    host.files["/hyrf-viewer.js"] = encode_element_script()
    host.files["/page.html"] = (
        b"<!DOCTYPE html><style>body { margin: 0; } hyrf-viewer { width: 200px; height: 400px; }</style>"
        b'<script src="hyrf-viewer.js"></script><hyrf-viewer poster="poster.webp"></hyrf-viewer>'
    )
    browser.resize(300, 500)
    browser.open(f"{host.address}/page.html")
    image = "document.querySelector('hyrf-viewer').shadowRoot.querySelector('img')"
    wait_until(browser, f"{image}?.classList.contains('placed')")
    scale = np.sqrt(200 * 400 / (camera.width * camera.height))
    centers = [
        [100 + scale * camera.fx * x / z, 200 + scale * camera.fy * y / z]
        for x, y, z in (balls.positions - camera.position) @ camera.rotation.T
    ]
    assert np.abs(ball_centers(browser) - centers).max() < 3


# ---- views and files without a poster


def serve_page_with_poster(host: Site) -> None:
    camera = make_camera()
    views = encode_views([camera, make_camera(1.5)], UP_DIRECTION, SCENE_CENTER)
    host.files["/index.html"] = encode_player(
        "room", content="some scene.hyrf", poster="poster.webp", views={"some scene.hyrf": views}
    )
    host.files["/poster.webp"] = host.files["/other.webp"] = make_poster(three_balls(camera), camera)


@pytest.mark.parametrize(
    ("where", "shown"),
    [
        ("", "poster.webp"),
        ("#camera=1", "poster.webp"),
        ("?content=some%20scene.hyrf", "poster.webp"),
        ("?content=cloud.spz&poster=other.webp", "other.webp"),
        ("?content=cloud.spz", None),
        ("#camera=2", None),
        ("?camera=2", None),
        ("#camera=1,2,3,1,0,0,0,1,2", None),
    ],
)
def test_other_files_and_views_than_the_first_have_no_poster(
    browser: Browser, host: Site, where: str, shown: str | None
):
    serve_page_with_poster(host)
    with browser.before_every_page(NO_WEBGL_JS):
        browser.open(f"{host.address}/index.html{where}")
        wait_for_message(browser)
        name = browser.evaluate(f"{POSTER_JS} && {POSTER_JS}.src.split('/').pop()")
    assert name == shown


def test_a_page_of_one_file_ignores_the_poster_of_its_address(browser: Browser, tmp_path: Path):
    camera = make_camera()
    poster = make_poster(three_balls(camera), camera)
    (tmp_path / "page.html").write_bytes(make_splats_page(three_balls(camera), poster=poster))
    with browser.before_every_page(NO_WEBGL_JS):
        browser.open(f"{(tmp_path / 'page.html').as_uri()}?poster=https://example.org/other.webp")
        wait_for_message(browser)
    assert browser.evaluate(f"{POSTER_JS}.src.startsWith('data:') && {POSTER_JS}.naturalWidth > 0")


def test_a_file_that_is_opened_while_another_one_loads_removes_the_poster(browser: Browser, host: Site):
    serve_page_with_poster(host)
    del host.files["/some scene.hyrf"]
    browser.open(f"{host.address}/index.html")
    wait_for_message(browser)
    assert browser.evaluate(f"{POSTER_JS} !== null")
    drop_file(browser, b"not a scene", "notes.txt")
    assert browser.evaluate(f"{POSTER_JS} === null")


def test_a_shared_link_does_not_name_the_poster_of_another_view(browser: Browser, host: Site):
    serve_page_with_poster(host)
    browser.open(f"{host.address}/index.html?content=cloud.spz&poster=other.webp")
    browser.evaluate("hyrfpack.ready")
    browser.press("l")
    wait_until(browser, "location.hash.startsWith('#camera=')")
    assert browser.evaluate("location.search") == "?content=cloud.spz"

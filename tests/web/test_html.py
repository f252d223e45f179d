"""The web page: one file, safe and whole; in browsers it draws what our rasteriser draws, and it can be moved."""

from __future__ import annotations

import base64
import json
import re
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from web.browser.chromium import Chromium, find

from hyrfpack.cameras.paths import look_at
from hyrfpack.errors import HyrfDataError
from hyrfpack.model import Frame
from hyrfpack.scene import Camera
from hyrfpack.splats.draw import Drawable, draw
from hyrfpack.splats.formats import ply
from hyrfpack.splats.splats import Splats, normalized_quats
from hyrfpack.web.html import decode_page, encode_page

UP, CENTER = np.array([0.0, -1.0, 0.0]), np.array([1000.0, -50.0, 20.0])
FRAME = Frame(tuple(CENTER), 1.0, (1.0, 1.0, 1.0))
NEAR = 0.01
SOLID = (0.2, 0.3, 0.1)


def cloud(count: int = 1500, degree: int = 3, seed: int = 1) -> Splats:
    """Splats of all shapes around CENTER, far from the origin."""
    rng = np.random.default_rng(seed)
    harmonics = rng.normal(size=(count, 16, 3)) * np.array([0.8] + [0.12] * 15)[:, None]
    return Splats(
        CENTER + rng.normal(size=(count, 3)) * 0.5,
        np.exp(rng.normal(-3.3, 0.8, (count, 3))),
        normalized_quats(rng.normal(size=(count, 4))),
        rng.uniform(size=count),
        harmonics,
    ).with_degree(degree)


def camera(distance: float = 2.5, width: int = 120, height: int = 90) -> Camera:
    pose = look_at(CENTER + distance * np.array([0.6, -0.3, -0.74]), CENTER, UP)
    return Camera(width, height, 110.0, 110.0, width / 2, height / 2, pose)


def sky() -> np.ndarray:
    """(64, 128, 3): smooth over the sphere, different in every direction."""
    latitude, longitude = np.meshgrid(
        np.pi / 2 - np.pi * (np.arange(64) + 0.5) / 64, 2 * np.pi * (np.arange(128) + 0.5) / 128 - np.pi, indexing="ij"
    )
    x, y, z = np.cos(latitude) * np.sin(longitude), -np.sin(latitude), np.cos(latitude) * np.cos(longitude)
    return 0.5 + 0.4 * np.stack((x, y, z), axis=-1)


def page_of(splats: Splats, background: np.ndarray | None = None, title: str = "a scene", **more: object) -> bytes:
    cameras = [camera(), camera(1.5), camera(4.0)]
    settings = {"title": title, "cameras": cameras, "up": UP, "center": CENTER, "solid": SOLID, "near": NEAR}
    return encode_page(splats, background=background, **{**settings, **more})


def test_a_page_is_the_same_bytes_for_the_same_scene_and_names_no_other_file():
    page = page_of(cloud(), sky())
    assert page == page_of(cloud(), sky())
    text = page.decode()
    assert not re.search(r'(src|href)="(?!data:)', text) and "import(" not in text and "://" not in text
    assert "default-src 'none'" in text and "unsafe" not in text


def test_a_title_cannot_break_out_of_the_page():
    title = '</title><script>alert("x")</script>{{script}}'
    text = page_of(cloud(3), title=title).decode()
    assert '<script>alert("x")' not in text and text.count("&lt;script&gt;alert") == 3


def test_a_page_holds_its_splats_as_finely_as_spz_far_from_the_origin_and_in_any_unit():
    for factor in (1e-6, 1.0, 1e6):
        splats = cloud(300)
        splats = replace(splats, positions=splats.positions * factor, scales=splats.scales * np.float32(factor))
        back, _ = decode_page(page_of(splats), "page")
        extent = np.ptp(splats.positions, axis=0).max()
        assert np.abs(back.positions - splats.positions).max() < extent * 2**-21
        assert np.abs(np.log(back.scales / splats.scales)).max() < 1 / 31
        assert np.abs(back.opacities - splats.opacities).max() < 1 / 500
        assert back.degree == 3


def test_many_splats_come_in_blocks_that_unpack_apart(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("hyrfpack.web.html.BLOCK", 3000)
    page = page_of(cloud())
    assert page.count(b'class="splats"') > 10 and len(decode_page(page, "page")[0]) == 1500


def test_a_page_needs_a_camera():
    with pytest.raises(ValueError, match="camera"):
        page_of(cloud(3), cameras=[])


@pytest.mark.parametrize("data", [b"", b"<html>", b'<script type="text/plain" id="scene">{}</script>'])
def test_what_is_no_page_is_refused_in_one_sentence(data: bytes):
    with pytest.raises(HyrfDataError, match=r"^x\.html: this is not a page"):
        decode_page(data, "x.html")


def test_damaged_pages_give_splats_or_one_sentence():
    page = page_of(cloud(20))
    rng = np.random.default_rng(0)
    places = [match.span(1) for match in re.finditer(rb'(?:id="scene"|class="splats")>([^<]*)<', page)]
    for _ in range(300):
        damaged, (first, last) = bytearray(page), places[rng.integers(2)]
        damaged[rng.integers(first, last)] = rng.integers(256)
        try:
            decode_page(bytes(damaged), "x.html")
        except HyrfDataError as error:
            assert str(error).startswith("x.html: ") and "\n" not in str(error)


# --- in a browser -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chromium]:
    if find() is None:
        pytest.skip("there is no Chromium here")
    with Chromium(tmp_path_factory.mktemp("profile")) as opened:
        opened.resize(240, 180)
        yield opened


def opened(browser: Chromium, tmp_path: Path, page: bytes, hash: str = "") -> Chromium:
    """The page in the browser, loaded."""
    file = tmp_path / "page.html"
    file.write_bytes(page)
    browser.open(file.as_uri() + hash)
    browser.evaluate("hyrfpack.ready")
    return browser


def settled(browser: Chromium) -> Chromium:
    """Once the window's picture has not changed for a while."""
    frames, since, ends = browser.evaluate("hyrfpack.frames()"), time.monotonic(), time.monotonic() + 15
    while time.monotonic() < min(since + 0.5, ends):
        time.sleep(0.05)
        if (now := browser.evaluate("hyrfpack.frames()")) != frames:
            frames, since = now, time.monotonic()
    return browser


def json_of(camera: Camera) -> str:
    fx, fy, cx, cy = camera.intrinsics
    size = {"width": camera.width, "height": camera.height, "fx": fx, "fy": fy, "cx": cx, "cy": cy}
    return json.dumps({**size, "camera_from_world": camera.camera_from_world.tolist()})


def pixels(browser: Chromium, camera: Camera) -> np.ndarray:
    data = browser.evaluate("btoa(Array.from(hyrfpack.pixels(), (byte) => String.fromCharCode(byte)).join(''))")
    return np.frombuffer(base64.b64decode(data), np.uint8).reshape(camera.height, camera.width, 3)


def shown(browser: Chromium, camera: Camera) -> np.ndarray:
    """(H, W, 3) uint8: what the page draws for a camera."""
    browser.evaluate(f"hyrfpack.show({json_of(camera)})")
    return pixels(browser, camera)


def drawn(splats: Splats, camera: Camera, background: np.ndarray | None = None, frame: Frame = FRAME) -> np.ndarray:
    """The same by our rasteriser."""
    raster = draw(Drawable.of(splats, frame), camera)
    behind = np.array(SOLID) if background is None else background
    return np.clip(raster.rgb.numpy() + raster.transmittance.numpy()[..., None] * behind, 0, 1) * 255


def sky_seen(camera: Camera) -> np.ndarray:
    """(H, W, 3) the sky behind each pixel, from its formula."""
    v, u = np.meshgrid(np.arange(camera.height) + 0.5, np.arange(camera.width) + 0.5, indexing="ij")
    rays = np.stack(((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)), axis=-1)
    directions = rays @ camera.rotation
    return 0.5 + 0.4 * directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def psnr(first: np.ndarray, second: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / ((first - second) ** 2).mean()))


CASES = {
    "as photographed": camera(),
    "off-centre": replace(camera(), cx=100.0, cy=10.0),
    "oblong pixels": replace(camera(), fx=70.0, fy=150.0),
    "among the splats": camera(0.3),
    "turned upside down": replace(camera(), camera_from_world=np.diag([-1.0, -1, 1, 1]) @ camera().camera_from_world),
}


def test_pictures_are_those_of_our_rasterizer(browser: Chromium, tmp_path: Path):
    splats = cloud()
    page = page_of(splats, sky())
    opened(browser, tmp_path, page)
    for case, at in CASES.items():
        picture = shown(browser, at)
        assert psnr(picture, drawn(decode_page(page, "page")[0], at, sky_seen(at))) > 45, case
        assert psnr(picture, drawn(splats, at, sky_seen(at))) > 38, case
    assert browser.complaints() == []


def test_a_scene_of_another_program_looks_as_our_rasterizer_draws_it(
    browser: Chromium, tmp_path: Path, shared_data: Path
):
    splats = ply.decode((shared_data / "trained_models" / "inria_sh3_small.ply").read_bytes(), "small.ply")
    middle = np.median(splats.positions, axis=0)
    size = float(np.percentile(np.abs(splats.positions - middle), 90))
    at = replace(camera(), camera_from_world=look_at(middle - 2 * size * np.array([0.0, 0.3, 0.95]), middle, UP))
    page = page_of(splats, cameras=[at], near=0.01 * size)
    frame = Frame(tuple(middle), size, (1.0, 1.0, 1.0))
    picture = shown(opened(browser, tmp_path, page), at)
    assert psnr(picture, drawn(decode_page(page, "page")[0], at, frame=frame)) > 50
    assert psnr(picture, drawn(splats, at, frame=frame)) > 38


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_lower_degrees_and_compensated_opacities_look_right(browser: Chromium, tmp_path: Path, degree: int):
    page = page_of(replace(cloud(400, degree), antialiased=degree != 1))
    opened(browser, tmp_path, page)
    assert psnr(shown(browser, camera(6.0)), drawn(decode_page(page, "page")[0], camera(6.0))) > 50


def test_where_targets_of_floats_are_missing_eight_bits_serve(browser: Chromium, tmp_path: Path):
    script = "WebGL2RenderingContext.prototype.getExtension = () => null"
    with before_every_page(browser, script):
        page = page_of(cloud())
        opened(browser, tmp_path, page)
        assert psnr(shown(browser, camera()), drawn(decode_page(page, "page")[0], camera())) > 35


def test_a_page_without_splats_shows_its_background(browser: Chromium, tmp_path: Path):
    opened(browser, tmp_path, page_of(cloud(0), sky()))
    assert psnr(shown(browser, camera()), 255 * sky_seen(camera())) > 40


def test_the_address_can_name_the_camera(browser: Chromium, tmp_path: Path):
    page = page_of(cloud())
    opened(browser, tmp_path, page, "#camera=" + json_of(camera(1.0)))
    ends = time.monotonic() + 10
    while not browser.evaluate("Boolean(hyrfpack.pixels())") and time.monotonic() < ends:
        time.sleep(0.05)
    assert psnr(pixels(browser, camera(1.0)), drawn(decode_page(page, "page")[0], camera(1.0))) > 50


def eye(browser: Chromium) -> Camera:
    return Camera(**{
        name: np.array(value) if name == "camera_from_world" else value
        for name, value in browser.evaluate("hyrfpack.camera()").items()
    })  # fmt: skip


def test_the_window_starts_at_the_first_camera_and_draws_only_when_something_changes(browser: Chromium, tmp_path: Path):
    settled(opened(browser, tmp_path, page_of(cloud())))
    np.testing.assert_allclose(eye(browser).camera_from_world, camera().camera_from_world, atol=1e-9)
    frames = browser.evaluate("hyrfpack.frames()")
    time.sleep(0.3)
    assert browser.evaluate("hyrfpack.frames()") == frames


def test_mouse_and_keys_move_the_eye(browser: Chromium, tmp_path: Path):
    opened(browser, tmp_path, page_of(cloud()))
    home = eye(browser)

    browser.drag((120, 90), (170, 90))
    orbited = eye(browser)
    assert np.linalg.norm(orbited.position - CENTER) == pytest.approx(np.linalg.norm(home.position - CENTER))
    assert (orbited.position - home.position) @ home.rotation[0] < -0.3  # the scene follows the pointer
    assert orbited.position @ UP == pytest.approx(home.position @ UP, abs=1e-6)

    browser.drag((120, 90), (120, 900))  # far beyond the pole
    assert 0.99 < -eye(browser).forward @ UP < 1.0

    browser.press("r")
    np.testing.assert_allclose(eye(browser).camera_from_world, home.camera_from_world, atol=1e-9)
    browser.drag((120, 90), (140, 90), button="right")
    panned = eye(browser).position - home.position
    assert panned @ home.rotation[0] < -0.1 and abs(panned @ home.forward) < 1e-9

    browser.press("r")
    browser.mouse("mouseWheel", 120, 90, deltaX=0, deltaY=-300)
    assert np.linalg.norm(eye(browser).position - CENTER) < 2.0
    browser.press("w", seconds=0.3)
    settled(browser)
    assert np.linalg.norm(eye(browser).position - CENTER) < 1.6

    browser.press("n")
    np.testing.assert_allclose(eye(browser).camera_from_world, camera(1.5).camera_from_world, atol=1e-9)
    browser.press("p")
    browser.press("p")
    np.testing.assert_allclose(eye(browser).camera_from_world, camera(4.0).camera_from_world, atol=1e-9)
    assert browser.evaluate("document.getElementById('cameras').selectedIndex") == 2
    hidden = "document.getElementById('panel').hidden"
    assert browser.evaluate(hidden)  # in a window so small
    browser.press("h")
    assert not browser.evaluate(hidden)
    assert browser.complaints() == []


def test_the_scene_follows_the_pointer_where_the_camera_stands_on_its_head(browser: Chromium, tmp_path: Path):
    opened(browser, tmp_path, page_of(cloud(), cameras=[CASES["turned upside down"]]))
    home = eye(browser)
    browser.drag((120, 90), (170, 90))
    assert (eye(browser).position - home.position) @ home.rotation[0] < -0.3


def test_a_camera_in_the_middle_of_the_scene_flies_as_fast_as_befits_its_size(browser: Chromium, tmp_path: Path):
    opened(browser, tmp_path, page_of(cloud(), cameras=[camera(0.01), camera(2.5), camera(4.0)]))
    home = eye(browser)
    browser.drag((120, 90), (140, 90), button="right")
    assert np.linalg.norm(eye(browser).position - home.position) > 0.05


def test_the_wheel_zooms_towards_the_pointer(browser: Chromium, tmp_path: Path):
    opened(browser, tmp_path, page_of(cloud()))
    home = eye(browser)
    ray = np.array([(60 - home.cx) / home.fx, (150 - home.cy) / home.fy, 1.0])
    point = home.position + 2.5 * ray @ home.rotation
    browser.mouse("mouseWheel", 60, 150, deltaX=0, deltaY=-200)
    near = eye(browser)
    x, y, z = near.rotation @ point + near.camera_from_world[:3, 3]
    assert z < 2.2
    assert (near.fx * x / z + near.cx, near.fy * y / z + near.cy) == pytest.approx((60, 150), abs=1e-6)


def test_two_fingers_pan_and_pinch(browser: Chromium, tmp_path: Path):
    opened(browser, tmp_path, page_of(cloud()))
    browser.resize(240, 180, phone=True)
    try:
        home = eye(browser)
        browser.touch("touchStart", (100, 90), (140, 90))
        browser.touch("touchMove", (80, 90), (160, 90))
        browser.touch("touchEnd")
        assert np.linalg.norm(eye(browser).position - CENTER) == pytest.approx(1.25, abs=0.05)
        near = eye(browser)
        browser.touch("touchStart", (100, 90))
        browser.touch("touchMove", (140, 90))
        browser.touch("touchEnd")
        assert (eye(browser).position - near.position) @ home.rotation[0] < -0.1
    finally:
        browser.resize(240, 180)


def test_a_double_click_sets_what_is_orbited(browser: Chromium, tmp_path: Path):
    one = cloud(1, 0)
    place = CENTER + 0.4 * camera().rotation[0] - 0.5 * camera().forward
    one = replace(one, positions=place[None], scales=np.full((1, 3), 0.05, np.float32), opacities=np.ones(1))
    settled(opened(browser, tmp_path, page_of(one)))
    at = eye(browser)
    x, y, z = at.rotation @ place + at.camera_from_world[:3, 3]
    spot = at.fx * x / z + at.cx, at.fy * y / z + at.cy
    for count in (1, 2):
        for kind in ("mousePressed", "mouseReleased"):
            browser.mouse(kind, *spot, button="left", clickCount=count)
    browser.drag((120, 90), (160, 100))
    after = eye(browser)
    assert np.linalg.norm(after.position - at.position) > 0.3
    assert np.linalg.norm(after.position - place) == pytest.approx(np.linalg.norm(at.position - place), rel=0.01)


class before_every_page:
    """Inside, a script runs before those of the pages that are opened."""

    def __init__(self, browser: Chromium, script: str) -> None:
        self._browser, self._script = browser, script

    def __enter__(self) -> None:
        added = self._browser.call("Page.addScriptToEvaluateOnNewDocument", source=self._script)
        self._identifier = added["identifier"]

    def __exit__(self, *exception: object) -> None:
        self._browser.call("Page.removeScriptToEvaluateOnNewDocument", identifier=self._identifier)


def message(browser: Chromium) -> str:
    """The sentence that the page shows, once it does."""
    ends = time.monotonic() + 10
    while time.monotonic() < ends:
        if browser.evaluate("!document.getElementById('message').hidden"):
            break
        time.sleep(0.05)
    return browser.evaluate("document.getElementById('message').textContent")


def test_what_a_browser_cannot_do_is_said_in_a_sentence(browser: Chromium, tmp_path: Path):
    file = tmp_path / "page.html"
    page = page_of(cloud(50))
    file.write_bytes(page)
    with before_every_page(browser, "HTMLCanvasElement.prototype.getContext = () => null"):
        browser.open(file.as_uri())
        assert "no WebGL 2" in message(browser)
    opened(browser, tmp_path, page)
    lose = "document.getElementById('view').getContext('webgl2').getExtension('WEBGL_lose_context').loseContext()"
    browser.evaluate(lose)
    assert "reload" in message(browser)
    file.write_bytes(re.sub(rb'(class="splats">.{400}).{40}', rb"\1", page))
    browser.open(file.as_uri())
    assert "cannot be unpacked" in message(browser)
    file.write_bytes(page)
    browser.open(file.as_uri() + "#camera={}")
    assert "needs width" in message(browser)


def test_the_page_may_not_use_the_network(browser: Chromium, tmp_path: Path):
    opened(browser, tmp_path, page_of(cloud(3)))
    refused = "fetch('data:,x').then(() => 'fetched', () => 'refused')"
    assert browser.evaluate(refused) == "refused"

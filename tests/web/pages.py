"""Make pages of test scenes, open them in a browser and read what it shows."""

from __future__ import annotations

import base64
import contextlib
import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from hyrfpack.cameras.paths import look_at
from hyrfpack.model import Frame
from hyrfpack.scene import Camera
from hyrfpack.splats.draw import Drawable, draw
from hyrfpack.splats.splats import Splats, normalize_quats
from hyrfpack.web.html import encode_splats_page
from tools.browser.browser import Browser

UP_DIRECTION, SCENE_CENTER = np.array([0.0, -1.0, 0.0]), np.array([1000.0, -50.0, 20.0])
SCENE_FRAME = Frame(tuple(SCENE_CENTER), 1.0, (1.0, 1.0, 1.0))
NEAR_PLANE = 0.01
BACKGROUND_COLOR = (0.2, 0.3, 0.1)


def random_splats(count: int = 1500, degree: int = 3, seed: int = 1) -> Splats:
    """Return splats of all shapes around SCENE_CENTER, far from the origin."""
    rng = np.random.default_rng(seed)
    harmonics = rng.normal(size=(count, 16, 3)) * np.array([0.8] + [0.12] * 15)[:, None]
    return Splats(
        SCENE_CENTER + rng.normal(size=(count, 3)) * 0.5,
        np.exp(rng.normal(-3.3, 0.8, (count, 3))),
        normalize_quats(rng.normal(size=(count, 4))),
        rng.uniform(size=count),
        harmonics,
    ).with_degree(degree)


def make_camera(distance: float = 2.5, width: int = 120, height: int = 90) -> Camera:
    pose = look_at(SCENE_CENTER + distance * np.array([0.6, -0.3, -0.74]), SCENE_CENTER, UP_DIRECTION)
    return Camera(width, height, 110.0, 110.0, width / 2, height / 2, pose)


def sky_panorama() -> np.ndarray:
    """Return a panorama (64, 128, 3) that is smooth over the sphere and different in every direction."""
    latitude, longitude = np.meshgrid(
        np.pi / 2 - np.pi * (np.arange(64) + 0.5) / 64, 2 * np.pi * (np.arange(128) + 0.5) / 128 - np.pi, indexing="ij"
    )
    x, y, z = np.cos(latitude) * np.sin(longitude), -np.sin(latitude), np.cos(latitude) * np.cos(longitude)
    return 0.5 + 0.4 * np.stack((x, y, z), axis=-1)


def make_splats_page(
    splats: Splats, background: np.ndarray | None = None, title: str = "a scene", **more: object
) -> bytes:
    cameras = [make_camera(), make_camera(1.5), make_camera(4.0)]
    settings = {
        "title": title,
        "cameras": cameras,
        "up": UP_DIRECTION,
        "center": SCENE_CENTER,
        "solid": BACKGROUND_COLOR,
        "near": NEAR_PLANE,
    }
    return encode_splats_page(splats, background=background, **{**settings, **more})


def open_page(browser: Browser, tmp_path: Path, page: bytes, hash: str = "") -> Browser:
    """Open a page in the browser and wait until its scene is visible."""
    file = tmp_path / "page.html"
    file.write_bytes(page)
    browser.open(file.as_uri() + hash)
    browser.evaluate("hyrfpack.ready")
    wait_until(browser, "document.body.classList.contains('there')")
    return browser


def wait_until_still(browser: Browser) -> Browser:
    """Wait, at most 15 seconds, until the window's picture has not changed for half a second."""
    frames, since, ends = browser.evaluate("hyrfpack.frames()"), time.monotonic(), time.monotonic() + 15
    while time.monotonic() < min(since + 0.5, ends):
        time.sleep(0.05)
        if (now := browser.evaluate("hyrfpack.frames()")) != frames:
            frames, since = now, time.monotonic()
    return browser


def camera_json(camera: Camera) -> str:
    fx, fy, cx, cy = camera.intrinsics
    size = {"width": camera.width, "height": camera.height, "fx": fx, "fy": fy, "cx": cx, "cy": cy}
    return json.dumps({**size, "camera_from_world": camera.camera_from_world.tolist()})


def read_pixels(browser: Browser, camera: Camera) -> np.ndarray:
    data = browser.evaluate("btoa(Array.from(hyrfpack.pixels(), (byte) => String.fromCharCode(byte)).join(''))")
    return np.frombuffer(base64.b64decode(data), np.uint8).reshape(camera.height, camera.width, 3)


def render_in_page(browser: Browser, camera: Camera) -> np.ndarray:
    """Return the picture that the page draws for a camera, (H, W, 3) uint8."""
    browser.evaluate(f"hyrfpack.show({camera_json(camera)})")
    return read_pixels(browser, camera)


def rasterize_reference(
    splats: Splats, camera: Camera, background: np.ndarray | None = None, frame: Frame = SCENE_FRAME
) -> np.ndarray:
    """Return the picture of our rasteriser, (H, W, 3) in 0 to 255."""
    raster = draw(Drawable.from_splats(splats, frame), camera)
    background_color = np.array(BACKGROUND_COLOR) if background is None else background
    return np.clip(raster.rgb.numpy() + raster.transmittance.numpy()[..., None] * background_color, 0, 1) * 255


def sky_picture(camera: Camera) -> np.ndarray:
    """Return the colour of the sky behind each pixel, (H, W, 3) in [0.1, 0.9], from its formula."""
    v, u = np.meshgrid(np.arange(camera.height) + 0.5, np.arange(camera.width) + 0.5, indexing="ij")
    rays = np.stack(((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)), axis=-1)
    directions = rays @ camera.rotation
    return 0.5 + 0.4 * directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def psnr(first: np.ndarray, second: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / max(((first - second) ** 2).mean(), 1e-9)))


CAMERA_CASES = {
    "as photographed": make_camera(),
    "off-centre": replace(make_camera(), cx=100.0, cy=10.0),
    "oblong pixels": replace(make_camera(), fx=70.0, fy=150.0),
    "among the splats": make_camera(0.3),
    "turned upside down": replace(
        make_camera(), camera_from_world=np.diag([-1.0, -1, 1, 1]) @ make_camera().camera_from_world
    ),
}


def wait_until_at_rest(browser: Browser) -> Browser:
    """Wait until nothing moves the window's camera."""
    check = "const check = () => (hyrfpack.player.driven ? requestAnimationFrame(check) : resolve())"
    browser.evaluate(f"new Promise((resolve) => {{ {check}; check(); }})")
    return browser


def window_camera(browser: Browser) -> Camera:
    """Return the window's camera after it has come to rest."""
    return Camera(**{
        name: np.array(value) if name == "camera_from_world" else value
        for name, value in wait_until_at_rest(browser).evaluate("hyrfpack.camera()").items()
    })  # fmt: skip


def wait_for_message(browser: Browser) -> str:
    """Wait until the page shows a message; return its sentence."""
    ends = time.monotonic() + 10
    while time.monotonic() < ends:
        if browser.evaluate("!document.getElementById('message').hidden"):
            break
        time.sleep(0.05)
    return browser.evaluate("document.getElementById('sentence').textContent")


def wait_until(browser: Browser, expression: str, seconds: float = 10.0) -> None:
    """Wait until an expression is true in the page; fail after `seconds`."""
    ends = time.monotonic() + seconds
    while not browser.evaluate(expression):
        assert time.monotonic() < ends, f"never: {expression}"
        time.sleep(0.02)


def wait_for_path(browser: Browser, path: str, seconds: float = 10.0) -> None:
    """Wait until the browser has gone to the page at a path of its server; fail after `seconds`."""
    ends, now = time.monotonic() + seconds, None
    while now != path:
        assert time.monotonic() < ends, f"never at {path}, but at {now}"
        time.sleep(0.02)
        with contextlib.suppress(RuntimeError):  # a script cannot run while one page replaces the other
            now = browser.evaluate("location.pathname")

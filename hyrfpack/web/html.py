"""The web page: one file that shows a scene in any browser, by itself. A model is inside, or splats."""

from __future__ import annotations

import base64
import io
import json
import math
import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from PIL import Image

from hyrfpack.cameras.files import camera_to_json
from hyrfpack.errors import HyrfDataError
from hyrfpack.model import Frame
from hyrfpack.render import RenderSettings
from hyrfpack.scene import Camera
from hyrfpack.splats.formats import spz
from hyrfpack.splats.formats.hints import Hints
from hyrfpack.splats.splats import Splats
from hyrfpack.web.player import json_text, player_page

SPZ_VERSION = 3  # gzip, which every browser unpacks
QUALITY = 80  # of the background's WebP, of 100; 95 takes three times the bytes for 0.01 dB in pictures of real scenes

# What SPZ can hold: coordinates of 24 bits with 12 behind the point, scales of e^-10 to e^5.9.
FARTHEST, LARGEST = 2000.0, 370.0


def encode_native(
    data: bytes,
    *,
    title: str,
    count: int,
    frame: Frame,
    cameras: Sequence[Camera],
    up: np.ndarray,
    center: np.ndarray,
    solid: tuple[float, float, float],
    poster: bytes | None = None,
) -> bytes:
    """One HTML file with a `.hyrf` file inside, which it decodes and draws itself, in a browser with WebGL 2.

    It needs no network, nor any other file. Scripts and the address reach it as `encode_page` says.

    Args:
        data: the `.hyrf` file.
        title: of the page.
        count: Gaussians in the file.
        frame: of the model; its centre and its longest half-axis are the page's origin and unit.
        cameras: to start from, the first one first; at least one. Others are stepped through.
        up: (3,) which way is up in the world, unit length.
        center: (3,) what orbits go about, world units.
        solid: RGB in [0, 1], what lies behind where the model has no background sphere.
        poster: WebP, what is shown while the scene is unpacked.

    Returns:
        The file, UTF-8. The same arguments give the same bytes.

    Raises:
        ValueError: there is no camera.
    """
    facts = {"count": count, "center": list(frame.center), "unit": frame.scale, "near": RenderSettings().near}
    scene = _scene("hyrf", title, facts, cameras, up, center, solid)
    return player_page(title, [scene, *_poster(poster)], _summary(count, len(data)), payload=data, readers=False)


def encode_page(
    splats: Splats,
    *,
    title: str,
    cameras: Sequence[Camera],
    up: np.ndarray,
    center: np.ndarray,
    background: np.ndarray | None,
    solid: tuple[float, float, float],
    near: float,
    sphere: tuple[Sequence[float], float] | None = None,
    poster: bytes | None = None,
) -> bytes:
    """One HTML file that shows splats in a browser with WebGL 2; it needs no network, nor any other file.

    The splats are inside as SPZ, in units of the page's own, so that any scene fits its fixed-point numbers.
    `hyrfpack.show(camera)` and `hyrfpack.pixels()` draw for scripts what `hyrfpack.splats.draw` draws, and
    `#camera={"width", "height", "fx", "fy", "cx", "cy", "camera_from_world"}` in the address starts there.

    Args:
        splats: what to show, world units.
        background: (H, W, 3) RGB in [0, 1], what lies behind in all directions: pixel (row v, column u) is at longitude
            phi = 2 pi (u + 0.5) / W - pi and latitude lam = pi / 2 - pi (v + 0.5) / H, in the world's direction
            (cos lam sin phi, -sin lam, cos lam cos phi). None for the colour `solid`.
        near: splats nearer than this are not drawn, world units.
        sphere: where the background lies: the centre (3,) from which its directions count, and its radius, world
            units; None for infinitely far away.
        title, cameras, up, center, solid, poster: as of `encode_native`.

    Returns:
        The file, UTF-8. The same arguments give the same bytes.

    Raises:
        ValueError: there is no camera.
    """
    middle, unit = _frame(splats)
    local = replace(splats, positions=(splats.positions - middle) / unit, scales=splats.scales / np.float32(unit))
    facts = {"count": len(splats), "degree": splats.degree, "center": middle.tolist(), "unit": unit}
    if sphere is not None:
        facts["sphere"] = {"center": list(sphere[0]), "radius": sphere[1]}
    scene = _scene("splats", title, {**facts, "near": near / unit}, cameras, up, center, solid)
    texts = [scene, *_poster(poster)]
    if background is not None:
        texts.append(f'<img id="background" alt="" hidden src="{_data_url(_webp(background), "image/webp")}">')
    packed = spz.encode(local, Hints(spz_version=SPZ_VERSION))
    return player_page(title, texts, _summary(len(splats), len(packed)), payload=packed)


def payload_of(page: bytes, name: str) -> tuple[dict, bytes]:
    """What a page from `encode_native` or `encode_page` says of its scene, and the file inside it.

    Args:
        page: the HTML.
        name: what error messages call it.

    Raises:
        HyrfDataError: it is no page of this version of hyrfpack with a scene inside, or is damaged.
    """
    try:
        (facts,) = re.findall(rb'<script type="text/plain" id="scene">([^<]*)</script>', page)
        scene = json.loads(facts)
        if not isinstance(scene, dict):
            raise TypeError("no scene")
        blocks = re.findall(rb'<script type="text/plain" class="payload">([^<]*)</script>', page)
        return scene, b"".join(base64.b64decode(block, validate=True) for block in blocks)
    except (TypeError, ValueError, RecursionError) as error:
        raise _no_page(name) from error


def decode_page(page: bytes, name: str) -> tuple[Splats, np.ndarray | None]:
    """The splats in a page, world units, and its background (H, W, 3) float32 in [0, 1] or None, as it draws them.

    Args:
        page: from `encode_page`.
        name: what error messages call the page.

    Raises:
        HyrfDataError: it is no page of splats of this version of hyrfpack, or is damaged.
    """
    scene, packed = payload_of(page, name)
    try:
        middle, unit = np.array(scene["center"], np.float64), np.float64(scene["unit"])
        if scene["kind"] != "splats" or middle.shape != (3,) or unit.shape or not unit > 0:
            raise ValueError("no splats, or no frame")
        local = spz.decode(packed, name)
        with np.errstate(over="ignore"):  # Splats refuses what is not finite
            splats = replace(local, positions=local.positions * unit + middle, scales=local.scales * np.float32(unit))
        picture = re.search(rb'<img id="background"[^>]*base64,([^"]*)"', page)
        return splats, None if picture is None else _read_webp(base64.b64decode(picture[1], validate=True))
    except (LookupError, TypeError, ValueError, ArithmeticError, RecursionError, OSError) as error:
        raise _no_page(name) from error


def _scene(
    kind: str,
    title: str,
    facts: dict,
    cameras: Sequence[Camera],
    up: np.ndarray,
    center: np.ndarray,
    solid: tuple[float, float, float],
) -> str:
    """What the player is told of the scene."""
    if not cameras:
        raise ValueError("a page needs a camera to start from")
    scene = {
        "kind": kind,
        "title": title,
        **facts,
        "tolerance": RenderSettings().cull_tolerance,
        "solid": list(solid),
        **stage(cameras, up, center),
    }
    return json_text("scene", scene)


def stage(cameras: Sequence[Camera], up: np.ndarray, center: np.ndarray) -> dict:
    """From where the player looks at a scene, in JSON: arguments as of `encode_native`."""
    return {
        "cameras": [camera_to_json(camera) for camera in cameras],
        "up": np.asarray(up, np.float64).tolist(),
        "target": np.asarray(center, np.float64).tolist(),
    }


def _summary(count: int, length: int) -> str:
    return f"{count:,} Gaussians, {length:,} bytes"


def _frame(splats: Splats) -> tuple[np.ndarray, float]:
    """The page's origin in the world and its unit, a power of two, so that all splats fit into SPZ, finely."""
    if not len(splats):
        return np.zeros(3), 1.0
    low, high = splats.positions.min(0), splats.positions.max(0)
    least = max(float((high - low).max()) / 2 / FARTHEST, float(splats.scales.max()) / LARGEST)
    return (low + high) / 2, 2.0 ** math.ceil(math.log2(least)) if least > 0 else 1.0


def _poster(poster: bytes | None) -> list[str]:
    return [] if poster is None else [f'<img id="poster" alt="" src="{_data_url(poster, "image/webp")}">']


def _webp(picture: np.ndarray) -> bytes:
    """A picture (H, W, 3) in [0, 1] as WebP."""
    file = io.BytesIO()
    Image.fromarray((np.clip(picture, 0, 1) * 255 + 0.5).astype(np.uint8)).save(file, "WEBP", quality=QUALITY, method=6)
    return file.getvalue()


def _read_webp(data: bytes) -> np.ndarray:
    """The inverse of `_webp`, but for what WebP loses: (H, W, 3) float32 in [0, 1]."""
    try:
        with Image.open(io.BytesIO(data), formats=("WEBP",)) as picture:
            return np.asarray(picture.convert("RGB"), np.float32) / 255
    except Image.DecompressionBombError as error:
        raise ValueError(error) from error


def _data_url(data: bytes, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def _no_page(name: str) -> HyrfDataError:
    return HyrfDataError(f"{name}: this is not a page of hyrfpack's, or it is damaged; export it again")

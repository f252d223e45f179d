"""The web page: one file that shows splats in any browser, by itself. Its parts lie in `viewer/`."""

from __future__ import annotations

import base64
import hashlib
import html
import io
import json
import math
import re
from collections.abc import Sequence
from dataclasses import replace
from importlib.resources import files

import numpy as np
from PIL import Image

import hyrfpack
from hyrfpack.cameras.files import camera_to_json
from hyrfpack.errors import HyrfDataError
from hyrfpack.render import RenderSettings
from hyrfpack.scene import Camera
from hyrfpack.splats.formats import spz
from hyrfpack.splats.formats.hints import Hints
from hyrfpack.splats.splats import Splats

SPZ_VERSION = 3  # gzip, which every browser unpacks
SCRIPTS = ("camera.js", "renderer.js", "splats.js", "controls.js", "main.js")  # in the order they need one another
TEXTS = ("worker.js", "whole.vert", "project.frag", "blend.vert", "blend.frag", "resolve.frag")
BLOCK = 3 << 20  # bytes of a block of base64, which is unpacked while the next one comes in
QUALITY = 80  # of the background's WebP, of 100; 95 takes three times the bytes for 0.01 dB in pictures of real scenes

# What SPZ can hold: coordinates of 24 bits with 12 behind the point, scales of e^-10 to e^5.9.
FARTHEST, LARGEST = 2000.0, 370.0


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
) -> bytes:
    """One HTML file that shows splats in a browser with WebGL 2; it needs no network, nor any other file.

    The splats are inside as SPZ, in units of the page's own, so that any scene fits its fixed-point numbers.
    `hyrfpack.show(camera)` and `hyrfpack.pixels()` draw for scripts what `hyrfpack.splats.draw` draws, and
    `#camera={"width", "height", "fx", "fy", "cx", "cy", "camera_from_world"}` in the address starts there.

    Args:
        splats: what to show, world units.
        title: of the page.
        cameras: to start from, the first one first; at least one. Others are stepped through.
        up: (3,) which way is up in the world, unit length.
        center: (3,) what orbits go about, world units.
        background: (H, W, 3) RGB in [0, 1], what lies behind in all directions: pixel (row v, column u) is at longitude
            phi = 2 pi (u + 0.5) / W - pi and latitude lam = pi / 2 - pi (v + 0.5) / H, in the world's direction
            (cos lam sin phi, -sin lam, cos lam cos phi). None for the colour `solid`.
        solid: RGB in [0, 1].
        near: splats nearer than this are not drawn, world units.

    Returns:
        The file, UTF-8. The same arguments give the same bytes.

    Raises:
        ValueError: there is no camera.
    """
    if not cameras:
        raise ValueError("a page needs a camera to start from")
    middle, unit = _frame(splats)
    local = replace(splats, positions=(splats.positions - middle) / unit, scales=splats.scales / np.float32(unit))
    scene = {
        "count": len(splats),
        "degree": splats.degree,
        "center": middle.tolist(),
        "unit": unit,
        "near": near / unit,
        "tolerance": RenderSettings().cull_tolerance,
        "up": np.asarray(up, np.float64).tolist(),
        "target": np.asarray(center, np.float64).tolist(),
        "solid": list(solid),
        "cameras": [camera_to_json(camera) for camera in cameras],
    }
    texts = [_text("scene", json.dumps(scene).replace("<", "\\u003c"))]
    texts += [_text(name, _part(name)) for name in TEXTS]
    if background is not None:
        texts.append(f'<img id="background" alt="" hidden src="data:image/webp;base64,{_webp(background)}">')
    style, script = _part("style.css"), '"use strict";\n' + "\n".join(_part(name) for name in SCRIPTS)
    packed = memoryview(spz.encode(local, Hints(spz_version=SPZ_VERSION)))
    blocks = (base64.b64encode(packed[at : at + BLOCK]).decode() for at in range(0, len(packed), BLOCK))
    values = {
        "policy": _policy(style, script),
        "version": hyrfpack.__version__,
        "title": html.escape(title),
        "style": style,
        "texts": "\n".join(texts),
        "script": script,
        "splats": "\n".join(f'<script type="text/plain" class="splats">{block}</script>' for block in blocks),
    }
    return re.sub(r"\{\{(\w+)\}\}", lambda match: values[match[1]], _part("page.html")).encode()


def decode_page(data: bytes, name: str) -> tuple[Splats, np.ndarray | None]:
    """The splats in a page, world units, and its background (H, W, 3) float32 in [0, 1] or None, as it draws them.

    Args:
        data: from `encode_page`.
        name: what error messages call the page.

    Raises:
        HyrfDataError: it is no page of this version of hyrfpack, or is damaged.
    """
    try:
        (facts,) = re.findall(rb'<script type="text/plain" id="scene">([^<]*)</script>', data)
        scene = json.loads(facts)
        blocks = re.findall(rb'<script type="text/plain" class="splats">([^<]*)</script>', data)
        packed = b"".join(base64.b64decode(block, validate=True) for block in blocks)
        middle, unit = np.array(scene["center"], np.float64), np.float64(scene["unit"])
        if middle.shape != (3,) or unit.shape or not unit > 0:
            raise ValueError("no frame")
        local = spz.decode(packed, name)
        with np.errstate(over="ignore"):  # Splats refuses what is not finite
            splats = replace(local, positions=local.positions * unit + middle, scales=local.scales * np.float32(unit))
        picture = re.search(rb'<img id="background"[^>]*base64,([^"]*)"', data)
        return splats, None if picture is None else _read_webp(base64.b64decode(picture[1], validate=True))
    except (LookupError, TypeError, ValueError, ArithmeticError, RecursionError, OSError) as error:
        raise HyrfDataError(f"{name}: this is not a page of hyrfpack's, or it is damaged; export it again") from error


def _frame(splats: Splats) -> tuple[np.ndarray, float]:
    """The page's origin in the world and its unit, a power of two, so that all splats fit into SPZ, finely."""
    if not len(splats):
        return np.zeros(3), 1.0
    low, high = splats.positions.min(0), splats.positions.max(0)
    least = max(float((high - low).max()) / 2 / FARTHEST, float(splats.scales.max()) / LARGEST)
    return (low + high) / 2, 2.0 ** math.ceil(math.log2(least)) if least > 0 else 1.0


def _webp(picture: np.ndarray) -> str:
    """A picture (H, W, 3) in [0, 1] as WebP in base64."""
    file = io.BytesIO()
    Image.fromarray((np.clip(picture, 0, 1) * 255 + 0.5).astype(np.uint8)).save(file, "WEBP", quality=QUALITY, method=6)
    return base64.b64encode(file.getvalue()).decode()


def _read_webp(data: bytes) -> np.ndarray:
    """The inverse of `_webp`, but for what WebP loses: (H, W, 3) float32 in [0, 1]."""
    try:
        with Image.open(io.BytesIO(data), formats=("WEBP",)) as picture:
            return np.asarray(picture.convert("RGB"), np.float32) / 255
    except Image.DecompressionBombError as error:
        raise ValueError(error) from error


def _policy(style: str, script: str) -> str:
    """A content security policy: what is in the page runs, nothing is fetched and nothing sent."""
    style_hash, script_hash = (
        f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'" for text in (style, script)
    )
    allowed = {"script-src": script_hash, "style-src": style_hash, "worker-src": "blob:", "img-src": "data:"}
    allowed = {"default-src": "'none'", **allowed, "base-uri": "'none'", "form-action": "'none'"}
    return "; ".join(f"{what} {where}" for what, where in allowed.items())


def _text(name: str, text: str) -> str:
    """A text that scripts find by its name."""
    return f'<script type="text/plain" id="{name}">{text}</script>'


def _part(name: str) -> str:
    """A file of `viewer/`."""
    return files("hyrfpack.web").joinpath("viewer").joinpath(name).read_text("utf-8")

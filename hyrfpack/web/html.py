"""The self-contained web page: one HTML file that holds a model or splats and shows them in any browser."""

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
from hyrfpack.counts import format_count
from hyrfpack.errors import HyrfDataError
from hyrfpack.model import Frame
from hyrfpack.render import RenderSettings
from hyrfpack.scene import Camera
from hyrfpack.splats.formats import spz
from hyrfpack.splats.formats.hints import Hints
from hyrfpack.splats.splats import Splats
from hyrfpack.web.player import assemble_player_page, escape_surrogates, json_element

SPZ_VERSION = 3  # this version is compressed by gzip, which every browser unpacks
# Quality of the background's WebP, 0 to 100. 95 takes three times the bytes for 0.01 dB in pictures of real scenes.
BACKGROUND_WEBP_QUALITY = 80
MAX_BACKGROUND_PIXELS = 1 << 26

# Limits of SPZ, with some room: coordinates have 24 bits, 12 of them fractional, and scales are e^-10 to e^5.9.
MAX_SPZ_COORDINATE = 2000.0
MAX_SPZ_SCALE = 370.0


def encode_model_page(
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
    credit: str = "",
    editable_file: str | None = None,
) -> bytes:
    """Return an HTML file that holds a `.hyrf` file and decodes and draws it in a browser with WebGL 2.

    The page needs no network and no other file. Its interface for scripts and its address are those of
    `encode_splats_page`.

    Args:
        data: the `.hyrf` file.
        title: title of the page.
        count: number of Gaussians in the file.
        frame: frame of the model; the page has its origin, its axes, and its longest half-axis as the unit.
        cameras: at least one camera. The page starts at the first one and steps through the others.
        up: (3,) upward direction in the world, unit length.
        center: (3,) centre of orbits, world units.
        solid: RGB in [0, 1] of the background where the model has no background sphere.
        poster: a WebP picture that is shown while the scene is unpacked; None for none.
        credit: text below the title, such as the author and the licence.
        editable_file: name of the file in the commands of the panel that edits it; None for a page without this panel.

    Returns:
        The file, UTF-8. The same arguments give the same bytes.

    Raises:
        ValueError: there is no camera.
    """
    facts: dict = {"count": count, "center": list(frame.center), "unit": frame.scale, "near": RenderSettings().near}
    if frame.is_rotated:
        facts["rotation"] = list(frame.rotation)
    editable = editable_file is not None
    if editable:
        facts["file"] = editable_file
    scene = _scene_element("hyrf", title, facts, cameras, up, center, solid)
    texts, description = [scene, *_poster_elements(poster)], _page_description(count, len(data))
    return assemble_player_page(
        title, texts, description, payload=data, readers=False, credit=credit, editable=editable
    )


def encode_splats_page(
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
    credit: str = "",
) -> bytes:
    """Return an HTML file that shows splats in a browser with WebGL 2; it needs no network and no other file.

    The page holds the splats as SPZ, in its own units, so that any scene fits SPZ's fixed-point numbers. For scripts,
    `hyrfpack.show(camera)` and `hyrfpack.pixels()` draw what `hyrfpack.splats.draw` draws. An address with
    `#camera={"width", "height", "fx", "fy", "cx", "cy", "camera_from_world"}` starts at that camera.

    Args:
        splats: the splats to show, world units.
        background: (H, W, 3) RGB in [0, 1] of the background, or None for the colour `solid`. The pixel in row v and
            column u shows the world's direction (cos lam sin phi, -sin lam, cos lam cos phi), with longitude
            phi = 2 pi (u + 0.5) / W - pi and latitude lam = pi / 2 - pi (v + 0.5) / H.
        near: near plane in world units; splats in front of it are not drawn.
        sphere: centre (3,) and radius of the sphere that the background lies on, world units. Directions are relative
            to the centre. None for a background that is infinitely far away.
        title, cameras, up, center, solid, poster, credit: as for `encode_model_page`.

    Returns:
        The file, UTF-8. The same arguments give the same bytes.

    Raises:
        ValueError: there is no camera.
    """
    middle, unit = _page_origin_and_unit(splats)
    local = replace(splats, positions=(splats.positions - middle) / unit, scales=splats.scales / np.float32(unit))
    facts = {"count": len(splats), "degree": splats.degree, "center": middle.tolist(), "unit": unit}
    if sphere is not None:
        facts["sphere"] = {"center": list(sphere[0]), "radius": sphere[1]}
    scene = _scene_element("splats", title, {**facts, "near": near / unit}, cameras, up, center, solid)
    texts = [scene, *_poster_elements(poster)]
    if background is not None:
        texts.append(f'<img id="background" alt="" hidden src="{_data_url(_encode_webp(background), "image/webp")}">')
    packed = spz.encode(local, Hints(spz_version=SPZ_VERSION))
    description = _page_description(len(splats), len(packed))
    return assemble_player_page(title, texts, description, payload=packed, credit=credit)


def extract_payload(page: bytes, name: str) -> tuple[dict, bytes]:
    """Return the description of the scene in a page, and the file that the page holds.

    Args:
        page: HTML from `encode_model_page` or `encode_splats_page`.
        name: name of the page in error messages.

    Raises:
        HyrfDataError: the page is damaged, or was not written by this version of hyrfpack.
    """
    try:
        (facts,) = re.findall(rb'<script type="text/plain" id="scene">([^<]*)</script>', page)
        scene = json.loads(facts)
        if not isinstance(scene, dict):
            raise TypeError("no scene")
        blocks = re.findall(rb'<script type="text/plain" class="payload">([^<]*)</script>', page)
        return scene, b"".join(base64.b64decode(block, validate=True) for block in blocks)
    except (TypeError, ValueError, RecursionError) as error:
        raise _invalid_page_error(name) from error


def decode_splats_page(page: bytes, name: str) -> tuple[Splats, np.ndarray | None]:
    """Return the splats of a page, world units, and its background (H, W, 3) float32 in [0, 1] or None.

    Args:
        page: HTML from `encode_splats_page`.
        name: name of the page in error messages.

    Raises:
        HyrfDataError: the page is damaged, or is not a page of splats from this version of hyrfpack.
    """
    scene, packed = extract_payload(page, name)
    try:
        middle, unit = np.array(scene["center"], np.float64), np.float64(scene["unit"])
        if scene["kind"] != "splats" or middle.shape != (3,) or unit.shape or not unit > 0:
            raise ValueError("no splats, or no frame")
        local = spz.decode(packed, name)
        with np.errstate(over="ignore"):  # Splats rejects infinite values
            splats = replace(local, positions=local.positions * unit + middle, scales=local.scales * np.float32(unit))
        picture = re.search(rb'<img id="background"[^>]*base64,([^"]*)"', page)
        return splats, None if picture is None else _decode_webp(base64.b64decode(picture[1], validate=True))
    except (LookupError, TypeError, ValueError, ArithmeticError, RecursionError, OSError) as error:
        raise _invalid_page_error(name) from error


def _scene_element(
    kind: str,
    title: str,
    facts: dict,
    cameras: Sequence[Camera],
    up: np.ndarray,
    center: np.ndarray,
    solid: tuple[float, float, float],
) -> str:
    """Return the element of the page that describes the scene to the player."""
    if not cameras:
        raise ValueError("a page needs a camera to start from")
    scene = {
        "kind": kind,
        "title": escape_surrogates(title),
        **facts,
        "tolerance": RenderSettings().cull_tolerance,
        "solid": list(solid),
        **encode_views(cameras, up, center),
    }
    return json_element("scene", scene)


def encode_views(cameras: Sequence[Camera], up: np.ndarray, center: np.ndarray) -> dict:
    """Return the cameras, the upward direction and the centre of orbits for the player, ready for JSON.

    The arguments are those of `encode_model_page`.
    """
    return {
        "cameras": [camera_to_json(camera) for camera in cameras],
        "up": np.asarray(up, np.float64).tolist(),
        "target": np.asarray(center, np.float64).tolist(),
    }


def _page_description(count: int, length: int) -> str:
    """Return the description that programs show with the shared address of a page."""
    return f"{format_count(count, 'Gaussian')}, {length:,} bytes"


def _page_origin_and_unit(splats: Splats) -> tuple[np.ndarray, float]:
    """Return the page's origin in the world and its unit, the smallest power of two with which all splats fit SPZ."""
    if not len(splats):
        return np.zeros(3), 1.0
    low, high = splats.positions.min(0), splats.positions.max(0)
    least = max(float((high - low).max()) / 2 / MAX_SPZ_COORDINATE, float(splats.scales.max()) / MAX_SPZ_SCALE)
    return (low + high) / 2, 2.0 ** math.ceil(math.log2(least)) if least > 0 else 1.0


def _poster_elements(poster: bytes | None) -> list[str]:
    return [] if poster is None else [f'<img id="poster" alt="" src="{_data_url(poster, "image/webp")}">']


def _encode_webp(picture: np.ndarray) -> bytes:
    """Encode a picture (H, W, 3) in [0, 1] as WebP."""
    file = io.BytesIO()
    Image.fromarray((np.clip(picture, 0, 1) * 255 + 0.5).astype(np.uint8)).save(
        file, "WEBP", quality=BACKGROUND_WEBP_QUALITY, method=6
    )
    return file.getvalue()


def _decode_webp(data: bytes) -> np.ndarray:
    """Decode a WebP picture to (H, W, 3) float32 in [0, 1]."""
    try:
        with Image.open(io.BytesIO(data), formats=("WEBP",)) as picture:
            if picture.width * picture.height > MAX_BACKGROUND_PIXELS:
                raise ValueError(f"the background has {picture.width} x {picture.height} pixels")
            return np.asarray(picture.convert("RGB"), np.float32) / 255
    except Image.DecompressionBombError as error:
        raise ValueError(error) from error


def _data_url(data: bytes, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def _invalid_page_error(name: str) -> HyrfDataError:
    return HyrfDataError(f"{name}: this is not a page of hyrfpack's, or it is damaged", fix="export it again")

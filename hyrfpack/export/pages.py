"""Pages of one file: with the model itself inside, or with the splats that it was baked to."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from hyrfpack.atomic import write_atomic
from hyrfpack.export.poster import encode_poster, model_poster
from hyrfpack.export.report import ExportReport
from hyrfpack.export.source import Source
from hyrfpack.format import describe
from hyrfpack.model import BACKGROUND_RADIUS
from hyrfpack.render import RenderSettings
from hyrfpack.scene import Camera, evenly_spaced
from hyrfpack.splats.splats import Splats
from hyrfpack.web.html import encode_native, encode_page

PAGE_CAMERAS = 12  # that a page can be stepped through
POSTER, POSTER_BYTES = 480, 9_000  # pixels of its longer side; bytes, a third more in the page
LARGE = 20_000_000  # bytes of a page that take a while on many a connection


def page_cameras(read: Source) -> list[Camera]:
    """Those that a page can be stepped through: up to PAGE_CAMERAS of the known ones, or made-up ones."""
    cameras = [camera for _, camera in read.cameras] or [camera for camera, _ in read.measured]
    return evenly_spaced(cameras, PAGE_CAMERAS)


def baked_page(read: Source, splats: Splats, picture: np.ndarray | None, title: str) -> bytes:
    """The page that shows splats of a model.

    Args:
        read: the model.
        splats: what it was baked to.
        picture: (H, 2H, 3) its background, see `background_picture`; None for its solid colour.
        title: of the page.
    """
    frame = read.model.config.frame
    near, sphere = RenderSettings().near * frame.scale, (frame.center, BACKGROUND_RADIUS * frame.scale)
    return encode_page(splats, background=picture, near=near, sphere=sphere, **_stage(read, title))


def native_page(read: Source, data: bytes, title: str) -> bytes:
    """The page that holds a model itself.

    Args:
        read: the model.
        data: its `.hyrf` file.
        title: of the page.
    """
    return encode_native(data, count=len(read.model), frame=read.model.config.frame, **_stage(read, title))


def write_native_page(
    read: Source,
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    say: Callable[[str], None],
    overwrite: bool = True,
) -> ExportReport:
    """Write the page that holds a model file itself. `overwrite` as of `hyrfpack.atomic.pending_file`.

    Raises:
        HyrfError: it cannot be written.
    """
    data = Path(source).read_bytes()
    tell_of_size(source, len(data), say)
    page = native_page(read, data, Path(target).stem)
    written = write_atomic(target, page, overwrite=overwrite)
    return ExportReport(str(written), len(page), len(read.model), native=True)


def tell_of_size(source: str | os.PathLike[str], length: int, say: Callable[[str], None]) -> None:
    """Say what can be done where a model file of so many bytes, to be sent to browsers, is larger than need be."""
    if length > LARGE or describe(source)["profile"] == "raw":
        say(f"{source} goes along as it is, {length:,} bytes; 'hyrfpack compress' makes it smaller")


def _stage(read: Source, title: str) -> dict[str, Any]:
    """What pages are told besides what they hold."""
    cameras = page_cameras(read)
    return {
        "title": title,
        "cameras": cameras,
        "up": read.up,
        "center": read.center,
        "solid": read.model.config.solid,
        "poster": encode_poster(model_poster(read.model, cameras[0], POSTER), "WEBP", POSTER_BYTES),
    }

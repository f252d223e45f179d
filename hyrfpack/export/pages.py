"""Pages of a single file that contain either the model itself or splats baked from it."""

from __future__ import annotations

import logging
import os
from pathlib import Path
from typing import Any

import numpy as np

from hyrfpack.atomic import write_atomic
from hyrfpack.export.poster import encode_poster, render_model_poster
from hyrfpack.export.report import ExportReport
from hyrfpack.export.source import Source
from hyrfpack.format import describe_file
from hyrfpack.model import BACKGROUND_RADIUS
from hyrfpack.render import RenderSettings
from hyrfpack.scene import Camera, evenly_spaced
from hyrfpack.splats.splats import Splats
from hyrfpack.web.html import encode_model_page, encode_splats_page

_LOG = logging.getLogger(__name__)

MAX_PAGE_CAMERAS = 12
POSTER_LONGEST_SIDE_PIXELS = 480
MAX_POSTER_BYTES = 9_000  # before base64, which adds a third
LARGE_FILE_BYTES = 20_000_000  # larger files take long to load on many connections


def page_cameras(loaded: Source) -> list[Camera]:
    """Choose the cameras that a page steps through: up to MAX_PAGE_CAMERAS known ones, or made-up ones."""
    cameras = [camera for _, camera in loaded.cameras] or [camera for camera, _ in loaded.measured_views]
    return evenly_spaced(cameras, MAX_PAGE_CAMERAS)


def encode_baked_page(loaded: Source, splats: Splats, picture: np.ndarray | None, title: str) -> bytes:
    """Encode a page that shows splats baked from a model.

    Args:
        loaded: the model with its cameras.
        splats: the baked splats.
        picture: (H, 2H, 3) background of the model, see `background_picture`; None for its solid colour.
        title: title of the page.
    """
    frame = loaded.model.config.frame
    near, sphere = RenderSettings().near * frame.scale, (frame.center, BACKGROUND_RADIUS * frame.scale)
    return encode_splats_page(splats, background=picture, near=near, sphere=sphere, **_page_settings(loaded, title))


def encode_native_page(loaded: Source, data: bytes, title: str) -> bytes:
    """Encode a page that contains a model file.

    Args:
        loaded: the model with its cameras.
        data: bytes of the `.hyrf` file.
        title: title of the page.
    """
    return encode_model_page(
        data, count=len(loaded.model), frame=loaded.model.config.frame, **_page_settings(loaded, title)
    )


def write_native_page(
    loaded: Source,
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    overwrite: bool = True,
) -> ExportReport:
    """Write a page that contains a model file; `overwrite` is that of `hyrfpack.atomic.pending_file`.

    Raises:
        HyrfError: the page cannot be written.
    """
    data = Path(source).read_bytes()
    suggest_compression(source, len(data))
    page = encode_native_page(loaded, data, Path(target).stem)
    written = write_atomic(target, page, overwrite=overwrite)
    return ExportReport(str(written), len(page), len(loaded.model), native=True)


def suggest_compression(source: str | os.PathLike[str], length: int) -> None:
    """Suggest `hyrfpack compress` if a model file of `length` bytes is large or uncompressed."""
    if length > LARGE_FILE_BYTES or describe_file(source)["profile"] == "raw":
        _LOG.info(f"{source} is copied unchanged, {length:,} bytes; 'hyrfpack compress' makes it smaller")


def _page_settings(loaded: Source, title: str) -> dict[str, Any]:
    """Collect the arguments that both kinds of page share: title, cameras, axes, background colour and poster."""
    cameras = page_cameras(loaded)
    return {
        "title": title,
        "cameras": cameras,
        "up": loaded.up,
        "center": loaded.center,
        "solid": loaded.model.config.solid,
        "poster": encode_poster(
            render_model_poster(loaded.model, cameras[0], POSTER_LONGEST_SIDE_PIXELS), "WEBP", MAX_POSTER_BYTES
        ),
    }

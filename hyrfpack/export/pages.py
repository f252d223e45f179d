"""Pages of a single file that contain either the model itself or splats baked from it."""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch

from hyrfpack.atomic import write_atomic
from hyrfpack.cameras.view_sampling import shrink_camera
from hyrfpack.config.export import ExportConfig
from hyrfpack.export.poster import encode_poster, render_model_poster
from hyrfpack.export.report import ExportReport
from hyrfpack.export.source import Source
from hyrfpack.format import describe_file, find_model
from hyrfpack.format.scene_folder import is_scene
from hyrfpack.model import BACKGROUND_RADIUS, HybridModel
from hyrfpack.model.merged import MergedModel
from hyrfpack.render import RenderSettings, render_view
from hyrfpack.scene import Camera, evenly_spaced
from hyrfpack.splats.names import is_splats
from hyrfpack.splats.splats import Splats
from hyrfpack.web.html import encode_model_page, encode_splats_page

_LOG = logging.getLogger(__name__)

MAX_PAGE_CAMERAS = 12
POSTER_LONGEST_SIDE_PIXELS = 480
DETAIL_LONGEST_SIDE_PIXELS = 160
# Pictures of training cameras of five real scenes have 0.55 to 2.2 times the median detail of their scene.
MIN_START_DETAIL_RATIO = 0.5
MAX_POSTER_BYTES = 9_000  # before base64, which adds a third
LARGE_FILE_BYTES = 20_000_000  # larger files take long to load on many connections


def choose_page_cameras(loaded: Source) -> list[Camera]:
    """Choose the cameras that a page steps through: up to MAX_PAGE_CAMERAS known ones, or made-up ones.

    The page starts at the first camera whose picture has enough detail, compared with the other pictures: a camera in
    haze, or one that looks away from the scene, sees little. The cameras before it come last.
    """
    known_cameras = [camera for _, camera in loaded.cameras] or [camera for camera, _ in loaded.measured_views]
    cameras = evenly_spaced(known_cameras, MAX_PAGE_CAMERAS)
    start = choose_start(measure_detail(loaded.all_parts, cameras))
    return cameras[start:] + cameras[:start]


def choose_start(details: Sequence[float]) -> int:
    """Return the index of the first camera with at least MIN_START_DETAIL_RATIO of the median detail.

    Args:
        details: detail of the picture of each camera, see `measure_detail`; not empty.

    Returns:
        An index into `details`, 0 if no picture has any detail.
    """
    min_detail = MIN_START_DETAIL_RATIO * median(details)
    return next((index for index, detail in enumerate(details) if detail >= min_detail), 0)


@torch.no_grad()
def measure_detail(model: HybridModel | MergedModel, cameras: Sequence[Camera]) -> list[float]:
    """Return the mean difference between neighbouring pixels of a small picture of the model from each camera."""
    decoded = model.decode()
    details = []
    for camera in cameras:
        small = shrink_camera(camera, DETAIL_LONGEST_SIDE_PIXELS)
        grey = render_view(model, small, decoded=decoded).rgb.clamp(0, 1).mean(-1)
        details.append(float(sum(grey.diff(dim=axis).abs().sum() for axis in (0, 1))) / grey.numel())
    return details


def encode_baked_page(
    loaded: Source, splats: Splats, picture: np.ndarray | None, title: str, credit: str = ""
) -> bytes:
    """Encode a page that shows splats baked from a model.

    Args:
        loaded: the model with its cameras.
        splats: the baked splats.
        picture: (H, 2H, 3) background of the model, see `render_background_picture`; None for its solid colour.
        title: title of the page.
        credit: text below the title.
    """
    frame = loaded.model.config.frame
    near_plane, sphere = RenderSettings().near * frame.scale, (frame.center, BACKGROUND_RADIUS * frame.scale)
    settings = _collect_page_settings(loaded, title, credit)
    return encode_splats_page(splats, background=picture, near=near_plane, sphere=sphere, **settings)


def encode_native_page(
    loaded: Source, data: bytes, title: str, credit: str = "", editable_file: str | None = None
) -> bytes:
    """Encode a page that contains a model file.

    Args:
        loaded: the model with its cameras.
        data: bytes of the `.hyrf` file.
        title: title of the page.
        credit: text below the title.
        editable_file: as for `encode_model_page`.
    """
    settings = _collect_page_settings(loaded, title, credit)
    frame, count = loaded.model.config.frame, len(loaded.all_parts)
    return encode_model_page(data, count=count, frame=frame, editable_file=editable_file, **settings)


def write_native_page(
    loaded: Source,
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    config: ExportConfig,
    overwrite: bool = True,
) -> ExportReport:
    """Write a page that contains a model file; `overwrite` is that of `hyrfpack.atomic.pending_file`.

    Raises:
        HyrfError: the page cannot be written.
    """
    data = Path(source).read_bytes()
    title = Path(target).stem if config.title is None else config.title
    page = encode_native_page(loaded, data, title, config.credit, Path(source).name if config.editable else None)
    written_path = write_atomic(target, page, overwrite=overwrite)
    return ExportReport(str(written_path), len(page), len(loaded.all_parts), native=True)


def suggest_compression(source: str | os.PathLike[str]) -> None:
    """Suggest `hyrfpack compress` if a model file is large or uncompressed; the files of a scene folder are joined."""
    if is_scene(source) or is_splats(source):
        return
    file = find_model(source)
    facts = describe_file(file)
    if facts["bytes"] > LARGE_FILE_BYTES or facts["profile"] == "raw":
        _LOG.info(f"{file} is copied unchanged, {facts['bytes']:,} bytes; 'hyrfpack compress' makes it smaller")


def _collect_page_settings(loaded: Source, title: str, credit: str) -> dict[str, Any]:
    """Collect the arguments that both kinds of page share: texts, cameras, axes, background colour and poster."""
    cameras = choose_page_cameras(loaded)
    return {
        "title": title,
        "credit": credit,
        "cameras": cameras,
        "up": loaded.up,
        "center": loaded.center,
        "solid": loaded.model.config.solid,
        "poster": encode_poster(
            render_model_poster(loaded.all_parts, cameras[0], POSTER_LONGEST_SIDE_PIXELS), "WEBP", MAX_POSTER_BYTES
        ),
    }

"""Held-out views as runs rendered them, cut out of the pictures that lie in the runs' folders."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from hyrfpack.compare.run import Run
from hyrfpack.data.pictures import read_pixels
from hyrfpack.errors import HyrfDataError
from hyrfpack.evaluate.figures import split_comparison

SAME = 0.5  # levels of 255 that copies of a photo are apart at most, in the mean: decoders round differently


@dataclass(frozen=True)
class ComparedView:
    """A held-out view that all runs have a picture of.

    Attributes:
        name: of the photo.
        photo: as the runs were scored on it.
        renders: of each run.
        same: whether the photo looks the same in all runs.
    """

    name: str
    photo: Image.Image
    renders: list[Image.Image]
    same: bool


def read_views(runs: Sequence[Run]) -> list[ComparedView]:
    """The held-out views that all runs have pictures of.

    Raises:
        HyrfDataError: a picture cannot be read, or is no photo beside its render.
    """
    names = [name for name in runs[0].pictures if all(name in run.pictures for run in runs)]
    views = []
    for name in names:
        photos, renders = zip(*(_cut(run.pictures[name]) for run in runs), strict=True)
        same = all(_is_same(photos[0], photo) for photo in photos[1:])
        views.append(ComparedView(name, photos[0], list(renders), same))
    return views


def _cut(path: Path) -> tuple[Image.Image, Image.Image]:
    pixels, _ = read_pixels(path)
    try:
        photo, render, _ = split_comparison(Image.fromarray(pixels))
    except ValueError as error:
        raise HyrfDataError(
            f"{path}: this is no picture of photo, render and error map ({error}); remove it, and the view is left out"
        ) from error
    return photo, render


def _is_same(first: Image.Image, other: Image.Image) -> bool:
    if first.size != other.size:
        return False
    return float(np.abs(np.asarray(first, np.float32) - np.asarray(other, np.float32)).mean()) <= SAME


def data_address(image: Image.Image) -> str:
    """A picture as an address that holds it: lossless WebP."""
    data = io.BytesIO()
    image.save(data, "WEBP", lossless=True, method=2)  # finer search is 3 times as slow and saves a twentieth
    return "data:image/webp;base64," + base64.b64encode(data.getbuffer()).decode()

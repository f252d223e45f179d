"""Held-out views of several runs, cut out of the comparison pictures in the folders of the runs."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from hyrfpack.data.pictures import read_pixels
from hyrfpack.errors import HyrfDataError
from hyrfpack.evaluate.figures import split_comparison
from hyrfpack.report.run import Run

# Mean difference, in levels of 255, up to which two pictures count as the same photo: decoders round differently.
MAX_MEAN_DIFFERENCE_LEVELS = 0.5


@dataclass(frozen=True)
class ComparedView:
    """A held-out view that all runs have a picture of.

    Attributes:
        name: name of the photo.
        photo: the photo as the runs were scored on it.
        renders: the render of each run.
        shows_same_photo: whether the photo looks the same in all runs.
    """

    name: str
    photo: Image.Image
    renders: list[Image.Image]
    shows_same_photo: bool


def read_views(runs: Sequence[Run]) -> list[ComparedView]:
    """Read the held-out views of which all runs have pictures.

    Raises:
        HyrfDataError: a picture cannot be read, or does not show a photo beside its render.
    """
    names = [name for name in runs[0].pictures if all(name in run.pictures for run in runs)]
    views = []
    for name in names:
        photos, renders = zip(*(_read_photo_and_render(run.pictures[name]) for run in runs), strict=True)
        shows_same_photo = all(_look_same(photos[0], photo) for photo in photos[1:])
        views.append(ComparedView(name, photos[0], list(renders), shows_same_photo))
    return views


def _read_photo_and_render(path: Path) -> tuple[Image.Image, Image.Image]:
    pixels, _ = read_pixels(path)
    try:
        photo, render, _ = split_comparison(Image.fromarray(pixels))
    except ValueError as error:
        raise HyrfDataError(
            f"{path}: the file is not a comparison of photo, render and error map ({error})",
            fix="delete it to leave out this view",
        ) from error
    return photo, render


def _look_same(first: Image.Image, second: Image.Image) -> bool:
    if first.size != second.size:
        return False
    return (
        float(np.abs(np.asarray(first, np.float32) - np.asarray(second, np.float32)).mean())
        <= MAX_MEAN_DIFFERENCE_LEVELS
    )


def webp_data_uri(image: Image.Image) -> str:
    """Encode a picture as a data URI of lossless WebP."""
    data = io.BytesIO()
    image.save(data, "WEBP", lossless=True, method=2)  # higher methods take 3 times as long and save 5 %
    return "data:image/webp;base64," + base64.b64encode(data.getbuffer()).decode()

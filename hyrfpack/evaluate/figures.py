"""Pictures for people: photo beside render beside error map, and the curve of a training."""

from __future__ import annotations

import io
import logging
import math
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from hyrfpack.atomic import write_atomic
from hyrfpack.errors import needs_package

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ERROR_LIMIT = 0.2  # mean absolute difference over channels that gets the brightest colour
PANEL_WIDTH = 640  # pixels; larger pictures are shrunk to it
SMALL_PANEL = 400  # pixels; smaller pictures are enlarged a whole number of times, up to this width
SMOOTHING = 7  # points on either side that the drawn mean of a curve takes in
CURVE_MARGINS = {"left": 0.09, "right": 0.99, "bottom": 0.085, "top": 0.98, "hspace": 0.14}  # fractions of the figure
INK, PAPER, FAINT = (32, 33, 36), (255, 255, 255), (128, 130, 134)
GAP = 8


def comparison(photo: Tensor, render: Tensor, mask: Tensor | None = None, caption: str = "") -> Image.Image:
    """Photo | render | error map in a row, with a caption above and the error's colour bar below.

    Args:
        photo, render: (H, W, 3) in [0, 1].
        mask: (H, W) bool; pixels that do not count are dimmed in the photo and show no error.
        caption: one line.
    """
    seen = photo.cpu().numpy()
    error = (render - photo).abs().mean(dim=-1).cpu().numpy()
    if mask is not None:
        counted = mask.cpu().numpy()
        seen = np.where(counted[..., None], seen, 0.3 * seen)
        error = np.where(counted, error, 0)
    height, width = error.shape
    size = _panel_size(width, height)
    panels = [_panel(pixels, size) for pixels in (seen, render.cpu().numpy(), error_colors(error))]

    text, line = _font(size[0]), _line(size[0])
    sheet = Image.new("RGB", (3 * size[0] + 2 * GAP, size[1] + 2 * line + GAP), PAPER)
    draw = ImageDraw.Draw(sheet)
    draw.text((GAP, line / 2), caption, INK, text, anchor="lm")
    for column, (panel, label) in enumerate(zip(panels, ("photo", "render", ""), strict=True)):
        left = column * (size[0] + GAP)
        sheet.paste(panel, (left, line))
        draw.text((left + size[0] / 2, line + size[1] + line / 2), label, FAINT, text, anchor="mm")
    _color_bar(sheet, draw, text, (2 * (size[0] + GAP), line + size[1], size[0], line))
    return sheet


def cut_comparison(sheet: Image.Image) -> list[Image.Image]:
    """The photo, the render and the error map out of what `comparison` made, without the words around them.

    Raises:
        ValueError: the picture is not laid out so.
    """
    width, rest = divmod(sheet.width - 2 * GAP, 3)
    top = _line(width) if width > 0 else 0
    height = sheet.height - 2 * top - GAP
    if rest or width < 1 or height < 1:
        raise ValueError("it has not the size of photo, render and error map beside each other")
    sheet = sheet.convert("RGB")
    lefts = [column * (width + GAP) for column in range(3)]
    gaps = [sheet.crop((left - GAP, top, left, top + height)) for left in lefts[1:]]
    if any(gap.getcolors(1) != [(GAP * height, PAPER)] for gap in gaps):
        raise ValueError("there are no gaps where photo, render and error map would meet")
    return [sheet.crop((left, top, left + width, top + height)) for left in lefts]


def contact_sheet(rows: Sequence[Image.Image], title: str, lines: Sequence[str]) -> Image.Image:
    """Comparisons below each other, under a title and a few lines of text in fixed-width type."""
    width = max(row.width for row in rows)
    large, text = _font(width, 0.022), _font(width, 0.0145, fixed=True)
    margin, line = 2 * GAP, round(1.5 * text.size)
    top = margin + round(1.8 * large.size)
    header = top + line * len(lines) + margin
    width = max(width, *(math.ceil(text.getlength(words)) for words in lines))
    height = header + sum(row.height + GAP for row in rows) + margin
    sheet = Image.new("RGB", (width + 2 * margin, height), PAPER)
    draw = ImageDraw.Draw(sheet)
    draw.text((margin, margin), title, INK, large)
    for number, words in enumerate(lines):
        draw.text((margin, top + number * line), words, INK, text)
    for row in rows:
        sheet.paste(row, (margin, header))
        header += row.height + GAP
    return sheet


def training_curve(records: Sequence[dict], path: str | os.PathLike[str], *, overwrite: bool = True) -> Path:
    """Draw how a training went: PSNR and loss of the views trained on, faint with their mean, and the Gaussians.

    Args:
        records: each with "step", "psnr" (dB), "loss" and "gaussians".
        path: the PNG to write.
        overwrite: as of `hyrfpack.atomic.pending_file`.

    Returns:
        The path that was written.

    Raises:
        HyrfError: the file cannot be written.
    """
    figure = blank_figure(9, 6, layout=None)  # to measure all words would take longer than to draw them
    axes = figure.subplots(3, 1, sharex=True, gridspec_kw=CURVE_MARGINS)
    steps = [record["step"] for record in records]
    for axis, key, label, color in zip(
        axes,
        ("psnr", "loss", "gaussians"),
        ("training PSNR (dB)", "loss", "Gaussians"),
        ("#1a73e8", "#d93025", "#188038"),
        strict=True,
    ):
        values = [record[key] for record in records]
        if key != "gaussians":
            axis.plot(steps, values, color=color, linewidth=0.8, alpha=0.35)
            values = running_mean(values)
        axis.plot(steps, values, color=color, linewidth=1.5)
        axis.set_ylabel(label)
        axis.yaxis.set_label_coords(-0.077, 0.5)  # one below the other, left of the widest numbers
        axis.grid(alpha=0.3)
        axis.spines[["top", "right"]].set_visible(False)
    axes[1].set_yscale("log")
    axes[2].set_ylim(bottom=0)
    axes[2].set_xlabel("step")
    return save_figure(path, figure, overwrite=overwrite, format="png", metadata={"Software": None})


@contextmanager
def _drawing() -> Iterator[None]:
    """Import matplotlib inside this block, which says nothing then: as of having no folder to keep its fonts in."""
    logger = logging.getLogger("matplotlib")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with needs_package("matplotlib", "drawing figures"):
            yield
    finally:
        logger.setLevel(level)


def blank_figure(width: float, height: float, layout: Literal["constrained"] | None = "constrained") -> Figure:
    """A matplotlib figure to draw on, drawn by Agg whatever the screen; inches; `layout` as matplotlib has it."""
    with _drawing():
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout=layout)
    FigureCanvasAgg(figure)
    return figure


def save_figure(
    path: str | os.PathLike[str], figure: Figure, *, overwrite: bool = True, rename: bool = True, **options: Any
) -> Path:
    """Write a figure in one step, making its folder, and return the path that was written.

    `overwrite` and `rename` are those of `hyrfpack.atomic.pending_file`, `options` those of matplotlib's `savefig`.

    Raises:
        HyrfError: the folder or the file cannot be written.
    """
    data = io.BytesIO()
    figure.savefig(data, dpi=120, **options)
    return write_atomic(path, data.getbuffer(), overwrite=overwrite, rename=rename)


def svg_of(figure: Figure) -> str:
    """A figure as SVG, letters as outlines; the same figure gives the same text."""
    with _drawing():
        from matplotlib import rc_context

    data = io.StringIO()
    with rc_context({"svg.hashsalt": "hyrfpack"}):  # of the names in it
        figure.savefig(data, format="svg", metadata=dict.fromkeys(("Creator", "Date", "Format", "Type")))
    return data.getvalue()


def _panel_size(width: int, height: int) -> tuple[int, int]:
    if width > PANEL_WIDTH:
        return PANEL_WIDTH, max(1, round(height * PANEL_WIDTH / width))
    times = max(1, SMALL_PANEL // width)
    return times * width, times * height


def _panel(pixels: np.ndarray, size: tuple[int, int]) -> Image.Image:
    image = Image.fromarray((np.clip(pixels, 0, 1) * 255).round().astype(np.uint8))
    return image if image.size == size else image.resize(size, Image.Resampling.BOX)


def running_mean(values: Sequence[float]) -> list[float]:
    """Means over SMOOTHING values on either side and the value itself; the windows shrink towards the ends."""
    reach = [min(SMOOTHING, place, len(values) - 1 - place) for place in range(len(values))]
    return [fmean(values[place - near : place + near + 1]) for place, near in enumerate(reach)]


def error_colors(error: np.ndarray) -> np.ndarray:
    """(H, W) errors to (H, W, 3) colours, black at 0 and bright from ERROR_LIMIT on."""
    with _drawing():
        from matplotlib import colormaps

    return colormaps["inferno"](np.clip(error / ERROR_LIMIT, 0, 1))[..., :3]


def _color_bar(
    sheet: Image.Image, draw: ImageDraw.ImageDraw, text: ImageFont.FreeTypeFont, box: tuple[int, int, int, int]
) -> None:
    """The scale of the error map, centred in `box` (left, top, width, height)."""
    left, top, width, height = box
    length, thickness = width // 3, max(4, int(text.size) // 2)
    middle = top + height // 2
    start = left + (width - length) // 2
    ramp = np.broadcast_to(np.linspace(0, ERROR_LIMIT, length), (thickness, length))
    sheet.paste(_panel(error_colors(ramp), (length, thickness)), (start, middle - thickness // 2))
    draw.text((start - GAP, middle), "error 0", FAINT, text, anchor="rm")
    draw.text((start + length + GAP, middle), f"{ERROR_LIMIT:g}+", FAINT, text, anchor="lm")


def _line(width: int) -> int:
    """Height of a line of words above or below a picture of that width."""
    return round(1.6 * _font(width).size)


def _font(width: int, fraction: float = 0.036, fixed: bool = False) -> ImageFont.FreeTypeFont:
    """Type that fits a picture of that width; matplotlib brings the files on every system."""
    with _drawing():
        from matplotlib import get_data_path

    name = "DejaVuSansMono.ttf" if fixed else "DejaVuSans.ttf"
    size = min(20, max(9, round(width * fraction)))
    return ImageFont.truetype(str(Path(get_data_path()) / "fonts" / "ttf" / name), size)

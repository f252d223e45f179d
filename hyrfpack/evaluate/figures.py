"""Figures for reports: comparisons of photo, render and error map, contact sheets and training curves."""

from __future__ import annotations

import io
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
from hyrfpack.logs import log_only_errors_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Errors (mean absolute difference over channels) from this value on have the brightest colour of the map.
ERROR_LIMIT = 0.2
# Wider pictures are shrunk to this width.
MAX_PANEL_WIDTH_PIXELS = 640
# Small pictures are enlarged by a whole factor, up to this width and height.
MAX_ENLARGED_PIXELS = 400
SMOOTHING_RADIUS_RECORDS = 7
# Margins of the training curve's axes, as fractions of the figure.
CURVE_MARGINS = {"left": 0.09, "right": 0.99, "bottom": 0.085, "top": 0.98, "hspace": 0.14}
TEXT_COLOR = (32, 33, 36)
PAPER_COLOR = (255, 255, 255)
LABEL_COLOR = (128, 130, 134)
GAP_PIXELS = 8


def draw_comparison(
    photo: Tensor,
    render: Tensor,
    mask: Tensor | None = None,
    caption: str = "",
    labels: tuple[str, str] = ("photo", "render"),
) -> Image.Image:
    """Draw photo | render | error map in a row, with a caption above and the error's colour bar below.

    Args:
        photo, render: (H, W, 3) in [0, 1].
        mask: (H, W) bool, False where a pixel is ignored; ignored pixels are dimmed in the photo and show no error.
        caption: one line of text.
        labels: texts below the first two pictures.
    """
    dimmed_photo = photo.cpu().numpy()
    error = (render - photo).abs().mean(dim=-1).cpu().numpy()
    if mask is not None:
        counted = mask.cpu().numpy()
        dimmed_photo = np.where(counted[..., None], dimmed_photo, 0.3 * dimmed_photo)
        error = np.where(counted, error, 0)
    height, width = error.shape
    size = _panel_size(width, height)
    panels = [_panel(pixels, size) for pixels in (dimmed_photo, render.cpu().numpy(), map_error_colors(error))]

    text, line = _font(size[0]), _line_height(size[0])
    sheet = Image.new("RGB", (3 * size[0] + 2 * GAP_PIXELS, size[1] + 2 * line + GAP_PIXELS), PAPER_COLOR)
    draw = ImageDraw.Draw(sheet)
    draw.text((GAP_PIXELS, line / 2), caption, TEXT_COLOR, text, anchor="lm")
    for column, (panel, label) in enumerate(zip(panels, (*labels, ""), strict=True)):
        left = column * (size[0] + GAP_PIXELS)
        sheet.paste(panel, (left, line))
        draw.text((left + size[0] / 2, line + size[1] + line / 2), label, LABEL_COLOR, text, anchor="mm")
    _color_bar(sheet, draw, text, (2 * (size[0] + GAP_PIXELS), line + size[1], size[0], line))
    return sheet


def split_comparison(sheet: Image.Image) -> list[Image.Image]:
    """Cut the photo, the render and the error map out of a picture drawn by `draw_comparison`.

    Raises:
        ValueError: the picture has another layout.
    """
    width, remainder = divmod(sheet.width - 2 * GAP_PIXELS, 3)
    top = _line_height(width) if width > 0 else 0
    height = sheet.height - 2 * top - GAP_PIXELS
    if remainder or width < 1 or height < 1:
        raise ValueError("it has not the size of photo, render and error map beside each other")
    sheet = sheet.convert("RGB")
    lefts = [column * (width + GAP_PIXELS) for column in range(3)]
    gaps = [sheet.crop((left - GAP_PIXELS, top, left, top + height)) for left in lefts[1:]]
    if any(gap.getcolors(1) != [(GAP_PIXELS * height, PAPER_COLOR)] for gap in gaps):
        raise ValueError("there are no gaps where photo, render and error map would meet")
    return [sheet.crop((left, top, left + width, top + height)) for left in lefts]


def draw_contact_sheet(rows: Sequence[Image.Image], title: str, lines: Sequence[str]) -> Image.Image:
    """Draw comparisons below each other, under a title and a few lines of text in a fixed-width font."""
    width = max(row.width for row in rows)
    large, text = _font(width, 0.022), _font(width, 0.0145, fixed=True)
    margin, line = 2 * GAP_PIXELS, round(1.5 * text.size)
    top = margin + round(1.8 * large.size)
    header = top + line * len(lines) + margin
    width = max([width, *(math.ceil(text.getlength(text_line)) for text_line in lines)])
    height = header + sum(row.height + GAP_PIXELS for row in rows) + margin
    sheet = Image.new("RGB", (width + 2 * margin, height), PAPER_COLOR)
    draw = ImageDraw.Draw(sheet)
    draw.text((margin, margin), title, TEXT_COLOR, large)
    for number, text_line in enumerate(lines):
        draw.text((margin, top + number * line), text_line, TEXT_COLOR, text)
    for row in rows:
        sheet.paste(row, (margin, header))
        header += row.height + GAP_PIXELS
    return sheet


def draw_training_curve(records: Sequence[dict], path: str | os.PathLike[str], *, overwrite: bool = True) -> Path:
    """Write the training curves as a PNG: PSNR and loss of training views, with running means, and Gaussians.

    Args:
        records: one dictionary for each recorded step, with "step", "psnr" (dB), "loss" and "gaussians".
        path: the PNG to write.
        overwrite: as in `hyrfpack.atomic.pending_file`.

    Returns:
        The path that was written.

    Raises:
        HyrfError: the file cannot be written.
    """
    figure = make_blank_figure(9, 6, layout=None)  # matplotlib's constrained layout takes longer than drawing
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
            values = compute_running_mean(values)
        axis.plot(steps, values, color=color, linewidth=1.5)
        axis.set_ylabel(label)
        axis.yaxis.set_label_coords(-0.077, 0.5)  # aligns the labels, left of the widest numbers
        axis.grid(alpha=0.3)
        axis.spines[["top", "right"]].set_visible(False)
    axes[1].set_yscale("log")
    axes[2].set_ylim(bottom=0)
    axes[2].set_xlabel("step")
    return save_figure(path, figure, overwrite=overwrite, format="png", metadata={"Software": None})


@contextmanager
def _quiet_matplotlib() -> Iterator[None]:
    """Import matplotlib inside this block without its log messages, such as those on a missing cache folder."""
    with log_only_errors_of("matplotlib"), needs_package("drawing figures"):
        yield


def require_matplotlib() -> None:
    """Check that figures can be drawn, before work whose result is a figure.

    Raises:
        HyrfError: matplotlib is not installed.
    """
    with _quiet_matplotlib():
        import matplotlib.figure  # noqa: F401


def make_blank_figure(width: float, height: float, layout: Literal["constrained"] | None = "constrained") -> Figure:
    """Return an empty matplotlib figure with the Agg backend, which needs no display.

    Args:
        width, height: size in inches.
        layout: layout engine of matplotlib.
    """
    with _quiet_matplotlib():
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout=layout)
    FigureCanvasAgg(figure)
    return figure


def save_figure(path: str | os.PathLike[str], figure: Figure, *, overwrite: bool = True, **options: Any) -> Path:
    """Write a figure in one step, create its folder if needed, and return the path that was written.

    `overwrite` is that of `hyrfpack.atomic.pending_file`, `options` are those of matplotlib's `savefig`.

    Raises:
        HyrfError: the folder or the file cannot be written.
    """
    data = io.BytesIO()
    figure.savefig(data, dpi=120, **options)
    return write_atomic(path, data.getbuffer(), overwrite=overwrite)


def figure_to_svg(figure: Figure) -> str:
    """Return a figure as SVG with text as outlines; the same figure gives the same SVG."""
    with _quiet_matplotlib():
        from matplotlib import rc_context

    data = io.StringIO()
    with rc_context({"svg.hashsalt": "hyrfpack"}):  # makes the element ids reproducible
        figure.savefig(data, format="svg", metadata=dict.fromkeys(("Creator", "Date", "Format", "Type")))
    return data.getvalue()


def _panel_size(width: int, height: int) -> tuple[int, int]:
    if width > MAX_PANEL_WIDTH_PIXELS:
        return MAX_PANEL_WIDTH_PIXELS, max(1, round(height * MAX_PANEL_WIDTH_PIXELS / width))
    times = max(1, MAX_ENLARGED_PIXELS // max(width, height))
    return times * width, times * height


def _panel(pixels: np.ndarray, size: tuple[int, int]) -> Image.Image:
    image = Image.fromarray((np.clip(pixels, 0, 1) * 255).round().astype(np.uint8))
    return image if image.size == size else image.resize(size, Image.Resampling.BOX)


def compute_running_mean(values: Sequence[float]) -> list[float]:
    """Return running means over each value and SMOOTHING_RADIUS_RECORDS values on either side.

    The windows shrink towards the ends.
    """
    reach = [min(SMOOTHING_RADIUS_RECORDS, index, len(values) - 1 - index) for index in range(len(values))]
    return [fmean(values[index - radius : index + radius + 1]) for index, radius in enumerate(reach)]


def map_error_colors(error: np.ndarray) -> np.ndarray:
    """Map errors (H, W) to colours (H, W, 3), from black at 0 to the brightest colour at ERROR_LIMIT and above."""
    with _quiet_matplotlib():
        from matplotlib import colormaps

    return colormaps["inferno"](np.clip(error / ERROR_LIMIT, 0, 1))[..., :3]


def _color_bar(
    sheet: Image.Image, draw: ImageDraw.ImageDraw, text: ImageFont.FreeTypeFont, box: tuple[int, int, int, int]
) -> None:
    """Draw the scale of the error map, centred in `box` (left, top, width, height)."""
    left, top, width, height = box
    length, thickness = width // 3, max(4, int(text.size) // 2)
    middle = top + height // 2
    start = left + (width - length) // 2
    ramp = np.broadcast_to(np.linspace(0, ERROR_LIMIT, length), (thickness, length))
    sheet.paste(_panel(map_error_colors(ramp), (length, thickness)), (start, middle - thickness // 2))
    draw.text((start - GAP_PIXELS, middle), "error 0", LABEL_COLOR, text, anchor="rm")
    draw.text((start + length + GAP_PIXELS, middle), f"{ERROR_LIMIT:g}+", LABEL_COLOR, text, anchor="lm")


def _line_height(width: int) -> int:
    """Return the height in pixels of a line of text above or below a picture of this width in pixels."""
    return round(1.6 * _font(width).size)


def _font(width: int, fraction: float = 0.036, fixed: bool = False) -> ImageFont.FreeTypeFont:
    """Return a font that fits a picture of this width, from the files that matplotlib installs on every system."""
    with _quiet_matplotlib():
        from matplotlib import get_data_path

    name = "DejaVuSansMono.ttf" if fixed else "DejaVuSans.ttf"
    size = min(20, max(9, round(width * fraction)))
    return ImageFont.truetype(str(Path(get_data_path()) / "fonts" / "ttf" / name), size)

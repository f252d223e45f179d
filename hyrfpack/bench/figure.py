"""Rows as a picture: time against error."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from hyrfpack.bench.rows import Row
from hyrfpack.errors import HyrfError
from hyrfpack.evaluate.figures import blank_figure, save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FORMATS = ("png", "svg", "pdf")
COLORS = ("#1a73e8", "#d93025", "#188038", "#e37400", "#8430ce", "#12858d", "#5f6368", "#b31412")
COLUMNS = 3
CURVES = ("render", "codec")  # groups whose settings are numbers on a scale
LABEL_SIZE = 7  # points
LABEL_PLACES = ((6, 4), (6, -9), (-6, 4), (-6, -9), (6, 13), (-6, 13), (6, -18), (-6, -18))  # points; < 0 is leftwards

Box = tuple[float, float, float, float]  # left, bottom, right, top


@dataclass(frozen=True)
class Panel:
    """Some rows, and what their horizontal axis is."""

    title: str
    axis: str
    rows: list[Row]
    across: Callable[[Row], float]


def plot(rows: Sequence[Row], path: str | os.PathLike[str], *, overwrite: bool = True) -> Path:
    """Draw the rms error of each row against its time over the reference's, both axes logarithmic.

    A panel for each group; in "render" one for each setting with a curve, in "codec" one for the profiles and one for
    each profile's settings, and each again over bytes. References are stars, defaults are ringed. Results without any
    error lie on the line marked 0.

    Args:
        path: the picture to write, in the format of its extension, one out of FORMATS.
        overwrite: as of `hyrfpack.atomic.pending_file`.

    Returns:
        The path that was written.

    Raises:
        HyrfError: the file cannot be written, or its extension names no such format.
    """
    drawn = panels(rows)
    across = min(COLUMNS, len(drawn))
    down = -(-len(drawn) // across)
    figure = blank_figure(5.2 * across, 4.2 * down)
    places = list(figure.subplots(down, across, squeeze=False).flat)
    marked = [_draw(axes, panel) for axes, panel in zip(places, drawn, strict=False)]
    for axes in places[len(drawn) :]:
        axes.set_axis_off()
    figure.draw_without_rendering()  # now it is known where each point lies
    figure.set_layout_engine("none")
    for axes, labels in zip(places, marked, strict=False):
        _label(axes, labels)
    return save_figure(path, figure, overwrite=overwrite, format=picture_format(path))


def picture_format(path: str | os.PathLike[str]) -> str:
    """The format that a path's extension names. Raises HyrfError unless it is one of FORMATS."""
    suffix = Path(path).suffix.lower().removeprefix(".")
    if suffix not in FORMATS:
        raise HyrfError(f"{path}: a plot is written as {', '.join(FORMATS)}; give it one of these extensions")
    return suffix


def panels(rows: Sequence[Row]) -> list[Panel]:
    """What is drawn where."""
    parts: dict[str, list[Row]] = {}
    for row in rows:
        title = row.group
        if row.group == "render":
            values = sum((other.group, other.setting) == ("render", row.setting) for other in rows)
            title = f"render: {row.setting}" if values > 2 else "render: other settings"
        elif row.group == "codec":
            title = f"codec: {row.setting.partition(',')[0]}"
        parts.setdefault(title, []).append(row)
    made = []
    for title, here in parts.items():
        if here[0].group != "codec":
            made.append(Panel(title, "time / reference", here, lambda row: row.ratio.wall))
            continue
        (size,) = {row.bytes for row in rows if row.group == "codec" and row.is_reference}
        made.append(Panel(f"{title}, encoding", "time / raw", here, lambda row: row.ratio.wall))
        made.append(Panel(f"{title}, size", "bytes / raw", here, partial(_size_ratio, reference=size)))
    return made


def _size_ratio(row: Row, reference: int | None) -> float:
    assert row.bytes is not None and reference is not None  # rows of the codec have bytes
    return row.bytes / reference


def _draw(axes: Axes, panel: Panel) -> list[tuple[Row, float, float, str]]:
    """Points and axes of a panel; returns what is to be labelled: row, place, colour."""
    exact = min((row.error.rms for row in panel.rows if row.error.rms > 0), default=1e-8) / 10
    settings = list(dict.fromkeys(row.setting for row in panel.rows))
    marked = []
    for number, setting in enumerate(settings):
        color = COLORS[number % len(COLORS)]
        here = [row for row in panel.rows if row.setting == setting]
        points = {id(row): (panel.across(row), row.error.rms or exact) for row in here}
        if here[0].group in CURVES:
            curve = [points[id(row)] for row in here if not row.is_reference]
            axes.plot(*zip(*curve, strict=True), color=color, linewidth=0.8, alpha=0.5, zorder=1)
        for row in here:
            x, y = points[id(row)]
            axes.scatter(x, y, s=90 if row.is_reference else 18, marker="*" if row.is_reference else "o", color=color)
            if row.is_default:
                axes.scatter(x, y, s=110, facecolors="none", edgecolors=color, linewidths=1.5)
            marked.append((row, x, y, color))
        axes.plot([], [], color=color, label=setting)
    axes.set(xscale="log", yscale="log", xlabel=panel.axis, ylabel="rms error")
    axes.set_title(panel.title, fontsize=10, loc="left")
    axes.margins(x=0.18, y=0.15)
    low, high = axes.get_xlim()
    axes.xaxis.set_major_formatter(_plain)
    axes.xaxis.set_minor_formatter(_plain if high < 10 * low else _nothing)
    axes.tick_params(which="both", labelsize=LABEL_SIZE)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    if any(row.error.rms == 0 for row in panel.rows):
        axes.axhline(exact, color="#9aa0a6", linewidth=0.8, linestyle=":", zorder=0)
        axes.annotate(
            "0",
            (0, exact),
            xycoords=("axes fraction", "data"),
            xytext=(3, 2),
            textcoords="offset points",
            fontsize=LABEL_SIZE,
        )
    if len(settings) > 1:
        axes.legend(fontsize=LABEL_SIZE, frameon=False)
    return marked


def _label(axes: Axes, marked: Sequence[tuple[Row, float, float, str]]) -> None:
    """Write values beside their points where there is room; references and defaults choose first."""
    scale = axes.figure.dpi / 72
    edge = axes.bbox.x1 / scale
    taken: list[Box] = []
    for row, x, y, color in sorted(marked, key=lambda item: not (item[0].is_reference or item[0].is_default)):
        left, bottom = axes.transData.transform((x, y)) / scale
        width = 0.58 * LABEL_SIZE * len(row.value)
        for right, up in LABEL_PLACES:
            start = left + right - (width if right < 0 else 0)
            box = (start, bottom + up, start + width, bottom + up + LABEL_SIZE)
            if box[2] <= edge and not any(_overlap(box, other) for other in taken):
                taken.append(box)
                axes.annotate(
                    row.value,
                    (x, y),
                    xytext=(right, up),
                    textcoords="offset points",
                    ha="right" if right < 0 else "left",
                    fontsize=LABEL_SIZE,
                    color=color,
                )
                break


def _overlap(a: Box, b: Box) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def _plain(value: float, _position: float) -> str:
    return f"{value:g}"


def _nothing(_value: float, _position: float) -> str:
    return ""

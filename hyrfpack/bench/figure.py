"""Plot measured rows: error against time."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from hyrfpack.bench.rows import Row
from hyrfpack.errors import HyrfError
from hyrfpack.evaluate.figures import make_blank_figure, save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PLOT_FORMATS = ("png", "svg", "pdf")
SETTING_COLORS = ("#1a73e8", "#d93025", "#188038", "#e37400", "#8430ce", "#12858d", "#5f6368", "#b31412")
MAX_PANEL_COLUMNS = 3
CURVE_GROUPS = ("render", "codec")  # groups whose points are joined, because their values lie on a scale
LABEL_SIZE_POINTS = 7
# Candidate offsets (right, up) of a label from its point; labels with a negative first offset are right-aligned.
LABEL_OFFSETS_POINTS = ((6, 4), (6, -9), (-6, 4), (-6, -9), (6, 13), (-6, 13), (6, -18), (-6, -18))

Box = tuple[float, float, float, float]  # left, bottom, right, top


@dataclass(frozen=True)
class Panel:
    """The rows of one panel of the plot.

    Attributes:
        title: title of the panel.
        axis: label of the horizontal axis.
        rows: rows that are drawn as points.
        x_value: returns a row's value on the horizontal axis.
    """

    title: str
    axis: str
    rows: list[Row]
    x_value: Callable[[Row], float]


def plot(rows: Sequence[Row], path: str | os.PathLike[str], *, overwrite: bool = True) -> Path:
    """Plot the rms error of each row against the ratio of its time to the reference's, both on logarithmic axes.

    There is one panel for each group. "render" has one for each setting with a curve. "codec" has one for the profiles
    and one for each profile's settings; each is repeated with the file size as horizontal axis. References are stars,
    defaults have a ring. Results without any error lie on the line marked 0.

    Args:
        rows: the measured rows.
        path: the picture to write; its extension, one of PLOT_FORMATS, decides the format.
        overwrite: as in `hyrfpack.atomic.pending_file`.

    Returns:
        The path of the written file.

    Raises:
        HyrfError: the file cannot be written, or its extension is not one of PLOT_FORMATS.
    """
    panels = build_panels(rows)
    columns = min(MAX_PANEL_COLUMNS, len(panels))
    panel_rows = -(-len(panels) // columns)
    figure = make_blank_figure(5.2 * columns, 4.2 * panel_rows)
    all_axes = list(figure.subplots(panel_rows, columns, squeeze=False).flat)
    labels_by_panel = [_draw_panel(axes, panel) for axes, panel in zip(all_axes, panels, strict=False)]
    for axes in all_axes[len(panels) :]:
        axes.set_axis_off()
    figure.draw_without_rendering()  # this lays out the axes, which the positions of the labels depend on
    figure.set_layout_engine("none")
    for axes, labels in zip(all_axes, labels_by_panel, strict=False):
        _draw_labels(axes, labels)
    return save_figure(path, figure, overwrite=overwrite, format=choose_plot_format(path))


def choose_plot_format(path: str | os.PathLike[str]) -> str:
    """Return the format that a path's extension names.

    Raises:
        HyrfError: the extension is not one of PLOT_FORMATS.
    """
    suffix = Path(path).suffix.lower().removeprefix(".")
    if suffix not in PLOT_FORMATS:
        raise HyrfError(
            f"{path}: a plot is written as {', '.join(PLOT_FORMATS)}",
            fix="give it one of these extensions",
        )
    return suffix


def build_panels(rows: Sequence[Row]) -> list[Panel]:
    """Group rows into panels, see `plot`."""
    rows_by_title: dict[str, list[Row]] = {}
    for row in rows:
        title = row.group
        if row.group == "render":
            values = sum((candidate.group, candidate.setting) == ("render", row.setting) for candidate in rows)
            title = f"render: {row.setting}" if values > 2 else "render: other settings"
        elif row.group == "codec":
            title = f"codec: {row.setting.partition(',')[0]}"
        rows_by_title.setdefault(title, []).append(row)
    panels = []
    for title, panel_rows in rows_by_title.items():
        if panel_rows[0].group != "codec":
            panels.append(Panel(title, "time / reference", panel_rows, lambda row: row.ratio.wall))
            continue
        (size,) = {row.bytes for row in rows if row.group == "codec" and row.is_reference}
        panels.append(Panel(f"{title}, encoding", "time / raw", panel_rows, lambda row: row.ratio.wall))
        panels.append(Panel(f"{title}, size", "bytes / raw", panel_rows, partial(_size_ratio, reference=size)))
    return panels


def _size_ratio(row: Row, reference: int | None) -> float:
    """Divide a row's file size by that of the reference."""
    assert row.bytes is not None and reference is not None  # every row of group "codec" has a size
    return row.bytes / reference


def _draw_panel(axes: Axes, panel: Panel) -> list[tuple[Row, float, float, str]]:
    """Draw the points and axes of a panel; return the row, x, y and colour of each point for the labels."""
    exact = min((row.error.rms for row in panel.rows if row.error.rms > 0), default=1e-8) / 10
    settings = list(dict.fromkeys(row.setting for row in panel.rows))
    labels = []
    for number, setting in enumerate(settings):
        color = SETTING_COLORS[number % len(SETTING_COLORS)]
        setting_rows = [row for row in panel.rows if row.setting == setting]
        points = {id(row): (panel.x_value(row), row.error.rms or exact) for row in setting_rows}
        if setting_rows[0].group in CURVE_GROUPS:
            curve = [points[id(row)] for row in setting_rows if not row.is_reference]
            axes.plot(*zip(*curve, strict=True), color=color, linewidth=0.8, alpha=0.5, zorder=1)
        for row in setting_rows:
            x, y = points[id(row)]
            axes.scatter(x, y, s=90 if row.is_reference else 18, marker="*" if row.is_reference else "o", color=color)
            if row.is_default:
                axes.scatter(x, y, s=110, facecolors="none", edgecolors=color, linewidths=1.5)
            labels.append((row, x, y, color))
        axes.plot([], [], color=color, label=setting)
    axes.set(xscale="log", yscale="log", xlabel=panel.axis, ylabel="rms error")
    axes.set_title(panel.title, fontsize=10, loc="left")
    axes.margins(x=0.18, y=0.15)
    low, high = axes.get_xlim()
    axes.xaxis.set_major_formatter(_format_tick)
    axes.xaxis.set_minor_formatter(_format_tick if high < 10 * low else _hide_tick)
    axes.tick_params(which="both", labelsize=LABEL_SIZE_POINTS)
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
            fontsize=LABEL_SIZE_POINTS,
        )
    if len(settings) > 1:
        axes.legend(fontsize=LABEL_SIZE_POINTS, frameon=False)
    return labels


def _draw_labels(axes: Axes, labels: Sequence[tuple[Row, float, float, str]]) -> None:
    """Write the values at their points if there is room; references and defaults are placed first."""
    scale = axes.figure.dpi / 72
    edge = axes.bbox.x1 / scale
    placed_boxes: list[Box] = []
    for row, x, y, color in sorted(labels, key=lambda item: not (item[0].is_reference or item[0].is_default)):
        left, bottom = axes.transData.transform((x, y)) / scale
        width = 0.58 * LABEL_SIZE_POINTS * len(row.value)
        for right, up in LABEL_OFFSETS_POINTS:
            start = left + right - (width if right < 0 else 0)
            box = (start, bottom + up, start + width, bottom + up + LABEL_SIZE_POINTS)
            if box[2] <= edge and not any(_overlap(box, placed) for placed in placed_boxes):
                placed_boxes.append(box)
                axes.annotate(
                    row.value,
                    (x, y),
                    xytext=(right, up),
                    textcoords="offset points",
                    ha="right" if right < 0 else "left",
                    fontsize=LABEL_SIZE_POINTS,
                    color=color,
                )
                break


def _overlap(a: Box, b: Box) -> bool:
    """Return whether two boxes overlap."""
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def _format_tick(value: float, _position: float) -> str:
    """Format a tick as a plain number, which matplotlib would write as a power of ten."""
    return f"{value:g}"


def _hide_tick(_value: float, _position: float) -> str:
    """Return no label for a tick."""
    return ""

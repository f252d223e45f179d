"""The plot of the compression report: size, loss and decoding time of all files."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from hyrfpack.evaluate.figures import make_blank_figure
from hyrfpack.report.compression_page import Findings, MeasuredFile, format_size
from hyrfpack.report.page import LIGHT_TEXT_COLOR, style_axes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CURVE_COLOR = "#1a73e8"
PAPER_COLOR = "#d93025"
RAW_COLOR = LIGHT_TEXT_COLOR  # becomes DARK_TEXT_COLOR on dark backgrounds, as text does


def draw_plot(findings: Findings) -> Figure:
    """Plot loss and decoding time over bytes. A line joins the "compact" files, and a ring marks the written file."""
    figure = make_blank_figure(9, 6.5)
    loss_axes, time_axes = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    exact = [point for point in findings.points if findings.is_exact(point.scores)]
    finite = [point for point in findings.points if point not in exact]
    _scatter(loss_axes, findings, finite, lambda point: findings.fidelity(point.scores))
    _scatter(time_axes, findings, findings.points, lambda point: point.decode_ms)
    for point in finite:
        _label_point(loss_axes, findings, point, (point.bytes, findings.fidelity(point.scores)), "data")
    for point in exact:  # an exact file has infinite PSNR, so it is a vertical line
        loss_axes.axvline(point.bytes, color=_point_color(findings, point), linestyle=":")
        _label_point(loss_axes, findings, point, (point.bytes, 0.5), ("data", "axes fraction"))
    loss_axes.set_ylabel("PSNR lost (dB): less is better" if findings.has_photos else "PSNR (dB): more is better")
    time_axes.set(xscale="log", xlabel="size of the file", ylabel="decoding (ms)")
    time_axes.set_ylim(bottom=0)
    ticks = _round_sizes(*time_axes.get_xlim())
    time_axes.set_xticks(ticks, [format_size(tick) for tick in ticks])
    time_axes.set_xticks([], minor=True)
    return figure


def _scatter(
    axes: Axes, findings: Findings, points: Sequence[MeasuredFile], height: Callable[[MeasuredFile], float]
) -> None:
    curve = sorted((point for point in findings.curve if point in points), key=lambda point: point.bytes)
    axes.plot([point.bytes for point in curve], [height(point) for point in curve], color=CURVE_COLOR, linewidth=1)
    for point in points:
        color = _point_color(findings, point)
        axes.scatter(point.bytes, height(point), s=25, color=color, zorder=3)
        if point is findings.chosen:
            axes.scatter(point.bytes, height(point), s=140, facecolors="none", edgecolors=color, linewidths=1.5)
    style_axes(axes)
    axes.margins(x=0.12, y=0.15)


def _label_point(
    axes: Axes, findings: Findings, point: MeasuredFile, position: tuple[float, float], coordinates: Any
) -> None:
    """Label a point, unless it lies on the line; the label is on the side away from the line."""
    if point is findings.chosen or point in findings.profiles:
        label = f"{point.name}: exact" if findings.is_exact(point.scores) else point.name
        offset = (8, 8) if findings.has_photos else (8, -16)
        color = _point_color(findings, point)
        axes.annotate(
            label, position, offset, coordinates, "offset points", color=color, weight="bold", annotation_clip=False
        )


def _point_color(findings: Findings, point: MeasuredFile) -> str:
    if point in findings.profiles:
        return RAW_COLOR if point.name == "raw" else PAPER_COLOR
    return CURVE_COLOR


def _round_sizes(low: float, high: float) -> list[float]:
    """Return the sizes of 1, 2 and 5 times powers of ten between two limits."""
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    sizes = [digit * 10.0**power for power in powers for digit in (1, 2, 5)]
    return [size for size in sizes if low <= size <= high]

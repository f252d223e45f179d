"""Size, loss and speed of the files that a model can be, as one picture."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from hyrfpack.compress.report_page import Findings, Point, size_in_words
from hyrfpack.evaluate.figures import blank_figure, save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BLUE, RED, GREY = "#1a73e8", "#d93025", "#5f6368"


def draw(findings: Findings, path: str | os.PathLike[str], *, overwrite: bool = True) -> None:
    """Plot bytes against loss, and below that against the time to decode; "compact" is joined, the file itself ringed.

    Raises:
        HyrfError: the file cannot be written, or not without `overwrite`.
    """
    figure = blank_figure(9, 6.5)
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    exact = [point for point in findings.points if findings.is_exact(point.scores)]
    finite = [point for point in findings.points if point not in exact]
    _scatter(above, findings, finite, lambda point: findings.fidelity(point.scores))
    _scatter(below, findings, findings.points, lambda point: point.decode_ms)
    for point in finite:
        _name(above, findings, point, (point.bytes, findings.fidelity(point.scores)), "data")
    for point in exact:  # infinitely good: at any height
        above.axvline(point.bytes, color=_color(findings, point), linestyle=":")
        _name(above, findings, point, (point.bytes, 0.5), ("data", "axes fraction"))
    above.set_ylabel("PSNR lost (dB): less is better" if findings.has_photos else "PSNR (dB): more is better")
    below.set(xscale="log", xlabel="size of the file", ylabel="decoding (ms)")
    below.set_ylim(bottom=0)
    ticks = _round_sizes(*below.get_xlim())
    below.set_xticks(ticks, [size_in_words(tick) for tick in ticks])
    below.set_xticks([], minor=True)
    save_figure(path, figure, overwrite=overwrite, rename=False, format="png", metadata={"Software": None})


def _scatter(axes: Axes, findings: Findings, points: Sequence[Point], height: Callable[[Point], float]) -> None:
    curve = sorted((point for point in findings.curve if point in points), key=lambda point: point.bytes)
    axes.plot([point.bytes for point in curve], [height(point) for point in curve], color=BLUE, linewidth=1)
    for point in points:
        color = _color(findings, point)
        axes.scatter(point.bytes, height(point), s=25, color=color, zorder=3)
        if point is findings.chosen:
            axes.scatter(point.bytes, height(point), s=140, facecolors="none", edgecolors=color, linewidths=1.5)
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    axes.margins(x=0.12, y=0.15)


def _name(axes: Axes, findings: Findings, point: Point, place: tuple[float, float], system: Any) -> None:
    """Write beside a point what it is, unless the line says so; on the side where the line is not."""
    if point is findings.chosen or point in findings.profiles:
        words = f"{point.name}: exact" if findings.is_exact(point.scores) else point.name
        offset = (8, 8) if findings.has_photos else (8, -16)
        color = _color(findings, point)
        axes.annotate(words, place, offset, system, "offset points", color=color, weight="bold", annotation_clip=False)


def _color(findings: Findings, point: Point) -> str:
    if point in findings.profiles:
        return GREY if point.name == "raw" else RED
    return BLUE


def _round_sizes(low: float, high: float) -> list[float]:
    """1, 2 and 5 times powers of ten, between two sizes."""
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    sizes = [digit * 10.0**power for power in powers for digit in (1, 2, 5)]
    return [size for size in sizes if low <= size <= high]

"""The figure of a comparison: training curves of several runs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from hyrfpack.evaluate.figures import compute_running_mean, make_blank_figure
from hyrfpack.report.page import style_axes
from hyrfpack.report.run import Run

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Okabe and Ito's colours for all kinds of colour vision, those that are visible on white and on black.
LINE_COLORS = ("#0072b2", "#e69f00", "#009e73", "#d55e00", "#cc79a7", "#56b4e9")
# Dash patterns of SVG. Runs take the colours in turn with the first pattern, then with the next one.
LINE_DASHES = ("", "6 3", "2 3")


def choose_line_style(number: int) -> tuple[str, str]:
    """Return the colour of a run's line and its dash pattern in SVG's notation, by the run's index."""
    return LINE_COLORS[number % len(LINE_COLORS)], LINE_DASHES[number // len(LINE_COLORS) % len(LINE_DASHES)]


def draw_curves(runs: Sequence[Run]) -> Figure:
    """Draw PSNR over steps and seconds, and Gaussians over steps. The figure contains no text from files."""
    figure = make_blank_figure(12, 3.7)
    by_step, by_time, counts = figure.subplots(1, 3)
    for number, run in enumerate(runs):
        color, dashes = choose_line_style(number)
        style = (0, [float(length) for length in dashes.split()]) if dashes else "-"
        options = {"color": color, "linestyle": style, "linewidth": 1.5}
        steps = [record.step for record in run.curve]
        psnr = compute_running_mean([record.psnr for record in run.curve])
        by_step.plot(steps, psnr, **options)
        by_time.plot(list_record_seconds(run), psnr, **options)
        counts.plot(steps, [record.gaussians for record in run.curve], **options)
    by_step.set(xlabel="step", ylabel="training PSNR (dB)")
    by_time.set(xlabel="seconds of training", ylabel="training PSNR (dB)")
    counts.set(xlabel="step", ylabel="Gaussians")
    counts.set_ylim(bottom=0)
    for axes in (by_step, by_time, counts):
        style_axes(axes)
    return figure


def list_record_seconds(run: Run) -> list[float]:
    """Return the training seconds of each record of the curve, spread evenly over the steps if the run has no times."""
    if has_times(run):
        return [record.seconds for record in run.curve if record.seconds is not None]
    return [run.seconds * record.step / run.settings["steps"] for record in run.curve]


def has_times(run: Run) -> bool:
    """Return whether each record of the run's curve has its time."""
    return all(record.seconds is not None for record in run.curve)

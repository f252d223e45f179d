"""How the trainings of several runs went, in one figure."""

from __future__ import annotations

from collections.abc import Sequence

from hyrfpack.compare.run import Run
from hyrfpack.evaluate.figures import blank_figure, figure_to_svg, running_mean

# Of the runs, in turn (Okabe and Ito's, for all kinds of eyes, those that show on white and on black); then dashed.
COLORS = ("#0072b2", "#e69f00", "#009e73", "#d55e00", "#cc79a7", "#56b4e9")
DASHES = ("", "6 3", "2 3")  # of SVG
INK = "#5a6068"  # as --dim in the style


def line_style(number: int) -> tuple[str, str]:
    """The colour of a run's line, and its dashes as SVG has them."""
    return COLORS[number % len(COLORS)], DASHES[number // len(COLORS) % len(DASHES)]


def draw_curves(runs: Sequence[Run]) -> str:
    """PSNR over steps and seconds, Gaussians over steps, as SVG: on no ground, in INK, and no word of files in it."""
    figure = blank_figure(12, 3.7)
    figure.patch.set_alpha(0)
    by_step, by_time, counts = figure.subplots(1, 3)
    for number, run in enumerate(runs):
        color, dashes = line_style(number)
        style = (0, [float(length) for length in dashes.split()]) if dashes else "-"
        options = {"color": color, "linestyle": style, "linewidth": 1.5}
        steps = [record.step for record in run.curve]
        psnr = running_mean([record.psnr for record in run.curve])
        by_step.plot(steps, psnr, **options)
        by_time.plot(seconds_of(run), psnr, **options)
        counts.plot(steps, [record.gaussians for record in run.curve], **options)
    by_step.set(xlabel="step", ylabel="training PSNR (dB)")
    by_time.set(xlabel="seconds of training", ylabel="training PSNR (dB)")
    counts.set(xlabel="step", ylabel="Gaussians")
    counts.set_ylim(bottom=0)
    for axis in (by_step, by_time, counts):
        axis.patch.set_alpha(0)
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
        axis.spines[["left", "bottom"]].set_color(INK)
        axis.tick_params(colors=INK)
        axis.xaxis.label.set_color(INK)
        axis.yaxis.label.set_color(INK)
    return figure_to_svg(figure)


def seconds_of(run: Run) -> list[float]:
    """When each record of the curve was made; spread evenly over the steps where the run kept no times."""
    if keeps_times(run):
        return [record.seconds for record in run.curve if record.seconds is not None]
    return [run.seconds * record.step / run.settings["steps"] for record in run.curve]


def keeps_times(run: Run) -> bool:
    """Whether each record of the curve says when it was made."""
    return all(record.seconds is not None for record in run.curve)

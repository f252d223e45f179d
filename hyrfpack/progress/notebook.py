"""Progress in a Jupyter notebook: a bar with the line of progress and, in training, curves of loss and PSNR."""

from __future__ import annotations

from html import escape
from time import monotonic

from hyrfpack.measure.psnr import psnr_from_mse
from hyrfpack.progress.events import Event, StepEvent
from hyrfpack.progress.status import Status, StatusLine

MIN_REDRAW_SECONDS = 0.5
MAX_CURVE_POINTS = 400
CURVE_WIDTH, CURVE_HEIGHT = 320, 80  # pixels
CURVE_COLORS = {"loss": "#c44e52", "PSNR (dB)": "#4c72b0"}


class NotebookDisplay:
    """Redraws the output of a notebook's cell at events; the last training step and the curves stay in it."""

    def __init__(self, status: Status) -> None:
        from IPython.display import HTML, display

        self._html, self._status = HTML, status
        self._curves = Curves()
        self._drawn = monotonic()
        self._last_step: StatusLine | None = None
        self._handle = display(HTML(""), display_id=True)

    def __enter__(self) -> NotebookDisplay:
        return self

    def __exit__(self, *_: object) -> None:
        self._keep_last_step()
        self._draw(self._last_step)

    def __call__(self, event: Event) -> None:
        if not isinstance(event, StepEvent):
            self._keep_last_step()
        self._status.update(event)
        means = self._status.means
        if isinstance(event, StepEvent) and means.loss is not None and means.mse is not None:
            self._curves.add(event.step, means.loss, psnr_from_mse(means.mse))
        if monotonic() - self._drawn >= MIN_REDRAW_SECONDS:
            self._draw(self._status.line())

    def _keep_last_step(self) -> None:
        if isinstance(self._status.event, StepEvent):
            self._last_step = self._status.line()

    def _draw(self, line: StatusLine | None) -> None:
        self._drawn, page = monotonic(), ""
        if line is not None:
            bar = f'<progress value="{line.share:.4f}" max="1" style="width: 20em"></progress>'
            page = f"<div>{bar} <code>{escape(str(line))}</code></div>{self._curves.svg()}"
        self._handle.update(self._html(page))


class Curves:
    """The curves of loss and PSNR over the steps, each in a range of its own, as an SVG picture."""

    def __init__(self) -> None:
        self._points: list[tuple[int, float, float]] = []  # step, loss, PSNR in dB
        self._stride = 1

    def add(self, step: int, loss: float, psnr: float) -> None:
        """Add a step, if it is one of those that are kept: at most MAX_CURVE_POINTS at equal distances.

        A step that does not follow the last one begins the curves of another run.
        """
        if self._points and step <= self._points[-1][0]:
            self._points, self._stride = [], 1
        if step % self._stride:
            return
        self._points.append((step, loss, psnr))
        if len(self._points) > MAX_CURVE_POINTS:
            self._stride *= 2
            self._points = [point for point in self._points if point[0] % self._stride == 0]

    def svg(self) -> str:
        """Return the picture; "" before the second point."""
        if len(self._points) < 2:
            return ""
        steps, losses, psnrs = zip(*self._points, strict=True)
        curves = [_curve_svg(name, steps, values) for name, values in (("loss", losses), ("PSNR (dB)", psnrs))]
        return f"<div>{''.join(curves)}</div>"


def _curve_svg(name: str, steps: tuple[int, ...], values: tuple[float, ...]) -> str:
    """Return one curve, with its range in the caption."""
    low, high = min(values), max(values)
    across, up = CURVE_WIDTH / (steps[-1] - steps[0]), CURVE_HEIGHT / ((high - low) or 1.0)
    points = " ".join(
        f"{across * (step - steps[0]):.1f},{CURVE_HEIGHT - up * (value - low):.1f}"
        for step, value in zip(steps, values, strict=True)
    )
    return (
        f'<figure style="display: inline-block; margin: 0.5em 1em"><figcaption>{name} {low:.3g} to {high:.3g}'
        f'</figcaption><svg width="{CURVE_WIDTH}" height="{CURVE_HEIGHT}" style="overflow: visible"><polyline '
        f'points="{points}" fill="none" stroke="{CURVE_COLORS[name]}" stroke-width="1.5"/></svg></figure>'
    )

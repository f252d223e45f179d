"""The HTML page of a comparison, a single file. All texts from files are escaped."""

from __future__ import annotations

import base64
import html
from collections.abc import Callable, Sequence
from importlib.resources import files

import numpy as np

from hyrfpack.errors import printable
from hyrfpack.evaluate.figures import ERROR_LIMIT, SMOOTHING_RADIUS_RECORDS, error_colors
from hyrfpack.report.curves import LIGHT_TEXT_COLOR, draw_curves, has_times, line_style
from hyrfpack.report.differences import choices_that_differ, notes_that_differ, settings_that_differ
from hyrfpack.report.run import Run
from hyrfpack.report.views import ComparedView, webp_data_uri
from hyrfpack.version import __version__
from hyrfpack.web.player import content_security_policy, fill_template, json_element

# The value of --dim in style.css for dark backgrounds.
DARK_TEXT_COLOR = "#a6acb3"


def encode_comparison(
    runs: Sequence[Run], names: Sequence[str], views: Sequence[ComparedView], doubts: Sequence[str]
) -> bytes:
    """Encode a page that shows runs side by side.

    Args:
        runs: two or more runs.
        names: their names on the page.
        views: held-out views to show.
        doubts: sentences on why some numbers of the runs cannot be compared.

    Returns:
        The HTML file, UTF-8. The same arguments give the same bytes.
    """
    style, script = _read_asset("style.css"), _read_asset("comparison.js")
    values = {
        "policy": content_security_policy(style, [script]),
        "version": __version__,
        "title": _escape(f"{len(runs)} training runs: {', '.join(names)}"),
        "style": style,
        "doubts": "\n".join(f'<p class="doubt">{_escape(sentence)}</p>' for sentence in doubts),
        "tables": "\n".join(_tables(runs, names, ranked=not doubts)),
        "legend": _legend(names),
        "curves": _curves(runs, names),
        "curves_note": _escape(_curves_note(runs, names)),
        "views": _read_asset("views.html") if views else "",
        "texts": json_element("compared", _view_data(runs, names, views)) if views else "",
        "script": script,
    }
    return fill_template(_read_asset("comparison.html"), values).encode()


def _tables(runs: Sequence[Run], names: Sequence[str], ranked: bool) -> list[str]:
    """Return the tables of numbers and of differences as HTML; with `ranked`, the best scores are marked."""
    numbers = [
        *_score_rows("held-out PSNR (dB)", [run.psnr for run in runs], 2, max if ranked else None),
        *_score_rows("held-out SSIM", [run.ssim for run in runs], 4, max if ranked else None),
        *_score_rows("held-out LPIPS", [run.lpips for run in runs], 4, min if ranked else None),
        _row("Gaussians", [f"{run.gaussians:,}" for run in runs]),
    ]
    for file in dict.fromkeys(file for run in runs for file in run.files):
        sizes = [f"{run.files[file]:,}" if file in run.files else "-" for run in runs]
        numbers.append(_row(f"bytes of {file}", sizes))
    numbers += [
        _row("seconds of training", [f"{run.seconds:,.1f}" for run in runs]),
        _row("steps", [f"{run.settings['steps']:,}" for run in runs]),
        _row("seed", [str(run.settings["seed"]) for run in runs]),
    ]
    notes = ["; ".join(notes) or "-" for notes in notes_that_differ(runs)]
    differing = {
        "Settings": settings_that_differ(runs),
        "Choices": choices_that_differ(runs),
        "Notes": {"from reading the photos": notes} if len(set(notes)) > 1 else {},
    }
    tables = [_table("Numbers", names, numbers)]
    for kind, rows in differing.items():
        if rows:
            formatted = [_row(name, cells) for name, cells in rows.items()]
            tables.append(_table(f"{kind} that differ", names, formatted))
    if same := [kind.lower() for kind, rows in differing.items() if not rows]:
        tables.append(f'<p class="small">The same in all runs: {", ".join(same)}.</p>')
    return tables


def _table(caption: str, names: Sequence[str], rows: Sequence[str]) -> str:
    heads = "".join(f'<th scope="col">{_swatch(number)}{_escape(name)}</th>' for number, name in enumerate(names))
    return "\n".join([
        f'<div class="wide"><table><caption>{_escape(caption)}</caption>',
        f"<thead><tr><td></td>{heads}</tr></thead>",
        "<tbody>",
        *rows,
        "</tbody></table></div>",
    ])  # fmt: skip


def _score_rows(name: str, scores: Sequence[float | None], digits: int, best: Callable | None) -> list[str]:
    """Return a row of scores with the best one marked, or no row if there are no scores."""
    present = [round(score, digits) for score in scores if score is not None]
    if not present:
        return []
    cells = ["-" if score is None else f"{score:.{digits}f}" for score in scores]
    return [_row(name, cells, f"{best(present):.{digits}f}" if best and len(set(present)) > 1 else None)]


def _row(name: str, cells: Sequence[str], best: str | None = None) -> str:
    tags = ('<td class="best">' if cell == best else "<td>" for cell in cells)
    formatted = "".join(f"{tag}{_escape(cell)}</td>" for tag, cell in zip(tags, cells, strict=True))
    return f'<tr><th scope="row">{_escape(name)}</th>{formatted}</tr>'


def _legend(names: Sequence[str]) -> str:
    items = (f"<li>{_swatch(number)}{_escape(name)}</li>" for number, name in enumerate(names))
    return f'<ul class="legend">{"".join(items)}</ul>'


def _swatch(number: int) -> str:
    """Return a sample of a run's line as SVG."""
    color, dashes = line_style(number)
    dashed = f' stroke-dasharray="{dashes}"' if dashes else ""
    line = f'<path d="M0 4h26" stroke="{color}" stroke-width="3"{dashed}/>'
    return f'<svg class="swatch" viewBox="0 0 26 8" aria-hidden="true">{line}</svg>'


def _curves(runs: Sequence[Run], names: Sequence[str]) -> str:
    """Return the figure as HTML, with one image for light and one for dark backgrounds."""
    svg = draw_curves(runs)
    light, dark = (_svg_data_uri(svg.replace(LIGHT_TEXT_COLOR, ink)) for ink in (LIGHT_TEXT_COLOR, DARK_TEXT_COLOR))
    note = "Training PSNR over steps, training PSNR over seconds and Gaussians over steps, with a line for each run"
    return (
        f'<div class="wide"><picture><source media="(prefers-color-scheme: dark)" srcset="{dark}">'
        f'<img class="curves" src="{light}" alt="{note}"></picture></div>'
    )


def _svg_data_uri(svg: str) -> str:
    return "data:image/svg+xml;base64," + base64.b64encode(svg.encode()).decode()


def _curves_note(runs: Sequence[Run], names: Sequence[str]) -> str:
    note = (
        f"PSNR is measured on the training photos, as a running mean over {2 * SMOOTHING_RADIUS_RECORDS + 1} records."
    )
    timeless = [name for run, name in zip(runs, names, strict=True) if not has_times(run)]
    if timeless:
        missing = ", ".join(timeless)
        note += f" Times of single steps are missing for {missing}; the seconds are spread evenly over the steps there."
    return note


def _view_data(runs: Sequence[Run], names: Sequence[str], views: Sequence[ComparedView]) -> dict:
    """Return the data of the page's script: photo, renders and scores of each view, and the error colours."""
    scores = [{score.name: [score.psnr, score.ssim, score.lpips] for score in run.scores} for run in runs]
    ramp = (error_colors(np.linspace(0, ERROR_LIMIT, 256)) * 255).round().astype(np.uint8)
    return {
        "runs": list(names),
        "views": [
            {
                "name": view.name,
                "pictures": [webp_data_uri(picture) for picture in (view.photo, *view.renders)],
                "scores": [of_run.get(view.name, [None] * 3) for of_run in scores],
            }
            for view in views
        ],
        "ramp": base64.b64encode(ramp.tobytes()).decode(),
        "limit": ERROR_LIMIT,
    }


def _read_asset(name: str) -> str:
    return files("hyrfpack.report").joinpath(name).read_text("utf-8")


def _escape(text: str) -> str:
    return html.escape(printable(text))

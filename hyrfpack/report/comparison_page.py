"""The HTML page of a comparison, a single file."""

from __future__ import annotations

import base64
from collections.abc import Callable, Sequence

import numpy as np

from hyrfpack.counts import format_count
from hyrfpack.evaluate.figures import ERROR_LIMIT, SMOOTHING_RADIUS_RECORDS, map_error_colors
from hyrfpack.report.curves import choose_line_style, draw_curves, has_times
from hyrfpack.report.differences import find_differing_choices, find_differing_notes, find_differing_settings
from hyrfpack.report.page import embed_figure, encode_page, escape, paragraph, read_asset, section, table, table_row
from hyrfpack.report.run import Run
from hyrfpack.report.views import ComparedView, webp_data_uri
from hyrfpack.web.player import json_element


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
    curves = embed_figure(
        draw_curves(runs),
        "Training PSNR over steps, training PSNR over seconds and Gaussians over steps, with a line for each run",
    )
    content = [
        *(paragraph(sentence, "doubt") for sentence in doubts),
        section("numbers", "Scores and sizes", *_tables(runs, names, ranked=not doubts)),
        section("training", "Training", _legend(names), curves, paragraph(_curves_note(runs, names), "small")),
    ]
    heading = f"{format_count(len(runs), 'training run')}: {', '.join(names)}"
    if not views:
        return encode_page(heading, content)
    content.append(section("views", "Held-out views", read_asset("views.html")))
    data = json_element("compared", _view_data(runs, names, views))
    return encode_page(heading, content, script=read_asset("views.js"), data=data)


def _tables(runs: Sequence[Run], names: Sequence[str], ranked: bool) -> list[str]:
    """Return the tables of numbers and of differences as HTML; with `ranked`, the best scores are marked."""
    numbers = [
        *_score_rows("held-out PSNR (dB)", [run.psnr for run in runs], 2, max if ranked else None),
        *_score_rows("held-out SSIM", [run.ssim for run in runs], 4, max if ranked else None),
        *_score_rows("held-out LPIPS", [run.lpips for run in runs], 4, min if ranked else None),
        table_row("Gaussians", [f"{run.gaussians:,}" for run in runs]),
    ]
    for file in dict.fromkeys(file for run in runs for file in run.files):
        sizes = [f"{run.files[file]:,}" if file in run.files else "-" for run in runs]
        numbers.append(table_row(f"bytes of {file}", sizes))
    numbers += [
        table_row("seconds of training", [f"{run.seconds:,.1f}" for run in runs]),
        table_row("steps", [f"{run.settings['steps']:,}" for run in runs]),
        table_row("seed", [str(run.settings["seed"]) for run in runs]),
    ]
    notes = ["; ".join(notes) or "-" for notes in find_differing_notes(runs)]
    differing = {
        "Other settings": find_differing_settings(runs),
        "Choices": find_differing_choices(runs),
        "Notes": {"from reading the photos": notes} if len(set(notes)) > 1 else {},
    }
    header = ["", *(f"{_swatch(number)}{escape(name)}" for number, name in enumerate(names))]
    tables = [table(header, numbers, "Numbers")]
    for kind, rows in differing.items():
        if rows:
            formatted = [table_row(name, cells) for name, cells in rows.items()]
            tables.append(table(header, formatted, f"{kind} that differ"))
    if same := [kind.lower() for kind, rows in differing.items() if not rows]:
        tables.append(paragraph(f"The same in all runs: {', '.join(same)}.", "small"))
    return tables


def _score_rows(name: str, scores: Sequence[float | None], digits: int, best: Callable | None) -> list[str]:
    """Return a row of scores with the best one marked, or no row if there are no scores."""
    present = [round(score, digits) for score in scores if score is not None]
    if not present:
        return []
    cells = ["-" if score is None else f"{score:.{digits}f}" for score in scores]
    return [table_row(name, cells, f"{best(present):.{digits}f}" if best and len(set(present)) > 1 else None)]


def _legend(names: Sequence[str]) -> str:
    items = (f"<li>{_swatch(number)}{escape(name)}</li>" for number, name in enumerate(names))
    return f'<ul class="legend">{"".join(items)}</ul>'


def _swatch(number: int) -> str:
    """Return a sample of a run's line as SVG."""
    color, dashes = choose_line_style(number)
    dashed = f' stroke-dasharray="{dashes}"' if dashes else ""
    line = f'<path d="M0 4h26" stroke="{color}" stroke-width="3"{dashed}/>'
    return f'<svg class="swatch" viewBox="0 0 26 8" aria-hidden="true">{line}</svg>'


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
    ramp = (map_error_colors(np.linspace(0, ERROR_LIMIT, 256)) * 255).round().astype(np.uint8)
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

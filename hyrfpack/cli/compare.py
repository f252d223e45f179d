"""The command `hyrfpack compare`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import click

from hyrfpack.cli.common import json_option, note, note_rename, overwrite_option, print_json
from hyrfpack.cli.types import INPUT_PATH, OUTPUT


@click.command(short_help="Compare training runs on one page.")
@click.argument("runs", metavar="RUN RUN...", type=INPUT_PATH, nargs=-1, required=True)
@click.option("-o", "--output", type=OUTPUT, required=True, metavar="FILE", help="The .html page to write.")
@overwrite_option
@json_option
def compare(runs: tuple[Path, ...], output: Path, overwrite: bool, as_json: bool) -> None:
    """Write one page that compares RUNs, folders written by 'hyrfpack train', side by side.

    The page has a table of scores, sizes, times and differing settings, a figure of the training curves, and held-out
    photos and renders with a slider between them. It is one file and loads nothing from elsewhere.

    \b
    Examples:
      hyrfpack compare runs/a runs/b -o comparison.html
      hyrfpack compare runs/* -o comparison.html --overwrite
    """
    from hyrfpack.report import compare_runs

    report = compare_runs(runs, output, overwrite=overwrite)
    for sentence in report.doubts:
        note(sentence)
    written_path = note_rename(output, report.file)
    if as_json:
        print_json(asdict(report))
        return
    views = f"{len(report.views)} held-out view{'' if len(report.views) == 1 else 's'}"
    click.echo(f"{written_path}: {len(report.runs)} runs, {views}, {report.bytes:,} bytes; open it in a browser")

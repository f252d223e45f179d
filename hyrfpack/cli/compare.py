"""The command `hyrfpack compare`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import click

from hyrfpack.cli.common import OUTPUT, PATH, json_option, note, note_rename, overwrite_option, print_json


@click.command(short_help="Show training runs side by side.")
@click.argument("runs", metavar="RUN RUN...", type=PATH, nargs=-1, required=True)
@click.option("-o", "--output", type=OUTPUT, required=True, metavar="FILE", help="The page, an .html file.")
@overwrite_option
@json_option
def compare(runs: tuple[Path, ...], output: Path, overwrite: bool, as_json: bool) -> None:
    """Write one page that shows RUNs, folders of 'hyrfpack train', side by side.

    Scores, sizes, times and what differs in settings and choices as a table, the training curves in one figure, and
    held-out photos and renders with a slider between them. The page holds everything and fetches nothing.

    \b
    Examples:
      hyrfpack compare runs/a runs/b -o comparison.html
      hyrfpack compare runs/* -o comparison.html --overwrite
    """
    from hyrfpack.compare import compare_runs as run

    report = run(runs, output, overwrite=overwrite)
    for sentence in report.doubts:
        note(sentence)
    written = note_rename(output, report.file)
    if as_json:
        print_json(asdict(report))
        return
    views = f"{len(report.views)} held-out view{'' if len(report.views) == 1 else 's'}"
    click.echo(f"{written}: {len(report.runs)} runs, {views}, {report.bytes:,} bytes; open it in a browser")

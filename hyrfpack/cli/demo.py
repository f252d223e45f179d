"""The command `hyrfpack demo`."""

from __future__ import annotations

from pathlib import Path

import click

from hyrfpack.cli.common import json_option, note_rename, overwrite_option, print_json
from hyrfpack.cli.console import notes_only_of
from hyrfpack.cli.settings import settings_options
from hyrfpack.cli.types import OUTPUT_FOLDER
from hyrfpack.config.train import TrainConfig
from hyrfpack.outputs import Outputs


@click.command(short_help="Run every stage on a small synthetic scene.")
@click.option(
    "-o",
    "--output",
    type=OUTPUT_FOLDER,
    default=Path("demo"),
    show_default=True,
    metavar="DIR",
    help="Folder of the results.",
)
@settings_options(TrainConfig, "steps")
@overwrite_option
@json_option
def demo(output: Path, steps: int, overwrite: bool, as_json: bool) -> None:
    """Make a synthetic scene, train on it, compress, decompress, render, measure and export it, and plot the results.

    \b
    Example:
      hyrfpack demo -o demo
    """
    from hyrfpack.demo.run import PAGE_FILE, PICTURE_FILE, RESULT_FILES, run_demo

    Outputs(overwrite=overwrite).folder(output, RESULT_FILES)
    with notes_only_of("hyrfpack.demo", "hyrfpack.train"):
        result = run_demo(output, steps=steps, overwrite=overwrite)
    note_rename(output / PICTURE_FILE, result.picture)
    note_rename(output / PAGE_FILE, result.page.file)
    if as_json:
        print_json(result.to_dict())
        return
    click.echo("\n".join(result.table()))
    click.echo(f"{result.page.file}: the scene in a browser; {result.page.bytes:,} bytes")
    click.echo(f"{result.picture}: photos, renders and errors of held-out views")

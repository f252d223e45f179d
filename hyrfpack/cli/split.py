"""The command `hyrfpack split`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from hyrfpack.cli.common import format_table, json_option, overwrite_option, print_json, resolve_model_file
from hyrfpack.cli.settings import settings_options
from hyrfpack.cli.types import OUTPUT, PATH
from hyrfpack.config.split import SplitConfig


@click.command(short_help="Split a model into chunks with levels of detail.")
@click.argument("model", type=PATH)
@click.option("-o", "--output", type=OUTPUT, metavar="DIR", required=True, help="The folder to write.")
@settings_options(SplitConfig, "chunk_gaussians", "levels", "refit_steps", "title", "licence", "seed")
@overwrite_option
@json_option
def split(model: Path, output: Path, overwrite: bool, as_json: bool, **settings: Any) -> None:
    """Split MODEL, a .hyrf file or the folder of a run, into a scene folder: scene.json and chunks beside it.

    Each chunk is a .hyrf file of nearby Gaussians, at several levels of detail. The finest level of all chunks is the
    model. scene.json lists the chunks, and the error of each level in pictures. render, evaluate, export, view and info
    read the folder, its scene.json or a .zip of it like a file.

    \b
    Examples:
      hyrfpack split city.hyrf -o city-scene
      hyrfpack split city.hyrf -o city-scene --chunk-gaussians 50000 --levels 5
      hyrfpack render city-scene -o walk --cameras walk.json --gaussians 500000
    """
    resolve_model_file(model)
    from hyrfpack.lod import split_model

    report = split_model(model, output, SplitConfig(**settings), overwrite=overwrite)
    if as_json:
        print_json(report.to_dict())
        return
    rows = [
        [f"level {level}", f"{count:,}", f"{size:,}"]
        for level, (count, size) in enumerate(zip(report.level_gaussians, report.level_bytes, strict=True))
    ]
    shared = report.bytes_finest - report.level_bytes[0]
    click.echo(format_table(["files", "Gaussians", "bytes"], [["shared", "-", f"{shared:,}"], *rows]))
    click.echo(
        f"{report.folder}: {report.chunks} chunks, {report.bytes:,} bytes; the finest level takes "
        f"{report.bytes_finest:,} bytes, the model {report.bytes_source:,}"
    )

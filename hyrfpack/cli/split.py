"""The command `hyrfpack split`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from hyrfpack.cli.common import (
    format_table,
    json_option,
    overwrite_option,
    print_json,
    read_scene,
    resolve_model_file,
    scene_options,
)
from hyrfpack.cli.settings import settings_options
from hyrfpack.cli.types import INPUT_PATH, OUTPUT_FOLDER
from hyrfpack.config.split import SplitConfig
from hyrfpack.counts import format_count


@click.command(short_help="Split a model into chunks with levels of detail.")
@click.argument("model", type=INPUT_PATH)
@click.option("-o", "--output", type=OUTPUT_FOLDER, metavar="DIR", required=True, help="The folder to write.")
@click.option(
    "--data",
    type=INPUT_PATH,
    help="Photos and poses, at whose cameras levels are fitted and measured.  [default: the cameras that MODEL keeps]",
)
@settings_options(SplitConfig, "chunk_gaussians", "levels", "refit_steps", "title", "licence", "seed")
@overwrite_option
@scene_options
@json_option
def split(
    model: Path,
    output: Path,
    data: Path | None,
    overwrite: bool,
    reader_options: dict[str, Any],
    as_json: bool,
    **settings: Any,
) -> None:
    """Split MODEL, a .hyrf file or the folder of a run, into a scene folder: scene.json and chunks beside it.

    Each chunk is a .hyrf file of nearby Gaussians, at several levels of detail. The finest level of all chunks is the
    model. scene.json lists the chunks, and the error of each level in pictures. render, evaluate, export, view and info
    read the folder, its scene.json or a .zip of it like a file.

    \b
    Examples:
      hyrfpack split city.hyrf -o city-scene --data photos/city
      hyrfpack split city.hyrf -o city-scene --chunk-gaussians 50000 --levels 5
      hyrfpack render city-scene -o walk --cameras walk.json --gaussians 500000
    """
    file = resolve_model_file(model)
    from hyrfpack.format import describe_file
    from hyrfpack.lod import split_model

    scene = None if data is None else read_scene(data, reader_options, file, describe_file(file), must_match=True)
    report = split_model(model, output, SplitConfig(**settings), data=scene, overwrite=overwrite)
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
        f"{report.folder}: {format_count(report.chunks, 'chunk')}, {report.bytes:,} bytes; the finest level takes "
        f"{report.bytes_finest:,} bytes, the model {report.bytes_source:,}"
    )

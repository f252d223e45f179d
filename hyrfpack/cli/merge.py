"""The command `hyrfpack merge`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from hyrfpack.cli.common import (
    format_table,
    json_option,
    note_rename,
    overwrite_option,
    print_json,
    resolve_model_file,
)
from hyrfpack.cli.ordered import OrderedCommand, options_in_order
from hyrfpack.cli.types import INPUT_PATH, OUTPUT, NamedNumbers
from hyrfpack.config.edit import Move, Rotate, Scale, Translate

_ACTION_BY_OPTION: dict[str, Callable[[Any], Move]] = {
    "translate": Translate,
    "rotate": lambda numbers: Rotate(numbers[:3], numbers[3]),
    "scale": lambda numbers: Scale(numbers[0]),
}


@click.command(short_help="Put several models into one file.", cls=OrderedCommand)
@click.argument("models", type=INPUT_PATH, nargs=-1, required=True)
@click.option("-o", "--output", type=OUTPUT, metavar="FILE", required=True, help="The .hyrf file to write.")
@click.option("--translate", type=NamedNumbers(3, "X,Y,Z"), multiple=True, help="Move the model NAME.")
@click.option(
    "--rotate",
    type=NamedNumbers(4, "X,Y,Z,DEGREES"),
    multiple=True,
    help="Rotate the model NAME about the axis X,Y,Z through the origin, by the right-hand rule.",
)
@click.option("--scale", type=NamedNumbers(1, "FACTOR"), multiple=True, help="Scale the model NAME about the origin.")
@overwrite_option
@json_option
@click.pass_context
def merge(
    ctx: click.Context, models: tuple[Path, ...], output: Path, overwrite: bool, as_json: bool, **values: Any
) -> None:
    """Put MODELS, .hyrf files or folders of runs, into one file, in which they are drawn together.

    The first model is the scene: its background and its viewpoint are those of the file. NAME is the name of a file
    without its folder and ending, or that of a run's folder. Moves are applied in the order in which they are given.
    The models themselves are copied unchanged.

    \b
    Examples:
      hyrfpack merge room.hyrf chair.hyrf -o furnished.hyrf
      hyrfpack merge room.hyrf chair.hyrf -o furnished.hyrf --scale chair=0.4 --translate chair=1.5,0,2
      hyrfpack merge room.hyrf chair.hyrf -o furnished.hyrf --rotate chair=0,1,0,90
      hyrfpack merge furnished.hyrf lamp.hyrf -o lit.hyrf
    """
    moves: dict[str, list[Move]] = {}
    for option, (name, numbers) in options_in_order(ctx, values):
        try:
            moves.setdefault(name, []).append(_ACTION_BY_OPTION[option](numbers))
        except ValueError as error:
            raise click.UsageError(f"--{option}: {error}") from error
    for path in models:
        resolve_model_file(path)  # raises an error for splats, which names the command that imports them
    from hyrfpack.edit import merge_models

    report = merge_models(models, output, moves, overwrite=overwrite)
    note_rename(output, report.file)
    if as_json:
        print_json(report.to_dict())
        return
    rows = [[part.name, f"{part.gaussians:,}", f"{part.bytes:,}"] for part in report.parts]
    click.echo(format_table(["part", "Gaussians", "bytes"], rows))
    click.echo(f"{report.file}: {report.bytes:,} bytes")

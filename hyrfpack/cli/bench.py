"""The command `hyrfpack bench`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import click

from hyrfpack.choices import BENCH_GROUPS
from hyrfpack.cli.common import (
    format_table,
    json_option,
    note,
    note_rename,
    overwrite_option,
    print_json,
    read_scene,
    resolve_model_file,
    scene_options,
)
from hyrfpack.cli.console import notes_only_of
from hyrfpack.cli.types import INPUT_PATH, OUTPUT
from hyrfpack.errors import HyrfError
from hyrfpack.outputs import Outputs


@click.command(short_help="Measure speed and error.")
@click.argument("model", type=INPUT_PATH, required=False)
@click.option("--data", type=INPUT_PATH, metavar="DIR", help="Photos and poses; the held-out photos measure quality.")
@scene_options
@click.option(
    "--repeats",
    type=click.IntRange(min=1),
    metavar="N",
    default=7,
    show_default=True,
    help="Timed runs of each variant.",
)
@click.option(
    "--only", type=click.Choice(BENCH_GROUPS), multiple=True, help="Measure only this group. May be repeated."
)
@click.option(
    "-o",
    "--output",
    type=OUTPUT,
    default=Path("bench.png"),
    show_default=True,
    help="Plot to write, time against error.",
)
@click.option(
    "--markdown",
    type=OUTPUT,
    metavar="FILE",
    help="Also write the tables to this Markdown file, between the marks that an existing FILE has for them.",
)
@overwrite_option
@json_option
def bench(
    model: Path | None,
    data: Path | None,
    reader_options: dict[str, Any],
    repeats: int,
    only: tuple[str, ...],
    output: Path,
    markdown: Path | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Measure the time and the error of each operation, and of each setting that trades accuracy for time, on the CPU.

    MODEL is the folder of a run or a .hyrf file. Without MODEL, a small model is first trained on a synthetic scene,
    which takes about a minute. Quality is given as PSNR and SSIM: against the held-out photos of --data, or without
    photos against exact renders of the model. --json prints all numbers, including some that the tables leave out.

    \b
    Examples:
      hyrfpack bench
      hyrfpack bench runs/bonsai --data photos/bonsai -o bonsai-speed.png
      hyrfpack bench runs/bonsai --only render --only codec --json > numbers.json
    """
    if data is not None and model is None:
        raise click.UsageError("--data gives the photos of a MODEL; name the MODEL, too")
    # The references run on torch's own threads, which would keep spinning on the cores of the kernels timed next.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    from hyrfpack.atomic import write_atomic
    from hyrfpack.bench import tables
    from hyrfpack.bench.figure import choose_plot_format, plot
    from hyrfpack.bench.suite import benchmark_model
    from hyrfpack.evaluate.figures import require_matplotlib
    from hyrfpack.format import describe_file
    from hyrfpack.format.input_folder import find_input_folder
    from hyrfpack.measure.machine import format_machine

    model = None if model is None else resolve_model_file(model)
    choose_plot_format(output)
    require_matplotlib()
    scene = None if data is None or model is None else read_scene(data, reader_options, model, describe_file(model))
    folder = None if model is None else find_input_folder(model)
    outputs = Outputs(model, folders=[folder], scene=scene, overwrite=overwrite)
    outputs.file(output)
    page, _ = _read_page(markdown)
    if page:  # check before minutes of work that the page has a place for each table
        tables.fill_page(page, dict.fromkeys(("machine", *(only or BENCH_GROUPS)), ""), str(markdown))
    if markdown is not None:  # an existing page with places is filled, which needs no permission to overwrite
        Outputs(model, folders=[folder], scene=scene, overwrite=overwrite or bool(page)).file(markdown)
    with notes_only_of("hyrfpack.bench"):
        result = benchmark_model(model, scene, repeats=repeats, only=only or None)
    if as_json:
        print_json(result.to_dict())
    else:
        click.echo(f"{format_machine(result.machine)}\n{result.subject}")
        for part in tables.build_tables(result.rows):
            click.echo(f"\n{part.title}\n{format_table(part.header, part.cells)}")
        for sentence in result.notes:
            click.echo(f"\nnote: {sentence}")
    note(f"{note_rename(output, plot(result.rows, output, overwrite=overwrite))}: time against error")
    if markdown is not None:
        blocks = tables.format_markdown(result)
        # It is read again, because it may have been edited during the measurements.
        page, line_end = _read_page(markdown) if page else ("", "\n")
        filled = tables.fill_page(page or tables.empty_page(blocks), blocks, str(markdown))
        content = filled.replace("\n", line_end).encode()
        note_rename(markdown, write_atomic(markdown, content, overwrite=overwrite or bool(page)))


def _read_page(path: Path | None) -> tuple[str, str]:
    """Return the text of a Markdown file, whose lines end with "\\n", and the end of its lines; "" without a file."""
    if path is None or not path.exists():
        return "", "\n"
    try:
        text = path.read_bytes().decode("utf-8")
        return text.replace("\r\n", "\n"), "\r\n" if "\r\n" in text else "\n"
    except (OSError, ValueError) as error:
        raise HyrfError(f"{path}: the page cannot be read ({error})", fix="name another with --markdown") from error

"""The command `hyrfpack convert`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from hyrfpack.cli.common import format_table, json_option, note_rename, overwrite_option, print_json
from hyrfpack.cli.export import crop_option
from hyrfpack.cli.settings import settings_options
from hyrfpack.cli.types import INPUT_PATH, OUTPUT
from hyrfpack.config.export import ConvertConfig

if TYPE_CHECKING:
    from hyrfpack.export import ConversionReport


@click.command(short_help="Convert splats between formats.")
@click.argument("source", type=INPUT_PATH)
@click.argument("target", type=OUTPUT)
@settings_options(ConvertConfig, "degree")
@crop_option
@settings_options(ConvertConfig, "min_opacity", "spz_version")
@overwrite_option
@json_option
def convert(
    source: Path,
    target: Path,
    overwrite: bool,
    as_json: bool,
    **settings: Any,
) -> None:
    """Convert SOURCE, 3D Gaussians of another program, to the format that the extension of TARGET names.

    SOURCE is a .ply (plain or compressed), .splat, .spz or .sog file, or the folder of a SOG that is not bundled.
    TARGET is a .ply, .splat, .spz, .sog, .glb, .usda, .usdc or .usdz file. Axes and units stay the same. The result is
    checked: 12 renders of the written file are compared with the same renders of SOURCE.

    \b
    Examples:
      hyrfpack convert scene.ply scene.spz
      hyrfpack convert scene.ply small.sog --sh-degree 1 --min-opacity 0.02
      hyrfpack convert scene.spz table.ply --crop -1,-1,-1,1,1,1
    """
    from hyrfpack.export.conversion import convert_splats

    report = convert_splats(source, target, ConvertConfig(**settings), overwrite=overwrite)
    note_rename(target, report.file)
    if as_json:
        print_json(report.to_dict())
        return
    _print_report(source, report)


def _print_report(source: Path, report: ConversionReport) -> None:
    rows = [
        [source.name, f"{report.gaussians_before:,}", str(report.degree_before), f"{report.bytes_before:,}"],
        [Path(report.file).name, f"{report.gaussians_after:,}", str(report.degree_after), f"{report.bytes_after:,}"],
    ]
    click.echo(format_table(["file", "Gaussians", "SH degree", "bytes"], rows))
    click.echo(
        f"PSNR against renders of {source.name}, {report.views} views: mean {report.psnr:.2f} dB, worst "
        f"{report.psnr_worst:.2f} dB"
    )

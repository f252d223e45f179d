"""`hyrfpack export`."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from hyrfpack.cli.common import (
    OUTPUT,
    PATH,
    json_option,
    note,
    overwrite_option,
    print_json,
    read_scene,
    scene_options,
    table,
)
from hyrfpack.outputs import Outputs

if TYPE_CHECKING:
    from hyrfpack.export import ExportReport


class _Box(click.ParamType):
    """Six numbers with commas between: the least x, y, z, then the greatest."""

    name = "box"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, ...]:
        try:
            numbers = tuple(float(part) for part in str(value).split(","))
        except ValueError:
            numbers = ()
        if len(numbers) != 6 or any(map(math.isnan, numbers)):
            self.fail(f"'{value}' is not a box; write it as MINX,MINY,MINZ,MAXX,MAXY,MAXZ in world units", param, ctx)
        if any(low > high for low, high in zip(numbers[:3], numbers[3:], strict=True)):
            self.fail(f"'{value}' is turned inside out; give the least x, y and z first", param, ctx)
        return numbers


degree_option = click.option(
    "--sh-degree",
    "degree",
    type=click.IntRange(0, 3),
    default=3,
    show_default=True,
    help="Of the spherical harmonics: how finely colour follows the direction. A .splat has 0.",
)


@click.command(short_help="Write a model for other programs.")
@click.argument("model", type=PATH)
@click.option("-o", "--output", type=OUTPUT, required=True, metavar="FILE", help="What to write; its ending says how.")
@degree_option
@click.option(
    "--crop",
    type=_Box(),
    metavar="BOX",
    help="Keep what is in MINX,MINY,MINZ,MAXX,MAXY,MAXZ, world units, without the background.",
)
@click.option(
    "--min-opacity", type=click.FloatRange(0, 1), default=0.0, show_default=True, help="Leave out fainter Gaussians."
)
@click.option("--background/--no-background", default=True, help="Take the background along.  [default: do]")
@click.option(
    "--data", type=PATH, help="Photos of the scene: for a file that keeps no cameras, and to score held-out ones."
)
@click.option("--spz-version", type=click.Choice(["3", "4"]), default="3", show_default=True, help="Of .spz files.")
@overwrite_option
@scene_options
@json_option
def export(
    model: Path,
    output: Path,
    degree: int,
    crop: tuple[float, ...] | None,
    min_opacity: float,
    background: bool,
    spz_version: str,
    data: Path | None,
    overwrite: bool,
    reading: dict[str, Any],
    as_json: bool,
) -> None:
    """Write MODEL, a .hyrf file, as what other programs read, and say what was lost on the way.

    \b
    The ending of -o is the format:
      .ply .splat .spz .sog .glb .usda .usdc .usdz    3D Gaussians with spherical harmonics
      .html                                           a page that shows the scene in any browser
      .points.ply .points.glb                         centres as points, cameras as frusta
      .json, or a folder                              cameras: transforms.json, or a COLMAP model

    Everything stays in the axes and units of the photos' poses.

    \b
    Examples:
      hyrfpack export bonsai.hyrf -o bonsai.html
      hyrfpack export runs/bonsai/model.hyrf -o bonsai.spz --sh-degree 2
      hyrfpack export bonsai.hyrf -o bonsai.ply --data photos/bonsai --min-opacity 0.02
      hyrfpack export bonsai.hyrf -o table.glb --crop -1,-1,-1,1,1,1
    """
    from hyrfpack.export import export as write
    from hyrfpack.export.kinds import check_place
    from hyrfpack.format import describe

    scene = None if data is None else read_scene(data, reading, describe(model))
    check_place(output, Outputs(model, scene=scene, overwrite=overwrite))
    report = write(
        model,
        output,
        degree=degree,
        data=scene,
        crop=crop,
        min_opacity=min_opacity,
        background=background,
        spz_version=int(spz_version),
        say=note,
    )
    if as_json:
        print_json(asdict(report))
        return
    _print(report)


def _print(report: ExportReport) -> None:
    if report.views:
        rows = [[f"degree {degree}", f"{score:.2f}"] for degree, score in report.by_degree.items()]
        rows.append([f"the file, degree {report.degree}", f"{report.psnr:.2f}"])
        click.echo(table([f"against the model, {report.views} views", "PSNR (dB)"], rows))
    behind = f", {report.background:,} of them for the background" if report.background else ""
    holds = f", {report.gaussians:,} Gaussians{behind}" if report.gaussians else ""
    cameras = f", {report.cameras:,} cameras" if report.cameras else ""
    click.echo(f"{report.file}: {report.bytes:,} bytes{holds}{cameras}")
    if report.photos_model is not None:
        click.echo(f"held-out photos: PSNR {report.photos_model:.3f} to {report.photos_file:.3f} dB")

"""The command `hyrfpack export`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from hyrfpack.cli.common import (
    format_table,
    json_option,
    note_rename,
    overwrite_option,
    print_json,
    read_scene,
    scene_options,
    suggest_model_name,
)
from hyrfpack.cli.settings import settings_options
from hyrfpack.cli.types import BOX, HARMONICS_DEGREE, INPUT_PATH, OUTPUT
from hyrfpack.config.export import ExportConfig
from hyrfpack.counts import format_count
from hyrfpack.errors import HyrfError, suggest_command
from hyrfpack.outputs import Outputs

if TYPE_CHECKING:
    from hyrfpack.export import ExportReport
    from hyrfpack.scene import Scene
    from hyrfpack.splats.table import FileKind


crop_option = click.option(
    "--crop",
    type=BOX,
    metavar="BOX",
    help="Keep only the Gaussians inside MINX,MINY,MINZ,MAXX,MAXY,MAXZ (world units), without the background.",
)


@click.command(short_help="Export a model to formats of other programs.")
@click.argument("models", metavar="[MODEL]...", type=INPUT_PATH, nargs=-1)
@click.option(
    "-o",
    "--output",
    type=OUTPUT,
    required=True,
    metavar="FILE",
    help="File or folder to write. Its extension names the format.",
)
@settings_options(ExportConfig, "baked", "colmap", "streamed_sog", "tiles_3d", "tile_content")
@click.option(
    "--sh-degree",
    "degree",
    type=HARMONICS_DEGREE,
    default="auto",
    show_default=True,
    metavar="0-3|auto",
    help="Degree of the spherical harmonics that colours are baked to; auto takes the lowest within 0.2 dB of the "
    "best. A .splat has degree 0.",
)
@crop_option
@settings_options(ExportConfig, "min_opacity", "background", "exposure")
@click.option("--title", metavar="TEXT", help="Title of a page, a player or a gallery.  [default: its name]")
@click.option("--credit", default="", metavar="TEXT", help="Text below the title, such as the author and the licence.")
@settings_options(ExportConfig, "editable")
@click.option(
    "--data",
    type=INPUT_PATH,
    multiple=True,
    help="Photos and poses of the scene: cameras for a file that stores none, and held-out photos to score the result. "
    "For a gallery, give it once for each MODEL.",
)
@settings_options(ExportConfig, "spz_version", "voxel", "faces")
@overwrite_option
@scene_options
@json_option
def export(
    models: tuple[Path, ...],
    output: Path,
    data: tuple[Path, ...],
    overwrite: bool,
    reader_options: dict[str, Any],
    as_json: bool,
    **settings: Any,
) -> None:
    """Export MODEL, a .hyrf file or the folder of a run, to a format of other programs, and report the loss of quality.

    \b
    The extension of -o selects the format:
      .html                                           a page that shows the neural model in any browser
      a folder                                        the player and the model, for a web server
      .ply .splat .spz .sog .glb .usda .usdc .usdz    3D Gaussians with spherical harmonics
      .points.ply .points.glb                         centres as points, cameras as frusta
      .mesh.glb .mesh.ply .obj .stl                   the surface as triangles with vertex colours
      .collision.glb .collision.obj .collision.stl    a closed mesh of few triangles for physics engines
      .json, or a folder with --colmap                cameras: transforms.json, or a COLMAP model
      a folder with --streamed-sog or --3d-tiles      levels of detail that other programs stream

    Several models exported to a folder make a gallery. Without a model, the folder gets a player that opens the files
    that are dropped on it. Splats (.ply .spz .splat .sog) can be exported to a player folder, too. Levels of detail
    come from a scene folder ('hyrfpack split'). Axes and units are those of the photos' poses.

    \b
    Examples:
      hyrfpack export bonsai.hyrf -o bonsai.html
      hyrfpack export bonsai.hyrf -o player/
      hyrfpack export bonsai.hyrf room.hyrf -o gallery/
      hyrfpack export runs/bonsai -o bonsai.spz --sh-degree 2
      hyrfpack export bonsai.hyrf -o bonsai.ply --data photos/bonsai --min-opacity 0.02
      hyrfpack export bonsai.hyrf -o table.glb --crop -1,-1,-1,1,1,1
      hyrfpack export bonsai.hyrf -o bonsai.mesh.glb --faces 200000
      hyrfpack export bonsai.hyrf -o bonsai.collision.glb
      hyrfpack export bonsai-scene -o streamed/ --streamed-sog
      hyrfpack export bonsai-scene -o tiles/ --3d-tiles
    """
    from hyrfpack.export.folder import check_export_folder
    from hyrfpack.export.kinds import PLAYER_FOLDER, check_export_target, check_request, find_file_kind
    from hyrfpack.format import describe_file
    from hyrfpack.format.input_folder import find_input_folder

    config = ExportConfig(**settings)
    kind = find_file_kind(output, config)
    files = _find_model_files(models, data, output, kind)
    check_request(kind, output, config)
    scenes = [
        read_scene(path, reader_options, model, describe_file(model), must_match=True)
        for path, model in zip(data, files, strict=False)
    ]
    if kind is PLAYER_FOLDER:
        check_export_folder(output, models, scenes, overwrite=overwrite, is_gallery=len(models) > 1)
    else:
        folder, scene = find_input_folder(files[0]), scenes[0] if scenes else None
        check_export_target(output, Outputs(*files, folders=[folder], scene=scene, overwrite=overwrite), config)
    report = _write_export(models, scenes, output, config, overwrite=overwrite)
    note_rename(output, report.file)
    if as_json:
        print_json(asdict(report))
        return
    _print_report(report)


def _find_model_files(models: Sequence[Path], data: Sequence[Path], output: Path, kind: FileKind) -> list[Path]:
    """Return the file of each MODEL: that of a run, and splats as they are.

    Raises:
        HyrfError: the output takes another number of models, no splats, or the models other photos.
    """
    from hyrfpack.export.kinds import PLAYER_FOLDER
    from hyrfpack.format import find_model
    from hyrfpack.splats.names import is_splats

    if len(models) != 1 and kind is not PLAYER_FOLDER:
        what = "there is no MODEL to write" if not models else "several models make a gallery, which is a folder"
        raise HyrfError(f"{output}: {what}", fix="name one MODEL")
    splats = [model for model in models if is_splats(model)]
    if splats and kind is not PLAYER_FOLDER:
        raise _splats_error(splats[0], output, kind)
    files = [model if model in splats else find_model(model) for model in models]
    if splats and data:
        raise HyrfError(f"{splats[0]}: photos go with .hyrf files only", fix="leave out --data, or this file")
    if data and len(data) != len(models):
        raise HyrfError(
            f"--data is given {format_count(len(data), 'time')} for {format_count(len(models), 'model')}",
            fix="give it once for each model, or not at all",
        )
    return files


def _write_export(
    models: Sequence[Path], scenes: Sequence[Scene], output: Path, config: ExportConfig, *, overwrite: bool
) -> ExportReport:
    """Write a gallery of several models, a player without any, or the export of one."""
    from hyrfpack.export import export_gallery, export_model, export_player

    texts: dict[str, Any] = {"title": config.title, "credit": config.credit, "editable": config.editable}
    if len(models) > 1:
        return export_gallery(models, output, data=scenes, overwrite=overwrite, **texts)
    if not models:
        return export_player(None, output, overwrite=overwrite, **texts)
    return export_model(models[0], output, config, data=scenes[0] if scenes else None, overwrite=overwrite)


def _splats_error(source: Path, output: Path, kind: FileKind) -> HyrfError:
    """Return the error that names the right command for splats of another program."""
    from hyrfpack.splats.table import FORMATS

    if kind.ending in FORMATS:
        return HyrfError(
            f"{source}: these are splats, not a model",
            fix=f"convert them with {suggest_command('convert', source, output)}",
        )
    return HyrfError(
        f"{source}: only a folder (-o player/) can play splats",
        fix=f"to write {kind.ending or 'this'}, import them first: "
        f"{suggest_command('import', source, '-o', suggest_model_name(source))}",
    )


def _print_exposures(report: ExportReport) -> None:
    """Print a table of the PSNR of baked splats with local and with consistent exposure."""
    photos = report.photos_by_exposure
    head = ["exposure of baked splats, before writing", "PSNR (dB), renders as photographed"]
    rows = [
        [f"{name}{' (in the file)' if name == report.exposure else ''}", f"{psnr:.2f}"]
        + ([f"{photos[name]:.2f}"] if photos else [])
        for name, psnr in report.psnr_by_exposure.items()
    ]
    click.echo(format_table(head + (["PSNR (dB), held-out photos"] if photos else []), rows))


def _print_report(report: ExportReport) -> None:
    """Print the scores of an export, what was written, and the size of it."""
    if report.native:
        click.echo(
            f"{report.file}: {report.bytes:,} bytes, {format_count(report.gaussians, 'Gaussian')}, unchanged: "
            "nothing is baked"
        )
        return
    ending = Path(report.file).suffix
    written_kind, rounding = ("folder, finest level", "the format") if report.chunks else (f"{ending} file", ending)
    if report.views:
        rows = [
            [f"baked to harmonics of degree {report.degree}, before writing", f"{report.psnr_baked:.2f}"],
            [f"read back from the {written_kind}", f"{report.psnr:.2f}"],
        ]
        click.echo(
            format_table([f"against renders of the model, {format_count(report.views, 'view')}", "PSNR (dB)"], rows)
        )
        click.echo(
            f"the first row shows the loss by baking, the second the loss by baking and by the rounding of {rounding} "
            "together; neither compares with photos"
        )
        if report.views_fitted:
            click.echo(
                "the file keeps so few cameras that colours were fitted at these views, too; other views have a lower "
                "PSNR (name photos with --data to measure at held-out ones)"
            )
    if report.psnr_by_exposure:
        _print_exposures(report)
    background_text = f", {report.background:,} of them for the background" if report.background else ""
    gaussians_text = f", {format_count(report.gaussians, 'Gaussian')}{background_text}" if report.gaussians else ""
    cameras = f", {format_count(report.cameras, 'camera')}" if report.cameras else ""
    mesh = f", {report.vertices:,} vertices, {format_count(report.faces, 'triangle')}" if report.faces else ""
    voxels = f", voxels of {report.voxel:.4g} units" if report.voxel else ""
    click.echo(f"{report.file}: {report.bytes:,} bytes{gaussians_text}{cameras}{mesh}{voxels}")
    if report.chunks:
        levels = ", ".join(f"{count:,}" for count in report.level_gaussians)
        click.echo(f"{format_count(report.chunks, 'chunk')}; Gaussians at each level, without the background: {levels}")
    if report.surface_to_mesh and report.mesh_to_surface and report.wall:
        distances_by_direction = {"surface to mesh": report.surface_to_mesh, "mesh to surface": report.mesh_to_surface}
        rows = [
            [direction, *(f"{distance:.4g}" for distance in distances)]
            for direction, distances in distances_by_direction.items()
        ]
        click.echo(format_table(["distance, units", "mean", "95 %"], rows))
        click.echo(f"the mesh is closed; behind the surface it has walls of {report.wall:.4g} units")
    if report.photos_model is not None:
        click.echo(
            f"PSNR against held-out photos: model {report.photos_model:.3f} dB, file {report.photos_file:.3f} dB"
        )

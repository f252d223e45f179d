"""The command `hyrfpack import`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from hyrfpack.cli.common import (
    choose_command_device,
    device_option,
    format_table,
    json_option,
    note,
    note_rename,
    overwrite_option,
    print_json,
)
from hyrfpack.cli.settings import settings_options
from hyrfpack.cli.types import INPUT_PATH, OUTPUT
from hyrfpack.config.imports import ImportConfig
from hyrfpack.counts import format_count

if TYPE_CHECKING:
    from hyrfpack.imports import ImportReport
    from hyrfpack.scene import Camera, Scene


@click.command("import", short_help="Compress splats of another program to a small model.")
@click.argument("source", type=INPUT_PATH)
@click.option("-o", "--output", type=OUTPUT, required=True, metavar="FILE", help="The .hyrf file to write.")
@settings_options(ImportConfig, "psnr", "worst", "target_bytes", "size")
@click.option(
    "--cameras",
    type=INPUT_PATH,
    metavar="PATH",
    help="Cameras to measure at: a JSON file (also of nerfstudio or 3DGS), or a folder of photos and poses.",
)
@settings_options(ImportConfig, "seed")
@device_option
@overwrite_option
@json_option
def import_(
    source: Path,
    output: Path,
    cameras: Path | None,
    device: str,
    overwrite: bool,
    as_json: bool,
    **settings: Any,
) -> None:
    """Compress SOURCE, 3D Gaussians as .ply (plain or compressed), .splat, .spz or .sog, to a small .hyrf file.

    No photos are needed: what each number is worth is measured on renders of SOURCE, from all around an object or from
    inside a room. --cameras names the viewpoints to render instead; it reads the files of 'hyrfpack render --cameras'
    and the folders of --data. A cameras.json that 3DGS training has left with SOURCE is used automatically. Scores are
    measured at held-out viewpoints.

    \b
    Examples:
      hyrfpack import scene.ply -o scene.hyrf
      hyrfpack import scene.spz -o scene.hyrf --psnr 45
      hyrfpack import scene.spz -o scene.hyrf --target-size 2MB
      hyrfpack import room.ply -o room.hyrf --cameras photos/room --size 800
    """
    from hyrfpack.context import RunContext
    from hyrfpack.imports import import_splats
    from hyrfpack.imports.run import check_target

    config = ImportConfig(**settings)
    check_target(source, output, cameras, overwrite=overwrite)  # before the cameras are read
    cameras = cameras or _find_training_cameras(source)
    known_cameras, scene = (None, None) if cameras is None else _read_cameras(cameras)
    check_target(source, output, cameras, scene=scene, overwrite=overwrite)
    torch_device = choose_command_device(device)
    context = RunContext(device=torch_device)
    report = import_splats(source, output, config, cameras=known_cameras, overwrite=overwrite, context=context)
    written_path = note_rename(output, report.file)
    if as_json:
        print_json(report.to_dict())
        return
    rows = [
        [
            source.name,
            f"{report.gaussians_before:,}",
            f"{report.bytes_source:,}",
            _format_ratio(report, report.bytes_source),
        ],
        ["as PLY", f"{report.gaussians_before:,}", f"{report.bytes_ply:,}", _format_ratio(report, report.bytes_ply)],
        [written_path.name, f"{report.gaussians_after:,}", f"{report.bytes_after:,}", ""],
    ]
    click.echo(format_table(["file", "Gaussians", "bytes", "smaller by"], rows))
    click.echo(
        f"PSNR against renders of {source.name}, {format_count(report.views, 'held-out view')}: mean "
        f"{report.psnr:.2f} dB, worst {report.psnr_worst:.2f} dB; took {report.seconds:.0f} s"
    )


def _find_training_cameras(source: Path) -> Path | None:
    """Return the cameras.json that 3DGS training wrote together with these splats; None if there is none.

    3DGS training writes cameras.json and point_cloud/iteration_30000/point_cloud.ply into one folder.
    """
    folders = source.absolute().parents[2:3]
    if source.name != "point_cloud.ply" or not folders or not (folders[0] / "cameras.json").is_file():
        return None
    note(f"using the cameras of the training: {folders[0] / 'cameras.json'}")
    return folders[0] / "cameras.json"


def _read_cameras(path: Path) -> tuple[list[Camera], Scene | None]:
    """Read the cameras of a JSON file, or of a folder or archive of photos and poses, which is returned, too."""
    from hyrfpack.cameras.files import cameras_from_json
    from hyrfpack.data import load_scene
    from hyrfpack.data.archive import is_archive

    if path.is_dir() or is_archive(path):
        scene = load_scene(path)
        for sentence in scene.notes:
            note(sentence)
        return [view.camera for view in scene.views], scene
    return [camera for _, camera in cameras_from_json(path)], None


def _format_ratio(report: ImportReport, size: int | None) -> str:
    """Return as text how many times larger a size is than the written file; "" if the size is None."""
    return "" if size is None else f"{size / report.bytes_after:.1f}x"

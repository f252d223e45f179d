"""The command `hyrfpack make`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from hyrfpack.cli.common import (
    choose_command_device,
    device_option,
    format_consistent_psnr,
    json_option,
    note,
    note_rename,
    overwrite_option,
    print_json,
)
from hyrfpack.cli.console import notes_only_of
from hyrfpack.cli.live import check_view_options, serve_training_view, view_options
from hyrfpack.cli.settings import reject_two_sizes, settings_options
from hyrfpack.cli.types import INPUT_PATH, OUTPUT, OUTPUT_FOLDER
from hyrfpack.config.make import MakeConfig
from hyrfpack.counts import format_count
from hyrfpack.errors import printable, suggest_command

if TYPE_CHECKING:
    from hyrfpack.make import MakeResult

# Photos without a pose that are listed; the others are only counted.
MAX_LISTED_PHOTOS = 5


@click.command(short_help="Make a scene from photos, end to end.")
@click.argument("photos", type=INPUT_PATH)
@click.option("-o", "--output", type=OUTPUT, required=True, metavar="FILE", help="File or folder to make.")
@settings_options(MakeConfig, "quality", "minutes", "target_bytes", "max_gaussians", "preset", "matching")
@settings_options(MakeConfig, "images", "max_size", "test_every")
@click.option(
    "--work",
    type=OUTPUT_FOLDER,
    metavar="DIR",
    help="Folder of intermediate results.  [default: the name of FILE with .work]",
)
@device_option
@settings_options(MakeConfig, "seed")
@view_options
@overwrite_option
@json_option
def make(
    photos: Path,
    output: Path,
    work: Path | None,
    device: str,
    view: bool,
    view_port: int | None,
    overwrite: bool,
    as_json: bool,
    **settings: Any,
) -> None:
    """Make a scene from PHOTOS: estimate poses if there are none, train, compress, score and export.

    PHOTOS is a folder or its .zip, a video, splats of another program (.ply .splat .spz .sog), or a .hyrf file.
    The extension of FILE names the format: .hyrf, .html or any other that 'hyrfpack export' writes, except .json. A
    FILE without an extension becomes a folder with a player.

    The results of each stage are kept. After an interruption (Ctrl-C, exit code 1), the same command resumes. If the
    training was interrupted, the scene so far is packed first.

    \b
    Examples:
      hyrfpack make photos/ -o scene.html
      hyrfpack make clip.mp4 -o scene.hyrf --minutes 20
      hyrfpack make photos/bonsai -o bonsai.spz --quality best
      hyrfpack make other.ply -o scene.html
    """
    config = MakeConfig(**settings)
    if config.quality is not None and config.minutes is not None:
        raise click.UsageError("--quality and --minutes each decide how long to work; give one of them")
    reject_two_sizes(**settings)
    check_view_options(view, view_port)
    from hyrfpack.context import RunContext
    from hyrfpack.make import Stopped
    from hyrfpack.make.run import make_observed_scene

    torch_device = choose_command_device(device)
    try:
        with notes_only_of("hyrfpack.make", "hyrfpack.poses", "hyrfpack.live", silent=("hyrfpack.imports.run",)):
            result = make_observed_scene(
                photos,
                output,
                config,
                work=work,
                overwrite=overwrite,
                observing=serve_training_view(output.name, view, view_port) if view else None,
                context=RunContext(device=torch_device),
            )
    except Stopped as stop:
        scene_text = f"; the scene so far: {stop.scene}" if stop.scene else ""
        note(f"stopped in {stop.stage}; the same command resumes{scene_text}")
        click.get_current_context().exit(1)
    note_rename(output, result.output)
    if as_json:
        print_json(result.to_dict())
        return
    _print_result(result)


def _print_result(result: MakeResult) -> None:
    """Print a summary of the result.

    Doubts about poses have been printed as they came up, and the work folder holds all figures.
    """
    poses = result.poses
    if poses:
        sure = f", {poses['sure']} confirmed by both mappers" if poses["sure"] < poses["registered"] else ""
        click.echo(f"poses: {poses['registered']} of {poses['photos']} photos{sure}")
        for name, reason in list(poses["left_out"].items())[:MAX_LISTED_PHOTOS]:
            click.echo(f"  left out: {printable(name)}, {reason}")
        if (unlisted_count := len(poses["left_out"]) - MAX_LISTED_PHOTOS) > 0:
            click.echo(f"  left out: {unlisted_count} more, see {result.work / 'scene' / 'poses.json'}")
    times = ", ".join(f"{stage} {seconds:.0f} s" for stage, seconds in result.seconds.items())
    total = f"{result.total_seconds:.0f} s in all"
    click.echo(f"times: {times}, {total}; intermediate results are in {result.work}, which you may delete")
    if result.psnr is not None:
        consistent = format_consistent_psnr(result.psnr_consistent)
        photos = format_count(result.views, "photo")
        click.echo(f"{photos} held out: PSNR {result.psnr:.2f} dB{consistent}, SSIM {result.ssim:.4f}")
    elif result.training:
        click.echo("no photo is held out, so the scene is not scored")
    if result.note:
        click.echo(result.note)
    size = f"{result.bytes:,} bytes, {format_count(result.gaussians, 'Gaussian')}"
    click.echo(f"{result.output}: {size}; {_viewing_hint(result)}")


def _viewing_hint(result: MakeResult) -> str:
    """Return what the user can do to look at the result."""
    output = result.output
    if output.suffix.lower() == ".html":
        return "open it in a browser"
    if output.is_dir():
        return f"for any web server; see it with {suggest_command('view', result.model)}"
    from hyrfpack.export.kinds import find_kind_by_ending
    from hyrfpack.splats.names import SPLATS_SUFFIXES

    kind = find_kind_by_ending(output)
    viewable = output.suffix.lower() == ".hyrf" or (kind is not None and kind.ending in SPLATS_SUFFIXES)
    return f"see it with {suggest_command('view', output if viewable else result.model)}"

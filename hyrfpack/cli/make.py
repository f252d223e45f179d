"""The command `hyrfpack make`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from hyrfpack.choices import MATCHING_METHODS, QUALITIES
from hyrfpack.cli.common import (
    choose_command_device,
    format_consistent_psnr,
    json_option,
    note,
    note_rename,
    overwrite_option,
    print_json,
)
from hyrfpack.cli.console import notes_only_of
from hyrfpack.cli.live import serve_training_view, view_options
from hyrfpack.cli.settings import settings_options
from hyrfpack.cli.types import OUTPUT, PATH, SIZE, reject_nan
from hyrfpack.config.train import TrainConfig

if TYPE_CHECKING:
    from hyrfpack.make import MakeResult

# Photos without a pose that are listed; the others are only counted.
MAX_LISTED_PHOTOS = 5


@click.command(short_help="Make a scene from photos, end to end.")
@click.argument("photos", type=PATH)
@click.option("-o", "--output", type=OUTPUT, required=True, metavar="FILE", help="File or folder to make.")
@click.option("--quality", type=click.Choice(QUALITIES), help="Quality; a better one takes longer.  [default: normal]")
@click.option(
    "--minutes",
    type=click.FloatRange(min=0, min_open=True),
    callback=reject_nan,
    metavar="N",
    help="Instead of --quality: finish in about N minutes, including poses.",
)
@click.option("--target-size", type=SIZE, metavar="SIZE", help="Best quality within this file size, such as 2MB.")
@click.option(
    "--max-gaussians",
    type=click.IntRange(min=1),
    metavar="N",
    help="Budget: the maximum number of Gaussians, instead of --target-size.  [default: measured by pilot runs]",
)
@settings_options(TrainConfig, "preset")
@click.option(
    "--matching",
    type=click.Choice(MATCHING_METHODS),
    default="auto",
    show_default=True,
    help="Which pairs of photos are matched to estimate poses, see 'hyrfpack poses --help'.",
)
@click.option("--images", metavar="NAME", help="Folder of the photos within PHOTOS, such as images_4.")
@click.option(
    "--max-size",
    type=click.IntRange(min=0),
    metavar="PIXELS",
    help="Shrink photos whose longer side exceeds this; 0 keeps their size.  [default: 1600; of a draft, 640]",
)
@click.option(
    "--test-every",
    type=click.IntRange(min=0),
    metavar="N",
    help="Hold out every Nth photo for scoring; 0 holds out none.  [default: 8; of fewer than 16 photos, one photo]",
)
@click.option(
    "--work", type=OUTPUT, metavar="DIR", help="Folder of intermediate results.  [default: the name of FILE with .work]"
)
@click.option("--device", metavar="NAME", default="auto", show_default=True, help="Device: cpu, cuda, cuda:N.")
@settings_options(TrainConfig, "seed")
@view_options
@overwrite_option
@json_option
def make(
    photos: Path,
    output: Path,
    quality: str | None,
    minutes: float | None,
    target_size: int | None,
    max_gaussians: int | None,
    preset: str,
    matching: str,
    images: str | None,
    max_size: int | None,
    test_every: int | None,
    work: Path | None,
    device: str,
    seed: int,
    view: bool,
    view_port: int | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Make a scene from PHOTOS: estimate poses if there are none, train, compress, score and export.

    PHOTOS is a folder or its .zip, a video, splats of another program (.ply .splat .spz .sog), or a .hyrf file.
    The extension of FILE names the format: .hyrf, .html or any other that 'hyrfpack export' writes. A FILE without an
    extension becomes a folder with a player.

    The results of each stage are kept. After an interruption (Ctrl-C, exit code 1), the same command resumes.

    \b
    Examples:
      hyrfpack make photos/ -o scene.html
      hyrfpack make clip.mp4 -o scene.hyrf --minutes 20
      hyrfpack make photos/bonsai -o bonsai.spz --quality best
      hyrfpack make other.ply -o scene.html
    """
    if quality is not None and minutes is not None:
        raise click.UsageError("--quality and --minutes each decide how long to work; give one of them")
    if target_size is not None and max_gaussians is not None:
        raise click.UsageError("--max-gaussians and --target-size each decide how large the model is; give one of them")
    from hyrfpack.context import RunContext
    from hyrfpack.make import Stopped
    from hyrfpack.make import make_scene as run

    torch_device = choose_command_device(device)
    try:
        with (
            notes_only_of("hyrfpack.make", "hyrfpack.poses", "hyrfpack.live"),
            serve_training_view(output.name, view, view_port) as observer,
        ):
            result = run(
                photos,
                output,
                quality=quality or "normal",
                minutes=minutes,
                work=work,
                images=images,
                max_size=max_size,
                test_every=test_every,
                matching=matching,
                target_bytes=target_size,
                max_gaussians=max_gaussians,
                preset=preset,
                seed=seed,
                overwrite=overwrite,
                observer=observer,
                context=RunContext(device=torch_device),
            )
    except Stopped as stop:
        note(f"stopped in {stop.stage}; the same command resumes")
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
            click.echo(f"  left out: {name}, {reason}")
        if (more := len(poses["left_out"]) - MAX_LISTED_PHOTOS) > 0:
            click.echo(f"  left out: {more} more, see {result.work / 'scene' / 'poses.json'}")
    times = ", ".join(f"{stage} {seconds:.0f} s" for stage, seconds in result.seconds.items())
    total = f"{result.total_seconds:.0f} s in all"
    click.echo(f"times: {times}, {total}; intermediate results are in {result.work}, which you may delete")
    if result.psnr is not None:
        photos = f"{result.views} photo{'s' if result.views > 1 else ''}"
        consistent = format_consistent_psnr(result.psnr_consistent)
        click.echo(f"{photos} held out: PSNR {result.psnr:.2f} dB{consistent}, SSIM {result.ssim:.4f}")
    elif result.training:
        click.echo("no photo is held out, so the scene is not scored")
    if result.note:
        click.echo(result.note)
    click.echo(f"{result.output}: {result.bytes:,} bytes, {result.gaussians:,} Gaussians; {_viewing_hint(result)}")


def _viewing_hint(result: MakeResult) -> str:
    """Return what the user can do to look at the result."""
    output = result.output
    if output.suffix.lower() == ".html":
        return "open it in a browser"
    if output.is_dir():
        return f"for any web server; see it with 'hyrfpack view {result.model}'"
    viewable = output.suffix.lower() in (".hyrf", ".ply", ".splat", ".spz", ".sog") and ".points." not in output.name
    return f"see it with 'hyrfpack view {output if viewable else result.model}'"

"""The command `hyrfpack poses`."""

from __future__ import annotations

import shlex
from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from hyrfpack.cli.common import json_option, note, note_if_verbose, print_json
from hyrfpack.cli.settings import settings_options
from hyrfpack.cli.types import INPUT_PATH, OUTPUT_FOLDER
from hyrfpack.config.poses import PosesConfig
from hyrfpack.counts import format_count
from hyrfpack.errors import printable

if TYPE_CHECKING:
    from hyrfpack.poses import PosesReport

# Photos without a pose that are named for each reason; the others are counted.
_MAX_NAMED_PHOTOS = 5


@click.command(short_help="Estimate the camera poses of photos or a video.")
@click.argument("photos", type=INPUT_PATH)
@click.option("-o", "--output", "out", type=OUTPUT_FOLDER, required=True, metavar="SCENE", help="Folder of the scene.")
@settings_options(PosesConfig, "matching")
@click.option(
    "--masks", type=INPUT_PATH, metavar="FOLDER", help="Masks, named like the photos; black pixels are ignored."
)
@settings_options(PosesConfig, "seed")
@click.option("--overwrite", is_flag=True, help="Replace poses that an earlier run wrote to SCENE.")
@json_option
def poses(photos: Path, out: Path, masks: Path | None, overwrite: bool, as_json: bool, **settings: Any) -> None:
    """Estimate the poses of PHOTOS, a folder of photos, its .zip, or a video, and write a scene for 'hyrfpack train'.

    SCENE gets images/ (copies of the photos), sparse/0 (a COLMAP model) and poses.json (a report). PHOTOS may be SCENE
    itself; photos in its images/ stay as they are. Ctrl-C keeps finished stages, and the same command resumes.

    \b
    Examples:
      hyrfpack poses photos/ -o scenes/garden
      hyrfpack poses clip.mp4 -o scenes/clip
      hyrfpack train scenes/garden -o runs/garden
    """
    from hyrfpack.poses import estimate_poses

    try:
        result = estimate_poses(photos, out, PosesConfig(**settings), masks=masks, overwrite=overwrite)
    except KeyboardInterrupt:
        note("stopped; the same command resumes from here")
        click.get_current_context().exit(1)
    note_if_verbose("seconds: " + ", ".join(f"{stage} {seconds:.1f}" for stage, seconds in result.seconds.items()))
    if as_json:
        print_json(asdict(result) | {"scene": str(result.scene)})
    else:
        _print_result(result)


def _print_result(result: PosesReport) -> None:
    """Print how many photos have a pose, which were left out and why, and the next command."""
    of_photos = f"of {result.photos:,} photos"
    click.echo(
        f"{result.scene}: {format_count(result.registered, f'{of_photos} has', f'{of_photos} have')} a pose, "
        f"{result.sure} confirmed by both mappers; {result.why}"
    )
    for reason, count in Counter(result.left_out.values()).most_common():
        names = [name for name, why in result.left_out.items() if why == reason]
        others = f" and {count - _MAX_NAMED_PHOTOS} more" if count > _MAX_NAMED_PHOTOS else ""
        click.echo(f"left out, {reason}: {printable(', '.join(names[:_MAX_NAMED_PHOTOS]))}{others}")
    run = f"runs/{result.scene.resolve().name}"
    click.echo(f"next: hyrfpack train {shlex.quote(str(result.scene))} -o {shlex.quote(run)}")

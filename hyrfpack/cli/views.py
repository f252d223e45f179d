"""The commands `hyrfpack render` and `evaluate`."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from hyrfpack.choices import AS_PHOTOGRAPHED
from hyrfpack.cli.common import (
    OUTPUT,
    PATH,
    choose_command_device,
    device_options,
    exposure_option,
    format_consistent_psnr,
    format_table,
    json_option,
    largest_picture_size,
    note,
    note_rename,
    overwrite_option,
    print_json,
    read_scene,
    scene_options,
    select_views,
)
from hyrfpack.cli.processes import processes_option
from hyrfpack.cli.progress import show_item_progress, show_progress
from hyrfpack.outputs import Outputs

if TYPE_CHECKING:
    from collections.abc import Callable

    from hyrfpack.cli.render_source import RenderSource
    from hyrfpack.evaluate import Evaluation, ViewScore
    from hyrfpack.model import HybridModel
    from hyrfpack.parallel.ranks import Ranks
    from hyrfpack.render.files import ColorAndDepth
    from hyrfpack.scene import Camera, Scene, View
    from hyrfpack.splats.draw import Drawable

SPLITS = ("test", "train", "all")
DEFAULT_ORBIT_FRAMES = 60


@click.command(short_help="Render views to picture files.")
@click.argument("model", type=PATH)
@click.option("-o", "--output", type=OUTPUT, required=True, metavar="OUT", help="Folder of the pictures.")
@click.option("--data", type=PATH, help="Render the views of this folder of photos and poses.")
@click.option(
    "--split", type=click.Choice(SPLITS), default="test", show_default=True, help="Views of --data to render."
)
@scene_options
@click.option("--cameras", type=PATH, metavar="JSON", help="Render the cameras of this file.")
@click.option(
    "--orbit", type=click.IntRange(1, 100_000), metavar="N", help="Render an orbit of N frames around the scene."
)
@click.option("--depth", is_flag=True, help="Also write depth in world units (float32 TIFF).")
@click.option("--video", is_flag=True, help="Also write the frames as OUT/video.mp4 (needs ffmpeg).")
@click.option(
    "--allow-partial",
    is_flag=True,
    help="Accept a file that is cut short, if enough of it is there for a coarser model.",
)
@exposure_option
@overwrite_option
@processes_option
@device_options
@json_option
def render(
    model: Path,
    output: Path,
    data: Path | None,
    split: str,
    reader_options: dict[str, Any],
    cameras: Path | None,
    orbit: int | None,
    depth: bool,
    video: bool,
    allow_partial: bool,
    exposure: str,
    overwrite: bool,
    device: str,
    precision: str,
    as_json: bool,
    ranks: Ranks,
) -> None:
    """Render MODEL to PNG pictures: the views of photos, the cameras of a file, or by default an orbit of 60 frames.

    MODEL is a .hyrf file, the folder of a run, or splats (.ply .splat .spz .sog), which are drawn over black.

    The file of --cameras is a list of {"name", "width", "height", "fx", "fy", "cx", "cy", "camera_from_world": 4 x 4}
    with OpenCV axes, or a transforms.json in the format of nerfstudio.

    \b
    Examples:
      hyrfpack render bonsai.hyrf -o orbit --video
      hyrfpack render bonsai.hyrf -o out --data photos/bonsai --split test
      hyrfpack render bonsai.hyrf -o path --cameras path.json --depth
      hyrfpack render other.ply -o orbit --orbit 90
    """
    if sum(source is not None for source in (data, cameras, orbit)) > 1:
        raise click.UsageError("--data, --cameras and --orbit each say what to render; give one of them")
    from hyrfpack.cameras.files import cameras_from_json
    from hyrfpack.cameras.paths import orbit as orbit_around
    from hyrfpack.cli.render_source import RenderSource
    from hyrfpack.lock import exclusive_folder
    from hyrfpack.render import RenderSettings
    from hyrfpack.render.files import make_renderer, render_file_names, write_pictures
    from hyrfpack.render.video import has_ffmpeg, write_video
    from hyrfpack.splats.draw import Drawable, draw

    torch_device, settings = choose_command_device(device, ranks), RenderSettings(exposure=exposure)
    source, scene = ranks.run_on_all(lambda: RenderSource.open(model, torch_device, precision, allow_partial)), None
    if data is not None:
        scene = ranks.run_on_all(lambda: read_scene(data, reader_options, source.facts))
        views = select_views(scene, split)
        named = [(view.name, view.camera) for view in views]
    elif cameras is not None:
        named = cameras_from_json(cameras)
    else:
        cameras_around = orbit_around(source.viewpoint, orbit or DEFAULT_ORBIT_FRAMES)
        named = [(f"{number:04d}", camera) for number, camera in enumerate(cameras_around)]
    video_path = output / "video.mp4" if video and has_ffmpeg() else None
    names = render_file_names([name for name, _ in named], depth)
    names += [video_path.name] if video_path else []

    def check(replace: bool) -> None:
        if ranks.is_main:
            outputs = Outputs(source.path, cameras, folder=source.folder, scene=scene, overwrite=replace)
            outputs.folder(output, names)

    def write() -> list[Path]:
        shown = source.load()
        if isinstance(shown, Drawable):
            picture_of: Callable[[Camera], ColorAndDepth] = partial(draw, shown, settings=settings, depth=depth)
        else:
            picture_of = make_renderer(shown, depth=depth, settings=settings)
        pictures = write_pictures(picture_of, named, output, overwrite=overwrite, ranks=ranks)
        return list(show_item_progress(pictures, len(ranks.share(named)), "render", "picture"))

    # This first check ignores existing files. It prevents the creation of a folder where nothing may be written.
    ranks.run_on_all(lambda: check(replace=True))
    with exclusive_folder(output, ranks=ranks):  # the lock is held until the video is written, too
        ranks.run_on_all(lambda: check(replace=overwrite))
        width, height = largest_picture_size(camera for _, camera in named)
        note(f"rendering {len(named)} pictures of up to {width} x {height} pixels")
        parts = ranks.all_gather(ranks.run_on_all(write))
        if not ranks.is_main:
            return
        written = [parts[index % ranks.size][index // ranks.size] for index in range(len(named))]
        if video_path:
            video_path = note_rename(video_path, write_video(written, video_path, overwrite=overwrite))
    for name, path in zip(render_file_names([name for name, _ in named]), written, strict=True):
        note_rename(output / name, path)
    if video and not video_path:
        note("ffmpeg was not found, so no video was written; the pictures are complete")
    if as_json:
        print_json({"pictures": [str(path) for path in written], "video": str(video_path) if video_path else None})
    else:
        film = f" and {video_path.name}" if video_path else ""
        click.echo(f"{output}: {len(written)} pictures{film}, {width} x {height} pixels")


@click.command(short_help="Score a model against photos.")
@click.argument("model", type=PATH)
@click.option("--data", type=PATH, required=True, help="Folder of photos and poses.")
@click.option(
    "--split", type=click.Choice(SPLITS), default="test", show_default=True, help="Photos of --data to score."
)
@scene_options
@click.option("--lpips-weights", type=PATH, metavar="FILE", help="Weights of the lpips package, needed for LPIPS.")
@click.option(
    "--pictures", type=OUTPUT, metavar="DIR", help="Write a picture of each photo, its render and the error to DIR."
)
@click.option(
    "--allow-partial",
    is_flag=True,
    help="Accept a file that is cut short, if enough of it is there for a coarser model.",
)
@exposure_option
@overwrite_option
@processes_option
@device_options
@json_option
def evaluate(
    model: Path,
    data: Path,
    split: str,
    reader_options: dict[str, Any],
    lpips_weights: Path | None,
    pictures: Path | None,
    allow_partial: bool,
    exposure: str,
    overwrite: bool,
    device: str,
    precision: str,
    as_json: bool,
    ranks: Ranks,
) -> None:
    """Score MODEL against held-out photos: PSNR, SSIM, LPIPS, file size in bytes, seconds per frame.

    MODEL is a .hyrf file, the folder of a run, or splats (.ply .splat .spz .sog) of 'hyrfpack export' or another
    program. Splats must have the axes and units of the photos' poses and are drawn over black.

    Renders are rounded to 8 bits before they are scored. PSNR is that of the pictures that 'hyrfpack render' writes.
    "corrected" is the PSNR after an affine colour map has been fitted to each photo. LPIPS needs the trained weights of
    the lpips package:
    torch.save(lpips.LPIPS(net="alex").state_dict(), FILE)

    \b
    Examples:
      hyrfpack evaluate bonsai.hyrf --data photos/bonsai
      hyrfpack evaluate bonsai.hyrf --data photos/bonsai --pictures compare --json
      hyrfpack evaluate bonsai.ply --data photos/bonsai
    """
    from hyrfpack.cli.render_source import RenderSource
    from hyrfpack.evaluate import evaluate_model as score
    from hyrfpack.evaluate import picture_names
    from hyrfpack.render import RenderSettings

    torch_device = choose_command_device(device, ranks)

    def read() -> tuple[RenderSource, HybridModel | Drawable, Scene, list[View]]:
        source = RenderSource.open(model, torch_device, precision, allow_partial)
        shown = source.load()
        scene = read_scene(data, reader_options, source.facts)
        views = select_views(scene, split)
        if pictures is not None:
            outputs = Outputs(source.path, lpips_weights, folder=source.folder, scene=scene, overwrite=overwrite)
            outputs.folder(pictures, picture_names(views).values())
        return source, shown, scene, views

    source, shown, scene, views = ranks.run_on_all(read)
    with show_progress("evaluate") as progress:
        scores = score(
            shown,
            views,
            lpips_weights=lpips_weights,
            settings=RenderSettings(exposure=exposure),
            pictures=pictures,
            overwrite=overwrite,
            report=progress,
            ranks=ranks,
        )
    if not ranks.is_main:
        return
    size = source.bytes
    width, height = largest_picture_size(view.camera for view in views)
    if scores.skipped:
        note(f"{len(scores.skipped)} photos were not scored because their masks leave no pixel")
    if as_json:
        print_json({"bytes": size, "max_size": scene.max_size, "picture_size": [width, height], **scores.to_dict()})
        return
    rows = [*(_score_row(view.name, view) for view in scores.views), _score_row("mean", scores)]
    click.echo(format_table(["view", "PSNR (dB)", "corrected", "SSIM", "LPIPS"], rows))
    limit = f"--max-size {scene.max_size}" if scene.max_size else "as they are stored"
    click.echo(f"{len(scores.views)} photos of up to {width} x {height} pixels ({limit})")
    if scores.psnr_consistent is not None and exposure == AS_PHOTOGRAPHED:
        click.echo(f"mean PSNR {scores.psnr:.2f} dB{format_consistent_psnr(scores.psnr_consistent)}")
    click.echo(f"{model}: {size:,} bytes, {scores.gaussians:,} Gaussians, {scores.seconds_per_frame:.4f} s a frame")
    if scores.lpips is None:
        click.echo(f"LPIPS: {scores.lpips_reason}")


def _score_row(name: str, scores: ViewScore | Evaluation) -> list[str]:
    perceptual = "-" if scores.lpips is None else f"{scores.lpips:.4f}"
    return [name, f"{scores.psnr:.2f}", f"{scores.psnr_corrected:.2f}", f"{scores.ssim:.4f}", perceptual]

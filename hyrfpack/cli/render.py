"""The command `hyrfpack render`."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Any

import click

from hyrfpack.choices import DEPTH_FORMATS, NORMAL_FORMATS
from hyrfpack.cli.common import note, note_rename, print_json, read_scene, scene_options
from hyrfpack.cli.drawing import drawing_options, largest_picture_size, select_views, split_option
from hyrfpack.cli.progress import show_item_progress
from hyrfpack.cli.settings import settings_options
from hyrfpack.cli.types import INPUT_PATH, OUTPUT_FOLDER, SIZE
from hyrfpack.config.render import DEFAULT_DEPTH_UNIT, GeometryConfig
from hyrfpack.counts import format_count
from hyrfpack.outputs import Outputs

if TYPE_CHECKING:
    from collections.abc import Callable

    from hyrfpack.cli.drawing import Drawing
    from hyrfpack.cli.render_source import RenderSource
    from hyrfpack.lod import LevelRenderer
    from hyrfpack.render import RenderedPicture, RenderSettings
    from hyrfpack.scene import Camera

DEFAULT_ORBIT_FRAMES = 60
CAMERAS_NAME = "cameras.json"


@click.command(short_help="Render views to picture files.")
@click.argument("model", type=INPUT_PATH)
@click.option("-o", "--output", type=OUTPUT_FOLDER, required=True, metavar="OUT", help="Folder of the pictures.")
@click.option("--data", type=INPUT_PATH, help="Render the views of this folder of photos and poses.")
@split_option("Views of --data to render.")
@scene_options
@click.option("--cameras", type=INPUT_PATH, metavar="JSON", help="Render the cameras of this file.")
@click.option(
    "--orbit", type=click.IntRange(1, 100_000), metavar="N", help="Render an orbit of N frames around the scene."
)
@click.option(
    "--depth",
    type=click.Choice(DEPTH_FORMATS),
    is_flag=False,
    flag_value=DEPTH_FORMATS[0],
    help="Also write the depth along the view axis in world units: as float32 (tiff, which --depth alone writes, or "
    "exr) or as 16-bit steps of --depth-unit (png). 0 is no surface.",
)
@settings_options(GeometryConfig, "depth_unit")
@click.option(
    "--normals",
    type=click.Choice(NORMAL_FORMATS),
    is_flag=False,
    flag_value=NORMAL_FORMATS[0],
    help="Also write the normals of surfaces in world axes: as 8 bits, 0.5 n + 0.5 (png, which --normals alone "
    "writes), or as float32 (exr).",
)
@click.option(
    "--gaussians",
    type=click.IntRange(1),
    metavar="N",
    help="Of a scene folder, draw at most N Gaussians in each view, at the levels of detail with the least error.",
)
@click.option(
    "--bytes",
    "level_bytes",
    type=SIZE,
    metavar="SIZE",
    help="Of a scene folder, draw files of at most SIZE in each view: 200kB, 2MB, or bytes.",
)
@click.option("--video", is_flag=True, help="Also write the frames as OUT/video.mp4 (needs ffmpeg).")
@drawing_options
def render(
    model: Path,
    output: Path,
    data: Path | None,
    split: str,
    reader_options: dict[str, Any],
    cameras: Path | None,
    orbit: int | None,
    depth: str | None,
    depth_unit: float,
    normals: str | None,
    gaussians: int | None,
    level_bytes: int | None,
    video: bool,
    drawing: Drawing,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Render MODEL to PNG pictures: the views of photos, the cameras of a file, or by default an orbit of 60 frames.

    MODEL is a .hyrf file, the folder of a run, a scene folder of 'hyrfpack split', or splats (.ply .splat .spz .sog),
    which are drawn over black.

    The file of --cameras is a list of {"name", "width", "height", "fx", "fy", "cx", "cy", "camera_from_world": 4 x 4}
    with OpenCV axes, or a transforms.json in the format of nerfstudio.

    \b
    Examples:
      hyrfpack render bonsai.hyrf -o orbit --video
      hyrfpack render bonsai.hyrf -o out --data photos/bonsai --split test
      hyrfpack render bonsai.hyrf -o path --cameras path.json --depth exr --normals exr
      hyrfpack render bonsai.hyrf -o rgbd --data photos/bonsai --split all --depth png --depth-unit 0.001
      hyrfpack render other.ply -o orbit --orbit 90
      hyrfpack render city-scene -o walk --cameras walk.json --gaussians 500000
    """
    _check_usage(data, cameras, orbit, depth, depth_unit, gaussians, level_bytes)
    from hyrfpack.atomic import write_atomic
    from hyrfpack.cameras.files import cameras_to_json
    from hyrfpack.lock import exclusive_folder
    from hyrfpack.render.files import render_file_names, unique_stems, write_pictures
    from hyrfpack.render.geometry_files import GeometryWriter
    from hyrfpack.render.video import has_ffmpeg, write_video

    ranks, settings = drawing.ranks, drawing.settings
    geometry = GeometryConfig(depth, normals, depth_unit)
    writer = GeometryWriter(geometry) if geometry.is_wanted else None
    source, scene = drawing.open(model), None
    has_budget = gaussians is not None or level_bytes is not None
    levels = source.load_levels(gaussians, level_bytes) if has_budget else None
    if data is not None:
        scene = ranks.run_on_all(lambda: read_scene(data, reader_options, source.path, source.facts))
        named_cameras = [(view.name, view.camera) for view in select_views(scene, split)]
    else:
        named_cameras = _name_cameras(source, cameras, orbit or DEFAULT_ORBIT_FRAMES)
    video_path = output / "video.mp4" if video and has_ffmpeg() else None
    if video and not video_path:
        note("ffmpeg was not found, so only pictures are written; install the ffmpeg program for a video")
    names = render_file_names([name for name, _ in named_cameras], geometry)
    names += [video_path.name] if video_path else []
    names += [CAMERAS_NAME] if writer else []

    def check(replace: bool) -> None:
        if ranks.is_main:
            outputs = Outputs(source.path, cameras, folders=[source.folder], scene=scene, overwrite=replace)
            outputs.folder(output, names)

    def write() -> tuple[list[Path], float]:
        draw_view = _make_picture_renderer(source, levels, settings, geometry)
        pictures = write_pictures(draw_view, named_cameras, output, geometry=writer, overwrite=overwrite, ranks=ranks)
        count, written = len(ranks.share(named_cameras)), []
        try:
            for path in show_item_progress(pictures, count, "render", "picture"):
                written.append(path)
        except KeyboardInterrupt:
            note(f"{output}: {len(written):,} of {format_count(count, 'picture')} were written")
            raise
        return written, writer.max_depth if writer else 0.0

    # This first check ignores existing files. It prevents the creation of a folder where nothing may be written.
    ranks.run_on_all(lambda: check(replace=True))
    with exclusive_folder(output, ranks=ranks):  # the lock is held until the video is written, too
        ranks.run_on_all(lambda: check(replace=overwrite))
        width, height = largest_picture_size(camera for _, camera in named_cameras)
        note(f"rendering {format_count(len(named_cameras), 'picture')} of up to {width} x {height} pixels")
        parts = ranks.all_gather(ranks.run_on_all(write))
        if not ranks.is_main:
            return
        written = [parts[index % ranks.size][0][index // ranks.size] for index in range(len(named_cameras))]
        if writer:
            stems = unique_stems([name for name, _ in named_cameras])
            text = cameras_to_json([(stem, camera) for stem, (_, camera) in zip(stems, named_cameras, strict=True)])
            write_atomic(output / CAMERAS_NAME, text.encode(), overwrite=overwrite, rename=False)
            writer.warn_of_losses(max(max_depth for _, max_depth in parts))
        if video_path:
            video_path = note_rename(video_path, write_video(written, video_path, overwrite=overwrite))
    if levels is not None and levels.choices:
        _note_levels(levels)
    for name, path in zip(render_file_names([name for name, _ in named_cameras]), written, strict=True):
        note_rename(output / name, path)
    if as_json:
        print_json({"pictures": [str(path) for path in written], "video": str(video_path) if video_path else None})
        return
    video_text = f" and {video_path.name}" if video_path else ""
    geometry_kinds = [kind for kind, extension in (("depth", depth), ("normals", normals)) if extension]
    geometry_text = f", with {' and '.join(geometry_kinds)}" if geometry_kinds else ""
    pictures = f"{format_count(len(written), 'picture')}{video_text}, {width} x {height} pixels"
    click.echo(f"{output}: {pictures}{geometry_text}")


def _check_usage(
    data: Path | None,
    cameras: Path | None,
    orbit: int | None,
    depth: str | None,
    depth_unit: float,
    gaussians: int | None,
    level_bytes: int | None,
) -> None:
    """Raise UsageError for options that contradict each other."""
    if sum(source is not None for source in (data, cameras, orbit)) > 1:
        raise click.UsageError("--data, --cameras and --orbit each say what to render; give one of them")
    if depth_unit != DEFAULT_DEPTH_UNIT and depth != "png":
        raise click.UsageError("--depth-unit is the step of a 16-bit PNG; give it with --depth png")
    if gaussians is not None and level_bytes is not None:
        raise click.UsageError("--gaussians and --bytes each limit what a view draws; give one of them")


def _name_cameras(source: RenderSource, cameras: Path | None, frames: int) -> list[tuple[str, Camera]]:
    """Return the cameras of a file, or else those of an orbit around the scene, with their names."""
    from hyrfpack.cameras.files import cameras_from_json
    from hyrfpack.cameras.paths import orbit

    if cameras is not None:
        return cameras_from_json(cameras)
    return [(f"{number:04d}", camera) for number, camera in enumerate(orbit(source.viewpoint, frames))]


def _make_picture_renderer(
    source: RenderSource, levels: LevelRenderer | None, settings: RenderSettings, geometry: GeometryConfig
) -> Callable[[Camera], RenderedPicture]:
    """Return a function that renders a camera: from levels of detail if they are given, else from the whole source."""
    from hyrfpack.render.files import make_renderer
    from hyrfpack.splats.draw import Drawable, draw_picture

    if levels is not None:
        return partial(levels.draw, settings=settings, geometry=geometry)
    drawn_model = source.load()
    if isinstance(drawn_model, Drawable):
        return partial(draw_picture, drawn_model, settings=settings, geometry=geometry)
    return make_renderer(drawn_model, geometry=geometry, settings=settings)


def _note_levels(levels: LevelRenderer) -> None:
    """Say how many Gaussians the views have, and how well they match the finest levels."""
    from hyrfpack.measure.psnr import psnr_from_mse

    counts = [choice.gaussians for choice in levels.choices]
    predicted = fmean(psnr_from_mse(choice.predicted_mse) for choice in levels.choices)
    note(f"views have {min(counts):,} to {max(counts):,} Gaussians; predicted PSNR to the finest {predicted:.1f} dB")

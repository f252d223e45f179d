"""The command `hyrfpack evaluate`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from hyrfpack.choices import AS_PHOTOGRAPHED
from hyrfpack.cli.common import format_consistent_psnr, format_table, note, print_json, read_scene, scene_options
from hyrfpack.cli.drawing import drawing_options, largest_picture_size, select_views, split_option
from hyrfpack.cli.types import INPUT_PATH, OUTPUT_FOLDER
from hyrfpack.counts import format_count
from hyrfpack.errors import printable
from hyrfpack.outputs import Outputs

if TYPE_CHECKING:
    from hyrfpack.cli.drawing import Drawing
    from hyrfpack.evaluate import Evaluation
    from hyrfpack.evaluate.view_scores import ViewScore
    from hyrfpack.model import HybridModel
    from hyrfpack.model.merged import MergedModel
    from hyrfpack.scene import Scene, View
    from hyrfpack.splats.draw import Drawable


@click.command(short_help="Score a model against photos.")
@click.argument("model", type=INPUT_PATH)
@click.option("--data", type=INPUT_PATH, required=True, help="Folder of photos and poses.")
@split_option("Photos of --data to score.")
@scene_options
@click.option(
    "--lpips-weights", type=INPUT_PATH, metavar="FILE", help="Weights of the lpips package, needed for LPIPS."
)
@click.option(
    "--pictures",
    type=OUTPUT_FOLDER,
    metavar="DIR",
    help="Write a picture of each photo, its render and the error to DIR.",
)
@drawing_options
def evaluate(
    model: Path,
    data: Path,
    split: str,
    reader_options: dict[str, Any],
    lpips_weights: Path | None,
    pictures: Path | None,
    drawing: Drawing,
    overwrite: bool,
    as_json: bool,
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
    from hyrfpack.evaluate import evaluate_model, picture_names
    from hyrfpack.progress import open_display

    ranks, source = drawing.ranks, drawing.open(model)

    def read() -> tuple[HybridModel | MergedModel | Drawable, Scene, list[View]]:
        drawn_model = source.load()
        scene = read_scene(data, reader_options, source.path, source.facts)
        views = select_views(scene, split)
        if pictures is not None:
            outputs = Outputs(source.path, lpips_weights, folders=[source.folder], scene=scene, overwrite=overwrite)
            outputs.folder(pictures, picture_names(views).values())
        return drawn_model, scene, views

    drawn_model, scene, views = ranks.run_on_all(read)
    with open_display("auto", "evaluate") as progress:
        scores = evaluate_model(
            drawn_model,
            views,
            lpips_weights=lpips_weights,
            settings=drawing.settings,
            pictures=pictures,
            overwrite=overwrite,
            progress=progress,
            ranks=ranks,
        )
    if not ranks.is_main:
        return
    size = source.bytes
    width, height = largest_picture_size(view.camera for view in views)
    if scores.skipped:
        skipped = format_count(len(scores.skipped), "photo was", "photos were")
        note(f"{skipped} not scored because the masks leave no pixel")
    if as_json:
        print_json({"bytes": size, "max_size": scene.max_size, "picture_size": [width, height], **scores.to_dict()})
        return
    rows = [*(_score_row(printable(view.name), view) for view in scores.views), _score_row("mean", scores)]
    click.echo(format_table(["view", "PSNR (dB)", "corrected", "SSIM", "LPIPS"], rows))
    limit = f"--max-size {scene.max_size}" if scene.max_size else "as they are stored"
    click.echo(f"{format_count(len(scores.views), 'photo')} of up to {width} x {height} pixels ({limit})")
    if scores.psnr_consistent is not None and drawing.exposure == AS_PHOTOGRAPHED:
        click.echo(f"mean PSNR {scores.psnr:.2f} dB{format_consistent_psnr(scores.psnr_consistent)}")
    click.echo(
        f"{model}: {size:,} bytes, {format_count(scores.gaussians, 'Gaussian')}, "
        f"{scores.seconds_per_frame:.4f} s a frame"
    )
    if scores.lpips is None:
        click.echo(f"LPIPS: {scores.lpips_reason}")


def _score_row(name: str, scores: ViewScore | Evaluation) -> list[str]:
    perceptual = "-" if scores.lpips is None else f"{scores.lpips:.4f}"
    return [name, f"{scores.psnr:.2f}", f"{scores.psnr_corrected:.2f}", f"{scores.ssim:.4f}", perceptual]

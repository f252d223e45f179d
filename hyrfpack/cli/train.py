"""The command `hyrfpack train`."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from hyrfpack.cli.common import (
    choose_command_device,
    device_options,
    format_consistent_psnr,
    json_option,
    note,
    note_if_verbose,
    note_rename,
    print_json,
    read_scene,
    scene_options,
)
from hyrfpack.cli.live import check_view_options, serve_training_view, view_options
from hyrfpack.cli.processes import processes_option
from hyrfpack.cli.settings import reject_two_sizes, settings_options
from hyrfpack.cli.types import INPUT_PATH, OUTPUT, OUTPUT_FOLDER
from hyrfpack.config.train import TrainConfig
from hyrfpack.counts import format_count
from hyrfpack.errors import HyrfNoPosesError, suggest_command

if TYPE_CHECKING:
    from hyrfpack.parallel.ranks import Ranks
    from hyrfpack.train import TrainResult


@click.command(short_help="Train a model on photos with poses.")
@click.argument("data", type=INPUT_PATH)
@click.option("-o", "--output", "out", type=OUTPUT_FOLDER, required=True, metavar="RUN", help="Folder of the run.")
@settings_options(
    TrainConfig, "steps", "early_stop", "resolution_schedule", "max_gaussians", "target_bytes", "preset", "seed"
)
@scene_options
@settings_options(
    TrainConfig, "background", "background_color", "exposure", "virtual_views", "antialiased", "log2_table_size"
)
@click.option(
    "--blocks",
    metavar="auto|NxM",
    help="Train in blocks: divide the ground into N x M cells, and train them one after the other. auto takes as many "
    "as memory asks for.",
)
@click.option(
    "--cache-mb",
    type=click.IntRange(min=1),
    metavar="MB",
    help="Memory for decoded photos, in MiB.  [default: a quarter of the RAM]",
)
@click.option(
    "--log",
    type=OUTPUT,
    metavar="FILE",
    help="Write a log of JSON lines to FILE, and TensorBoard scalars beside it if tensorboard is installed.",
)
@view_options
@click.option("--poses", is_flag=True, help="If DATA has no poses, estimate them first, in RUN/scene.")
@click.option("--resume", is_flag=True, help="Resume from the checkpoint of the run.")
@click.option("--overwrite", is_flag=True, help="Replace an earlier run in RUN.")
@processes_option
@device_options
@json_option
def train(
    data: Path,
    out: Path,
    reader_options: dict[str, Any],
    blocks: str | None,
    cache_mb: int | None,
    log: Path | None,
    view: bool,
    view_port: int | None,
    poses: bool,
    resume: bool,
    overwrite: bool,
    device: str,
    as_json: bool,
    ranks: Ranks,
    **settings: Any,
) -> None:
    """Train a model on DATA, a folder of photos and poses, or a .zip of it.

    Poses may be COLMAP's, NeRF-synthetic's, nerfstudio's (instant-ngp's), LLFF's, Metashape's, Bundler's,
    RealityScan's, Polycam's or Record3D's.

    With --poses, DATA may be photos without poses, or a video.

    With --processes, torchrun or srun, several processes train together. In each step, each process renders a different
    photo, on its own GPU if there are GPUs. --steps counts photos, and --cache-mb is the total of a machine.

    With --blocks, large scenes are trained in parts and written as one file. --steps are those of each
    block, and --max-gaussians is the total. Several processes then train one block each at a time.

    RUN gets model.hyrf, metrics.json, the training curve and renders of held-out views. Ctrl-C saves a checkpoint and
    exits with code 1; so do SIGTERM and closing the terminal. --resume then gives the same model as an uninterrupted
    run.

    \b
    Examples:
      hyrfpack train photos/bonsai -o runs/bonsai
      hyrfpack train photos/garden -o runs/garden --images images_4 --steps 30000
      hyrfpack train photos/garden -o runs/garden --target-size 1MB
      hyrfpack train lego -o runs/lego --background-color white --max-gaussians 50000
      hyrfpack train photos/garden -o runs/garden --images images_4 --steps 30000 --resume
      hyrfpack train photos/desk -o runs/desk --poses
      hyrfpack train photos/garden -o runs/garden --processes 4
      hyrfpack train photos/city -o runs/city --blocks 2x2
    """
    if resume and overwrite:
        raise click.UsageError("--resume continues a run and --overwrite replaces it; give one of them")
    reject_two_sizes(**settings)
    check_view_options(view, view_port)
    if poses and not ranks.is_single:
        raise click.UsageError(
            "--poses runs in one process only; run 'hyrfpack poses' first, then train from its folder"
        )
    from hyrfpack.blocks.plan import parse_grid
    from hyrfpack.blocks.run import train_blocks
    from hyrfpack.context import RunContext
    from hyrfpack.data import PictureCache
    from hyrfpack.device import describe_device
    from hyrfpack.train import train_model
    from hyrfpack.train.run import resuming

    if blocks not in (None, "auto"):
        parse_grid(blocks)  # before photos are read, which takes minutes for large scenes
    torch_device = choose_command_device(device, ranks)
    try:
        scene = ranks.run_on_all(lambda: read_scene(data, reader_options))
    except HyrfNoPosesError:
        if not poses:
            raise
        scene = read_scene(
            _estimate_poses(data, out, reader_options["images"], resume, overwrite), {**reader_options, "images": None}
        )
    device_text = describe_device(torch_device) + ("" if ranks.is_single else f" in each of {ranks.size} processes")
    photos = format_count(len(scene.train), "photo")
    note(f"{scene.layout} scene: {photos} to train on, {len(scene.test)} held out; on {device_text}")
    cache = None if cache_mb is None else PictureCache(cache_mb * 2**20 // ranks.local_size)
    config, context = TrainConfig(**settings), RunContext(device=torch_device, ranks=ranks, cache=cache)
    serves_view = view and ranks.is_main
    with serve_training_view(out.name, serves_view, view_port if serves_view else None) as observer:
        try:
            train_scene = train_model if blocks is None else partial(train_blocks, blocks=blocks)
            result = train_scene(
                scene, out, config, resume=resume, overwrite=overwrite, observer=observer, log=log, context=context
            )
        except KeyboardInterrupt:
            if not _is_resumable(out, blocks):
                raise
            note(f"stopped; {resuming(overwrite)} continues")
            click.get_current_context().exit(1)
    _note_outcome(result, out, blocks, overwrite)
    if as_json:
        print_json({"complete": result.complete, "step": result.step, **result.metrics})
    elif result.complete and ranks.is_main:
        _print_result(result)
        if view:
            note(f"to see the model again, run {suggest_command('view', result.model)}")
    if not result.complete:
        click.get_current_context().exit(1)


def _is_resumable(run: Path, blocks: str | None) -> bool:
    """Return whether a folder holds a run that has begun, of the kind that --blocks names."""
    from hyrfpack.blocks.journal import is_begun as is_block_run_begun
    from hyrfpack.blocks.plan import parse_grid
    from hyrfpack.train.run import is_begun

    if blocks is None:
        return is_begun(run)
    # A single block, which "auto" may choose, is trained as a run without blocks.
    is_single = blocks == "auto" or parse_grid(blocks) == (1, 1)
    return is_block_run_begun(run) or (is_single and is_begun(run))


def _note_outcome(result: TrainResult, out: Path, blocks: str | None, overwrite: bool) -> None:
    """Print notes on the times of the stages, on how to resume, and on files that are missing or have other names."""
    from hyrfpack.format.run_folder import MODEL_FILE
    from hyrfpack.train.run import resuming

    seconds_by_stage = result.metrics.get("stage_seconds", {})
    note_if_verbose("seconds: " + ", ".join(f"{stage} {seconds:.1f}" for stage, seconds in seconds_by_stage.items()))
    if not result.complete and not _is_resumable(out, blocks):
        note("stopped before the first step; run the same command to start again")
    elif not result.complete:
        place = f"after step {result.step:,}" if result.step else "before the first step"
        note(f"stopped {place}; {resuming(overwrite)} continues from there")
    if result.model is not None:
        note_rename(out / MODEL_FILE, result.model)
    if result.missing:
        note(f"{resuming(overwrite)} writes the missing files")


def _print_result(result: TrainResult) -> None:
    """Print the size of the model of a complete run, and its scores on held-out views."""
    metrics = result.metrics
    click.echo(
        f"{result.model}: {format_count(metrics['gaussians'], 'Gaussian')}, {metrics['bytes']:,} bytes, "
        f"{metrics['seconds']:.0f} s of training"
    )
    if scores := metrics.get("evaluation"):
        consistent = format_consistent_psnr(scores.get("psnr_consistent"))
        click.echo(f"held-out views: {scores['psnr']:.2f} dB{consistent}, SSIM {scores['ssim']:.4f}")


def _estimate_poses(photos: Path, run: Path, images: str | None, resume: bool, overwrite: bool) -> Path:
    """Estimate the poses of photos and return the folder of the scene, which lies in the folder of the run."""
    from hyrfpack.make.auto_pose import auto_pose

    try:
        return auto_pose(photos, run, images=images, resume=resume, overwrite=overwrite)
    except KeyboardInterrupt:
        note("stopped while estimating poses; the same command resumes")
        click.get_current_context().exit(1)

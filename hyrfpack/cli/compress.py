"""The commands `hyrfpack compress` and `decompress`."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from hyrfpack.cli.common import (
    choose_command_device,
    device_option,
    is_given,
    json_option,
    note,
    note_rename,
    overwrite_option,
    print_json,
    read_scene,
    resolve_model_file,
    scene_options,
)
from hyrfpack.cli.processes import processes_option
from hyrfpack.cli.section_table import format_section_table
from hyrfpack.cli.settings import settings_options
from hyrfpack.cli.types import INPUT_PATH, OUTPUT, OUTPUT_FOLDER, reject_non_finite
from hyrfpack.config.compress import CompressConfig
from hyrfpack.counts import format_count
from hyrfpack.measure.psnr import psnr_from_mse
from hyrfpack.outputs import Outputs

if TYPE_CHECKING:
    import torch

    from hyrfpack.compress import CompressionReport
    from hyrfpack.format import FileReport
    from hyrfpack.parallel.ranks import Ranks
    from hyrfpack.progress import Progress
    from hyrfpack.scene import Scene


@click.command(short_help="Compress a model to a small file.")
@click.argument("model", type=INPUT_PATH)
@click.option("-o", "--output", type=OUTPUT, required=True, metavar="FILE", help="The .hyrf file to write.")
@settings_options(CompressConfig, "profile")
@click.option(
    "--data",
    type=INPUT_PATH,
    help="Photos and poses for --finetune, --max-psnr-drop and scores.  [default: those that MODEL was trained on]",
)
@click.option("--no-data", is_flag=True, help="Do not use the photos that MODEL was trained on.")
@settings_options(CompressConfig, "finetune_steps", "prune", "target_bytes", "max_psnr_drop")
@click.option(
    "--report",
    type=OUTPUT_FOLDER,
    metavar="DIR",
    help="Write a page to this folder: rate and distortion, renders, error maps.",
)
@overwrite_option
@processes_option
@scene_options
@device_option
@json_option
def compress(
    model: Path,
    output: Path,
    data: Path | None,
    no_data: bool,
    report: Path | None,
    overwrite: bool,
    reader_options: dict[str, Any],
    device: str,
    as_json: bool,
    ranks: Ranks,
    **settings: Any,
) -> None:
    """Compress MODEL, a .hyrf file or the folder of a run, to a smaller file, and print the bytes of each section.

    The default profile measures how much each stored number affects renders, and spends bits accordingly. With photos,
    it also reports the loss of quality. The folder of a run records where its photos are, so you need not name them.
    Several processes share the photos of --finetune; each process does all other work itself.

    \b
    Examples:
      hyrfpack compress runs/bonsai -o bonsai.hyrf
      hyrfpack compress runs/bonsai -o bonsai.hyrf --finetune 500
      hyrfpack compress runs/bonsai -o bonsai.hyrf --target-size 150kB --no-data
      hyrfpack compress runs/bonsai -o bonsai.hyrf --max-psnr-drop 0.05 --report page
      hyrfpack compress bonsai.hyrf -o small.hyrf --data photos/bonsai
    """
    if data is not None and no_data:
        raise click.UsageError("--data and --no-data contradict each other; give one of them")
    from hyrfpack.compress import compress_model
    from hyrfpack.context import RunContext
    from hyrfpack.format import describe_file
    from hyrfpack.progress import open_display, part_of_progress
    from hyrfpack.report.compression_page import REPORT_FILES

    model, config = resolve_model_file(model), CompressConfig(**settings)
    torch_device = choose_command_device(device, ranks)

    def read() -> Scene | None:
        if data is not None:
            scene: Scene | None = read_scene(data, reader_options, model, describe_file(model), must_match=True)
        else:
            scene = None if no_data or config.profile != "compact" else _load_training_photos(model)
        outputs = Outputs(model, scene=scene, overwrite=overwrite)
        outputs.file(output, ".hyrf")
        if report is not None:
            from hyrfpack.evaluate.figures import require_matplotlib
            from hyrfpack.report.compression import check_single_model

            require_matplotlib()
            check_single_model(model)
            outputs.folder(report, REPORT_FILES)
        return scene

    scene = ranks.run_on_all(read)
    with open_display("auto", "compress") as progress:
        result = compress_model(
            model,
            output,
            config,
            data=scene,
            overwrite=overwrite,
            context=RunContext(torch_device, ranks, part_of_progress(progress, 0.0, 0.9)),
        )
        if not ranks.is_main:
            return
        files = model, Path(result.file)
        scores = _score_both_files(*files, scene, torch_device, part_of_progress(progress, 0.9, 1.0))
    written_path = note_rename(output, result.file)
    page = None
    if report is not None:
        from hyrfpack.report.compression import write_compression_report

        command = _command_as_typed(click.get_current_context())
        page = write_compression_report(
            report, model, written_path, result, scene, command=command, overwrite=overwrite
        )
    if as_json:
        print_json({**result.to_dict(), **scores, **({} if page is None else {"report": str(page)})})
        return
    _print_compression(result, scores)
    if page is not None:
        click.echo(f"{page}: rate and distortion, renders, error maps; open it in a browser")


@click.command(short_help="Decompress a file to exact float32.")
@click.argument("file", type=INPUT_PATH)
@click.option("-o", "--output", type=OUTPUT, required=True, metavar="FILE", help="The .hyrf file to write.")
@click.option(
    "--fraction",
    type=click.FloatRange(0, 1),
    callback=reject_non_finite,
    metavar="F",
    help="Read only this fraction of the file, from its start, such as 0.6. The model is coarser then.",
)
@overwrite_option
@json_option
def decompress(file: Path, output: Path, fraction: float | None, overwrite: bool, as_json: bool) -> None:
    """Decompress FILE, or the model of a run, to a .hyrf file of profile raw, which stores the decoded numbers exactly.

    A large file of profile compact consists of layers, the most important Gaussians first, so its first layers are a
    model, too. With --fraction, the rest of the file may be missing.

    \b
    Examples:
      hyrfpack decompress bonsai.hyrf -o back.hyrf
      hyrfpack decompress bonsai.hyrf -o coarse.hyrf --fraction 0.6
    """
    from hyrfpack.format import repack
    from hyrfpack.format.input_folder import find_input_folder

    file = resolve_model_file(file)
    Outputs(file, folders=[find_input_folder(file)], overwrite=overwrite).file(output, ".hyrf")
    result = repack(file, output, fraction=fraction, overwrite=overwrite)
    note_rename(output, result.file)
    if as_json:
        print_json(result.to_dict())
    else:
        _print_file(result)


def _command_as_typed(context: click.Context) -> str:
    """Return the command line of a command, with the parameters that were given there."""
    words = ["hyrfpack", str(context.info_name)]
    for parameter in context.command.params:
        if not is_given(context, parameter) or not parameter.expose_value:
            continue
        value = context.params[str(parameter.name)]
        if isinstance(parameter, click.Argument):
            words.append(str(value))
        elif isinstance(parameter, click.Option) and parameter.is_flag:
            words.append((parameter.opts if value else parameter.secondary_opts)[-1])
        else:
            words += [parameter.opts[-1], str(value)]
    return shlex.join(words)


def _load_training_photos(model: Path) -> Scene | None:
    """Load the photos that the model of a run was trained on; None, with a note, if they cannot be read."""
    from hyrfpack.errors import HyrfDataError
    from hyrfpack.train import load_training_scene

    try:
        scene = load_training_scene(model)
    except HyrfDataError as error:
        note(f"{error}; continuing without the photos that the model was trained on")
        return None
    if scene is not None:
        note(f"using the photos that the model was trained on, {scene.path} (turn off with --no-data)")
    return scene


def _score_both_files(
    source: Path, packed: Path, scene: Scene | None, device: torch.device, progress: Progress
) -> dict[str, float]:
    """Return mean PSNR and SSIM of both files on the held-out photos; empty if there are none."""
    if scene is None or not scene.test:
        return {}
    from hyrfpack.evaluate import evaluate_model
    from hyrfpack.format.parts import load_model_or_parts
    from hyrfpack.progress import part_of_progress

    source_scores, packed_scores = (
        evaluate_model(load_model_or_parts(file).to(device), scene.test, progress=part_of_progress(progress, *shares))
        for file, shares in ((source, (0.0, 0.5)), (packed, (0.5, 1.0)))
    )
    return {
        "psnr_before": source_scores.psnr,
        "psnr": packed_scores.psnr,
        "ssim_before": source_scores.ssim,
        "ssim": packed_scores.ssim,
    }


def _print_file(report: FileReport, shares: dict[str, float] | None = None) -> None:
    click.echo(format_section_table(report.sections, report.bytes_after, report.gaussians, shares))
    ratio = report.bytes_before / report.bytes_after
    outcome = "all numbers as float32" if report.profile == "raw" else f"{ratio:.2f} times smaller than float32"
    click.echo(f"{report.file}: {report.bytes_after:,} bytes, {format_count(report.gaussians, 'Gaussian')}, {outcome}")


def _print_compression(report: CompressionReport, scores: dict[str, float]) -> None:
    _print_file(report, report.shares)
    if report.found:
        click.echo(report.found)
    if report.error is not None:
        psnr = psnr_from_mse(report.error)
        click.echo(f"loss in pictures: {report.error:.2g} mean squared error, PSNR {psnr:.1f} dB")
    if scores:
        click.echo(
            f"held-out photos: PSNR {scores['psnr_before']:.3f} to {scores['psnr']:.3f} dB, "
            f"SSIM {scores['ssim_before']:.4f} to {scores['ssim']:.4f}"
        )

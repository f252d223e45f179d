"""The commands `hyrfpack compress`, `decompress` and `info`."""

from __future__ import annotations

import math
import shlex
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from hyrfpack.cli.common import (
    OUTPUT,
    PATH,
    SIZE,
    choose_command_device,
    device_option,
    format_consistent_psnr,
    format_table,
    json_option,
    note,
    note_rename,
    overwrite_option,
    print_json,
    read_scene,
    reject_nan,
    resolve_model_file,
    scene_options,
)
from hyrfpack.cli.console import print_line
from hyrfpack.cli.processes import processes_option
from hyrfpack.cli.progress import show_progress
from hyrfpack.cli.wording import use_option_names
from hyrfpack.outputs import ARCHIVE_SUFFIXES, PICTURE_SUFFIXES, VIDEO_SUFFIXES, Outputs
from hyrfpack.progress import report_part

if TYPE_CHECKING:
    from hyrfpack.format import CompressionReport
    from hyrfpack.parallel.ranks import Ranks
    from hyrfpack.progress import Report
    from hyrfpack.scene import Scene

# The same as in `hyrfpack.format.codec`, which cannot be imported without torch.
PROFILES = ("raw", "paper", "compact")
DEFAULT_PROFILE = "compact"


@click.command(short_help="Compress a model to a small file.")
@click.argument("model", type=PATH)
@click.option("-o", "--output", type=OUTPUT, required=True, metavar="FILE", help="The .hyrf file to write.")
@click.option(
    "--profile",
    type=click.Choice(PROFILES),
    default=DEFAULT_PROFILE,
    show_default=True,
    help="compact is the smallest and spends bits where renders need them, paper follows the HyRF paper, raw is exact "
    "float32.",
)
@click.option(
    "--data",
    type=PATH,
    help="Photos and poses for --finetune, --max-psnr-drop and scores.  [default: those that MODEL was trained on]",
)
@click.option("--no-data", is_flag=True, help="Do not use the photos that MODEL was trained on.")
@click.option(
    "--finetune",
    "finetune_steps",
    type=click.IntRange(1),
    metavar="N",
    help="Fine-tune the quantised model on the photos for N steps: slower, but a smaller file.",
)
@click.option("--prune/--no-prune", default=True, help="Prune Gaussians that renders do not need.  [default: prune]")
@click.option("--target-size", type=SIZE, metavar="SIZE", help="Best quality within this file size, such as 2MB.")
@click.option(
    "--max-psnr-drop",
    type=click.FloatRange(min=0),
    callback=reject_nan,
    metavar="DB",
    help="Smallest file that loses at most this PSNR, in dB, on the held-out photos of --data.",
)
@click.option(
    "--report",
    type=OUTPUT,
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
    profile: str,
    data: Path | None,
    no_data: bool,
    finetune_steps: int | None,
    prune: bool,
    target_size: int | None,
    max_psnr_drop: float | None,
    report: Path | None,
    overwrite: bool,
    reader_options: dict[str, Any],
    device: str,
    as_json: bool,
    ranks: Ranks,
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
    from hyrfpack.compress import compress_model as pack
    from hyrfpack.compress.report_page import REPORT_FILES
    from hyrfpack.format import describe_file

    model = resolve_model_file(model)
    torch_device = choose_command_device(device, ranks)

    def read() -> Scene | None:
        if data is not None:
            scene: Scene | None = read_scene(data, reader_options, describe_file(model))
        else:
            scene = None if no_data or profile != DEFAULT_PROFILE else _load_training_photos(model)
        outputs = Outputs(model, scene=scene, overwrite=overwrite)
        outputs.file(output, ".hyrf")
        if report is not None:
            outputs.folder(report, REPORT_FILES)
        return scene

    scene = ranks.run_on_all(read)
    with show_progress("compress") as progress:
        result = pack(
            model,
            output,
            profile,
            data=scene,
            finetune_steps=finetune_steps or 0,
            prune=prune,
            target_bytes=target_size,
            max_psnr_drop=max_psnr_drop,
            overwrite=overwrite,
            device=torch_device,
            report=report_part(progress, 0.0, 0.9),
            ranks=ranks,
        )
        if not ranks.is_main:
            return
        scores = _score_both_files(model, Path(result.file), scene, report_part(progress, 0.9, 1.0))
    written = note_rename(output, result.file)
    if report is not None:
        from hyrfpack.compress.report import write_report

        command = _command_as_typed(click.get_current_context())
        write_report(report, model, written, result, scene, command=command, overwrite=overwrite)
    _print_report(result, scores, as_json)


@click.command(short_help="Decompress a file to exact float32.")
@click.argument("file", type=PATH)
@click.option("-o", "--output", type=OUTPUT, required=True, metavar="FILE", help="The .hyrf file to write.")
@click.option(
    "--fraction",
    type=click.FloatRange(0, 1),
    callback=reject_nan,
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

    file = resolve_model_file(file)
    Outputs(file, overwrite=overwrite).file(output, ".hyrf")
    result = repack(file, output, fraction=fraction, overwrite=overwrite)
    note_rename(output, result.file)
    _print_report(result, {}, as_json)


@click.command(short_help="Describe a file, a run or a folder of photos.")
@click.argument("path", metavar="FILE", type=PATH)
@json_option
def info(path: Path, as_json: bool) -> None:
    """Describe FILE.

    For a .hyrf file: the model, the bytes of each section, and the settings that training chose, with the reasons.

    For the folder of a training run: its model, steps and scores, or the progress of an unfinished run.

    For splats (.ply .splat .spz .sog): format, number of Gaussians, degree of harmonics, bounds.

    For a folder of photos, with or without poses, its .zip, or a video: number of photos, poses, cameras, sharpness,
    exposure, problems and what to do about them.

    \b
    Examples:
      hyrfpack info bonsai.hyrf
      hyrfpack info bonsai.hyrf --json
      hyrfpack info runs/bonsai
      hyrfpack info other.ply
      hyrfpack info photos/bonsai
      hyrfpack info clip.mp4
    """
    from hyrfpack.format.run_folder import is_run_folder
    from hyrfpack.splats.names import is_splats

    if is_run_folder(path):
        _print_run(path, as_json)
    elif is_splats(path):
        _print_splats(path, as_json)
    elif path.is_dir() or (
        path.is_file() and path.suffix.lower() in (*ARCHIVE_SUFFIXES, *VIDEO_SUFFIXES, *PICTURE_SUFFIXES)
    ):
        _print_photos(path, as_json)
    else:
        _print_model(path, as_json)


def _print_photos(path: Path, as_json: bool) -> None:
    from hyrfpack.cli.survey import print_survey
    from hyrfpack.make.survey import describe_photos

    with show_progress("info") as progress:
        survey = describe_photos(path, report=progress)
    if as_json:
        print_json(asdict(survey))
    else:
        print_survey(survey)


def _print_run(folder: Path, as_json: bool) -> None:
    from hyrfpack.format import describe_file, read_run_status
    from hyrfpack.format.run_folder import FINISH_RUN_ADVICE, MODEL_FILE, describe_unfinished_run

    run = read_run_status(folder)
    facts = describe_file(folder) if (folder / MODEL_FILE).is_file() else {}
    if as_json:
        print_json({**facts, "run": asdict(run)})
        return
    if run.finished:
        steps = "" if run.steps is None else f": {run.steps:,} steps"
        seconds = "" if run.seconds is None else f" in {run.seconds:,.0f} s"
        print_line(f"{folder}: a finished training run{steps}{seconds}")
    else:
        print_line(f"{folder}: {describe_unfinished_run(run)}; {use_option_names(FINISH_RUN_ADVICE)}")
    if run.photos is not None:
        print_line(f"photos: {run.photos}, {run.train} to train on and {run.test} held out")
    if run.psnr is not None and run.ssim is not None:
        consistent = format_consistent_psnr(run.psnr_consistent)
        print_line(f"held-out photos: PSNR {run.psnr:.2f} dB{consistent}, SSIM {run.ssim:.4f}")
    if facts:
        click.echo()
        _print_model_facts(folder / MODEL_FILE, facts)


def _print_splats(path: Path, as_json: bool) -> None:
    from hyrfpack.splats.facts import describe_splats
    from hyrfpack.splats.files import read_splats

    facts = describe_splats(path, read_splats(path))
    if as_json:
        print_json(facts.to_dict())
        return
    click.echo(f"{path}: {facts.bytes:,} bytes, {facts.gaussians:,} Gaussians")
    rows = [
        ("format", facts.format + (", antialiased" if facts.antialiased else "")),
        ("bytes/Gaussian", f"{facts.bytes / max(facts.gaussians, 1):.1f}"),
        ("harmonics", f"degree {facts.degree}"),
    ]
    if facts.low is not None and facts.high is not None and facts.opacity is not None:
        low, high = (", ".join(f"{value:.4g}" for value in corner) for corner in (facts.low, facts.high))
        rows += [("centres", f"from ({low}) to ({high}), world units"), ("opacity", f"median {facts.opacity:.2f}")]
    for name, text in rows:
        print_line(f"  {name:<14}  {text}")


def _print_model(file: Path, as_json: bool) -> None:
    from hyrfpack.format import describe_file

    facts = describe_file(file)
    if as_json:
        print_json(facts)
    else:
        _print_model_facts(file, facts)


def _print_model_facts(file: Path, facts: dict) -> None:
    config, provenance = facts["config"], facts["provenance"]
    click.echo(f"{file}: {facts['bytes']:,} bytes, {facts['gaussians']:,} Gaussians")
    print_line(f"written by {facts['writer']}, format {facts['version']}, profile {facts['profile']}")
    click.echo("\n" + _section_table(facts["sections"], facts["bytes"], facts["gaussians"]))
    click.echo("\nmodel")
    frame = config["frame"]
    center = ", ".join(f"{value:.4g}" for value in frame["center"])
    half = " x ".join(f"{2.0 * value * frame['scale']:.4g}" for value in frame["half_extent"])
    print_line(f"  {'box':<18}  {half} around ({center}), world units")
    for name in ("geometry", "radiance"):
        print_line(f"  {name + ' grid':<18}  {_format_settings(config[name])}")
    if (exposure := facts["exposure"]) is not None:
        lowest, highest = exposure["stops"]
        print_line(f"  {'exposure map':<18}  {exposure['centers']} centres, {lowest:+.2f} to {highest:+.2f} stops")
    for name, value in config.items():
        if name not in ("frame", "geometry", "radiance"):
            print_line(f"  {name.replace('_', ' '):<18}  {value}")
    choices = provenance.get("choices")
    if choices and isinstance(choices, dict):
        click.echo("\nchosen in training")
        for name, reason in choices.items():
            print_line(f"  {name.replace('_', ' '):<18}  {reason}")


def _command_as_typed(context: click.Context) -> str:
    """Return the command line of a command, with the parameters that were given there."""
    words = ["hyrfpack", str(context.info_name)]
    for parameter in context.command.params:
        given = context.get_parameter_source(str(parameter.name)) is click.core.ParameterSource.COMMANDLINE
        if not given or not parameter.expose_value:
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


def _score_both_files(before: Path, after: Path, scene: Scene | None, report: Report) -> dict[str, float]:
    """Return mean PSNR and SSIM of both files on the held-out photos; empty if there are none."""
    if scene is None or not scene.test:
        return {}
    from hyrfpack.evaluate import evaluate_model
    from hyrfpack.format import load_model

    old = evaluate_model(load_model(before), scene.test, report=report_part(report, 0.0, 0.5))
    new = evaluate_model(load_model(after), scene.test, report=report_part(report, 0.5, 1.0))
    return {"psnr_before": old.psnr, "psnr": new.psnr, "ssim_before": old.ssim, "ssim": new.ssim}


def _print_report(report: CompressionReport, scores: dict[str, float], as_json: bool) -> None:
    if as_json:
        print_json({**report.to_dict(), **scores})
        return
    sections = [asdict(part) for part in report.sections]
    click.echo(_section_table(sections, report.bytes_after, report.gaussians, report.shares))
    ratio = report.bytes_before / report.bytes_after
    outcome = "all numbers as float32" if report.profile == "raw" else f"{ratio:.2f} times smaller than float32"
    click.echo(f"{report.file}: {report.bytes_after:,} bytes, {report.gaussians:,} Gaussians, {outcome}")
    if report.found:
        click.echo(report.found)
    if report.error is not None:
        click.echo(f"loss in pictures: {report.error:.2g} mean squared error, {-10 * math.log10(report.error):.1f} dB")
    if scores:
        click.echo(
            f"held-out photos: PSNR {scores['psnr_before']:.3f} to {scores['psnr']:.3f} dB, "
            f"SSIM {scores['ssim_before']:.4f} to {scores['ssim']:.4f}"
        )


def _section_table(sections: list[dict], total: int, gaussians: int, shares: dict[str, float] | None = None) -> str:
    """Format a table of the bytes of each section, summed over its layers, and of its share of the loss if known."""
    from hyrfpack.format.sections import NON_PARAMETER_SECTIONS, SECTION_CONTENTS, group_and_layer

    together: dict[str, list] = {}
    for part in sections:
        tag = group_and_layer(part["type"])[0]
        sizes = together.setdefault(tag, [SECTION_CONTENTS.get(tag, part["holds"]), 0, 0])
        sizes[1] += part["before"]
        sizes[2] += part["after"]
    parts = [(tag, holds, f"{before:,}", after) for tag, (holds, before, after) in together.items()]
    parts.append(("", "header, table of contents, padding", "", total - sum(after for *_, after in parts)))
    rows, header = [], ["section", "unpacked bytes", "stored bytes", "share", "bits/Gaussian", "bits/number"]
    for tag, holds, before, after in parts:
        numbers = int(before.replace(",", "") or 0) / 4 if tag not in (*NON_PARAMETER_SECTIONS, "") else 0
        rows.append(
            [
                f"{tag} {holds}".strip(),
                before,
                f"{after:,}",
                f"{after / total:.1%}",
                f"{8 * after / max(gaussians, 1):.2f}",
                f"{8 * after / numbers:.2f}" if numbers else "",
            ]
        )
        if shares:
            rows[-1].append(f"{shares[tag]:.1%}" if tag in shares else "")
    if shares:
        left_out = sum(share for part, share in shares.items() if part not in together)
        rows.append(["Gaussians left out", "", "", "", "", "", f"{left_out:.1%}"])
    return format_table([*header, *(["of the loss"] if shares else [])], rows)


def _format_settings(values: dict) -> str:
    return ", ".join(f"{name.replace('_', ' ')} {value}" for name, value in values.items())

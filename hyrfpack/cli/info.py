"""The command `hyrfpack info`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import click

from hyrfpack.cli.common import format_consistent_psnr, format_table, json_option, print_json
from hyrfpack.cli.console import print_line
from hyrfpack.cli.section_table import format_section_table
from hyrfpack.cli.types import INPUT_PATH
from hyrfpack.cli.wording import use_option_names
from hyrfpack.counts import format_count
from hyrfpack.errors import HyrfError, printable
from hyrfpack.format.info import SectionSize
from hyrfpack.outputs import ARCHIVE_SUFFIXES, PICTURE_SUFFIXES, VIDEO_SUFFIXES

EXPORT_ONLY_SUFFIXES = (".glb", ".html", ".obj", ".stl", ".usda", ".usdc", ".usdz")
# Longest sides of boxes, world units, whose numbers are printed with decimals.
MIN_DECIMAL_SIZE, MAX_DECIMAL_SIZE = 1e-6, 1e12


@click.command(short_help="Describe a file, a run or a folder of photos.")
@click.argument("path", metavar="FILE", type=INPUT_PATH)
@json_option
def info(path: Path, as_json: bool) -> None:
    """Describe FILE.

    For a .hyrf file: the model, the bytes of each section, and the settings that training chose, with the reasons.

    For the folder of a training run: its model, steps and scores, or the progress of an unfinished run.

    For a scene folder of 'hyrfpack split': its chunks, their levels of detail and errors.

    For splats (.ply .splat .spz .sog): format, number of Gaussians, degree of harmonics, bounds.

    For a folder of photos, with or without poses, its .zip, or a video: number of photos, poses, cameras, sharpness,
    exposure, problems and what to do about them.

    \b
    Examples:
      hyrfpack info bonsai.hyrf
      hyrfpack info bonsai.hyrf --json
      hyrfpack info runs/bonsai
      hyrfpack info city-scene
      hyrfpack info other.ply
      hyrfpack info photos/bonsai
      hyrfpack info clip.mp4
    """
    from hyrfpack.format.run_folder import is_run_folder
    from hyrfpack.format.scene_folder import is_scene
    from hyrfpack.splats.names import is_splats

    if is_scene(path):
        _print_scene(path, as_json)
    elif is_run_folder(path):
        _print_run(path, as_json)
    elif is_splats(path):
        _print_splats(path, as_json)
    elif path.is_dir() or (
        path.is_file() and path.suffix.lower() in (*ARCHIVE_SUFFIXES, *VIDEO_SUFFIXES, *PICTURE_SUFFIXES)
    ):
        _print_photos(path, as_json)
    elif path.is_file() and path.suffix.lower() == ".json":
        raise HyrfError(f"{path}: poses are described with their photos", fix="name the folder that holds the photos")
    elif path.is_file() and path.suffix.lower() in EXPORT_ONLY_SUFFIXES:
        raise HyrfError(
            f"{path}: files with this extension are written for other programs and not read",
            fix="name the model, splats (.ply, .splat, .spz, .sog), or a folder of photos",
        )
    else:
        _print_model(path, as_json)


def _print_photos(path: Path, as_json: bool) -> None:
    from hyrfpack.cli.survey import print_survey
    from hyrfpack.survey import describe_photos

    survey = describe_photos(path)
    if as_json:
        print_json(asdict(survey))
    else:
        print_survey(survey)


def _print_run(folder: Path, as_json: bool) -> None:
    from hyrfpack.format import describe_file, read_run_status
    from hyrfpack.format.run_folder import MODEL_FILE, advise_on_unfinished_run, describe_unfinished_run

    run = read_run_status(folder)
    facts = describe_file(folder) if (folder / MODEL_FILE).is_file() else {}
    if as_json:
        print_json({**facts, "run": asdict(run)})
        return
    if run.finished:
        steps = "" if run.steps is None else f": {format_count(run.steps, 'step')}"
        seconds = "" if run.seconds is None else f" in {run.seconds:,.0f} s"
        print_line(f"{folder}: a finished training run{steps}{seconds}")
    else:
        advice = use_option_names(advise_on_unfinished_run(folder))
        print_line(f"{folder}: {describe_unfinished_run(run)}; {advice}")
    if run.photos is not None:
        print_line(f"photos: {run.photos}, {run.train} to train on and {run.test} held out")
    if run.psnr is not None and run.ssim is not None:
        consistent = format_consistent_psnr(run.psnr_consistent)
        print_line(f"held-out photos: PSNR {run.psnr:.2f} dB{consistent}, SSIM {run.ssim:.4f}")
    if facts:
        click.echo()
        _print_model_facts(folder / MODEL_FILE, facts)


def _print_scene(path: Path, as_json: bool) -> None:
    from hyrfpack.format import describe_file

    facts = describe_file(path)
    if as_json:
        print_json(facts)
        return
    scene, name = facts["scene"], path.parent if path.name == "scene.json" else path
    print_line(
        f"{name}: {facts['bytes']:,} bytes, {format_count(facts['gaussians'], 'Gaussian')} in "
        f"{format_count(len(scene['chunks']), 'chunk')}"
    )
    print_line(f"written by {facts['writer']}, chunks of format {facts['version']}")
    for key in ("title", "licence"):
        if scene[key]:
            print_line(f"  {key:<9}  {scene[key]}")
    depth = max((len(chunk["levels"]) for chunk in scene["chunks"]), default=0)
    if "parts" in facts:
        rows = [[printable(part["name"]), f"{part['gaussians']:,}", f"{part['bytes']:,}"] for part in facts["parts"]]
        click.echo("\n" + format_table(["part", "Gaussians", "bytes"], rows))
    shared = sum(part["bytes"] for part in scene.get("parts") or [scene["shared"]])
    rows = [["shared", "-", f"{shared:,}", *("-" for _ in scene["error_radii"])]]
    for level in range(depth):
        items = [chunk["levels"][level] for chunk in scene["chunks"] if level < len(chunk["levels"])]
        sums = [sum(item[key] for item in items) for key in ("gaussians", "bytes")]
        means = [
            sum(item["errors"][number] for item in items) / len(items) for number in range(len(scene["error_radii"]))
        ]
        rows.append([f"level {level}", *(f"{value:,}" for value in sums), *(f"{mean:.1e}" for mean in means)])
    head = ["files", "Gaussians", "bytes", *(f"MSE at {radius:g} px" for radius in scene["error_radii"])]
    click.echo("\n" + format_table(head, rows))


def _print_splats(path: Path, as_json: bool) -> None:
    from hyrfpack.splats.facts import describe_splats
    from hyrfpack.splats.files import read_splats

    facts = describe_splats(path, read_splats(path))
    if as_json:
        print_json(facts.to_dict())
        return
    print_line(f"{path}: {facts.bytes:,} bytes, {format_count(facts.gaussians, 'Gaussian')}")
    rows = [
        ("format", facts.format + (", antialiased" if facts.antialiased else "")),
        ("bytes/Gaussian", f"{facts.bytes / max(facts.gaussians, 1):.1f}"),
        ("harmonics", f"degree {facts.degree}"),
    ]
    if facts.low is not None and facts.high is not None and facts.opacity is not None:
        size = max(end - start for start, end in zip(facts.low, facts.high, strict=True))
        low, high = (", ".join(_format_lengths(corner, size)) for corner in (facts.low, facts.high))
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
    print_line(f"{file}: {facts['bytes']:,} bytes, {format_count(facts['gaussians'], 'Gaussian')}")
    print_line(f"written by {facts['writer']}, format {facts['version']}, profile {facts['profile']}")
    if "parts" in facts:
        rows = [
            [printable(part["name"]), f"{part['gaussians']:,}", f"{part['bytes']:,}", part["profile"]]
            for part in facts["parts"]
        ]
        click.echo("\n" + format_table(["part", "Gaussians", "bytes", "profile"], rows))
        click.echo()
        print_line(f"The rest describes the scene, its first part '{facts['parts'][0]['name']}'.")
        facts = facts["parts"][0]
    names = ("type", "holds", "before", "after")
    sections = [SectionSize(*(part[name] for name in names)) for part in facts["sections"]]
    click.echo("\n" + format_section_table(sections, facts["bytes"], facts["gaussians"]))
    click.echo("\nmodel")
    frame = config["frame"]
    sides = [2.0 * value * frame["scale"] for value in frame["half_extent"]]
    box, center = (_format_lengths(values, max(sides)) for values in (sides, frame["center"]))
    print_line(f"  {'box':<18}  {' x '.join(box)} around ({', '.join(center)}), world units")
    if rotation := frame.get("rotation"):
        print_line(f"  {'rotation':<18}  {', '.join(f'{value:.6g}' for value in rotation)} (wxyz)")
    for name in ("geometry", "radiance"):
        print_line(f"  {name + ' grid':<18}  {_format_settings(config[name])}")
    if (exposure := facts["exposure"]) is not None:
        lowest, highest = exposure["stops"]
        centers = format_count(exposure["centers"], "centre")
        print_line(f"  {'exposure map':<18}  {centers}, {lowest:+.2f} to {highest:+.2f} stops")
    for name, value in config.items():
        if name not in ("frame", "geometry", "radiance"):
            print_line(f"  {name.replace('_', ' '):<18}  {value}")
    choices = provenance.get("choices")
    if choices and isinstance(choices, dict):
        click.echo("\nchosen in training")
        for name, reason in choices.items():
            print_line(f"  {name.replace('_', ' '):<18}  {reason}")


def _format_settings(values: dict) -> str:
    return ", ".join(f"{name.replace('_', ' ')} {value}" for name, value in values.items())


def _format_lengths(values: Sequence[float], size: float) -> list[str]:
    """Format coordinates or lengths to a thousandth of the size of their box or finer, however far away it is.

    Args:
        values: numbers in world units.
        size: longest side of the box, world units. Numbers of much smaller and larger boxes, and of points, have
            nine digits instead.
    """
    if not MIN_DECIMAL_SIZE <= size <= MAX_DECIMAL_SIZE:
        return [f"{value:.9g}" for value in values]
    decimals = max(0, math.ceil(3 - math.log10(size)))
    return [f"{round(value, decimals) + 0.0:.{decimals}f}" for value in values]  # + 0.0 turns -0.0 into 0.0

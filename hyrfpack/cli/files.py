"""`hyrfpack compress`, `decompress` and `info`."""

from __future__ import annotations

import os
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from hyrfpack.cli.common import PATH, json_option, print_json, table
from hyrfpack.errors import HyrfError, printable

if TYPE_CHECKING:
    from hyrfpack.format import CompressionReport

PROFILES, DEFAULT_PROFILE = ("raw", "paper"), "paper"  # those of hyrfpack.format.codec, without loading torch


@click.command(short_help="Pack a model into a small file.")
@click.argument("model", type=PATH)
@click.option("-o", "--output", type=PATH, required=True, metavar="FILE", help="The .hyrf file to write.")
@click.option(
    "--profile",
    type=click.Choice(PROFILES),
    default=DEFAULT_PROFILE,
    show_default=True,
    help="How: exact float32 (raw), or the HyRF paper's recipe.",
)
@json_option
def compress(model: Path, output: Path, profile: str, as_json: bool) -> None:
    """Pack MODEL, a .hyrf file, into a smaller one and show what each part takes.

    \b
    Examples:
      hyrfpack compress runs/bonsai/model.hyrf -o bonsai.hyrf
      hyrfpack compress runs/bonsai/model.hyrf -o bonsai.hyrf --profile paper --json
    """
    _rewrite(model, output, profile, as_json)


@click.command(short_help="Unpack a file to exact float32.")
@click.argument("file", type=PATH)
@click.option("-o", "--output", type=PATH, required=True, metavar="FILE", help="The .hyrf file to write.")
@json_option
def decompress(file: Path, output: Path, as_json: bool) -> None:
    """Unpack FILE into a .hyrf file of profile raw: the numbers that FILE decodes to, bit for bit.

    \b
    Example:
      hyrfpack decompress bonsai.hyrf -o back.hyrf
    """
    _rewrite(file, output, "raw", as_json)


@click.command(short_help="Show what a file holds.")
@click.argument("file", type=PATH)
@json_option
def info(file: Path, as_json: bool) -> None:
    """Show what FILE holds: the model, the bytes of each part, and what was chosen in training and why.

    \b
    Examples:
      hyrfpack info bonsai.hyrf
      hyrfpack info bonsai.hyrf --json
    """
    from hyrfpack.format import describe

    facts = describe(file)
    if as_json:
        print_json(facts)
        return
    config, provenance = facts["config"], facts["provenance"]
    click.echo(f"{file}: {facts['bytes']:,} bytes, {facts['gaussians']:,} Gaussians")
    _say(f"written by {facts['writer']}, format {facts['version']}, profile {facts['profile']}")
    click.echo("\n" + _section_table(facts["sections"], facts["bytes"], facts["gaussians"]))
    click.echo("\nmodel")
    frame = config["frame"]
    center = ", ".join(f"{value:.4g}" for value in frame["center"])
    half = " x ".join(f"{2.0 * value * frame['scale']:.4g}" for value in frame["half_extent"])
    _say(f"  {'box':<18}  {half} around ({center}), world units")
    for name in ("geometry", "radiance"):
        _say(f"  {name + ' grid':<18}  {_in_words(config[name])}")
    for name, value in config.items():
        if name not in ("frame", "geometry", "radiance"):
            _say(f"  {name.replace('_', ' '):<18}  {value}")
    choices = provenance.get("choices")
    if choices and isinstance(choices, dict):
        click.echo("\nchosen in training")
        for name, reason in choices.items():
            _say(f"  {name.replace('_', ' '):<18}  {reason}")


def _say(line: str) -> None:
    """Print a line with words of the file in it."""
    click.echo(printable(line))


def _rewrite(source: Path, target: Path, profile: str, as_json: bool) -> None:
    if os.path.realpath(source) == os.path.realpath(target):
        raise HyrfError(f"{target}: the output is the input itself; name another file with -o")
    from hyrfpack.format import compress as rewrite

    report: CompressionReport = rewrite(source, target, profile)
    sections = [asdict(part) for part in report.sections]
    if as_json:
        print_json(
            {
                "file": str(target),
                "profile": report.profile,
                "gaussians": report.gaussians,
                "bytes": report.bytes_after,
                "bytes_before": report.bytes_before,
                "sections": sections,
            }
        )
        return
    click.echo(_section_table(sections, report.bytes_after, report.gaussians))
    ratio = report.bytes_before / report.bytes_after
    outcome = "every number as float32" if profile == "raw" else f"{ratio:.2f} times smaller than as float32"
    click.echo(f"{target}: {report.bytes_after:,} bytes, {outcome}")


def _section_table(sections: list[dict], total: int, gaussians: int) -> str:
    parts = [(f"{part['type']} {part['holds']}", f"{part['before']:,}", part["after"]) for part in sections]
    parts.append(("header, table of contents, padding", "", total - sum(after for *_, after in parts)))
    rows = [
        [name, before, f"{after:,}", f"{after / total:.1%}", f"{8 * after / max(gaussians, 1):.2f}"]
        for name, before, after in parts
    ]
    return table(["section", "unpacked bytes", "stored bytes", "share", "bits/Gaussian"], rows)


def _in_words(values: dict) -> str:
    return ", ".join(f"{name.replace('_', ' ')} {value}" for name, value in values.items())

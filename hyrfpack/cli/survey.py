"""How `hyrfpack info` prints what photos or a video are like."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from hyrfpack.cli.wording import with_options
from hyrfpack.errors import printable

if TYPE_CHECKING:
    from hyrfpack.make.survey import PhotoSurvey

_LISTED = 4  # sizes and cameras


def print_survey(survey: PhotoSurvey) -> None:
    """Print a survey: a line for each fact, then what is wrong and what to do."""
    video = survey.kind == "video"
    things = "frames" if video else "photo" if survey.photos == 1 else "photos"
    _say(f"{survey.path}: {survey.photos:,} {things}")
    rows = [
        ("poses", f"{survey.posed:,} as {survey.layout}, {survey.points:,} points" if survey.layout else "none"),
        ("sizes", _counts(survey.sizes)),
        ("cameras", _counts(survey.cameras)),
        ("preset", survey.preset),
    ]
    if video:
        rows.append(("taken", f"{survey.frames:,} frames would be"))
    else:
        count = len(survey.blurred)
        rows.append(("sharpness", f"{survey.sharpness:.2f} ({count} of {survey.decoded} blurred)"))
        rows.append(("light", f"{survey.luminance:.2f} of white in the mean, even within {survey.stops:.1f} stops"))
    for name, text in rows:
        if text:
            _say(f"  {name:<10} {text}")
    for note in survey.notes:
        _say(f"  {with_options(note)}")
    click.echo("\nwhat to do" if survey.problems else "\nnothing is wrong with it")
    for problem in survey.problems:
        _say(f"  - {with_options(problem)}")


def _counts(counted: dict[str, int]) -> str:
    """ "98 of 400 x 266, 2 of 266 x 400" """
    parts = [f"{count:,} of {name}" for name, count in list(counted.items())[:_LISTED]]
    more = len(counted) - _LISTED
    return ", ".join(parts) + (f" and {more} more kinds" if more > 0 else "")


def _say(line: str) -> None:
    click.echo(printable(line))

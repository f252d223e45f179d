"""Print the survey of photos or a video for `hyrfpack info`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from hyrfpack.cli.console import print_line
from hyrfpack.cli.wording import use_option_names
from hyrfpack.counts import format_count

if TYPE_CHECKING:
    from hyrfpack.survey import PhotoSurvey

# Sizes of photos, and cameras, that are listed; the others are only counted.
_MAX_LISTED_KINDS = 4


def print_survey(survey: PhotoSurvey) -> None:
    """Print a survey: a line for each fact, then each problem with what to do."""
    video = survey.kind == "video"
    print_line(f"{survey.path}: {format_count(survey.photos, 'frame' if video else 'photo')}")
    points = format_count(survey.points, "point")
    rows = [
        ("poses", f"{survey.posed:,} as {survey.layout}, {points}" if survey.layout else "none"),
        ("sizes", _format_counts(survey.sizes)),
        ("cameras", _format_counts(survey.cameras)),
        ("preset", survey.preset),
    ]
    if video:
        rows.append(("taken", f"{format_count(survey.frames, 'frame')} would be"))
    else:
        count = len(survey.blurred)
        rows.append(("sharpness", f"{survey.sharpness:.2f} ({count} of {survey.decoded} blurred)"))
        rows.append(("light", f"{survey.luminance:.2f} of white on average, spread {survey.stops:.1f} stops"))
    for name, text in rows:
        if text:
            print_line(f"  {name:<10} {text}")
    for note in survey.notes:
        print_line(f"  {use_option_names(note)}")
    click.echo("\nwhat to do" if survey.problems else "\nno problems found")
    for problem in survey.problems:
        print_line(f"  - {use_option_names(problem)}")


def _format_counts(counts: dict[str, int]) -> str:
    """Return counts by name as text, such as "98 of 400 x 266, 2 of 266 x 400"."""
    parts = [f"{count:,} of {name}" for name, count in list(counts.items())[:_MAX_LISTED_KINDS]]
    unlisted_count = len(counts) - _MAX_LISTED_KINDS
    return ", ".join(parts) + (f" and {unlisted_count} more kinds" if unlisted_count > 0 else "")

"""Differences between runs, and checks whether their scores can be compared."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence

from hyrfpack.errors import HyrfDataError
from hyrfpack.report.run import Run

ALWAYS_SHOWN_SETTINGS = ("steps", "seed")


def find_differing_settings(runs: Sequence[Run]) -> dict[str, list[str]]:
    """Return, by name, the values of all runs for the settings and facts that differ between runs."""
    values_of_runs = []
    for run in runs:
        settings = {name: value for name, value in run.settings.items() if name not in ALWAYS_SHOWN_SETTINGS}
        scene = {f"scene: {name}": value for name, value in _without_repetition(run.scene).items()}
        run_facts = {"device": run.device, "processes": f"{run.processes:,}"}
        values_of_runs.append({**dict(_flatten(settings)), **dict(_flatten(scene)), **run_facts})
    return _differing_rows(values_of_runs)


def find_differing_choices(runs: Sequence[Run]) -> dict[str, list[str]]:
    """Return, by name, the automatic choices of all runs, with reasons, where they differ between runs."""
    return _differing_rows([run.choices for run in runs])


def find_differing_notes(runs: Sequence[Run]) -> list[list[str]]:
    """Return for each run its notes that are not common to all runs."""
    common = set.intersection(*(set(run.notes) for run in runs))
    return [[note for note in run.notes if note not in common] for run in runs]


def check_scores(runs: Sequence[Run], names: Sequence[str]) -> None:
    """Check that the scores of all runs are of the same photos.

    Raises:
        HyrfDataError: two runs have held-out photos of different names.
    """
    scored = [(run, name) for run, name in zip(runs, names, strict=True) if run.held_out]
    for (first, first_name), (run, name) in zip(scored[:1] * len(scored), scored, strict=True):
        if run.held_out != first.held_out:
            example = min(run.held_out ^ first.held_out)
            raise HyrfDataError(
                f"{run.folder}: the runs '{first_name}' and '{name}' hold out different photos "
                f"({len(first.held_out)} and {len(run.held_out)}; '{example}' is in only one of them), so that their "
                "scores cannot be compared",
                fix="train both on the same photos with the same `test_every`",
            )


def describe_doubts(runs: Sequence[Run], names: Sequence[str], changed: Sequence[str]) -> list[str]:
    """Return a sentence for each reason why some numbers of the runs cannot be compared.

    Args:
        runs: the runs.
        names: their names on the page.
        changed: names of held-out photos that differ between the pictures of the runs.
    """
    doubts = []
    without_scores = [name for run, name in zip(runs, names, strict=True) if not run.scores]
    if without_scores and len(without_scores) < len(runs):
        doubts.append(
            f"No photos were held out in {_quoted(without_scores)}, so only the curves and the sizes can be compared."
        )
    elif without_scores:
        doubts.append("No photos were held out in these runs, so only their curves and sizes are compared.")
    if changed:
        doubts.append(
            f"The held-out photos differ between the runs (such as {_quoted(changed[:1])}), so their scores cannot be "
            "compared. The scene, the size, the undistortion or the colour behind transparent photos is different."
        )
    elif any(run.cameras != runs[0].cameras for run in runs):
        doubts.append(
            "The runs were trained from different cameras, so their curves cannot be compared. The photos, the poses, "
            "the sizes or the scene are different."
        )
    return doubts


def _without_repetition(scene: Mapping) -> dict:
    """Return the facts about a scene, whose "reading" repeats some of them, with each of them once."""
    reading = scene.get("reading")
    if not isinstance(reading, dict):
        return dict(scene)
    return {**scene, "reading": {name: value for name, value in reading.items() if name not in scene}}


def _quoted(names: Sequence[str]) -> str:
    quoted = [f"'{name}'" for name in names]
    return quoted[0] if len(quoted) == 1 else f"{', '.join(quoted[:-1])} and {quoted[-1]}"


def _flatten(values: Mapping, prefix: str = "") -> Iterator[tuple[str, str]]:
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _flatten(value, f"{prefix}{name}: ")
        else:
            yield f"{prefix}{name}".replace("_", " "), _format_value(value)


def _format_value(value: object) -> str:
    if value is None:
        return "not given"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list):
        return ", ".join(map(_format_value, value))
    return f"{value:,}" if isinstance(value, int) else str(value)


def _differing_rows(values_of_runs: Sequence[Mapping[str, str]]) -> dict[str, list[str]]:
    """Return, by name, the values of all runs where they differ; a dash stands for a missing value."""
    names = dict.fromkeys(itertools.chain.from_iterable(values_of_runs))
    rows = {name: [values.get(name, "-") for values in values_of_runs] for name in names}
    return {name.replace("_", " "): row for name, row in rows.items() if len(set(row)) > 1}

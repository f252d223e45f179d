"""What tells runs apart, and whether their scores may be compared at all."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence

from hyrfpack.compare.run import Run
from hyrfpack.errors import HyrfDataError

SHOWN_ANYWAY = ("steps", "seed")


def settings_that_differ(runs: Sequence[Run]) -> dict[str, list[str]]:
    """Values of each setting, of the scene's facts and of the device that are not the same in all runs, in words."""
    told = []
    for run in runs:
        settings = {name: value for name, value in run.settings.items() if name not in SHOWN_ANYWAY}
        scene = {f"scene: {name}": value for name, value in run.scene.items()}
        told.append({**dict(_flat(settings)), **dict(_flat(scene)), "device": run.device})
    return _rows(told)


def choices_that_differ(runs: Sequence[Run]) -> dict[str, list[str]]:
    """What was chosen, with its reason, where that is not the same in all runs."""
    return _rows([run.choices for run in runs])


def notes_that_differ(runs: Sequence[Run]) -> list[list[str]]:
    """Of each run the notes that not all runs have."""
    common = set.intersection(*(set(run.notes) for run in runs))
    return [[note for note in run.notes if note not in common] for run in runs]


def check_scores(runs: Sequence[Run], names: Sequence[str]) -> None:
    """Refuse runs whose scores are of different photos.

    Raises:
        HyrfDataError: two runs have held-out photos of different names.
    """
    scored = [(run, name) for run, name in zip(runs, names, strict=True) if run.held_out]
    for (first, first_name), (other, name) in zip(scored[:1] * len(scored), scored, strict=True):
        if other.held_out != first.held_out:
            odd = min(other.held_out ^ first.held_out)
            raise HyrfDataError(
                f"{other.folder}: other photos are held out of '{name}' ({len(other.held_out)}) than of '{first_name}' "
                f"({len(first.held_out)}; '{odd}' of one of them alone), so that scores cannot be compared; train both "
                "on the same photos with the same `test_every`"
            )


def doubts(runs: Sequence[Run], names: Sequence[str], changed: Sequence[str]) -> list[str]:
    """One sentence for each reason why runs cannot be compared by all their numbers.

    Args:
        changed: names of held-out photos that do not look the same in all runs' pictures.
    """
    found = []
    without = [name for run, name in zip(runs, names, strict=True) if not run.scores]
    if without and len(without) < len(runs):
        found.append(
            f"No photo is held out of {_listed(without)}, so that only the curves and the sizes can be compared."
        )
    elif without:
        found.append("No photo is held out of these runs, so that only their curves and sizes are compared.")
    if changed:
        found.append(
            f"Held-out photos are not the same pictures in all runs ({_listed(changed[:1])} for one): another scene, "
            "size or undistortion, or another colour behind transparent photos; the scores cannot be compared."
        )
    elif any(run.cameras != runs[0].cameras for run in runs):
        found.append(
            "The runs were trained from different cameras: other photos, poses or sizes, or another scene; the curves "
            "cannot be compared."
        )
    return found


def _listed(names: Sequence[str]) -> str:
    quoted = [f"'{name}'" for name in names]
    return quoted[0] if len(quoted) == 1 else f"{', '.join(quoted[:-1])} and {quoted[-1]}"


def _flat(values: Mapping, above: str = "") -> Iterator[tuple[str, str]]:
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{above}{name}: ")
        else:
            yield f"{above}{name}".replace("_", " "), _in_words(value)


def _in_words(value: object) -> str:
    if value is None:
        return "not given"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list):
        return ", ".join(map(_in_words, value))
    return f"{value:,}" if isinstance(value, int) else str(value)


def _rows(told: Sequence[Mapping[str, str]]) -> dict[str, list[str]]:
    """By name, the values of all runs where they are not the same; a dash where a run has none."""
    names = dict.fromkeys(itertools.chain.from_iterable(told))
    rows = {name: [values.get(name, "-") for values in told] for name in names}
    return {name.replace("_", " "): row for name, row in rows.items() if len(set(row)) > 1}

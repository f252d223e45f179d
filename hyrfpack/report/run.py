"""Read and check the folder of a finished training run."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hyrfpack.errors import HyrfDataError
from hyrfpack.format import describe_file
from hyrfpack.format.run_folder import CHECKPOINT_FILE, METRICS_FILE, MODEL_FILE, advise_on_unfinished_run
from hyrfpack.outputs import StrPath
from hyrfpack.render.files import unique_stems
from hyrfpack.train.results import VIEWS_FOLDER

# Steps, counts, sizes and times of real runs are smaller; a larger number means that the metrics are damaged.
MAX_NUMBER = 1e15
TYPE_NAMES: dict[type, str] = {str: "text", list: "a list", dict: "an object"}


@dataclass(frozen=True)
class Record:
    """A recorded training step; `seconds` is the training time up to its end, None in runs of older versions."""

    step: int
    psnr: float
    gaussians: int
    seconds: float | None


@dataclass(frozen=True)
class Score:
    """Scores of a held-out view: PSNR in dB, SSIM, and LPIPS, which is None if it was not measured."""

    name: str
    psnr: float
    ssim: float
    lpips: float | None


@dataclass(frozen=True)
class Run:
    """A finished training run.

    Attributes:
        folder: folder of the run.
        files: bytes of each `.hyrf` file in the folder, by name, the model first.
        gaussians: number of Gaussians of the model.
        seconds: training time.
        settings, scene: the settings and the scene facts of the metrics.
        device: device of the training.
        choices: automatic choices by name, each with its reason.
        notes: notes of the reader of photos.
        curve: recorded training steps, at least one.
        psnr, ssim, lpips: means over the held-out photos; None if there are none.
        scores: scores of each held-out photo.
        skipped: names of held-out photos whose mask leaves no pixel to score.
        pictures: path of the picture of photo, render and error map, by the name of the photo.
        cameras: training cameras, as in the provenance of the model's file.
    """

    folder: Path
    files: dict[str, int]
    gaussians: int
    seconds: float
    settings: dict
    scene: dict
    device: str
    processes: int
    choices: dict[str, str]
    notes: list[str]
    curve: list[Record]
    psnr: float | None
    ssim: float | None
    lpips: float | None
    scores: list[Score]
    skipped: list[str]
    pictures: dict[str, Path]
    cameras: Any

    @property
    def held_out(self) -> set[str]:
        """Names of the held-out photos, scored or not."""
        return {score.name for score in self.scores} | set(self.skipped)


class _DamagedMetrics(Exception):
    """The metrics are damaged; the message describes the damage in a few words."""


def read_run(folder: StrPath) -> Run:
    """Read a folder that `hyrfpack train` wrote.

    Raises:
        HyrfDataError: the folder has no finished run, or the metrics are damaged.
        HyrfFormatError: the model is damaged.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise HyrfDataError(f"{folder}: there is no such folder", fix="name one that 'hyrfpack train' wrote to")
    if (folder / CHECKPOINT_FILE).exists():
        raise HyrfDataError(
            f"{folder}: the run has not finished ({CHECKPOINT_FILE} still exists)",
            fix=advise_on_unfinished_run(folder),
        )
    for name in (METRICS_FILE, MODEL_FILE):
        if not (folder / name).is_file():
            raise HyrfDataError(
                f"{folder}: there is no {name}, so this is not the folder of a finished run",
                fix="give the folder of a finished run",
            )
    path = folder / METRICS_FILE
    try:
        metrics = json.loads(path.read_text("utf-8"), parse_constant=_refuse_constant)
        return _parse_run(folder, metrics)
    except OSError as error:
        raise HyrfDataError(
            f"{path}: the file cannot be read ({error.strerror})",
            fix="check its permissions",
        ) from error
    except _DamagedMetrics as error:
        reason = str(error)
    except (ValueError, RecursionError):
        reason = "it is not JSON"
    raise HyrfDataError(f"{path}: the metrics are damaged ({reason})", fix="train the run anew with `overwrite=True`")


def _refuse_constant(name: str) -> None:
    raise _DamagedMetrics(f"a number in it is {name}")


def _parse_run(folder: Path, metrics: Any) -> Run:
    """Return the run that the metrics describe; raise _DamagedMetrics if they are damaged."""
    if not isinstance(metrics, dict):
        raise _DamagedMetrics("it is not an object")
    evaluation = _read_field(metrics, "evaluation", dict) if "evaluation" in metrics else {}
    scores = [_parse_score(values) for values in _read_field(evaluation, "views", list)] if evaluation else []
    skipped = list(map(str, _read_field(evaluation, "skipped", list))) if evaluation else []
    curve = [_parse_record(values) for values in _read_field(metrics, "curve", list)]
    if not curve:
        raise _DamagedMetrics("'curve' is empty")
    settings = _read_field(metrics, "settings", dict)
    for name in ("steps", "seed"):
        _read_number(settings, name, int, maximum=2**64)
    if settings["steps"] < 1:
        raise _DamagedMetrics("'steps' is less than 1")
    return Run(
        folder=folder,
        files=_file_sizes(folder),
        gaussians=_read_number(metrics, "gaussians", int),
        seconds=_read_number(metrics, "seconds"),
        settings=settings,
        scene=_read_field(metrics, "scene", dict),
        device=str(metrics.get("device", "")),
        processes=_read_number(metrics, "processes", int) if "processes" in metrics else 1,
        choices={name: str(reason) for name, reason in _read_field(metrics, "choices", dict).items()},
        notes=list(map(str, _read_field(metrics, "notes", list))),
        curve=curve,
        psnr=_read_number(evaluation, "psnr") if evaluation else None,
        ssim=_read_number(evaluation, "ssim") if evaluation else None,
        lpips=_read_optional_number(evaluation, "lpips"),
        scores=scores,
        skipped=skipped,
        pictures=_existing_pictures(folder, [*(score.name for score in scores), *skipped]),
        cameras=describe_file(folder / MODEL_FILE)["provenance"].get("cameras"),
    )


def _parse_score(values: Any) -> Score:
    return Score(
        _read_field(values, "name", str),
        _read_number(values, "psnr"),
        _read_number(values, "ssim"),
        _read_optional_number(values, "lpips"),
    )


def _parse_record(values: Any) -> Record:
    return Record(
        _read_number(values, "step", int),
        _read_number(values, "psnr"),
        _read_number(values, "gaussians", int),
        _read_optional_number(values, "seconds"),
    )


def _read_field(values: Any, name: str, kind: type) -> Any:
    if not isinstance(values, dict) or not isinstance(values.get(name), kind):
        raise _DamagedMetrics(f"'{name}' is missing or not {TYPE_NAMES[kind]}")
    return values[name]


def _read_number(values: Any, name: str, kind: type = float, maximum: float = MAX_NUMBER) -> Any:
    value: Any = values.get(name) if isinstance(values, dict) else None
    has_right_type = isinstance(value, int | float if kind is float else int) and not isinstance(value, bool)
    if not has_right_type or not abs(value) <= maximum:  # also rejects NaN
        raise _DamagedMetrics(f"'{name}' is missing or not a number in its range")
    return value


def _read_optional_number(values: Mapping, name: str) -> float | None:
    return None if values.get(name) is None else _read_number(values, name)


def _file_sizes(folder: Path) -> dict[str, int]:
    """Return the bytes of each `.hyrf` file, the model first."""
    names = sorted(path.name for path in folder.glob("*.hyrf") if path.is_file() and path.name != MODEL_FILE)
    return {name: os.path.getsize(folder / name) for name in (MODEL_FILE, *names)}


def _existing_pictures(folder: Path, names: Sequence[str]) -> dict[str, Path]:
    """Return the paths of the existing pictures of `evaluate`, by the name of their photo."""
    files = {name: folder / VIEWS_FOLDER / f"{file}.png" for name, file in zip(names, unique_stems(names), strict=True)}
    return {name: path for name, path in files.items() if path.is_file()}


def choose_short_names(folders: Sequence[Path]) -> list[str]:
    """Return a short name for each run: the last parts of its path that distinguish it from the other runs."""
    parts = [Path(os.path.abspath(folder)).parts for folder in folders]
    for count in range(1, max(map(len, parts)) + 1):
        names = ["/".join(part[-count:]) for part in parts]
        if len(set(names)) == len(names):
            break
    return names

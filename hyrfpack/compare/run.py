"""What a training run left in its folder, checked."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hyrfpack.errors import HyrfDataError
from hyrfpack.format import describe
from hyrfpack.format.run_folder import CHECKPOINT_FILE, METRICS_FILE, MODEL_FILE
from hyrfpack.outputs import StrPath
from hyrfpack.render.files import unique_stems
from hyrfpack.train.run import VIEWS

LARGEST = 1e15  # no step, count, size or time in the metrics of a run that ever was is larger
KINDS: dict[type, str] = {str: "text", list: "a list", dict: "an object"}


@dataclass(frozen=True)
class Record:
    """A step of a run; `seconds` of training up to its end, None in runs of versions that kept none."""

    step: int
    psnr: float
    gaussians: int
    seconds: float | None


@dataclass(frozen=True)
class Score:
    """A held-out view: PSNR in dB, SSIM, and LPIPS where it was measured."""

    name: str
    psnr: float
    ssim: float
    lpips: float | None


@dataclass(frozen=True)
class Run:
    """A finished training run.

    Attributes:
        folder: where it lies.
        files: bytes of each `.hyrf` file in the folder, by name, the model first.
        gaussians, seconds: of the model; of its training.
        settings, scene: as the metrics tell them.
        device: where it was trained.
        choices: what was chosen, each with its reason.
        notes: what the reader of photos had to say.
        curve: at least one record.
        psnr, ssim, lpips: means over the held-out photos; None where there are none.
        scores: of each held-out photo.
        skipped: names of held-out photos that their masks leave nothing of.
        pictures: the file of photo, render and error map, by the name of its photo.
        cameras: that it was trained from, in the numbers of the model's file.
    """

    folder: Path
    files: dict[str, int]
    gaussians: int
    seconds: float
    settings: dict
    scene: dict
    device: str
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


class _Broken(Exception):
    """What is wrong with the metrics, in a few words."""


def read_run(folder: StrPath) -> Run:
    """Read what `hyrfpack train` left in a folder.

    Raises:
        HyrfDataError: there is no finished run in it, or its metrics are damaged.
        HyrfFormatError: its model is damaged.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise HyrfDataError(f"{folder}: there is no such folder; name one that 'hyrfpack train' wrote to")
    if (folder / CHECKPOINT_FILE).exists():
        raise HyrfDataError(
            f"{folder}: this run is not finished ({CHECKPOINT_FILE} is there); the 'hyrfpack train' command that "
            "started it finishes it with `resume=True` (instead of `overwrite=True`)"
        )
    for name in (METRICS_FILE, MODEL_FILE):
        if not (folder / name).is_file():
            raise HyrfDataError(f"{folder}: there is no {name}, so this is no finished run; name a folder of one")
    path = folder / METRICS_FILE
    try:
        metrics = json.loads(path.read_text("utf-8"), parse_constant=_refuse_constant)
        return _run(folder, metrics)
    except OSError as error:
        raise HyrfDataError(f"{path}: the file cannot be read ({error.strerror}); check its permissions") from error
    except _Broken as error:
        reason = str(error)
    except (ValueError, RecursionError):
        reason = "it is no JSON"
    raise HyrfDataError(f"{path}: the metrics are damaged ({reason}); train the run anew with `overwrite=True`")


def _refuse_constant(name: str) -> None:
    raise _Broken(f"a number in it is {name}")


def _run(folder: Path, metrics: Any) -> Run:
    """A run of what its metrics say; raises _Broken where they make no sense."""
    if not isinstance(metrics, dict):
        raise _Broken("it is no object")
    evaluation = _take(metrics, "evaluation", dict) if "evaluation" in metrics else {}
    scores = [_score(values) for values in _take(evaluation, "views", list)] if evaluation else []
    skipped = list(map(str, _take(evaluation, "skipped", list))) if evaluation else []
    curve = [_record(values) for values in _take(metrics, "curve", list)]
    if not curve:
        raise _Broken("'curve' is empty")
    settings = _take(metrics, "settings", dict)
    for name in ("steps", "seed"):
        _number(settings, name, int, most=2**64)
    if settings["steps"] < 1:
        raise _Broken("'steps' is not a number that can be")
    return Run(
        folder=folder,
        files=_files(folder),
        gaussians=_number(metrics, "gaussians", int),
        seconds=_number(metrics, "seconds"),
        settings=settings,
        scene=_take(metrics, "scene", dict),
        device=str(metrics.get("device", "")),
        choices={name: str(reason) for name, reason in _take(metrics, "choices", dict).items()},
        notes=list(map(str, _take(metrics, "notes", list))),
        curve=curve,
        psnr=_number(evaluation, "psnr") if evaluation else None,
        ssim=_number(evaluation, "ssim") if evaluation else None,
        lpips=_optional(evaluation, "lpips"),
        scores=scores,
        skipped=skipped,
        pictures=_pictures(folder, [*(score.name for score in scores), *skipped]),
        cameras=describe(folder / MODEL_FILE)["provenance"].get("cameras"),
    )


def _score(values: Any) -> Score:
    return Score(
        _take(values, "name", str), _number(values, "psnr"), _number(values, "ssim"), _optional(values, "lpips")
    )


def _record(values: Any) -> Record:
    return Record(
        _number(values, "step", int),
        _number(values, "psnr"),
        _number(values, "gaussians", int),
        _optional(values, "seconds"),
    )


def _take(values: Any, name: str, kind: type) -> Any:
    if not isinstance(values, dict) or not isinstance(values.get(name), kind):
        raise _Broken(f"'{name}' is missing or not {KINDS[kind]}")
    return values[name]


def _number(values: Any, name: str, kind: type = float, most: float = LARGEST) -> Any:
    value: Any = values.get(name) if isinstance(values, dict) else None
    right = isinstance(value, int | float if kind is float else int) and not isinstance(value, bool)
    if not right or not abs(value) <= most:  # NaN is not, either
        raise _Broken(f"'{name}' is missing or not a number that can be")
    return value


def _optional(values: Mapping, name: str) -> float | None:
    return None if values.get(name) is None else _number(values, name)


def _files(folder: Path) -> dict[str, int]:
    """Bytes of each `.hyrf` file, the model first."""
    names = sorted(path.name for path in folder.glob("*.hyrf") if path.is_file() and path.name != MODEL_FILE)
    return {name: os.path.getsize(folder / name) for name in (MODEL_FILE, *names)}


def _pictures(folder: Path, names: Sequence[str]) -> dict[str, Path]:
    """The files of `evaluate`'s pictures that are there, by the name of their photo."""
    files = {name: folder / VIEWS / f"{file}.png" for name, file in zip(names, unique_stems(names), strict=True)}
    return {name: path for name, path in files.items() if path.is_file()}


def short_names(folders: Sequence[Path]) -> list[str]:
    """What to call runs: as many of the last parts of their paths as tell them apart."""
    parts = [Path(os.path.abspath(folder)).parts for folder in folders]
    for count in range(1, max(map(len, parts)) + 1):
        names = ["/".join(part[-count:]) for part in parts]
        if len(set(names)) == len(names):
            break
    return names

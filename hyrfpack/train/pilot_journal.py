"""The finished pilot runs of a training run, kept in its folder so that a resumed run does not repeat them."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hyrfpack.atomic import remove_if_possible, write_atomic
from hyrfpack.config.train import TrainConfig
from hyrfpack.errors import HyrfError
from hyrfpack.format.run_folder import PILOT_CHECKPOINT_FILE, PILOTS_FILE
from hyrfpack.scene import View
from hyrfpack.train.checkpoint import names_and_sizes

_LOG = logging.getLogger(__name__)

JOURNAL_VERSION = 1
# Shorter pilots are repeated. Writing their checkpoints would take a large part of their time.
MIN_CHECKPOINT_STEPS = 1_000


@dataclass(frozen=True)
class PilotScore:
    """The scores of one pilot run on the validation photos.

    Attributes:
        steps, seed: number of steps and random seed of the pilot run.
        run_steps: number of steps that the user asked for, of the run that the pilot precedes.
        max_gaussians: Gaussian budget of the run.
        exposure: whether per-image gains were learnt, and renders exposed by the map fitted to them.
        psnr, ssim, psnr_corrected: means over the validation photos, see `hyrfpack.Evaluation`.
        psnr_per_view: PSNR of each validation photo in dB.
    """

    steps: int
    run_steps: int
    seed: int
    max_gaussians: int
    exposure: bool
    psnr: float
    ssim: float
    psnr_corrected: float
    psnr_per_view: list[float] = field(default_factory=list)


class PilotJournal:
    """Scores of finished pilots, which are also kept in a folder, and the checkpoint of the pilot in progress."""

    def __init__(
        self, folder: Path | None = None, scores: Mapping[str, PilotScore] | None = None, *, checkpoints: bool = True
    ) -> None:
        """Start with known scores.

        Args:
            folder: folder of the run; None keeps nothing on disk.
            scores: scores of pilots by key, as `read_scores` returns them.
            checkpoints: whether pilots have checkpoints.
        """
        self._folder, self._scores, self._has_checkpoints = folder, dict(scores or {}), checkpoints

    def find(self, key: str) -> PilotScore | None:
        """Return the score of a finished pilot; None if there is none with this key."""
        return self._scores.get(key)

    def checkpoint(self, steps: int) -> Path | None:
        """Return the path of the checkpoint of a pilot of `steps` steps; None if it is not to have one."""
        if self._folder is None or not self._has_checkpoints or steps < MIN_CHECKPOINT_STEPS:
            return None
        return self._folder / PILOT_CHECKPOINT_FILE

    def add(self, key: str, score: PilotScore) -> None:
        """Keep the score of a finished pilot, and remove its checkpoint; warn if the score cannot be written."""
        self._scores[key] = score
        if self._folder is None:
            return
        scores = {key: dataclasses.asdict(score) for key, score in self._scores.items()}
        try:
            write_atomic(
                self._folder / PILOTS_FILE, json.dumps({"version": JOURNAL_VERSION, "scores": scores}).encode()
            )
        except HyrfError as error:
            _LOG.warning(f"{error}; training continues, and would repeat this pilot run if it were interrupted")
        remove_if_possible(self._folder / PILOT_CHECKPOINT_FILE)


def pilot_key(settings: TrainConfig, run_steps: int, training: Sequence[View], validation: Sequence[View] = ()) -> str:
    """Return the key of a pilot or teacher run: a digest of its settings, and of names and sizes of its photos.

    Args:
        settings: settings of the pilot or teacher run.
        run_steps: number of steps of the run that it precedes.
        training, validation: the photos it is trained and scored on.
    """
    inputs = {
        "settings": settings.to_dict(),
        "run_steps": run_steps,
        "training": names_and_sizes(training),
        "validation": names_and_sizes(validation),
    }
    return hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()


def read_scores(folder: Path) -> dict[str, PilotScore]:
    """Read the scores of finished pilots by key; none if there is no file, or it is damaged or of another version."""
    try:
        content = json.loads((folder / PILOTS_FILE).read_bytes())
        if content["version"] != JOURNAL_VERSION:
            return {}
        return {key: _parse_score(entry) for key, entry in content["scores"].items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
        return {}


def _parse_score(entry: dict[str, Any]) -> PilotScore:
    """Return a score from a file, which may be damaged or hostile.

    Raises:
        TypeError: a field is missing or unknown, or has a value of another type.
    """
    score = PilotScore(**entry)
    numbers = (score.psnr, score.ssim, score.psnr_corrected, *score.psnr_per_view)
    counts = (score.steps, score.run_steps, score.seed, score.max_gaussians)
    if not (
        isinstance(score.psnr_per_view, list)
        and all(type(number) in (int, float) and math.isfinite(number) for number in numbers)
        and all(type(count) is int for count in counts)
        and type(score.exposure) is bool
    ):
        raise TypeError("a field of a pilot's score has a value of another type")
    return score

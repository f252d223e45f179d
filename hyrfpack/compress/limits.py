"""Searches for the best file within a number of bytes, and for the smallest one within a loss of PSNR."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import count

from hyrfpack.compress.distortion import DISTORTION_RANGE
from hyrfpack.compress.search import find_coarsest, find_fullest
from hyrfpack.errors import HyrfError, HyrfSizeError
from hyrfpack.evaluate import evaluate_model
from hyrfpack.model import HybridModel
from hyrfpack.model.merged import MergedModel
from hyrfpack.progress import Progress, TaskEvent, part_of_progress, round_of_progress
from hyrfpack.scene import View

_LOG = logging.getLogger(__name__)

SEARCH_TRIALS = 9
# Fine-tuning takes long, so a search over fine-tuned files makes fewer trials.
FINETUNED_SEARCH_TRIALS = 4


@dataclass(frozen=True)
class EncodedCandidate:
    """An encoded file of the model, and the errors of its pictures.

    Attributes:
        data: the bytes of the file.
        predicted_errors: predicted mean squared error that compression adds to pictures, by section and for PRUNED_KEY.
        measured_error: mean squared error measured on renders; 0 if it was not measured.
        psnr_drop: measured loss of PSNR in dB; 0 if it was not measured.
    """

    data: bytes
    predicted_errors: dict[str, float]
    measured_error: float = 0.0
    psnr_drop: float = 0.0


# Encodes a file that adds a distortion to the pictures.
Encode = Callable[[float, Progress], EncodedCandidate]


def encode_within_bytes(
    encode: Encode, limit: int, start: float, progress: Progress, trials: int = SEARCH_TRIALS
) -> tuple[EncodedCandidate, str]:
    """Search for the best file of at most `limit` bytes, from distortion `start`; return it and a description.

    Raises:
        HyrfSizeError: even the largest distortion gives a larger file.
    """
    rounds = count()

    def encode_candidate(distortion: float) -> EncodedCandidate:
        candidate = encode(distortion, round_of_progress(progress, next(rounds)))
        _LOG.info(f"distortion {distortion:.2g}: {len(candidate.data):,} bytes")
        return candidate

    distortion, candidate = find_fullest(
        encode_candidate, lambda candidate: len(candidate.data), limit, start, trials, DISTORTION_RANGE
    )
    if (smallest := len(candidate.data)) > limit:
        raise HyrfSizeError(
            f"the model does not fit into {limit:,} bytes: with the coarsest numbers it still takes {smallest:,} bytes",
            fix=f"use a `target_bytes` of at least {smallest:,}, or train with fewer Gaussians (`max_gaussians`)",
            min_bytes=smallest,
        )
    return candidate, f"distortion {distortion:.2g} gives {len(candidate.data):,} of {limit:,} bytes"


def encode_within_psnr_drop(
    encode: Encode,
    decode: Callable[[EncodedCandidate], HybridModel | MergedModel],
    model: HybridModel | MergedModel,
    views: Sequence[View],
    limit: float,
    start: float,
    progress: Progress,
    trials: int = SEARCH_TRIALS,
) -> tuple[EncodedCandidate, str]:
    """Search for the smallest file that loses at most `limit` dB of PSNR on photos; return it and a description.

    Raises:
        HyrfError: even the smallest distortion loses more.
    """
    progress(TaskEvent("scoring the model", 0.0))
    before = evaluate_model(model, views).psnr
    rounds = count()

    def encode_candidate(distortion: float) -> EncodedCandidate:
        trial_progress = round_of_progress(progress, next(rounds))
        candidate = encode(distortion, part_of_progress(trial_progress, 0.0, 0.7))
        trial_progress(TaskEvent("scoring the file", 0.7))
        psnr_drop = before - evaluate_model(decode(candidate), views).psnr
        _LOG.info(f"distortion {distortion:.2g}: {len(candidate.data):,} bytes, {psnr_drop:+.3f} dB lost")
        return dataclasses.replace(candidate, psnr_drop=psnr_drop)

    answer = find_coarsest(
        encode_candidate, lambda candidate: candidate.psnr_drop <= limit, start, trials, DISTORTION_RANGE
    )
    if answer is None:
        raise HyrfError(
            f"even the finest file loses more than {limit:g} dB of PSNR",
            fix="use a larger `max_psnr_drop`, or profile 'raw'",
        )
    distortion, candidate = answer
    return (
        candidate,
        f"distortion {distortion:.2g} loses {candidate.psnr_drop:+.3f} of {limit:g} dB on {len(views)} photos",
    )

"""Settings of an estimation of poses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from hyrfpack.choices import MATCHING_METHODS
from hyrfpack.config.settings import OneOf, Seed, check_settings


@dataclass(frozen=True)
class PosesConfig:
    """Settings that, with the photos and their masks, determine the poses.

    With `matching` "sequential", loops are matched, too. "auto" means exhaustive for up to 60 photos, sequential for
    videos and larger numbered bursts, and retrieval for other large sets.

    Attributes:
        matching: which pairs of photos are matched: all (exhaustive), neighbours in order (sequential), or photos that
            look alike (retrieval). auto decides by the kind and number of photos.
        seed: random seed.
    """

    matching: Annotated[str, OneOf(MATCHING_METHODS)] = "auto"
    seed: Seed = 0

    def __post_init__(self) -> None:
        check_settings(self)

"""Settings of the split of a model into chunks with levels of detail."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from hyrfpack.config.settings import OneLine, Range, Seed, check_settings

MAX_LEVELS = 8
MAX_TITLE_LENGTH = 1000  # of each text for people in the manifest
DEFAULT_CHUNK_GAUSSIANS = 16_384


@dataclass(frozen=True)
class SplitConfig:
    """Settings of a split.

    Attributes:
        chunk_gaussians: the most Gaussians of a chunk.
        levels: levels of detail of each chunk. Each has a quarter of the Gaussians of the next finer one; the finest is
            the model itself.
        refit_steps: steps in which each level's Gaussians are fitted to renders of the model; for each part of a merged
            file.
        title: title of the scene, for people. Default: the name of the source.
        licence: licence of the scene, for people.
        seed: random seed.
    """

    chunk_gaussians: Annotated[int, Range(64)] = DEFAULT_CHUNK_GAUSSIANS
    levels: Annotated[int, Range(1, MAX_LEVELS)] = 4
    refit_steps: Annotated[int, Range(0)] = 250
    title: Annotated[str | None, OneLine(MAX_TITLE_LENGTH)] = None
    licence: Annotated[str, OneLine(MAX_TITLE_LENGTH)] = ""
    seed: Seed = 0

    def __post_init__(self) -> None:
        check_settings(self)

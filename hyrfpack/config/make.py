"""Settings of making a scene from photos, end to end."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from hyrfpack.choices import MATCHING_METHODS, PRESETS, QUALITIES
from hyrfpack.config.settings import OneOf, Range, Seed, check_settings


@dataclass(frozen=True)
class MakeConfig:
    """Settings that, with the photos, determine a scene that `hyrfpack.make_scene` makes.

    `quality` sets steps and the size of photos; with `minutes`, a measurement chooses them. A later call with another
    `target_bytes` packs the trained model again, without training. See `hyrfpack.load_scene` on reading photos,
    `hyrfpack.estimate_poses` on `matching` and `hyrfpack.TrainConfig` on training.

    Attributes:
        quality: quality; a better one takes longer. Default: normal.
        minutes: instead of `quality`: finish in about N minutes, including poses.
        target_bytes: best quality within this file size, such as 2MB.
        max_gaussians: budget: the maximum number of Gaussians, instead of `target_bytes`. Default: measured by pilot
            runs.
        preset: kind of scene; auto detects it.
        matching: which pairs of photos are matched to estimate poses, see 'hyrfpack poses --help'.
        images: folder of the photos within PHOTOS, such as images_4.
        max_size: shrink photos whose longer side exceeds this; 0 keeps their size. Default: 1600; of a draft, 640.
        test_every: hold out every Nth photo for scoring; 0 holds out none. Default: 8; of fewer than 16 photos, one
            photo.
        seed: random seed. On a CPU, the same seed gives the same file.
    """

    quality: Annotated[str | None, OneOf(QUALITIES)] = None
    minutes: Annotated[float | None, Range(0.001, unit="n")] = None
    target_bytes: Annotated[int | None, Range(1, unit="bytes")] = None
    max_gaussians: Annotated[int | None, Range(1)] = None
    preset: Annotated[str, OneOf(PRESETS)] = "auto"
    matching: Annotated[str, OneOf(MATCHING_METHODS)] = "auto"
    images: str | None = None
    max_size: Annotated[int | None, Range(0, unit="pixels")] = None
    test_every: Annotated[int | None, Range(0)] = None
    seed: Seed = 0

    def __post_init__(self) -> None:
        check_settings(self)

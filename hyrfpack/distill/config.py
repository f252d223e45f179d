"""What decides the outcome of a distillation."""

from __future__ import annotations

from dataclasses import dataclass

from hyrfpack.checks import check_float, check_int
from hyrfpack.train.config import LARGEST_SEED


@dataclass(frozen=True)
class DistillConfig:
    """What decides the outcome of a distillation, besides the splats.

    Attributes:
        steps: optimiser steps of fitting to the original's pictures, one each.
        psnr: dB of held-out pictures against the original's that the file is made for: higher takes more bytes.
        size: pixels of the longer side of pictures.
        train_views, test_views: how many viewpoints are made up, to teach (at most) and to score.
        seed: of viewpoints, first weights and order; 0 to LARGEST_SEED.
    """

    steps: int = 300
    psnr: float = 37.0
    size: int = 400
    train_views: int = 240
    test_views: int = 16
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("steps", "size", "train_views", "test_views"):
            check_int(name, getattr(self, name), 1)
        check_float("psnr", self.psnr, 10, 60)
        check_int("seed", self.seed, 0, LARGEST_SEED)

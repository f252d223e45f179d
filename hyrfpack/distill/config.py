"""The settings of a distillation."""

from __future__ import annotations

from dataclasses import dataclass

from hyrfpack.checks import check_float, check_int
from hyrfpack.train.config import LARGEST_SEED


@dataclass(frozen=True)
class DistillConfig:
    """Settings that, with the splats, determine the result of a distillation.

    Attributes:
        steps: optimiser steps of fitting to reference renders of the splats, one render per step.
        psnr: target PSNR in dB of the file on held-out reference renders; a higher target takes more bytes.
        size: longer side of the renders in pixels.
        train_views, test_views: number of sampled viewpoints to train at (at most) and to score at.
        seed: random seed of the viewpoints, initial weights and order; 0 to LARGEST_SEED.
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

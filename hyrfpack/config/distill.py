"""Settings of a distillation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from hyrfpack.config.settings import Range, Seed, check_settings
from hyrfpack.errors import HyrfError

# From this PSNR in dB on, a file with residuals is smaller than one without, if that reaches the PSNR at all.
RESIDUALS_MIN_PSNR = 38.0


@dataclass(frozen=True)
class DistillConfig:
    """Settings that, with the splats, determine the result of a distillation.

    The model is fitted to reference renders of the splats, one a step. The renders, at most `train_views`, are taken
    from sampled viewpoints; `test_views` others score the file. If `psnr` is RESIDUALS_MIN_PSNR or more, and with
    `worst` or `target_bytes`, the file has residuals, which correct the shapes and colours of single Gaussians and take
    the place of training.

    Attributes:
        steps: training steps, for a PSNR below 38 dB.
        psnr: PSNR of renders of FILE against renders of SOURCE; more dB take more bytes.
        worst: PSNR that the worst view must reach, too.
        target_bytes: best quality within this file size, such as 2MB, instead of a PSNR.
        size: longer side of the reference renders.
        train_views, test_views: number of sampled viewpoints to train at and to score at.
        seed: random seed. On a CPU, the same seed gives the same file.
    """

    steps: Annotated[int, Range(1)] = 300
    psnr: Annotated[float, Range(10, 60, unit="dB")] = 37.0
    worst: Annotated[float | None, Range(10, 60, unit="dB")] = None
    target_bytes: Annotated[int | None, Range(1, unit="bytes")] = None
    size: Annotated[int, Range(16, 4096, unit="pixels")] = 400
    train_views: Annotated[int, Range(1)] = 240
    test_views: Annotated[int, Range(1)] = 16
    seed: Seed = 0

    def __post_init__(self) -> None:
        check_settings(self)
        if self.worst is not None and self.target_bytes is not None:
            raise HyrfError(
                "a target size and a PSNR of the worst view each decide how large the file is",
                fix="give one of `target_bytes` and `worst`",
            )

    @property
    def has_residuals(self) -> bool:
        """Whether the file gets residuals."""
        return self.psnr >= RESIDUALS_MIN_PSNR or self.worst is not None or self.target_bytes is not None

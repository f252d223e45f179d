"""Settings of an import."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from hyrfpack.config.settings import Range, Seed, check_settings
from hyrfpack.errors import HyrfError

DEFAULT_IMPORT_PSNR_DB = 37.0
MAX_IMPORT_PSNR_DB = 60


@dataclass(frozen=True)
class ImportConfig:
    """Settings that, with the splats, determine the result of an import.

    Sensitivities are measured at `views` sampled viewpoints, and compression is decided at others, three times
    `test_views`; `test_views` further ones score the file.

    Attributes:
        psnr: PSNR of renders of FILE against renders of SOURCE; more dB take more bytes. Default: 37
            without a target size.
        worst: PSNR that the worst view must reach, too.
        target_bytes: best quality within this file size, such as 2MB, instead of a PSNR.
        size: longer side of the reference renders.
        views, test_views: number of sampled viewpoints to measure at and to score at.
        seed: random seed. On a CPU, the same seed gives the same file.
    """

    psnr: Annotated[float | None, Range(10, MAX_IMPORT_PSNR_DB, unit="dB")] = None
    worst: Annotated[float | None, Range(10, MAX_IMPORT_PSNR_DB, unit="dB")] = None
    target_bytes: Annotated[int | None, Range(1, unit="bytes")] = None
    size: Annotated[int, Range(16, 4096, unit="pixels")] = 400
    views: Annotated[int, Range(1)] = 240
    test_views: Annotated[int, Range(1)] = 16
    seed: Seed = 0

    def __post_init__(self) -> None:
        check_settings(self)
        if self.worst is not None and self.target_bytes is not None:
            raise HyrfError(
                "a target size and a PSNR of the worst view each decide how large the file is",
                fix="give one of `target_bytes` and `worst`",
            )
        if self.psnr is not None and self.target_bytes is not None:
            raise HyrfError(
                "a target size and a PSNR each decide how large the file is",
                fix="give one of `target_bytes` and `psnr`",
            )

    @property
    def target_psnr(self) -> float:
        """The PSNR to reach in dB; with a target size, the one that the search for that size starts from."""
        return DEFAULT_IMPORT_PSNR_DB if self.psnr is None else self.psnr

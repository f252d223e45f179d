"""Settings of a compression."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Annotated, Any

from hyrfpack.checks import check_int, check_pair
from hyrfpack.config.settings import LARGEST_SEED, OneOf, Range, check_settings
from hyrfpack.errors import HyrfError

PROFILES = ("raw", "paper", "compact")
MIN_DISTORTION = 1e-12  # It is above 0, because quantisation steps are proportional to its square root.
MAX_VQ_STAGES = 16  # bounds the decoding time: each stage takes some milliseconds, even for few rows
MAX_VQ_CODEWORDS = 256


@dataclass(frozen=True)
class PaperSettings:
    """Settings of profile `paper`.

    The defaults take 26 to 27 bits per Gaussian in scenes of 8,000 Gaussians and more. On the six trained scenes (15
    to 32 dB) on which they were chosen, the whole profile lost at most 0.08 dB. One quantiser for all five numbers
    needs more bits for the same error: the colour channels are correlated, scales and opacities are not.

    Attributes:
        color, scale, opacity: (stages, codewords per stage) of the residual quantiser of these logits; 1 to 16 stages
            of 1 to 256 codewords.
        seed: random seed of the quantisers' k-means.
    """

    color: tuple[int, int] = (2, 128)
    scale: tuple[int, int] = (1, 128)
    opacity: tuple[int, int] = (1, 32)
    seed: int = 0

    def __post_init__(self) -> None:
        check_int("seed", self.seed, 0, LARGEST_SEED)
        for name in ("color", "scale", "opacity"):
            check_pair(name, getattr(self, name))
            stages, size = getattr(self, name)
            are_ints = isinstance(stages, int) and isinstance(size, int)
            if not (are_ints and 1 <= stages <= MAX_VQ_STAGES and 1 <= size <= MAX_VQ_CODEWORDS):
                raise HyrfError(
                    f"the paper profile was asked for {stages} stages of {size} codewords",
                    fix=f"use 1 to {MAX_VQ_STAGES} stages of 1 to {MAX_VQ_CODEWORDS}",
                )


@dataclass(frozen=True)
class CompressConfig:
    """Settings that, with the model and its photos, determine a compressed file.

    Profile "compact" measures how much each number of the model affects pictures and spends bits accordingly. By
    default it aims at a loss of `hyrfpack.compress.distortion.DEFAULT_PSNR_DROP_DB`. It accepts one of `distortion`,
    `target_bytes` and `max_psnr_drop`, which the other profiles do not accept.

    Attributes:
        profile: codecs of the file: compact is the smallest and spends bits where renders need them, paper follows the
            HyRF paper, raw is exact float32.
        distortion: estimated mean squared error that compression may add to pictures, colours in [0, 1].
        target_bytes: best quality within this file size, such as 2MB.
        max_psnr_drop: smallest file that loses at most this PSNR, in dB, on the held-out photos of `data`.
        finetune_steps: fine-tune the quantised model on the photos for N steps: slower, but a smaller file.
        prune: prune Gaussians that renders do not need.
        paper: settings of profile "paper"; None for its defaults.
    """

    profile: Annotated[str, OneOf(PROFILES)] = "compact"
    distortion: Annotated[float | None, Range(MIN_DISTORTION)] = None
    target_bytes: Annotated[int | None, Range(1, unit="bytes")] = None
    max_psnr_drop: Annotated[float | None, Range(0, unit="dB")] = None
    finetune_steps: Annotated[int | None, Range(1)] = None
    prune: bool = True
    paper: PaperSettings | None = None

    def __post_init__(self) -> None:
        check_settings(self)

    def encoder_settings(self) -> dict[str, Any]:
        """Return the settings of the profile's encoder, see `hyrfpack.format.encode_model`."""
        return {} if self.paper is None else asdict(self.paper)

"""One measured setting."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from hyrfpack.measure.error import Error
from hyrfpack.measure.timing import Ratio, Timing

__all__ = ["Error", "Row", "in_words"]


@dataclass(frozen=True)
class Row:
    """One setting of one thing: how long it takes, and how far off it is.

    Attributes:
        group: what is measured, a name out of `hyrfpack.bench.GROUPS`.
        setting: what is varied there, such as "background_threshold".
        value: what it is set to, in words.
        is_reference: other rows' errors and ratios are against this one.
        is_default: what hyrfpack does when nothing else is said.
        time: of one call; in "render" of one picture, in "codec" of encoding.
        ratio: of this time to the reference's, which took turns with it.
        error: of the result against the reference's. Pictures: in colour units, [0, 1]. Features and gradients: the
            maximum as a fraction of the reference's largest number, the rms of its rms; of gradients the worst.
        parts: the same for each part by itself: gradients by input (relative), parameters by group (absolute).
        psnr, ssim: of the pictures against the photos, or without photos against the reference's pictures; means
            over views of 8-bit pictures. None where there is no picture.
        psnr_drop, ssim_drop: the reference's score minus this one's, in dB and SSIM. None without photos.
        bytes: of the file ("codec").
        decode, decode_ratio: as time and ratio, of decoding ("codec").
    """

    group: str
    setting: str
    value: str
    is_reference: bool
    is_default: bool
    time: Timing
    ratio: Ratio
    error: Error
    parts: dict[str, Error] = field(default_factory=dict)
    psnr: float | None = None
    ssim: float | None = None
    psnr_drop: float | None = None
    ssim_drop: float | None = None
    bytes: int | None = None
    decode: Timing | None = None
    decode_ratio: Ratio | None = None


def in_words(value: object) -> str:
    """A setting's value for people: 0.3, 1/255, none (for no limit), 2 x 128."""
    if isinstance(value, (list, tuple)):
        return " x ".join(in_words(part) for part in value)
    if isinstance(value, float):
        if math.isinf(value):
            return "none"
        if 0 < value < 0.01 and (1 / value).is_integer() and not math.log10(value).is_integer():
            return f"1/{1 / value:.0f}"
        return f"{value:g}"
    return str(value)

"""The row that one measurement gives."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from hyrfpack.measure.error import Error
from hyrfpack.measure.timing import Ratio, Timing

__all__ = ["Error", "Row", "format_value"]


@dataclass(frozen=True)
class Row:
    """Time and error of one value of one setting.

    Attributes:
        group: the group of measurements, one of `hyrfpack.bench.suite.ROW_FUNCTIONS_BY_GROUP`.
        setting: the setting that is varied, such as "background_threshold".
        value: the formatted value of the setting.
        is_reference: whether errors and ratios of other rows refer to this row.
        is_default: whether hyrfpack uses this value by default.
        time: time of one call; in "render" of one picture, in "codec" of encoding.
        ratio: ratio of this time to the reference's; both were measured in turns.
        error: error of the result against the reference's. Pictures: in colour units, [0, 1]. Features and gradients:
            the maximum relative to the reference's largest magnitude, the rms relative to its rms. Of several
            gradients, the largest errors are given.
        parts: errors of each part: relative errors of gradients by input, absolute errors of parameters by group.
        psnr, ssim: scores of 8-bit pictures, means over views, against the photos, or without photos against the
            reference's pictures. None if there is no picture.
        psnr_drop, ssim_drop: the reference's score minus this row's, in dB and SSIM. None without photos.
        bytes: size of the file in bytes ("codec").
        decode, decode_ratio: as `time` and `ratio`, for decoding ("codec").
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


def format_value(value: object) -> str:
    """Format the value of a setting for tables: 0.3, 1/255, none (for infinity), auto (for None), 2 x 128."""
    if value is None:
        return "auto"
    if isinstance(value, (list, tuple)):
        return " x ".join(format_value(part) for part in value)
    if isinstance(value, float):
        if math.isinf(value):
            return "none"
        if 0 < value < 0.01 and (1 / value).is_integer() and not math.log10(value).is_integer():
            return f"1/{1 / value:.0f}"
        return f"{value:g}"
    return str(value)

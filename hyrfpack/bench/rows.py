"""One measured setting, and how errors are told."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from hyrfpack.errors import HyrfError
from hyrfpack.measure.timing import Ratio, Timing


@dataclass(frozen=True)
class Error:
    """How far numbers are from what they should be: at most, and as a root mean square."""

    max: float
    rms: float


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


def difference(values: Tensor, reference: Tensor, what: str) -> Error:
    """Largest and root mean square difference of two tensors of one shape, worked out in float64.

    Raises:
        HyrfError: either holds NaN or infinity; `what` says in the message what was measured.
    """
    if not (torch.isfinite(values).all() and torch.isfinite(reference).all()):
        raise HyrfError(f"{what}: the result holds NaN or infinity, so there is no error to tell; check the model")
    off = values.detach().double() - reference.detach().double()
    if not off.numel():
        return Error(0.0, 0.0)
    return Error(float(off.abs().max()), float(off.square().mean().sqrt()))


def relative_difference(values: Tensor, reference: Tensor, what: str) -> Error:
    """As `difference`, over the reference's largest magnitude and over its rms; absolute where it is all zero."""
    off, size = difference(values, reference, what), difference(reference, torch.zeros_like(reference), what)
    return Error(off.max / (size.max or 1), off.rms / (size.rms or 1))


def worst(errors: Sequence[Error]) -> Error:
    """The largest maximum and the largest rms of several parts."""
    return Error(max(error.max for error in errors), max(error.rms for error in errors))


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

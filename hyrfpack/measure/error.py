"""How far numbers are off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from hyrfpack.errors import HyrfError


@dataclass(frozen=True)
class Error:
    """How far numbers are from what they should be: at most, and as a root mean square."""

    max: float
    rms: float


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

"""Largest and root mean square errors of tensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from hyrfpack.errors import HyrfError


@dataclass(frozen=True)
class Error:
    """The largest and the root mean square deviation of numbers from their reference."""

    max: float
    rms: float


def measure_error(values: Tensor, reference: Tensor, subject: str) -> Error:
    """Compute the largest and the root mean square difference of two tensors of the same shape, in float64.

    Args:
        values: the tensor to measure.
        reference: the correct values.
        subject: what is measured, for the error message.

    Raises:
        HyrfError: a tensor holds NaN or infinity.
    """
    if not (torch.isfinite(values).all() and torch.isfinite(reference).all()):
        raise HyrfError(
            f"{subject}: the result holds NaN or infinity, so that the error cannot be measured",
            fix="check the model",
        )
    deviation = values.detach().double() - reference.detach().double()
    if not deviation.numel():
        return Error(0.0, 0.0)
    return Error(float(deviation.abs().max()), float(deviation.square().mean().sqrt()))


def measure_relative_error(values: Tensor, reference: Tensor, subject: str) -> Error:
    """Compute errors relative to the reference: `max` to its largest magnitude, `rms` to its root mean square.

    The errors are absolute if the reference is all zero. Arguments and exceptions are those of `measure_error`.
    """
    absolute = measure_error(values, reference, subject)
    size = measure_error(reference, torch.zeros_like(reference), subject)
    return Error(absolute.max / (size.max or 1), absolute.rms / (size.rms or 1))


def largest_error(errors: Sequence[Error]) -> Error:
    """Return the largest `max` and the largest `rms` among several errors."""
    return Error(max(error.max for error in errors), max(error.rms for error in errors))

"""Measure the errors of a kernel's values and gradients against float64, and compare them with their bounds."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from hyrfpack.bench.operation_calls import OperationCall
from hyrfpack.errors import HyrfError
from hyrfpack.measure.error import measure_relative_error


def check_call(call: OperationCall, implementation: str) -> dict[str, object]:
    """Return both errors of a call as cells, with the status of a row for both passes."""
    forward, backward = check_passes(call, implementation)
    return forward | backward


def check_passes(call: OperationCall, implementation: str) -> tuple[dict[str, object], dict[str, object]]:
    """Return a call's value error and its largest gradient error, each as the cells and status of a row of its own."""
    exact, exact_gradients = call.forward_backward_task("reference", torch.float64)()
    measured, gradients = call.forward_backward_task(implementation)()
    value_error = relative_error(measured, exact)
    gradient_error = largest_relative_error(gradients, exact_gradients)
    value_bound, gradient_bound = call.error_bounds
    return (
        {"value error": value_error} | make_bound_status(value_error, value_bound),
        {"gradient error": gradient_error} | make_bound_status(gradient_error, gradient_bound),
    )


def make_bound_status(error: float, bound: float) -> dict[str, object]:
    """Return the "failed" status of a row whose error exceeds its bound, otherwise an empty dictionary."""
    if error <= bound:
        return {}
    return {"status": "failed", "note": f"the error against the float64 reference is {error:.1e}, beyond {bound:.0e}"}


def largest_relative_error(values: Iterable[Tensor], exact: Iterable[Tensor]) -> float:
    """Return the largest of the relative errors of several tensors, each relative to its own size; 0 for none."""
    return max((relative_error(a, b) for a, b in zip(values, exact, strict=True)), default=0.0)


def relative_error(values: Tensor, exact: Tensor) -> float:
    """Return the rms of the difference over the rms of the exact values; infinity if a value is not finite."""
    try:
        return measure_relative_error(values, exact, "").rms
    except HyrfError:
        return float("inf")

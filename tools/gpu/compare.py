"""Measure the errors of a kernel's values and gradients against float64, and compare them with their bounds."""

from __future__ import annotations

import torch
from torch import Tensor

from hyrfpack.bench.operation_calls import OperationCall
from hyrfpack.errors import HyrfError
from hyrfpack.measure.error import measure_relative_error


def check_call(call: OperationCall, implementation: str) -> dict[str, object]:
    """Return the error of a call's values and the largest error of its gradients as cells, with the row's status."""
    exact, exact_gradients = call.forward_backward_task("reference", torch.float64)()
    measured, gradients = call.forward_backward_task(implementation)()
    values = relative_error(measured, exact)
    worst = max((relative_error(a, b) for a, b in zip(gradients, exact_gradients, strict=True)), default=0.0)
    row: dict[str, object] = {"value error": values, "gradient error": worst}
    return row | status_beyond(values, call.error_bounds[0]) | status_beyond(worst, call.error_bounds[1])


def status_beyond(error: float, bound: float) -> dict[str, object]:
    """Return the "failed" status of a row whose error exceeds its bound, otherwise an empty dictionary."""
    if error <= bound:
        return {}
    return {"status": "failed", "note": f"the error against the float64 reference is {error:.1e}, beyond {bound:.0e}"}


def relative_error(values: Tensor, exact: Tensor) -> float:
    """Return the rms of the difference over the rms of the exact values; infinity if a value is not finite."""
    try:
        return measure_relative_error(values, exact, "").rms
    except HyrfError:
        return float("inf")

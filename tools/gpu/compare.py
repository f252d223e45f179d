"""How far a kernel's values and gradients are from the float64 reference's, and whether that is too far."""

from __future__ import annotations

import torch
from torch import Tensor

from hyrfpack.errors import HyrfError
from hyrfpack.measure.error import measure_relative_error
from hyrfpack.model.operation_calls import OperationCall


def checked(call: OperationCall, implementation: str) -> dict[str, object]:
    """The errors of a call's values and of its gradients, the worst of them, as cells of a row with its status."""
    exact, exact_gradients = call.forward_backward_task("reference", torch.float64)()
    found, gradients = call.forward_backward_task(implementation)()
    values = relative_error(found, exact)
    worst = max((relative_error(a, b) for a, b in zip(gradients, exact_gradients, strict=True)), default=0.0)
    row: dict[str, object] = {"value error": values, "gradient error": worst}
    return row | within(values, call.error_bounds[0]) | within(worst, call.error_bounds[1])


def within(error: float, bound: float) -> dict[str, object]:
    """Nothing, or the status of a row whose error is beyond its bound."""
    if error <= bound:
        return {}
    return {"status": "failed", "note": f"{error:.1e} off the float64 reference, beyond {bound:.0e}"}


def relative_error(values: Tensor, exact: Tensor) -> float:
    """The rms of the difference over that of the exact numbers; infinity where a number is not finite."""
    try:
        return measure_relative_error(values, exact, "").rms
    except HyrfError:
        return float("inf")

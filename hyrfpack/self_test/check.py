"""Compare the kernels of one case with the reference in float64, on the CPU."""

from __future__ import annotations

from math import inf, isnan
from time import perf_counter

import torch
from torch import Tensor

from hyrfpack.errors import HyrfError
from hyrfpack.measure.error import measure_relative_error
from hyrfpack.parallel.child_items import Row
from hyrfpack.self_test.cases import SelfTestCase

TIMED_RUNS = 3


def check_case(case: SelfTestCase, implementation: str, device: torch.device) -> Row:
    """Return the largest errors of a case's results and gradients, the seconds that it took, and whether it failed.

    If the kernels are wrong, the row also has "slowdown": how many times as long plain torch takes on this input. It is
    left out if the reference runs no operation.

    Args:
        case: the operation and its inputs.
        implementation: the implementation to test, "gpu" or "cpu".
        device: the device of its tensors.
    """
    exact = run_case(case, "reference", torch.float64, torch.device("cpu"))
    start = perf_counter()
    measured = run_case(case, implementation, torch.float32, device)
    seconds = perf_counter() - start
    row: Row = {"seconds": round(seconds, 3)}
    for kind, measured_tensors, expected, bound in zip(
        ("value", "gradient"), measured, exact, case.bounds, strict=True
    ):
        for name, tensor in expected.items():
            error = _relative_error(measured_tensors[name], tensor)
            # NaN counts as infinite, because the maximum of NaN and a later number may be that number.
            comparable_error = inf if isnan(error) else error
            row[f"{kind} error"] = max(comparable_error, float(str(row.get(f"{kind} error", 0.0))))
            if not error <= bound and "status" not in row:
                of = f"the gradient of {name}" if kind == "gradient" else name
                row |= {"status": "failed", "note": f"{of} {_describe_error(error, bound)}"}
    if "status" in row and case.reference_runs:
        plain, kernels = (_median_seconds(case, name, device) for name in ("reference", implementation))
        row["slowdown"] = round(plain / kernels, 1)
    return row


def run_case(
    case: SelfTestCase, implementation: str, dtype: torch.dtype, device: torch.device
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Return the results of a case and the gradients of its inputs by name, as CPU tensors."""
    # bfloat16 inputs stay what they are, because the operation rounds to them.
    tensors = {
        name: x.to(device=device, dtype=dtype if x.dtype == torch.float32 else x.dtype, copy=True)
        for name, x in case.inputs.items()
    }
    leaves = [tensors[name].requires_grad_() for name in case.gradient_inputs]
    with torch.set_grad_enabled(bool(leaves)):
        results = case.run(implementation, tensors)
    pulled = [value for value in results.values() if value.requires_grad]
    upstream = [_random_like(value, seed) for seed, value in enumerate(pulled)]
    gradients = torch.autograd.grad(pulled, leaves, upstream) if leaves else ()
    # A result may be a buffer that the backward pass has changed.
    # Copying to the CPU waits for the device, so that an error of a kernel is raised here.
    values = {name: value.detach().cpu() for name, value in results.items()}
    return values, {name: part.cpu() for name, part in zip(case.gradient_inputs, gradients, strict=True)}


def _random_like(value: Tensor, seed: int) -> Tensor:
    """Return a random upstream gradient, with the same numbers in every precision."""
    numbers = torch.randn(value.shape, generator=torch.Generator().manual_seed(seed))
    return numbers.to(value.device, value.dtype)


def _relative_error(measured: Tensor, exact: Tensor) -> float:
    """Return the rms of the difference over the rms of the exact values.

    It is infinity if the shapes differ, and NaN if a value is not finite.
    """
    if measured.shape != exact.shape:
        return float("inf")
    try:
        return measure_relative_error(measured.double(), exact.double(), "").rms
    except HyrfError:
        return float("nan")


def _describe_error(error: float, bound: float) -> str:
    if isnan(error):
        return "is NaN or infinite"
    if error == float("inf"):
        return "has the wrong shape"
    return f"is off by {error:.1e} of its size, more than {bound:.0e}"


def _median_seconds(case: SelfTestCase, implementation: str, device: torch.device) -> float:
    """Return the median time of a case with its gradients, which include the copies to and from the device."""
    times = []
    for _ in range(TIMED_RUNS):
        start = perf_counter()
        run_case(case, implementation, torch.float32, device)
        times.append(perf_counter() - start)
    return sorted(times)[len(times) // 2]

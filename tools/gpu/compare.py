"""One call of an operation, and how far a kernel's values and gradients are from the float64 reference's."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Call:
    """An operation with its inputs.

    Attributes:
        run: takes the implementation's name, then the inputs by name in any one precision; returns one tensor.
        inputs: float32, on the device.
        wanted: names of the inputs that gradients are taken in.
        bounds: largest error of the values and of the gradients that passes; see `errors`.
    """

    run: Callable[..., Tensor]
    inputs: Mapping[str, Tensor]
    wanted: tuple[str, ...]
    bounds: tuple[float, float] = (1e-4, 1e-3)


def passes(call: Call, implementation: str) -> tuple[Callable[[], Tensor], Callable[[], tuple[Tensor, ...]]]:
    """The forward pass as training makes it, and the backward pass of one such."""
    inputs = _leaves(call, torch.float32)

    def forward() -> Tensor:
        return call.run(implementation, **inputs)

    result = forward()
    cotangent = _cotangent(result)
    leaves = [inputs[name] for name in call.wanted]
    return forward, lambda: torch.autograd.grad(result, leaves, cotangent, retain_graph=True)


def errors(call: Call, implementation: str) -> tuple[float, float]:
    """Errors of values and of gradients (the worst of them): the length of the difference over the reference's."""
    exact, exact_gradients = _values_and_gradients(call, "reference", torch.float64)
    values, gradients = _values_and_gradients(call, implementation, torch.float32)
    worst = max((relative_error(a, b) for a, b in zip(gradients, exact_gradients, strict=True)), default=0.0)
    return relative_error(values, exact), worst


def checked(call: Call, implementation: str) -> dict[str, object]:
    """The errors of a call as cells of a row, with its status."""
    values, gradients = errors(call, implementation)
    row: dict[str, object] = {"value error": values, "gradient error": gradients}
    return row | within(values, call.bounds[0]) | within(gradients, call.bounds[1])


def within(error: float, bound: float) -> dict[str, object]:
    """Nothing, or the status of a row whose error is beyond its bound."""
    if error <= bound:
        return {}
    return {"status": "failed", "note": f"{error:.1e} off the float64 reference, beyond {bound:.0e}"}


def _values_and_gradients(call: Call, implementation: str, dtype: torch.dtype) -> tuple[Tensor, tuple[Tensor, ...]]:
    inputs = _leaves(call, dtype)
    result = call.run(implementation, **inputs)
    gradients = torch.autograd.grad(result, [inputs[name] for name in call.wanted], _cotangent(result))
    return result.detach(), gradients


def _leaves(call: Call, dtype: torch.dtype) -> dict[str, Tensor]:
    leaves = {
        name: tensor.detach().clone().to(dtype) if tensor.is_floating_point() else tensor
        for name, tensor in call.inputs.items()
    }
    for name in call.wanted:
        leaves[name].requires_grad_()
    return leaves


def _cotangent(result: Tensor) -> Tensor:
    """What the gradient of `result` is multiplied by: random, and the same in every precision."""
    generator = torch.Generator().manual_seed(1)
    return torch.randn(result.shape, generator=generator).to(result.device, result.dtype)


def relative_error(values: Tensor, exact: Tensor) -> float:
    """The length of the difference over that of the exact numbers; infinity where a number is not finite."""
    difference = torch.linalg.vector_norm((values.double() - exact.double()).flatten())
    length = torch.linalg.vector_norm(exact.double().flatten())
    error = float(difference / length) if length > 0 else float(difference)
    return error if error == error else float("inf")

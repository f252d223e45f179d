"""mlp: every implementation against the reference in float64, the reference against torch's own layers."""

from __future__ import annotations

import pytest
import torch
from ops.device import IS_INTERPRETED, gpu, needs_triton, pair_with_implementations

from hyrfpack.ops.mlp import mlp

KERNEL_IMPLEMENTATIONS = ["cpu", pytest.param("gpu", marks=needs_triton)]
TESTED_IMPLEMENTATIONS = ["reference", *KERNEL_IMPLEMENTATIONS]


def normal(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def layers_for(*widths: int) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    weights = [normal(o, i, seed=o + i) / i**0.5 for i, o in zip(widths, widths[1:], strict=False)]
    return weights, [0.1 * normal(o, seed=o) for o in widths[1:]]


def zero_some_rows(grad: torch.Tensor, share: float) -> torch.Tensor:
    idle = torch.rand(grad.shape[0], generator=torch.Generator().manual_seed(7)) < share
    return grad.masked_fill(idle[:, None], 0)


# Name -> (x, layer widths, gradient of the result).
MLP_CASES = {
    "geometry decoder": (normal(5000, 32), (32, 64, 64, 8), normal(5000, 8, seed=1)),
    "radiance decoder, a third idle": (normal(9001, 41), (41, 64, 64, 3), zero_some_rows(normal(9001, 3, seed=1), 0.3)),
    "radiance decoder, by feature": (normal(56, 3001).T, (56, 64, 64, 3), normal(3001, 3, seed=1)),
    "rows stored by feature": (normal(32, 6000).T, (32, 16, 4), zero_some_rows(normal(6000, 4, seed=1), 0.5)),
    "whole chunks idle": (normal(9000, 8), (8, 16, 2), normal(9000, 2) * (torch.arange(9000) > 7000)[:, None]),
    "whole blocks idle": (
        normal(9, 3000).T,
        (9, 16, 24, 2),
        normal(3000, 2) * (torch.arange(3000) % 300 > 200)[:, None],
    ),
    "every row idle": (normal(3000, 8), (8, 16, 2), torch.zeros(3000, 2)),
    "gradient of one expanded number": (normal(3000, 8), (8, 16, 2), torch.ones(1).expand(3000, 2)),
    "every row idle, two hidden layers": (normal(300, 8), (8, 16, 16, 2), torch.zeros(300, 2)),
    "gradient stored by output": (normal(8, 900).T, (8, 16, 16, 4), normal(4, 900).T),
    "rows and features with gaps": (normal(900, 64)[::3, ::4], (16, 20, 16, 1), normal(300, 1)),
    "widest": (normal(100, 128), (128, 128, 100, 16), normal(100, 16, seed=1)),
    "too wide for the gpu": (normal(50, 9), (9, 129, 16, 2), normal(50, 2)),
    "one layer": (normal(3000, 8), (8, 5), normal(3000, 5)),
    "four layers": (normal(600, 5), (5, 7, 6, 9, 2), normal(600, 2)),
    "one row": (normal(1, 32), (32, 64, 8), normal(1, 8)),
    "no row": (normal(0, 32), (32, 64, 8), normal(0, 8)),
    "one row, two hidden layers": (normal(1, 32), (32, 64, 64, 8), normal(1, 8)),
    "no row, two hidden layers": (normal(0, 32), (32, 64, 64, 8), normal(0, 8)),
}


def case_for(implementation: str, case: str) -> tuple[torch.Tensor, tuple[int, ...], torch.Tensor]:
    """Return the case, or for the interpreter its first rows: more than all programs take at once, no whole blocks."""
    x, widths, upstream = MLP_CASES[case]
    return (x[:550], widths, upstream[:550]) if implementation == "gpu" and IS_INTERPRETED else (x, widths, upstream)


def values_and_gradients(
    case: tuple, dtype: torch.dtype, implementation: str, mixed: bool = False
) -> list[torch.Tensor]:
    x, widths, upstream = case
    weights, biases = layers_for(*widths)
    inputs = [tensor.detach().to(dtype).requires_grad_() for tensor in (x, *weights, *biases)]
    upstream = upstream.to(dtype)
    if implementation == "gpu":
        inputs, upstream = [gpu(tensor) for tensor in inputs], gpu(upstream)
    layers = len(weights)
    result = mlp(inputs[0], inputs[1 : 1 + layers], inputs[1 + layers :], mixed=mixed, implementation=implementation)
    return [tensor.detach().cpu() for tensor in (result, *torch.autograd.grad(result, inputs, upstream))]


def assert_gradients_close(gradients: list[torch.Tensor], expected: list[torch.Tensor], tolerance: float) -> None:
    """Check gradients to a fraction of the largest number of each."""
    for gradient, wanted in zip(gradients, expected, strict=True):
        scale = wanted.abs().max().item() if wanted.numel() else 0.0
        torch.testing.assert_close(gradient.double(), wanted, rtol=0, atol=tolerance * scale)


# Other cases run the same branches of the GPU kernels.
SIMILAR_GPU_CASES = {"geometry decoder", "radiance decoder, by feature"}


@pytest.mark.parametrize(
    ("implementation", "name"), pair_with_implementations(MLP_CASES, SIMILAR_GPU_CASES, TESTED_IMPLEMENTATIONS)
)
def test_values_and_gradients_match_the_float64_reference(implementation: str, name: str) -> None:
    case = case_for(implementation, name)
    result, *gradients = values_and_gradients(case, torch.float32, implementation)
    expected, *expected_gradients = values_and_gradients(case, torch.float64, "reference")
    tolerance = 1e-4 if implementation == "gpu" else 1e-5
    torch.testing.assert_close(result.double(), expected, rtol=tolerance, atol=tolerance)
    assert_gradients_close(gradients, expected_gradients, 1e-3)


def relative_difference(values: list[torch.Tensor], expected: list[torch.Tensor]) -> float:
    """Return the largest |value - expected| / |expected| of the tensors."""
    pairs = [(a.double(), b.double()) for a, b in zip(values, expected, strict=True)]
    return max(float((a - b).norm() / b.norm().clamp_min(1e-30)) for a, b in pairs)


# float32 rounds a few hidden values to another bfloat16 than float64, 1/256 away, and some cross the zero of a ReLU.
# So whole tensors are compared. Against exact products all values are rounded, and gradients of x cross zero most.
@pytest.mark.parametrize(
    ("implementation", "name"),
    pair_with_implementations(MLP_CASES, SIMILAR_GPU_CASES, ["reference", pytest.param("gpu", marks=needs_triton)]),
)
def test_mixed_values_and_gradients_match_the_mixed_float64_reference(implementation: str, name: str) -> None:
    case = case_for(implementation, name)
    result, *gradients = values_and_gradients(case, torch.float32, implementation, mixed=True)
    rounded, *rounded_gradients = values_and_gradients(case, torch.float64, "reference", mixed=True)
    exact, *exact_gradients = values_and_gradients(case, torch.float64, "reference")
    assert relative_difference([result], [rounded]) < 2e-3
    assert relative_difference(gradients, rounded_gradients) < 5e-3
    assert relative_difference([result], [exact]) < 1.5e-2
    assert relative_difference(gradients, exact_gradients) < 0.3


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_matches_torch_modules(implementation: str) -> None:
    x, widths, upstream = case_for(implementation, "geometry decoder")
    torch.manual_seed(0)
    modules = [torch.nn.Linear(i, o) for i, o in zip(widths, widths[1:], strict=False)]
    network = torch.nn.Sequential(modules[0], torch.nn.ReLU(), modules[1], torch.nn.ReLU(), modules[2])
    weights, biases = [m.weight for m in modules], [m.bias for m in modules]
    expected = network(x)
    expected_gradients = torch.autograd.grad(expected, weights + biases, upstream)
    if implementation == "gpu":
        x, upstream, weights, biases = gpu(x), gpu(upstream), list(map(gpu, weights)), list(map(gpu, biases))
    result = mlp(x, weights, biases, implementation=implementation)
    gradients = torch.autograd.grad(result, weights + biases, upstream)
    torch.testing.assert_close(result.cpu(), expected, rtol=1e-5, atol=1e-5)
    for gradient, wanted in zip(gradients, expected_gradients, strict=True):
        torch.testing.assert_close(gradient.cpu(), wanted, rtol=1e-4, atol=1e-3)


def test_reference_passes_gradcheck() -> None:
    weights, biases = layers_for(4, 6, 5, 3)
    inputs = [tensor.double().requires_grad_() for tensor in (normal(7, 4), *weights, *biases)]
    assert torch.autograd.gradcheck(lambda x, *p: mlp(x, p[:3], p[3:]), inputs)


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
@pytest.mark.parametrize("mixed", [False, True])
def test_zero_weights_give_the_last_bias_and_no_gradient_below(implementation: str, mixed: bool) -> None:
    x = gpu(normal(900, 8)) if implementation == "gpu" else normal(900, 8)
    x = x.requires_grad_()
    weights = [x.new_zeros(16, 8), x.new_zeros(16, 16), x.new_zeros(2, 16)]
    biases = [x.new_zeros(16), x.new_zeros(16), x.new_tensor([0.5, -2.0])]
    for tensor in (*weights, *biases):
        tensor.requires_grad_()
    result = mlp(x, weights, biases, mixed=mixed, implementation=implementation)
    result.sum().backward()
    assert torch.equal(result, biases[2].expand(900, 2))
    assert not x.grad.any() and not any(weight.grad.any() for weight in weights)
    assert torch.equal(biases[2].grad, x.new_full((2,), 900.0))


@pytest.mark.parametrize("implementation", KERNEL_IMPLEMENTATIONS)
def test_gradient_of_x_keeps_the_layout_of_x(implementation: str) -> None:
    weights, biases = layers_for(32, 16, 16, 4)
    if implementation == "gpu":
        weights, biases = list(map(gpu, weights)), list(map(gpu, biases))
    for x in (normal(500, 32), normal(32, 500).T):
        x = (gpu(x) if implementation == "gpu" else x).requires_grad_()
        (grad,) = torch.autograd.grad(mlp(x, weights, biases, implementation=implementation).sum(), x)
        assert grad.stride() == x.stride()


@pytest.mark.parametrize("implementation", KERNEL_IMPLEMENTATIONS)
def test_inputs_without_gradients_are_supported(implementation: str) -> None:
    x, widths, upstream = case_for(implementation, "geometry decoder")
    weights, biases = layers_for(*widths)
    if implementation == "gpu":
        x, upstream, weights, biases = gpu(x), gpu(upstream), list(map(gpu, weights)), list(map(gpu, biases))
    weights[1].requires_grad_()
    mlp(x, weights, biases, implementation=implementation).backward(upstream)
    assert x.grad is None and weights[0].grad is None
    assert weights[1].grad.any()


@needs_triton
@pytest.mark.parametrize("mixed", [False, True])
def test_a_nan_reaches_the_result_and_the_gradients_through_the_gpu_kernels(mixed: bool) -> None:
    case = x, _, _ = normal(40, 8), (8, 16, 16, 2), normal(40, 2)
    x[7, 3] = float("nan")
    result, *gradients = values_and_gradients(case, torch.float32, "gpu", mixed)
    assert result.isnan().any(1).nonzero().tolist() == [[7]]
    assert gradients[3].isnan().any()


@needs_triton
def test_bytes_of_the_gpu_do_not_depend_on_the_run() -> None:
    case = case_for("gpu", "radiance decoder, a third idle")
    first, second = (values_and_gradients(case, torch.float32, "gpu", mixed=True) for _ in range(2))
    assert all(map(torch.equal, first, second))


def test_bytes_do_not_depend_on_threads_or_on_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    def run() -> list[bytes]:
        tensors = values_and_gradients(MLP_CASES["radiance decoder, a third idle"], torch.float32, "cpu")
        return [tensor.detach().numpy().tobytes() for tensor in tensors]

    monkeypatch.setenv("HYRFPACK_THREADS", "1")
    alone = run()
    monkeypatch.setenv("HYRFPACK_THREADS", "2")
    assert run() == alone
    assert run() == alone


def test_the_number_of_torch_threads_is_unchanged() -> None:
    before = torch.get_num_threads()
    values_and_gradients(MLP_CASES["one row"], torch.float32, "cpu")
    assert torch.get_num_threads() == before


def test_hidden_layers_are_kept_only_where_gradients_are_recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    from hyrfpack.ops.mlp import cpu

    allocate, calls = cpu.allocate_hidden, []
    monkeypatch.setattr(cpu, "allocate_hidden", lambda *arguments: calls.append(arguments) or allocate(*arguments))
    weights, biases = ([torch.nn.Parameter(values) for values in parameters] for parameters in layers_for(8, 16, 16, 3))

    with torch.no_grad():
        result = mlp(normal(50, 8), weights, biases)
    assert not calls
    torch.testing.assert_close(mlp(normal(50, 8), weights, biases).detach(), result, rtol=0, atol=0)
    assert len(calls) == 1


def test_auto_uses_the_reference_for_float64() -> None:
    weights, biases = layers_for(4, 3)
    result = mlp(normal(5, 4).double(), [weights[0].double()], [biases[0].double()])
    assert result.dtype == torch.float64


@pytest.mark.parametrize(
    ("x", "weights", "biases"),
    [
        ((5, 4), [(3, 5)], [(3,)]),
        ((5, 4), [(3, 4)], [(2,)]),
        ((5, 4), [(3, 4), (2, 4)], [(3,), (2,)]),
        ((5, 4), [], []),
    ],
    ids=["width of x", "length of a bias", "width between layers", "no layer"],
)
def test_tensors_that_do_not_form_layers_are_rejected(x: tuple, weights: list, biases: list) -> None:
    with pytest.raises(ValueError, match="do not form layers"):
        mlp(torch.rand(x), [torch.rand(shape) for shape in weights], [torch.rand(shape) for shape in biases])

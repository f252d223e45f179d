"""mlp: every implementation against the reference in float64, the reference against torch's own layers."""

from __future__ import annotations

import pytest
import torch

from hyrfpack.ops.mlp import mlp

IMPLEMENTATIONS = ["reference", "cpu"]


def normal(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def layers_for(*widths: int) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    weights = [normal(o, i, seed=o + i) / i**0.5 for i, o in zip(widths, widths[1:], strict=False)]
    return weights, [0.1 * normal(o, seed=o) for o in widths[1:]]


def with_idle_rows(grad: torch.Tensor, share: float) -> torch.Tensor:
    idle = torch.rand(grad.shape[0], generator=torch.Generator().manual_seed(7)) < share
    return grad.masked_fill(idle[:, None], 0)


# name -> (x, layer widths, gradient of the result)
CASES = {
    "geometry decoder": (normal(5000, 32), (32, 64, 64, 8), normal(5000, 8, seed=1)),
    "radiance decoder, a third idle": (normal(9001, 41), (41, 64, 64, 3), with_idle_rows(normal(9001, 3, seed=1), 0.3)),
    "rows stored by feature": (normal(32, 6000).T, (32, 16, 4), with_idle_rows(normal(6000, 4, seed=1), 0.5)),
    "whole chunks idle": (normal(9000, 8), (8, 16, 2), normal(9000, 2) * (torch.arange(9000) > 7000)[:, None]),
    "every row idle": (normal(3000, 8), (8, 16, 2), torch.zeros(3000, 2)),
    "gradient of one expanded number": (normal(3000, 8), (8, 16, 2), torch.ones(1).expand(3000, 2)),
    "one layer": (normal(3000, 8), (8, 5), normal(3000, 5)),
    "four layers": (normal(600, 5), (5, 7, 6, 9, 2), normal(600, 2)),
    "one row": (normal(1, 32), (32, 64, 8), normal(1, 8)),
    "no row": (normal(0, 32), (32, 64, 8), normal(0, 8)),
}


def values_and_gradients(case: str, dtype: torch.dtype, implementation: str) -> list[torch.Tensor]:
    x, widths, upstream = CASES[case]
    weights, biases = layers_for(*widths)
    inputs = [tensor.detach().to(dtype).requires_grad_() for tensor in (x, *weights, *biases)]
    result = mlp(inputs[0], inputs[1 : len(widths)], inputs[len(widths) :], implementation=implementation)
    return [result, *torch.autograd.grad(result, inputs, upstream.to(dtype))]


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
@pytest.mark.parametrize("case", CASES)
def test_values_and_gradients_match_the_float64_reference(implementation: str, case: str) -> None:
    result, *gradients = values_and_gradients(case, torch.float32, implementation)
    expected, *expected_gradients = values_and_gradients(case, torch.float64, "reference")
    torch.testing.assert_close(result.double(), expected, rtol=1e-5, atol=1e-5)
    for gradient, wanted in zip(gradients, expected_gradients, strict=True):
        scale = wanted.abs().max().item() if wanted.numel() else 0.0
        torch.testing.assert_close(gradient.double(), wanted, rtol=0, atol=1e-3 * scale)


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
def test_matches_torch_modules(implementation: str) -> None:
    x, widths, upstream = CASES["geometry decoder"]
    torch.manual_seed(0)
    modules = [torch.nn.Linear(i, o) for i, o in zip(widths, widths[1:], strict=False)]
    network = torch.nn.Sequential(modules[0], torch.nn.ReLU(), modules[1], torch.nn.ReLU(), modules[2])
    weights, biases = [m.weight for m in modules], [m.bias for m in modules]
    expected = network(x)
    expected_gradients = torch.autograd.grad(expected, weights + biases, upstream)
    result = mlp(x, weights, biases, implementation=implementation)
    gradients = torch.autograd.grad(result, weights + biases, upstream)
    torch.testing.assert_close(result, expected)
    for gradient, wanted in zip(gradients, expected_gradients, strict=True):
        torch.testing.assert_close(gradient, wanted, rtol=1e-4, atol=1e-3)


def test_reference_passes_gradcheck() -> None:
    weights, biases = layers_for(4, 6, 5, 3)
    inputs = [tensor.double().requires_grad_() for tensor in (normal(7, 4), *weights, *biases)]
    assert torch.autograd.gradcheck(lambda x, *p: mlp(x, p[:3], p[3:]), inputs)


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
def test_zero_weights_give_the_last_bias_and_no_gradient_below(implementation: str) -> None:
    x = normal(3000, 8).requires_grad_()
    weights = [torch.zeros(16, 8, requires_grad=True), torch.zeros(2, 16, requires_grad=True)]
    biases = [torch.zeros(16, requires_grad=True), torch.tensor([0.5, -2.0], requires_grad=True)]
    result = mlp(x, weights, biases, implementation=implementation)
    result.sum().backward()
    assert torch.equal(result, biases[1].expand(3000, 2))
    assert not x.grad.any() and not weights[0].grad.any() and not weights[1].grad.any()
    assert torch.equal(biases[1].grad, torch.full((2,), 3000.0))


def test_gradient_of_x_keeps_the_layout_of_x() -> None:
    weights, biases = layers_for(32, 16, 4)
    for x in (normal(5000, 32), normal(32, 5000).T):
        x = x.requires_grad_()
        (grad,) = torch.autograd.grad(mlp(x, weights, biases, implementation="cpu").sum(), x)
        assert grad.stride() == x.stride()


def test_inputs_that_need_no_gradient_may_be_left_out() -> None:
    x, widths, upstream = CASES["geometry decoder"]
    weights, biases = layers_for(*widths)
    weights[1].requires_grad_()
    mlp(x, weights, biases, implementation="cpu").backward(upstream)
    assert x.grad is None and weights[0].grad is None
    assert weights[1].grad.any()


def test_bytes_do_not_depend_on_threads_or_on_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    def run() -> list[bytes]:
        tensors = values_and_gradients("radiance decoder, a third idle", torch.float32, "cpu")
        return [tensor.detach().numpy().tobytes() for tensor in tensors]

    monkeypatch.setenv("HYRFPACK_THREADS", "1")
    alone = run()
    monkeypatch.setenv("HYRFPACK_THREADS", "2")
    assert run() == alone
    assert run() == alone


def test_torch_keeps_its_threads() -> None:
    before = torch.get_num_threads()
    values_and_gradients("one row", torch.float32, "cpu")
    assert torch.get_num_threads() == before


def test_auto_takes_the_reference_for_float64() -> None:
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
def test_refuses_what_does_not_form_layers(x: tuple, weights: list, biases: list) -> None:
    with pytest.raises(ValueError, match="do not form layers"):
        mlp(torch.rand(x), [torch.rand(shape) for shape in weights], [torch.rand(shape) for shape in biases])

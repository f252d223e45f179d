"""upsample: torch's own interpolation and its gradient, in float64; on a GPU without atomics."""

from __future__ import annotations

import pytest
import torch
from ops.device import DEVICE
from pretend_gpu import pretended_gpu
from torch.utils._python_dispatch import TorchDispatchMode

from hyrfpack.ops.upsample import upsample

SHAPES = [(3, 4, 5), (1, 2, 2), (2, 1, 7), (1, 1, 1)]


class Called(TorchDispatchMode):
    """Names of torch's operations that ran."""

    def __init__(self) -> None:
        super().__init__()
        self.names: set[str] = set()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.names.add(func.overloadpacket.__name__)
        return func(*args, **(kwargs or {}))


def made(shape: tuple[int, ...], seed: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def expected(grid: torch.Tensor, stride: int, grad: torch.Tensor | None = None):
    """torch's own values and, for a gradient of theirs, the grid's."""
    grid = grid.clone().requires_grad_()
    size = [(nodes - 1) * stride + 1 for nodes in grid.shape[1:]]
    values = torch.nn.functional.interpolate(grid[None], size, mode="bilinear", align_corners=True)[0]
    return values.detach(), torch.autograd.grad(values, grid, made(values.shape, 1) if grad is None else grad)[0]


@pytest.mark.parametrize("stride", [1, 2, 3, 5])
@pytest.mark.parametrize("shape", SHAPES)
def test_values_and_gradients_are_torchs_own(shape, stride):
    wanted, wanted_gradient = expected(made(shape, 0), stride)
    grid = made(shape, 0).requires_grad_()

    values = upsample(grid, stride)

    torch.testing.assert_close(values.detach(), wanted, rtol=0, atol=1e-14)
    (gradient,) = torch.autograd.grad(values, grid, made(values.shape, 1))
    torch.testing.assert_close(gradient, wanted_gradient, rtol=0, atol=1e-13)


@pytest.mark.parametrize("stride", [1, 2, 3, 5])
@pytest.mark.parametrize("shape", SHAPES)
def test_on_a_gpu_each_node_gathers_the_same_gradient_without_atomics(shape, stride):
    wanted, wanted_gradient = expected(made(shape, 0), stride)
    with pretended_gpu() as gpu, Called() as called:
        grid = made(shape, 0).to(gpu).requires_grad_()
        values = upsample(grid, stride)
        (gradient,) = torch.autograd.grad(values, grid, made(values.shape, 1).to(gpu))
        values, gradient = values.detach().cpu(), gradient.cpu()

    torch.testing.assert_close(values, wanted, rtol=0, atol=1e-14)
    torch.testing.assert_close(gradient, wanted_gradient, rtol=0, atol=1e-13)
    assert "upsample_bilinear2d_backward" not in called.names
    assert stride == 1 or "upsample_bilinear2d" in called.names  # or what ran was not seen


@pytest.mark.gpu
@pytest.mark.skipif(DEVICE == "cpu", reason="there is no GPU")
def test_bytes_of_the_gpu_do_not_depend_on_the_run():
    grid, grad = made((3, 270, 480), 0).float().to(DEVICE), made((3, 539, 959), 1).float().to(DEVICE)
    first, again = (torch.autograd.grad(upsample(leaf, 2), leaf, grad)[0] for leaf in [grid.requires_grad_()] * 2)
    assert torch.equal(first, again)

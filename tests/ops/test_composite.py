"""composite: values and gradients of every implementation against hat functions in float64."""

from __future__ import annotations

import pytest
import torch
from ops.device import IS_INTERPRETED, KERNEL_DEVICE, gpu, needs_triton
from torch import Tensor

from hyrfpack.ops.background import grid_size
from hyrfpack.ops.composite import composite
from hyrfpack.parallel import has_numba

TESTED_IMPLEMENTATIONS = [
    "reference",
    pytest.param("cpu", marks=pytest.mark.skipif(not has_numba(), reason="no numba")),
    pytest.param("gpu", marks=needs_triton),
]
NODE_STRIDES = [1, 2, 3, 5]
# Picture sizes (H, W). At some strides the last node is at the picture's edge, at others past it. The last size is more
# than one block, also of nodes.
PICTURE_SIZES = [(1, 1), (1, 8), (7, 1), (2, 2), (6, 11), (16, 17)]
GRID_LAYOUTS = ["by rows", "by channels", "part of more", "expanded"]


def random_values(*shape: int, seed: int = 0) -> Tensor:
    """Return random float64 numbers that float32 can represent."""
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed)).double()


def make_inputs(height: int, width: int, stride: int) -> list[Tensor]:
    """Return rgb, transmittance and grid."""
    return [
        random_values(height, width, 3),
        random_values(height, width, seed=1).sigmoid().float().double(),
        random_values(*grid_size(height, width, stride), 3, seed=2),
    ]


def with_layout(grid: Tensor, layout: str) -> Tensor:
    """Return the grid as a view of other storage; "expanded" repeats one channel three times."""
    if layout == "by channels":  # as `background_grid` returns it
        return grid.permute(2, 0, 1).contiguous().permute(1, 2, 0)
    if layout == "part of more":
        more = grid.new_zeros(grid.shape[0] + 1, 2 * grid.shape[1], 5)
        more[1:, ::2, 1:4] = grid
        return more[1:, ::2, 1:4]
    return grid[..., :1].expand(grid.shape) if layout == "expanded" else grid


def hat_weights(size: int, stride: int) -> Tensor:
    """Return (size, nodes): the weight of each node in each pixel along an axis."""
    nodes = -(-(size - 1) // stride) + 1
    apart = torch.arange(size).double()[:, None] - stride * torch.arange(nodes).double()
    return (1 - apart.abs() / stride).clamp_min(0)


def composite_by_hats(rgb: Tensor, transmittance: Tensor, grid: Tensor, stride: int) -> Tensor:
    height, width = transmittance.shape
    behind = torch.einsum("yr,xs,rsc->yxc", hat_weights(height, stride), hat_weights(width, stride), grid)
    return rgb + transmittance[..., None] * behind


def place_float32(tensors: list[Tensor], implementation: str) -> list[Tensor]:
    """Return the tensors in float32 on the device of this implementation."""
    return [gpu(tensor.float()) if implementation == "gpu" else tensor.float() for tensor in tensors]


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
@pytest.mark.parametrize("stride", NODE_STRIDES)
@pytest.mark.parametrize("size", PICTURE_SIZES)
def test_values_and_gradients_match_float64(size: tuple[int, int], stride: int, implementation: str) -> None:
    leaves = [leaf.requires_grad_() for leaf in make_inputs(*size, stride)]
    wanted = composite_by_hats(*leaves, stride)
    upstream = random_values(*wanted.shape, seed=3)
    wanted_gradients = torch.autograd.grad(wanted, leaves, upstream)

    leaves = [leaf.detach().requires_grad_() for leaf in place_float32(leaves, implementation)]
    picture = composite(*leaves, stride, implementation=implementation)
    gradients = torch.autograd.grad(picture, leaves, upstream.to(picture))

    assert picture.is_contiguous()
    torch.testing.assert_close(picture.detach().cpu().double(), wanted.detach(), rtol=0, atol=2e-6)
    for gradient, expected in zip(gradients, wanted_gradients, strict=True):
        assert gradient.shape == expected.shape
        torch.testing.assert_close(gradient.cpu().double(), expected, rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize("stride", NODE_STRIDES)
@pytest.mark.parametrize("size", PICTURE_SIZES)
def test_the_reference_is_exact_in_float64(size: tuple[int, int], stride: int) -> None:
    leaves = make_inputs(*size, stride)
    torch.testing.assert_close(composite(*leaves, stride), composite_by_hats(*leaves, stride), rtol=0, atol=1e-13)


@pytest.mark.parametrize("stride", [1, 2, 3])
def test_the_reference_passes_gradcheck(stride: int) -> None:
    leaves = [leaf.requires_grad_() for leaf in make_inputs(3, 6, stride)]
    assert torch.autograd.gradcheck(lambda *leaves: composite(*leaves, stride), leaves)


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
@pytest.mark.parametrize("layout", GRID_LAYOUTS)
@pytest.mark.parametrize("stride", [1, 2])
def test_memory_layouts_have_no_effect(stride: int, layout: str, implementation: str) -> None:
    rgb, transmittance, grid = place_float32(make_inputs(4, 7, stride), implementation)
    there = [
        rgb.transpose(0, 1).contiguous().transpose(0, 1),
        transmittance.T.contiguous().T,
        with_layout(grid, layout),
    ]
    assert layout == "by rows" or not there[2].is_contiguous()
    here = [tensor.contiguous() for tensor in there]
    upstream = place_float32([random_values(3, 4, 7, seed=3)], implementation)[0].permute(
        1, 2, 0
    )  # channels first, as the gradient of ssim is stored

    def run(leaves: list[Tensor], upstream: Tensor) -> list[Tensor]:
        leaves = [leaf.detach().requires_grad_() for leaf in leaves]
        picture = composite(*leaves, stride, implementation=implementation)
        return [picture.detach(), *torch.autograd.grad(picture, leaves, upstream)]

    for found, expected in zip(run(there, upstream), run(here, upstream.contiguous()), strict=True):
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_a_gradient_may_be_one_expanded_number(implementation: str) -> None:
    leaves = [leaf.requires_grad_() for leaf in place_float32(make_inputs(4, 7, 3), implementation)]
    composite(*leaves, 3, implementation=implementation).sum().backward()
    pulled = [leaf.grad.cpu() for leaf in leaves]
    assert torch.equal(pulled[0], torch.ones(4, 7, 3))
    shares = torch.einsum("yr,xs,yx->rs", hat_weights(4, 3), hat_weights(7, 3), leaves[1].detach().cpu().double())
    torch.testing.assert_close(pulled[2].double(), shares[..., None].expand(2, 3, 3), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
@pytest.mark.parametrize("learnt", [(0,), (1,), (2,), (1, 2), (0, 2)])
def test_gradients_of_some_inputs_can_be_requested(learnt: tuple[int, ...], implementation: str) -> None:
    leaves = place_float32(make_inputs(5, 8, 2), implementation)
    for leaf in leaves:
        leaf.requires_grad_()
    upstream = place_float32([random_values(5, 8, 3, seed=3)], implementation)[0]
    expected = torch.autograd.grad(composite(*leaves, 2, implementation=implementation), leaves, upstream)

    some = [leaf.detach().clone().requires_grad_(i in learnt) for i, leaf in enumerate(leaves)]
    composite(*some, 2, implementation=implementation).backward(upstream)

    assert tuple(i for i, leaf in enumerate(some) if leaf.grad is not None) == learnt
    assert all(torch.equal(some[i].grad, expected[i]) for i in learnt)


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_nothing_is_recorded_where_no_gradient_is_needed(implementation: str) -> None:
    leaves = place_float32(make_inputs(3, 4, 2), implementation)
    assert not composite(*leaves, 2, implementation=implementation).requires_grad


NAN_CASES = [(8, 8, 2, (2, 1)), (8, 8, 3, (1, 3)), (8, 8, 3, (0, 0)), (5, 9, 1, (4, 3)), (7, 7, 3, (2, 2))]


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
@pytest.mark.parametrize(("height", "width", "stride", "node"), NAN_CASES)
def test_a_nan_node_affects_only_the_pixels_that_use_it(
    height: int, width: int, stride: int, node: tuple[int, int], implementation: str
) -> None:
    """A pixel takes nothing from a node one stride away, yet torch's own interpolation multiplies that node by 0."""
    rgb, transmittance, grid = place_float32(make_inputs(height, width, stride), implementation)
    grid[(*node, 1)] = float("nan")

    picture = composite(rgb, transmittance, grid, stride, implementation=implementation).cpu()

    rows, columns = (torch.arange(size) - stride * at for size, at in zip((height, width), node, strict=True))
    apart = torch.maximum(rows.abs()[:, None], columns.abs()[None, :])
    spoilt = picture.isnan()
    assert spoilt[..., 1][apart < stride].all()
    assert not spoilt[..., 1][apart > stride].any() and not spoilt[..., [0, 2]].any()
    if implementation != "reference":
        assert torch.equal(spoilt[..., 1], apart < stride)


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS[:2])  # "gpu" subtracts nodes, which gives NaN.
@pytest.mark.parametrize("stride", NODE_STRIDES)
def test_an_infinite_node_makes_the_pixels_around_it_infinite(stride: int, implementation: str) -> None:
    rgb, transmittance, grid = place_float32(make_inputs(16, 16, stride), implementation)
    grid[1, 1, 0] = -float("inf")

    picture = composite(rgb, transmittance, grid, stride, implementation=implementation)

    apart = (torch.arange(16) - stride).abs()
    apart = torch.maximum(apart[:, None], apart[None, :])
    assert (picture[..., 0][apart < stride] == -float("inf")).all()
    assert picture[..., 0][apart > stride].isfinite().all() and picture[..., 1:].isfinite().all()


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
@pytest.mark.parametrize("part", [0, 1])
def test_a_nan_pixel_affects_only_itself(part: int, implementation: str) -> None:
    leaves = place_float32(make_inputs(5, 7, 2), implementation)
    leaves[part][3, 4] = float("nan")
    picture = composite(*leaves, 2, implementation=implementation)
    assert picture.isnan().any(-1).nonzero().tolist() == [[3, 4]] and picture[3, 4].isnan().all()


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_a_nan_gradient_reaches_only_the_nodes_around_it(implementation: str) -> None:
    leaves = [leaf.requires_grad_() for leaf in place_float32(make_inputs(7, 7, 3), implementation)]
    upstream = torch.zeros_like(leaves[0])
    upstream[4, 1] = float("nan")
    _, light, grid = torch.autograd.grad(composite(*leaves, 3, implementation=implementation), leaves, upstream)
    assert light.isnan().nonzero().tolist() == [[4, 1]]
    assert grid.isnan().all(-1).nonzero().tolist() == [[1, 0], [1, 1], [2, 0], [2, 1]]


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
@pytest.mark.parametrize(
    ("rgb", "transmittance", "grid", "stride"),
    [
        ((5, 8, 3), (5, 8), (3, 4, 3), 2),
        ((5, 8, 3), (5, 8), (3, 6, 3), 2),
        ((5, 8, 3), (5, 8), (5, 3, 3), 2),
        ((5, 8, 3), (5, 8), (3, 5, 4), 2),
        ((5, 8, 4), (5, 8), (3, 5, 3), 2),
        ((8, 5, 3), (5, 8), (3, 5, 3), 2),
        ((5, 8, 3), (5, 8, 1), (3, 5, 3), 2),
        ((5, 8, 3), (40,), (3, 5, 3), 2),
        ((5, 8, 3), (5, 8), (3, 5, 3), 0),
        ((5, 8, 3), (5, 8), (3,), 0),
    ],
)
def test_inputs_that_do_not_match_are_rejected(rgb, transmittance, grid, stride, implementation: str) -> None:
    tensors = place_float32([torch.zeros(shape) for shape in (rgb, transmittance, grid)], implementation)
    with pytest.raises(ValueError):
        composite(*tensors, stride, implementation=implementation)


def test_unsupported_types_and_implementations_are_rejected() -> None:
    rgb, transmittance, grid = make_inputs(5, 8, 2)
    with pytest.raises(ValueError, match="tensors disagree"):
        composite(rgb, transmittance, grid.float(), 2)
    for implementation in ("cpu", "gpu"):
        with pytest.raises(ValueError, match="float32"):
            composite(rgb, transmittance, grid, 2, implementation=implementation)
    with pytest.raises(ValueError, match="no implementation 'cuda'"):
        composite(rgb.float(), transmittance.float(), grid.float(), 2, implementation="cuda")


@pytest.mark.skipif(not has_numba(), reason="no numba")
@pytest.mark.parametrize("stride", NODE_STRIDES)
def test_bytes_of_the_cpu_do_not_depend_on_threads_or_on_the_run(stride: int, monkeypatch: pytest.MonkeyPatch) -> None:
    leaves = [leaf.float().requires_grad_() for leaf in make_inputs(211, 403, stride)]  # several tasks
    upstream = random_values(211, 403, 3, seed=3).float()

    def run(threads: int) -> list[Tensor]:
        monkeypatch.setenv("HYRFPACK_THREADS", str(threads))
        picture = composite(*leaves, stride, implementation="cpu")
        return [picture.detach(), *torch.autograd.grad(picture, leaves, upstream)]

    first = run(1)
    for threads in (1, 2, 5):
        assert all(map(torch.equal, first, run(threads)))


@pytest.mark.gpu
@pytest.mark.skipif(IS_INTERPRETED, reason="there is no GPU")
@pytest.mark.parametrize("stride", [2, 5])
def test_bytes_of_the_gpu_do_not_depend_on_the_run(stride: int) -> None:
    leaves = [leaf.float().to(KERNEL_DEVICE).requires_grad_() for leaf in make_inputs(539, 959, stride)]
    upstream = random_values(539, 959, 3, seed=3).float().to(KERNEL_DEVICE)
    first, again = (
        torch.autograd.grad(composite(*leaves, stride, implementation="gpu"), leaves, upstream) for _ in range(2)
    )
    assert all(map(torch.equal, first, again))

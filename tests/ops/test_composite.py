"""composite: every implementation, values and gradients, against hat functions in float64."""

from __future__ import annotations

import pytest
import torch
from ops.device import DEVICE, INTERPRETED, gpu, needs_triton
from torch import Tensor

from hyrfpack.ops.background import grid_size
from hyrfpack.ops.composite import composite

IMPLEMENTATIONS = ["reference", pytest.param("gpu", marks=needs_triton)]
STRIDES = [1, 2, 3, 5]
# Pictures (H, W); at some strides the last node is at the picture's edge, at others past it.
SIZES = [(1, 1), (1, 8), (7, 1), (2, 2), (6, 11), (16, 17)]  # the last is more than one block, of nodes too
LAYOUTS = ["by rows", "by channels", "part of more", "expanded"]


def made(*shape: int, seed: int = 0) -> Tensor:
    """Numbers that float32 holds, in float64."""
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed)).double()


def inputs(height: int, width: int, stride: int) -> list[Tensor]:
    """rgb, transmittance and grid."""
    return [
        made(height, width, 3),
        made(height, width, seed=1).sigmoid().float().double(),
        made(*grid_size(height, width, stride), 3, seed=2),
    ]


def laid_out(grid: Tensor, layout: str) -> Tensor:
    """The grid, a view of something that is stored otherwise; "expanded": one channel three times."""
    if layout == "by channels":  # as `background_grid` gives it
        return grid.permute(2, 0, 1).contiguous().permute(1, 2, 0)
    if layout == "part of more":
        more = grid.new_zeros(grid.shape[0] + 1, 2 * grid.shape[1], 5)
        more[1:, ::2, 1:4] = grid
        return more[1:, ::2, 1:4]
    return grid[..., :1].expand(grid.shape) if layout == "expanded" else grid


def hats(size: int, stride: int) -> Tensor:
    """(size, nodes): the share of each node in each pixel along an axis."""
    nodes = -(-(size - 1) // stride) + 1
    apart = torch.arange(size).double()[:, None] - stride * torch.arange(nodes).double()
    return (1 - apart.abs() / stride).clamp_min(0)


def by_hats(rgb: Tensor, transmittance: Tensor, grid: Tensor, stride: int) -> Tensor:
    height, width = transmittance.shape
    behind = torch.einsum("yr,xs,rsc->yxc", hats(height, stride), hats(width, stride), grid)
    return rgb + transmittance[..., None] * behind


def placed(tensors: list[Tensor], implementation: str) -> list[Tensor]:
    """In float32, where this implementation takes them."""
    return [gpu(tensor.float()) if implementation == "gpu" else tensor.float() for tensor in tensors]


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
@pytest.mark.parametrize("stride", STRIDES)
@pytest.mark.parametrize("size", SIZES)
def test_values_and_gradients_match_float64(size: tuple[int, int], stride: int, implementation: str) -> None:
    leaves = [leaf.requires_grad_() for leaf in inputs(*size, stride)]
    wanted = by_hats(*leaves, stride)
    upstream = made(*wanted.shape, seed=3)
    wanted_gradients = torch.autograd.grad(wanted, leaves, upstream)

    leaves = [leaf.detach().requires_grad_() for leaf in placed(leaves, implementation)]
    picture = composite(*leaves, stride, implementation=implementation)
    gradients = torch.autograd.grad(picture, leaves, upstream.to(picture))

    assert picture.is_contiguous()
    torch.testing.assert_close(picture.detach().cpu().double(), wanted.detach(), rtol=0, atol=2e-6)
    for gradient, expected in zip(gradients, wanted_gradients, strict=True):
        assert gradient.shape == expected.shape
        torch.testing.assert_close(gradient.cpu().double(), expected, rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize("stride", STRIDES)
@pytest.mark.parametrize("size", SIZES)
def test_the_reference_is_exact_in_float64(size: tuple[int, int], stride: int) -> None:
    leaves = inputs(*size, stride)
    torch.testing.assert_close(composite(*leaves, stride), by_hats(*leaves, stride), rtol=0, atol=1e-13)


@pytest.mark.parametrize("stride", [1, 2, 3])
def test_the_reference_passes_gradcheck(stride: int) -> None:
    leaves = [leaf.requires_grad_() for leaf in inputs(3, 6, stride)]
    assert torch.autograd.gradcheck(lambda *leaves: composite(*leaves, stride), leaves)


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("stride", [1, 2])
def test_layouts_do_not_matter(stride: int, layout: str, implementation: str) -> None:
    rgb, transmittance, grid = placed(inputs(4, 7, stride), implementation)
    there = [rgb.transpose(0, 1).contiguous().transpose(0, 1), transmittance.T.contiguous().T, laid_out(grid, layout)]
    assert layout == "by rows" or not there[2].is_contiguous()
    here = [tensor.contiguous() for tensor in there]
    upstream = placed([made(3, 4, 7, seed=3)], implementation)[0].permute(1, 2, 0)  # by channels, as ssim pulls it

    def run(leaves: list[Tensor], upstream: Tensor) -> list[Tensor]:
        leaves = [leaf.detach().requires_grad_() for leaf in leaves]
        picture = composite(*leaves, stride, implementation=implementation)
        return [picture.detach(), *torch.autograd.grad(picture, leaves, upstream)]

    for found, expected in zip(run(there, upstream), run(here, upstream.contiguous()), strict=True):
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
def test_a_gradient_may_be_one_expanded_number(implementation: str) -> None:
    leaves = [leaf.requires_grad_() for leaf in placed(inputs(4, 7, 3), implementation)]
    composite(*leaves, 3, implementation=implementation).sum().backward()
    pulled = [leaf.grad.cpu() for leaf in leaves]
    assert torch.equal(pulled[0], torch.ones(4, 7, 3))
    shares = torch.einsum("yr,xs,yx->rs", hats(4, 3), hats(7, 3), leaves[1].detach().cpu().double())
    torch.testing.assert_close(pulled[2].double(), shares[..., None].expand(2, 3, 3), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
@pytest.mark.parametrize("learnt", [(0,), (1,), (2,), (1, 2), (0, 2)])
def test_gradients_of_some_alone(learnt: tuple[int, ...], implementation: str) -> None:
    leaves = placed(inputs(5, 8, 2), implementation)
    for leaf in leaves:
        leaf.requires_grad_()
    upstream = placed([made(5, 8, 3, seed=3)], implementation)[0]
    expected = torch.autograd.grad(composite(*leaves, 2, implementation=implementation), leaves, upstream)

    some = [leaf.detach().clone().requires_grad_(i in learnt) for i, leaf in enumerate(leaves)]
    composite(*some, 2, implementation=implementation).backward(upstream)

    assert tuple(i for i, leaf in enumerate(some) if leaf.grad is not None) == learnt
    assert all(torch.equal(some[i].grad, expected[i]) for i in learnt)


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
def test_nothing_is_recorded_where_no_gradient_is_wanted(implementation: str) -> None:
    leaves = placed(inputs(3, 4, 2), implementation)
    assert not composite(*leaves, 2, implementation=implementation).requires_grad


NAN_CASES = [(8, 8, 2, (2, 1)), (8, 8, 3, (1, 3)), (8, 8, 3, (0, 0)), (5, 9, 1, (4, 3)), (7, 7, 3, (2, 2))]


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
@pytest.mark.parametrize(("height", "width", "stride", "node"), NAN_CASES)
def test_a_node_that_is_nan_spoils_the_pixels_that_take_part_of_it(
    height: int, width: int, stride: int, node: tuple[int, int], implementation: str
) -> None:
    """A pixel takes nothing of a node that is a stride away, and yet torch's own interpolation multiplies it by 0."""
    rgb, transmittance, grid = placed(inputs(height, width, stride), implementation)
    grid[(*node, 1)] = float("nan")

    picture = composite(rgb, transmittance, grid, stride, implementation=implementation).cpu()

    rows, columns = (torch.arange(size) - stride * at for size, at in zip((height, width), node, strict=True))
    apart = torch.maximum(rows.abs()[:, None], columns.abs()[None, :])
    spoilt = picture.isnan()
    assert spoilt[..., 1][apart < stride].all()
    assert not spoilt[..., 1][apart > stride].any() and not spoilt[..., [0, 2]].any()
    if implementation == "gpu":
        assert torch.equal(spoilt[..., 1], apart < stride)


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
@pytest.mark.parametrize("part", [0, 1])
def test_a_pixel_that_is_nan_spoils_itself_alone(part: int, implementation: str) -> None:
    leaves = placed(inputs(5, 7, 2), implementation)
    leaves[part][3, 4] = float("nan")
    picture = composite(*leaves, 2, implementation=implementation)
    assert picture.isnan().any(-1).nonzero().tolist() == [[3, 4]] and picture[3, 4].isnan().all()


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
def test_a_gradient_that_is_nan_reaches_the_nodes_around_it(implementation: str) -> None:
    leaves = [leaf.requires_grad_() for leaf in placed(inputs(7, 7, 3), implementation)]
    upstream = torch.zeros_like(leaves[0])
    upstream[4, 1] = float("nan")
    _, light, grid = torch.autograd.grad(composite(*leaves, 3, implementation=implementation), leaves, upstream)
    assert light.isnan().nonzero().tolist() == [[4, 1]]
    assert grid.isnan().all(-1).nonzero().tolist() == [[1, 0], [1, 1], [2, 0], [2, 1]]


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
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
def test_what_does_not_fit_together_is_rejected(rgb, transmittance, grid, stride, implementation: str) -> None:
    tensors = placed([torch.zeros(shape) for shape in (rgb, transmittance, grid)], implementation)
    with pytest.raises(ValueError):
        composite(*tensors, stride, implementation=implementation)


def test_types_and_implementations_that_do_not_fit_are_rejected() -> None:
    rgb, transmittance, grid = inputs(5, 8, 2)
    with pytest.raises(ValueError, match="tensors disagree"):
        composite(rgb, transmittance, grid.float(), 2)
    with pytest.raises(ValueError, match="float32"):
        composite(rgb, transmittance, grid, 2, implementation="gpu")
    with pytest.raises(ValueError, match="no implementation 'cpu'"):
        composite(rgb.float(), transmittance.float(), grid.float(), 2, implementation="cpu")


@pytest.mark.gpu
@pytest.mark.skipif(INTERPRETED, reason="there is no GPU")
@pytest.mark.parametrize("stride", [2, 5])
def test_bytes_of_the_gpu_do_not_depend_on_the_run(stride: int) -> None:
    leaves = [leaf.float().to(DEVICE).requires_grad_() for leaf in inputs(539, 959, stride)]
    upstream = made(539, 959, 3, seed=3).float().to(DEVICE)
    first, again = (
        torch.autograd.grad(composite(*leaves, stride, implementation="gpu"), leaves, upstream) for _ in range(2)
    )
    assert all(map(torch.equal, first, again))

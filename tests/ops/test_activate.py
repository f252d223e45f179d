"""activate_geometry and scale_bounds: every implementation against float64, the reference against other arithmetic."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from ops.device import gpu, needs_triton
from torch import Tensor

from hyrfpack.ops.activate import activate_geometry, scale_bounds

IMPLEMENTATIONS = ["reference", pytest.param("gpu", marks=needs_triton)]
RULES = ["sum", "product"]
HALF_EXTENT = (1.0, 0.5, 0.25)
LAYOUTS: dict[str, Callable[[Tensor], Tensor]] = {
    "by rows": lambda stored: stored[:, :8].contiguous(),
    "by columns": lambda stored: stored[:, :8].T.contiguous().T,
    "part of wider rows": lambda stored: stored[:, 2:10],
    "every other row and column": lambda stored: stored.repeat_interleave(2, 0)[::2, ::2],
    "one row expanded": lambda stored: stored[:1, :8].expand(len(stored), 8),
    "one column expanded": lambda stored: stored[:, :1].expand(len(stored), 8),
}


def made(*shape: int, seed: int = 0) -> Tensor:
    """Numbers that float32 holds, in float64."""
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed)).double()


def inputs(count: int) -> list[Tensor]:
    """What raw is laid out from (N, 16), positions inside the box and far outside, scale and opacity logits."""
    stored, positions = 2 * made(count, 16), made(count, 3, seed=1)
    positions[1::3] *= 100
    return [stored, positions, made(count, 1, seed=2), made(count, 1, seed=3)]


def placed(tensor: Tensor, implementation: str) -> Tensor:
    """In float32, where this implementation takes it."""
    return gpu(tensor.float()) if implementation == "gpu" else tensor.float()


def values_and_gradients(tensors: list[Tensor], implementation: str, **settings) -> tuple[list[Tensor], list[Tensor]]:
    """The three results, and gradients of raw and both logits, where the tensors are."""
    raw, positions, scale_logits, opacity_logits = tensors
    leaves = [leaf.detach().requires_grad_() for leaf in (raw, scale_logits, opacity_logits)]
    parts = activate_geometry(leaves[0], positions, *leaves[1:], implementation=implementation, **settings)
    upstream = [made(*part.shape, seed=10 + i).to(part) for i, part in enumerate(parts)]
    gradients = torch.autograd.grad(parts, leaves, upstream)
    return [part.detach() for part in parts], list(gradients)


def assert_matches_float64(tensors: list[Tensor], layout: str, implementation: str, **settings) -> None:
    stored, *rest = tensors
    lay_out = LAYOUTS[layout]
    raw = lay_out(placed(stored, implementation))
    found = values_and_gradients([raw, *(placed(t, implementation) for t in rest)], implementation, **settings)
    expected = values_and_gradients([lay_out(stored), *rest], "reference", **settings)
    sizes = scale_bounds(rest[0], settings.get("half_extent"))  # what scales and their gradients are multiplied by
    for some, wanted in zip(found, expected, strict=True):
        for one, other in zip(some, wanted, strict=True):
            assert one.shape == other.shape and one.dtype == torch.float32
            error = (one.cpu().double() - other).abs()
            assert (error <= 1e-5 * other.abs() + 1e-6 * sizes.view(-1, *[1] * (other.ndim - 1))).all()


@pytest.mark.parametrize("half_extent", [None, HALF_EXTENT])
@pytest.mark.parametrize("rule", RULES)
def test_the_reference_is_what_it_says(rule: str, half_extent: tuple | None) -> None:
    stored, *rest = inputs(40)
    parts = activate_geometry(stored[:, :8], *rest, half_extent=half_extent, rule=rule)

    raw, positions, scale_logits, opacity_logits = stored[:, :8].numpy(), *(tensor.numpy() for tensor in rest)

    def sigmoid(x: np.ndarray) -> np.ndarray:
        return 0.5 * (1 + np.tanh(x / 2))

    bounds = np.maximum(1, np.sqrt(((positions / (half_extent or np.inf)) ** 2).sum(1)))[:, None]
    neural = raw[:, 1:4]
    shares = sigmoid(neural + scale_logits) if rule == "sum" else sigmoid(neural) * sigmoid(scale_logits)
    wanted = bounds * shares, raw[:, 4:] + (1, 0, 0, 0), sigmoid(raw[:, 0] + opacity_logits[:, 0])
    for part, expected in zip(parts, wanted, strict=True):
        np.testing.assert_allclose(part.numpy(), expected, rtol=1e-12)


@pytest.mark.parametrize("half_extent", [None, HALF_EXTENT])
@pytest.mark.parametrize("rule", RULES)
def test_the_reference_passes_gradcheck_of_positions_too(rule: str, half_extent: tuple | None) -> None:
    stored, *rest = inputs(5)
    leaves = [tensor.requires_grad_() for tensor in (stored[:, :8].clone(), *rest)]
    assert torch.autograd.gradcheck(
        lambda *leaves: activate_geometry(*leaves, half_extent=half_extent, rule=rule), leaves
    )


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
@pytest.mark.parametrize("count", [0, 1, 127, 128, 129])
def test_any_number_of_gaussians(count: int, implementation: str) -> None:
    assert_matches_float64(inputs(count), "by rows", implementation, half_extent=HALF_EXTENT)


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
@pytest.mark.parametrize("half_extent", [None, HALF_EXTENT, (3, 1, 2)])
@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("layout", LAYOUTS)
def test_rules_and_layouts(layout: str, rule: str, half_extent: tuple | None, implementation: str) -> None:
    assert_matches_float64(inputs(7), layout, implementation, rule=rule, half_extent=half_extent)


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
@pytest.mark.parametrize("count", [0, 1, 130])
@pytest.mark.parametrize("layout", ["by columns", "part of wider rows"])
def test_layouts_of_any_number_of_gaussians(layout: str, count: int, implementation: str) -> None:
    assert_matches_float64(inputs(count), layout, implementation, half_extent=HALF_EXTENT)


@needs_triton
@pytest.mark.parametrize("count", [1, 130])
@pytest.mark.parametrize("layout", ["by rows", "by columns"])
def test_the_gradient_of_raw_keeps_its_layout(layout: str, count: int) -> None:
    stored, *rest = (placed(tensor, "gpu") for tensor in inputs(count))
    raw = LAYOUTS[layout](stored)
    _, (gradient, *_) = values_and_gradients([raw, *rest], "gpu")
    assert gradient.stride() == raw.stride()


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
def test_rows_of_raw_may_overlap(implementation: str) -> None:
    """A number that is in several rows is pulled by each of them."""
    line = placed(made(16), implementation).requires_grad_()
    rest = [placed(tensor, implementation) for tensor in inputs(9)[1:]]
    raw = line.unfold(0, 8, 1)
    assert raw.stride() == (1, 1)
    (found,) = torch.autograd.grad(activate_geometry(raw, *rest, implementation=implementation)[1].sum(), line)
    quats_with = [sum(row + 4 <= place < row + 8 for row in range(9)) for place in range(16)]
    assert found.tolist() == quats_with


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
def test_layouts_of_the_rest_do_not_matter(implementation: str) -> None:
    stored, positions, scale_logits, opacity_logits = (placed(tensor, implementation) for tensor in inputs(9))
    raw = stored[:, :8]
    spread = [positions.T.contiguous().T, *(t.repeat_interleave(2, 0)[::2] for t in (scale_logits, opacity_logits))]
    there, pulled_there = values_and_gradients([raw, *spread], implementation, half_extent=HALF_EXTENT)
    here, pulled_here = values_and_gradients(
        [raw, positions, scale_logits, opacity_logits], implementation, half_extent=HALF_EXTENT
    )
    for found, expected in zip((*there, *pulled_there), (*here, *pulled_here), strict=True):
        torch.testing.assert_close(found, expected)


@pytest.mark.filterwarnings("ignore:overflow encountered in exp")  # numpy's, in the interpreter; 1 / inf is 0
@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
@pytest.mark.parametrize("rule", RULES)
def test_logits_of_any_size(rule: str, implementation: str) -> None:
    logits = torch.tensor([-80.0, -40.0, -5.0, 0.0, 5.0, 40.0, 80.0]).double()
    neural, explicit = torch.cartesian_prod(logits, logits).unbind(1)
    positions = made(49, 3, seed=1)
    stored = neural[:, None].expand(49, 16)
    tensors = [stored, positions, explicit[:, None], -explicit[:, None]]
    assert_matches_float64(tensors, "by rows", implementation, rule=rule, half_extent=HALF_EXTENT)


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
def test_centres_may_be_far_away(implementation: str) -> None:
    stored, _, *logits = inputs(12)
    directions = torch.nn.functional.normalize(made(12, 3, seed=1), dim=1)
    positions = (directions * 10.0 ** torch.arange(-20, 16, 3).double()[:, None]).float().double()
    assert_matches_float64([stored, positions, *logits], "by rows", implementation, half_extent=HALF_EXTENT)


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
def test_upstream_gradients_may_be_expanded(implementation: str) -> None:
    stored, positions, *logits = (placed(tensor, implementation) for tensor in inputs(6))
    leaves = [leaf.clone().requires_grad_() for leaf in (stored[:, :8], *logits)]
    parts = activate_geometry(leaves[0], positions, *leaves[1:], implementation=implementation)
    wanted = torch.autograd.grad(parts, leaves, list(map(torch.ones_like, parts)), retain_graph=True)

    found = torch.autograd.grad(sum(part.sum() for part in parts), leaves)

    assert all(map(torch.equal, found, wanted)) and all(gradient.all() for gradient in found)


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
def test_upstream_gradients_may_be_left_out(implementation: str) -> None:
    stored, positions, *logits = (placed(tensor, implementation) for tensor in inputs(6))
    leaves = [leaf.clone().requires_grad_() for leaf in (stored[:, :8], *logits)]
    _, quats, opacities = activate_geometry(leaves[0], positions, *leaves[1:], implementation=implementation)

    (quats.sum() + opacities.sum()).backward()

    slope = (opacities * (1 - opacities)).detach()
    expected = torch.cat((slope[:, None], torch.zeros_like(positions), torch.ones_like(quats)), 1)
    torch.testing.assert_close(leaves[0].grad, expected)
    assert leaves[1].grad is None or not leaves[1].grad.any()
    torch.testing.assert_close(leaves[2].grad, slope[:, None])


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
@pytest.mark.parametrize("learnt", [0, 1, 2])
@pytest.mark.parametrize("rule", RULES)
def test_gradients_of_one_alone(rule: str, learnt: int, implementation: str) -> None:
    stored, positions, *logits = (placed(tensor, implementation) for tensor in inputs(6))
    tensors = [stored[:, :8].contiguous(), positions, *logits]
    _, expected = values_and_gradients(tensors, implementation, rule=rule, half_extent=HALF_EXTENT)
    leaves = [leaf.clone().requires_grad_(i == learnt) for i, leaf in enumerate((tensors[0], *logits))]
    parts = activate_geometry(
        leaves[0], positions, *leaves[1:], rule=rule, half_extent=HALF_EXTENT, implementation=implementation
    )
    upstream = [(part, made(*part.shape, seed=10 + i).to(part)) for i, part in enumerate(parts) if part.requires_grad]
    torch.autograd.backward(*zip(*upstream, strict=True))
    assert [leaf.grad is not None for leaf in leaves] == [i == learnt for i in range(3)]
    torch.testing.assert_close(leaves[learnt].grad, expected[learnt])


# Where a NaN is -> the scales, quaternions and opacities that are NaN.
SPOILT = {
    "an opacity": (0, (slice(None), 0), [0, 0, 0], [0, 0, 0, 0], 1),
    "the first scale": (0, (slice(None), 1), [1, 0, 0], [0, 0, 0, 0], 0),
    "the last scale": (0, (slice(None), 3), [0, 0, 1], [0, 0, 0, 0], 0),
    "the first of a rotation": (0, (slice(None), 4), [0, 0, 0], [1, 0, 0, 0], 0),
    "the last of a rotation": (0, (slice(None), 7), [0, 0, 0], [0, 0, 0, 1], 0),
    "x": (1, (slice(None), 0), [1, 1, 1], [0, 0, 0, 0], 0),
    "z": (1, (slice(None), 2), [1, 1, 1], [0, 0, 0, 0], 0),
    "the scale logit": (2, (slice(None), 0), [1, 1, 1], [0, 0, 0, 0], 0),
    "the opacity logit": (3, (slice(None), 0), [0, 0, 0], [0, 0, 0, 0], 1),
}


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("where", SPOILT)
def test_what_is_not_a_number_shows(where: str, rule: str, implementation: str) -> None:
    which, (_, column), *expected = SPOILT[where]
    stored, *rest = (placed(tensor, implementation) for tensor in inputs(5))
    tensors = [stored[:, :8].contiguous(), *rest]
    tensors[which][3, column] = float("nan")

    parts, gradients = values_and_gradients(tensors, implementation, rule=rule, half_extent=HALF_EXTENT)

    for part, wanted in zip(parts, expected, strict=True):
        found = part.isnan().cpu()
        assert found[3].int().tolist() == wanted
        assert not found[[0, 1, 2, 4]].any()
    if "rotation" not in where:  # whose gradient does not ask for it
        assert any(gradient[3].isnan().any() for gradient in gradients)
    assert not any(gradient[[0, 1, 2, 4]].isnan().any() for gradient in gradients)


@needs_triton
def test_the_kernel_is_not_taken_where_positions_want_a_gradient() -> None:
    stored, positions, *logits = (placed(tensor, "gpu") for tensor in inputs(4))
    arguments = stored[:, :8], positions.requires_grad_(), *logits
    with pytest.raises(ValueError, match="no implementation 'gpu'"):
        activate_geometry(*arguments, implementation="gpu")
    with torch.no_grad():
        found = activate_geometry(*arguments, implementation="gpu")
    for part, expected in zip(found, activate_geometry(*arguments), strict=True):
        assert not part.requires_grad
        torch.testing.assert_close(part, expected.detach())


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
@pytest.mark.parametrize(
    "shapes",
    [
        [(5, 7), (5, 3), (5, 1), (5, 1)],
        [(5, 9), (5, 3), (5, 1), (5, 1)],
        [(4, 8), (5, 3), (5, 1), (5, 1)],
        [(5, 8), (4, 3), (5, 1), (5, 1)],
        [(5, 8), (5, 4), (5, 1), (5, 1)],
        [(5, 8), (5, 3), (1, 1), (5, 1)],
        [(5, 8), (5, 3), (5, 3), (5, 1)],
        [(5, 8), (5, 3), (5, 1), (5,)],
    ],
)
def test_shapes_that_do_not_fit_together_are_rejected(shapes: list[tuple[int, ...]], implementation: str) -> None:
    tensors = [placed(torch.zeros(shape), implementation) for shape in shapes]
    with pytest.raises(ValueError, match="logits are"):
        activate_geometry(*tensors, implementation=implementation)


def test_types_rules_and_implementations_that_there_are_not_are_rejected() -> None:
    stored, *rest = inputs(3)
    raw = stored[:, :8]
    with pytest.raises(ValueError, match="the rule 'mean'"):
        activate_geometry(raw, *rest, rule="mean")
    with pytest.raises(ValueError, match="tensors disagree"):
        activate_geometry(raw.float(), *rest)
    with pytest.raises(ValueError, match="float32"):
        activate_geometry(raw, *rest, implementation="gpu")
    with pytest.raises(ValueError, match="no implementation 'cpu'"):
        activate_geometry(raw, *rest, implementation="cpu")


# -- scale_bounds ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_bounds_are_one_in_the_box_and_grow_outside(dtype: torch.dtype) -> None:
    positions = 0.5 * made(500, 3)
    bounds = scale_bounds(positions.to(dtype), HALF_EXTENT)
    lengths = np.linalg.norm(positions.numpy() / HALF_EXTENT, axis=1)
    assert bounds.shape == (500, 1) and bounds.dtype == dtype
    assert 20 < (lengths < 1).sum() < 480
    np.testing.assert_allclose(
        bounds[:, 0].numpy(), np.maximum(lengths, 1), rtol=1e-6 if dtype is torch.float32 else 1e-15
    )


def test_bounds_without_a_box_are_one_and_learn_nothing() -> None:
    positions = (1e6 * made(4, 3)).float().requires_grad_()
    bounds = scale_bounds(positions, None)
    assert torch.equal(bounds, torch.ones(4, 1)) and not bounds.requires_grad


def test_gradients_of_bounds_are_finite_and_zero_inside() -> None:
    inside = torch.tensor([[0.0, 0.0, 0.0], [0.3, -0.2, 0.1]], dtype=torch.float64, requires_grad=True)
    scale_bounds(inside, HALF_EXTENT).sum().backward()
    assert torch.equal(inside.grad, torch.zeros(2, 3))
    outside = (torch.tensor(HALF_EXTENT).double() * (2 + made(5, 3).abs())).requires_grad_()
    assert torch.autograd.gradcheck(lambda positions: scale_bounds(positions, HALF_EXTENT), outside)


def test_bounds_of_no_place_and_of_no_number() -> None:
    assert scale_bounds(torch.zeros(0, 3), HALF_EXTENT).shape == (0, 1)
    bounds = scale_bounds(torch.tensor([[float("nan"), 0.0, 0.0], [0.0, 0.0, 0.0]]), HALF_EXTENT)
    assert bounds[0].isnan() and bounds[1] == 1

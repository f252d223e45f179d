"""activate_geometry and scale_bounds: every implementation against float64, the reference against other arithmetic."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from ops.device import gpu, needs_triton
from torch import Tensor

from hyrfpack.ops.activate import activate_geometry, scale_bounds

TESTED_IMPLEMENTATIONS = ["reference", pytest.param("gpu", marks=needs_triton)]
SCALE_RULES = ["sum", "product"]
HALF_EXTENT = (1.0, 0.5, 0.25)
RAW_LAYOUTS: dict[str, Callable[[Tensor], Tensor]] = {
    "by rows": lambda stored: stored[:, :8].contiguous(),
    "by columns": lambda stored: stored[:, :8].T.contiguous().T,
    "part of wider rows": lambda stored: stored[:, 2:10],
    "every other row and column": lambda stored: stored.repeat_interleave(2, 0)[::2, ::2],
    "one row expanded": lambda stored: stored[:1, :8].expand(len(stored), 8),
    "one column expanded": lambda stored: stored[:, :1].expand(len(stored), 8),
}


def random_values(*shape: int, seed: int = 0) -> Tensor:
    """Return random float64 numbers that float32 can represent."""
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed)).double()


def make_inputs(count: int) -> list[Tensor]:
    """Return storage (N, 16) for `raw`, positions inside and far outside the box, scale logits and opacity logits."""
    stored, positions = 2 * random_values(count, 16), random_values(count, 3, seed=1)
    positions[1::3] *= 100
    return [stored, positions, random_values(count, 1, seed=2), random_values(count, 1, seed=3)]


def place_float32(tensor: Tensor, implementation: str) -> Tensor:
    """Return the tensor in float32 on the device of this implementation."""
    return gpu(tensor.float()) if implementation == "gpu" else tensor.float()


def values_and_gradients(tensors: list[Tensor], implementation: str, **settings) -> tuple[list[Tensor], list[Tensor]]:
    """Return the three results and the gradients of raw and both logits, on the device of the tensors."""
    raw, positions, scale_logits, opacity_logits = tensors
    leaves = [leaf.detach().requires_grad_() for leaf in (raw, scale_logits, opacity_logits)]
    parts = activate_geometry(leaves[0], positions, *leaves[1:], implementation=implementation, **settings)
    upstream = [random_values(*part.shape, seed=10 + i).to(part) for i, part in enumerate(parts)]
    gradients = torch.autograd.grad(parts, leaves, upstream)
    return [part.detach() for part in parts], list(gradients)


def assert_matches_float64(tensors: list[Tensor], layout: str, implementation: str, **settings) -> None:
    stored, *rest = tensors
    lay_out = RAW_LAYOUTS[layout]
    raw = lay_out(place_float32(stored, implementation))
    found = values_and_gradients([raw, *(place_float32(t, implementation) for t in rest)], implementation, **settings)
    expected = values_and_gradients([lay_out(stored), *rest], "reference", **settings)
    sizes = scale_bounds(rest[0], settings.get("half_extent"))  # the factors of scales and of their gradients
    for some, wanted in zip(found, expected, strict=True):
        for one, other in zip(some, wanted, strict=True):
            assert one.shape == other.shape and one.dtype == torch.float32
            error = (one.cpu().double() - other).abs()
            assert (error <= 1e-5 * other.abs() + 1e-6 * sizes.view(-1, *[1] * (other.ndim - 1))).all()


@pytest.mark.parametrize("half_extent", [None, HALF_EXTENT])
@pytest.mark.parametrize("rule", SCALE_RULES)
def test_the_reference_matches_the_formula_in_numpy(rule: str, half_extent: tuple | None) -> None:
    stored, *rest = make_inputs(40)
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
@pytest.mark.parametrize("rule", SCALE_RULES)
def test_the_reference_passes_gradcheck_with_positions(rule: str, half_extent: tuple | None) -> None:
    stored, *rest = make_inputs(5)
    leaves = [tensor.requires_grad_() for tensor in (stored[:, :8].clone(), *rest)]
    assert torch.autograd.gradcheck(
        lambda *leaves: activate_geometry(*leaves, half_extent=half_extent, rule=rule), leaves
    )


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
@pytest.mark.parametrize("count", [0, 1, 127, 128, 129])
def test_any_number_of_gaussians_matches_float64(count: int, implementation: str) -> None:
    assert_matches_float64(make_inputs(count), "by rows", implementation, half_extent=HALF_EXTENT)


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
@pytest.mark.parametrize("half_extent", [None, HALF_EXTENT, (3, 1, 2)])
@pytest.mark.parametrize("rule", SCALE_RULES)
@pytest.mark.parametrize("layout", RAW_LAYOUTS)
def test_all_rules_and_layouts_match_float64(
    layout: str, rule: str, half_extent: tuple | None, implementation: str
) -> None:
    assert_matches_float64(make_inputs(7), layout, implementation, rule=rule, half_extent=half_extent)


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
@pytest.mark.parametrize("count", [0, 1, 130])
@pytest.mark.parametrize("layout", ["by columns", "part of wider rows"])
def test_layouts_with_any_number_of_gaussians_match_float64(layout: str, count: int, implementation: str) -> None:
    assert_matches_float64(make_inputs(count), layout, implementation, half_extent=HALF_EXTENT)


@needs_triton
@pytest.mark.parametrize("count", [1, 130])
@pytest.mark.parametrize("layout", ["by rows", "by columns"])
def test_the_gradient_of_raw_keeps_its_layout(layout: str, count: int) -> None:
    stored, *rest = (place_float32(tensor, "gpu") for tensor in make_inputs(count))
    raw = RAW_LAYOUTS[layout](stored)
    _, (gradient, *_) = values_and_gradients([raw, *rest], "gpu")
    assert gradient.stride() == raw.stride()


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_overlapping_rows_of_raw_add_their_gradients(implementation: str) -> None:
    """A number that belongs to several rows receives the gradient of each."""
    line = place_float32(random_values(16), implementation).requires_grad_()
    rest = [place_float32(tensor, implementation) for tensor in make_inputs(9)[1:]]
    raw = line.unfold(0, 8, 1)
    assert raw.stride() == (1, 1)
    (found,) = torch.autograd.grad(activate_geometry(raw, *rest, implementation=implementation)[1].sum(), line)
    quats_with = [sum(row + 4 <= place < row + 8 for row in range(9)) for place in range(16)]
    assert found.tolist() == quats_with


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_layouts_of_the_other_inputs_have_no_effect(implementation: str) -> None:
    stored, positions, scale_logits, opacity_logits = (
        place_float32(tensor, implementation) for tensor in make_inputs(9)
    )
    raw = stored[:, :8]
    spread = [positions.T.contiguous().T, *(t.repeat_interleave(2, 0)[::2] for t in (scale_logits, opacity_logits))]
    there, pulled_there = values_and_gradients([raw, *spread], implementation, half_extent=HALF_EXTENT)
    here, pulled_here = values_and_gradients(
        [raw, positions, scale_logits, opacity_logits], implementation, half_extent=HALF_EXTENT
    )
    for found, expected in zip((*there, *pulled_there), (*here, *pulled_here), strict=True):
        torch.testing.assert_close(found, expected)


@pytest.mark.filterwarnings("ignore:overflow encountered in exp")  # a warning of numpy in the interpreter; 1 / inf is 0
@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
@pytest.mark.parametrize("rule", SCALE_RULES)
def test_logits_of_any_size_match_float64(rule: str, implementation: str) -> None:
    logits = torch.tensor([-80.0, -40.0, -5.0, 0.0, 5.0, 40.0, 80.0]).double()
    neural, explicit = torch.cartesian_prod(logits, logits).unbind(1)
    positions = random_values(49, 3, seed=1)
    stored = neural[:, None].expand(49, 16)
    tensors = [stored, positions, explicit[:, None], -explicit[:, None]]
    assert_matches_float64(tensors, "by rows", implementation, rule=rule, half_extent=HALF_EXTENT)


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_distant_centres_match_float64(implementation: str) -> None:
    stored, _, *logits = make_inputs(12)
    directions = torch.nn.functional.normalize(random_values(12, 3, seed=1), dim=1)
    positions = (directions * 10.0 ** torch.arange(-20, 16, 3).double()[:, None]).float().double()
    assert_matches_float64([stored, positions, *logits], "by rows", implementation, half_extent=HALF_EXTENT)


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_expanded_upstream_gradients_are_supported(implementation: str) -> None:
    stored, positions, *logits = (place_float32(tensor, implementation) for tensor in make_inputs(6))
    leaves = [leaf.clone().requires_grad_() for leaf in (stored[:, :8], *logits)]
    parts = activate_geometry(leaves[0], positions, *leaves[1:], implementation=implementation)
    wanted = torch.autograd.grad(parts, leaves, list(map(torch.ones_like, parts)), retain_graph=True)

    found = torch.autograd.grad(sum(part.sum() for part in parts), leaves)

    assert all(map(torch.equal, found, wanted)) and all(gradient.all() for gradient in found)


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_missing_upstream_gradients_are_supported(implementation: str) -> None:
    stored, positions, *logits = (place_float32(tensor, implementation) for tensor in make_inputs(6))
    leaves = [leaf.clone().requires_grad_() for leaf in (stored[:, :8], *logits)]
    _, quats, opacities = activate_geometry(leaves[0], positions, *leaves[1:], implementation=implementation)

    (quats.sum() + opacities.sum()).backward()

    slope = (opacities * (1 - opacities)).detach()
    expected = torch.cat((slope[:, None], torch.zeros_like(positions), torch.ones_like(quats)), 1)
    torch.testing.assert_close(leaves[0].grad, expected)
    assert leaves[1].grad is None or not leaves[1].grad.any()
    torch.testing.assert_close(leaves[2].grad, slope[:, None])


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
@pytest.mark.parametrize("learnt", [0, 1, 2])
@pytest.mark.parametrize("rule", SCALE_RULES)
def test_the_gradient_of_a_single_input_can_be_requested(rule: str, learnt: int, implementation: str) -> None:
    stored, positions, *logits = (place_float32(tensor, implementation) for tensor in make_inputs(6))
    tensors = [stored[:, :8].contiguous(), positions, *logits]
    _, expected = values_and_gradients(tensors, implementation, rule=rule, half_extent=HALF_EXTENT)
    leaves = [leaf.clone().requires_grad_(i == learnt) for i, leaf in enumerate((tensors[0], *logits))]
    parts = activate_geometry(
        leaves[0], positions, *leaves[1:], rule=rule, half_extent=HALF_EXTENT, implementation=implementation
    )
    upstream = [
        (part, random_values(*part.shape, seed=10 + i).to(part)) for i, part in enumerate(parts) if part.requires_grad
    ]
    torch.autograd.backward(*zip(*upstream, strict=True))
    assert [leaf.grad is not None for leaf in leaves] == [i == learnt for i in range(3)]
    torch.testing.assert_close(leaves[learnt].grad, expected[learnt])


# Position of a NaN -> the scales, quaternions and opacities that become NaN.
NAN_OUTPUTS_BY_INPUT = {
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


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
@pytest.mark.parametrize("rule", SCALE_RULES)
@pytest.mark.parametrize("where", NAN_OUTPUTS_BY_INPUT)
def test_nan_inputs_give_nan_outputs(where: str, rule: str, implementation: str) -> None:
    which, (_, column), *expected = NAN_OUTPUTS_BY_INPUT[where]
    stored, *rest = (place_float32(tensor, implementation) for tensor in make_inputs(5))
    tensors = [stored[:, :8].contiguous(), *rest]
    tensors[which][3, column] = float("nan")

    parts, gradients = values_and_gradients(tensors, implementation, rule=rule, half_extent=HALF_EXTENT)

    for part, wanted in zip(parts, expected, strict=True):
        found = part.isnan().cpu()
        assert found[3].int().tolist() == wanted
        assert not found[[0, 1, 2, 4]].any()
    if "rotation" not in where:  # the gradient of a rotation does not depend on its value
        assert any(gradient[3].isnan().any() for gradient in gradients)
    assert not any(gradient[[0, 1, 2, 4]].isnan().any() for gradient in gradients)


@needs_triton
def test_the_kernel_is_not_used_where_positions_need_a_gradient() -> None:
    stored, positions, *logits = (place_float32(tensor, "gpu") for tensor in make_inputs(4))
    arguments = stored[:, :8], positions.requires_grad_(), *logits
    with pytest.raises(ValueError, match="no implementation 'gpu'"):
        activate_geometry(*arguments, implementation="gpu")
    with torch.no_grad():
        found = activate_geometry(*arguments, implementation="gpu")
    for part, expected in zip(found, activate_geometry(*arguments), strict=True):
        assert not part.requires_grad
        torch.testing.assert_close(part, expected.detach())


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
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
    tensors = [place_float32(torch.zeros(shape), implementation) for shape in shapes]
    with pytest.raises(ValueError, match="logits are"):
        activate_geometry(*tensors, implementation=implementation)


def test_unknown_types_rules_and_implementations_are_rejected() -> None:
    stored, *rest = make_inputs(3)
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
    positions = 0.5 * random_values(500, 3)
    bounds = scale_bounds(positions.to(dtype), HALF_EXTENT)
    lengths = np.linalg.norm(positions.numpy() / HALF_EXTENT, axis=1)
    assert bounds.shape == (500, 1) and bounds.dtype == dtype
    assert 20 < (lengths < 1).sum() < 480
    np.testing.assert_allclose(
        bounds[:, 0].numpy(), np.maximum(lengths, 1), rtol=1e-6 if dtype is torch.float32 else 1e-15
    )


def test_bounds_without_a_box_are_one_without_gradient() -> None:
    positions = (1e6 * random_values(4, 3)).float().requires_grad_()
    bounds = scale_bounds(positions, None)
    assert torch.equal(bounds, torch.ones(4, 1)) and not bounds.requires_grad


def test_gradients_of_bounds_are_finite_and_zero_inside() -> None:
    inside = torch.tensor([[0.0, 0.0, 0.0], [0.3, -0.2, 0.1]], dtype=torch.float64, requires_grad=True)
    scale_bounds(inside, HALF_EXTENT).sum().backward()
    assert torch.equal(inside.grad, torch.zeros(2, 3))
    outside = (torch.tensor(HALF_EXTENT).double() * (2 + random_values(5, 3).abs())).requires_grad_()
    assert torch.autograd.gradcheck(lambda positions: scale_bounds(positions, HALF_EXTENT), outside)


def test_bounds_of_no_points_and_of_nan() -> None:
    assert scale_bounds(torch.zeros(0, 3), HALF_EXTENT).shape == (0, 1)
    bounds = scale_bounds(torch.tensor([[float("nan"), 0.0, 0.0], [0.0, 0.0, 0.0]]), HALF_EXTENT)
    assert bounds[0].isnan() and bounds[1] == 1

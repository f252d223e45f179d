"""The contraction against the paper's formula, at the unit sphere and at both ends of float32's range."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from ops.device import gpu, needs_triton

from hyrfpack.ops.contraction import contract

TESTED_IMPLEMENTATIONS = ["reference", pytest.param("gpu", marks=needs_triton)]
HALF_EXTENTS = [(1.0, 1.0, 1.0), (2.0, 0.5, 0.125), (1, 3, 2)]


def place(tensor: torch.Tensor, implementation: str) -> torch.Tensor:
    return gpu(tensor) if implementation == "gpu" else tensor


def contract_float64(u: np.ndarray) -> np.ndarray:
    """Compute the contraction as the paper defines it (plus 0.5) in numpy, with hypot, which cannot overflow."""
    u = u.astype(np.float64)
    radius = np.hypot(np.hypot(u[:, 0], u[:, 1]), u[:, 2])[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        outside = 0.25 * (2 - 1 / radius) * u / radius + 0.5
    return np.where(radius <= 1, 0.25 * u + 0.5, outside)


def random_directions(count: int, seed: int = 0) -> np.ndarray:
    vectors = np.random.default_rng(seed).normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


@pytest.mark.parametrize("radius", [0.0, 1e-20, 1e-3, 0.5, 0.999999, 1.0, 1.000001, 2.0, 100.0, 1e8, 1e20, 1e30])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_contract_matches_the_formula(radius, dtype):
    u = torch.from_numpy(radius * random_directions(200)).to(dtype)

    cube = contract(u)

    expected = contract_float64(u.double().numpy())
    np.testing.assert_allclose(cube.numpy(), expected, rtol=0, atol=1e-6 if dtype == torch.float32 else 1e-14)


def test_contract_stays_finite_and_inside_for_float32_up_to_1e30():
    generator = np.random.default_rng(1)
    u = np.float32(10.0 ** generator.uniform(-30, 30, (50_000, 1)) * random_directions(50_000))
    u[:1000] = np.diag([1e30, -1e30, 1e30]).astype(np.float32)[generator.integers(3, size=1000)]  # on the axes

    cube = contract(torch.from_numpy(u))

    assert torch.isfinite(cube).all()
    assert cube.min() >= 0 and cube.max() <= 1


def test_contract_keeps_the_inner_ball_in_the_inner_half():
    u = torch.tensor([[1.0, 0, 0], [-1, 0, 0], [0, 0, 0.5], [0, 0, 0]])
    expected = torch.tensor([[0.75, 0.5, 0.5], [0.25, 0.5, 0.5], [0.5, 0.5, 0.625], [0.5, 0.5, 0.5]])
    assert torch.equal(contract(u), expected)


def test_contract_keeps_directions_and_orders_radii():
    radii = torch.logspace(-3, 6, 200, dtype=torch.float64)
    direction = torch.tensor([0.48, -0.6, 0.64], dtype=torch.float64)

    offsets = contract(radii[:, None] * direction) - 0.5

    lengths = torch.linalg.vector_norm(offsets, dim=1)
    assert (lengths.diff() > 0).all() and lengths[-1] < 0.5
    torch.testing.assert_close(offsets / lengths[:, None], direction.expand(200, 3))


def test_contract_is_c1_at_the_unit_sphere():
    directions = torch.from_numpy(random_directions(50, seed=2))
    step = 1e-7

    def jacobians(radius: float) -> torch.Tensor:
        return torch.stack([torch.autograd.functional.jacobian(contract, radius * d) for d in directions])

    below, above = jacobians(1 - step), jacobians(1 + step)

    torch.testing.assert_close(contract((1 - step) * directions), contract((1 + step) * directions), rtol=0, atol=1e-7)
    torch.testing.assert_close(below, above, rtol=0, atol=1e-6)
    torch.testing.assert_close(below, 0.25 * torch.eye(3).double().expand(50, 3, 3), rtol=0, atol=1e-6)


@pytest.mark.parametrize("radius", [0.3, 0.9, 1.1, 3.0, 40.0])
def test_contract_passes_gradcheck(radius):
    u = torch.from_numpy(radius * random_directions(6, seed=3)).requires_grad_()
    assert torch.autograd.gradcheck(contract, (u,), eps=1e-6, atol=1e-7)


def test_contract_gradient_is_finite_at_hard_points():
    u = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 1], [1e30, 1e30, -1e30], [1e-38, 0, 0]], requires_grad=True)
    contract(u).sum().backward()
    assert torch.isfinite(u.grad).all()


# -- boxes and implementations ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
@pytest.mark.parametrize("half_extent", HALF_EXTENTS)
@pytest.mark.parametrize("radius", [0.0, 1e-20, 0.5, 0.999999, 1.0, 1.000001, 2.0, 1e4, 1e20, 1e30])
def test_a_box_is_scaled_to_the_unit_cube_first(radius, half_extent, implementation):
    u = radius * random_directions(20, seed=4)
    u[:6] = radius * np.concatenate([np.eye(3), -np.eye(3)])
    points = torch.from_numpy(u * half_extent).float()

    cube = contract(place(points, implementation), half_extent, implementation=implementation)

    expected = contract_float64(points.double().numpy() / half_extent)
    assert cube.dtype == torch.float32
    np.testing.assert_allclose(cube.cpu().numpy(), expected, rtol=0, atol=1e-6)
    assert cube.min() >= 0 and cube.max() <= 1


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_the_inner_ball_is_in_the_inner_half_of_each_implementation(implementation):
    points = torch.tensor([[2.0, 0, 0], [-2, 0, 0], [0, 0, 0.0625], [0, 0, 0]])
    expected = torch.tensor([[0.75, 0.5, 0.5], [0.25, 0.5, 0.5], [0.5, 0.5, 0.625], [0.5, 0.5, 0.5]])
    cube = contract(place(points, implementation), (2.0, 0.5, 0.125), implementation=implementation)
    torch.testing.assert_close(cube.cpu(), expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
@pytest.mark.parametrize("shape", [(0, 3), (1, 3), (3,), (2, 5, 3), (255, 3), (256, 3), (257, 3)])
def test_any_shape_of_points_is_supported(shape, implementation):
    points = 3 * torch.randn(shape, generator=torch.Generator().manual_seed(5))
    cube = contract(place(points, implementation), HALF_EXTENTS[1], implementation=implementation)
    expected = contract_float64(points.reshape(-1, 3).double().numpy() / HALF_EXTENTS[1])
    assert cube.shape == shape
    np.testing.assert_allclose(cube.cpu().numpy().reshape(-1, 3), expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
@pytest.mark.parametrize("layout", ["by columns", "part of wider rows", "expanded"])
def test_memory_layouts_have_no_effect(layout, implementation):
    wide = place(3 * torch.randn(9, 7, generator=torch.Generator().manual_seed(6)), implementation)
    views = {
        "by columns": wide[:, :3].T.contiguous().T,
        "part of wider rows": wide[::2, 1:6:2],
        "expanded": wide[:1, :3].expand(9, 3),
    }
    points = views[layout]
    assert not points.is_contiguous()
    cube = contract(points, HALF_EXTENTS[1], implementation=implementation)
    expected = contract(points.contiguous(), HALF_EXTENTS[1], implementation=implementation)
    torch.testing.assert_close(cube, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_nan_coordinates_give_nan_only_there(axis, implementation):
    points = torch.ones(4, 3)
    points[2, axis] = float("nan")
    cube = contract(place(points, implementation), HALF_EXTENTS[1], implementation=implementation)
    assert cube[2, axis].isnan() and not cube[[0, 1, 3]].isnan().any()


@pytest.mark.parametrize("half_extent", HALF_EXTENTS)
def test_contract_of_a_box_passes_gradcheck(half_extent):
    u = np.concatenate([radius * random_directions(3, seed=7) for radius in (0.3, 1.2, 30.0)])
    points = torch.from_numpy(u * half_extent).requires_grad_()
    assert torch.autograd.gradcheck(lambda points: contract(points, half_extent), (points,), eps=1e-6, atol=1e-7)


@needs_triton
def test_the_kernel_is_not_used_where_a_gradient_is_needed():
    points = gpu(torch.ones(2, 3)).requires_grad_()
    with pytest.raises(ValueError, match="no implementation 'gpu'"):
        contract(points, implementation="gpu")
    contract(points).sum().backward()
    assert points.grad.isfinite().all() and points.grad.any()
    with torch.no_grad():
        assert not contract(points, implementation="gpu").requires_grad


def test_unknown_types_and_implementations_are_rejected():
    with pytest.raises(ValueError, match="float32"):
        contract(torch.ones(2, 3).double(), implementation="gpu")
    with pytest.raises(ValueError, match="no implementation 'cpu'"):
        contract(torch.ones(2, 3), implementation="cpu")


def test_points_without_three_coordinates_are_rejected():
    for shape in ((6, 2), (3, 4), ()):
        with pytest.raises(ValueError, match="3 coordinates"):
            contract(torch.zeros(shape))

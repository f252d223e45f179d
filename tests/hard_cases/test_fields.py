"""Hard cases of decoding a Gaussian: contraction, hash encoding, decoder, background sphere and activations.

`docs/explanation/numerics.md` states the bounds.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples
from scenes import small_model
from torch import Tensor

from hyrfpack.model import contract
from hyrfpack.ops.background import BACKGROUND_RADIUS, sphere_points
from hyrfpack.ops.hash_encode import hash_encode, level_offsets
from hyrfpack.ops.mlp import mlp

# Half a unit in the last place of float32.
FLOAT32_ROUNDING = 2.0**-24


def _directions(count: int, seed: int = 0) -> np.ndarray:
    vectors = np.random.default_rng(seed).normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def _uniform(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


# -- contraction ----------------------------------------------------------------------------------------------------


def _contract_in_long_double(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return c(u) and its Jacobian (N, 3, 3) by the formulas in long doubles, whose squares do not overflow."""
    u = u.astype(np.longdouble)
    radius = np.maximum(np.sqrt((u**2).sum(1)), 1e-300)[:, None]
    direction = u / radius
    radial = direction[:, :, None] * direction[:, None, :]
    r = radius[..., None]
    outside = 0.25 * (radial / r**2 + (2 - 1 / r) / r * (np.eye(3) - radial))
    value = np.where(radius <= 1, 0.25 * u + 0.5, 0.25 * (2 - 1 / radius) * direction + 0.5)
    return value.astype(float), np.where(r <= 1, 0.25 * np.eye(3), outside).astype(float)


@pytest.mark.parametrize(
    "radius", [1e-30, 0.5, 1 - FLOAT32_ROUNDING, 1.0, 1 + 2 * FLOAT32_ROUNDING, 1.01, 3.0, 1e4, 1e8, 1e18, 1e30]
)
def test_contraction_and_its_jacobian_match_the_formula(radius: float) -> None:
    u = torch.from_numpy(radius * _directions(200)).float().requires_grad_()
    cube = contract(u)
    rows = [torch.autograd.grad(cube[:, axis].sum(), u, retain_graph=True)[0] for axis in range(3)]
    expected, jacobian = _contract_in_long_double(u.detach().numpy())

    error = np.abs(torch.stack(rows, 1).numpy() - jacobian).max((1, 2))

    np.testing.assert_allclose(cube.detach().numpy(), expected, rtol=0, atol=4 * FLOAT32_ROUNDING)
    assert (error <= 1e-6 * np.abs(jacobian).max((1, 2))).all()


@pytest.mark.parametrize("radius", [1 - 1e-9, 1.0, 1 + 1e-9, 1e8, 1e12])
def test_contraction_has_slopes_at_the_unit_sphere_and_far_outside(radius: float) -> None:
    """Steps are proportional to |u|, in float64; at |u| = 1 both sides have the same slope."""
    directions = torch.cat([torch.eye(3, dtype=torch.float64), torch.from_numpy(_directions(5))])
    steps = torch.zeros(8, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda step: contract(radius * (directions + step)), steps, eps=1e-6, atol=1e-6)


FINITE_FLOATS = st.floats(-(2.0**100), 2.0**100, width=32)


@examples(200)
@given(st.lists(st.tuples(FINITE_FLOATS, FINITE_FLOATS, FINITE_FLOATS), min_size=1, max_size=5))
def test_contraction_of_any_point_is_inside_the_cube_and_correct(points: list[tuple]) -> None:
    u = torch.tensor(points, dtype=torch.float32)
    cube = contract(u)
    assert cube.min() >= 0 and cube.max() <= 1
    np.testing.assert_allclose(cube.numpy(), _contract_in_long_double(u.numpy())[0], rtol=0, atol=4 * FLOAT32_ROUNDING)


# -- hash encoding --------------------------------------------------------------------------------------------------

LEVEL_RESOLUTIONS = (2, 23, 1024, 65536)
LOG2_TABLE_SIZE = 12


def _make_table() -> Tensor:
    return 2 * _uniform(level_offsets(LEVEL_RESOLUTIONS, LOG2_TABLE_SIZE)[-1], 2, seed=1) - 1


def _near_cell_boundary(resolution: int, share: float, ulps: int) -> float:
    """Return the coordinate of a vertex of a level, or of a few floats beside it."""
    place = np.float32(round(share * (resolution - 1)) / (resolution - 1))
    for _ in range(abs(ulps)):
        place = np.nextafter(place, np.float32(2 if ulps > 0 else -1))
    return float(np.clip(place, 0, 1))


COORDINATE_STRATEGY = st.one_of(
    st.builds(_near_cell_boundary, st.sampled_from(LEVEL_RESOLUTIONS), st.floats(0, 1), st.integers(-3, 3)),
    st.floats(0, 1, width=32),
)


@examples(100)
@given(st.lists(st.tuples(COORDINATE_STRATEGY, COORDINATE_STRATEGY, COORDINATE_STRATEGY), min_size=1, max_size=8))
def test_points_on_cell_boundaries_encode_as_in_float64(points: list[tuple]) -> None:
    """Rounding may move a point to the next cell, which changes nothing because interpolation is continuous."""
    coords, upstream = torch.tensor(points, dtype=torch.float32), 2 * _uniform(len(points), 8, seed=2) - 1

    def run(dtype: torch.dtype, implementation: str) -> tuple[Tensor, Tensor, Tensor]:
        inputs = [coords.to(dtype).requires_grad_(), _make_table().to(dtype).requires_grad_()]
        features = hash_encode(*inputs, LEVEL_RESOLUTIONS, LOG2_TABLE_SIZE, implementation=implementation)
        return features.detach(), *torch.autograd.grad(features, inputs, upstream.to(dtype))

    expected, _, expected_table = run(torch.float64, "reference")
    for implementation in ("cpu", "reference"):
        features, grad_coords, grad_table = run(torch.float32, implementation)
        # A coordinate is known to one rounding; along an axis of r vertices a feature in [-1, 1] changes by 2 (r - 1).
        for level, resolution in enumerate(LEVEL_RESOLUTIONS):
            error = (features - expected)[:, 2 * level : 2 * level + 2].abs().max()
            assert error <= 6 * FLOAT32_ROUNDING * resolution + 1e-6, level
        assert (grad_table - expected_table).abs().max() <= len(points) * 3 * FLOAT32_ROUNDING * max(LEVEL_RESOLUTIONS)
        assert grad_coords.abs().max() <= 4 * sum(
            LEVEL_RESOLUTIONS
        )  # two features, each with a slope of at most 2 (r - 1)


@pytest.mark.parametrize("implementation", ["cpu", "reference"])
def test_the_faces_of_the_cube_belong_to_the_cells_inside(implementation: str) -> None:
    """At a coordinate of 1 there is no cell to the right, so slopes are those of the last cell."""
    places = torch.tensor([0.0, 0.37, 1.0])
    coords, resolutions = torch.cartesian_prod(places, places, places), (2, 5, 23)
    table = 2 * _uniform(level_offsets(resolutions, 9)[-1], 2, seed=1) - 1

    def slopes(dtype: torch.dtype, implementation: str) -> Tensor:
        inputs = coords.to(dtype).requires_grad_()
        features = hash_encode(inputs, table.to(dtype), resolutions, 9, implementation=implementation)
        return torch.autograd.grad(features.sum(), inputs)[0].double()

    torch.testing.assert_close(
        slopes(torch.float32, implementation), slopes(torch.float64, "reference"), rtol=0, atol=2e-4
    )


@pytest.mark.parametrize("implementation", ["cpu", "reference"])
@pytest.mark.parametrize("far", [1e7, -1e7, 1e12, -1e12])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_the_nearest_cell_is_extrapolated_to_any_distance(implementation: str, far: float, axis: int) -> None:
    """On a level of 512 vertices, a coordinate of 1e7 exceeds every 32-bit integer."""
    coords, resolutions = _uniform(20, 3, seed=3), (5, 512)
    coords[:, axis] = far
    table = 2 * _uniform(level_offsets(resolutions, 9)[-1], 2, seed=1) - 1

    expected = hash_encode(coords.double(), table.double(), resolutions, 9)
    features = hash_encode(coords, table, resolutions, 9, implementation=implementation)

    for level in (slice(0, 2), slice(2, 4)):
        scale = expected[:, level].abs().max()
        torch.testing.assert_close(features[:, level].double(), expected[:, level], rtol=0, atol=1e-4 * scale)


def test_a_hundred_thousand_points_in_one_cell_add_up() -> None:
    coords, upstream = torch.full((100_000, 3), 0.37), _uniform(100_000, 8, seed=3)

    def run(dtype: torch.dtype, implementation: str) -> Tensor:
        table = _make_table().to(dtype).requires_grad_()
        features = hash_encode(
            coords.to(dtype), table, LEVEL_RESOLUTIONS, LOG2_TABLE_SIZE, implementation=implementation
        )
        return torch.autograd.grad(features, table, upstream.to(dtype))[0]

    found, expected = run(torch.float32, "cpu"), run(torch.float64, "reference")
    # A weight has the error of its coordinate, which all points share; the error of adding is on top of it.
    levels = list(zip(level_offsets(LEVEL_RESOLUTIONS, LOG2_TABLE_SIZE), LEVEL_RESOLUTIONS, strict=False))
    for (first, resolution), (last, _) in zip(levels, [*levels[1:], (len(expected), 0)], strict=True):
        error = (found[first:last] - expected[first:last]).abs().max() / expected[first:last].sum()
        assert error <= 3 * FLOAT32_ROUNDING * resolution + 5e-5, resolution


# -- decoder --------------------------------------------------------------------------------------------------------


@examples(40)
@given(st.floats(-20, 12), st.floats(-3, 3), st.integers(1, 700), st.integers(0, 10**6))
def test_decoders_of_any_magnitude_agree_with_float64(inputs: float, weights: float, rows: int, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    x, layers = normal(rows, 20) * 10**inputs, [normal(o, i) * 10**weights for o, i in ((32, 20), (32, 32), (4, 32))]
    biases = [normal(len(layer)) * 10**inputs for layer in layers]

    found = mlp(x, layers, biases, implementation="cpu").double()

    expected = mlp(x.double(), [layer.double() for layer in layers], [bias.double() for bias in biases])
    largest = x.double().abs()  # the sum of the magnitudes of the terms of each output
    for layer, bias in zip(layers, biases, strict=True):
        largest = largest @ layer.double().abs().T + bias.double().abs()
    assert ((found - expected).abs() <= 1e-6 * largest).all()


@pytest.mark.parametrize("implementation", ["cpu", "reference"])
def test_a_relu_at_its_kink_passes_no_gradient(implementation: str) -> None:
    x, eye = torch.zeros(5, 4, requires_grad=True), torch.eye(4)
    mlp(x, [eye, eye], [torch.zeros(4), torch.zeros(4)], implementation=implementation).sum().backward()
    assert not x.grad.any()


# -- background sphere ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("distance", [0.0, 0.5, 99.999, 100.0, 150.0, 1e3, 1e4, 1e5, 1e6, 1e8])
def test_rays_meet_the_sphere_from_any_distance(distance: float) -> None:
    """Rays are aimed at places inside the sphere, away from its rim, where a ray is tangent and any answer possible."""
    origin = torch.from_numpy(distance * _directions(1, seed=1)[0]).float()
    targets = 0.95 * BACKGROUND_RADIUS * np.random.default_rng(2).uniform(size=(2000, 1)) * _directions(2000, seed=3)
    aims = targets - origin.double().numpy()
    directions = torch.from_numpy(aims / np.linalg.norm(aims, axis=1, keepdims=True)).float()

    found = sphere_points(origin, directions).double().numpy()

    o, d = origin.numpy().astype(np.longdouble), directions.numpy().astype(np.longdouble)
    d /= np.sqrt((d**2).sum(1, keepdims=True))
    along = d @ o
    root = np.sqrt(np.maximum(along**2 - o @ o + BACKGROUND_RADIUS**2, 0))  # the textbook root, in enough digits
    bound = 8 * FLOAT32_ROUNDING * (distance + BACKGROUND_RADIUS)
    hits = bound < BACKGROUND_RADIUS / 4
    if hits:  # otherwise float32 directions are too coarse to decide what is hit
        assert np.abs(np.linalg.norm(found, axis=1) - BACKGROUND_RADIUS).max() < bound
        np.testing.assert_allclose(found, (o + (root - along)[:, None] * d).astype(float), rtol=0, atol=bound)
    assert np.abs(np.cross(found - o.astype(float), d.astype(float))).max() < bound + 8 * FLOAT32_ROUNDING * distance


@examples(200)
@given(st.tuples(*[st.floats(-1, 1)] * 3), st.floats(-30, 37), st.tuples(*[st.integers(-1000, 1000)] * 3).filter(any))
def test_every_ray_has_a_finite_background(place: tuple, exponent: float, aim: tuple) -> None:
    origin = torch.tensor(place, dtype=torch.float32) * 10**exponent
    direction = torch.nn.functional.normalize(torch.tensor([aim], dtype=torch.float32))

    point = sphere_points(origin, direction)

    assert torch.isfinite(point).all()
    assert 0 <= contract(point).min() and contract(point).max() <= 1


# -- activations ----------------------------------------------------------------------------------------------------

HARD_PLACES = [
    [0.0, 0.0, 0.0],
    [1.0, 0.0, 0.0],
    [0.6, 0.8, 0.0],
    [1 - 2**-24, 0.0, 0.0],
    [1e8, -1e8, 3.0],
    [1e15, 0, 0],
]


@pytest.mark.parametrize("logit", [-80.0, 0.0, 80.0])
def test_decoding_of_hard_positions_and_logits_agrees_with_float64(logit: float) -> None:
    def run(dtype: torch.dtype) -> tuple[list[Tensor], list[Tensor]]:
        model = small_model(
            HARD_PLACES, fields=1.0, position_gradients=True,
            color_logits=logit, scale_logits=logit, opacity_logits=logit,
        ).to(dtype)  # fmt: skip
        geometry = model.decode_geometry()
        bound = model.scale_bounds(model.gaussians.positions).detach()
        values = [geometry.scales / bound, geometry.quats, geometry.opacities,
                  model.decode_colors(torch.tensor([0.0, 0.0, 0.0], dtype=dtype))]  # fmt: skip
        sum(value.sum() for value in values).backward()
        return values, [getattr(model.gaussians, name).grad for name in model.gaussians.PARAMETER_NAMES]

    expected, expected_gradients = run(torch.float64)
    values, gradients = run(torch.float32)

    for value, wanted in zip(values, expected, strict=True):
        torch.testing.assert_close(value.double(), wanted, rtol=0, atol=5e-6)
    for gradient, wanted in zip(gradients[1:], expected_gradients[1:], strict=True):
        torch.testing.assert_close(gradient.double(), wanted, rtol=0, atol=5e-6)
    assert torch.isfinite(gradients[0]).all()  # gradients of positions: on a cell boundary that of either side is valid

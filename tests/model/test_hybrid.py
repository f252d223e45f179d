from __future__ import annotations

import numpy as np
import pytest
import torch
from scenes import look_at, small_model

from hyrfpack.model import Frame, hybrid
from hyrfpack.model.gaussians import Gaussians
from hyrfpack.ops.viewport import Viewport

BOX_FRAME = Frame((0.0, 0.0, 0.0), 2.0, (1.0, 0.5, 0.25))
CAMERA_POSITION = (0.3, -4.0, 1.5)


def random_points(count: int = 40, seed: int = 0) -> np.ndarray:
    """Return points of which some are inside the box and some far outside."""
    generator = np.random.default_rng(seed)
    return generator.normal(size=(count, 3)) * generator.choice([0.2, 1, 5], (count, 1))


def random_model(**settings):
    generator = torch.Generator().manual_seed(3)
    return small_model(
        random_points(),
        frame=BOX_FRAME,
        fields=1.0,
        color_logits=torch.randn(40, 3, generator=generator),
        scale_logits=torch.randn(40, 1, generator=generator) - 2,
        opacity_logits=torch.randn(40, 1, generator=generator),
        **settings,
    )


# -- the model in numpy, float64 -------------------------------------------------------------------------------------


def sigmoid(x):
    return 1 / (1 + np.exp(-x))


def as_float64(values: torch.Tensor) -> np.ndarray:
    return values.detach().double().numpy()


def evaluate_field_in_numpy(field, cube: np.ndarray, extra: np.ndarray | None = None) -> np.ndarray:
    table, config = as_float64(field.grid.table), field.grid.config
    rows = []
    for point in cube:
        features = []
        for resolution, offset in zip(config.resolutions, config.offsets, strict=False):
            x = point * (resolution - 1)
            cell = np.minimum(np.floor(x), resolution - 2).astype(int)
            value = np.zeros(2)
            for corner in np.ndindex(2, 2, 2):
                i, j, k = (int(v) for v in cell + corner)
                if resolution**3 <= 2**config.log2_table_size:
                    row = i + resolution * j + resolution**2 * k
                else:
                    hashed = i ^ (j * 2654435761 % 2**32) ^ (k * 805459861 % 2**32)
                    row = hashed % 2**config.log2_table_size
                weight = np.prod(np.where(corner, x - cell, 1 - (x - cell)))
                value += weight * table[offset + row]
            features.extend(value)
        rows.append(features)
    h = np.array(rows) if extra is None else np.concatenate((rows, extra), axis=1)
    for layer, (weight, bias) in enumerate(zip(field.weights, field.biases, strict=True)):
        h = h @ as_float64(weight).T + as_float64(bias)
        h = np.maximum(h, 0) if layer < 2 else h
    return h


def contract_in_numpy(model, positions: np.ndarray) -> np.ndarray:
    u = positions / model.config.frame.half_extent
    radius = np.linalg.norm(u, axis=1, keepdims=True)
    return np.where(radius <= 1, u / 4, (2 - 1 / radius) * u / radius / 4) + 0.5


def encode_directions_in_numpy(d: np.ndarray, encoding: str) -> np.ndarray:
    x, y, z = d.T
    if encoding == "frequency":
        phases = np.concatenate([np.pi * 2**k * d for k in range(4)], axis=1)
        return np.concatenate([np.sin(phases), np.cos(phases)], axis=1)
    one, pi = np.ones_like(x), np.pi
    bands = [
        np.stack([one]) * np.sqrt(1 / (4 * pi)),
        np.stack([y, z, x]) * np.sqrt(3 / (4 * pi)),
        np.stack([x * y, y * z, (3 * z**2 - 1) / np.sqrt(12), x * z, (x**2 - y**2) / 2]) * np.sqrt(15 / (4 * pi)),
    ]
    return np.concatenate(bands).T


# -- aggregation -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scale_rule", ["sum", "product"])
@pytest.mark.parametrize("scale_grows", [True, False])
def test_geometry_is_the_aggregation_of_fields_and_explicit_values(scale_rule, scale_grows):
    model = random_model(scale_rule=scale_rule, scale_grows=scale_grows)
    g = model.gaussians
    positions, s_e, a_e = map(as_float64, (g.positions, g.scale_logits, g.opacity_logits))
    raw = evaluate_field_in_numpy(model.geometry, contract_in_numpy(model, positions))
    bound = (
        np.maximum(1, np.linalg.norm(positions / BOX_FRAME.half_extent, axis=1, keepdims=True)) if scale_grows else 1
    )
    s_n = raw[:, 1:4]
    fraction = sigmoid(s_n + s_e) if scale_rule == "sum" else sigmoid(s_n) * sigmoid(s_e)

    geometry = model.decode_geometry()

    np.testing.assert_allclose(as_float64(geometry.opacities), sigmoid(raw[:, 0] + a_e[:, 0]), atol=1e-5)
    np.testing.assert_allclose(as_float64(geometry.scales), bound * fraction, rtol=1e-4)
    np.testing.assert_allclose(as_float64(geometry.quats), raw[:, 4:] + [1, 0, 0, 0], atol=1e-5)


@pytest.mark.parametrize("encoding", ["sh", "frequency"])
def test_colours_are_the_aggregation_seen_from_the_viewpoint(encoding):
    model = random_model(direction_encoding=encoding)
    positions, c_e = as_float64(model.gaussians.positions), as_float64(model.gaussians.color_logits)
    directions = positions - CAMERA_POSITION
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    raw = evaluate_field_in_numpy(
        model.radiance, contract_in_numpy(model, positions), encode_directions_in_numpy(directions, encoding)
    )

    colors = model.decode_colors(torch.tensor(CAMERA_POSITION))

    np.testing.assert_allclose(as_float64(colors), sigmoid(raw + c_e), atol=1e-5)


@pytest.mark.parametrize("encoding", ["sh", "frequency"])
def test_background_is_the_radiance_field_on_the_sphere(encoding):
    model = random_model(background=True, direction_encoding=encoding)
    pose = look_at((0.2, -3.0, 0.4), (0, 0, 0))
    pixels, intrinsics = np.array([[0.5, 0.5], [5.5, 0.5], [3.0, 4.2], [-1.0, 9.0]]), (5.0, 6.0, 2.9, 2.1)
    fx, fy, cx, cy = intrinsics
    rays = np.stack([(pixels[:, 0] - cx) / fx, (pixels[:, 1] - cy) / fy, np.ones(4)], 1) @ pose[:3, :3]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    origin = -pose[:3, :3].T @ pose[:3, 3]
    # |origin + t ray| = 100 gives t as the positive root of the quadratic equation.
    distances = [max(np.roots([1, 2 * ray @ origin, origin @ origin - 100**2]).real) for ray in rays]
    on_sphere = origin + np.array(distances)[:, None] * rays
    raw = evaluate_field_in_numpy(
        model.radiance, contract_in_numpy(model, on_sphere), encode_directions_in_numpy(rays, encoding)
    )

    viewport = Viewport(torch.from_numpy(pose).float(), intrinsics, 6, 4)
    colors = model.decode_background(torch.from_numpy(pixels).float(), viewport)

    np.testing.assert_allclose(as_float64(colors), sigmoid(raw), atol=2e-4)


def test_fields_with_zero_output_leave_the_explicit_values():
    model = small_model(random_points(), fields=0.0, color_logits=0.3, scale_logits=-2.0, opacity_logits=1.5)
    geometry = model.decode_geometry()

    assert torch.equal(geometry.quats, torch.tensor([1.0, 0, 0, 0]).expand(40, 4))
    torch.testing.assert_close(geometry.opacities, torch.full((40,), float(sigmoid(1.5))))
    torch.testing.assert_close(
        geometry.scales / model.scale_bounds(model.gaussians.positions), torch.full((40, 3), float(sigmoid(-2.0)))
    )
    torch.testing.assert_close(
        model.decode_colors(torch.tensor(CAMERA_POSITION)), torch.full((40, 3), float(sigmoid(0.3)))
    )


@pytest.mark.parametrize("learns", [False, True])
def test_a_colour_decoder_with_zero_output_is_evaluated_only_in_training(learns):
    model, viewpoint = random_model().requires_grad_(False), torch.tensor(CAMERA_POSITION)
    for values in (model.radiance.weights[-1], model.radiance.biases[-1]):
        values.zero_()
    model.radiance.requires_grad_(learns)
    model.gaussians.color_logits.requires_grad_(True)
    asked = []
    model.radiance.grid.register_forward_hook(lambda *_: asked.append(1))

    colors = model.decode_colors(viewpoint)
    colors.sum().backward()

    assert len(asked) == learns
    assert torch.equal(colors, torch.sigmoid(model.gaussians.color_logits))
    assert model.gaussians.color_logits.grad.abs().min() > 0
    assert (model.radiance.biases[-1].grad is not None) == learns


def test_a_single_bias_in_the_last_layer_counts_as_output():
    model, viewpoint = random_model().requires_grad_(False), torch.tensor(CAMERA_POSITION)
    weight, bias = model.radiance.weights[-1], model.radiance.biases[-1]
    weight.zero_(), bias.zero_()
    bias[1] = 1.0

    colors = model.decode_colors(viewpoint)

    torch.testing.assert_close(colors, torch.sigmoid(model.gaussians.color_logits + torch.tensor([0.0, 1.0, 0.0])))


def test_decoding_a_subset_equals_a_subset_of_all():
    model, index = random_model(), torch.tensor([3, 3, 17, 0, 39])
    viewpoint = torch.tensor(CAMERA_POSITION)

    some, picked = model.decode_geometry(index), model.decode_geometry()[index]

    # They agree up to the last bits, because matrix products of other heights may add in another order.
    for name in ("scales", "quats", "opacities"):
        torch.testing.assert_close(getattr(some, name), getattr(picked, name), rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(
        model.decode_colors(viewpoint, index), model.decode_colors(viewpoint)[index], rtol=1e-5, atol=1e-6
    )


@pytest.mark.parametrize("extreme", [-80.0, 80.0])
def test_extreme_logits_decode_to_finite_values_in_range(extreme):
    model = small_model(random_points(), color_logits=extreme, scale_logits=extreme, opacity_logits=extreme, fields=1.0)
    geometry, colors = model.decode_geometry(), model.decode_colors(torch.tensor(CAMERA_POSITION))
    for values in (geometry.scales, geometry.quats, geometry.opacities, colors):
        assert torch.isfinite(values).all()
    assert 0 <= geometry.opacities.min() and geometry.opacities.max() <= 1
    assert 0 <= colors.min() and colors.max() <= 1


def test_a_gaussian_at_the_viewpoint_has_a_finite_colour_and_gradient():
    model = small_model([CAMERA_POSITION], fields=1.0, position_gradients=True)
    colors = model.decode_colors(torch.tensor(CAMERA_POSITION))
    colors.sum().backward()
    assert torch.isfinite(colors).all() and torch.isfinite(model.gaussians.positions.grad).all()


def test_fields_evaluated_in_blocks_have_the_same_values(monkeypatch):
    model = random_model()
    outputs, shading = model.geometry_outputs(), model.compute_shading()

    monkeypatch.setattr(hybrid, "GAUSSIANS_PER_CPU_BLOCK", 7)

    torch.testing.assert_close(model.geometry_outputs(), outputs)
    torch.testing.assert_close(model.compute_shading().first_layer, shading.first_layer)


def test_an_empty_model_decodes_to_nothing():
    model = small_model(np.zeros((0, 3)))
    assert model.decode_geometry().scales.shape == (0, 3)
    assert model.decode_colors(torch.tensor(CAMERA_POSITION)).shape == (0, 3)


# -- gradients -------------------------------------------------------------------------------------------------------


def decoded_sum(model) -> torch.Tensor:
    geometry = model.decode_geometry()
    parts = (geometry.scales, geometry.quats, geometry.opacities, model.decode_colors(torch.tensor(CAMERA_POSITION)))
    return sum((part * torch.linspace(0.5, 1.5, part.numel()).view_as(part)).sum() for part in parts)


def test_fields_are_detached_from_positions_by_default():
    model = random_model()
    decoded_sum(model).backward()
    assert model.gaussians.positions.grad is None
    others = {name: p.grad for name, p in model.named_parameters() if name != "gaussians.positions"}
    assert all(grad is not None and grad.abs().max() > 0 for grad in others.values()), others.keys()


@pytest.mark.parametrize("scale_rule", ["sum", "product"])
def test_position_gradients_attach_the_fields(scale_rule):
    model = random_model(position_gradients=True, scale_rule=scale_rule).double()
    viewpoint = torch.tensor(CAMERA_POSITION, dtype=torch.float64)
    positions = model.gaussians.positions
    generator = torch.Generator().manual_seed(9)

    def decoded() -> torch.Tensor:
        geometry = model.decode_geometry()
        return torch.cat(
            [geometry.scales.log(), geometry.quats, geometry.opacities[:, None], model.decode_colors(viewpoint)], 1
        )

    weights = torch.rand(40, 11, generator=generator, dtype=torch.float64)
    (decoded() * weights).sum().backward()

    # Central differences: points whose cell or ReLU changes within the step do not match, so only most have to.
    step, before = 1e-7, positions.detach().clone()
    numeric = torch.empty_like(before)
    with torch.no_grad():
        for axis in range(3):
            sides = []
            for sign in (1, -1):
                positions.copy_(before)
                positions[:, axis] += sign * step
                sides.append((decoded() * weights).sum(1))
            numeric[:, axis] = (sides[0] - sides[1]) / (2 * step)
    torch.testing.assert_close(positions.grad, numeric, rtol=1e-4, atol=1e-5)


def test_the_length_of_a_model_is_its_number_of_gaussians():
    model = random_model()
    assert len(model) == len(model.gaussians) == 40
    assert [getattr(model.gaussians, name).shape[1] for name in Gaussians.PARAMETER_NAMES] == list(
        Gaussians.PARAMETER_WIDTHS
    )

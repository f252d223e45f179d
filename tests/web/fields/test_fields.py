"""The fields in JavaScript return the same values as the model in float64."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from web.scripts import run_script

import hyrfpack
from hyrfpack.model import Frame, HashGridConfig, HybridModel, ModelConfig
from hyrfpack.model.gaussians import Gaussians
from hyrfpack.model.residuals import add_color_residuals
from hyrfpack.ops.background.reference import BACKGROUND_RADIUS
from hyrfpack.ops.contraction import contract
from hyrfpack.ops.shade import encode_directions
from hyrfpack.splats.splats import normalize_quats
from tools.safety.make_golden import add_golden_residuals

EVALUATE_SCRIPT = Path(__file__).parent / "evaluate.mjs"
SMALL_GRID = HashGridConfig(log2_table_size=6, levels=3, base=3, finest=12)
LARGE_GRID = HashGridConfig(log2_table_size=14, levels=16, base=16, finest=512)
ONE_LEVEL_GRID = HashGridConfig(log2_table_size=4, levels=1, base=2, finest=2)
# Sums are float64 and rounded once to float32, so the measured error is 1e-7; near 0 it is absolute.
FLOAT32_ROUNDING = {"rtol": 2e-7, "atol": 1e-7}


def random_model(count: int, seed: int = 3, residual_degree: int | None = None, **settings: object) -> HybridModel:
    """Return a model with large random fields and Gaussians inside the frame, far outside and at its centre."""
    generator = torch.Generator().manual_seed(seed)
    frame = Frame((10.0, -3.0, 0.5), 2.5, (1.0, 0.5, 0.25))
    config = ModelConfig(**{"frame": frame, "geometry": SMALL_GRID, "radiance": LARGE_GRID, "hidden": 19, **settings})

    def normal(width: int, spread: float = 1.0) -> torch.Tensor:
        return torch.randn(count, width, generator=generator) * spread

    positions = normal(3) * torch.logspace(-2, 4, count)[:, None]
    positions[:1] = 0
    model = HybridModel(config, Gaussians(positions, normal(3), normal(1), normal(1)), generator)
    with torch.no_grad():
        for parameter in (*model.geometry.parameters(), *model.radiance.parameters()):
            parameter.copy_(torch.randn(parameter.shape, generator=generator) * 0.4)
    return model if residual_degree is None else add_golden_residuals(model, residual_degree)


def random_directions(count: int, seed: int) -> np.ndarray:
    values = np.random.default_rng(seed).normal(size=(count, 3))
    values /= np.linalg.norm(values, axis=1, keepdims=True)
    values[:1] = 0, 0, 1
    return values.astype(np.float32)


def evaluate_in_float64(
    model: HybridModel, along: np.ndarray, places: np.ndarray, behind: np.ndarray
) -> list[np.ndarray]:
    """Return the arrays that evaluate.mjs writes, computed by the model in float64."""
    model = model.double()
    along, places, behind = (torch.from_numpy(values).double() for values in (along, places, behind))
    coding = model.config.direction_encoding
    with torch.no_grad():
        geometry, coords = model.decode_geometry(), model.cube_coords(model.gaussians.positions)
        colors = torch.sigmoid(model.radiance(coords, encode_directions(along, coding)) + model.gaussians.color_logits)
        if model.gaussians.color_residuals is not None:
            colors = add_color_residuals(colors, model.gaussians.color_residuals, along)
        sphere = contract(places, model.config.frame.half_extent)
        background = torch.sigmoid(model.radiance(sphere, encode_directions(behind, coding)))
    quats = geometry.quats / geometry.quats.norm(dim=1, keepdim=True)
    return [part.numpy() for part in (geometry.opacities, geometry.scales, quats, colors, background)]


def evaluate_in_node(model: HybridModel, tmp_path: Path, *inputs: np.ndarray) -> list[np.ndarray]:
    count, sphere = len(model), len(inputs[-1])
    hyrfpack.save_model(model, tmp_path / "model.hyrf", profile="raw")
    (tmp_path / "inputs").write_bytes(b"".join(values.astype("<f4").tobytes() for values in inputs))
    run_script(EVALUATE_SCRIPT, tmp_path / "model.hyrf", tmp_path / "inputs", tmp_path / "outputs")
    numbers = np.fromfile(tmp_path / "outputs", "<f4")
    parts = np.split(numbers, np.cumsum([count, 3 * count, 4 * count, 3 * count]))
    shapes = (count,), (count, 3), (count, 4), (count, 3), (sphere, 3)
    return [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)]


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"direction_encoding": "sh", "scale_rule": "product"},
        {"geometry": LARGE_GRID, "radiance": SMALL_GRID, "hidden": 64, "scale_grows": False},
        {"geometry": ONE_LEVEL_GRID, "radiance": ONE_LEVEL_GRID, "hidden": 1},
        {"residual_degree": 0},
        {"residual_degree": 3},
    ],
    ids=["frequency", "sh", "wide", "smallest", "residuals", "residuals of degree 3"],
)
def test_fields_equal_those_of_the_model_in_float64(settings: dict, tmp_path: Path) -> None:
    model = random_model(700, **settings)
    along, behind = random_directions(700, 1), random_directions(300, 2)
    places = (BACKGROUND_RADIUS * random_directions(300, 5)).astype(np.float32)

    found = evaluate_in_node(model, tmp_path, along, places, behind)

    for values, expected in zip(found, evaluate_in_float64(model, along, places, behind), strict=True):
        np.testing.assert_allclose(values, expected, **FLOAT32_ROUNDING)


def test_a_model_without_gaussians_has_a_background(tmp_path: Path) -> None:
    model, behind = random_model(0), random_directions(5, 2)
    places = (BACKGROUND_RADIUS * behind).astype(np.float32)

    *gaussians, background = evaluate_in_node(model, tmp_path, random_directions(0, 1), places, behind)

    assert [part.size for part in gaussians] == [0, 0, 0, 0]
    expected = evaluate_in_float64(model, random_directions(0, 1), places, behind)[-1]
    np.testing.assert_allclose(background, expected, **FLOAT32_ROUNDING)


def test_a_zero_quaternion_becomes_the_identity(tmp_path: Path) -> None:
    model = random_model(4)
    with torch.no_grad():
        model.geometry.weights[-1].zero_()
        model.geometry.biases[-1].copy_(torch.tensor([0.0, 0, 0, 0, -1, 0, 0, 0]))

    quats = evaluate_in_node(
        model, tmp_path, random_directions(4, 1), random_directions(1, 2), random_directions(1, 2)
    )[2]

    np.testing.assert_array_equal(quats, normalize_quats(np.zeros((4, 4))))

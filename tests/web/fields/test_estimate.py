"""The estimate of the first picture: exact values at anchors, and their neural values elsewhere."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from web.fields.test_fields import random_model
from web.scripts import run_script

import hyrfpack
from hyrfpack.model import HybridModel
from hyrfpack.ops.shade import encode_directions

ESTIMATE_SCRIPT = Path(__file__).parent / "estimate.mjs"
MAX_ANCHORS = 4096
EYE_LOCAL = np.array([0.3, -2.0, 0.5])
# Anchors' values are float32 numbers in (0, 1), and logits are added to these.
ROUNDING_TOLERANCES = {"rtol": 1e-4, "atol": 1e-6}


def make_model(count: int, **settings: object) -> HybridModel:
    """Return a random model in whose file neighbours are near each other, as in trained ones."""
    model = random_model(count, **settings)
    positions = torch.randn(count, 3, generator=torch.Generator().manual_seed(1))
    model.gaussians.positions.data = positions[positions[:, 0].argsort()]
    return model


def estimate_in_node(model: HybridModel, tmp_path: Path) -> list[np.ndarray]:
    """Return opacities, scales, quats and colours of all Gaussians."""
    hyrfpack.save_model(model, tmp_path / "model.hyrf", profile="raw")
    lengths = run_script(ESTIMATE_SCRIPT, tmp_path / "model.hyrf", json.dumps(EYE_LOCAL.tolist()), tmp_path / "outputs")
    parts = np.split(np.fromfile(tmp_path / "outputs", "<f4"), np.cumsum(lengths)[:-1])
    return [part.reshape(len(model), -1) for part in parts]


def evaluate_in_float64(model: HybridModel) -> list[np.ndarray]:
    """Return the exact values of what `estimate_in_node` returns."""
    model = model.double()
    positions = model.gaussians.positions
    rays = positions - torch.from_numpy(EYE_LOCAL)
    directions = encode_directions(rays / rays.norm(dim=1, keepdim=True), model.config.direction_encoding)
    with torch.no_grad():
        geometry = model.decode_geometry()
        logits = model.radiance(model.cube_coords(positions), directions) + model.gaussians.color_logits
    quats = geometry.quats / geometry.quats.norm(dim=1, keepdim=True)
    arrays = geometry.opacities, geometry.scales, quats, logits.sigmoid()
    return [part.reshape(len(model), -1).numpy() for part in arrays]


@pytest.mark.parametrize(
    "settings", [{"scale_rule": "product"}, {"scale_rule": "sum", "scale_grows": True, "direction_encoding": "sh"}]
)
def test_all_values_of_a_model_with_few_gaussians_are_exact(tmp_path: Path, settings: dict[str, object]):
    model = make_model(700, **settings)
    for estimate, exact in zip(estimate_in_node(model, tmp_path), evaluate_in_float64(model), strict=True):
        np.testing.assert_allclose(estimate, exact, **ROUNDING_TOLERANCES)


@pytest.mark.acceptance
def test_anchors_have_exact_values_and_others_the_neural_values_of_a_near_anchor(tmp_path: Path):
    model = make_model(MAX_ANCHORS + 900)
    estimate, exact = estimate_in_node(model, tmp_path), evaluate_in_float64(model)
    is_exact = np.isclose(estimate[0], exact[0], **ROUNDING_TOLERANCES).ravel()
    assert is_exact.sum() >= MAX_ANCHORS
    positions = model.gaussians.positions.detach().numpy()
    anchors, others = np.flatnonzero(is_exact), np.flatnonzero(~is_exact)
    # Quaternions are neural values alone, so they tell which anchor it was.
    sources = [anchors[np.abs(exact[2][anchors] - quat).max(1).argmin()] for quat in estimate[2][others]]
    np.testing.assert_allclose(estimate[2][others], exact[2][sources], atol=1e-5)
    own = model.gaussians.opacity_logits.detach().numpy()
    odds = exact[0] / (1 - exact[0]) / np.exp(own)
    np.testing.assert_allclose(estimate[0][others], 1 / (1 + 1 / (odds[sources] * np.exp(own[others]))), rtol=1e-4)
    distances = np.linalg.norm(positions[others] - positions[sources], axis=1)
    nearest = np.linalg.norm(positions[others, None] - positions[anchors], axis=-1).min(1)
    assert np.median(distances) < 2 * np.median(nearest)

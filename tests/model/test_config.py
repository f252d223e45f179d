from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from hyrfpack.model import Frame, HashGridConfig, HybridModel, ModelConfig
from hyrfpack.model.gaussians import Gaussians

MODEL_CONFIG = ModelConfig(
    frame=Frame((1.0, -2.0, 3e5), 0.125, (1.0, 0.25, 0.5)),
    geometry=HashGridConfig(9, levels=8, base=16, finest=256),
    radiance=HashGridConfig(10),
    background=False,
    solid=(1.0, 0.5, 0.0),
    scale_rule="product",
    direction_encoding="sh",
    antialiased=True,
)


def test_config_survives_json():
    assert ModelConfig.from_dict(json.loads(json.dumps(MODEL_CONFIG.to_dict()))) == MODEL_CONFIG


def test_a_configuration_has_a_rotation_only_if_its_frame_is_rotated():
    rotated = replace(MODEL_CONFIG, frame=replace(MODEL_CONFIG.frame, rotation=(0.8, 0.0, -0.6, 0.0)))

    assert "rotation" not in MODEL_CONFIG.to_dict()["frame"]
    assert ModelConfig.from_dict(json.loads(json.dumps(rotated.to_dict()))) == rotated != MODEL_CONFIG


def test_by_default_grids_rise_from_8_to_512_vertices_and_directions_have_24_inputs():
    grid = HashGridConfig(10)
    ratios = np.divide(grid.resolutions[1:], grid.resolutions[:-1])
    assert len(grid.resolutions) == 16 and (grid.resolutions[0], grid.resolutions[-1]) == (8, 512)
    assert np.abs(ratios - 64 ** (1 / 15)).max() < 1 / 8  # geometric, up to rounding to whole vertices
    config = ModelConfig(MODEL_CONFIG.frame, geometry=grid, radiance=grid)
    nothing = Gaussians(*(torch.zeros(0, width) for width in Gaussians.PARAMETER_WIDTHS))
    model = HybridModel(config, nothing)
    assert model.radiance.weights[0].shape == (64, 16 * 2 + 24)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("scale_rule", "max"),
        ("direction_encoding", "none"),
        ("hidden", 0),
        ("hidden", 5000),
        ("solid", [1.0, 2.0]),
        ("frame", {"center": [0, 0, 0], "scale": 0.0, "half_extent": [1, 1, 1]}),
        ("frame", {"center": [0, 0, 0], "scale": 1.0, "half_extent": [1, -1, 1]}),
        ("frame", {"center": [0, 0, 0], "scale": float("nan"), "half_extent": [1, 1, 1]}),
        ("frame", {"center": [0, 0, 0], "scale": 1.0, "half_extent": [1, 1, 1], "rotation": [1, 0, 0]}),
        ("frame", {"center": [0, 0, 0], "scale": 1.0, "half_extent": [1, 1, 1], "rotation": [1, 0, 0, 0.1]}),
        ("geometry", {"log2_table_size": 9, "depth": 3}),
        ("surprise", 1),
    ],
)
def test_config_rejects_wrong_fields(name, value):
    with pytest.raises((KeyError, TypeError, ValueError)):
        ModelConfig.from_dict({**MODEL_CONFIG.to_dict(), name: value})


@pytest.mark.parametrize("name", ["frame", "geometry", "radiance"])
def test_config_rejects_missing_fields(name):
    values = MODEL_CONFIG.to_dict()
    del values[name]
    with pytest.raises((KeyError, TypeError, ValueError)):
        ModelConfig.from_dict(values)

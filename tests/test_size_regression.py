"""File sizes of fixed models in each profile stay within 1 % of the recorded ones.

python -m tests.test_size_regression     records the sizes again (after a change that is meant to change them)
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from hyrfpack.model import Frame, HashGridConfig, HybridModel, ModelConfig
from hyrfpack.model.gaussians import Gaussians
from tools.safety.synthetic_encoding import encode

RECORDED_SIZES_PATH = Path(__file__).parent / "golden" / "sizes.json"
PROFILE_NAMES = ("raw", "paper", "compact")
# Number of Gaussians and log2 table sizes of a scene with surroundings, of a single object and of a minimal model.
MODEL_SIZES = {"scene": (20_000, 12, 13), "object": (4_000, 10, 11), "one": (1, 4, 4)}


def make_model(count: int, geometry_size: int, radiance_size: int) -> HybridModel:
    """Return a model with the statistics of a trained one.

    Positions lie in clusters on surfaces. Colour logits share their brightness. Opacity logits have two modes. Hash
    tables are Laplace-distributed, wider on finer levels, and most rows of the coarse levels are untouched.
    """
    rng = np.random.default_rng(7)
    config = ModelConfig(
        frame=Frame(center=(0.3, -1.7, 2.9), scale=4.2, half_extent=(1.0, 0.6, 0.9)),
        geometry=HashGridConfig(geometry_size, levels=16, base=8, finest=512),
        radiance=HashGridConfig(radiance_size, levels=16, base=8, finest=512),
        hidden=64,
        direction_encoding="frequency",
    )
    centers = rng.normal(size=(50, 3)) * 0.7
    spread = rng.normal(size=(count, 3)) * (0.2, 0.2, 0.01)
    positions = centers[rng.integers(50, size=count)] + spread
    colors = rng.normal(size=(count, 1)) + 0.3 * rng.laplace(size=(count, 3))
    scales = rng.normal(-4.0, 0.8, size=(count, 1))
    opacities = np.where(rng.random((count, 1)) < 0.3, rng.normal(4, 2, (count, 1)), rng.normal(-2, 1, (count, 1)))
    parts = [torch.from_numpy(part).float() for part in (positions, colors, scales, opacities)]
    model = HybridModel(config, Gaussians(*parts))
    with torch.no_grad():
        for field in (model.geometry, model.radiance):
            grid = field.grid.config
            for level, (start, stop) in enumerate(zip(grid.offsets, grid.offsets[1:], strict=False)):
                share = (level + 1) / grid.levels
                rows = rng.laplace(scale=0.05 * share, size=(stop - start, 2))
                untouched = rng.random(stop - start) > share
                rows[untouched] = rng.uniform(-1e-4, 1e-4, size=(int(untouched.sum()), 2))
                field.grid.table[start:stop] = torch.from_numpy(rows)
            for parameter in (*field.weights, *field.biases):
                parameter.copy_(torch.from_numpy(rng.normal(scale=0.2, size=parameter.shape)))
    return model


def measure_bytes(name: str, profile: str) -> int:
    return len(encode(make_model(*MODEL_SIZES[name]), profile))


@pytest.mark.parametrize("profile", PROFILE_NAMES)
@pytest.mark.parametrize("name", MODEL_SIZES)
def test_fixed_models_keep_their_size(name, profile):
    recorded = json.loads(RECORDED_SIZES_PATH.read_text())["bytes"][name][profile]

    assert measure_bytes(name, profile) == pytest.approx(recorded, rel=0.01)


if __name__ == "__main__":
    sizes = {name: {profile: measure_bytes(name, profile) for profile in PROFILE_NAMES} for name in MODEL_SIZES}
    record = {"command": "python tests/test_size_regression.py", "bytes": sizes}
    RECORDED_SIZES_PATH.write_text(json.dumps(record, indent=2) + "\n")
    print(RECORDED_SIZES_PATH.read_text())

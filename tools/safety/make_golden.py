"""Make the golden files under tests/golden: what this version of the format writes, for all later ones to read.

    python -m tools.safety.make_golden

A golden file is never made again once a release has written such files: delete it by hand to replace it before.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from hyrfpack.format import decode_model
from hyrfpack.format.arrays import to_arrays
from hyrfpack.model import Frame, HashGridConfig, HybridModel, ModelConfig
from hyrfpack.model.gaussians import Gaussians
from tools.safety import minimal_reader
from tools.safety.plans import encode

TESTS = Path(__file__).parents[2] / "tests"
FOLDER = TESTS / "golden"
PROVENANCE = {"preset": "standard", "steps": 100, "why": {"geometry": "one entry a Gaussian", "name": "caf\u00e9"}}
# File -> profile and settings.
FILES = {
    "v1.0_raw": ("raw", {}),
    "v1.0_paper": ("paper", {"color": (3, 8), "scale": (2, 4), "opacity": (1, 16)}),
    "v1.1_compact": ("compact", {"distortion": 5e-4}),
    "v1.1_compact_layers": ("compact", {"distortion": 1e-5, "layered": True}),
}


def golden_model() -> HybridModel:
    """A model of 20 Gaussians with one dense and one hashed level in each grid, and no two sizes alike."""
    rng = np.random.default_rng(20)
    config = ModelConfig(
        frame=Frame(center=(1e6, -0.1, 3.0), scale=12.5, half_extent=(1.0, 0.75, 0.25)),
        geometry=HashGridConfig(log2_table_size=4, levels=2, base=2, finest=5),
        radiance=HashGridConfig(log2_table_size=5, levels=2, base=3, finest=7),
        hidden=3,
        background=True,
        solid=(0.0, 0.5, 1.0),
        scale_rule="sum",
        scale_grows=True,
        direction_encoding="sh",
        position_gradients=False,
        antialiased=True,
    )
    values = torch.from_numpy(rng.normal(size=(20, 8)).astype(np.float32))
    values[0, :3] = torch.tensor([-0.0, 1e-42, -1234.5])
    model = HybridModel(config, Gaussians(values[:, :3], values[:, 3:6], values[:, 6:7], values[:, 7:] * 4))
    with torch.no_grad():
        for parameter in (*model.geometry.parameters(), *model.radiance.parameters()):
            parameter.copy_(torch.from_numpy(rng.laplace(scale=0.1, size=parameter.shape)))
    return model


def expected(model: HybridModel, name: str) -> np.ndarray:
    """A parameter as the paper profile must give it back, from the original by the profile's definition."""
    values = model.state_dict()[name].numpy()
    if name.endswith("grid.table"):
        low, high = values.min().astype(np.float64), values.max().astype(np.float64)
        codes = np.rint((values - low) / (high - low) * 255)
        return (((255 - codes) * low + codes * high) / 255).astype(np.float32)
    return values.astype(np.float16).astype(np.float32)


def recorded(model: HybridModel, profile: str, data: bytes) -> dict[str, np.ndarray]:
    """What the file must decode to, by parameter."""
    _, groups = minimal_reader.read(data)
    if profile == "compact":
        # What is kept and how finely is the encoder's choice, so these come from the minimal reader.
        decoded = decode_model(data)
        for group, values in to_arrays(decoded).items():
            assert np.array_equal(values.view(np.uint32), groups[group].view(np.uint32)), group
        return {name: value.numpy() for name, value in decoded.state_dict().items()}
    original = {name: value.numpy() for name, value in model.state_dict().items()}
    values = dict(original) if profile == "raw" else {name: expected(model, name) for name in original}
    for group, name in {"COLO": "color_logits", "SCAL": "scale_logits", "OPAC": "opacity_logits"}.items():
        before = original[f"gaussians.{name}"]
        after = groups[group]
        # Codebooks depend on k-means, so these come from the minimal reader, and are near the original.
        assert np.abs(after - before).max() < 0.5 * before.std()
        values[f"gaussians.{name}"] = after
    return values


def main() -> None:
    model = golden_model()
    for name, (profile, settings) in FILES.items():
        target = FOLDER / f"{name}.hyrf"
        if target.exists():
            print(f"{target} is there already and is kept")
            continue
        data = encode(model, profile, PROVENANCE, **settings)
        values = recorded(model, profile, data)
        FOLDER.mkdir(exist_ok=True)
        target.write_bytes(data)
        np.savez_compressed(target.with_suffix(".npz"), **values)
        print(f"{target}: {len(data)} bytes")


if __name__ == "__main__":
    main()

"""Files that released versions wrote stay readable, and are still written byte by byte the same."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hyrfpack.format import describe, load, metadata
from hyrfpack.model import Frame, HashGridConfig, ModelConfig
from tools.safety.make_golden import FILES as GOLDEN_FILES
from tools.safety.plans import encode

GOLDEN = Path(__file__).parents[1] / "golden"
FILES = sorted(GOLDEN.glob("*.hyrf"))


def test_golden_files_are_there():
    assert set(GOLDEN_FILES) <= {file.stem for file in FILES}


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_golden_file_decodes_to_the_recorded_numbers(file):
    recorded = np.load(file.with_suffix(".npz"))

    decoded = {name: value.numpy() for name, value in load(file).state_dict().items()}

    assert sorted(decoded) == sorted(recorded.files)
    for name, values in decoded.items():
        # As bits: -0.0 is not 0.0, and denormals count.
        assert np.array_equal(values.view(np.uint32), recorded[name].view(np.uint32)), name


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_golden_file_has_the_recorded_configuration(file):
    config = load(file).config

    assert config == ModelConfig(
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


@pytest.mark.parametrize("name", GOLDEN_FILES)
def test_golden_model_encodes_to_the_same_bytes(name, monkeypatch):
    golden = (GOLDEN / f"{name}.hyrf").read_bytes()
    info, (profile, settings) = describe(GOLDEN / f"{name}.hyrf"), GOLDEN_FILES[name]
    monkeypatch.setattr(metadata, "writer", lambda: info["writer"])

    data = encode(load(GOLDEN / "v1.0_raw.hyrf"), profile, info["provenance"], **settings)

    assert data == golden
    assert (info["version"], info["profile"]) == (name[1:4], profile)

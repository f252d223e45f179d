"""The reader derives step groups from decoded positions and refuses hostile sections of profile compact."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples
from scenes import small_model

from hyrfpack.errors import HyrfFormatError
from hyrfpack.format.arrays import SECTION_PARAMETERS, group_shapes, to_arrays, to_model
from hyrfpack.format.compact import SECTIONS_BY_CODEC, decode_positions, decode_section, encode
from hyrfpack.format.compact import plan as layout
from hyrfpack.format.compact.plan import build_step_groups
from hyrfpack.format.compact.quantized import CODEC_CHANNELS, CODEC_GROUPS, CODEC_POINTS
from hyrfpack.model import HybridModel
from hyrfpack.ops.hash_encode.reference import cells as reference_cells
from hyrfpack.ops.hash_encode.reference import corner_rows
from hyrfpack.quant import DamagedDataError
from hyrfpack.quant.points import LatticePoints
from tools.safety.synthetic_encoding import quantize_with_drawn_sensitivity


def random_model(count: int) -> HybridModel:
    rng = np.random.default_rng(0)
    return small_model(rng.normal(size=(count, 3)) * 0.7, fields=0.3, color_logits=rng.normal(size=(count, 3)))


# Step groups.


def random_lattice(count: int = 250, seed: int = 0) -> LatticePoints:
    rng = np.random.default_rng(seed)
    bits, classes = np.array([12, 5, 3]), rng.integers(3, size=count).astype(np.uint8)
    return LatticePoints(rng.integers(0, (1 << bits)[classes][:, None], (count, 3)), classes, bits)


@pytest.mark.parametrize("group", ["GTAB", "RTAB"])
def test_table_rows_are_grouped_by_level_and_usage(group: str) -> None:
    config, points = random_model(1).config, random_lattice()
    grid = config.geometry
    coords = torch.from_numpy((points.cells + 0.5) * 2.0 ** -points.bits[points.classes][:, None])
    read = corner_rows(reference_cells(coords, grid.resolutions), grid.resolutions, grid.log2_table_size)
    counts = [0] * grid.rows
    for row in read.flatten().tolist():
        counts[row] += 1

    groups = build_step_groups(group, config, points)

    usage = [0 if n == 0 else 1 + math.floor(math.log(n, 4) + 1e-9) for n in counts]
    level = [sum(row >= offset for offset in grid.offsets[1:-1]) for row in range(grid.rows)]
    expected = [16 * level[row] + usage[row] for row in range(grid.rows) for _ in range(2)]
    assert groups.index.tolist() == expected
    assert groups.count == 16 * grid.levels and max(usage) > 2


def test_usage_counts_every_nth_of_many_gaussians(monkeypatch: pytest.MonkeyPatch) -> None:
    config, points = random_model(1).config, random_lattice(250)
    every_third = LatticePoints(points.cells[::3], points.classes[::3], points.bits)
    expected = build_step_groups("GTAB", config, every_third)

    monkeypatch.setattr(layout, "MAX_COUNTED_GAUSSIANS", 100)

    np.testing.assert_array_equal(build_step_groups("GTAB", config, points).index, expected.index)


def test_without_gaussians_no_row_is_used() -> None:
    config = random_model(1).config
    points = LatticePoints(np.zeros((0, 3), np.int64), np.zeros(0, np.uint8), np.ones(6, np.int64))

    groups = build_step_groups("RTAB", config, points)

    assert (groups.index % 16 == 0).all() and len(groups.index) == 2 * config.radiance.rows


@pytest.mark.parametrize(("group", "field"), [("GMLP", "geometry"), ("RMLP", "radiance")])
def test_weights_are_grouped_by_output_and_biases_by_layer(group: str, field: str) -> None:
    model = random_model(1)
    arrays = to_arrays(model)
    groups = build_step_groups(group, model.config, None)
    arrays[group] = groups.index.astype(np.float32)[:, None]

    parts = getattr(to_model(model.config, arrays), field)

    expected = 0
    for weights, biases in zip(parts.weights, parts.biases, strict=True):
        for row in weights.tolist():
            assert set(row) == {expected}
            expected += 1
        assert set(biases.tolist()) == {expected}
        expected += 1
    assert groups.count == expected


# Hostile sections.


@pytest.mark.parametrize(
    ("group", "codec"),
    [
        (group, codec)
        for codec, groups in SECTIONS_BY_CODEC.items()
        for group in SECTION_PARAMETERS
        if group not in groups
    ],
)
def test_sections_with_a_codec_of_other_groups_are_refused(group: str, codec: int) -> None:
    with pytest.raises(HyrfFormatError, match="codec"):
        decode_section(group, codec, memoryview(bytes(40)), (0, 1), random_model(1).config, random_lattice())


@pytest.mark.parametrize("group", ["COLO", "SCAL", "OPAC", "GTAB", "RTAB"])
def test_sections_that_need_positions_are_refused_without_them(group: str) -> None:
    codec = CODEC_GROUPS if group.endswith("TAB") else CODEC_CHANNELS

    with pytest.raises(HyrfFormatError, match=f"positions of codec {CODEC_POINTS}"):
        decode_section(group, codec, memoryview(bytes(40)), (0, 1), random_model(1).config, None)


def decode_sections(coded: dict[str, tuple[int, bytes]], model: HybridModel, count: int) -> dict[str, np.ndarray]:
    arrays = {}
    arrays["POSI"], points = decode_positions(memoryview(coded["POSI"][1]), count, model.config)
    for group, shape in group_shapes(model.config, count).items():
        if group != "POSI":
            codec, data = coded[group]
            arrays[group] = decode_section(group, codec, memoryview(data), shape, model.config, points)
    return arrays


@given(st.data())
@examples(150)
def test_damaged_sections_are_refused_or_decode_to_finite_values(data: st.DataObject) -> None:
    group = data.draw(st.sampled_from(sorted(CODED_SECTIONS)))
    codec, stored = CODED_SECTIONS[group]
    damaged = bytearray(stored)
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] ^= data.draw(st.integers(1, 255))
    coded = {**CODED_SECTIONS, group: (codec, bytes(damaged))}

    try:
        arrays = decode_sections(coded, SAMPLE_MODEL, 40)
    except DamagedDataError:
        return
    for group, shape in group_shapes(SAMPLE_MODEL.config, 40).items():
        assert arrays[group].shape == shape and np.isfinite(arrays[group]).all()


SAMPLE_MODEL = random_model(40)
CODED_SECTIONS = {
    section.type: (section.codec, section.data)
    for section in encode(SAMPLE_MODEL, quantize_with_drawn_sensitivity(SAMPLE_MODEL, prune=False))[0]
}

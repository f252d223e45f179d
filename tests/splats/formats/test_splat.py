"""The .splat format: records, their order and a real file round-trip, invalid files are refused."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hyrfpack.errors import HyrfDataError
from hyrfpack.splats.formats import splat
from hyrfpack.splats.splats import Splats, normalize_quats

BAND_0_VALUE = 0.5 / np.sqrt(np.pi)


def make_splats(count: int) -> Splats:
    rng = np.random.default_rng(count)
    return Splats(
        rng.normal(0, 5, (count, 3)).astype(np.float32),
        np.exp(rng.normal(-3, 1, (count, 3))),
        normalize_quats(rng.normal(size=(count, 4))),
        rng.uniform(0, 1, count),
        rng.uniform(-1.7, 1.7, (count, 4, 3)),
    )


def test_a_record_has_32_bytes():
    color = (np.array([1, 0.2, -3]) - 0.5) / BAND_0_VALUE
    splats = Splats(np.array([[1.0, -2, 3]]), np.array([[0.1, 0.2, 0.3]]), np.array([[1.0, 0, 0, 0]]), np.array([0.4]),
                    color.reshape(1, 1, 3))  # fmt: skip
    record = struct.pack("<6f8B", 1, -2, 3, 0.1, 0.2, 0.3, 255, 51, 0, 102, 255, 128, 128, 128)
    assert splat.encode(splats) == record

    decoded = splat.decode(record, "a.splat")

    np.testing.assert_array_equal(decoded.positions, [[1, -2, 3]])
    np.testing.assert_array_equal(decoded.scales, splats.scales)
    np.testing.assert_array_equal(decoded.quats, [[1, 0, 0, 0]])
    np.testing.assert_allclose(decoded.opacities, [0.4], rtol=1e-6)
    np.testing.assert_allclose(decoded.harmonics[0], (np.array([[1, 0.2, 0]]) - 0.5) / BAND_0_VALUE, rtol=1e-5)


def test_gaussians_are_sorted_by_visible_size():
    splats = make_splats(200)
    order = np.argsort(-splats.opacities.astype(float) * splats.scales.astype(float).prod(axis=1))
    decoded = splat.decode(splat.encode(splats), "a.splat")
    np.testing.assert_array_equal(decoded.positions, splats.positions[order])
    assert np.abs(decoded.opacities - splats.opacities[order]).max() <= 0.5 / 255 + 1e-6
    assert np.abs(decoded.harmonics - splats.harmonics[order, :1]).max() <= 0.5 / 255 / BAND_0_VALUE + 1e-5
    assert np.abs((decoded.quats * splats.quats[order]).sum(1)).min() > 0.9999
    assert splat.encode(splats) == splat.encode(splats)


def test_no_gaussians_are_encoded_as_an_empty_file():
    assert splat.encode(make_splats(0)) == b""
    assert len(splat.decode(b"", "a.splat")) == 0


def test_a_file_of_another_program_round_trips(shared_data):
    data = (shared_data / "trained_models" / "small_scene.splat").read_bytes()
    splats = splat.decode(data, "small_scene.splat")
    assert len(splats) == 22_764 == len(data) // 32
    again = np.frombuffer(splat.encode(splats), np.uint8).reshape(-1, 32)
    before = np.frombuffer(data, np.uint8).reshape(-1, 32)
    order = np.lexsort(before[:, :28].T)
    np.testing.assert_array_equal(again[np.lexsort(again[:, :28].T), :28], before[order, :28])


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (bytes(33), "33 bytes are not a multiple of 32"),
        (struct.pack("<6f8x", 0, 0, 0, 1, -1, 1), "a scale is negative"),
        (struct.pack("<6f8x", 0, np.inf, 0, 1, 1, 1), "the position of Gaussian 0 of 1 is not a finite number"),
        (bytes(32) + struct.pack("<6f8x", 0, 0, 0, 1, np.nan, 1), "the scale of Gaussian 1 of 2"),
    ],
)
def test_invalid_files_are_refused_with_the_reason(data, words):
    with pytest.raises(HyrfDataError, match=words) as error:
        splat.decode(data, "some.splat")
    assert str(error.value).startswith("some.splat: ")


def test_positions_beyond_float32_are_refused():
    splats = make_splats(2)
    splats.positions[1, 1] = -1e39
    with pytest.raises(HyrfDataError, match="farther from the origin"):
        splat.encode(splats)


@settings(max_examples=40, derandomize=True, database=None)
@given(st.binary(max_size=100), st.integers(0, 3))
def test_random_bytes_are_decoded_or_refused(data, records):
    try:
        splats = splat.decode((data + bytes(32))[: 32 * records] or data, "a.splat")
    except HyrfDataError as error:
        assert str(error).startswith("a.splat: ")
    else:
        assert np.isfinite(splats.positions).all()

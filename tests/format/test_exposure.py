from __future__ import annotations

import dataclasses
import struct

import numpy as np
import pytest
from exposures import maps_equal, random_map
from hypothesis import given
from hypothesis import strategies as st
from scenes import ball_points, small_model

from hyrfpack.errors import HyrfFormatError
from hyrfpack.format.codec import decode_model, encode_model
from hyrfpack.format.container import MINOR_VERSION, read_container, write_container
from hyrfpack.format.exposure import decode_exposure, encode_exposure
from hyrfpack.format.exposure_header import CODEC_EXPOSURE
from hyrfpack.format.sections import EXPOSURE
from hyrfpack.model.exposure import MAX_CENTERS
from tools.safety.synthetic_encoding import encode

RANDOM_SEEDS = st.integers(0, 2**32 - 1)


@given(RANDOM_SEEDS, st.integers(0, MAX_CENTERS))
def test_exposure_maps_round_trip(seed, centers):
    exposure = random_map(seed, centers)
    section = encode_exposure(exposure)

    assert len(section.data) == section.raw_length == 84 + 12 * centers and not section.required
    assert maps_equal(decode_exposure(section.codec, memoryview(section.data), section.raw_length), exposure)


def build_map_bytes(numbers: list[float], centers: bytes) -> bytes:
    """Build the bytes of a map with the right length from any numbers."""
    count = len(centers) // 12
    return bytes([count, 0, 0, 0]) + np.array(numbers, "<f4").tobytes() + centers[: 12 * count]


TWENTY_FLOATS = st.lists(st.floats(width=32) | st.floats(-8, 8, width=32), min_size=20, max_size=20)


@given(st.binary(max_size=200) | st.builds(build_map_bytes, TWENTY_FLOATS, st.binary(max_size=800)))
def test_random_bytes_are_decoded_or_refused(data):
    try:
        exposure = decode_exposure(CODEC_EXPOSURE, memoryview(data), len(data))
    except HyrfFormatError:
        return
    gains = exposure.predict_log_gains(np.zeros(3), np.array([0.0, 0.0, 1.0]))
    assert np.isfinite(gains).all() and np.abs(gains).max() <= 8


@pytest.mark.parametrize("change", [b"", b"\1", None])
def test_bytes_of_a_wrong_length_are_refused(change):
    section = encode_exposure(random_map(0, 3))
    data = section.data[:-1] if change is None else bytes(section.data) + change
    raw_length = len(data) + (change == b"")
    with pytest.raises(HyrfFormatError, match="damaged"):
        decode_exposure(CODEC_EXPOSURE, memoryview(data), raw_length)


HEADER_FORMAT = "<BBBB2f6f3f6f3f"  # from docs/reference/format.md


@pytest.mark.parametrize(
    ("place", "value"),
    [
        *[(place, 1) for place in (1, 2, 3)],  # reserved bytes
        *[(place, value) for place in (4, 5) for value in (0.0, -1.0)],  # lengths
        *[(place, 1e6) for place in (6, 7, 8)],  # lower corner
        *[(place, -1e6) for place in (9, 10, 11)],  # upper corner
        *[(place, value) for place in (15, 16, 17) for value in (-8.001, 7.9)],  # lowest log gains
        *[(place, value) for place in (18, 19, 20) for value in (-7.9, 8.001)],  # highest log gains
        *[(place, value) for place in range(4, 24) for value in (np.nan, np.inf, -np.inf)],
    ],
)
def test_a_number_out_of_the_range_of_the_specification_is_refused(place, value):
    section = encode_exposure(random_map(3, 2))
    numbers = list(struct.unpack_from(HEADER_FORMAT, section.data))
    assert struct.pack(HEADER_FORMAT, *numbers) == section.data[:84]
    numbers[place] = value
    data = struct.pack(HEADER_FORMAT, *numbers) + section.data[84:]

    with pytest.raises(HyrfFormatError, match="damaged"):
        decode_exposure(section.codec, memoryview(data), len(data))


@pytest.mark.parametrize("count", [65, 255])
def test_more_centers_than_the_specification_allows_are_refused(count):
    section = encode_exposure(random_map(3, 0))
    data = bytes([count]) + section.data[1:] + bytes(12 * count)

    with pytest.raises(HyrfFormatError, match="64"):
        decode_exposure(section.codec, memoryview(data), len(data))


@given(st.integers(0, MAX_CENTERS), st.binary(min_size=12 * MAX_CENTERS, max_size=12 * MAX_CENTERS))
def test_all_center_codes_round_trip(count, centers):
    head = encode_exposure(random_map(5, 0)).data[1:84]
    data = bytes([count]) + head + centers[: 12 * count]

    assert encode_exposure(decode_exposure(CODEC_EXPOSURE, memoryview(data), len(data))).data == data


def test_another_codec_is_refused():
    section = encode_exposure(random_map(0, 3))
    with pytest.raises(HyrfFormatError, match="update hyrfpack"):
        decode_exposure(1, memoryview(section.data), section.raw_length)


@pytest.mark.parametrize(("profile", "plain_minor"), [("raw", 0), ("paper", 0), ("compact", 1)])
def test_a_file_stores_the_map_and_has_version_1_2_only_with_a_map(profile, plain_minor):
    model = small_model(ball_points(50)[0])
    plain = encode(model, profile)
    model.exposure = random_map(7, 20)
    data = encode(model, profile)

    assert maps_equal(decode_model(data).exposure, model.exposure)
    assert decode_model(plain).exposure is None
    assert read_container(plain).version == (1, plain_minor) and read_container(data).version == (1, 2)
    assert list(read_container(data).entries)[:2] == ["META", "EXPO"]
    assert len(data) == len(plain) + 40 + (84 + 12 * 20 + 7) // 8 * 8  # an entry of the table, and the padded section


def test_readers_without_exposure_maps_read_the_rest():
    model = small_model(ball_points(50)[0])
    model.exposure = random_map(7, 20)
    container = read_container(encode_model(model))
    entries = container.entries
    assert [tag for tag, entry in entries.items() if not entry.required] == [EXPOSURE]
    read_container(encode_model(model), known=[tag for tag in entries if tag != EXPOSURE])


def test_the_error_for_a_damaged_map_contains_file_and_section():
    model = small_model(ball_points(50)[0])
    model.exposure = random_map(7, 20)
    container = read_container(encode_model(model))
    sections = [container[tag] for tag in container.entries]
    broken = [
        dataclasses.replace(part, data=b"\0" * len(part.data)) if part.type == EXPOSURE else part for part in sections
    ]
    with pytest.raises(HyrfFormatError, match="scene.hyrf: section 'EXPO'"):
        decode_model(write_container(broken, minor=MINOR_VERSION), name="scene.hyrf")

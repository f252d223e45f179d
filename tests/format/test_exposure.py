from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from exposures import random_map
from hypothesis import given
from hypothesis import strategies as st
from scenes import ball_points, small_model

from hyrfpack.errors import HyrfFormatError
from hyrfpack.format.codec import decode_model, encode_model
from hyrfpack.format.container import MINOR, read_container, write_container
from hyrfpack.format.exposure import CODEC_EXPOSURE, decode_exposure, exposure_section
from hyrfpack.format.sections import EXPOSURE
from hyrfpack.model.exposure import MAX_CENTERS, ExposureMap

SEEDS = st.integers(0, 2**32 - 1)


def same(one: ExposureMap, other: ExposureMap) -> bool:
    return all(
        np.array_equal(getattr(one, field.name), getattr(other, field.name)) for field in dataclasses.fields(one)
    )


@given(SEEDS, st.integers(0, MAX_CENTERS))
def test_a_map_is_read_as_it_was_written(seed, centers):
    exposure = random_map(seed, centers)
    section = exposure_section(exposure)

    assert len(section.data) == section.raw_length == 84 + 12 * centers and not section.required
    assert same(decode_exposure(section.codec, memoryview(section.data), section.raw_length), exposure)


def stored(numbers: list[float], centers: bytes) -> bytes:
    """Bytes of the right length, with any numbers in them."""
    count = len(centers) // 12
    return bytes([count, 0, 0, 0]) + np.array(numbers, "<f4").tobytes() + centers[: 12 * count]


NUMBERS = st.lists(st.floats(width=32) | st.floats(-8, 8, width=32), min_size=20, max_size=20)


@given(st.binary(max_size=200) | st.builds(stored, NUMBERS, st.binary(max_size=800)))
def test_any_bytes_are_a_map_or_refused(data):
    try:
        exposure = decode_exposure(CODEC_EXPOSURE, memoryview(data), len(data))
    except HyrfFormatError:
        return
    gains = exposure.log_gains(np.zeros(3), np.array([0.0, 0.0, 1.0]))
    assert np.isfinite(gains).all() and np.abs(gains).max() <= 8


@pytest.mark.parametrize("change", [b"", b"\1", None])
def test_bytes_that_do_not_fit_are_refused(change):
    section = exposure_section(random_map(0, 3))
    data = section.data[:-1] if change is None else bytes(section.data) + change
    raw_length = len(data) + (change == b"")
    with pytest.raises(HyrfFormatError, match="damaged"):
        decode_exposure(CODEC_EXPOSURE, memoryview(data), raw_length)


def test_another_codec_is_refused():
    section = exposure_section(random_map(0, 3))
    with pytest.raises(HyrfFormatError, match="update hyrfpack"):
        decode_exposure(1, memoryview(section.data), section.raw_length)


@pytest.mark.parametrize("profile", ["raw", "paper"])
def test_a_file_keeps_the_map_of_its_model(profile):
    model = small_model(ball_points(50)[0])
    plain = encode_model(model, profile)
    model.exposure = random_map(7, 20)
    data = encode_model(model, profile)

    assert same(decode_model(data).exposure, model.exposure)
    assert decode_model(plain).exposure is None
    assert read_container(plain).version == (1, 0) and read_container(data).version == (1, 2)
    assert encode_model(decode_model(data), profile) == data or profile == "paper"


def test_readers_that_know_no_map_read_the_rest():
    model = small_model(ball_points(50)[0])
    model.exposure = random_map(7, 20)
    container = read_container(encode_model(model))
    entries = container.entries
    assert [tag for tag, entry in entries.items() if not entry.required] == [EXPOSURE]
    read_container(encode_model(model), known=[tag for tag in entries if tag != EXPOSURE])


def test_a_damaged_map_names_file_and_section():
    model = small_model(ball_points(50)[0])
    model.exposure = random_map(7, 20)
    container = read_container(encode_model(model))
    sections = [container[tag] for tag in container.entries]
    broken = [
        dataclasses.replace(part, data=b"\0" * len(part.data)) if part.type == EXPOSURE else part for part in sections
    ]
    with pytest.raises(HyrfFormatError, match="scene.hyrf: section 'EXPO'"):
        decode_model(write_container(broken, minor=MINOR), name="scene.hyrf")

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from layers import only_in_acceptance
from property_tests import examples
from token_streams import decode_integers_by_spec

from hyrfpack.parallel import has_numba
from hyrfpack.quant import DamagedDataError, decode_integers, encode_integers

CODER_IMPLEMENTATIONS = ["numpy", pytest.param("cpu", marks=pytest.mark.skipif(not has_numba(), reason="no numba"))]
INTEGER_DTYPES = [np.int8, np.uint8, np.int16, np.uint16, np.int32, np.uint32, np.int64, np.uint64]

_rng = np.random.default_rng(0)
HARD_CASES = {
    "one": (np.array([0]), False),
    "one large": (np.array([2**56 - 1]), False),
    "largest and smallest": (np.array([2**55 - 1, 1 - 2**55, 0]), True),
    "around every power of two": (np.unique(np.add.outer(1 << np.arange(2, 56), [-1, 0, 1])).clip(0, 2**56 - 1), False),
    "signed powers of two": (np.concatenate([sign << np.arange(55) for sign in (1, -1)]), True),
    "laplace": (np.rint(_rng.laplace(scale=40, size=20_000)).astype(np.int64), True),
    "Morton gaps": (_rng.geometric(1e-6, 5000), False),
    "constant": (np.full(3000, 1000), False),
    "7-bit weights": (np.clip(_rng.normal(64, 20, 5000), 0, 127).astype(np.uint8), False),
    "huge outlier": (np.append(np.zeros(4000, np.int64), -(2**54)), True),
}


@pytest.mark.parametrize("implementation", CODER_IMPLEMENTATIONS)
@pytest.mark.parametrize("name", HARD_CASES)
def test_integers_round_trip(name: str, implementation: str) -> None:
    values, signed = HARD_CASES[name]

    data = encode_integers(values, signed=signed, implementation=implementation)

    decoded = decode_integers(data, len(values), signed=signed, implementation=implementation)
    np.testing.assert_array_equal(decoded, values)
    assert decode_integers_by_spec(data, [0] * len(values), signed) == values.tolist()


@pytest.mark.skipif(not has_numba(), reason="no numba")
@pytest.mark.parametrize("name", HARD_CASES)
def test_numpy_and_numba_encode_to_the_same_bytes(name: str) -> None:
    values, signed = HARD_CASES[name]

    written = {encode_integers(values, signed=signed, implementation=each) for each in ("numpy", "cpu", "auto")}

    assert len(written) == 1


@pytest.mark.parametrize("implementation", CODER_IMPLEMENTATIONS)
@given(data=st.data())
@examples(150)
def test_any_integers_of_any_dtype_round_trip(implementation: str, data: st.DataObject) -> None:
    dtype, signed = data.draw(st.sampled_from(INTEGER_DTYPES)), data.draw(st.booleans())
    largest = min(np.iinfo(dtype).max, 2**55 - 1 if signed else 2**56 - 1)
    smallest = max(np.iinfo(dtype).min, 1 - 2**55) if signed else 0
    value = st.one_of(st.integers(max(smallest, -3), 3), st.integers(smallest, largest))
    values = np.array(data.draw(st.lists(value, max_size=200)), dtype)
    contexts = data.draw(st.none() | st.integers(1, 256).map(lambda n: _periodic_contexts(len(values), n)))

    coded = encode_integers(values, contexts, signed=signed, implementation=implementation)

    decoded = decode_integers(coded, len(values), contexts, signed=signed, implementation=implementation)
    assert decoded.tolist() == values.tolist()
    listed = [0] * len(values) if contexts is None else contexts.tolist()
    assert decode_integers_by_spec(coded, listed, signed) == values.tolist()


def _periodic_contexts(count: int, number: int) -> np.ndarray:
    return (np.arange(count) * 7 % number).astype(np.uint8)


def test_more_values_than_a_block_round_trip() -> None:
    values = np.rint(np.random.default_rng(1).laplace(scale=1000, size=200_003)).astype(np.int64)

    data = encode_integers(values, signed=True, implementation="numpy")

    assert encode_integers(values, signed=True) == data
    for implementation in ("numpy", "auto"):
        decoded = decode_integers(data, len(values), signed=True, implementation=implementation)
        np.testing.assert_array_equal(decoded, values)


@pytest.mark.parametrize("implementation", CODER_IMPLEMENTATIONS)
@pytest.mark.parametrize(
    ("values", "signed", "dtype"),
    [
        ([], False, np.uint32),
        ([], True, np.int32),
        ([2**32 - 1, 0], False, np.uint32),
        ([2**32, 0], False, np.uint64),
        ([2**32, 2**32], False, np.uint64),
        ([2**31 - 1, -(2**31)], True, np.int32),
        ([2**31, 0], True, np.int64),
        ([-(2**31) - 1, 0], True, np.int64),
    ],
)
def test_decoded_dtype_is_the_narrowest_that_holds_the_values(
    values: list[int], signed: bool, dtype: type, implementation: str
) -> None:
    data = encode_integers(np.array(values, np.int64), signed=signed)

    decoded = decode_integers(data, len(values), signed=signed, implementation=implementation)

    assert decoded.dtype == dtype
    assert decoded.tolist() == values


@pytest.mark.parametrize("scale", [0.3, 1, 3, 10, 40])
def test_laplace_values_take_at_most_half_a_percent_more_than_their_entropy(scale: float) -> None:
    values = np.rint(np.random.default_rng(2).laplace(scale=scale, size=400_000)).astype(np.int64)

    data = encode_integers(values, signed=True)

    decay = np.exp(-1 / scale)  # P(k) = P(1) decay^(k - 1) for k >= 1, and P(0) = 1 - e^(-1 / (2 scale))
    outside = np.exp(-1 / (2 * scale)) / 2 * (1 - decay) * decay ** np.arange(4000)
    shares = np.concatenate(([1 - np.exp(-1 / (2 * scale))], outside, outside))
    shares = shares[shares > 0]
    entropy = -(shares * np.log2(shares)).sum()
    assert 8 * len(data) / len(values) < 1.005 * entropy + 0.002


def test_empty_array_takes_no_bytes_and_equal_values_take_three() -> None:
    assert encode_integers(np.zeros(0, np.int64)) == b""
    assert len(encode_integers(np.full(10**6, -7), signed=True)) == 3


@pytest.mark.acceptance
def test_decoding_takes_little_memory_beyond_its_output_and_input() -> None:
    values = np.rint(np.random.default_rng(3).laplace(scale=2, size=2_000_000)).astype(np.int32)
    contexts = np.zeros(len(values), np.uint8)
    contexts[::3] = 1
    data = encode_integers(values, contexts, signed=True)

    for implementation in ("numpy", "auto"):
        decode_integers(data, len(values), contexts, signed=True, implementation=implementation)
        tracemalloc.start()
        decode_integers(data, len(values), contexts, signed=True, implementation=implementation)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 4 * len(values) + len(values) + 3 * len(data) + 2**22


@pytest.mark.parametrize("implementation", CODER_IMPLEMENTATIONS)
@pytest.mark.parametrize(
    "name",
    only_in_acceptance(["one large", "laplace", "constant", "huge outlier", "signed powers of two"], ["laplace"]),
)
def test_truncation_and_trailing_bytes_are_refused(name: str, implementation: str) -> None:
    values, signed = HARD_CASES[name]
    data = encode_integers(values, signed=signed)

    for length in np.unique(np.append(np.arange(min(len(data), 40)), np.linspace(0, len(data) - 1, 20).astype(int))):
        with pytest.raises(DamagedDataError):
            decode_integers(data[:length], len(values), signed=signed, implementation=implementation)
    with pytest.raises(DamagedDataError):
        decode_integers(data + b"\0", len(values), signed=signed, implementation=implementation)
    with pytest.raises(DamagedDataError):
        decode_integers(data, 0, signed=signed, implementation=implementation)


@pytest.mark.parametrize("implementation", CODER_IMPLEMENTATIONS)
@given(data=st.data())
@examples(25)
def test_damaged_stream_is_refused_or_decodes_to_the_requested_count(implementation: str, data: st.DataObject) -> None:
    values, signed = HARD_CASES["Morton gaps"]
    damaged = bytearray(ENCODED_MORTON_GAPS)
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] ^= data.draw(st.integers(1, 255))

    try:
        decoded = decode_integers(bytes(damaged), len(values), signed=signed, implementation=implementation)
    except DamagedDataError:
        return
    assert decoded.shape == values.shape


ENCODED_MORTON_GAPS = encode_integers(HARD_CASES["Morton gaps"][0])


@pytest.mark.parametrize(
    ("values", "signed", "claim"),
    [
        (np.zeros(3), False, r"\(M,\) integers"),
        (np.zeros((2, 2), int), False, r"\(M,\) integers"),
        (np.array([True]), False, r"\(M,\) integers"),
        (np.array([-1]), False, "0 to 2"),
        (np.array([2**56]), False, "0 to 2"),
        (np.array([2**63], np.uint64), False, "0 to 2"),
        (np.array([2**55]), True, "between"),
        (np.array([-(2**55)]), True, "between"),
        (np.array([-(2**63)]), True, "between"),
    ],
)
def test_encode_refuses_other_dtypes_shapes_and_ranges(values: np.ndarray, signed: bool, claim: str) -> None:
    with pytest.raises(ValueError, match=claim):
        encode_integers(values, signed=signed)


def test_negative_counts_are_refused() -> None:
    with pytest.raises(ValueError, match="0 or more"):
        decode_integers(b"", -1)

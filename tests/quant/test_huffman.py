from __future__ import annotations

import sys

import numpy as np
import pytest
from dahuffman import HuffmanCodec
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples

from hyrfpack.quant.errors import DamagedDataError
from hyrfpack.quant.huffman import END_MARK, HuffmanCode, HuffmanStream, chunk_length, huffman_decode, huffman_encode


def fibonacci_numbers(n: int) -> np.ndarray:
    numbers = [1, 1]
    while len(numbers) < n:
        numbers.append(numbers[-1] + numbers[-2])
    return np.array(numbers)


def code_values(code: HuffmanCode) -> np.ndarray:
    """Return the (n,) codes as numbers of `lengths` bits, as in dahuffman's code table."""
    return code.left_aligned_codes >> (np.uint64(64) - code.lengths.astype(np.uint64))


def laplace_symbols(count: int, scale: float = 6.0, dtype: type = np.uint8) -> np.ndarray:
    values = np.random.default_rng(count).laplace(np.iinfo(dtype).max / 2, scale, count)
    return np.clip(np.rint(values), 0, np.iinfo(dtype).max).astype(dtype)


HARD_CASES = {
    "one symbol": np.array([7], np.uint8),
    "one Gaussian": np.array([3, 200, 3, 0, 17], np.uint8),
    "constant channel": np.full(5000, 255, np.uint8),
    "two values": np.tile(np.array([0, 255], np.uint8), 777),
    "all symbols once": np.arange(256, dtype=np.uint8),
    "one chunk exactly": laplace_symbols(1024),
    "one symbol in the last chunk": laplace_symbols(2049),
    "odd count": laplace_symbols(4095),
    "more than 1024 chunks of the least length": laplace_symbols(1024 * 1024 + 3),
    "skewed": np.minimum(np.random.default_rng(1).geometric(0.6, 50_000), 255).astype(np.uint8),
    "codes of 24 bits": np.repeat(np.arange(25), fibonacci_numbers(25)).astype(np.uint8),
    "uint16": laplace_symbols(20_000, 300.0, np.uint16),
    "uint16 constant": np.full(3000, 65535, np.uint16),
    "uint16 all symbols": np.random.default_rng(2).permutation(65536).astype(np.uint16),
    "uint16 many symbols": np.random.default_rng(2).permutation(65536)[:4096].astype(np.uint16),
    "uint16 odd": laplace_symbols(1025, 3.0, np.uint16),
    "not contiguous": laplace_symbols(6001)[::2],
}


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.acceptance] if name == "uint16 all symbols" else []) for name in HARD_CASES],
)
def test_payload_is_byte_identical_to_dahuffman_and_decodes(name: str) -> None:
    symbols = HARD_CASES[name]

    stream = huffman_encode(symbols)

    listed = symbols.tolist()
    assert stream.payload == HuffmanCodec.from_data(listed).encode(listed)
    decoded = huffman_decode(HuffmanStream.from_bytes(stream.to_bytes()))
    assert decoded.dtype == symbols.dtype
    np.testing.assert_array_equal(decoded, symbols)


@given(st.lists(st.integers(0, 255), min_size=1, max_size=300) | st.lists(st.integers(0, 3), min_size=1, max_size=5000))
@examples(150)
def test_any_bytes_round_trip_and_match_dahuffman(listed: list[int]) -> None:
    symbols = np.array(listed, np.uint8)

    stream = huffman_encode(symbols)

    assert stream.payload == HuffmanCodec.from_data(listed).encode(listed)
    np.testing.assert_array_equal(huffman_decode(HuffmanStream.from_bytes(stream.to_bytes())), symbols)


@given(st.lists(st.integers(0, 65535), min_size=1, max_size=300))
@examples(50)
def test_any_16_bit_symbols_round_trip_and_match_dahuffman(listed: list[int]) -> None:
    symbols = np.array(listed, np.uint16)

    stream = huffman_encode(symbols)

    assert stream.payload == HuffmanCodec.from_data(listed).encode(listed)
    np.testing.assert_array_equal(huffman_decode(HuffmanStream.from_bytes(stream.to_bytes())), symbols)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_codes_of_up_to_52_bits_match_dahuffman(dtype: type) -> None:
    counts = fibonacci_numbers(52)
    code = HuffmanCode.from_frequencies(counts)
    symbols = np.random.default_rng(0).permutation(np.tile(np.arange(52), 100)).astype(dtype)

    stream = huffman_encode(symbols, code)

    assert code.lengths.max() == 52
    oracle = HuffmanCodec.from_frequencies(dict(enumerate(counts.tolist())))
    assert stream.payload == oracle.encode(symbols.tolist())
    np.testing.assert_array_equal(huffman_decode(HuffmanStream.from_bytes(stream.to_bytes())), symbols)


def test_code_table_equals_that_of_dahuffman() -> None:
    counts = np.bincount(laplace_symbols(10_000))

    code = HuffmanCode.from_frequencies(counts)

    frequencies = {symbol: int(count) for symbol, count in enumerate(counts) if count}
    expected = {s: c for s, c in HuffmanCodec.from_frequencies(frequencies).get_code_table().items()}
    ours = zip(code.symbols.tolist(), code.lengths.tolist(), code_values(code).tolist(), strict=True)
    ours = {symbol: (length, value) for symbol, length, value in ours}
    assert ours.pop(END_MARK) in expected.values()
    assert ours == {symbol: expected[symbol] for symbol in ours}
    assert len(expected) == len(ours) + 1


def test_codes_follow_from_their_lengths_as_specified() -> None:
    code = HuffmanCode.from_frequencies(np.bincount(laplace_symbols(3000)))

    fraction, denominator = 0, 1 << 64
    for length, value in zip(code.lengths.tolist(), code_values(code).tolist(), strict=True):
        assert value == fraction >> (64 - length)
        fraction += denominator >> length
    assert fraction == denominator


def test_histogram_that_needs_codes_longer_than_57_bits_is_refused() -> None:
    with pytest.raises(ValueError, match="57 bits"):
        HuffmanCode.from_frequencies(fibonacci_numbers(70))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_empty_array_is_stored_as_a_header_alone(dtype: type) -> None:
    stream = huffman_encode(np.zeros(0, dtype))

    data = stream.to_bytes()

    assert stream.payload == b""
    assert len(data) == 26
    decoded = huffman_decode(HuffmanStream.from_bytes(data))
    assert decoded.shape == (0,)
    assert decoded.dtype == dtype


def test_decoding_does_not_import_dahuffman(monkeypatch: pytest.MonkeyPatch) -> None:
    symbols = laplace_symbols(3000)
    data = huffman_encode(symbols).to_bytes()
    monkeypatch.setitem(sys.modules, "dahuffman", None)

    np.testing.assert_array_equal(huffman_decode(HuffmanStream.from_bytes(data)), symbols)


def test_header_code_table_and_chunk_sizes_take_the_documented_bytes() -> None:
    symbols = laplace_symbols(200_000)

    stream = huffman_encode(symbols)

    leaves, chunks = len(stream.code.symbols), -(-200_000 // chunk_length(200_000))
    assert len(stream.to_bytes()) - len(stream.payload) == 26 + leaves + (leaves - 1) + 2 * chunks


def test_chunk_sizes_beyond_16_bits_round_trip() -> None:
    code = HuffmanCode.from_frequencies(fibonacci_numbers(52))
    symbols = np.zeros(1_500_000, np.uint8)  # codes of 52 bits, 1466 symbols a chunk

    stream = HuffmanStream.from_bytes(huffman_encode(symbols, code).to_bytes())

    assert stream.chunk_bits[0] == chunk_length(1_500_000) * 52 > 0xFFFF
    np.testing.assert_array_equal(huffman_decode(stream), symbols)


@pytest.mark.parametrize("symbols", [np.zeros(3, np.int64), np.zeros((2, 2), np.uint8), np.zeros(3, np.float32)])
def test_encode_refuses_other_dtypes_and_shapes(symbols: np.ndarray) -> None:
    with pytest.raises(ValueError, match="uint8 or uint16"):
        huffman_encode(symbols)


def test_encode_refuses_symbols_without_a_code() -> None:
    code = HuffmanCode.from_frequencies(np.array([5, 0, 3]))

    with pytest.raises(ValueError, match="no code for symbol 1"):
        huffman_encode(np.array([0, 1, 2], np.uint8), code)


@pytest.mark.parametrize("name", ["one Gaussian", "constant channel", "uint16 odd"])
def test_every_truncation_and_a_trailing_byte_are_refused(name: str) -> None:
    data = huffman_encode(HARD_CASES[name]).to_bytes()

    for length in range(len(data)):
        with pytest.raises(DamagedDataError):
            HuffmanStream.from_bytes(data[:length])
    with pytest.raises(DamagedDataError):
        HuffmanStream.from_bytes(data + b"\0")


@given(st.data())
@examples(100)
def test_damaged_stream_is_refused_or_decodes_to_the_declared_count(data: st.DataObject) -> None:
    damaged = bytearray(huffman_encode(HARD_CASES["odd count"]).to_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] ^= data.draw(st.integers(1, 255))

    try:
        stream = HuffmanStream.from_bytes(bytes(damaged))
        decoded = huffman_decode(stream)
    except DamagedDataError:
        return
    assert len(decoded) == stream.count
    assert stream.count <= 8 * len(damaged)


@given(st.binary(max_size=200))
def test_random_bytes_are_refused_or_declare_at_most_one_symbol_per_bit(data: bytes) -> None:
    try:
        stream = HuffmanStream.from_bytes(data)
    except DamagedDataError:
        return
    assert stream.count <= 8 * len(data)


def stream_with_changed_fields(**changes: object) -> bytes:
    stream = huffman_encode(np.array([0, 1, 1, 2, 2, 2, 2], np.uint8))
    return HuffmanStream(**{**vars(stream), **changes}).to_bytes()


@pytest.mark.parametrize(
    ("lengths", "symbols", "claim"),
    [
        ([1, 2, 3], [0, 1, END_MARK], "no complete code"),
        ([1, 1, 1], [0, 1, END_MARK], "no complete code"),
        ([2, 1, 2], [0, 1, END_MARK], "order of their codes"),
        ([1, 2, 2], [0, 0, END_MARK], "two codes"),
        ([0, 1, 1], [0, 1, END_MARK], "1 to 57"),
        ([1, 1, 58], [0, 1, END_MARK], "1 to 57"),
        ([1], [END_MARK], "1 to 57"),
        ([8] * 255 + [1, 1], [*range(256), END_MARK], "no complete code"),
    ],
)
def test_invalid_code_tables_are_refused(lengths: list[int], symbols: list[int], claim: str) -> None:
    code = HuffmanCode(np.array(symbols, np.int32), np.array(lengths, np.uint8))

    with pytest.raises(DamagedDataError, match=claim):
        HuffmanStream.from_bytes(stream_with_changed_fields(code=code))


def test_code_table_whose_sum_wraps_around_is_refused() -> None:
    # In units of the longest code the sum is 2^57 + 2^64; a 64-bit sum overflows and would look complete.
    lengths = [*[1] * 256, 1, 1]
    code = HuffmanCode(np.array([*range(257), END_MARK], np.int32), np.array(lengths, np.uint8))

    with pytest.raises(DamagedDataError, match="no complete code"):
        HuffmanStream.from_bytes(stream_with_changed_fields(code=code, dtype=np.dtype("u2")))


@pytest.mark.parametrize("count", [0, 10**3, 2**40, 2**63])
def test_forged_counts_are_refused(count: int) -> None:
    with pytest.raises(DamagedDataError):
        HuffmanStream.from_bytes(stream_with_changed_fields(count=count))


def test_count_that_does_not_fit_the_payload_is_refused_while_decoding() -> None:
    stream = HuffmanStream.from_bytes(stream_with_changed_fields(count=6))

    with pytest.raises(DamagedDataError, match="does not end where it should"):
        huffman_decode(stream)


def test_early_end_mark_is_refused() -> None:
    code = HuffmanCode.from_frequencies(np.array([9]))
    end_is_one = int(code_values(code)[code.symbols == END_MARK][0])
    stream = HuffmanStream(code, 8, np.dtype("u1"), np.array([8]), bytes([0b00000001 if end_is_one else 0b11111110]))

    with pytest.raises(DamagedDataError, match="does not end where it should"):
        huffman_decode(stream)


def test_chunk_sizes_that_do_not_add_up_are_refused() -> None:
    symbols = laplace_symbols(5000)
    stream = huffman_encode(symbols)
    shifted = stream.chunk_bits.copy()
    shifted[:2] += [1, -1]

    with pytest.raises(DamagedDataError, match="add up"):
        huffman_decode(HuffmanStream(**{**vars(stream), "chunk_bits": stream.chunk_bits + 8}))
    with pytest.raises(DamagedDataError, match="chunk"):
        huffman_decode(HuffmanStream(**{**vars(stream), "chunk_bits": shifted}))

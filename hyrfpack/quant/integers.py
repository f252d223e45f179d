"""Code integer arrays: a token for the magnitude of each value is coded by rANS, and lower bits are stored raw.

    v < 16     token v, no extra bits
    v < 128    n = floor(log2 v); token 4 n + (bits n - 1 and n - 2 of v); extra: the lowest n - 2 bits of v
    else       n = floor(log2 v); token 14 + 2 n + (bit n - 1 of v); extra: the lowest n - 1 bits of v

Signed values are mapped to unsigned ones first (zigzag): 0, -1, 1, -2, 2, ... become 0, 1, 2, 3, 4, ...
The bytes are the stream of the tokens (`rans`), followed by the extra bits of all values (`bits`).
"""

from __future__ import annotations

import numpy as np

from hyrfpack.quant.bits import BitReader, pack_bits
from hyrfpack.quant.rans import decode_tokens, encode_tokens, uses_numba

_VALUE_LIMIT = 1 << 56
_VALUES_PER_BLOCK = 1 << 16  # Temporary arrays of this size stay in the caches.


def _build_token_tables() -> tuple[np.ndarray, np.ndarray]:
    """Return the smallest value (uint64) and the number of extra bits (uint8) of each token."""
    exponents = np.append(np.repeat(np.arange(4, 7), 4), np.repeat(np.arange(7, 56), 2)).astype(np.int64)
    token_bits = np.where(exponents < 7, 2, 1)  # bits below the highest one that are part of the token
    leading = (1 << token_bits) + np.arange(len(exponents)) % (1 << token_bits)
    extra = exponents - token_bits
    return np.append(np.arange(16), leading << extra).astype(np.uint64), np.append(np.zeros(16), extra).astype(np.uint8)


MIN_VALUE_BY_TOKEN, EXTRA_BITS_BY_TOKEN = _build_token_tables()
"""Smallest value (uint64) and number of extra bits (uint8) of each of the 126 tokens."""

# All tokens of an alphabet of at most this size stand for values below 2^32.
_MAX_UINT32_ALPHABET = int(np.searchsorted(MIN_VALUE_BY_TOKEN, np.uint64(1 << 32)))
_TOKEN_BY_SMALL_VALUE = (
    np.searchsorted(MIN_VALUE_BY_TOKEN, np.arange(4096, dtype=np.uint64), side="right") - 1
).astype(np.uint8)


def encode_integers(
    values: np.ndarray, contexts: np.ndarray | None = None, *, signed: bool = False, implementation: str = "auto"
) -> bytes:
    """Encode an array of integers. Small values, and values that are similar within a context, take few bits.

    Args:
        values: (M,) of any integer dtype, 0 to 2^56 - 1, or with `signed` above -2^55 and below 2^55.
        contexts: (M,) uint8 class of each value, which the decoder must know; None means one class. Values of one class
            should have the same distribution. M and the contexts are not stored.
        signed: whether values may be negative; not stored.
        implementation: "numpy", "cpu" (Numba) or "auto"; the bytes are the same.

    Returns:
        The bytes; empty if there are no values.

    Raises:
        ValueError: a value is out of range, or the shape or dtype is wrong.

    Example:
        >>> data = encode_integers(np.array([0, -3, 1_000_000]), signed=True)
        >>> decode_integers(data, 3, signed=True).tolist()
        [0, -3, 1000000]
    """
    values = np.asarray(values)
    if values.ndim != 1 or values.dtype.kind not in "iu":
        raise ValueError(f"values must be (M,) integers, got {values.shape} {values.dtype}")
    limit = _VALUE_LIMIT // 2 if signed else _VALUE_LIMIT
    if len(values) and (int(values.max()) >= limit or int(values.min()) <= (-limit if signed else -1)):
        allowed = "between -2^55 and 2^55" if signed else "0 to 2^56 - 1"
        raise ValueError(f"values must be {allowed}, got {values.min()} to {values.max()}")
    tokens, extra = (_values_to_tokens_compiled if uses_numba(implementation) else _values_to_tokens)(values, signed)
    return encode_tokens(tokens, contexts, implementation) + extra


def decode_integers(
    data: bytes | memoryview,
    count: int,
    contexts: np.ndarray | None = None,
    *,
    signed: bool = False,
    implementation: str = "auto",
) -> np.ndarray:
    """Decode integers that `encode_integers` encoded.

    Args:
        data: the bytes, no more and no fewer.
        count: M, which the caller must bound, because equal values may take no bytes.
        contexts: (M,) uint8 as given to the encoder.
        signed: as given to the encoder.
        implementation: "numpy", "cpu" (Numba) or "auto"; the values are the same.

    Returns:
        (M,) uint32, or int32 if signed. If the largest token of the stream stands for (unsigned) values of 2^32 or
        more: uint64, or int64 if signed.

    Raises:
        DamagedDataError: the bytes are truncated, damaged or inconsistent.
        ValueError: the count is negative, or contexts have a wrong shape or dtype.
    """
    data = memoryview(data)
    tokens, size, alphabet = decode_tokens(data, count, contexts, implementation)
    reader = BitReader(data[size:], _count_extra_bits(tokens))
    wide = alphabet > _MAX_UINT32_ALPHABET
    values = np.empty(count, np.uint64 if wide else np.uint32)
    (_tokens_to_values_compiled if uses_numba(implementation) else _tokens_to_values)(tokens, reader, signed, values)
    return values.view(f"i{values.itemsize}") if signed else values


def _count_extra_bits(tokens: np.ndarray) -> int:
    """Return the total number of extra bits of the tokens."""
    blocks = (tokens[first : first + _VALUES_PER_BLOCK] for first in range(0, len(tokens), _VALUES_PER_BLOCK))
    return sum(int(EXTRA_BITS_BY_TOKEN.take(block).sum(dtype=np.int64)) for block in blocks)


def _values_to_tokens(values: np.ndarray, signed: bool) -> tuple[np.ndarray, bytes]:
    """Return the tokens (M,) uint8 and the packed extra bits of values."""
    tokens = np.empty(len(values), np.uint8)
    extras, lengths = [np.zeros(0, np.uint64)], [np.zeros(0, np.uint8)]
    for first in range(0, len(values), _VALUES_PER_BLOCK):
        block = values[first : first + _VALUES_PER_BLOCK].astype(np.int64)
        if signed:
            block = block << 1 ^ block >> 63
        token = _TOKEN_BY_SMALL_VALUE.take(block, mode="clip")
        large = np.flatnonzero(block >= len(_TOKEN_BY_SMALL_VALUE))
        token[large] = np.searchsorted(MIN_VALUE_BY_TOKEN, block[large].view(np.uint64), side="right") - 1
        length = EXTRA_BITS_BY_TOKEN.take(token)
        extended = np.flatnonzero(length)
        tokens[first : first + _VALUES_PER_BLOCK] = token
        extras.append(block[extended].view(np.uint64))
        lengths.append(length[extended])
    return tokens, pack_bits(np.concatenate(extras), np.concatenate(lengths))


def _tokens_to_values(tokens: np.ndarray, reader: BitReader, signed: bool, values: np.ndarray) -> None:
    """Write the values of tokens and extra bits into `values` (M,) uint32 or uint64."""
    for first in range(0, len(tokens), _VALUES_PER_BLOCK):
        token = tokens[first : first + _VALUES_PER_BLOCK]
        block, length = MIN_VALUE_BY_TOKEN.take(token), EXTRA_BITS_BY_TOKEN.take(token)
        extended = np.flatnonzero(length)
        block[extended] += reader.read(length[extended])
        if signed:
            block = block >> np.uint64(1) ^ np.uint64(0) - (block & np.uint64(1))
        # Truncation keeps negative numbers: the lower half of an int64 in two's complement is the same number in int32.
        values[first : first + _VALUES_PER_BLOCK] = block.astype(values.dtype)


def _values_to_tokens_compiled(values: np.ndarray, signed: bool) -> tuple[np.ndarray, bytes]:
    """Return the same as `_values_to_tokens`, by Numba."""
    from hyrfpack.quant import integers_kernels

    tokens, extra = np.empty(len(values), np.uint8), bytearray()
    words, position = np.zeros(_VALUES_PER_BLOCK + 2, np.uint64), 0
    for first in range(0, len(values), _VALUES_PER_BLOCK):
        block = values[first : first + _VALUES_PER_BLOCK].astype(np.int64)
        token = tokens[first : first + _VALUES_PER_BLOCK]
        tables = _TOKEN_BY_SMALL_VALUE, EXTRA_BITS_BY_TOKEN
        end = int(integers_kernels.values_to_tokens(block, signed, *tables, token, words, position))
        extra += words[: end // 64].astype("<u8").tobytes()
        words[0] = words[end // 64]
        words[1 : end // 64 + 2] = 0
        position = end % 64
    return tokens, bytes(extra) + words[:1].astype("<u8").tobytes()[: (position + 7) // 8]


def _tokens_to_values_compiled(tokens: np.ndarray, reader: BitReader, signed: bool, values: np.ndarray) -> None:
    """Write the same values as `_tokens_to_values`, by Numba."""
    from hyrfpack.quant import integers_kernels

    integers_kernels.tokens_to_values(
        tokens, reader.read_all_words(), signed, MIN_VALUE_BY_TOKEN, EXTRA_BITS_BY_TOKEN, values
    )

"""Arrays of integers to few bytes: a token for the size of each, by rANS, and the lower bits as they are.

    v < 16     token v, no extra bits
    v < 128    n = floor(log2 v); token 4 n + (bits n - 1 and n - 2 of v); extra: the lowest n - 2 bits of v
    else       n = floor(log2 v); token 14 + 2 n + (bit n - 1 of v); extra: the lowest n - 1 bits of v

Signed values are folded first: 0, -1, 1, -2, 2, ... become 0, 1, 2, 3, 4, ...
The bytes are the stream of the tokens (`rans`) and after it the extra bits of all values (`bits`).
"""

from __future__ import annotations

import numpy as np

from hyrfpack.quant.bits import BitReader, pack_bits
from hyrfpack.quant.rans import decode_tokens, encode_tokens, uses_numba

_LIMIT = 1 << 56
_BLOCK = 1 << 16  # values at once: few enough that temporaries stay in the caches


def _tokens() -> tuple[np.ndarray, np.ndarray]:
    """The least value (uint64) and the number of extra bits (uint8) of each token."""
    exponents = np.append(np.repeat(np.arange(4, 7), 4), np.repeat(np.arange(7, 56), 2)).astype(np.int64)
    kept = np.where(exponents < 7, 2, 1)  # bits below the highest that are part of the token
    leading = (1 << kept) + np.arange(len(exponents)) % (1 << kept)
    extra = exponents - kept
    return np.append(np.arange(16), leading << extra).astype(np.uint64), np.append(np.zeros(16), extra).astype(np.uint8)


LEAST_VALUE, EXTRA_BITS = _tokens()
"""Of each of the 126 tokens: the smallest value, uint64, and the number of extra bits, uint8."""

_NARROW_ALPHABET = int(np.searchsorted(LEAST_VALUE, np.uint64(1 << 32)))  # its tokens stand for values below 2^32
_TOKEN_OF = (np.searchsorted(LEAST_VALUE, np.arange(4096, dtype=np.uint64), side="right") - 1).astype(np.uint8)


def encode_integers(
    values: np.ndarray, contexts: np.ndarray | None = None, *, signed: bool = False, implementation: str = "auto"
) -> bytes:
    """Code an array of integers. Small values, and values that are alike within a context, take few bits.

    Args:
        values: (M,) of any integer dtype, 0 to 2^56 - 1, or with `signed` above -2^55 and below 2^55.
        contexts: (M,) uint8 class of each value, which the decoder knows beforehand; None means one class. Values in
            one class should be distributed alike. M and the contexts are not stored.
        signed: whether values may be negative; not stored.
        implementation: "numpy", "cpu" (Numba) or "auto"; the bytes are the same.

    Returns:
        The bytes; none for no values.

    Raises:
        ValueError: a value out of range, or another shape or dtype.

    Example:
        >>> data = encode_integers(np.array([0, -3, 1_000_000]), signed=True)
        >>> decode_integers(data, 3, signed=True).tolist()
        [0, -3, 1000000]
    """
    values = np.asarray(values)
    if values.ndim != 1 or values.dtype.kind not in "iu":
        raise ValueError(f"values must be (M,) integers, got {values.shape} {values.dtype}")
    limit = _LIMIT // 2 if signed else _LIMIT
    if len(values) and (int(values.max()) >= limit or int(values.min()) <= (-limit if signed else -1)):
        allowed = "between -2^55 and 2^55" if signed else "0 to 2^56 - 1"
        raise ValueError(f"values must be {allowed}, got {values.min()} to {values.max()}")
    tokens, extra = (_split_compiled if uses_numba(implementation) else _split)(values, signed)
    return encode_tokens(tokens, contexts, implementation) + extra


def decode_integers(
    data: bytes | memoryview,
    count: int,
    contexts: np.ndarray | None = None,
    *,
    signed: bool = False,
    implementation: str = "auto",
) -> np.ndarray:
    """Decode what `encode_integers` wrote.

    Args:
        data: the bytes, no more and no fewer.
        count: M, which the caller has bounded: equal values may take no bytes.
        contexts: (M,) uint8 as given to the encoder.
        signed: as given to the encoder.
        implementation: "numpy", "cpu" (Numba) or "auto"; the values are the same.

    Returns:
        (M,) uint32, or int32 if signed. If the largest token that the stream announces stands for (folded) values of
        2^32 or more: uint64, or int64 if signed.

    Raises:
        DamagedDataError: the bytes are truncated, damaged or contradict themselves.
        ValueError: a negative count, or contexts of another shape or dtype.
    """
    data = memoryview(data)
    tokens, size, alphabet = decode_tokens(data, count, contexts, implementation)
    reader = BitReader(data[size:], _bits_after(tokens))
    wide = alphabet > _NARROW_ALPHABET
    values = np.empty(count, np.uint64 if wide else np.uint32)
    (_join_compiled if uses_numba(implementation) else _join)(tokens, reader, signed, values)
    return values.view(f"i{values.itemsize}") if signed else values


def _bits_after(tokens: np.ndarray) -> int:
    """How many extra bits these tokens have."""
    blocks = (tokens[first : first + _BLOCK] for first in range(0, len(tokens), _BLOCK))
    return sum(int(EXTRA_BITS.take(block).sum(dtype=np.int64)) for block in blocks)


def _split(values: np.ndarray, signed: bool) -> tuple[np.ndarray, bytes]:
    """Tokens (M,) uint8 and the packed extra bits."""
    tokens = np.empty(len(values), np.uint8)
    extras, lengths = [np.zeros(0, np.uint64)], [np.zeros(0, np.uint8)]
    for first in range(0, len(values), _BLOCK):
        part = values[first : first + _BLOCK].astype(np.int64)
        if signed:
            part = part << 1 ^ part >> 63
        token = _TOKEN_OF.take(part, mode="clip")
        large = np.flatnonzero(part >= len(_TOKEN_OF))
        token[large] = np.searchsorted(LEAST_VALUE, part[large].view(np.uint64), side="right") - 1
        length = EXTRA_BITS.take(token)
        extended = np.flatnonzero(length)
        tokens[first : first + _BLOCK] = token
        extras.append(part[extended].view(np.uint64))
        lengths.append(length[extended])
    return tokens, pack_bits(np.concatenate(extras), np.concatenate(lengths))


def _join(tokens: np.ndarray, reader: BitReader, signed: bool, values: np.ndarray) -> None:
    """The inverse of `_split`, into `values` (M,) uint32 or uint64."""
    for first in range(0, len(tokens), _BLOCK):
        token = tokens[first : first + _BLOCK]
        part, length = LEAST_VALUE.take(token), EXTRA_BITS.take(token)
        extended = np.flatnonzero(length)
        part[extended] += reader.read(length[extended])
        if signed:
            part = part >> np.uint64(1) ^ np.uint64(0) - (part & np.uint64(1))
        values[first : first + _BLOCK] = part.astype(values.dtype)  # the lower half of a negative number is that number


def _split_compiled(values: np.ndarray, signed: bool) -> tuple[np.ndarray, bytes]:
    from hyrfpack.quant import integers_kernels

    tokens, extra = np.empty(len(values), np.uint8), bytearray()
    words, place = np.zeros(_BLOCK + 2, np.uint64), 0
    for first in range(0, len(values), _BLOCK):
        part = values[first : first + _BLOCK].astype(np.int64)
        token = tokens[first : first + _BLOCK]
        end = int(integers_kernels.split(part, signed, _TOKEN_OF, EXTRA_BITS, token, words, place))
        extra += words[: end // 64].astype("<u8").tobytes()
        words[0] = words[end // 64]
        words[1 : end // 64 + 2] = 0
        place = end % 64
    return tokens, bytes(extra) + words[:1].astype("<u8").tobytes()[: (place + 7) // 8]


def _join_compiled(tokens: np.ndarray, reader: BitReader, signed: bool, values: np.ndarray) -> None:
    from hyrfpack.quant import integers_kernels

    integers_kernels.join(tokens, reader.words(), signed, LEAST_VALUE, EXTRA_BITS, values)

"""Pack values of varying bit length one after another.

The lowest bit of a value comes first and takes the lowest free bit.
"""

from __future__ import annotations

import numpy as np

from hyrfpack.quant.errors import DamagedDataError

MAX_BITS_PER_VALUE = 56

_VALUES_PER_BLOCK = 1 << 16  # Temporary arrays of this size stay in the caches.


def pack_bits(values: np.ndarray, lengths: np.ndarray) -> bytes:
    """Pack the lowest bits of each value into bytes.

    Args:
        values: (M,) unsigned integers; bits above a value's length are ignored.
        lengths: (M,) uint8 number of bits of each value, 0 to `MAX_BITS_PER_VALUE`.

    Returns:
        ceil(sum of lengths / 8) bytes; free bits at the end are zero.

    Raises:
        ValueError: the shapes differ or a length is too large.

    Example:
        >>> pack_bits(np.array([1, 2], np.uint64), np.array([1, 7], np.uint8)).hex()
        '05'
    """
    _check_lengths(values.shape, lengths)
    bits = int(lengths.sum(dtype=np.int64))
    words = np.zeros(bits // 64 + 3, np.uint64)
    position = 0
    for first in range(0, len(values), _VALUES_PER_BLOCK):
        part = slice(first, first + _VALUES_PER_BLOCK)
        length = lengths[part].astype(np.uint64)
        entries = values[part].astype(np.uint64) & ((np.uint64(1) << length) - np.uint64(1))
        starts = np.cumsum(length)
        starts += np.uint64(position)
        position = int(starts[-1])
        starts -= length
        offsets, word_index = starts & np.uint64(63), starts >> np.uint64(6)
        # Values do not overlap, so that adding them joins them. Only the last value that starts in a word can reach
        # into the next word; since no value is longer than a word, a value starts in every word.
        heads = np.append(0, np.flatnonzero(word_index[1:] != word_index[:-1]) + 1)
        tails = np.append(heads[1:], len(entries)) - 1
        np.add.at(words, word_index[heads].astype(np.int64), np.add.reduceat(entries << offsets, heads))
        # Two shifts are used, because one shift by all 64 bits would be undefined.
        overflow = entries[tails] >> np.uint64(1) >> (np.uint64(63) - offsets[tails])
        np.add.at(words, word_index[tails].astype(np.int64) + 1, overflow)
    return words.astype("<u8").tobytes()[: (bits + 7) // 8]


def unpack_bits(data: bytes | memoryview, lengths: np.ndarray) -> np.ndarray:
    """Unpack the values that `pack_bits` packed.

    Args:
        data: the packed bytes, no more and no fewer.
        lengths: (M,) uint8 as given to `pack_bits`.

    Returns:
        (M,) uint64 values.

    Raises:
        DamagedDataError: the lengths need more or fewer bytes, or the bits left over are not zero.
        ValueError: a length is too large.

    Example:
        >>> unpack_bits(bytes([0x05]), np.array([1, 7], np.uint8)).tolist()
        [1, 2]
    """
    _check_lengths(lengths.shape, lengths)
    reader = BitReader(data, int(lengths.sum(dtype=np.int64)))
    values = np.empty(len(lengths), np.uint64)
    for first in range(0, len(lengths), _VALUES_PER_BLOCK):
        part = slice(first, first + _VALUES_PER_BLOCK)
        values[part] = reader.read(lengths[part])
    return values


class BitReader:
    """Reader of packed values that returns one block at a time.

    Args:
        data: the packed bytes, no more and no fewer.
        bits: total number of bits of all values.

    Raises:
        DamagedDataError: this number of bits takes more or fewer bytes, or the bits left over are not zero.
    """

    def __init__(self, data: bytes | memoryview, bits: int) -> None:
        if len(data) != (bits + 7) // 8:
            raise DamagedDataError(f"packed bits: {len(data)} bytes where {bits} bits are announced; it is damaged")
        if bits % 8 and data[-1] >> bits % 8:
            raise DamagedDataError("packed bits: the bits after the last value are not zero; the data is damaged")
        self._data, self._position = memoryview(data), 0

    def read(self, lengths: np.ndarray) -> np.ndarray:
        """Read the next values, uint64, of the given bit lengths; all calls together read at most `bits` bits."""
        length = lengths.astype(np.uint64)
        starts = np.cumsum(length)
        bits = int(starts[-1]) if len(starts) else 0
        starts -= length
        starts += np.uint64(self._position % 64)
        words = self._read_words(self._position // 64, (self._position + bits) // 64 + 2)
        self._position += bits
        offsets, word_index = starts & np.uint64(63), (starts >> np.uint64(6)).view(np.int64)
        # Two shifts are used, because one shift by all 64 bits would be undefined.
        values = words[word_index] >> offsets | words[word_index + 1] << np.uint64(1) << (np.uint64(63) - offsets)
        return values & ((np.uint64(1) << length) - np.uint64(1))

    def read_all_words(self) -> np.ndarray:
        """Return all bits as uint64 words, lowest bits first; at least 64 zero bits follow the last bit."""
        return self._read_words(0, len(self._data) // 8 + 2)

    def _read_words(self, start: int, stop: int) -> np.ndarray:
        """Return the 64-bit words start to stop - 1; words beyond the data are 0."""
        data = bytes(self._data[8 * start : 8 * stop])
        return np.frombuffer(data.ljust(8 * (stop - start), b"\0"), "<u8").astype(np.uint64, copy=False)


def _check_lengths(shape: tuple[int, ...], lengths: np.ndarray) -> None:
    if len(shape) != 1 or lengths.shape != shape or lengths.dtype != np.uint8:
        raise ValueError(f"lengths must be uint8, one for each of (M,) values, got {lengths.shape} {lengths.dtype}")
    if lengths.max(initial=0) > MAX_BITS_PER_VALUE:
        raise ValueError(f"a value has at most {MAX_BITS_PER_VALUE} bits, got {lengths.max()}")

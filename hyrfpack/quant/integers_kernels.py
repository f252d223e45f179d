"""Integers to tokens and extra bits and back, in Numba: the same results as the numpy loops of `integers`."""

from __future__ import annotations

import numpy as np

from hyrfpack.parallel.compiled import compiled

njit = compiled(error_model="numpy")

_1, _6, _OFFSET = np.uint64(1), np.uint64(6), np.uint64(63)


@njit
def split(values, signed, token_of, extra_bits, tokens, words, place):
    """Write the token of each value and add its extra bits to zeroed words, from bit `place` on; return where they end.

    Args:
        values: (M,) int64.
        token_of: (2^k,) tokens of the values below 2^k, k at least 8: from 128 on, twice a value is 2 tokens higher.
        tokens: (M,) uint8, written.
        words: uint64, one more than the bits fill, written.
    """
    place = np.uint64(place)
    for i in range(len(values)):
        value = np.uint64(values[i] << 1 ^ values[i] >> 63) if signed else np.uint64(values[i])
        head, halvings = value, 0
        while head >= np.uint64(len(token_of)):
            head >>= _1
            halvings += 1
        token = token_of[head] + np.uint8(2 * halvings)
        tokens[i] = token
        length = np.uint64(extra_bits[np.uint64(token)])
        if length > 0:
            extra, offset = value & ((_1 << length) - _1), place & _OFFSET
            words[place >> _6] |= extra << offset
            # Two shifts, as one by all 64 bits would be undefined.
            words[(place >> _6) + _1] |= extra >> _1 >> (_OFFSET - offset)
            place += length
    return place


@njit
def join(tokens, words, signed, least_value, extra_bits, values):
    """Write the values of tokens and of extra bits in uint64 words, one more than they fill; `values` are unsigned."""
    place = np.uint64(0)
    for i in range(len(tokens)):
        token = np.uint64(tokens[i])
        value, length = least_value[token], np.uint64(extra_bits[token])
        if length > 0:
            offset = place & _OFFSET
            extra = words[place >> _6] >> offset | words[(place >> _6) + _1] << _1 << (_OFFSET - offset)
            value += extra & ((_1 << length) - _1)
            place += length
        values[i] = value >> _1 ^ (~(value & _1) + _1) if signed else value

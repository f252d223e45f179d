"""Numba kernels between integers and tokens with extra bits; their results equal the numpy loops of `integers`."""

from __future__ import annotations

import numpy as np

from hyrfpack.parallel.compiled import compiled

njit = compiled(error_model="numpy")

_ONE = np.uint64(1)
_WORD_SHIFT = np.uint64(6)  # A bit position shifted by this is the index of its 64-bit word.
_OFFSET_MASK = np.uint64(63)


@njit
def values_to_tokens(values, signed, token_by_value, extra_bits, tokens, words, position):
    """Write the token of each value, and its extra bits into zeroed words from bit `position` on.

    Args:
        values: (M,) int64.
        signed: whether values may be negative.
        token_by_value: (2^k,) tokens of the values below 2^k, k at least 8. For values of 128 and more, the token of
            twice a value is 2 higher.
        extra_bits: number of extra bits of each token.
        tokens: (M,) uint8 output.
        words: uint64 output, one more word than the bits fill.
        position: that of the first extra bit.

    Returns:
        The bit position after the last extra bit.
    """
    position = np.uint64(position)
    for i in range(len(values)):
        value = np.uint64(values[i] << 1 ^ values[i] >> 63) if signed else np.uint64(values[i])
        head, halvings = value, 0
        while head >= np.uint64(len(token_by_value)):
            head >>= _ONE
            halvings += 1
        token = token_by_value[head] + np.uint8(2 * halvings)
        tokens[i] = token
        length = np.uint64(extra_bits[np.uint64(token)])
        if length > 0:
            extra, offset = value & ((_ONE << length) - _ONE), position & _OFFSET_MASK
            words[position >> _WORD_SHIFT] |= extra << offset
            # Two shifts are used, because one shift by all 64 bits would be undefined.
            words[(position >> _WORD_SHIFT) + _ONE] |= extra >> _ONE >> (_OFFSET_MASK - offset)
            position += length
    return position


@njit
def tokens_to_values(tokens, words, signed, min_value_by_token, extra_bits, values):
    """Write the values of tokens and their extra bits into `values`, uint32 or uint64.

    `words` are uint64, one more word than the extra bits fill.
    """
    position = np.uint64(0)
    for i in range(len(tokens)):
        token = np.uint64(tokens[i])
        value, length = min_value_by_token[token], np.uint64(extra_bits[token])
        if length > 0:
            offset = position & _OFFSET_MASK
            low, high = words[position >> _WORD_SHIFT], words[(position >> _WORD_SHIFT) + _ONE]
            extra = low >> offset | high << _ONE << (_OFFSET_MASK - offset)
            value += extra & ((_ONE << length) - _ONE)
            position += length
        values[i] = value >> _ONE ^ (~(value & _ONE) + _ONE) if signed else value

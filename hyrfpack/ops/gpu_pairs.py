"""Device functions that pack two float32 into one 64-bit word, which halves the number of loads and stores."""

from __future__ import annotations

import triton
import triton.language as tl


@triton.jit
def pack_pair(first, second):
    """Pack two float32 into a 64-bit word, the first in the low half."""
    low = first.to(tl.uint32, bitcast=True).to(tl.uint64)
    high = second.to(tl.uint32, bitcast=True).to(tl.uint64)
    return (low | (high << 32)).to(tl.int64, bitcast=True)


@triton.jit
def unpack_pair(word):
    """Return the two float32 of a word that `pack_pair` made."""
    return word.to(tl.int32).to(tl.float32, bitcast=True), (word >> 32).to(tl.int32).to(tl.float32, bitcast=True)

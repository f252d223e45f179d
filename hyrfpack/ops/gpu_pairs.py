"""Pairs of float32 as one 64-bit word each, which halves the number of loads and stores: device functions."""

from __future__ import annotations

import triton
import triton.language as tl


@triton.jit
def pack(first, second):
    """A pair of float32 as a 64-bit word."""
    low = first.to(tl.uint32, bitcast=True).to(tl.uint64)
    high = second.to(tl.uint32, bitcast=True).to(tl.uint64)
    return (low | (high << 32)).to(tl.int64, bitcast=True)


@triton.jit
def unpack(word):
    """The pair of float32 in a 64-bit word."""
    return word.to(tl.int32).to(tl.float32, bitcast=True), (word >> 32).to(tl.int32).to(tl.float32, bitcast=True)

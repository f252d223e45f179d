"""Measure the speed of the Huffman coder on hash-table symbols against dahuffman's in the same run."""

from __future__ import annotations

import numpy as np
from dahuffman import HuffmanCodec

from hyrfpack.measure.timing import time_alternately
from hyrfpack.quant import MinMaxQuantizer, huffman_decode, huffman_encode

SYMBOL_COUNT = 3_400_000
PEER_SYMBOL_COUNT = 100_000  # dahuffman is slow, and its rate does not depend on the count
TIMING_REPEATS = 5


def make_table_symbols() -> np.ndarray:
    """Return 8-bit min-max codes of values like a trained hash table's.

    The values are Gaussian within a level and heavy-tailed over all levels.
    """
    rng = np.random.default_rng(0)
    spread = np.repeat(np.geomspace(0.3, 1.0, 16), -(-SYMBOL_COUNT // 16))[:SYMBOL_COUNT]
    values = rng.laplace(scale=spread) * 0.5 + rng.normal(scale=spread)
    return MinMaxQuantizer(8).encode(values.astype(np.float32))[0]


def entropy_bits(symbols: np.ndarray) -> float:
    """Return the zeroth-order entropy in bits per symbol."""
    shares = np.bincount(symbols)[np.unique(symbols)] / len(symbols)
    return float(-(shares * np.log2(shares)).sum())


def bench() -> list[dict]:
    """Time both coders in alternation; times are medians.

    Returns:
        One row for encoding and one for decoding: million symbols per second of our coder and of dahuffman, their
        ratio, and bits per symbol of the payload, of the whole stream and of the entropy.
    """
    symbols = make_table_symbols()
    stream = huffman_encode(symbols)
    head = symbols[:: SYMBOL_COUNT // PEER_SYMBOL_COUNT].tolist()
    peer = HuffmanCodec.from_frequencies(dict(enumerate(np.bincount(symbols).tolist())))
    peer_bytes = peer.encode(head)
    if peer.decode(peer_bytes)[: len(head)] != head or not np.array_equal(huffman_decode(stream), symbols):
        raise AssertionError("a coder does not decode its stream to the symbols that it encoded")
    tasks = {
        "encode": (lambda: huffman_encode(symbols), lambda: peer.encode(head)),
        "decode": (lambda: huffman_decode(stream), lambda: peer.decode(peer_bytes)),
    }
    rows = []
    for name, (ours, theirs) in tasks.items():
        times, _ = time_alternately({"ours": ours, "dahuffman": theirs}, TIMING_REPEATS)
        our_rate, peer_rate = SYMBOL_COUNT / times["ours"].ms / 1e3, len(head) / times["dahuffman"].ms / 1e3
        rows.append(
            {
                "operation": name,
                "symbols": SYMBOL_COUNT,
                "ours_msymbols_per_s": our_rate,
                "dahuffman_msymbols_per_s": peer_rate,
                "ratio": our_rate / peer_rate,
                "payload_bits_per_symbol": 8 * len(stream.payload) / SYMBOL_COUNT,
                "stream_bits_per_symbol": 8 * len(stream.to_bytes()) / SYMBOL_COUNT,
                "entropy_bits_per_symbol": entropy_bits(symbols),
            }
        )
    return rows

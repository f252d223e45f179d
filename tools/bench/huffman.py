"""Speed of the Huffman coder on hash-table symbols, beside dahuffman in the same run."""

from __future__ import annotations

import numpy as np
from dahuffman import HuffmanCodec

from hyrfpack.measure.timing import time_alternately
from hyrfpack.quant import MinMaxQuantizer, huffman_decode, huffman_encode

COUNT = 3_400_000
PEER_COUNT = 100_000  # dahuffman is slow and linear: a slice gives its rate
REPEATS = 5


def table_symbols(count: int = COUNT) -> np.ndarray:
    """8-bit min-max codes of values like a trained hash table's: per level Gaussian, heavy-tailed over all levels."""
    rng = np.random.default_rng(0)
    spread = np.repeat(np.geomspace(0.3, 1.0, 16), -(-count // 16))[:count]
    values = rng.laplace(scale=spread) * 0.5 + rng.normal(scale=spread)
    return MinMaxQuantizer(8).encode(values.astype(np.float32))[0]


def entropy_bits(symbols: np.ndarray) -> float:
    """Zeroth-order entropy in bits a symbol."""
    shares = np.bincount(symbols)[np.unique(symbols)] / len(symbols)
    return float(-(shares * np.log2(shares)).sum())


def bench() -> list[dict]:
    """Time both coders, interleaved; medians.

    Returns:
        One row for encoding and one for decoding: our and dahuffman's million symbols a second and their ratio, and
        what the stream takes: bits a symbol of the payload, of the whole stream, and the entropy.
    """
    symbols = table_symbols()
    stream = huffman_encode(symbols)
    head = symbols[:: COUNT // PEER_COUNT].tolist()
    peer = HuffmanCodec.from_frequencies(dict(enumerate(np.bincount(symbols).tolist())))
    peer_bytes = peer.encode(head)
    if peer.decode(peer_bytes)[: len(head)] != head or not np.array_equal(huffman_decode(stream), symbols):
        raise AssertionError("a coder does not give back what it was given")
    tasks = {
        "encode": (lambda: huffman_encode(symbols), lambda: peer.encode(head)),
        "decode": (lambda: huffman_decode(stream), lambda: peer.decode(peer_bytes)),
    }
    rows = []
    for name, (ours, theirs) in tasks.items():
        times, _ = time_alternately({"ours": ours, "dahuffman": theirs}, REPEATS)
        our_rate, peer_rate = COUNT / times["ours"].ms / 1e3, len(head) / times["dahuffman"].ms / 1e3
        rows.append(
            {
                "operation": name,
                "symbols": COUNT,
                "ours_msymbols_per_s": our_rate,
                "dahuffman_msymbols_per_s": peer_rate,
                "ratio": our_rate / peer_rate,
                "payload_bits_per_symbol": 8 * len(stream.payload) / COUNT,
                "stream_bits_per_symbol": 8 * len(stream.to_bytes()) / COUNT,
                "entropy_bits_per_symbol": entropy_bits(symbols),
            }
        )
    return rows


def main() -> None:
    """Print the table."""
    rows = bench()
    print(f"{COUNT:,} symbols; medians of {REPEATS}; million symbols a second")
    print(f"{'':8}{'ours':>10}{'dahuffman':>12}{'ratio':>8}")
    for row in rows:
        ours, peer = row["ours_msymbols_per_s"], row["dahuffman_msymbols_per_s"]
        print(f"{row['operation']:8}{ours:10.1f}{peer:12.2f}{row['ratio']:7.0f}x")
    payload, stream, entropy = (rows[0][f"{what}_bits_per_symbol"] for what in ("payload", "stream", "entropy"))
    print(f"bits a symbol: {payload:.4f} payload, {stream:.4f} with table and chunk sizes, {entropy:.4f} entropy")


if __name__ == "__main__":
    main()

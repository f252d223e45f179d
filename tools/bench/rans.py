"""Measure speed and size of the rANS integer coder against zstd, constriction and our Huffman coder in the same run.

constriction and Huffman encode the same tokens as our rANS coder. Their sizes include the uncompressed extra bits, and
their times leave out the split of values into tokens. zstd encodes the values as bytes.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from hyrfpack.measure.timing import time_alternately
from hyrfpack.parallel import has_numba
from hyrfpack.quant import HuffmanStream, decode_integers, encode_integers, huffman_decode, huffman_encode
from hyrfpack.quant.integers import EXTRA_BITS_BY_TOKEN
from hyrfpack.quant.rans import decode_tokens

try:
    import zstandard
except ImportError:
    zstandard = None
try:
    import constriction
except ImportError:
    constriction = None

SYMBOL_COUNTS = (3_400_000, 30_000)
TIMING_REPEATS = 3

Coder = tuple[Callable[[], bytes], Callable[[bytes], np.ndarray], int]  # encode, decode, size of the extra bits


def make_laplace_with_contexts(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return Laplace residuals of eight scales from 0.3 to 10 steps, and the index of each one's scale as context."""
    rng = np.random.default_rng(0)
    contexts = rng.integers(0, 8, count).astype(np.uint8)
    return np.rint(rng.laplace(scale=np.geomspace(0.3, 10, 8)[contexts])).astype(np.int32), contexts


def make_morton_gaps(count: int) -> tuple[np.ndarray, None]:
    """Return the gaps along the Morton curve between points near a surface, on a grid of 2^14 cells per axis."""
    rng = np.random.default_rng(0)
    plane = rng.integers(0, 1 << 14, (count + 1, 2))
    height = 8000 + 2000 * np.sin(plane[:, 0] / 2000) + rng.normal(0, 20, count + 1)
    code = np.zeros(count + 1, np.int64)
    for axis, coordinate in enumerate((*plane.T, height.astype(np.int64))):
        for bit in range(14):
            code |= (coordinate >> bit & 1) << (3 * bit + axis)
    return np.diff(np.sort(code)), None


def make_mostly_zero(count: int) -> tuple[np.ndarray, None]:
    """Return Laplace residuals, 90 % of which are zero."""
    return np.rint(np.random.default_rng(0).laplace(scale=0.22, size=count)).astype(np.int32), None


VALUE_SOURCES = {
    "laplace, 8 contexts": make_laplace_with_contexts,
    "Morton gaps": make_morton_gaps,
    "mostly zero": make_mostly_zero,
}


def bench() -> list[dict]:
    """Time all coders in alternation; times are medians.

    Returns:
        A row for each source, count and coder: bits per symbol, the excess over the entropy in percent, and million
        symbols per second. The entropy is that of each context's tokens plus the extra bits.

    Raises:
        AssertionError: a coder does not decode to the values that it encoded.
    """
    return [
        row
        for name, make in VALUE_SOURCES.items()
        for count in SYMBOL_COUNTS
        for row in _bench_source(name, *make(count))
    ]


def _bench_source(name: str, values: np.ndarray, contexts: np.ndarray | None) -> list[dict]:
    count, signed = len(values), bool(values.min() < 0)
    tokens = decode_tokens(encode_integers(values, contexts, signed=signed), count, contexts).tokens
    groups = np.zeros(count, np.uint8) if contexts is None else contexts
    histograms = np.stack([np.bincount(tokens[groups == group], minlength=126) for group in range(groups.max() + 1)])
    shares = histograms / np.maximum(histograms.sum(axis=1, keepdims=True), 1)
    extra = int(EXTRA_BITS_BY_TOKEN[tokens].sum(dtype=np.int64))
    entropy = (extra - (histograms * np.log2(np.where(shares > 0, shares, 1))).sum()) / count

    coders = {}
    for implementation in ("cpu", "numpy") if has_numba() else ("numpy",):
        coders[f"ours ({implementation})"] = _rans_coder(values, contexts, signed, implementation)
    coders["ours, Huffman"] = _huffman_coder(tokens, extra)
    if constriction:
        coders["constriction"] = _constriction_coder(tokens, groups, shares, extra)
    if zstandard:
        coders["zstd-19"] = _zstd_coder(values)

    encoding, blobs = time_alternately({coder: encode for coder, (encode, _, _) in coders.items()}, TIMING_REPEATS)
    for coder, (_, decode, _) in coders.items():
        expected = values if coder.startswith(("ours (", "zstd")) else tokens
        if not np.array_equal(decode(blobs[coder]), expected):
            raise AssertionError(f"{coder} does not decode its bytes to the values that it encoded")
    decoding, _ = time_alternately(
        {c: partial(decode, blobs[c]) for c, (_, decode, _) in coders.items()}, TIMING_REPEATS
    )
    rows = [{"set": name, "symbols": count, "coder": "entropy", "bits_per_symbol": entropy, "above_entropy_%": 0.0}]
    for coder, (_, _, more_bits) in coders.items():
        bits = (8 * len(blobs[coder]) + more_bits) / count
        rows.append(
            {
                "set": name,
                "symbols": count,
                "coder": coder,
                "bits_per_symbol": bits,
                "above_entropy_%": 100 * (bits / entropy - 1),
                "encode_msymbols_per_s": count / encoding[coder].ms / 1e3,
                "decode_msymbols_per_s": count / decoding[coder].ms / 1e3,
            }
        )
    return rows


def _rans_coder(values: np.ndarray, contexts: np.ndarray | None, signed: bool, implementation: str) -> Coder:
    options = {"signed": signed, "implementation": implementation}
    encode = partial(encode_integers, values, contexts, **options)
    return encode, lambda data: decode_integers(data, len(values), contexts, **options), 0


def _huffman_coder(tokens: np.ndarray, extra: int) -> Coder:
    return (
        lambda: huffman_encode(tokens).to_bytes(),
        lambda data: huffman_decode(HuffmanStream.from_bytes(data)),
        extra,
    )


def _constriction_coder(tokens: np.ndarray, groups: np.ndarray, shares: np.ndarray, extra: int) -> Coder:
    """Return a range coder that encodes one context after another; the size of its models is not counted."""
    rows_by_group = [np.flatnonzero(groups == group) for group in range(len(shares))]
    models = [constriction.stream.model.Categorical(row.astype(np.float64), perfect=False) for row in shares]

    def encode() -> bytes:
        coder = constriction.stream.queue.RangeEncoder()
        for rows, model in zip(rows_by_group, models, strict=True):
            coder.encode(tokens[rows].astype(np.int32), model)
        return coder.get_compressed().tobytes()

    def decode(data: bytes) -> np.ndarray:
        coder, decoded = constriction.stream.queue.RangeDecoder(np.frombuffer(data, np.uint32)), np.empty_like(tokens)
        for rows, model in zip(rows_by_group, models, strict=True):
            decoded[rows] = coder.decode(model, len(rows))
        return decoded

    return encode, decode, extra


def _zstd_coder(values: np.ndarray) -> Coder:
    dtype = np.result_type(np.min_scalar_type(values.min()), np.min_scalar_type(values.max()))
    raw = values.astype(dtype).tobytes()
    encode = partial(zstandard.ZstdCompressor(level=19).compress, raw)
    return encode, lambda data: np.frombuffer(zstandard.ZstdDecompressor().decompress(data), dtype), 0

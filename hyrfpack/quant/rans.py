"""Interleaved rANS codes arrays of small numbers (tokens) in nearly as few bits as their entropy.

The coder is a range asymmetric numeral system (Duda, arXiv:1311.2540) with 32-bit states, 16-bit words and frequencies
in 4096ths. It codes the array on many parallel lanes, which is fast in numpy and in pipelined processors.

**Bytes of a stream**, little-endian; an array without tokens takes no bytes:

    u8   bits 0-3: log2 of the requested lanes; bits 4-6: classes - 1; bit 7: models are static
    u8   A, size of the alphabet, 1 to 126; 0 if each context has one token only
    ...  A = 0: the token of each context, a byte each, and nothing follows
    classes - 1 bytes    rising thresholds of the classes
    ...  static: the levels of the models, a stream of this kind
    u32 for each used lane    its state
    u16 ...                   words

docs/reference/format.md specifies the meaning of each field.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import NamedTuple

import numpy as np

from hyrfpack.parallel import has_numba
from hyrfpack.quant import rans_lanes
from hyrfpack.quant.errors import DamagedDataError
from hyrfpack.quant.rans_lanes import LaneLayout, ModelSelector
from hyrfpack.quant.rans_models import (
    COST_BY_FREQUENCY,
    MAX_ALPHABET_SIZE,
    MAX_LEVEL,
    adaptive_frequencies,
    iter_update_ranges,
    static_frequencies,
    static_levels,
)

MAX_LANES = 8192
MAX_TOKEN_CLASSES = 8
MAX_MODELS = 1024  # A model is a pair of context and class. The table of the decoder then takes at most 16 MiB.

_HEADER_BYTES = 2
_MAX_STEPS_PER_LANE = 1 << 16  # A decoder rejects longer lanes if a stream has fewer than MAX_LANES lanes.
_TARGET_BYTES_PER_LANE = 1024  # The overhead is then small, because each lane takes about 3 extra bytes.
_MIN_TOKENS_PER_MODEL = 64  # With fewer tokens on average, token classes do not save bytes.
_STATIC_FLAG = 0x80


class DecodedTokens(NamedTuple):
    """Decoded tokens of a stream and the stream's properties.

    Attributes:
        tokens: (M,) uint8.
        size: length of the stream in bytes.
        alphabet: size of the alphabet: the largest token plus 1, unless the stream is damaged.
    """

    tokens: np.ndarray
    size: int
    alphabet: int


def encode_tokens(tokens: np.ndarray, contexts: np.ndarray | None = None, implementation: str = "auto") -> bytes:
    """Encode an array of tokens.

    The encoder chooses the variant with the smallest estimated size: static or adaptive models, one per context or one
    per pair of a context and the class of the previous token.

    Args:
        tokens: (M,) uint8 below `MAX_ALPHABET_SIZE`.
        contexts: (M,) uint8 class of each token, which the decoder must know; None means one class.
        implementation: "numpy", "cpu" (Numba) or "auto"; the bytes are the same.

    Raises:
        ValueError: the shape or dtype is wrong, or a token is too large.

    Example:
        >>> tokens = np.array([0, 0, 1, 0, 2], np.uint8)
        >>> decode_tokens(encode_tokens(tokens), 5).tokens.tolist()
        [0, 0, 1, 0, 2]
    """
    backend = _select_backend(implementation)
    contexts, context_count = _check_contexts(contexts, len(tokens))
    if tokens.ndim != 1 or tokens.dtype != np.uint8 or tokens.max(initial=0) >= MAX_ALPHABET_SIZE:
        raise ValueError(f"tokens must be (M,) uint8 below {MAX_ALPHABET_SIZE}, got {tokens.shape} {tokens.dtype}")
    return _encode(np.ascontiguousarray(tokens), contexts, context_count, backend, allow_static=True)


def decode_tokens(
    data: bytes | memoryview, count: int, contexts: np.ndarray | None = None, implementation: str = "auto"
) -> DecodedTokens:
    """Decode tokens that `encode_tokens` encoded.

    Args:
        data: the stream; more may follow it.
        count: M, the number of tokens.
        contexts: (M,) uint8 as given to the encoder.
        implementation: "numpy", "cpu" (Numba) or "auto"; the tokens are the same.

    Raises:
        DamagedDataError: the bytes are truncated, damaged or inconsistent.
        ValueError: the count is negative, or contexts have a wrong shape or dtype.
    """
    if count < 0:
        raise ValueError(f"count must be 0 or more, got {count}")
    contexts, context_count = _check_contexts(contexts, count)
    return _decode(memoryview(data), count, contexts, context_count, _select_backend(implementation), allow_static=True)


def uses_numba(implementation: str) -> bool:
    """Return whether an implementation name selects the Numba kernels.

    Raises:
        ValueError: the name is not "numpy", "cpu" or "auto".
    """
    if implementation not in ("auto", "numpy", "cpu"):
        raise ValueError(f"no implementation '{implementation}'; there are auto, numpy, cpu")
    return implementation == "cpu" or (implementation == "auto" and has_numba())


def _select_backend(implementation: str) -> ModuleType:
    """Return the module with the inner loops: `rans_lanes` (numpy) or `rans_kernels` (Numba)."""
    if not uses_numba(implementation):
        return rans_lanes
    from hyrfpack.quant import rans_kernels

    return rans_kernels


def _check_contexts(contexts: np.ndarray | None, count: int) -> tuple[np.ndarray | None, int]:
    """Check the contexts; return them, or None if there is only one, and their number."""
    if contexts is None:
        return None, 1
    if contexts.shape != (count,) or contexts.dtype != np.uint8:
        raise ValueError(f"contexts must be ({count},) uint8, got {contexts.shape} {contexts.dtype}")
    number = int(contexts.max(initial=0)) + 1
    return (None, 1) if number == 1 else (np.ascontiguousarray(contexts), number)


def _encode(
    tokens: np.ndarray, contexts: np.ndarray | None, context_count: int, backend: ModuleType, allow_static: bool
) -> bytes:
    """Encode tokens that have been checked; static models are considered only if `allow_static`."""
    if len(tokens) == 0:
        return b""
    alphabet = int(tokens.max()) + 1
    max_classes = min(
        MAX_TOKEN_CLASSES, MAX_MODELS // context_count, len(tokens) // (context_count * _MIN_TOKENS_PER_MODEL)
    )
    if max_classes > 1:
        pairs = backend.count_pairs(tokens, contexts, context_count, alphabet)
    else:
        one_lane, one_class = LaneLayout(len(tokens), 1), _make_selector(contexts, (), alphabet)
        shape = (context_count, alphabet)
        pairs = backend.count_tokens(tokens, one_class, one_lane, 0, len(tokens), shape)[:, None]
    context_counts = pairs.sum(axis=1)
    if ((context_counts > 0).sum(axis=1) <= 1).all():
        return bytes((0, 0)) + context_counts.argmax(axis=1).astype(np.uint8).tobytes()
    plans = [
        _make_plan(tokens, contexts, context_count, alphabet, thresholds, bits, backend, allow_static)
        for thresholds, bits in _candidate_thresholds(pairs, max_classes)
    ]
    return min(plans, key=lambda plan: plan.cost).encode(tokens, backend)


@dataclass(frozen=True, eq=False)
class _CodingPlan:
    """One way of coding the tokens, with its estimated size.

    Attributes:
        cost: size of tokens and models, in 2^-16 bits.
        header: bytes before the states.
        selector: selects the model of each token.
        lanes: assignment of tokens to lanes.
        segments: ranges (start, stop) of steps with their frequencies.
    """

    cost: int
    header: bytes
    selector: ModelSelector
    lanes: LaneLayout
    segments: list[tuple[int, int, np.ndarray]]

    def encode(self, tokens: np.ndarray, backend: ModuleType) -> bytes:
        """Return the stream of the tokens."""
        states, words = backend.encode_lanes(tokens, self.selector, self.lanes, self.segments)
        return b"".join((self.header, states.astype("<u4").tobytes(), words.astype("<u2").tobytes()))


def _make_plan(
    tokens: np.ndarray,
    contexts: np.ndarray | None,
    context_count: int,
    alphabet: int,
    thresholds: tuple[int, ...],
    bits: int,
    backend: ModuleType,
    allow_static: bool,
) -> _CodingPlan:
    """Choose adaptive models, or static ones if allowed, for the classes of `thresholds`.

    `bits` is the estimated size of the tokens.
    """
    lanes_log2 = _choose_lanes_log2(len(tokens), bits)
    lanes, selector = LaneLayout(len(tokens), 1 << lanes_log2), _make_selector(contexts, thresholds, alphabet)
    shape = (context_count * selector.classes, alphabet)
    first_byte = lanes_log2 | len(thresholds) << 4

    ranges = list(iter_update_ranges(lanes.steps))
    range_counts = np.stack(
        [backend.count_tokens(tokens, selector, lanes, start, stop, shape) for start, stop in ranges]
    )
    counts = range_counts.sum(axis=0)
    counts_before = np.cumsum(range_counts, axis=0) - range_counts
    frequencies = adaptive_frequencies(counts_before)
    cost = int((range_counts * COST_BY_FREQUENCY[frequencies]).sum())
    segments = [(*steps, rows) for steps, rows in zip(ranges, frequencies, strict=True)]
    adaptive = _CodingPlan(cost, bytes((first_byte, alphabet, *thresholds)), selector, lanes, segments)
    if not allow_static:
        return adaptive

    levels = static_levels(counts)
    level_bytes, frequencies = _encode_levels(levels, backend), static_frequencies(levels)
    cost = int((counts * COST_BY_FREQUENCY[frequencies]).sum()) + (8 * len(level_bytes) << 16)
    if cost >= adaptive.cost:
        return adaptive
    header = bytes((first_byte | _STATIC_FLAG, alphabet, *thresholds)) + level_bytes
    return _CodingPlan(cost, header, selector, lanes, [(0, lanes.steps, frequencies)])


def _make_selector(contexts: np.ndarray | None, thresholds: Sequence[int], alphabet: int) -> ModelSelector:
    """Build the selector for token classes that begin at the given thresholds."""
    class_by_token = np.searchsorted(thresholds, np.arange(alphabet), side="right").astype(np.uint8)
    return ModelSelector(contexts, class_by_token, len(thresholds) + 1)


def _candidate_thresholds(pairs: np.ndarray, max_classes: int) -> list[tuple[tuple[int, ...], int]]:
    """Return the class thresholds to try, each with the estimated size in bits.

    These are the empty thresholds, which make one class, and the thresholds with the smallest estimate.

    Args:
        pairs: (contexts, previous token, token) number of occurrences of each pair.
        max_classes: largest allowed number of classes.
    """
    choices: dict[tuple[int, ...], int] = {(): _estimate_bits(pairs.sum(axis=1))}
    pooled = np.cumsum(pairs.sum(axis=(0, 1)))
    for classes in range(2, max_classes + 1):
        # Each class gets about the same number of tokens.
        edges = np.searchsorted(pooled, pooled[-1] * np.arange(1, classes) // classes, side="right")
        thresholds = tuple(np.unique(np.clip(edges, 1, len(pooled) - 1)).tolist())
        if len(pooled) > 1 and thresholds not in choices:
            counts = np.add.reduceat(pairs, [0, *thresholds], axis=1)
            choices[thresholds] = _estimate_bits(counts.reshape(-1, len(pooled)))
    best = min(choices, key=choices.__getitem__)
    return [(thresholds, choices[thresholds]) for thresholds in dict.fromkeys([(), best])]


def _estimate_bits(counts: np.ndarray) -> int:
    """Estimate the bits of tokens with counts (K, A): their entropy plus the cost of learning the frequencies."""
    totals = counts.sum(axis=1, keepdims=True)
    bits = counts * np.log2(np.maximum(totals, 1) / np.maximum(counts, 1)) + (counts > 0) * np.log2(totals + 1) / 2
    return round(float(bits.sum()))


def _choose_lanes_log2(count: int, bits: float) -> int:
    """Return log2 of the number of lanes, so that lanes take few extra bytes and none is too long."""
    lanes = max(int(bits) // (8 * _TARGET_BYTES_PER_LANE), count // (_MAX_STEPS_PER_LANE // 2), 1)
    return min(lanes, MAX_LANES).bit_length() - 1


def _encode_levels(levels: np.ndarray, backend: ModuleType) -> bytes:
    """Encode levels (K, A) as a stream of differences.

    They are differences along the alphabet in the first model, and from model to model in the others.
    """
    differences = np.diff(levels, axis=0, prepend=0)
    differences[0] = np.diff(levels[0], prepend=0)
    zigzag = np.where(differences < 0, -2 * differences - 1, 2 * differences)
    return _encode(zigzag.astype(np.uint8).ravel(), None, 1, backend, allow_static=False)


def _decode_levels(data: memoryview, models: int, alphabet: int, backend: ModuleType) -> tuple[np.ndarray, int]:
    """Decode the levels (models, alphabet) of static models; return them and the length of their stream in bytes."""
    decoded = _decode(data, models * alphabet, None, 1, backend, allow_static=False)
    zigzag = decoded.tokens.astype(np.int64).reshape(models, alphabet)
    levels = np.where(zigzag & 1, -(zigzag + 1 >> 1), zigzag >> 1)
    levels[0] = np.cumsum(levels[0])
    levels = np.cumsum(levels, axis=0)
    if levels.min() < 0 or levels.max() > MAX_LEVEL or not levels.any(axis=1).all():
        raise DamagedDataError("rANS stream: a model has no valid frequencies; the data is damaged")
    return levels, decoded.size


def _decode(
    data: memoryview,
    count: int,
    contexts: np.ndarray | None,
    context_count: int,
    backend: ModuleType,
    allow_static: bool,
) -> DecodedTokens:
    """Decode tokens with checked arguments; static models are rejected unless `allow_static`."""
    if count == 0:
        return DecodedTokens(np.zeros(0, np.uint8), 0, 0)
    if len(data) < _HEADER_BYTES:
        raise DamagedDataError(f"rANS stream: {len(data)} bytes are fewer than its header; it is truncated")
    lanes_log2, classes, alphabet = data[0] & 15, (data[0] >> 4 & 7) + 1, data[1]
    is_static = data[0] >= _STATIC_FLAG
    if alphabet == 0:
        return _decode_constants(data, count, contexts, context_count)
    models = context_count * classes
    if (
        alphabet > MAX_ALPHABET_SIZE
        or models > MAX_MODELS
        or 1 << lanes_log2 > MAX_LANES
        or (is_static and not allow_static)
    ):
        raise DamagedDataError("rANS stream: its header has impossible values; the data is damaged")
    if count > _MAX_STEPS_PER_LANE << lanes_log2 and 1 << lanes_log2 < MAX_LANES:
        raise DamagedDataError(f"rANS stream: too few lanes for {count} symbols; the data is damaged")
    position = _HEADER_BYTES + classes - 1
    thresholds = list(data[_HEADER_BYTES:position])
    if any(low >= high for low, high in zip([0, *thresholds], [*thresholds, alphabet], strict=True)):
        raise DamagedDataError("rANS stream: the thresholds of its classes do not rise; the data is damaged")

    lanes = LaneLayout(count, 1 << lanes_log2)
    if is_static:
        levels, size = _decode_levels(data[position:], models, alphabet, backend)
        position += size
    if len(data) < position + 4 * lanes.used_lanes:
        raise DamagedDataError(f"rANS stream: {len(data)} bytes are fewer than its lanes need; it is truncated")
    states = np.frombuffer(data, "<u4", lanes.used_lanes, position).astype(np.uint32)
    position += 4 * lanes.used_lanes
    words = np.frombuffer(data, "<u2", (len(data) - position) // 2, position).astype(np.uint16)

    selector = _make_selector(contexts, thresholds, alphabet)
    decoder = backend.LaneDecoder(selector, lanes, states, words)
    if is_static:
        decoder.run(0, lanes.steps, static_frequencies(levels))
    else:
        shape = (models, alphabet)
        counts = np.zeros(shape, np.int64)
        for start, stop in iter_update_ranges(lanes.steps):
            decoder.run(start, stop, adaptive_frequencies(counts))
            if stop < lanes.steps:
                counts += backend.count_tokens(decoder.tokens, selector, lanes, start, stop, shape)
    return DecodedTokens(decoder.tokens, position + 2 * decoder.finish(), alphabet)


def _decode_constants(data: memoryview, count: int, contexts: np.ndarray | None, context_count: int) -> DecodedTokens:
    """Decode a stream in which each context has only one token."""
    stop = _HEADER_BYTES + context_count
    token_by_context = np.frombuffer(data[_HEADER_BYTES:stop], np.uint8)
    if data[0] != 0 or len(token_by_context) < context_count or token_by_context.max() >= MAX_ALPHABET_SIZE:
        raise DamagedDataError("rANS stream: the tokens of its contexts are missing or damaged")
    tokens = np.full(count, token_by_context[0]) if contexts is None else token_by_context.take(contexts)
    return DecodedTokens(tokens, stop, int(token_by_context.max()) + 1)

"""Interleaved rANS: arrays of small numbers (tokens) to bytes, close to their entropy.

A range asymmetric numeral system (Duda, arXiv:1311.2540) with 32-bit states, 16-bit words and frequencies in 4096ths.
A coder works through the array on many lanes side by side, which numpy and a processor's pipelines both like.

**Bytes of a stream**, little-endian; nothing at all for no tokens:

    u8   bits 0-3: log2 of the lanes asked for; bits 4-6: classes - 1; bit 7: models are static
    u8   A, size of the alphabet, 1 to 126; 0 if each context has one token only
    ...  A = 0: the token of each context, a byte each, and no more follows
    classes - 1 bytes    rising thresholds of the classes
    ...  static: the levels of the models, a stream of this kind
    u32 for each used lane    its state
    u16 ...                   words

docs/format.md says what they mean.
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
from hyrfpack.quant.rans_lanes import Lanes, Selector
from hyrfpack.quant.rans_models import (
    COSTS,
    MAX_LEVEL,
    MAX_TOKENS,
    adaptive_frequencies,
    levels_of,
    static_frequencies,
    update_steps,
)

MAX_LANES = 8192
MAX_CLASSES = 8
MAX_MODELS = 1024  # contexts times classes; bounds the decoder's table to 16 MiB

_HEADER = 2
_MOST_STEPS = 1 << 16  # of a lane, as long as there are fewer than MAX_LANES
_BYTES_PER_LANE = 1024  # a lane costs about 3
_TOKENS_PER_MODEL = 64  # with fewer on average, classes are not worth trying
_STATIC = 0x80


class DecodedTokens(NamedTuple):
    """What a stream holds.

    Attributes:
        tokens: (M,) uint8.
        size: bytes that the stream took.
        alphabet: tokens are below this number; the least such number, unless the stream is damaged.
    """

    tokens: np.ndarray
    size: int
    alphabet: int


def encode_tokens(tokens: np.ndarray, contexts: np.ndarray | None = None, implementation: str = "auto") -> bytes:
    """Code an array of tokens.

    The smallest of these is kept: static or adaptive models, for the contexts alone or for each pair of a context and
    a class of the token before.

    Args:
        tokens: (M,) uint8 below `MAX_TOKENS`.
        contexts: (M,) uint8 class of each token, which the decoder knows; None means one class.
        implementation: "numpy", "cpu" (Numba) or "auto"; the bytes are the same.

    Raises:
        ValueError: another shape or dtype, or a token that is too large.

    Example:
        >>> tokens = np.array([0, 0, 1, 0, 2], np.uint8)
        >>> decode_tokens(encode_tokens(tokens), 5).tokens.tolist()
        [0, 0, 1, 0, 2]
    """
    backend = _backend(implementation)
    contexts, classes_of_context = _checked_contexts(contexts, len(tokens))
    if tokens.ndim != 1 or tokens.dtype != np.uint8 or tokens.max(initial=0) >= MAX_TOKENS:
        raise ValueError(f"tokens must be (M,) uint8 below {MAX_TOKENS}, got {tokens.shape} {tokens.dtype}")
    return _encode(np.ascontiguousarray(tokens), contexts, classes_of_context, backend, static=True)


def decode_tokens(
    data: bytes | memoryview, count: int, contexts: np.ndarray | None = None, implementation: str = "auto"
) -> DecodedTokens:
    """Decode what `encode_tokens` wrote.

    Args:
        data: the stream; more may follow it.
        count: M, the number of tokens.
        contexts: (M,) uint8 as given to the encoder.
        implementation: "numpy", "cpu" (Numba) or "auto"; the tokens are the same.

    Raises:
        DamagedDataError: the bytes are truncated, damaged or contradict themselves.
        ValueError: a negative count, or contexts of another shape or dtype.
    """
    if count < 0:
        raise ValueError(f"count must be 0 or more, got {count}")
    contexts, context_count = _checked_contexts(contexts, count)
    return _decode(memoryview(data), count, contexts, context_count, _backend(implementation), static=True)


def uses_numba(implementation: str) -> bool:
    """Whether this names the kernels in Numba.

    Raises:
        ValueError: it is none of "numpy", "cpu" and "auto".
    """
    if implementation not in ("auto", "numpy", "cpu"):
        raise ValueError(f"no implementation '{implementation}'; there are auto, numpy, cpu")
    return implementation == "cpu" or (implementation == "auto" and has_numba())


def _backend(implementation: str) -> ModuleType:
    if not uses_numba(implementation):
        return rans_lanes
    from hyrfpack.quant import rans_kernels

    return rans_kernels


def _checked_contexts(contexts: np.ndarray | None, count: int) -> tuple[np.ndarray | None, int]:
    """The contexts, None if there is one only, and their number."""
    if contexts is None:
        return None, 1
    if contexts.shape != (count,) or contexts.dtype != np.uint8:
        raise ValueError(f"contexts must be ({count},) uint8, got {contexts.shape} {contexts.dtype}")
    number = int(contexts.max(initial=0)) + 1
    return (None, 1) if number == 1 else (np.ascontiguousarray(contexts), number)


def _encode(
    tokens: np.ndarray, contexts: np.ndarray | None, context_count: int, backend: ModuleType, static: bool
) -> bytes:
    """`encode_tokens`, already checked; only with adaptive models unless `static`."""
    if len(tokens) == 0:
        return b""
    alphabet = int(tokens.max()) + 1
    most_classes = min(MAX_CLASSES, MAX_MODELS // context_count, len(tokens) // (context_count * _TOKENS_PER_MODEL))
    if most_classes > 1:
        pairs = backend.count_pairs(tokens, contexts, context_count, alphabet)
    else:
        one_lane, one_class = Lanes(len(tokens), 1), _selector(contexts, (), alphabet)
        shape = (context_count, alphabet)
        pairs = backend.count_tokens(tokens, one_class, one_lane, 0, len(tokens), shape)[:, None]
    alone = pairs.sum(axis=1)
    if ((alone > 0).sum(axis=1) <= 1).all():
        return bytes((0, 0)) + alone.argmax(axis=1).astype(np.uint8).tobytes()
    plans = [
        _plan(tokens, contexts, context_count, alphabet, thresholds, bits, backend, static)
        for thresholds, bits in _thresholds_to_try(pairs, most_classes)
    ]
    return min(plans, key=lambda plan: plan.cost).encode(tokens, backend)


@dataclass(frozen=True, eq=False)
class _Plan:
    """A way to code tokens.

    Attributes:
        cost: 2^-16 bits that tokens and models take.
        head: bytes before the states.
        selector: which model codes each token.
        lanes: how the tokens are dealt.
        segments: ranges of steps with their frequencies.
    """

    cost: int
    head: bytes
    selector: Selector
    lanes: Lanes
    segments: list[tuple[int, int, np.ndarray]]

    def encode(self, tokens: np.ndarray, backend: ModuleType) -> bytes:
        states, words = backend.encode_lanes(tokens, self.selector, self.lanes, self.segments)
        return b"".join((self.head, states.astype("<u4").tobytes(), words.astype("<u2").tobytes()))


def _plan(
    tokens: np.ndarray,
    contexts: np.ndarray | None,
    context_count: int,
    alphabet: int,
    thresholds: tuple[int, ...],
    bits: int,
    backend: ModuleType,
    static: bool,
) -> _Plan:
    """The better kind of models with these classes, for tokens that take about `bits`."""
    lanes_log2 = _lanes_log2(len(tokens), bits)
    lanes, selector = Lanes(len(tokens), 1 << lanes_log2), _selector(contexts, thresholds, alphabet)
    shape = (context_count * selector.classes, alphabet)
    first = lanes_log2 | len(thresholds) << 4

    segments, cost, counts = [], 0, np.zeros(shape, np.int64)
    for start, stop in update_steps(lanes.steps):
        frequencies = adaptive_frequencies(counts)
        new = backend.count_tokens(tokens, selector, lanes, start, stop, shape)
        cost += int((new * COSTS[frequencies]).sum())
        segments.append((start, stop, frequencies))
        counts += new
    adaptive = _Plan(cost, bytes((first, alphabet, *thresholds)), selector, lanes, segments)
    if not static:
        return adaptive

    levels = levels_of(counts)
    table, frequencies = _encode_levels(levels, backend), static_frequencies(levels)
    cost = int((counts * COSTS[frequencies]).sum()) + (8 * len(table) << 16)
    if cost >= adaptive.cost:
        return adaptive
    head = bytes((first | _STATIC, alphabet, *thresholds)) + table
    return _Plan(cost, head, selector, lanes, [(0, lanes.steps, frequencies)])


def _selector(contexts: np.ndarray | None, thresholds: Sequence[int], alphabet: int) -> Selector:
    class_of = np.searchsorted(thresholds, np.arange(alphabet), side="right").astype(np.uint8)
    return Selector(contexts, class_of, len(thresholds) + 1)


def _thresholds_to_try(pairs: np.ndarray, most_classes: int) -> list[tuple[tuple[int, ...], int]]:
    """Thresholds of one class, that is none, and of the classes that promise most; with about how many bits it takes.

    Args:
        pairs: how often each token follows each other one, (contexts, token before, token).
        most_classes: how many classes there may be.
    """
    choices: dict[tuple[int, ...], int] = {(): _promise(pairs.sum(axis=1))}
    pooled = np.cumsum(pairs.sum(axis=(0, 1)))
    for classes in range(2, most_classes + 1):
        # As many tokens in each class, as far as whole tokens allow.
        edges = np.searchsorted(pooled, pooled[-1] * np.arange(1, classes) // classes, side="right")
        thresholds = tuple(np.unique(np.clip(edges, 1, len(pooled) - 1)).tolist())
        if len(pooled) > 1 and thresholds not in choices:
            counts = np.add.reduceat(pairs, [0, *thresholds], axis=1)
            choices[thresholds] = _promise(counts.reshape(-1, len(pooled)))
    best = min(choices, key=choices.__getitem__)
    return [(thresholds, choices[thresholds]) for thresholds in dict.fromkeys([(), best])]


def _promise(counts: np.ndarray) -> int:
    """About how many bits tokens with these counts (K, A) take: their entropy, and what it takes to learn it."""
    totals = counts.sum(axis=1, keepdims=True)
    bits = counts * np.log2(np.maximum(totals, 1) / np.maximum(counts, 1)) + (counts > 0) * np.log2(totals + 1) / 2
    return round(float(bits.sum()))


def _lanes_log2(count: int, bits: float) -> int:
    """As many lanes as cost little, and enough that no lane is long."""
    wanted = max(int(bits) // (8 * _BYTES_PER_LANE), count // (_MOST_STEPS // 2), 1)
    return min(wanted, MAX_LANES).bit_length() - 1


def _encode_levels(levels: np.ndarray, backend: ModuleType) -> bytes:
    """Levels (K, A) as a stream: of the first model the differences along the alphabet, then from model to model."""
    differences = np.diff(levels, axis=0, prepend=0)
    differences[0] = np.diff(levels[0], prepend=0)
    zigzag = np.where(differences < 0, -2 * differences - 1, 2 * differences)
    return _encode(zigzag.astype(np.uint8).ravel(), None, 1, backend, static=False)


def _decode_levels(data: memoryview, models: int, alphabet: int, backend: ModuleType) -> tuple[np.ndarray, int]:
    decoded = _decode(data, models * alphabet, None, 1, backend, static=False)
    zigzag = decoded.tokens.astype(np.int64).reshape(models, alphabet)
    levels = np.where(zigzag & 1, -(zigzag + 1 >> 1), zigzag >> 1)
    levels[0] = np.cumsum(levels[0])
    levels = np.cumsum(levels, axis=0)
    if levels.min() < 0 or levels.max() > MAX_LEVEL or not levels.any(axis=1).all():
        raise DamagedDataError("rANS stream: a model has no valid frequencies; the data is damaged")
    return levels, decoded.size


def _decode(
    data: memoryview, count: int, contexts: np.ndarray | None, context_count: int, backend: ModuleType, static: bool
) -> DecodedTokens:
    """`decode_tokens`, arguments already checked; refuses static models unless `static`."""
    if count == 0:
        return DecodedTokens(np.zeros(0, np.uint8), 0, 0)
    if len(data) < _HEADER:
        raise DamagedDataError(f"rANS stream: {len(data)} bytes are fewer than its header; it is truncated")
    lanes_log2, classes, alphabet = data[0] & 15, (data[0] >> 4 & 7) + 1, data[1]
    is_static = data[0] >= _STATIC
    if alphabet == 0:
        return _decode_constants(data, count, contexts, context_count)
    models = context_count * classes
    if alphabet > MAX_TOKENS or models > MAX_MODELS or 1 << lanes_log2 > MAX_LANES or (is_static and not static):
        raise DamagedDataError("rANS stream: its header says what cannot be; the data is damaged")
    if count > _MOST_STEPS << lanes_log2 and 1 << lanes_log2 < MAX_LANES:
        raise DamagedDataError(f"rANS stream: too few lanes for {count} symbols; the data is damaged")
    place = _HEADER + classes - 1
    thresholds = list(data[_HEADER:place])
    if any(low >= high for low, high in zip([0, *thresholds], [*thresholds, alphabet], strict=True)):
        raise DamagedDataError("rANS stream: the thresholds of its classes do not rise; the data is damaged")

    lanes = Lanes(count, 1 << lanes_log2)
    if is_static:
        levels, size = _decode_levels(data[place:], models, alphabet, backend)
        place += size
    if len(data) < place + 4 * lanes.used:
        raise DamagedDataError(f"rANS stream: {len(data)} bytes are fewer than its lanes need; it is truncated")
    states = np.frombuffer(data, "<u4", lanes.used, place).astype(np.uint32)
    place += 4 * lanes.used
    words = np.frombuffer(data, "<u2", (len(data) - place) // 2, place).astype(np.uint16)

    selector = _selector(contexts, thresholds, alphabet)
    decoder = backend.LaneDecoder(selector, lanes, states, words)
    if is_static:
        decoder.run(0, lanes.steps, static_frequencies(levels))
    else:
        shape = (models, alphabet)
        counts = np.zeros(shape, np.int64)
        for start, stop in update_steps(lanes.steps):
            decoder.run(start, stop, adaptive_frequencies(counts))
            if stop < lanes.steps:
                counts += backend.count_tokens(decoder.tokens, selector, lanes, start, stop, shape)
    return DecodedTokens(decoder.tokens, place + 2 * decoder.finish(), alphabet)


def _decode_constants(data: memoryview, count: int, contexts: np.ndarray | None, context_count: int) -> DecodedTokens:
    """Tokens that follow from their contexts."""
    stop = _HEADER + context_count
    token_of = np.frombuffer(data[_HEADER:stop], np.uint8)
    if data[0] != 0 or len(token_of) < context_count or token_of.max() >= MAX_TOKENS:
        raise DamagedDataError("rANS stream: the tokens of its contexts are missing or damaged")
    tokens = np.full(count, token_of[0]) if contexts is None else token_of.take(contexts)
    return DecodedTokens(tokens, stop, int(token_of.max()) + 1)

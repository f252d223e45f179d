"""Inner loops of the rANS coder in Numba, with the same functions, results and errors as `rans_lanes`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hyrfpack.parallel.compiled import compiled
from hyrfpack.quant import rans_lanes
from hyrfpack.quant.errors import DamagedDataError
from hyrfpack.quant.rans_lanes import START_STATE, LaneLayout, ModelSelector
from hyrfpack.quant.rans_models import FREQUENCY_TOTAL, SCALE_BITS

njit = compiled(error_model="numpy")

_NO_CONTEXTS = np.zeros(0, np.uint8)
_ZERO = np.uint64(0)
_ONE = np.uint64(1)
_SCALE_BITS = np.uint32(SCALE_BITS)
_WORD_BITS = np.uint32(16)
_FLUSH_SHIFT = np.uint32(32 - SCALE_BITS)  # A lane emits a word if its state shifted by this reaches the frequency.
_TOKEN_SHIFT = np.uint32(25)
_OFFSET_MASK = np.uint32(FREQUENCY_TOTAL - 1)
_FREQUENCY_MASK = np.uint32(2 * FREQUENCY_TOTAL - 1)
_FREQUENCY_TOTAL = np.uint32(FREQUENCY_TOTAL)
_START_STATE = np.uint32(START_STATE)


def count_tokens(
    tokens: np.ndarray, selector: ModelSelector, lanes: LaneLayout, start: int, stop: int, shape: tuple[int, int]
) -> np.ndarray:
    """Count tokens by model; see `rans_lanes.count_tokens`."""
    counts = np.zeros(shape, np.int64)
    _count_tokens(
        counts, tokens, *_selection(selector), start, stop, lanes.steps, lanes.used_lanes, lanes.last_lane_steps
    )
    return counts


def count_pairs(tokens: np.ndarray, contexts: np.ndarray | None, context_count: int, alphabet: int) -> np.ndarray:
    """Count pairs of successive tokens; see `rans_lanes.count_pairs`."""
    counts = np.zeros((context_count, alphabet, alphabet), np.int64)
    _count_pairs(counts, tokens, _NO_CONTEXTS if contexts is None else contexts)
    return counts


def encode_lanes(
    tokens: np.ndarray, selector: ModelSelector, lanes: LaneLayout, segments: Sequence[tuple[int, int, np.ndarray]]
) -> tuple[np.ndarray, np.ndarray]:
    """Encode all tokens; see `rans_lanes.encode_lanes`."""
    states = np.full(lanes.used_lanes, START_STATE, np.uint32)
    words = np.empty(lanes.count, np.uint16)  # Each token emits at most one word. Unused pages take no memory.
    position = lanes.count
    for start, stop, frequencies in reversed(segments):
        bases = np.cumsum(frequencies, axis=1) - frequencies
        packed = (frequencies << SCALE_BITS | bases).astype(np.uint32)
        position = _encode(
            tokens, *_selection(selector), states, words, position, packed, start, stop,
            lanes.steps, lanes.used_lanes, lanes.last_lane_steps,
        )  # fmt: skip
    return states, words[position:]


class LaneDecoder(rans_lanes.LaneDecoder):
    """Decoder of the lanes of a stream; see `rans_lanes.LaneDecoder`."""

    def __init__(self, selector: ModelSelector, lanes: LaneLayout, states: np.ndarray, words: np.ndarray) -> None:
        # A step reads at most one word per lane. With as many spare words, one check per step is enough.
        super().__init__(selector, lanes, states, np.append(words, np.zeros(lanes.used_lanes, np.uint16)))

    def run(self, start: int, stop: int, frequencies: np.ndarray) -> None:
        lanes, table = self._lanes, _decoding_table(frequencies)
        self._position = _decode(
            self.tokens, *_selection(self._selector), self._states, self._words, self._position, table, start, stop,
            lanes.steps, lanes.used_lanes, lanes.last_lane_steps,
        )  # fmt: skip
        if self._position > len(self._words) - lanes.used_lanes:
            raise DamagedDataError("rANS stream: it ends before its last symbol; it is truncated")


def _selection(selector: ModelSelector) -> tuple[np.ndarray, np.ndarray, int]:
    """Return contexts, class of each token and number of classes, as the kernels take them."""
    return _NO_CONTEXTS if selector.contexts is None else selector.contexts, selector.class_by_token, selector.classes


@njit
def _count_tokens(counts, tokens, contexts, class_by_token, classes, start, stop, steps, used_lanes, last_lane_steps):
    has_contexts, has_classes = len(contexts) > 0, classes > 1
    for lane in range(used_lanes):
        for step in range(start, min(stop, last_lane_steps if lane == used_lanes - 1 else steps)):
            i = np.uint64(lane * steps + step)
            model = np.uint64(contexts[i]) * np.uint64(classes) if has_contexts else _ZERO
            if has_classes and step > 0:
                model += np.uint64(class_by_token[np.uint64(tokens[i - _ONE])])
            counts[model, np.uint64(tokens[i])] += 1


@njit
def _count_pairs(counts, tokens, contexts):
    before, has_contexts = _ZERO, len(contexts) > 0
    for i in range(len(tokens)):
        token, context = np.uint64(tokens[np.uint64(i)]), _ZERO
        if has_contexts:
            context = np.uint64(contexts[np.uint64(i)])
        counts[context, before, token] += 1
        before = token


@njit
def _encode(
    tokens, contexts, class_by_token, classes, states, words,
    position, packed, start, stop, steps, used_lanes, last_lane_steps,
):  # fmt: skip
    has_contexts, has_classes = len(contexts) > 0, classes > 1
    for step in range(stop - 1, start - 1, -1):
        for lane in range(used_lanes - (step >= last_lane_steps) - 1, -1, -1):
            i = np.uint64(lane * steps + step)
            model = np.uint64(contexts[i]) * np.uint64(classes) if has_contexts else _ZERO
            if has_classes and step > 0:
                model += np.uint64(class_by_token[np.uint64(tokens[i - _ONE])])
            entry = packed[model, np.uint64(tokens[i])]
            x, f = states[np.uint64(lane)], entry >> _SCALE_BITS
            if x >> _FLUSH_SHIFT >= f:
                position -= 1
                words[np.uint64(position)] = np.uint16(x)
                x >>= _WORD_BITS
            states[np.uint64(lane)] = x + x // f * (_FREQUENCY_TOTAL - f) + (entry & _OFFSET_MASK)
    return position


@njit
def _decode(
    tokens, contexts, class_by_token, classes, states, words,
    position, table, start, stop, steps, used_lanes, last_lane_steps,
):  # fmt: skip
    has_contexts, has_classes = len(contexts) > 0, classes > 1
    end, position = np.uint64(len(words) - used_lanes), np.uint64(position)
    for step in range(start, stop):
        for lane in range(used_lanes - (step >= last_lane_steps)):
            i = np.uint64(lane) * np.uint64(steps) + np.uint64(step)
            model = np.uint64(contexts[i]) * np.uint64(classes) if has_contexts else _ZERO
            if has_classes and step > 0:
                model += np.uint64(class_by_token[np.uint64(tokens[i - _ONE])])
            x = states[np.uint64(lane)]
            entry = table[model, np.uint64(x & _OFFSET_MASK)]
            x = (x >> _SCALE_BITS) * (entry >> _SCALE_BITS & _FREQUENCY_MASK) + (entry & _OFFSET_MASK)
            tokens[i] = np.uint8(entry >> _TOKEN_SHIFT)
            low, word = x < _START_STATE, np.uint32(words[position])
            states[np.uint64(lane)] = x << _WORD_BITS | word if low else x
            position += np.uint64(low)
        if position > end:
            break
    return np.int64(position)


@njit
def _decoding_table(frequencies):
    """Build the table of `rans_lanes._decoding_table`, in the shape (K, 4096)."""
    models, tokens = frequencies.shape
    table = np.empty((models, FREQUENCY_TOTAL), np.uint32)
    for model in range(models):
        position = _ZERO
        for token in range(tokens):
            f = np.uint32(frequencies[model, token])
            entry = np.uint32(token) << _TOKEN_SHIFT | f << _SCALE_BITS
            for offset in range(f):
                table[model, position] = entry | np.uint32(offset)
                position += _ONE
    return table

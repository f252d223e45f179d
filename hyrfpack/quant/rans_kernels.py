"""The inner loops of the rANS coder in Numba: the same functions, results and errors as in `rans_lanes`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hyrfpack.parallel.compiled import compiled
from hyrfpack.quant import rans_lanes
from hyrfpack.quant.errors import DamagedDataError
from hyrfpack.quant.rans_lanes import START, Lanes, Selector
from hyrfpack.quant.rans_models import SCALE, SCALE_BITS

njit = compiled(error_model="numpy")

_NO_CONTEXTS = np.zeros(0, np.uint8)
_0, _1 = np.uint64(0), np.uint64(1)
_BITS, _WORD, _TOP, _TOKEN = np.uint32(SCALE_BITS), np.uint32(16), np.uint32(32 - SCALE_BITS), np.uint32(25)
_OFFSET_MASK, _FREQUENCY_MASK = np.uint32(SCALE - 1), np.uint32(2 * SCALE - 1)
_SCALE, _START = np.uint32(SCALE), np.uint32(START)


def count_tokens(
    tokens: np.ndarray, selector: Selector, lanes: Lanes, start: int, stop: int, shape: tuple[int, int]
) -> np.ndarray:
    """As `rans_lanes.count_tokens`."""
    counts = np.zeros(shape, np.int64)
    _count_tokens(counts, tokens, *_selection(selector), start, stop, lanes.steps, lanes.used, lanes.last)
    return counts


def count_pairs(tokens: np.ndarray, contexts: np.ndarray | None, context_count: int, alphabet: int) -> np.ndarray:
    """As `rans_lanes.count_pairs`."""
    counts = np.zeros((context_count, alphabet, alphabet), np.int64)
    _count_pairs(counts, tokens, _NO_CONTEXTS if contexts is None else contexts)
    return counts


def encode_lanes(
    tokens: np.ndarray, selector: Selector, lanes: Lanes, segments: Sequence[tuple[int, int, np.ndarray]]
) -> tuple[np.ndarray, np.ndarray]:
    """As `rans_lanes.encode_lanes`."""
    states = np.full(lanes.used, START, np.uint32)
    words = np.empty(lanes.count, np.uint16)  # a token emits at most one; what stays unused is never touched
    place = lanes.count
    for start, stop, frequencies in reversed(segments):
        bases = np.cumsum(frequencies, axis=1) - frequencies
        packed = (frequencies << SCALE_BITS | bases).astype(np.uint32)
        place = _encode(
            tokens, *_selection(selector), states, words, place, packed, start, stop,
            lanes.steps, lanes.used, lanes.last,
        )  # fmt: skip
    return states, words[place:]


class LaneDecoder(rans_lanes.LaneDecoder):
    """As `rans_lanes.LaneDecoder`."""

    def __init__(self, selector: Selector, lanes: Lanes, states: np.ndarray, words: np.ndarray) -> None:
        # A step reads at most one word a lane: with as many to spare, it is enough to look after each step.
        super().__init__(selector, lanes, states, np.append(words, np.zeros(lanes.used, np.uint16)))

    def run(self, start: int, stop: int, frequencies: np.ndarray) -> None:
        lanes, table = self._lanes, _decoding_table(frequencies)
        self._place = _decode(
            self.tokens, *_selection(self._selector), self._states, self._words, self._place, table, start, stop,
            lanes.steps, lanes.used, lanes.last,
        )  # fmt: skip
        if self._place > len(self._words) - lanes.used:
            raise DamagedDataError("rANS stream: it ends before its last symbol; it is truncated")


def _selection(selector: Selector) -> tuple[np.ndarray, np.ndarray, int]:
    return _NO_CONTEXTS if selector.contexts is None else selector.contexts, selector.class_of, selector.classes


@njit
def _count_tokens(counts, tokens, contexts, class_of, classes, start, stop, steps, used, last):
    has_contexts, has_classes = len(contexts) > 0, classes > 1
    for lane in range(used):
        for step in range(start, min(stop, last if lane == used - 1 else steps)):
            i = np.uint64(lane * steps + step)
            model = np.uint64(contexts[i]) * np.uint64(classes) if has_contexts else _0
            if has_classes and step > 0:
                model += np.uint64(class_of[np.uint64(tokens[i - _1])])
            counts[model, np.uint64(tokens[i])] += 1


@njit
def _count_pairs(counts, tokens, contexts):
    before, has_contexts = _0, len(contexts) > 0
    for i in range(len(tokens)):
        token, context = np.uint64(tokens[np.uint64(i)]), _0
        if has_contexts:
            context = np.uint64(contexts[np.uint64(i)])
        counts[context, before, token] += 1
        before = token


@njit
def _encode(tokens, contexts, class_of, classes, states, words, place, packed, start, stop, steps, used, last):
    has_contexts, has_classes = len(contexts) > 0, classes > 1
    for step in range(stop - 1, start - 1, -1):
        for lane in range(used - (step >= last) - 1, -1, -1):
            i = np.uint64(lane * steps + step)
            model = np.uint64(contexts[i]) * np.uint64(classes) if has_contexts else _0
            if has_classes and step > 0:
                model += np.uint64(class_of[np.uint64(tokens[i - _1])])
            entry = packed[model, np.uint64(tokens[i])]
            x, f = states[np.uint64(lane)], entry >> _BITS
            if x >> _TOP >= f:
                place -= 1
                words[np.uint64(place)] = np.uint16(x)
                x >>= _WORD
            states[np.uint64(lane)] = x + x // f * (_SCALE - f) + (entry & _OFFSET_MASK)
    return place


@njit
def _decode(tokens, contexts, class_of, classes, states, words, place, table, start, stop, steps, used, last):
    has_contexts, has_classes = len(contexts) > 0, classes > 1
    end, place = np.uint64(len(words) - used), np.uint64(place)
    for step in range(start, stop):
        for lane in range(used - (step >= last)):
            i = np.uint64(lane) * np.uint64(steps) + np.uint64(step)
            model = np.uint64(contexts[i]) * np.uint64(classes) if has_contexts else _0
            if has_classes and step > 0:
                model += np.uint64(class_of[np.uint64(tokens[i - _1])])
            x = states[np.uint64(lane)]
            entry = table[model, np.uint64(x & _OFFSET_MASK)]
            x = (x >> _BITS) * (entry >> _BITS & _FREQUENCY_MASK) + (entry & _OFFSET_MASK)
            tokens[i] = np.uint8(entry >> _TOKEN)
            low, word = x < _START, np.uint32(words[place])
            states[np.uint64(lane)] = x << _WORD | word if low else x
            place += np.uint64(low)
        if place > end:
            break
    return np.int64(place)


@njit
def _decoding_table(frequencies):
    """As `rans_lanes._decoding_table`, but (K, 4096)."""
    models, tokens = frequencies.shape
    table = np.empty((models, SCALE), np.uint32)
    for model in range(models):
        place = _0
        for token in range(tokens):
            f = np.uint32(frequencies[model, token])
            entry = np.uint32(token) << _TOKEN | f << _BITS
            for offset in range(f):
                table[model, place] = entry | np.uint32(offset)
                place += _1
    return table

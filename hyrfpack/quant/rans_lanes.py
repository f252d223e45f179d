"""Inner loops of the rANS coder in numpy: one step codes one token of every lane.

`rans_kernels` implements `count_tokens`, `count_pairs`, `encode_lanes` and `LaneDecoder` in Numba.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hyrfpack.quant.errors import DamagedDataError
from hyrfpack.quant.rans_models import FREQUENCY_TOTAL, SCALE_BITS

START_STATE = 1 << 16
"""State of a lane before its last token is coded and after it is decoded; also the lowest state."""

_STEPS_PER_BLOCK = 64
_TOKENS_PER_BLOCK = 1 << 20  # This bounds the memory of `count_pairs`.


class LaneLayout:
    """Assignment of tokens to lanes: lane l codes `steps` consecutive tokens from l * steps on, the last lane fewer.

    Args:
        count: number of tokens, at least 1.
        max_lanes: largest number of lanes, at least 1.

    Attributes:
        count: number of tokens.
        steps: tokens per lane: ceil(count / max_lanes), or one more if that is even. Lanes at a distance of a power of
            two would compete for the same few cache lines.
        used_lanes: number of lanes that have tokens, at most `max_lanes`.
        last_lane_steps: number of tokens in the last used lane.
    """

    def __init__(self, count: int, max_lanes: int) -> None:
        self.count = count
        self.steps = -(-count // max_lanes) | 1
        self.used_lanes = -(-count // self.steps)
        self.last_lane_steps = count - (self.used_lanes - 1) * self.steps

    def active_lanes(self, step: int) -> int:
        """Return the number of lanes that have a token at this step: all, or all but the last."""
        return self.used_lanes - (step >= self.last_lane_steps)

    def load(self, array: np.ndarray, start: int, stop: int, out: np.ndarray) -> None:
        """Copy elements of steps start to stop - 1 into out[step - start, lane]; entries without one stay unchanged."""
        edge = (self.used_lanes - 1) * self.steps
        out[: stop - start, :-1] = array[:edge].reshape(self.used_lanes - 1, self.steps)[:, start:stop].T
        last = array[edge:][start:stop]
        out[: len(last), -1] = last

    def store(self, rows: np.ndarray, start: int, stop: int, array: np.ndarray) -> None:
        """Copy rows[step - start, lane] into the array: the inverse of `load`."""
        edge = (self.used_lanes - 1) * self.steps
        array[:edge].reshape(self.used_lanes - 1, self.steps)[:, start:stop] = rows[: stop - start, :-1].T
        last = array[edge:][start:stop]
        last[:] = rows[: len(last), -1]


@dataclass(frozen=True, eq=False)
class ModelSelector:
    """Selects the model of each token: number `classes * context + class of the previous token in its lane`.

    The class before the first token of a lane is 0.

    Attributes:
        contexts: (M,) uint8, or None for one context.
        class_by_token: (A,) uint8 class of each token.
        classes: number of classes.
    """

    contexts: np.ndarray | None
    class_by_token: np.ndarray
    classes: int

    def load(self, tokens: np.ndarray, lanes: LaneLayout, start: int, stop: int, out: np.ndarray) -> None:
        """Write the models of at most `_STEPS_PER_BLOCK` steps of tokens into out[step - start, lane], int64."""
        if self.contexts is None:
            out[:] = 0
        else:
            lanes.load(self.contexts, start, stop, out)
            np.multiply(out, self.classes, out=out)
        if self.classes > 1:
            before = np.zeros((_STEPS_PER_BLOCK, lanes.used_lanes), np.uint8)
            lanes.load(tokens, max(start - 1, 0), stop - 1, before[start == 0 :])
            out += self.class_by_token.take(before)  # Before the first step this is token 0, whose class is 0.


def count_tokens(
    tokens: np.ndarray, selector: ModelSelector, lanes: LaneLayout, start: int, stop: int, shape: tuple[int, int]
) -> np.ndarray:
    """Count the tokens of the steps start to stop - 1 by model: `shape` (K, A) int64."""
    counts = np.zeros(shape[0] * shape[1], np.int64)
    keys, loaded = np.zeros((2, _STEPS_PER_BLOCK, lanes.used_lanes), np.int64)
    for first in range(start, stop, _STEPS_PER_BLOCK):
        end = min(first + _STEPS_PER_BLOCK, stop)
        selector.load(tokens, lanes, first, end, keys)
        lanes.load(tokens, first, end, loaded)
        np.multiply(keys, shape[1], out=keys)
        np.add(keys, loaded, out=keys)
        last = min(max(lanes.last_lane_steps - first, 0), end - first)
        counts += np.bincount(keys[: end - first, :-1].ravel(), minlength=len(counts))
        counts += np.bincount(keys[:last, -1], minlength=len(counts))
    return counts.reshape(shape)


def count_pairs(tokens: np.ndarray, contexts: np.ndarray | None, context_count: int, alphabet: int) -> np.ndarray:
    """Count pairs of successive tokens: (contexts, previous token, token) int64.

    The token before the first one counts as 0.
    """
    size = context_count * alphabet**2
    counts = np.zeros(size, np.int64)
    before = np.append(np.uint8(0), tokens[:-1])
    for first in range(0, len(tokens), _TOKENS_PER_BLOCK):
        part = slice(first, first + _TOKENS_PER_BLOCK)
        keys = before[part].astype(np.int64)
        if contexts is not None:
            keys += contexts[part].astype(np.int64) * alphabet
        keys *= alphabet
        keys += tokens[part]
        counts += np.bincount(keys, minlength=size)
    return counts.reshape(context_count, alphabet, alphabet)


def encode_lanes(
    tokens: np.ndarray, selector: ModelSelector, lanes: LaneLayout, segments: Sequence[tuple[int, int, np.ndarray]]
) -> tuple[np.ndarray, np.ndarray]:
    """Encode all tokens, from the last step to the first.

    Args:
        tokens: (M,) uint8.
        selector: selects the model of each token.
        lanes: assignment of tokens to lanes.
        segments: ranges of steps (start, stop) with the frequencies (K, A) of the models in them.

    Returns:
        (used_lanes,) uint32 states and the uint16 words, both in the order in which a decoder reads them.
    """
    states = np.full(lanes.used_lanes, START_STATE, np.uint32)
    keys, loaded = np.zeros((2, _STEPS_PER_BLOCK, lanes.used_lanes), np.int64)
    shifted, quotients = np.empty((2, lanes.used_lanes), np.uint32)
    full = np.empty(lanes.used_lanes, bool)
    emitted = []
    for start, stop, frequencies in reversed(segments):
        frequency_of = frequencies.astype(np.uint32).ravel()
        base_of = (np.cumsum(frequencies, axis=1) - frequencies).astype(np.uint32).ravel()
        for first in reversed(range(start, stop, _STEPS_PER_BLOCK)):
            end = min(first + _STEPS_PER_BLOCK, stop)
            selector.load(tokens, lanes, first, end, keys)
            lanes.load(tokens, first, end, loaded)
            np.multiply(keys, frequencies.shape[1], out=keys)
            np.add(keys, loaded, out=keys)
            f, base = frequency_of.take(keys[: end - first]), base_of.take(keys[: end - first])
            complement = np.uint32(FREQUENCY_TOTAL) - f
            for step in reversed(range(first, end)):
                n, row = lanes.active_lanes(step), step - first
                x, step_f, q, high = states[:n], f[row, :n], quotients[:n], shifted[:n]
                np.right_shift(x, np.uint32(32 - SCALE_BITS), out=high)
                lane = np.flatnonzero(np.greater_equal(high, step_f, out=full[:n]))
                if len(lane):
                    flushed = x.take(lane)
                    emitted.append(flushed.astype(np.uint16))
                    x[lane] = flushed >> np.uint32(16)
                np.floor_divide(x, step_f, out=q)
                np.multiply(q, complement[row, :n], out=q)
                np.add(x, q, out=x)
                np.add(x, base[row, :n], out=x)
    return states, np.concatenate([np.zeros(0, np.uint16), *reversed(emitted)])


class LaneDecoder:
    """Decoder of the lanes of a stream.

    Args:
        selector: selects the model of each token.
        lanes: assignment of tokens to lanes.
        states: (used_lanes,) uint32 as stored.
        words: uint16 words that follow the states; more may follow.

    Attributes:
        tokens: (M,) uint8 tokens; those of the steps that have not been decoded are undefined.
    """

    def __init__(self, selector: ModelSelector, lanes: LaneLayout, states: np.ndarray, words: np.ndarray) -> None:
        self.tokens = np.empty(lanes.count, np.uint8)
        self._selector, self._lanes, self._states, self._words, self._position = (
            selector,
            lanes,
            states.copy(),
            words,
            0,
        )

    def run(self, start: int, stop: int, frequencies: np.ndarray) -> None:
        """Decode the steps start to stop - 1 with the given frequencies (K, A).

        Raises:
            DamagedDataError: there are too few words.
        """
        selector, lanes, words = self._selector, self._lanes, self._words
        table = _decoding_table(frequencies)
        class_shift = selector.class_by_token.astype(np.int64) << SCALE_BITS
        entries = np.zeros((_STEPS_PER_BLOCK, lanes.used_lanes), np.uint32)
        bases = np.zeros((_STEPS_PER_BLOCK, lanes.used_lanes), np.int64)
        before, indices = np.zeros((2, lanes.used_lanes), np.int64)
        frequency, offsets = np.empty((2, lanes.used_lanes), np.uint32)
        low = np.empty(lanes.used_lanes, bool)
        if start and selector.classes > 1:
            previous = np.zeros((1, lanes.used_lanes), np.uint8)
            lanes.load(self.tokens, start - 1, start, previous)
            before[:] = class_shift.take(previous[0])
        offset_mask, frequency_mask = np.uint32(FREQUENCY_TOTAL - 1), np.uint32(2 * FREQUENCY_TOTAL - 1)
        bits = np.uint32(SCALE_BITS)
        for first in range(start, stop, _STEPS_PER_BLOCK):
            end = min(first + _STEPS_PER_BLOCK, stop)
            if selector.contexts is not None:
                lanes.load(selector.contexts, first, end, bases)
                np.multiply(bases, selector.classes << SCALE_BITS, out=bases)
            for step in range(first, end):
                n, row = lanes.active_lanes(step), step - first
                x, index, entry = self._states[:n], indices[:n], entries[row, :n]
                offset, f = offsets[:n], frequency[:n]
                np.bitwise_and(x, offset_mask, out=offset)
                np.add(offset, bases[row, :n], out=index)
                if selector.classes > 1:
                    np.add(index, before[:n], out=index)
                table.take(index, out=entry, mode="clip")
                np.right_shift(entry, bits, out=f)
                np.bitwise_and(f, frequency_mask, out=f)
                np.right_shift(x, bits, out=x)
                np.multiply(x, f, out=x)
                np.bitwise_and(entry, offset_mask, out=offset)
                np.add(x, offset, out=x)
                lane = np.flatnonzero(np.less(x, np.uint32(START_STATE), out=low[:n]))
                if len(lane):
                    read = words[self._position : self._position + len(lane)]
                    if len(read) < len(lane):
                        raise DamagedDataError("rANS stream: it ends before its last symbol; it is truncated")
                    self._position += len(lane)
                    x[lane] = x.take(lane) << np.uint32(16) | read
                if selector.classes > 1:
                    np.right_shift(entry, np.uint32(25), out=index, casting="unsafe")
                    class_shift.take(index, out=before[:n], mode="clip")
            lanes.store((entries[: end - first] >> np.uint32(25)).astype(np.uint8), first, end, self.tokens)

    def finish(self) -> int:
        """Check the final states and return the number of words that were read.

        Raises:
            DamagedDataError: a lane is not in `START_STATE`, in which the encoder began.
        """
        if (self._states != START_STATE).any():
            raise DamagedDataError("rANS stream: its end does not fit its symbols; the data is damaged")
        return self._position


def _decoding_table(frequencies: np.ndarray) -> np.ndarray:
    """Build the decoding table (K * 4096,) uint32, by model and the 12 lowest bits of a state.

    An entry is token << 25 | frequency << 12 | offset.
    """
    models, tokens = frequencies.shape
    bases = np.cumsum(frequencies, axis=1) - frequencies
    entries = np.arange(tokens) << 25 | frequencies << SCALE_BITS
    table = np.repeat((entries - bases).ravel(), frequencies.ravel()).reshape(models, FREQUENCY_TOTAL)
    return (table + np.arange(FREQUENCY_TOTAL)).astype(np.uint32).ravel()

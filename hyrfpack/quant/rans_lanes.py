"""The inner loops of the rANS coder in numpy: one step codes one token of every lane.

`rans_kernels` has `count_tokens`, `count_pairs`, `encode_lanes` and `LaneDecoder` in Numba.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hyrfpack.quant.errors import DamagedDataError
from hyrfpack.quant.rans_models import SCALE, SCALE_BITS

START = 1 << 16
"""State of a lane before its last token is coded and after it is decoded; also the lowest state."""

_ROWS = 64  # steps between two transpositions
_BLOCK = 1 << 20  # tokens whose pairs are counted at once


class Lanes:
    """How `count` tokens are dealt to lanes: lane l has those from l * steps on, `steps` of them, the last lane fewer.

    Args:
        count: tokens, at least 1.
        asked: lanes, at least 1.

    Attributes:
        count: tokens.
        steps: tokens of a lane, ceil(count / asked), or one more if that is even: lanes a power of two apart would all
            compete for the same few lines of a cache.
        used: lanes that have any, at most as many as asked for.
        last: tokens of the last used lane.
    """

    def __init__(self, count: int, asked: int) -> None:
        self.count = count
        self.steps = -(-count // asked) | 1
        self.used = -(-count // self.steps)
        self.last = count - (self.used - 1) * self.steps

    def active(self, step: int) -> int:
        """Lanes that have a token at this step: all, or all but the last."""
        return self.used - (step >= self.last)

    def load(self, array: np.ndarray, start: int, stop: int, out: np.ndarray) -> None:
        """Copy what belongs to some steps into out[step - start, lane]; places without a token keep what they had."""
        edge = (self.used - 1) * self.steps
        out[: stop - start, :-1] = array[:edge].reshape(self.used - 1, self.steps)[:, start:stop].T
        last = array[edge:][start:stop]
        out[: len(last), -1] = last

    def store(self, rows: np.ndarray, start: int, stop: int, array: np.ndarray) -> None:
        """The inverse of `load`."""
        edge = (self.used - 1) * self.steps
        array[:edge].reshape(self.used - 1, self.steps)[:, start:stop] = rows[: stop - start, :-1].T
        last = array[edge:][start:stop]
        last[:] = rows[: len(last), -1]


@dataclass(frozen=True, eq=False)
class Selector:
    """Which model codes a token: number `classes * context + class of the token before in its lane`, 0 for the first.

    Attributes:
        contexts: (M,) uint8, or None for one context.
        class_of: (A,) uint8 class of each token.
        classes: how many classes there are.
    """

    contexts: np.ndarray | None
    class_of: np.ndarray
    classes: int

    def load(self, tokens: np.ndarray, lanes: Lanes, start: int, stop: int, out: np.ndarray) -> None:
        """Write the models of the tokens of some steps, at most `_ROWS`, into out[step - start, lane], int64."""
        if self.contexts is None:
            out[:] = 0
        else:
            lanes.load(self.contexts, start, stop, out)
            np.multiply(out, self.classes, out=out)
        if self.classes > 1:
            before = np.zeros((_ROWS, lanes.used), np.uint8)
            lanes.load(tokens, max(start - 1, 0), stop - 1, before[start == 0 :])
            out += self.class_of.take(before)  # whatever is loaded for a first token belongs to class 0, as a 0 does


def count_tokens(
    tokens: np.ndarray, selector: Selector, lanes: Lanes, start: int, stop: int, shape: tuple[int, int]
) -> np.ndarray:
    """How often each model meets each token in some steps: (K, A) int64."""
    counts = np.zeros(shape[0] * shape[1], np.int64)
    keys, loaded = np.zeros((2, _ROWS, lanes.used), np.int64)
    for first in range(start, stop, _ROWS):
        end = min(first + _ROWS, stop)
        selector.load(tokens, lanes, first, end, keys)
        lanes.load(tokens, first, end, loaded)
        np.multiply(keys, shape[1], out=keys)
        np.add(keys, loaded, out=keys)
        last = min(max(lanes.last - first, 0), end - first)
        counts += np.bincount(keys[: end - first, :-1].ravel(), minlength=len(counts))
        counts += np.bincount(keys[:last, -1], minlength=len(counts))
    return counts.reshape(shape)


def count_pairs(tokens: np.ndarray, contexts: np.ndarray | None, context_count: int, alphabet: int) -> np.ndarray:
    """How often each token follows each other one: (contexts, token before, token) int64; the first follows a 0."""
    size = context_count * alphabet**2
    counts = np.zeros(size, np.int64)
    before = np.append(np.uint8(0), tokens[:-1])
    for first in range(0, len(tokens), _BLOCK):
        part = slice(first, first + _BLOCK)
        keys = before[part].astype(np.int64)
        if contexts is not None:
            keys += contexts[part].astype(np.int64) * alphabet
        keys *= alphabet
        keys += tokens[part]
        counts += np.bincount(keys, minlength=size)
    return counts.reshape(context_count, alphabet, alphabet)


def encode_lanes(
    tokens: np.ndarray, selector: Selector, lanes: Lanes, segments: Sequence[tuple[int, int, np.ndarray]]
) -> tuple[np.ndarray, np.ndarray]:
    """Code all tokens, from the last step to the first.

    Args:
        tokens: (M,) uint8.
        selector: which model codes each.
        lanes: how they are dealt.
        segments: ranges of steps (start, stop) with the frequencies (K, A) that hold there.

    Returns:
        (used,) uint32 states and the uint16 words, both as a decoder reads them.
    """
    states = np.full(lanes.used, START, np.uint32)
    keys, loaded = np.zeros((2, _ROWS, lanes.used), np.int64)
    shifted, quotients = np.empty((2, lanes.used), np.uint32)
    full = np.empty(lanes.used, bool)
    emitted = []
    for start, stop, frequencies in reversed(segments):
        frequency_of = frequencies.astype(np.uint32).ravel()
        base_of = (np.cumsum(frequencies, axis=1) - frequencies).astype(np.uint32).ravel()
        for first in reversed(range(start, stop, _ROWS)):
            end = min(first + _ROWS, stop)
            selector.load(tokens, lanes, first, end, keys)
            lanes.load(tokens, first, end, loaded)
            np.multiply(keys, frequencies.shape[1], out=keys)
            np.add(keys, loaded, out=keys)
            f, base = frequency_of.take(keys[: end - first]), base_of.take(keys[: end - first])
            rest = np.uint32(SCALE) - f
            for step in reversed(range(first, end)):
                n, row = lanes.active(step), step - first
                x, now, q, high = states[:n], f[row, :n], quotients[:n], shifted[:n]
                np.right_shift(x, np.uint32(32 - SCALE_BITS), out=high)
                lane = np.flatnonzero(np.greater_equal(high, now, out=full[:n]))
                if len(lane):
                    flushed = x.take(lane)
                    emitted.append(flushed.astype(np.uint16))
                    x[lane] = flushed >> np.uint32(16)
                np.floor_divide(x, now, out=q)
                np.multiply(q, rest[row, :n], out=q)
                np.add(x, q, out=x)
                np.add(x, base[row, :n], out=x)
    return states, np.concatenate([np.zeros(0, np.uint16), *reversed(emitted)])


class LaneDecoder:
    """Decodes the lanes of a stream, some steps after the other.

    Args:
        selector: which model codes each token.
        lanes: how they are dealt.
        states: (used,) uint32 as stored.
        words: uint16 that follow, and perhaps more.

    Attributes:
        tokens: (M,) uint8, as far as decoded.
    """

    def __init__(self, selector: Selector, lanes: Lanes, states: np.ndarray, words: np.ndarray) -> None:
        self.tokens = np.empty(lanes.count, np.uint8)
        self._selector, self._lanes, self._states, self._words, self._place = selector, lanes, states.copy(), words, 0

    def run(self, start: int, stop: int, frequencies: np.ndarray) -> None:
        """Decode some steps with these frequencies (K, A).

        Raises:
            DamagedDataError: there are not enough words.
        """
        selector, lanes, words = self._selector, self._lanes, self._words
        table = _decoding_table(frequencies)
        class_shift = selector.class_of.astype(np.int64) << SCALE_BITS
        entries = np.zeros((_ROWS, lanes.used), np.uint32)
        bases = np.zeros((_ROWS, lanes.used), np.int64)
        before, indices = np.zeros((2, lanes.used), np.int64)
        frequency, offsets = np.empty((2, lanes.used), np.uint32)
        low = np.empty(lanes.used, bool)
        if start and selector.classes > 1:
            previous = np.zeros((1, lanes.used), np.uint8)
            lanes.load(self.tokens, start - 1, start, previous)
            before[:] = class_shift.take(previous[0])
        offset_mask, frequency_mask, bits = np.uint32(SCALE - 1), np.uint32(2 * SCALE - 1), np.uint32(SCALE_BITS)
        for first in range(start, stop, _ROWS):
            end = min(first + _ROWS, stop)
            if selector.contexts is not None:
                lanes.load(selector.contexts, first, end, bases)
                np.multiply(bases, selector.classes << SCALE_BITS, out=bases)
            for step in range(first, end):
                n, row = lanes.active(step), step - first
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
                lane = np.flatnonzero(np.less(x, np.uint32(START), out=low[:n]))
                if len(lane):
                    read = words[self._place : self._place + len(lane)]
                    if len(read) < len(lane):
                        raise DamagedDataError("rANS stream: it ends before its last symbol; it is truncated")
                    self._place += len(lane)
                    x[lane] = x.take(lane) << np.uint32(16) | read
                if selector.classes > 1:
                    np.right_shift(entry, np.uint32(25), out=index, casting="unsafe")
                    class_shift.take(index, out=before[:n], mode="clip")
            lanes.store((entries[: end - first] >> np.uint32(25)).astype(np.uint8), first, end, self.tokens)

    def finish(self) -> int:
        """Return how many words were read.

        Raises:
            DamagedDataError: a lane is not in the state in which the encoder began.
        """
        if (self._states != START).any():
            raise DamagedDataError("rANS stream: its end does not fit its symbols; the data is damaged")
        return self._place


def _decoding_table(frequencies: np.ndarray) -> np.ndarray:
    """For each model and 12 lowest bits of a state: token << 25 | frequency << 12 | offset; (K * 4096,) uint32."""
    models, tokens = frequencies.shape
    bases = np.cumsum(frequencies, axis=1) - frequencies
    entries = np.arange(tokens) << 25 | frequencies << SCALE_BITS
    table = np.repeat((entries - bases).ravel(), frequencies.ravel()).reshape(models, SCALE)
    return (table + np.arange(SCALE)).astype(np.uint32).ravel()

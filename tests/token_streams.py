"""Reference decoders of token and integer streams from docs/reference/format.md alone, and tokens to encode."""

from __future__ import annotations

import numpy as np

from hyrfpack.quant.integers import MIN_VALUE_BY_TOKEN


def laplace_tokens(count: int, scales: list[float] | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return tokens of Laplace-distributed integers, and the index of each one's scale as its context."""
    rng = np.random.default_rng(count)
    contexts = rng.integers(0, len(scales), count).astype(np.uint8)
    values = np.rint(rng.laplace(scale=np.asarray(scales, float)[contexts])).astype(np.int64)
    folded = np.where(values < 0, -2 * values - 1, 2 * values)
    return (np.searchsorted(MIN_VALUE_BY_TOKEN, folded, side="right") - 1).astype(np.uint8), contexts


def decode_tokens_by_spec(data: bytes, contexts: list[int]) -> tuple[list[int], int]:
    """Decode a token stream; return the tokens and the number of bytes that they took."""
    count = len(contexts)
    if count == 0:
        return [], 0
    size_of_contexts = max(contexts) + 1
    lanes_asked, classes, static = 2 ** (data[0] % 16), data[0] // 16 % 8 + 1, data[0] >= 128
    alphabet = data[1]
    if alphabet == 0:
        return [data[2 + context] for context in contexts], 2 + size_of_contexts
    thresholds = data[2 : 1 + classes]
    place = 1 + classes
    models = size_of_contexts * classes
    if static:
        folded, size = decode_tokens_by_spec(data[place:], [0] * models * alphabet)
        place += size
        frequencies = [
            _normalize_weights([_weight_of_level(q) for q in row])
            for row in _undo_differences(folded, models, alphabet)
        ]
    steps = -(-count // lanes_asked)
    steps += steps % 2 == 0
    lanes = -(-count // steps)
    states = [int.from_bytes(data[place + 4 * lane : place + 4 * lane + 4], "little") for lane in range(lanes)]
    place += 4 * lanes
    tokens: list[int] = [0] * count
    counts = [[0] * alphabet for _ in range(models)]
    update = 0
    for step in range(steps):
        if not static and step == update:
            update += 1 + update // 8
            pooled = [1 + 2 * sum(row[j] for row in counts) for j in range(alphabet)]
            prior = [1048576 * g // sum(pooled) + 1 for g in pooled]
            frequencies = [
                _normalize_weights([65536 * n + p for n, p in zip(row, prior, strict=True)]) for row in counts
            ]
        seen = []
        for lane in range(lanes):
            i = lane * steps + step
            if i >= count:
                break
            model = contexts[i] * classes
            if step > 0:
                model += sum(threshold <= tokens[i - 1] for threshold in thresholds)
            x = states[lane]
            token, base = 0, 0
            while x % 4096 >= base + frequencies[model][token]:
                base += frequencies[model][token]
                token += 1
            x = frequencies[model][token] * (x // 4096) + x % 4096 - base
            if x < 65536:
                x = 65536 * x + int.from_bytes(data[place : place + 2], "little")
                place += 2
            states[lane], tokens[i] = x, token
            seen.append((model, token))
        for model, token in seen:
            counts[model][token] += 1
    assert states == [65536] * lanes
    return tokens, place


def decode_integers_by_spec(data: bytes, contexts: list[int], signed: bool) -> list[int]:
    """Decode a stream of integers."""
    tokens, size = decode_tokens_by_spec(data, contexts)
    bits, values = int.from_bytes(data[size:], "little"), []
    total = 0
    for token in tokens:
        if token < 16:
            head, length = token, 0
        elif token < 28:
            head, length = 4 + token % 4, token // 4 - 2
        else:
            head, length = 2 + token % 2, (token - 14) // 2 - 1
        v = head << length | bits & (1 << length) - 1
        bits >>= length
        total += length
        values.append(unfold(v) if signed else v)
    assert bits == 0
    assert len(data) == size + (total + 7) // 8
    return values


def unfold(v: int) -> int:
    return v // 2 if v % 2 == 0 else -(v + 1) // 2


def _normalize_weights(weights: list[int]) -> list[int]:
    total = sum(weights)
    frequencies = [max(1, 4096 * w // total) if w else 0 for w in weights]
    frequencies[weights.index(max(weights))] += 4096 - sum(frequencies)
    return frequencies


def _weight_of_level(level: int) -> int:
    return (4 + (level - 1) % 4) * 2 ** ((level - 1) // 4) if level else 0


def _undo_differences(folded: list[int], models: int, alphabet: int) -> list[list[int]]:
    rows: list[list[int]] = []
    for model in range(models):
        row: list[int] = []
        for token in range(alphabet):
            difference = unfold(folded[model * alphabet + token])
            row.append(difference + (rows[-1][token] if rows else row[-1] if row else 0))
        rows.append(row)
    return rows

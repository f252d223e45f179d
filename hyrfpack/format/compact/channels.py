"""Channels: one number for each Gaussian, a step for each class, predicted along the list.

The bytes of a channel: float32 mean, u8 weight of the prediction, u32 bytes of the stream, u8 classes, their step
codes, the stream.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hyrfpack.format.compact.quantize import ERROR_PER_BIT, best_steps, bits_of, cheapest, code_bits
from hyrfpack.quant import DamagedDataError
from hyrfpack.quant.integers import decode_integers, encode_integers
from hyrfpack.quant.lifting import lift, unlift
from hyrfpack.quant.steps import ONE, step_of

WEIGHTS = (0, 6, 9, 12)  # of the prediction, in sixteenths, that are tried
FINEST = 32  # step code, 8e-6: with it differences of numbers within the limit stay below 2^30 steps
LIMIT = 4096.0  # of the numbers: sums in fixed point stay far within 64 bits
_SAMPLE = 1 << 16  # numbers that the weight is chosen on
_BLOCK = 1 << 16  # numbers at once: few enough that temporaries stay in the caches
_HEADER = struct.Struct("<fBIB")

# (places, candidate values) -> what each would add to the pictures' mean squared error
ErrorModel = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Channel:
    """A quantised channel.

    Attributes:
        mean: float32, added to every number.
        weight: of the prediction, 0 to 16.
        codes: (K,) uint8, the step code of each class.
        residuals: (N,) int64, differences from the prediction in steps.
        values: (N,) float64, the numbers as they will be decoded.
    """

    mean: np.float32
    weight: int
    codes: np.ndarray
    residuals: np.ndarray
    values: np.ndarray


def quantize_channel(
    values: np.ndarray,
    classes: np.ndarray,
    sensitivity: np.ndarray,
    distortion: float,
    error: ErrorModel | None = None,
    reach: int = 1,
    weight: int | None = None,
) -> Channel:
    """Choose the steps and the symbols of a channel.

    Args:
        values: (N,) float64; cut to +-LIMIT.
        classes: (N,) uint8.
        sensitivity: (N,) s of each number, above 0.
        distortion: D, see `quantize`.
        error: what a candidate would cost; by default s (candidate - value)^2.
        reach: how many steps from the nearest are tried; 0 takes the nearest, without counting bits.
        weight: of the prediction; by default the best of WEIGHTS.
    """
    kinds = int(classes.max(initial=0)) + 1
    members = np.bincount(classes, minlength=kinds)
    mean_sensitivity = np.bincount(classes, sensitivity, kinds) / np.maximum(members, 1)
    codes = np.maximum(best_steps(np.where(members > 0, mean_sensitivity, 1), distortion), FINEST)
    steps = step_of(codes)[classes]
    values = np.clip(values, -LIMIT, LIMIT)
    mean = np.float32(np.average(values, weights=1 / steps)) if len(values) else np.float32(0)
    target = np.rint((values - float(mean)) * ONE).astype(np.int64)
    weight = _best_weight(target, steps) if weight is None else weight

    nearest = _nearest(target, steps)
    residuals, decoded = lift(len(target), weight, steps, nearest)
    if reach:
        bits = code_bits(residuals, classes, kinds, reach)

        def added(places: np.ndarray, candidates: np.ndarray) -> np.ndarray:
            if error is not None:
                return error(places, candidates)
            return sensitivity[places] * (candidates - values[places]) ** 2

        def choose(places: np.ndarray, prediction: np.ndarray) -> np.ndarray:
            step = steps[places]

            def cost(symbols: np.ndarray) -> np.ndarray:
                return added(places, (prediction + symbols * step) / ONE + float(mean))

            return cheapest(nearest(places, prediction), cost, classes[places], bits, distortion, reach)

        def total(symbols: np.ndarray, numbers: np.ndarray) -> float:
            errors = added(np.arange(len(numbers)), numbers / ONE + float(mean))
            return float(errors.sum() + ERROR_PER_BIT * distortion * bits_of(symbols, classes, bits).sum())

        # A number left at its prediction is what others are predicted by: with coarse steps that can cost more.
        chosen = lift(len(target), weight, steps, choose)
        if total(*chosen) < total(residuals, decoded):
            residuals, decoded = chosen
    return Channel(mean, weight, codes, residuals, decoded / ONE + float(mean))


def encode_channel(channel: Channel, classes: np.ndarray) -> bytes:
    """The bytes of a channel."""
    stream = encode_integers(channel.residuals, classes, signed=True)
    header = _HEADER.pack(channel.mean, channel.weight, len(stream), len(channel.codes))
    return header + channel.codes.tobytes() + stream


def decode_channel(data: memoryview, classes: np.ndarray) -> tuple[np.ndarray, memoryview]:
    """The numbers (N,) float64, and the bytes after the channel.

    Raises:
        DamagedDataError: the bytes are truncated, damaged or contradict themselves.
    """
    if len(data) < _HEADER.size:
        raise DamagedDataError(f"a channel's header takes more than the {len(data)} bytes left; it is truncated")
    mean, weight, size, kinds = _HEADER.unpack_from(data)
    start = _HEADER.size + kinds
    if start + size > len(data) or not abs(mean) <= LIMIT or weight > 16 or kinds <= int(classes.max(initial=0)):
        raise DamagedDataError("a channel's header says what cannot be; it is damaged")
    steps = step_of(np.frombuffer(data[_HEADER.size : start], np.uint8))
    residuals = decode_integers(data[start : start + size], len(classes), classes, signed=True)
    # Encoders stay within 2 LIMIT; sums of far larger ones would overflow.
    limits = np.minimum(int(8 * LIMIT * ONE) // steps, 1 << 30).astype(np.int32)
    for first in range(0, len(classes), _BLOCK):
        part, largest = residuals[first : first + _BLOCK], limits[classes[first : first + _BLOCK]]
        if ((part > largest) | (part < -largest)).any():
            raise DamagedDataError(f"a channel holds differences beyond {8 * LIMIT:.0f}; it is damaged")
    numbers = unlift(residuals, weight, steps[classes])
    del residuals
    values = numbers / ONE
    values += mean
    return values, data[start + size :]


def _best_weight(target: np.ndarray, steps: np.ndarray) -> int:
    """The weight with the fewest bits, about, on a run of the numbers."""
    start = max(len(target) - _SAMPLE, 0) // 2
    target, steps = target[start : start + _SAMPLE], steps[start : start + _SAMPLE]
    nearest = _nearest(target, steps)

    def cost(weight: int) -> float:
        return float(np.log2(np.abs(lift(len(target), weight, steps, nearest)[0]) + 0.5).sum())

    return min(WEIGHTS, key=cost)


def _nearest(target: np.ndarray, steps: np.ndarray) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """What `lift` shall choose to come nearest to the target (N,) int64."""

    def nearest(places: np.ndarray, prediction: np.ndarray) -> np.ndarray:
        step = steps[places]
        return (target[places] - prediction + (step >> 1)) // step

    return nearest

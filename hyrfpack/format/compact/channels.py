"""Channels: one number for each Gaussian, a step for each class, predicted along the list.

The bytes of a channel: float32 mean, u8 weight of the prediction, u32 bytes of the stream, u8 classes, their step
codes, the stream.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

from hyrfpack.quant import DamagedDataError
from hyrfpack.quant.integers import decode_integers, encode_integers
from hyrfpack.quant.lifting import unlift
from hyrfpack.quant.steps import ONE, step_of

LIMIT = 4096.0  # of the numbers: sums in fixed point stay far within 64 bits
_BLOCK = 1 << 16  # numbers at once: few enough that temporaries stay in the caches
_HEADER = struct.Struct("<fBIB")


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

"""Coding of channels: one number per Gaussian, one step per class of Gaussians, prediction by `quant.lifting`.

The bytes of a channel are: float32 mean, u8 weight of the prediction, u32 length of the stream in bytes, u8 number of
classes, a u8 step code per class, and the stream.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

from hyrfpack.quant import DamagedDataError
from hyrfpack.quant.integers import decode_integers, encode_integers
from hyrfpack.quant.lifting import MAX_WEIGHT_SIXTEENTHS, inverse_lift
from hyrfpack.quant.steps import FIXED_POINT_ONE, decode_step

MAX_ABS_CHANNEL_VALUE = 4096.0  # keeps fixed-point sums well within 64 bits
_NUMBERS_PER_BLOCK = 1 << 16  # small enough that temporary arrays stay in the caches
BASIS_BYTES = 36  # of three vectors of three float32
_HEADER_STRUCT = struct.Struct("<fBIB")


@dataclass(frozen=True)
class Channel:
    """A quantised channel.

    Attributes:
        mean: float32 that is added to every number.
        weight: weight of the prediction in 16ths, 0 to MAX_WEIGHT_SIXTEENTHS.
        codes: (K,) uint8 step code of each class.
        residuals: (N,) int64 differences from the prediction, in steps.
        values: (N,) float64 numbers as they will be decoded.
    """

    mean: np.float32
    weight: int
    codes: np.ndarray
    residuals: np.ndarray
    values: np.ndarray


def encode_channel(channel: Channel, classes: np.ndarray) -> bytes:
    """Encode a channel as bytes; `classes` (N,) is the class of each Gaussian."""
    stream = encode_integers(channel.residuals, classes, signed=True)
    header = _HEADER_STRUCT.pack(channel.mean, channel.weight, len(stream), len(channel.codes))
    return header + channel.codes.tobytes() + stream


def read_channel_header(data: memoryview) -> tuple[np.float32, int, np.ndarray]:
    """Return mean, weight and step codes from the start of a channel's bytes, which `decode_channel` has checked."""
    mean, weight, _, class_count = _HEADER_STRUCT.unpack_from(data)
    codes = np.frombuffer(data[_HEADER_STRUCT.size : _HEADER_STRUCT.size + class_count], np.uint8)
    return np.float32(mean), weight, codes


def decode_channel(data: memoryview, classes: np.ndarray) -> tuple[np.ndarray, memoryview]:
    """Decode a channel from the start of `data`.

    Args:
        data: the bytes of the channel; more may follow.
        classes: (N,) class of each Gaussian.

    Returns:
        The numbers (N,) float64, and the bytes after the channel.

    Raises:
        DamagedDataError: the bytes are truncated, damaged or inconsistent.
    """
    if len(data) < _HEADER_STRUCT.size:
        raise DamagedDataError(f"a channel's header takes more than the {len(data)} bytes left; it is truncated")
    mean, weight, size, class_count = _HEADER_STRUCT.unpack_from(data)
    start = _HEADER_STRUCT.size + class_count
    if (
        start + size > len(data)
        or not abs(mean) <= MAX_ABS_CHANNEL_VALUE
        or weight > MAX_WEIGHT_SIXTEENTHS
        or class_count <= int(classes.max(initial=0))
    ):
        raise DamagedDataError("a channel's header has impossible values; it is damaged")
    steps = decode_step(np.frombuffer(data[_HEADER_STRUCT.size : start], np.uint8))
    residuals = decode_integers(data[start : start + size], len(classes), classes, signed=True)
    # Encoders stay within 2 MAX_ABS_CHANNEL_VALUE; sums of far larger differences could overflow.
    limits = np.minimum(int(8 * MAX_ABS_CHANNEL_VALUE * FIXED_POINT_ONE) // steps, 1 << 30).astype(np.int32)
    for first in range(0, len(classes), _NUMBERS_PER_BLOCK):
        block = slice(first, first + _NUMBERS_PER_BLOCK)
        part, limit = residuals[block], limits[classes[block]]
        if ((part > limit) | (part < -limit)).any():
            raise DamagedDataError(f"a channel holds differences beyond {8 * MAX_ABS_CHANNEL_VALUE:.0f}; it is damaged")
    numbers = inverse_lift(residuals, weight, steps[classes])
    del residuals
    values = numbers / FIXED_POINT_ONE
    values += mean
    return values, data[start + size :]


def read_basis(data: memoryview) -> np.ndarray:
    """Read the basis (3, 3) float32 in which colours are coded, from BASIS_BYTES bytes.

    Raises:
        DamagedDataError: there are fewer bytes, or they are damaged.
    """
    if len(data) < BASIS_BYTES:
        raise DamagedDataError(f"its {len(data)} bytes are fewer than those of a basis; it is truncated")
    basis = np.frombuffer(data, "<f4").reshape(3, 3)
    if not (np.abs(basis) <= 1 + 2**-10).all():
        raise DamagedDataError("its basis is not orthonormal; it is damaged")
    return basis

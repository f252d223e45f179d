"""Uniform quantisation between the smallest and the largest value."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

import numpy as np

from hyrfpack.quant.errors import DamagedDataError

_PARAMS_STRUCT = struct.Struct("<ffB")


@dataclass(frozen=True)
class MinMaxParams:
    """Parameters that `MinMaxQuantizer.decode` needs besides the codes.

    Attributes:
        minimum, maximum: range of the values; each is exactly a float32.
        bits: bits per code, 1 to 16.
    """

    minimum: float
    maximum: float
    bits: int

    def to_bytes(self) -> bytes:
        """Return nine bytes, little-endian: minimum float32, maximum float32, bits u8."""
        return _PARAMS_STRUCT.pack(self.minimum, self.maximum, self.bits)

    @classmethod
    def from_bytes(cls, data: bytes) -> MinMaxParams:
        """Read parameters that `to_bytes` wrote.

        Raises:
            DamagedDataError: there are not nine bytes, the range is not finite or not ordered, or bits is not in 1 to
                16.
        """
        if len(data) != _PARAMS_STRUCT.size:
            raise DamagedDataError(
                f"min-max parameters: {len(data)} bytes instead of {_PARAMS_STRUCT.size}; the data is damaged"
            )
        params = cls(*_PARAMS_STRUCT.unpack(data))
        if not (-math.inf < params.minimum <= params.maximum < math.inf and 1 <= params.bits <= 16):
            raise DamagedDataError(f"min-max parameters: {params} is not a range; the data is damaged")
        return params


@dataclass(frozen=True)
class MinMaxQuantizer:
    """Uniform quantiser with levels from the minimum to the maximum of an array.

        L = 2^b - 1        q = round(L (v - min) / (max - min))        decoded: ((L - q) min + q max) / L

    The arithmetic is float64, one correctly rounded operation at a time in the order written. Halves are rounded to the
    even code, and decoded levels are rounded to float32 once. So every platform gives the same codes and values.

    Error of a decoded value: at most (max - min) / (2 L), half a step, plus rounding, at most
    2^-23 max(|min|, |max|). Arrays with min = max, and the minimum and the maximum of a float32 array, are exact.

    Attributes:
        bits: b, bits per code, 1 to 16.
    """

    bits: int = 8

    def __post_init__(self) -> None:
        if not 1 <= self.bits <= 16:
            raise ValueError(f"bits must be in 1 to 16, got {self.bits}")

    def encode(self, values: np.ndarray) -> tuple[np.ndarray, MinMaxParams]:
        """Quantise values.

        Args:
            values: floats of any shape, finite and within the range of float32; may be empty.

        Returns:
            Codes 0 to 2^b - 1 of the same shape, uint8 up to 8 bits, else uint16; and the parameters.

        Raises:
            ValueError: a value is not finite as float32.
        """
        levels = np.array(values, np.float64)  # copied, because it is changed in place
        with np.errstate(over="ignore"):
            minimum, maximum = (float(np.float32(f(levels))) if levels.size else 0.0 for f in (np.min, np.max))
        if not (math.isfinite(minimum) and math.isfinite(maximum)):
            raise ValueError("min-max quantisation: a value is NaN or beyond float32; only finite values can be coded")
        max_code = 2**self.bits - 1
        if maximum > minimum:
            levels -= minimum
            levels *= max_code
            levels /= maximum - minimum
            np.rint(levels, out=levels)
            # float64 values may lie a little outside a range rounded to float32.
            np.clip(levels, 0, max_code, out=levels)
        else:
            levels[...] = 0
        return levels.astype(np.uint8 if self.bits <= 8 else np.uint16), MinMaxParams(minimum, maximum, self.bits)

    @staticmethod
    def decode(codes: np.ndarray, params: MinMaxParams) -> np.ndarray:
        """Return the values of codes.

        Args:
            codes: unsigned integers of any shape.
            params: parameters that `encode` returned; their `bits` is used instead of the quantiser's.

        Returns:
            float32 of the same shape.

        Raises:
            DamagedDataError: a code is 2^b or more.
        """
        max_code = 2**params.bits - 1
        if codes.max(initial=0) > max_code:
            raise DamagedDataError(
                f"min-max codes: {codes.max()} has more than {params.bits} bits; the data is damaged"
            )
        levels = np.arange(max_code + 1)
        # Both products are exact in float64. So the ends of the range are exact, even if they are far apart.
        return (((max_code - levels) * params.minimum + levels * params.maximum) / max_code).astype(np.float32)[codes]

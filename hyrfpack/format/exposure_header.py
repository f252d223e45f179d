"""Header of section `EXPO`: an exposure map without its centres. `docs/reference/format.md` specifies its layout.

It is read without numpy, because importing numpy would make `describe_file` slow.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

from hyrfpack.errors import HyrfFormatError

CODEC_EXPOSURE = 9
BYTES_PER_CENTER = 12
# One unit of log gain makes middle grey (0.5) lighter by this many stops of exposure, at a display gamma of 2.2.
STOPS_PER_LOG_GAIN = 2.2 / 2 / math.log(2)
_HEADER_STRUCT = struct.Struct("<B3s20f")
_FLOATS_PER_FIELD = {"lengths": 2, "box": 6, "mean": 3, "limits": 6, "steps": 3}  # in file order


@dataclass(frozen=True)
class ExposureHeader:
    """The fields of an exposure map except its centres, in file order; `hyrfpack.model.ExposureMap` defines them.

    Attributes:
        centers: number of centres that follow the header.
        lengths: (2,) kernel lengths l_x and l_f.
        box: (6,) least corner, then largest corner.
        mean: (3,) log gain of each channel far from all centres.
        limits: (6,) lowest log gains of the three channels, then the highest.
        steps: (3,) unit of the weights of each channel.
    """

    centers: int
    lengths: tuple[float, ...]
    box: tuple[float, ...]
    mean: tuple[float, ...]
    limits: tuple[float, ...]
    steps: tuple[float, ...]

    @property
    def stops(self) -> tuple[float, float]:
        """Return the lowest and the highest exposure of a render in stops, each the mean of the three channels."""
        lowest, highest = (STOPS_PER_LOG_GAIN * sum(part) / 3 for part in (self.limits[:3], self.limits[3:]))
        return lowest, highest

    def to_bytes(self) -> bytes:
        """Return the bytes of the header: the inverse of `read_exposure_header`."""
        return _HEADER_STRUCT.pack(
            self.centers, bytes(3), *self.lengths, *self.box, *self.mean, *self.limits, *self.steps
        )


def read_exposure_header(codec: int, data: bytes | memoryview, raw_length: int) -> tuple[ExposureHeader, memoryview]:
    """Read the header of an exposure map.

    Args:
        codec: codec number of the section.
        data: stored bytes of the section.
        raw_length: bytes that the section declares to decode to.

    Returns:
        The header, and the bytes of the centres, BYTES_PER_CENTER each.

    Raises:
        HyrfFormatError: the codec is unknown, the number of bytes does not fit the number of centres, the reserved
            bytes are not zero, or a number is not finite.
    """
    if codec != CODEC_EXPOSURE:
        raise HyrfFormatError(f"the codec {codec} is unknown", fix="update hyrfpack")
    data = memoryview(data)
    if (
        len(data) < _HEADER_STRUCT.size
        or len(data) != raw_length
        or len(data) != _HEADER_STRUCT.size + data[0] * BYTES_PER_CENTER
    ):
        raise HyrfFormatError(
            f"its {len(data)} bytes do not fit an exposure map of {raw_length} bytes",
            fix="the file is damaged, write it again",
        )
    centers, reserved, *numbers = _HEADER_STRUCT.unpack_from(data)
    if any(reserved):
        raise HyrfFormatError("its reserved bytes are not zero", fix="the file is damaged, write it again")
    if not all(map(math.isfinite, numbers)):
        raise HyrfFormatError("it holds numbers that are not finite", fix="the file is damaged, write it again")
    values = iter(numbers)
    fields = {name: tuple(next(values) for _ in range(count)) for name, count in _FLOATS_PER_FIELD.items()}
    return ExposureHeader(centers, **fields), data[_HEADER_STRUCT.size :]

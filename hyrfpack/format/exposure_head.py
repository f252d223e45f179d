"""The first bytes of section `EXPO`, read without numpy: `describe` needs them fast. Layout: `docs/format.md`."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

from hyrfpack.errors import HyrfFormatError

CODEC_EXPOSURE = 9
CENTER_BYTES = 12
STOPS_PER_LOG_GAIN = 2.2 / 2 / math.log(2)  # by which middle grey becomes lighter, at a display gamma of 2.2
_HEAD = struct.Struct("<B3s20f")
_FLOATS = {"lengths": 2, "box": 6, "mean": 3, "limits": 6, "steps": 3}  # in the order of the bytes


@dataclass(frozen=True)
class ExposureHead:
    """All of an exposure map but its centers, as in `hyrfpack.model.ExposureMap`, in the order of the bytes.

    Attributes:
        centers: how many centers follow.
        lengths: l_x and l_f.
        box: least corner, then largest corner.
        mean: of the three channels, like the following.
        limits: lowest, then highest log gains.
        steps: units of the weights.
    """

    centers: int
    lengths: tuple[float, ...]
    box: tuple[float, ...]
    mean: tuple[float, ...]
    limits: tuple[float, ...]
    steps: tuple[float, ...]

    @property
    def stops(self) -> tuple[float, float]:
        """The lowest and the highest exposure of a render, mean of the three channels, in stops."""
        lowest, highest = (STOPS_PER_LOG_GAIN * sum(part) / 3 for part in (self.limits[:3], self.limits[3:]))
        return lowest, highest

    def to_bytes(self) -> bytes:
        """The inverse of `read_exposure_head`."""
        return _HEAD.pack(self.centers, bytes(3), *self.lengths, *self.box, *self.mean, *self.limits, *self.steps)


def read_exposure_head(codec: int, data: bytes | memoryview, raw_length: int) -> tuple[ExposureHead, memoryview]:
    """Read all of an exposure map but its centers.

    Args:
        codec, data, raw_length: of the section.

    Returns:
        The head, and the bytes of the centers, CENTER_BYTES each.

    Raises:
        HyrfFormatError: the codec is unknown, there are more or fewer bytes than the map has, the reserved bytes are
            not zero, or a number is not finite.
    """
    if codec != CODEC_EXPOSURE:
        raise HyrfFormatError(f"the codec {codec} is unknown; update hyrfpack")
    data = memoryview(data)
    if len(data) < _HEAD.size or len(data) != raw_length or len(data) != _HEAD.size + data[0] * CENTER_BYTES:
        raise HyrfFormatError(
            f"its {len(data)} bytes are no exposure map of {raw_length} bytes; the file is damaged, write it again"
        )
    centers, reserved, *numbers = _HEAD.unpack_from(data)
    if any(reserved):
        raise HyrfFormatError("its reserved bytes are not zero; the file is damaged, write it again")
    if not all(map(math.isfinite, numbers)):
        raise HyrfFormatError("it holds numbers that are not finite; the file is damaged, write it again")
    values = iter(numbers)
    fields = {name: tuple(next(values) for _ in range(count)) for name, count in _FLOATS.items()}
    return ExposureHead(centers, **fields), data[_HEAD.size :]

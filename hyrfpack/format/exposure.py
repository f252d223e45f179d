"""The exposure map of a model <-> the bytes of section `EXPO`. Section codec 9."""

from __future__ import annotations

import struct

import numpy as np

from hyrfpack.errors import HyrfFormatError
from hyrfpack.format.container import Section
from hyrfpack.format.sections import EXPOSURE
from hyrfpack.model.exposure import ExposureMap

CODEC_EXPOSURE = 9
_HEAD = struct.Struct("<B3x20f")
_CENTER = np.dtype([("position", "u1", 3), ("direction", "i1", 3), ("weight", "<i2", 3)])


def exposure_section(exposure: ExposureMap) -> Section:
    """The optional section that holds an exposure map; readers that do not know it show the consistent exposure."""
    numbers = (exposure.lengths, exposure.box, exposure.mean, exposure.limits, exposure.steps)
    centers = np.zeros(len(exposure.positions), _CENTER)
    centers["position"], centers["direction"] = exposure.positions, exposure.directions
    centers["weight"] = exposure.weights
    data = _HEAD.pack(len(centers), *np.concatenate([part.ravel() for part in numbers])) + centers.tobytes()
    return Section(EXPOSURE, CODEC_EXPOSURE, data, len(data), required=False)


def decode_exposure(codec: int, data: memoryview, raw_length: int) -> ExposureMap:
    """Read an exposure map.

    Raises:
        HyrfFormatError: the codec is unknown, there are more or fewer bytes than the map has, or its numbers are out of
            range.
    """
    if codec != CODEC_EXPOSURE:
        raise HyrfFormatError(f"the codec {codec} is unknown; update hyrfpack")
    if len(data) < _HEAD.size or len(data) != raw_length or len(data) != _HEAD.size + data[0] * _CENTER.itemsize:
        raise HyrfFormatError(f"its {len(data)} bytes are no exposure map; the file is damaged, write it again")
    if any(data[1:4]):
        raise HyrfFormatError("its reserved bytes are not zero; the file is damaged, write it again")
    numbers = np.array(_HEAD.unpack_from(data)[1:], np.float32)
    lengths, box, mean, limits, steps = np.split(numbers, [2, 8, 11, 17])
    centers = np.frombuffer(data[_HEAD.size :], _CENTER)
    try:
        return ExposureMap(
            box=box.reshape(2, 3),
            lengths=lengths,
            mean=mean,
            limits=limits.reshape(2, 3),
            steps=steps,
            positions=np.ascontiguousarray(centers["position"]),
            directions=np.ascontiguousarray(centers["direction"]),
            weights=np.ascontiguousarray(centers["weight"]).astype(np.int16),
        )
    except ValueError as error:
        raise HyrfFormatError(f"{error}; the file is damaged, write it again") from error

"""The exposure map of a model <-> the bytes of section `EXPO`. Section codec 9."""

from __future__ import annotations

import numpy as np

from hyrfpack.errors import HyrfFormatError
from hyrfpack.format.container import Section
from hyrfpack.format.exposure_head import CENTER_BYTES, CODEC_EXPOSURE, ExposureHead, read_exposure_head
from hyrfpack.format.sections import EXPOSURE
from hyrfpack.model.exposure import ExposureMap

_CENTER = np.dtype([("position", "u1", 3), ("direction", "i1", 3), ("weight", "<i2", 3)])
assert _CENTER.itemsize == CENTER_BYTES


def exposure_section(exposure: ExposureMap) -> Section:
    """The optional section that holds an exposure map; readers that do not know it show the consistent exposure."""
    centers = np.zeros(len(exposure.positions), _CENTER)
    centers["position"], centers["direction"] = exposure.positions, exposure.directions
    centers["weight"] = exposure.weights
    parts = (exposure.lengths, exposure.box, exposure.mean, exposure.limits, exposure.steps)
    head = ExposureHead(len(centers), *(tuple(part.ravel().tolist()) for part in parts))
    data = head.to_bytes() + centers.tobytes()
    return Section(EXPOSURE, CODEC_EXPOSURE, data, len(data), required=False)


def decode_exposure(codec: int, data: memoryview, raw_length: int) -> ExposureMap:
    """Read an exposure map.

    Raises:
        HyrfFormatError: as `read_exposure_head`, or numbers are out of range.
    """
    head, rest = read_exposure_head(codec, data, raw_length)
    centers = np.frombuffer(rest, _CENTER)
    try:
        return ExposureMap(
            box=np.array(head.box, np.float32).reshape(2, 3),
            lengths=np.array(head.lengths, np.float32),
            mean=np.array(head.mean, np.float32),
            limits=np.array(head.limits, np.float32).reshape(2, 3),
            steps=np.array(head.steps, np.float32),
            positions=np.ascontiguousarray(centers["position"]),
            directions=np.ascontiguousarray(centers["direction"]),
            weights=np.ascontiguousarray(centers["weight"]).astype(np.int16),
        )
    except ValueError as error:
        raise HyrfFormatError(f"{error}; the file is damaged, write it again") from error

"""Encoding of a model's exposure map as section `EXPO` (section codec 9), and back."""

from __future__ import annotations

import numpy as np

from hyrfpack.errors import HyrfFormatError
from hyrfpack.format.container import Section
from hyrfpack.format.exposure_header import BYTES_PER_CENTER, CODEC_EXPOSURE, ExposureHeader, read_exposure_header
from hyrfpack.format.sections import EXPOSURE
from hyrfpack.model.exposure import ExposureMap

_CENTER_DTYPE = np.dtype([("position", "u1", 3), ("direction", "i1", 3), ("weight", "<i2", 3)])
assert _CENTER_DTYPE.itemsize == BYTES_PER_CENTER


def encode_exposure(exposure: ExposureMap) -> Section:
    """Encode an exposure map as an optional section; readers that do not know it show the consistent exposure."""
    centers = np.zeros(len(exposure.positions), _CENTER_DTYPE)
    centers["position"], centers["direction"] = exposure.positions, exposure.directions
    centers["weight"] = exposure.weights
    parts = (exposure.lengths, exposure.box, exposure.mean, exposure.limits, exposure.steps)
    header = ExposureHeader(len(centers), *(tuple(part.ravel().tolist()) for part in parts))
    data = header.to_bytes() + centers.tobytes()
    return Section(EXPOSURE, CODEC_EXPOSURE, data, len(data), required=False)


def decode_exposure(codec: int, data: memoryview, raw_length: int) -> ExposureMap:
    """Decode an exposure map from the bytes of its section.

    Args:
        codec: codec number of the section.
        data: stored bytes of the section.
        raw_length: bytes that the section declares to decode to.

    Raises:
        HyrfFormatError: a number is out of range, or an error of `read_exposure_header`.
    """
    header, center_bytes = read_exposure_header(codec, data, raw_length)
    centers = np.frombuffer(center_bytes, _CENTER_DTYPE)
    try:
        return ExposureMap(
            box=np.array(header.box, np.float32).reshape(2, 3),
            lengths=np.array(header.lengths, np.float32),
            mean=np.array(header.mean, np.float32),
            limits=np.array(header.limits, np.float32).reshape(2, 3),
            steps=np.array(header.steps, np.float32),
            positions=np.ascontiguousarray(centers["position"]),
            directions=np.ascontiguousarray(centers["direction"]),
            weights=np.ascontiguousarray(centers["weight"]).astype(np.int16),
        )
    except ValueError as error:
        raise HyrfFormatError(f"{error}", fix="the file is damaged, write it again") from error

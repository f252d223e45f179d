"""Read arrays of .glb files without hyrfpack, with integers normalised as glTF 2.0 says."""

from __future__ import annotations

import json
import struct

import numpy as np

DTYPES = {5121: "u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


def read_attribute(data: bytes, semantic: str, mesh: int = 0) -> np.ndarray:
    """Return an attribute (N, width) of the first primitive of a mesh; check that its rows are aligned."""
    length = struct.unpack_from("<I", data, 12)[0]
    content = json.loads(data[20 : 20 + length])
    accessor = content["accessors"][content["meshes"][mesh]["primitives"][0]["attributes"][semantic]]
    view = content["bufferViews"][accessor["bufferView"]]
    dtype, width = np.dtype(DTYPES[accessor["componentType"]]), WIDTHS[accessor["type"]]
    assert width * dtype.itemsize % 4 == 0 and view["byteOffset"] % 4 == 0
    start = 28 + length + view["byteOffset"]
    values = np.frombuffer(data, dtype, accessor["count"] * width, start).reshape(-1, width)
    return values / np.iinfo(dtype).max if accessor.get("normalized") else values


def srgb_from_linear(linear: np.ndarray) -> np.ndarray:
    """Convert linear RGB to sRGB, as IEC 61966-2-1 defines it."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)

"""Write binary glTF 2.0 files (.glb): arrays, linear colours, and upright points, lines and triangles.

A file is a header of 12 bytes, a JSON chunk and a binary chunk, which holds one array after the other.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hyrfpack.errors import HyrfDataError
from hyrfpack.rotations import quaternion_from_matrix

GLTF_UP = (0.0, 1.0, 0.0)
POINTS_MODE, LINES_MODE, TRIANGLES_MODE = 0, 1, 4
HEADER_STRUCT = struct.Struct("<4sII")
CHUNK_HEADER_STRUCT = struct.Struct("<II")
JSON_CHUNK_TYPE = 0x4E4F534A
BINARY_CHUNK_TYPE = 0x004E4942
DTYPE_BY_COMPONENT_TYPE = {
    5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, 5125: np.uint32, 5126: np.float32,
}  # fmt: skip
WIDTH_BY_ACCESSOR_TYPE = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_ATTRIBUTES_TARGET, _INDICES_TARGET = 34962, 34963
_MAX_FILE_BYTES = (1 << 32) - 1  # because lengths in the file are uint32
_UNLIT_EXTENSION = "KHR_materials_unlit"  # colours of photos have the light in them already


@dataclass(frozen=True)
class Shape:
    """Points, lines or triangles.

    Attributes:
        name: name of its node and mesh.
        mode: POINTS_MODE, LINES_MODE (two vertices for each line) or TRIANGLES_MODE.
        attributes: maps glTF's names to arrays (N, width) that `pack_arrays` takes; "POSITION" (N, 3) float32 is one.
            With "COLOR_0", linear RGB or RGBA, the shape has a material without light.
        faces: (F, 3) vertices of triangles; None without indices.
    """

    name: str
    mode: int
    attributes: dict[str, np.ndarray]
    faces: np.ndarray | None = None


def encode_shapes(shapes: Sequence[Shape], turn: np.ndarray, origin: np.ndarray) -> bytes:
    """Encode shapes as a .glb file. The same shapes give the same bytes.

    Args:
        shapes: shapes that have at least one vertex each.
        turn, origin: (3, 3) and (3,) of the nodes, which map a position p to turn (p + origin).

    Raises:
        HyrfDataError: the shapes do not fit into 4 GiB.
    """
    arrays: list[np.ndarray] = []
    meshes: list[dict[str, Any]] = []
    for shape in shapes:
        numbers = range(len(arrays), len(arrays) + len(shape.attributes))
        primitive: dict[str, Any] = {
            "attributes": dict(zip(shape.attributes, numbers, strict=True)),
            "mode": shape.mode,
        }
        arrays += shape.attributes.values()
        if "COLOR_0" in shape.attributes:
            primitive["material"] = 0
        if shape.faces is not None:
            primitive["indices"] = len(arrays)
            arrays.append(shape.faces.reshape(-1, 1).astype(np.uint32))
        meshes.append({"name": shape.name, "primitives": [primitive]})
    accessors, views, parts = pack_arrays(arrays)
    for shape, mesh in zip(shapes, meshes, strict=True):
        number = mesh["primitives"][0]["attributes"]["POSITION"]
        accessors[number].update(describe_bounds(shape.attributes["POSITION"]))
    content: dict[str, Any] = {
        "scenes": [{"nodes": list(range(len(shapes)))}],
        "nodes": [
            {"name": shape.name, "mesh": number, **describe_placement(turn, origin)}
            for number, shape in enumerate(shapes)
        ],
        "meshes": meshes,
        "accessors": accessors,
        "bufferViews": views,
    }
    if any("COLOR_0" in shape.attributes for shape in shapes):
        pbr = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
        material = {"pbrMetallicRoughness": pbr, "doubleSided": True, "extensions": {_UNLIT_EXTENSION: {}}}
        content |= {"materials": [material], "extensionsUsed": [_UNLIT_EXTENSION]}
    return pack_glb(content, parts, fix="export a part with `crop`")


def linear_from_srgb(srgb: np.ndarray) -> np.ndarray:
    """Convert sRGB in [0, 1], display-referred, to linear RGB, as glTF defines COLOR_0.

    With 8 bits, linear RGB has bands of dark colours. Store it as float32 where the size allows: trimesh 5.2 and
    MeshLab read 16-bit integers as if they had 8 bits.
    """
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def describe_bounds(positions: np.ndarray) -> dict[str, list[float]]:
    """Return what glTF requires of an accessor of positions (N, 3), N at least 1: the corners of their box."""
    return {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}


def describe_placement(turn: np.ndarray, origin: np.ndarray) -> dict[str, list[float]]:
    """Return the rotation and translation of a node that maps a position p to turn (p + origin)."""
    w, x, y, z = quaternion_from_matrix(turn).tolist()
    translation = {"translation": (turn @ origin).tolist()} if origin.any() else {}
    return {"rotation": [x, y, z, w], **translation}


def pack_arrays(arrays: list[np.ndarray]) -> tuple[list[dict[str, Any]], list[dict[str, Any]], list[bytes]]:
    """Return the accessors, buffer views and bytes of arrays (N, width) whose rows take multiples of 4 bytes.

    Arrays of uint32 are indices of vertices. Those of uint8 and uint16 are marked as normalised.
    """
    accessors, parts, offset = [], [], 0
    views: list[dict[str, Any]] = []
    for values in arrays:
        kind = next(kind for kind, width in WIDTH_BY_ACCESSOR_TYPE.items() if width == values.shape[1])
        component = next(number for number, dtype in DTYPE_BY_COMPONENT_TYPE.items() if dtype == values.dtype)
        accessor = {"bufferView": len(views), "componentType": component, "count": len(values), "type": kind}
        is_indices = values.dtype == np.uint32
        accessors.append({**accessor, "normalized": True} if values.dtype.kind == "u" and not is_indices else accessor)
        parts.append(values.astype(values.dtype.newbyteorder("<"), copy=False).tobytes())
        target = _INDICES_TARGET if is_indices else _ATTRIBUTES_TARGET
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": len(parts[-1]), "target": target})
        offset += len(parts[-1])
    return accessors, views, parts


def pack_glb(content: dict[str, Any], parts: Sequence[bytes], *, fix: str) -> bytes:
    """Pack a .glb file.

    Args:
        content: the JSON without "asset", "scene" and "buffers".
        parts: pieces of the binary chunk, together a multiple of 4 bytes.
        fix: what to do about a file that is too large.

    Raises:
        HyrfDataError: the file would have more than 4 GiB.
    """
    binary = sum(map(len, parts))
    start = {"asset": {"version": "2.0", "generator": "hyrfpack"}}
    whole = {**start, "scene": 0, **content, "buffers": [{"byteLength": binary}]}
    text = json.dumps(whole, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    length = HEADER_STRUCT.size + 2 * CHUNK_HEADER_STRUCT.size + len(text) + binary
    if length > _MAX_FILE_BYTES:
        raise HyrfDataError(f"{length:,} bytes are needed and a .glb file holds {_MAX_FILE_BYTES:,}", fix=fix)
    head = HEADER_STRUCT.pack(b"glTF", 2, length) + CHUNK_HEADER_STRUCT.pack(len(text), JSON_CHUNK_TYPE) + text
    return b"".join((head, CHUNK_HEADER_STRUCT.pack(binary, BINARY_CHUNK_TYPE), *parts))

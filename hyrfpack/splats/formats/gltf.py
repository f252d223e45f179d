"""glTF 2.0 binary files (.glb) with the extension KHR_gaussian_splatting, as Khronos ratified it.

Layout: a header of 12 bytes, a JSON chunk, a binary chunk. One node, one mesh, one primitive of points. Its
attributes lie in the binary chunk one after the other, all N splats of each:

    POSITION                                    float32 x 3   relative to the node's translation
    KHR_gaussian_splatting:ROTATION             float32 x 4   unit quaternion xyzw
    KHR_gaussian_splatting:SCALE                float32 x 3   standard deviations
    KHR_gaussian_splatting:OPACITY              float32       in [0, 1]
    KHR_gaussian_splatting:SH_DEGREE_l_COEF_n   float32 x 3   RGB; n = m + l, Condon-Shortley phase
    COLOR_0                                     uint8 x 4     linear RGB and opacity, for viewers that draw points

Smaller types are allowed for rotation, scale and opacity; they would save 3 % of a file of degree 3. Harmonics,
which are most of it, have to be float32.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Iterator
from operator import index as integer
from typing import Any

import numpy as np

from hyrfpack.errors import HyrfDataError
from hyrfpack.splats.formats.checked import checked_splats
from hyrfpack.splats.formats.hints import NO_HINTS, Hints
from hyrfpack.splats.harmonics import MAX_DEGREE, terms_of
from hyrfpack.splats.placement import local_origin, local_positions, matrices_of, placed, rotation_of, upright_rotation
from hyrfpack.splats.splats import Splats, concatenate, quaternion_of

EXTENSION = "KHR_gaussian_splatting"
GLTF_UP = (0.0, 1.0, 0.0)
_HEADER, _CHUNK = struct.Struct("<4sII"), struct.Struct("<II")
_JSON, _BIN = 0x4E4F534A, 0x004E4942
_POINTS, _VERTICES = 0, 34962  # primitive mode, and the target of buffer views
_TYPES = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, 5126: np.float32}  # by component type
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_MAX_NODES = 10_000
_MIN_BYTES = 16  # of one splat: less, and the file shows the same data again and again
_MAX_BYTES = (1 << 32) - 1  # lengths are uint32


def encode(splats: Splats, hints: Hints = NO_HINTS) -> bytes:
    """Splats as a .glb file.

    The numbers stay in the input's axes and units. The node turns them to glTF's axes, where y is up; where the scene
    lies far from the origin compared to its size, the node's translation carries the distance, so that float32
    positions stay exact to a millionth of the scene's size. Same splats, same bytes.

    Args:
        splats: at least one.
        hints: which way is up in the scene.

    Raises:
        HyrfDataError: there are none, or they do not fit into float32 or into 4 GiB.
    """
    if not len(splats):
        raise HyrfDataError("there is no Gaussian, and glTF has no form for nothing; export at least one")
    origin, turn = local_origin(splats.positions), upright_rotation(hints.up, np.array(GLTF_UP))
    attributes = {"POSITION": local_positions(splats, origin)}
    attributes["COLOR_0"] = linear_colors(splats)
    attributes[f"{EXTENSION}:ROTATION"] = splats.quats[:, [1, 2, 3, 0]]
    attributes[f"{EXTENSION}:SCALE"] = splats.scales
    attributes[f"{EXTENSION}:OPACITY"] = splats.opacities[:, None]
    for term, semantic in enumerate(_harmonics_semantics(splats.degree)):
        attributes[semantic] = splats.harmonics[:, term]

    accessors, views, parts = _packed(list(attributes.values()))
    binary = sum(map(len, parts))
    positions = attributes["POSITION"]
    accessors[0].update(min=positions.min(axis=0).tolist(), max=positions.max(axis=0).tolist())

    w, x, y, z = quaternion_of(turn).tolist()
    node = {"name": "Gaussians", "mesh": 0, "rotation": [x, y, z, w]}
    if origin.any():
        node["translation"] = (turn @ origin).tolist()
    primitive = {
        "attributes": {semantic: number for number, semantic in enumerate(attributes)},
        "mode": _POINTS,
        "extensions": {
            EXTENSION: {
                "kernel": "ellipse",
                "colorSpace": "srgb_rec709_display",
                "projection": "perspective",
                "sortingMethod": "cameraDistance",
            }
        },
    }
    content = {
        "asset": {"version": "2.0", "generator": "hyrfpack"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [{"name": "Gaussians", "primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": binary}],
    }
    text = json.dumps(content, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    length = _HEADER.size + 2 * _CHUNK.size + len(text) + binary
    if length > _MAX_BYTES:
        raise HyrfDataError(
            f"{len(splats):,} Gaussians of degree {splats.degree} come to {length:,} bytes and a .glb file holds "
            f"{_MAX_BYTES:,}; lower `degree`"
        )
    head = _HEADER.pack(b"glTF", 2, length) + _CHUNK.pack(len(text), _JSON) + text
    return b"".join((head, _CHUNK.pack(binary, _BIN), *parts))


def decode(data: bytes, name: str, *, upright: bool = False) -> Splats:
    """The splats in a .glb file: what `encode` wrote, or others in the ratified form, floats or smaller integers.

    All splats of the file's scene, one node after the other, scaled and moved as their nodes say. `antialiased` is
    False: glTF does not say.

    Args:
        data: the file.
        name: what error messages call it.
        upright: give them in glTF's axes, y up. Otherwise they are turned back about the origin by the rotation of the
            first node with splats: for a file of ours that gives the axes and numbers `encode` was given.

    Raises:
        HyrfDataError: the bytes are no such file, are damaged, or need what is not read here (buffers in other
            files, sparse or compressed data, other kernels).
    """
    content, binary = _chunks(data, name)
    try:
        found = list(_nodes_with_splats(content, name))
        if not found:
            raise HyrfDataError(f"{name}: there are no Gaussian splats in it ({EXTENSION}); name another file")
        counts = [integer(_item(content, "accessors", item["attributes"]["POSITION"])["count"]) for _, item in found]
        if sum(max(count, 0) for count in counts) * _MIN_BYTES > len(data):
            raise HyrfDataError(f"{name}: its nodes show the same splats many times; export each once")
        turn = np.eye(3) if upright else rotation_of(found[0][0], name)[1].T
        parts = [
            placed(_read_primitive(content, binary, primitive, name), matrix, turn, name) for matrix, primitive in found
        ]
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError) as error:
        raise HyrfDataError(
            f"{name}: its parts do not fit together ({str(error) or type(error).__name__:.120}); export it again"
        ) from error
    return concatenate(parts)


def _packed(arrays: list[np.ndarray]) -> tuple[list[dict[str, Any]], list[dict[str, Any]], list[bytes]]:
    """Accessors, buffer views and bytes of arrays (N, width), one after the other; integers are normalised."""
    accessors, parts, offset = [], [], 0
    views: list[dict[str, Any]] = []
    for values in arrays:
        kind = next(kind for kind, width in _WIDTHS.items() if width == values.shape[1])
        component = next(number for number, dtype in _TYPES.items() if dtype == values.dtype)
        accessor = {"bufferView": len(views), "componentType": component, "count": len(values), "type": kind}
        accessors.append({**accessor, "normalized": True} if values.dtype.kind == "u" else accessor)
        parts.append(values.astype(values.dtype.newbyteorder("<"), copy=False).tobytes())
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": len(parts[-1]), "target": _VERTICES})
        offset += len(parts[-1])
    return accessors, views, parts


def _harmonics_semantics(degree: int) -> list[str]:
    return [f"{EXTENSION}:SH_DEGREE_{band}_COEF_{n}" for band in range(degree + 1) for n in range(2 * band + 1)]


def linear_colors(splats: Splats) -> np.ndarray:
    """(N, 4) uint8: colours of degree 0 as linear RGB, for that is what glTF's COLOR_0 means, and opacities."""
    srgb = splats.base_colors
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    return np.round(255 * np.column_stack((linear, splats.opacities))).astype(np.uint8)


def _chunks(data: bytes, name: str) -> tuple[dict[str, Any], memoryview]:
    """The parsed JSON and the binary chunk, empty where there is none."""
    if len(data) < _HEADER.size + _CHUNK.size or data[:4] != b"glTF":
        raise HyrfDataError(f"{name}: this is not a .glb file; check the path")
    _, version, length = _HEADER.unpack_from(data)
    if version != 2 or length != len(data):
        raise HyrfDataError(
            f"{name}: it says version {version} and {length:,} bytes, but version 2 is read and it has {len(data):,}; "
            "export it again"
        )
    chunks: dict[int, memoryview] = {}
    offset = _HEADER.size
    while offset < len(data):
        if offset + _CHUNK.size > len(data):
            raise HyrfDataError(f"{name}: it ends within the head of a chunk; the file is damaged")
        size, kind = _CHUNK.unpack_from(data, offset)
        offset += _CHUNK.size
        if offset + size > len(data):
            raise HyrfDataError(f"{name}: a chunk of {size:,} bytes goes past the end; the file is damaged")
        chunks.setdefault(kind, memoryview(data)[offset : offset + size])
        offset += size
    try:
        content = json.loads(bytes(chunks.get(_JSON, memoryview(b""))))
    except (ValueError, RecursionError) as error:
        raise HyrfDataError(f"{name}: its JSON cannot be read ({str(error):.120}); the file is damaged") from error
    if not isinstance(content, dict):
        raise HyrfDataError(f"{name}: its JSON is not an object; the file is damaged")
    return content, chunks.get(_BIN, memoryview(b""))


def _nodes_with_splats(content: dict[str, Any], name: str) -> Iterator[tuple[np.ndarray, dict[str, Any]]]:
    """World transform (4, 4) and primitive of all splats in the default scene, depth first."""
    scene = _item(content, "scenes", content.get("scene", 0))
    waiting = [(number, np.eye(4)) for number in reversed(scene.get("nodes", []))]
    visited: set[int] = set()
    while waiting:
        number, above = waiting.pop()
        if number in visited or len(visited) >= _MAX_NODES:
            raise HyrfDataError(f"{name}: its nodes form no tree, or more than {_MAX_NODES:,}; export it again")
        visited.add(number)
        node = _item(content, "nodes", number)
        matrix = above @ _local_transform(node)
        waiting += [(child, matrix) for child in reversed(node.get("children", []))]
        if "mesh" in node:
            for primitive in _item(content, "meshes", node["mesh"])["primitives"]:
                if EXTENSION in primitive.get("extensions", {}):
                    yield matrix, primitive


def _local_transform(node: dict[str, Any]) -> np.ndarray:
    """(4, 4), column vectors, of a node's matrix or its translation, rotation and scale."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    x, y, z, w = np.array(node.get("rotation", (0, 0, 0, 1)), np.float64)
    quat = np.array([[w, x, y, z]])
    rotation = matrices_of(quat / (math.hypot(*quat[0]) or 1))[0]  # as the norm, but its squares cannot overflow
    matrix = np.eye(4)
    matrix[:3, :3] = rotation * np.array(node.get("scale", (1, 1, 1)), np.float64)
    matrix[:3, 3] = np.array(node.get("translation", (0, 0, 0)), np.float64)
    return matrix


def _read_primitive(content: dict[str, Any], binary: memoryview, primitive: dict[str, Any], name: str) -> Splats:
    extension, attributes = primitive["extensions"][EXTENSION], primitive["attributes"]
    kernel, space = extension.get("kernel"), extension.get("colorSpace")
    if kernel != "ellipse" or space != "srgb_rec709_display" or extension.get("extensions"):
        raise HyrfDataError(
            f"{name}: kernel {kernel!r:.40} in {space!r:.40}, or an extension of them, is not read; export it as "
            "'ellipse' in 'srgb_rec709_display'"
        )

    def read(semantic: str, width: int) -> np.ndarray:
        return _accessor(content, binary, _item(content, "accessors", attributes[semantic]), width, name)

    own = [f"{EXTENSION}:SH_DEGREE_{band}_COEF_0" in attributes for band in range(MAX_DEGREE + 1)]
    degree = own.index(False) - 1 if False in own else MAX_DEGREE
    positions, scales = read("POSITION", 3), read(f"{EXTENSION}:SCALE", 3)
    if (scales < 0).any():
        raise HyrfDataError(
            f"{name}: there are negative scales, for it follows a draft with logarithms; export it again"
        )
    quats, opacities = read(f"{EXTENSION}:ROTATION", 4)[:, [3, 0, 1, 2]], read(f"{EXTENSION}:OPACITY", 1)[:, 0]
    harmonics = np.empty((len(positions), terms_of(degree), 3), np.float32)
    for term, semantic in enumerate(_harmonics_semantics(degree)):
        harmonics[:, term] = read(semantic, 3)
    return checked_splats(name, positions, scales, quats, opacities, harmonics)


def _accessor(content: dict[str, Any], binary: memoryview, accessor: dict, width: int, name: str) -> np.ndarray:
    """(count, width) float32, integers normalised where the accessor says so."""
    if "sparse" in accessor or "bufferView" not in accessor:
        raise HyrfDataError(f"{name}: sparse or absent data is not read; export it plainly")
    view = _item(content, "bufferViews", accessor["bufferView"])
    buffer = _item(content, "buffers", view["buffer"])
    if integer(view["buffer"]) != 0 or "uri" in buffer or view.get("extensions"):
        raise HyrfDataError(f"{name}: only plain data within the .glb file is read; pack it into one file")
    dtype = np.dtype(_TYPES[accessor["componentType"]])
    count, size = integer(accessor["count"]), width * dtype.itemsize
    start, length = integer(view.get("byteOffset", 0)), integer(view["byteLength"])
    offset, stride = integer(accessor.get("byteOffset", 0)), integer(view.get("byteStride", size))
    if _WIDTHS[accessor["type"]] != width:
        raise HyrfDataError(f"{name}: an attribute is {accessor['type']!r:.20}, not of width {width}; export it again")
    within = min(start, length, offset, count) >= 0 and start + length <= len(binary) and stride >= size
    if not within or (count and offset + stride * (count - 1) + size > length):
        raise HyrfDataError(f"{name}: an attribute goes past the end of the data; the file is damaged")
    dtype = dtype.newbyteorder("<")
    values = np.ndarray((count, width), dtype, binary, start + offset, (stride, dtype.itemsize))
    if accessor.get("normalized") is True and dtype.kind in "iu":
        return np.maximum(values / np.float32(np.iinfo(dtype).max), -1).astype(np.float32)
    return values.astype(np.float32)


def _item(content: dict[str, Any], key: str, number: int) -> dict[str, Any]:
    """content[key][number], where a list would also take numbers from its end."""
    if integer(number) < 0:
        raise IndexError(f"{key} {number}")
    return content[key][number]

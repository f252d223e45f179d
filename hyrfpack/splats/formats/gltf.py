"""glTF 2.0 binary files (.glb) with the ratified Khronos extension KHR_gaussian_splatting.

A file is a header of 12 bytes, a JSON chunk and a binary chunk. We write one node with one mesh and one primitive of
points. The binary chunk holds one attribute after the other, each for all N splats:

    POSITION                                    float32 x 3   relative to the node's translation
    KHR_gaussian_splatting:ROTATION             float32 x 4   unit quaternion xyzw
    KHR_gaussian_splatting:SCALE                float32 x 3   standard deviations
    KHR_gaussian_splatting:OPACITY              float32       in [0, 1]
    KHR_gaussian_splatting:SH_DEGREE_l_COEF_n   float32 x 3   RGB; n = m + l, Condon-Shortley phase
    COLOR_0                                     uint8 x 4     linear RGB and opacity, for viewers that draw points

The extension allows smaller types for rotation, scale and opacity. They would save only 3 % of a file of degree 3,
because most of its bytes are harmonics, which have to be float32.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from operator import index as integer
from typing import Any

import numpy as np

from hyrfpack.errors import HyrfDataError
from hyrfpack.ops.harmonics import MAX_DEGREE, num_sh_bases
from hyrfpack.rotations import rotation_matrices
from hyrfpack.splats.formats import spz
from hyrfpack.splats.formats.hints import NO_HINTS, Hints
from hyrfpack.splats.formats.validation import build_valid_splats
from hyrfpack.splats.glb import (
    BINARY_CHUNK_TYPE,
    CHUNK_HEADER_STRUCT,
    DTYPE_BY_COMPONENT_TYPE,
    GLTF_UP,
    HEADER_STRUCT,
    JSON_CHUNK_TYPE,
    POINTS_MODE,
    WIDTH_BY_ACCESSOR_TYPE,
    describe_bounds,
    describe_placement,
    linear_from_srgb,
    pack_arrays,
    pack_glb,
)
from hyrfpack.splats.placement import (
    apply_transform,
    choose_local_origin,
    decompose_similarity,
    subtract_origin,
    upright_rotation,
)
from hyrfpack.splats.splats import Splats, concatenate

SPLATTING_EXTENSION = "KHR_gaussian_splatting"
SPZ_EXTENSION = "KHR_gaussian_splatting_compression_spz_2"
_FLOAT_TYPE, _BYTE_TYPE = 5126, 5121
_MAX_NODES = 10_000
# A file with fewer bytes per splat must refer to the same data repeatedly, and would unpack to far more than its size.
_MIN_BYTES_PER_SPLAT = 16


def encode(splats: Splats, hints: Hints = NO_HINTS) -> bytes:
    """Encode splats as a .glb file.

    The stored numbers keep the input's axes and units. The node's rotation turns them to glTF's axes, where y is up.
    For a scene far from the origin compared to its size, the node's translation holds that distance, so that float32
    positions stay exact to a millionth of the scene's size. The same splats give the same bytes.

    Args:
        splats: at least one splat.
        hints: `up` is used.

    Raises:
        HyrfDataError: there are no splats, or they do not fit into float32 or into 4 GiB.
    """
    return encode_at(splats, choose_local_origin(splats.positions), upright_rotation(hints.up, np.array(GLTF_UP)))


def encode_at(splats: Splats, origin: np.ndarray, turn: np.ndarray) -> bytes:
    """Encode splats relative to `origin` (3,), with a node that moves them back and has the rotation `turn` (3, 3).

    Raises:
        HyrfDataError: there are no splats, or they do not fit into float32 or into 4 GiB.
    """
    _check_not_empty(splats)
    attributes = {"POSITION": subtract_origin(splats, origin)}
    attributes["COLOR_0"] = _encode_linear_colors(splats)
    attributes[f"{SPLATTING_EXTENSION}:ROTATION"] = splats.quats[:, [1, 2, 3, 0]]
    attributes[f"{SPLATTING_EXTENSION}:SCALE"] = splats.scales
    attributes[f"{SPLATTING_EXTENSION}:OPACITY"] = splats.opacities[:, None]
    for term, semantic in enumerate(_list_harmonics_semantics(splats.degree)):
        attributes[semantic] = splats.harmonics[:, term]

    accessors, views, parts = pack_arrays(list(attributes.values()))
    accessors[0].update(describe_bounds(attributes["POSITION"]))
    node = {"name": "Gaussians", "mesh": 0, **describe_placement(turn, origin)}
    return _assemble(list(attributes), node, accessors, views, parts)


def encode_compressed(splats: Splats) -> tuple[bytes, Splats]:
    """Encode splats as a .glb file whose numbers are an SPZ file of version 2, for CesiumJS.

    The extension SPZ_EXTENSION is a draft, and programs that do not know it cannot read the file. Its axes are those of
    SPZ: the splats turned by 180 degrees about x. The node has no transform, and positions are rounded relative to the
    origin.

    Returns:
        The bytes, and the splats as read back, in their own axes.

    Raises:
        HyrfDataError: there are no splats, or they are too far from the origin.
    """
    _check_not_empty(splats)
    positions = (splats.positions * (1, -1, -1)).astype(np.float32)
    vector, count = {"componentType": _FLOAT_TYPE, "type": "VEC3"}, {"count": len(splats)}
    accessors: dict[str, dict[str, Any]] = {
        "POSITION": {**vector, **count, **describe_bounds(positions)},
        "COLOR_0": {"componentType": _BYTE_TYPE, "normalized": True, "type": "VEC4", **count},
        f"{SPLATTING_EXTENSION}:ROTATION": {"componentType": _FLOAT_TYPE, "type": "VEC4", **count},
        f"{SPLATTING_EXTENSION}:SCALE": {**vector, **count},
    }
    for semantic in _list_harmonics_semantics(splats.degree)[1:]:
        accessors[semantic] = {**vector, **count}
    data = spz.encode(splats, Hints(spz_version=spz.VERSION_IN_GLTF))
    views = [{"buffer": 0, "byteLength": len(data)}]
    # CesiumJS needs a matrix, even if it is the identity.
    node = {"name": "Gaussians", "mesh": 0, "matrix": np.eye(4).ravel().tolist()}
    padded = data + bytes(-len(data) % 4)
    compression = {SPZ_EXTENSION: {"bufferView": 0}}
    file = _assemble(list(accessors), node, list(accessors.values()), views, [padded], compression)
    return file, spz.decode(data, "SPZ in glTF")


def _check_not_empty(splats: Splats) -> None:
    if not len(splats):
        raise HyrfDataError("there are no Gaussians, and glTF cannot represent an empty set", fix="export at least one")


def _assemble(
    semantics: list[str],
    node: dict[str, Any],
    accessors: list[dict[str, Any]],
    views: list[dict[str, Any]],
    parts: list[bytes],
    compression: dict[str, Any] | None = None,
) -> bytes:
    """Assemble a .glb file of one primitive.

    Args:
        semantics: the names of its attributes, in the order of `accessors`.
        node: the node of its mesh, number 0.
        accessors, views: accessors and buffer views.
        parts: pieces of the binary chunk.
        compression: an extension of the extension for splats.
    """
    splatting: dict[str, Any] = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    required = {}
    if compression is not None:
        splatting["extensions"] = compression
        required = {"extensionsRequired": [SPLATTING_EXTENSION, *compression]}
    primitive = {
        "attributes": {semantic: number for number, semantic in enumerate(semantics)},
        "mode": POINTS_MODE,
        "extensions": {SPLATTING_EXTENSION: splatting},
    }
    content = {
        "extensionsUsed": [SPLATTING_EXTENSION, *(compression or ())],
        **required,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [{"name": "Gaussians", "primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
    }
    return pack_glb(content, parts, fix="lower `degree`")


def decode(data: bytes, name: str, *, upright: bool = False) -> Splats:
    """Decode a .glb file in the ratified form, with floats or smaller integers, from `encode` or another program.

    The result holds all splats of the file's default scene, one node after the other, transformed by their nodes.
    `antialiased` is False, because glTF does not store it.

    Args:
        data: the file's bytes.
        name: the file's name in error messages.
        upright: return the splats in glTF's axes, with y up. Otherwise they are rotated back about the origin by the
            rotation of the first node with splats. For a file from `encode` that restores the original axes.

    Raises:
        HyrfDataError: the bytes are not such a file, are damaged, or need features that are not supported (buffers in
            other files, sparse or compressed data, other kernels).
    """
    content, binary = _read_chunks(data, name)
    try:
        transformed_primitives = list(_find_splat_primitives(content, name))
        if not transformed_primitives:
            raise HyrfDataError(
                f"{name}: there are no Gaussian splats in it ({SPLATTING_EXTENSION})",
                fix="name another file",
            )
        counts = [
            integer(_get_item(content, "accessors", item["attributes"]["POSITION"])["count"])
            for _, item in transformed_primitives
        ]
        if sum(max(count, 0) for count in counts) * _MIN_BYTES_PER_SPLAT > len(data):
            raise HyrfDataError(f"{name}: its nodes show the same splats many times", fix="export each once")
        last_rotation = np.eye(3) if upright else decompose_similarity(transformed_primitives[0][0], name)[1].T
        parts = [
            apply_transform(_read_primitive(content, binary, primitive, name), matrix, last_rotation, name)
            for matrix, primitive in transformed_primitives
        ]
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError) as error:
        raise HyrfDataError(
            f"{name}: its parts do not fit together ({str(error) or type(error).__name__:.120})",
            fix="export it again",
        ) from error
    return concatenate(parts)


def _list_harmonics_semantics(degree: int) -> list[str]:
    return [
        f"{SPLATTING_EXTENSION}:SH_DEGREE_{band}_COEF_{n}" for band in range(degree + 1) for n in range(2 * band + 1)
    ]


def _encode_linear_colors(splats: Splats) -> np.ndarray:
    """Return the colours of degree 0 as linear RGB, as glTF defines COLOR_0, with the opacities: (N, 4) uint8.

    They are only for programs that do not know the extension. Some of these misread 16-bit integers, and float32 would
    make files of degree 0 a fifth larger.
    """
    return np.round(255 * np.column_stack((linear_from_srgb(splats.base_colors), splats.opacities))).astype(np.uint8)


def _read_chunks(data: bytes, name: str) -> tuple[dict[str, Any], memoryview]:
    """Return the parsed JSON and the binary chunk, which is empty if the file has none."""
    if len(data) < HEADER_STRUCT.size + CHUNK_HEADER_STRUCT.size or data[:4] != b"glTF":
        raise HyrfDataError(f"{name}: this is not a .glb file", fix="check the path")
    _, version, length = HEADER_STRUCT.unpack_from(data)
    if version != 2 or length != len(data):
        raise HyrfDataError(
            f"{name}: it says version {version} and {length:,} bytes, but version 2 is read and it has {len(data):,}",
            fix="export it again",
        )
    chunks: dict[int, memoryview] = {}
    offset = HEADER_STRUCT.size
    while offset < len(data):
        if offset + CHUNK_HEADER_STRUCT.size > len(data):
            raise HyrfDataError(
                f"{name}: it ends within the head of a chunk",
                fix="the file is damaged, export it again",
            )
        size, kind = CHUNK_HEADER_STRUCT.unpack_from(data, offset)
        offset += CHUNK_HEADER_STRUCT.size
        if offset + size > len(data):
            raise HyrfDataError(
                f"{name}: a chunk of {size:,} bytes goes past the end",
                fix="the file is damaged, export it again",
            )
        chunks.setdefault(kind, memoryview(data)[offset : offset + size])
        offset += size
    try:
        content = json.loads(bytes(chunks.get(JSON_CHUNK_TYPE, memoryview(b""))))
    except (ValueError, RecursionError) as error:
        raise HyrfDataError(
            f"{name}: its JSON cannot be read ({str(error):.120})",
            fix="the file is damaged, export it again",
        ) from error
    if not isinstance(content, dict):
        raise HyrfDataError(f"{name}: its JSON is not an object", fix="the file is damaged, export it again")
    return content, chunks.get(BINARY_CHUNK_TYPE, memoryview(b""))


def _find_splat_primitives(content: dict[str, Any], name: str) -> Iterator[tuple[np.ndarray, dict[str, Any]]]:
    """Yield the world transform (4, 4) and the primitive of all splats in the default scene, depth first."""
    scene = _get_item(content, "scenes", content.get("scene", 0))
    pending = [(number, np.eye(4)) for number in reversed(scene.get("nodes", []))]
    visited: set[int] = set()
    while pending:
        number, parent_matrix = pending.pop()
        if number in visited or len(visited) >= _MAX_NODES:
            raise HyrfDataError(f"{name}: its nodes form no tree, or more than {_MAX_NODES:,}", fix="export it again")
        visited.add(number)
        node = _get_item(content, "nodes", number)
        matrix = parent_matrix @ _compute_local_transform(node)
        pending += [(child, matrix) for child in reversed(node.get("children", []))]
        if "mesh" in node:
            for primitive in _get_item(content, "meshes", node["mesh"])["primitives"]:
                if SPLATTING_EXTENSION in primitive.get("extensions", {}):
                    yield matrix, primitive


def _compute_local_transform(node: dict[str, Any]) -> np.ndarray:
    """Return a node's transform (4, 4) for column vectors, from its matrix or its translation, rotation and scale."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    x, y, z, w = np.array(node.get("rotation", (0, 0, 0, 1)), np.float64)
    quat = np.array([[w, x, y, z]])
    rotation = rotation_matrices(quat / (math.hypot(*quat[0]) or 1))[0]  # hypot cannot overflow, unlike squares
    matrix = np.eye(4)
    matrix[:3, :3] = rotation * np.array(node.get("scale", (1, 1, 1)), np.float64)
    matrix[:3, 3] = np.array(node.get("translation", (0, 0, 0)), np.float64)
    return matrix


def _read_primitive(content: dict[str, Any], binary: memoryview, primitive: dict[str, Any], name: str) -> Splats:
    extension, attributes = primitive["extensions"][SPLATTING_EXTENSION], primitive["attributes"]
    kernel, space = extension.get("kernel"), extension.get("colorSpace")
    if kernel != "ellipse" or space != "srgb_rec709_display" or extension.get("extensions"):
        raise HyrfDataError(
            f"{name}: kernel {kernel!r:.40} in {space!r:.40}, or an extension of them, is not read",
            fix="export it as 'ellipse' in 'srgb_rec709_display'",
        )

    def read(semantic: str, width: int) -> np.ndarray:
        return _read_accessor(content, binary, _get_item(content, "accessors", attributes[semantic]), width, name)

    has_degree = [f"{SPLATTING_EXTENSION}:SH_DEGREE_{band}_COEF_0" in attributes for band in range(MAX_DEGREE + 1)]
    degree = has_degree.index(False) - 1 if False in has_degree else MAX_DEGREE
    positions, scales = read("POSITION", 3), read(f"{SPLATTING_EXTENSION}:SCALE", 3)
    if (scales < 0).any():
        raise HyrfDataError(
            f"{name}: the file follows a draft of the format, with negative (logarithmic) scales",
            fix="export it again with a newer program",
        )
    quats, opacities = (
        read(f"{SPLATTING_EXTENSION}:ROTATION", 4)[:, [3, 0, 1, 2]],
        read(f"{SPLATTING_EXTENSION}:OPACITY", 1)[:, 0],
    )
    harmonics = np.empty((len(positions), num_sh_bases(degree), 3), np.float32)
    for term, semantic in enumerate(_list_harmonics_semantics(degree)):
        harmonics[:, term] = read(semantic, 3)
    return build_valid_splats(name, positions, scales, quats, opacities, harmonics)


def _read_accessor(content: dict[str, Any], binary: memoryview, accessor: dict, width: int, name: str) -> np.ndarray:
    """Read an accessor as (count, width) float32; integers are normalised where the accessor says so."""
    if "sparse" in accessor or "bufferView" not in accessor:
        raise HyrfDataError(
            f"{name}: sparse or missing data is not supported",
            fix="export it without sparse accessors",
        )
    view = _get_item(content, "bufferViews", accessor["bufferView"])
    buffer = _get_item(content, "buffers", view["buffer"])
    if integer(view["buffer"]) != 0 or "uri" in buffer or view.get("extensions"):
        raise HyrfDataError(
            f"{name}: only uncompressed data inside the .glb file is supported",
            fix="export it again as one .glb file without compression",
        )
    dtype = np.dtype(DTYPE_BY_COMPONENT_TYPE[accessor["componentType"]])
    count, size = integer(accessor["count"]), width * dtype.itemsize
    start, length = integer(view.get("byteOffset", 0)), integer(view["byteLength"])
    offset, stride = integer(accessor.get("byteOffset", 0)), integer(view.get("byteStride", size))
    if WIDTH_BY_ACCESSOR_TYPE[accessor["type"]] != width:
        raise HyrfDataError(
            f"{name}: an attribute is {accessor['type']!r:.20}, not of width {width}",
            fix="export it again",
        )
    is_view_valid = min(start, length, offset, count) >= 0 and start + length <= len(binary) and stride >= size
    if not is_view_valid or (count and offset + stride * (count - 1) + size > length):
        raise HyrfDataError(
            f"{name}: an attribute goes past the end of the data",
            fix="the file is damaged, export it again",
        )
    dtype = dtype.newbyteorder("<")
    values = np.ndarray((count, width), dtype, binary, start + offset, (stride, dtype.itemsize))
    if accessor.get("normalized") is True and dtype.kind in "iu":
        return np.maximum(values / np.float32(np.iinfo(dtype).max), -1).astype(np.float32)
    return values.astype(np.float32)


def _get_item(content: dict[str, Any], key: str, number: int) -> dict[str, Any]:
    """Return content[key][number], and raise IndexError for negative numbers, which a list would accept."""
    if integer(number) < 0:
        raise IndexError(f"{key} {number}")
    return content[key][number]

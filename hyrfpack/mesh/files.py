"""Files of triangle meshes: glTF, PLY, OBJ and STL."""

from __future__ import annotations

import logging
import math

import numpy as np

from hyrfpack.errors import HyrfDataError
from hyrfpack.mesh.extract import Mesh
from hyrfpack.splats.glb import GLTF_UP, TRIANGLES_MODE, Shape, encode_shapes, linear_from_srgb
from hyrfpack.splats.placement import choose_local_origin, upright_rotation

_LOG = logging.getLogger(__name__)

MAX_STEP_RATIO = 1e-5  # Coarser steps of a .stl, as a ratio of the mesh's size, are reported.


def encode_mesh(mesh: Mesh, extension: str, up: np.ndarray) -> bytes:
    """Encode a mesh in the input's axes and units. The same mesh gives the same bytes.

    - A .glb has linear float32 vertex colours, unit normals, and a material without light. Its node turns the mesh
      upright, and translates it if it lies far from the origin compared to its size. Without colours, it has positions
      alone.
    - A .ply has sRGB vertex colours, and float64 positions where float32 would be too coarse.
    - A .obj has sRGB vertex colours, if there are any, after the positions, which most programs read. Positions
      have as many digits as the mesh's size needs.
    - A .stl has no colours, and float32 positions. A warning says if their steps are coarse, see MAX_STEP_RATIO.

    Args:
        mesh: the mesh.
        extension: "glb", "ply", "obj" or "stl".
        up: (3,) unit vector that points up in the scene, world axes.

    Raises:
        HyrfDataError: positions are beyond float32.
    """
    origin = choose_local_origin(mesh.vertices)
    with np.errstate(over="ignore"):
        local = (mesh.vertices - origin).astype(np.float32)
    if not np.isfinite(local).all():
        raise HyrfDataError("positions are beyond the range of float32", fix="scale the scene down")
    if extension == "glb":
        return _encode_glb(mesh, local, origin, up)
    if extension == "ply":
        return _encode_ply(mesh, local if not origin.any() else mesh.vertices)
    if extension == "obj":
        return _encode_obj(mesh)
    step = np.spacing(np.abs(mesh.vertices).max(initial=0).astype(np.float32))
    if step > MAX_STEP_RATIO * np.ptp(mesh.vertices, axis=0).max(initial=0):
        _LOG.warning(
            f".stl holds float32 positions, which far from the origin are multiples of {step:.2g} units: choose "
            "another format, or move the scene to the origin first"
        )
    return _encode_stl(mesh)


def _encode_glb(mesh: Mesh, local: np.ndarray, origin: np.ndarray, up: np.ndarray) -> bytes:
    attributes = {"POSITION": local}
    if mesh.colors is not None:
        attributes["COLOR_0"] = linear_from_srgb(mesh.colors / 255).astype(np.float32)
        attributes["NORMAL"] = _compute_vertex_normals(mesh, up)
    shape = Shape("mesh", TRIANGLES_MODE, attributes, mesh.faces)
    return encode_shapes([shape], upright_rotation(up, np.array(GLTF_UP)), origin)


def _compute_vertex_normals(mesh: Mesh, up: np.ndarray) -> np.ndarray:
    """Return unit normals (V, 3) float32: means over the triangles of each vertex, weighted by area.

    Where they cancel out, as between triangles of opposite winding, the normal is `up`.
    """
    crosses = _compute_face_crosses(mesh)
    sums = np.column_stack(
        [np.bincount(mesh.faces.ravel(), np.repeat(axis, 3), len(mesh.vertices)) for axis in crosses.T]
    )
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    return np.where(lengths > 0, sums / np.where(lengths > 0, lengths, 1), up).astype(np.float32)


def _compute_face_crosses(mesh: Mesh) -> np.ndarray:
    """Return the normals (F, 3) of the triangles, as long as twice their areas."""
    corners = mesh.vertices[mesh.faces]
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def _encode_ply(mesh: Mesh, positions: np.ndarray) -> bytes:
    assert mesh.colors is not None
    number = "float" if positions.dtype == np.float32 else "double"
    vertices = np.empty(len(positions), [("position", positions.dtype.newbyteorder("<"), 3), ("color", "u1", 3)])
    vertices["position"], vertices["color"] = positions, mesh.colors
    faces = np.empty(len(mesh.faces), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, mesh.faces
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += [f"property {number} {axis}" for axis in "xyz"]
    header += [f"property uchar {channel}" for channel in ("red", "green", "blue")]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    return "\n".join(header).encode() + vertices.tobytes() + faces.tobytes()


def _encode_obj(mesh: Mesh) -> bytes:
    # Nine digits are as fine as float32. Far from the origin, the first of them do not tell positions apart.
    reach, size = (np.abs(mesh.vertices).max(), np.ptp(mesh.vertices, axis=0).max()) if len(mesh.vertices) else (0, 0)
    digits = 9 + math.floor(math.log10(reach / size)) if reach > size > 0 else 9
    number = f".{min(digits, 17)}g"
    lines = [f"v {x:{number}} {y:{number}} {z:{number}}" for x, y, z in mesh.vertices.tolist()]
    if mesh.colors is not None:
        colors = (f" {red:.4f} {green:.4f} {blue:.4f}" for red, green, blue in (mesh.colors / 255).tolist())
        lines = [line + color for line, color in zip(lines, colors, strict=True)]
    lines += [f"f {a} {b} {c}" for a, b, c in (mesh.faces + 1).tolist()]
    return ("\n".join(lines) + "\n").encode()


def _encode_stl(mesh: Mesh) -> bytes:
    corners, normals = mesh.vertices[mesh.faces], _compute_face_crosses(mesh)
    triangles = np.zeros(len(corners), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    triangles["normal"] = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    triangles["corners"] = corners
    return bytes(80) + np.uint32(len(triangles)).tobytes() + triangles.tobytes()

"""Files of triangle meshes: glTF, PLY, OBJ and STL."""

from __future__ import annotations

import logging
import math

import numpy as np

from hyrfpack.errors import HyrfDataError, needs_package
from hyrfpack.mesh.extract import Mesh
from hyrfpack.splats.formats.gltf import GLTF_UP, linear_from_srgb
from hyrfpack.splats.placement import choose_local_origin, upright_rotation

_LOG = logging.getLogger(__name__)

MAX_STEP_RATIO = 1e-5  # Coarser steps of a .stl, as a ratio of the mesh's size, are reported.
_UNLIT_EXTENSION = "KHR_materials_unlit"  # colours of photos have the light in them already


def encode_mesh(mesh: Mesh, extension: str, up: np.ndarray) -> bytes:
    """Encode a mesh in the input's axes and units. The same mesh gives the same bytes.

    - A .glb has linear vertex colours, normals, and a material without light. Its node turns the mesh upright, and
      translates it if it lies far from the origin compared to its size. Without colours, it has positions alone.
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
        HyrfError: trimesh is missing.
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
    with needs_package("writing a mesh as .glb"):
        import trimesh

    node_transform = np.eye(4)
    node_transform[:3, :3] = upright_rotation(up, np.array(GLTF_UP))
    node_transform[:3, 3] = node_transform[:3, :3] @ origin
    scene = trimesh.Scene()
    if mesh.colors is None:
        shape = trimesh.Trimesh(local, mesh.faces, process=False)
        scene.add_geometry(shape, node_name="mesh", geom_name="mesh", transform=node_transform)
        return scene.export(file_type="glb", include_normals=False)
    colors = np.round(255 * linear_from_srgb(mesh.colors / 255)).astype(np.uint8)
    shape = trimesh.Trimesh(local, mesh.faces, vertex_colors=colors, process=False)
    scene.add_geometry(shape, node_name="mesh", geom_name="mesh", transform=node_transform)

    def make_unlit(tree: dict) -> None:
        pbr = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
        tree["materials"] = [{"pbrMetallicRoughness": pbr, "doubleSided": True, "extensions": {_UNLIT_EXTENSION: {}}}]
        tree["extensionsUsed"] = [_UNLIT_EXTENSION]
        tree["meshes"][0]["primitives"][0]["material"] = 0

    return scene.export(file_type="glb", include_normals=True, tree_postprocessor=make_unlit)


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
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    triangles = np.zeros(len(corners), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    triangles["normal"] = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    triangles["corners"] = corners
    return bytes(80) + np.uint32(len(triangles)).tobytes() + triangles.tobytes()

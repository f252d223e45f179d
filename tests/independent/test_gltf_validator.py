"""The glTF validator of Khronos accepts our .glb files."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from independent.clouds import sample_splats
from independent.formats import SPLAT_FORMATS

from hyrfpack.export.points import encode_points
from hyrfpack.mesh import Mesh
from hyrfpack.mesh.files import encode_mesh
from hyrfpack.scene import Camera
from hyrfpack.splats.formats import gltf

SHAPES = ("points", "mesh", "collision")

# The validator does not know KHR_gaussian_splatting and reports these (code, pointer) for it.
EXPECTED_ISSUES = {
    ("UNSUPPORTED_EXTENSION", "/extensionsUsed/0"),
    *(
        ("MESH_PRIMITIVE_INVALID_ATTRIBUTE", f"/meshes/0/primitives/0/attributes/KHR_gaussian_splatting:{name}")
        for name in (
            *("ROTATION", "SCALE", "OPACITY"),
            *(f"SH_DEGREE_{band}_COEF_{term}" for band in range(4) for term in range(2 * band + 1)),
        )
    ),
}


@pytest.fixture(scope="module")
def validator_reports(node, tmp_path_factory: pytest.TempPathFactory) -> list[dict]:
    folder = tmp_path_factory.mktemp("gltf")
    files = [folder / f"{degree}.glb" for degree in range(4)]
    for degree, file in enumerate(files):
        file.write_bytes(SPLAT_FORMATS["glb"].encode(sample_splats(degree)))
    files.append(folder / "compressed.glb")
    files[-1].write_bytes(gltf.encode_compressed(sample_splats(3))[0])
    files += (folder / f"{name}.glb" for name in SHAPES)
    up = np.array([0.0, -1.0, 0.0])
    camera = Camera(64, 48, 60.0, 60.0, 30.0, 25.0, np.eye(3, 4))
    # Two triangles at one place of opposite winding, whose normals cancel out, and one beside them.
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    faces = np.array([[0, 1, 2], [2, 1, 0], [0, 1, 3]])
    mesh = Mesh(vertices, faces, np.full((4, 3), 9, np.uint8), voxel=0.1, truncation=0.3, maps=1)
    files[-3].write_bytes(encode_points(sample_splats(0), [camera], "glb", up))
    files[-2].write_bytes(encode_mesh(mesh, "glb", up))
    files[-1].write_bytes(encode_mesh(replace(mesh, colors=None), "glb", up))
    return node("gltf_validator.mjs", *files)


@pytest.mark.parametrize("degree", range(4))
def test_the_validator_reports_only_the_unsupported_extension(degree, validator_reports):
    issues = validator_reports[degree]["issues"]
    assert not issues["truncated"]
    assert {(issue["code"], issue["pointer"]) for issue in issues["messages"]} <= EXPECTED_ISSUES
    info = validator_reports[degree]["info"]
    assert (info["version"], info["extensionsUsed"], info["totalVertexCount"]) == (
        "2.0",
        ["KHR_gaussian_splatting"],
        300,
    )


def test_the_validator_reports_only_what_cesiumjs_needs_of_compressed_splats(validator_reports):
    issues = {(issue["code"], issue["pointer"]) for issue in validator_reports[4]["issues"]["messages"]}
    assert issues - EXPECTED_ISSUES == {
        ("UNSUPPORTED_EXTENSION", "/extensionsUsed/1"),
        ("UNUSED_OBJECT", "/bufferViews/0"),  # which the unknown extension uses
        ("NODE_MATRIX_DEFAULT", "/nodes/0/matrix"),
    }


@pytest.mark.parametrize("name", SHAPES)
def test_the_validator_reports_nothing_of_points_and_meshes(name, validator_reports):
    issues = validator_reports[5 + SHAPES.index(name)]["issues"]
    assert issues["messages"] == []

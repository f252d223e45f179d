"""Meshes: files that other programs read in the right axes and colours, and requests that are refused."""

from __future__ import annotations

import io
import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from commands import succeeded
from glb_arrays import read_attribute, srgb_from_linear
from scenes import QUIET_CONTEXT, ring, small_model

import hyrfpack
from hyrfpack.cameras.capture import provenance_cameras
from hyrfpack.cameras.paths import Viewpoint
from hyrfpack.errors import HyrfError
from hyrfpack.export.kinds import MESH_FILES
from hyrfpack.format import save_model
from hyrfpack.mesh import Mesh
from hyrfpack.mesh.files import encode_mesh
from tools.safety.train_golden import DEMO_MODEL_FILE

# A tetrahedron; the scene's up is -y, as in most reconstructions.
TETRAHEDRON_MESH = Mesh(
    np.array([[0, 0, 0], [1, 0, 0], [0, -2, 0], [0, 0, 3.0]]),
    np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]),
    np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [188, 188, 188]], np.uint8),
    0.1,
    0.3,
    4,
)
UP = np.array([0.0, -1.0, 0.0])


def read_mesh(data: bytes, extension: str) -> trimesh.Trimesh:
    return trimesh.load_scene(io.BytesIO(data), file_type=extension, process=False).to_mesh()


@pytest.mark.parametrize("extension", [kind.ending.split(".")[-1] for kind in MESH_FILES])
def test_trimesh_reads_positions_in_world_units(extension):
    read = read_mesh(encode_mesh(TETRAHEDRON_MESH, extension, UP), extension)
    corners = np.asarray(read.vertices)[np.asarray(read.faces)]
    expected = TETRAHEDRON_MESH.vertices[TETRAHEDRON_MESH.faces] * ((1, -1, -1) if extension == "glb" else (1, 1, 1))
    np.testing.assert_allclose(corners, expected, atol=1e-6)
    assert read.volume == pytest.approx(1)


def test_a_glb_is_upright_with_linear_colours_and_no_light():
    data = encode_mesh(TETRAHEDRON_MESH, "glb", UP)
    read = read_mesh(data, "glb")
    assert read.vertices[:, 1].max() == pytest.approx(2)  # the corner at y = -2, which is up
    (stored,) = trimesh.load_scene(io.BytesIO(data), file_type="glb", process=False).geometry.values()
    colors = stored.visual.vertex_attributes["color"]
    np.testing.assert_allclose(colors, [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.503] * 3], atol=5e-4)  # 188 is half
    assert b"KHR_materials_unlit" in data


def test_a_glb_tells_all_dark_colours_apart():
    levels = np.arange(256, dtype=np.uint8)
    vertices, faces = np.random.default_rng(0).normal(size=(256, 3)), np.arange(255).reshape(-1, 3)
    grey = replace(TETRAHEDRON_MESH, vertices=vertices, faces=faces, colors=np.repeat(levels[:, None], 3, axis=1))
    colors = read_attribute(encode_mesh(grey, "glb", UP), "COLOR_0")
    np.testing.assert_array_equal(np.round(255 * srgb_from_linear(colors[:, 0])), levels)


def one_triangle(*faces: list[int]) -> Mesh:
    """Return triangles between the vertices (0, 0, 0), (1, 0, 0) and (0, -2, 0)."""
    colors = TETRAHEDRON_MESH.colors
    assert colors is not None
    vertices = TETRAHEDRON_MESH.vertices[:3]
    return replace(TETRAHEDRON_MESH, vertices=vertices, faces=np.array(faces), colors=colors[:3])


def test_a_glb_has_unit_normals_that_point_outward():
    normals = read_attribute(encode_mesh(TETRAHEDRON_MESH, "glb", UP), "NORMAL")
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)
    outward = TETRAHEDRON_MESH.vertices - TETRAHEDRON_MESH.vertices.mean(axis=0)
    assert ((normals * outward).sum(axis=1) > 0).all()
    flat = read_attribute(encode_mesh(one_triangle([0, 1, 2]), "glb", UP), "NORMAL")
    np.testing.assert_allclose(flat, np.tile([0, 0, -1], (3, 1)), atol=1e-6)


@pytest.mark.parametrize("faces", [([0, 1, 2], [2, 1, 0]), ([0, 0, 1], [2, 2, 2])], ids=["opposite", "no area"])
def test_normals_that_cancel_out_point_up(faces):
    normals = read_attribute(encode_mesh(one_triangle(*faces), "glb", UP), "NORMAL")
    np.testing.assert_array_equal(normals, np.tile(UP, (3, 1)))


def test_a_glb_needs_no_other_package(monkeypatch):
    monkeypatch.setitem(sys.modules, "trimesh", None)
    assert encode_mesh(TETRAHEDRON_MESH, "glb", UP)[:4] == b"glTF"


@pytest.mark.parametrize("extension", ["ply", "obj"])
def test_ply_and_obj_have_srgb_colours(extension):
    read = read_mesh(encode_mesh(TETRAHEDRON_MESH, extension, UP), extension)
    np.testing.assert_array_equal(read.visual.vertex_colors[:, :3], TETRAHEDRON_MESH.colors)


@pytest.mark.parametrize("extension", ["glb", "ply", "obj"])
def test_a_mesh_far_from_the_origin_keeps_its_shape(extension):
    shift = np.array([4e6, -3e6, 50.0])
    far = Mesh(TETRAHEDRON_MESH.vertices + shift, *list(vars(TETRAHEDRON_MESH).values())[1:])
    read = read_mesh(encode_mesh(far, extension, UP), extension)
    edges = np.linalg.norm(read.vertices - read.vertices[0], axis=1)
    np.testing.assert_allclose(edges, [0, 1, 2, 3], atol=1e-4)


def test_an_stl_far_from_the_origin_is_reported_as_coarse(caplog):
    for shift in (0, 50):  # at 50 units, the steps are 4e-6 units
        encode_mesh(replace(TETRAHEDRON_MESH, vertices=TETRAHEDRON_MESH.vertices + shift), "stl", UP)
    assert not caplog.messages
    encode_mesh(replace(TETRAHEDRON_MESH, vertices=TETRAHEDRON_MESH.vertices + 5.3e6), "stl", UP)
    assert [message for message in caplog.messages if "multiples of 0.5 units: choose another format" in message]


def test_export_writes_the_surface_of_a_model(tmp_path):
    report = hyrfpack.export_model(DEMO_MODEL_FILE, tmp_path / "demo.mesh.ply")
    mesh = trimesh.load(report.file, process=False)
    assert (len(mesh.vertices), len(mesh.faces)) == (report.vertices, report.faces)
    assert report.faces > 2000 and report.gaussians == 0 and report.voxel > 0
    # The scene stands on the ground z = 0 and no object is higher than 1.34; the sky is not a surface.
    assert -0.3 < np.quantile(mesh.vertices[:, 2], 0.1) < 0.2 and mesh.vertices[:, 2].max() < 1.6
    again = hyrfpack.export_model(DEMO_MODEL_FILE, tmp_path / "again.mesh.ply")
    assert (tmp_path / "again.mesh.ply").read_bytes() == (tmp_path / "demo.mesh.ply").read_bytes()
    assert again.bytes == report.bytes


def test_crop_voxel_and_faces_are_obeyed(tmp_path):
    crop = (-1.5, -1.0, -0.2, 0.0, 0.5, 1.2)
    config = hyrfpack.ExportConfig(crop=crop, voxel=0.04, faces=1500)
    report = hyrfpack.export_model(DEMO_MODEL_FILE, tmp_path / "part.mesh.obj", config)
    mesh = trimesh.load(report.file, process=False)
    assert report.voxel == 0.04 and 1000 < len(mesh.faces) == report.faces <= 1500
    assert (mesh.vertices >= np.array(crop[:3]) - 0.04).all() and (mesh.vertices <= np.array(crop[3:]) + 0.04).all()


def test_faint_gaussians_can_be_left_out(tmp_path):
    with pytest.raises(HyrfError, match="no Gaussian is left"):
        hyrfpack.export_model(DEMO_MODEL_FILE, tmp_path / "x.stl", hyrfpack.ExportConfig(min_opacity=1.0))


def test_a_model_that_shows_no_surface_is_refused(tmp_path):
    cameras = ring(4)
    model = small_model(np.random.default_rng(0).uniform(-0.6, 0.6, (40, 3)), fields=2.0)
    model.gaussians.opacity_logits.data[:] = -40
    kept = {"cameras": provenance_cameras(cameras), "viewpoint": Viewpoint.from_cameras(cameras).to_json()}
    save_model(model, tmp_path / "faint.hyrf", provenance=kept)
    with pytest.raises(HyrfError, match="no camera sees a surface"):
        hyrfpack.export_model(tmp_path / "faint.hyrf", tmp_path / "faint.mesh.ply")
    assert not (tmp_path / "faint.mesh.ply").exists()


@pytest.mark.parametrize("settings", [{"voxel": 0.1}, {"faces": 100}])
def test_settings_of_meshes_are_refused_for_other_files(settings, tmp_path):
    with pytest.raises(HyrfError, match=f"this is not a mesh.*`{next(iter(settings))}`"):
        hyrfpack.export_model(DEMO_MODEL_FILE, tmp_path / "demo.ply", hyrfpack.ExportConfig(**settings))


@pytest.mark.parametrize("settings", [{"voxel": 0.0}, {"voxel": -1.0}, {"faces": 0}])
def test_settings_without_meaning_are_refused(settings):
    with pytest.raises(ValueError, match=next(iter(settings))):
        hyrfpack.ExportConfig(**settings)


@pytest.mark.parametrize("module, faces", [("skimage", None), ("fast_simplification", 100)])
def test_a_missing_package_is_named_with_its_extra(module, faces, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(HyrfError, match=r'pip install "hyrfpack\[mesh\]"'):
        hyrfpack.export_model(DEMO_MODEL_FILE, tmp_path / "demo.stl", hyrfpack.ExportConfig(faces=faces))


# -- closed meshes for physics engines --------------------------------------------------------------------------------


@pytest.mark.usefixtures("quick_distances")
@pytest.mark.parametrize(
    "extension", ["glb", *(pytest.param(extension, marks=pytest.mark.acceptance) for extension in ("obj", "stl"))]
)
def test_a_collision_file_is_closed_upright_and_small(extension, tmp_path):
    path = tmp_path / f"demo.collision.{extension}"
    report = hyrfpack.export_model(DEMO_MODEL_FILE, path, hyrfpack.ExportConfig(faces=600))
    mesh = trimesh.load(path, force="mesh")  # merges vertices at one place, as engines do
    assert mesh.is_watertight and mesh.is_volume and len(mesh.faces) == report.faces <= 650
    assert "color" not in str(mesh.visual.kind) and b"COLOR_0" not in path.read_bytes()
    lowest = mesh.vertices[:, 1 if extension == "glb" else 2].min()
    assert report.wall is not None and -0.6 - report.wall < lowest < 0.2  # the ground of the scene is at 0
    assert report.surface_to_mesh is not None and report.surface_to_mesh[0] < report.wall
    assert report.mesh_to_surface is not None and report.mesh_to_surface[0] < report.wall


@pytest.mark.usefixtures("quick_distances")
def test_the_command_prints_the_distances_of_a_collision_file(tmp_path):
    printed = succeeded("export", DEMO_MODEL_FILE, "-o", tmp_path / "demo.collision.obj").stdout
    assert "surface to mesh" in printed and "mesh to surface" in printed and "the mesh is closed" in printed
    report = json.loads(
        succeeded("export", DEMO_MODEL_FILE, "-o", tmp_path / "b.collision.obj", "--faces", 300, "--json").stdout
    )
    assert 0 < report["faces"] <= 330 and len(report["surface_to_mesh"]) == 2


def test_a_collision_file_of_another_format_is_refused(tmp_path):
    with pytest.raises(HyrfError, match=r"use \.collision\.glb, \.collision\.obj, \.collision\.stl"):
        hyrfpack.export_model(DEMO_MODEL_FILE, tmp_path / "demo.collision.ply")


def test_a_collision_file_needs_the_package_that_reduces_triangles(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "fast_simplification", None)
    with pytest.raises(HyrfError, match=r"needs fast-simplification; run 'pip install \"hyrfpack\[mesh\]\"'"):
        hyrfpack.export_model(DEMO_MODEL_FILE, tmp_path / "demo.collision.glb")


def test_a_mesh_without_numba_is_refused(monkeypatch, tmp_path):
    monkeypatch.setattr("hyrfpack.export.pipeline.has_numba", lambda: False)
    with pytest.raises(HyrfError, match=r"x.obj: meshes are extracted by Numba.*'hyrfpack doctor'"):
        hyrfpack.export_model(DEMO_MODEL_FILE, tmp_path / "x.obj", context=QUIET_CONTEXT)


@pytest.mark.integration
def test_other_exports_do_without_numba(tmp_path):
    script = (
        "import sys; sys.modules['numba'] = None\n"  # so that importing it fails
        "import hyrfpack\n"
        "hyrfpack.export_model(*sys.argv[1:], context=hyrfpack.RunContext(progress=None))\n"
    )
    target = tmp_path / "x.points.ply"
    subprocess.run([sys.executable, "-c", script, str(DEMO_MODEL_FILE), str(target)], check=True)
    assert target.stat().st_size > 0

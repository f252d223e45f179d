"""Exports of merged files hold all parts where they were placed, in the axes and units of the world."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from exposures import random_map
from scenes import ball_points, camera_at, ring, small_model
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import hyrfpack
from hyrfpack.cameras.capture import provenance_cameras
from hyrfpack.cameras.files import cameras_from_json
from hyrfpack.cameras.paths import Viewpoint
from hyrfpack.config.edit import Rotate, Scale, Translate
from hyrfpack.edit import merge_models
from hyrfpack.evaluate.metrics import psnr
from hyrfpack.export.bake import bake
from hyrfpack.format import load_merged_model, load_model, save_model
from hyrfpack.ops.harmonics import harmonics_basis
from hyrfpack.render import render_view
from hyrfpack.scene import Camera
from hyrfpack.splats.draw import Drawable, draw
from hyrfpack.splats.splats import Splats
from hyrfpack.splats.table import FORMATS
from hyrfpack.web.html import decode_splats_page

CAMERAS = ring(8)
# How the second model is placed: turned about two axes, scaled and moved.
PART_SCALE, PART_OFFSET = 0.6, np.array([0.9, -0.4, 0.2])
PART_ROTATION = Rotation.from_rotvec([0, 0, np.radians(70)]) * Rotation.from_rotvec([np.radians(-35), 0, 0])
PART_MOVES = [Rotate((1, 0, 0), -35), Rotate((0, 0, 1), 70), Scale(PART_SCALE), Translate(tuple(PART_OFFSET))]
POSITION_TOLERANCES = {".spz": 1e-3, ".sog": 1e-3}
SHAPE_TOLERANCES = {".spz": 0.07}  # logarithms of scales are rounded to 1/16
COLOR_TOLERANCES = {".ply": 2e-5, ".usda": 1e-3, ".usdc": 1e-3, ".usdz": 1e-3, ".glb": 2e-5, ".spz": 0.1, ".sog": 0.1}


def write_model(path: Path, seed: int, *, exposure=None, **settings) -> Path:
    points, colors = ball_points(60, seed)
    settings = {"scale_logits": -2.0, "opacity_logits": 1.0, "fields": 2.0, "direction_encoding": "sh", **settings}
    model = small_model(points, color_logits=torch.from_numpy(colors) * 4 - 2, seed=seed, **settings)
    model.exposure = exposure
    kept = {"cameras": provenance_cameras(CAMERAS), "viewpoint": Viewpoint.from_cameras(CAMERAS).to_json()}
    save_model(model, path, provenance=kept)
    return path


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> tuple[Path, Path, Path]:
    """Return a scene with a background, an object, and both in one file with the object moved."""
    folder = tmp_path_factory.mktemp("models")
    sources = write_model(folder / "room.hyrf", 1, background=True), write_model(folder / "toy.hyrf", 2)
    merge_models(sources, folder / "both.hyrf", {"toy": PART_MOVES})
    return (*sources, folder / "both.hyrf")


def camera_before_the_move(camera: Camera) -> Camera:
    """Return the camera that sees the second model as `camera` sees it after its moves."""
    pose = camera.camera_from_world.copy()
    pose[:3, 3] = (pose[:3, 3] + pose[:3, :3] @ PART_OFFSET) / PART_SCALE
    pose[:3, :3] = pose[:3, :3] @ PART_ROTATION.as_matrix()
    return replace(camera, camera_from_world=pose)


def covariances(splats: Splats) -> np.ndarray:
    axes = Rotation.from_quat(np.roll(splats.quats.astype(np.float64), -1, axis=1)).as_matrix()
    columns = axes * splats.scales.astype(np.float64)[:, None]
    return columns @ columns.transpose(0, 2, 1)


def colors_along(splats: Splats, directions: np.ndarray) -> np.ndarray:
    basis = harmonics_basis(torch.from_numpy(directions), splats.degree).numpy()
    return 0.5 + np.einsum("dk,nkc->ndc", basis, splats.harmonics)


@pytest.mark.parametrize("ending", FORMATS)
def test_exported_splats_are_the_union_of_both_models_placed_in_float64(ending, files, tmp_path):
    splat_format = FORMATS[ending]
    if splat_format.module:
        pytest.importorskip(splat_format.module)
    degree, target = splat_format.max_degree, tmp_path / f"both{ending}"

    everything = hyrfpack.ExportConfig(degree=degree, crop=(-9.0, -9.0, -9.0, 9.0, 9.0, 9.0))  # nothing is measured
    report = hyrfpack.export_model(files[2], target, everything)

    read = splat_format.decode(target.read_bytes(), target.name)
    room, toy = load_model(files[0]), load_model(files[1])
    directions = np.random.default_rng(1).normal(size=(20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    # The object alone, from where the moved cameras see it, and then moved by the definition of its moves.
    first, second = (
        bake(room, CAMERAS, (degree,))[degree],
        bake(toy, [*map(camera_before_the_move, CAMERAS)], (degree,))[degree],
    )
    turn = PART_ROTATION.as_matrix()
    positions = np.concatenate((first.positions, PART_SCALE * second.positions @ turn.T + PART_OFFSET))
    shapes = np.concatenate((covariances(first), PART_SCALE**2 * turn @ covariances(second) @ turn.T))
    colors = np.concatenate((colors_along(first, directions), colors_along(second, directions @ turn)))
    distances, index = cKDTree(read.positions).query(positions)
    assert len(read) == report.gaussians == len(positions) == len(set(index))
    assert distances.max() < POSITION_TOLERANCES.get(ending, 1e-6)
    shape_tolerance = SHAPE_TOLERANCES.get(ending, 0.03) * shapes.max()
    np.testing.assert_allclose(covariances(read)[index], shapes, rtol=0, atol=shape_tolerance)
    color_tolerance = COLOR_TOLERANCES.get(ending, 0.02)
    np.testing.assert_allclose(colors_along(read, directions)[index], colors, rtol=0, atol=color_tolerance)
    assert degree == 0 or np.ptp(colors, axis=1).max() > 0.2  # colours depend on the view


def test_splats_of_a_merged_file_look_like_the_render_of_the_merged_model(files, tmp_path):
    report = hyrfpack.export_model(files[2], tmp_path / "both.ply")

    splats = FORMATS[".ply"].decode((tmp_path / "both.ply").read_bytes(), "both.ply")
    merged = load_merged_model(files[2])
    drawable = Drawable.from_splats(splats, merged.scene.config.frame)
    camera = camera_at((1.5, -2.5, 1.2))
    with torch.no_grad():
        assert psnr(draw(drawable, camera).rgb, render_view(merged, camera).rgb) > 28
    assert report.background > 0 and report.views and report.chosen_by
    assert report.psnr_baked > report.psnr - 0.1 and report.psnr > 25


def test_a_baked_page_of_a_merged_file_holds_the_splats_of_all_parts(files, tmp_path):
    report = hyrfpack.export_model(files[2], tmp_path / "both.html", hyrfpack.ExportConfig(baked=True, degree=1))

    splats, picture = decode_splats_page((tmp_path / "both.html").read_bytes(), "both.html")

    assert len(splats) == report.gaussians == len(load_merged_model(files[2]))
    assert picture is not None and report.psnr > 25


def test_the_exposures_of_all_parts_are_baked(files, tmp_path):
    toy = write_model(tmp_path / "toy.hyrf", 2, exposure=random_map(3, centers=4))
    merge_models([files[0], toy], tmp_path / "both.hyrf", {"toy": PART_MOVES})

    config = hyrfpack.ExportConfig(degree=1, background=False)
    report = hyrfpack.export_model(tmp_path / "both.hyrf", tmp_path / "both.ply", config)

    assert report.exposure == "local"
    assert report.psnr_by_exposure["local"] > report.psnr_by_exposure["consistent"] + 1


def test_points_are_the_centres_of_all_parts_with_the_cameras_of_the_scene(files, tmp_path):
    report = hyrfpack.export_model(files[2], tmp_path / "both.points.ply")

    vertices = trimesh.load(tmp_path / "both.points.ply", process=False).vertices
    room, toy = (np.asarray(load_model(path).gaussians.positions.detach(), np.float64) for path in files[:2])
    expected = np.concatenate((room, PART_SCALE * PART_ROTATION.apply(toy) + PART_OFFSET))
    assert cKDTree(vertices[: report.gaussians]).query(expected)[0].max() < 1e-6
    assert report.gaussians == len(expected) and report.cameras == len(CAMERAS)


def test_cameras_of_a_merged_file_are_those_of_the_scene(files, tmp_path):
    hyrfpack.export_model(files[2], tmp_path / "transforms.json")

    exported = cameras_from_json(tmp_path / "transforms.json")
    for (_, camera), expected in zip(exported, CAMERAS, strict=True):
        np.testing.assert_allclose(camera.camera_from_world, expected.camera_from_world, atol=1e-6)


def test_a_crop_and_a_limit_of_opacity_select_gaussians_of_all_parts(files, tmp_path):
    box = (-0.2, -9.0, -9.0, 1.0, 9.0, 9.0)
    hyrfpack.export_model(files[2], tmp_path / "cut.ply", hyrfpack.ExportConfig(degree=0, crop=box, min_opacity=0.7))

    merged, expected = load_merged_model(files[2]), []
    for part in merged.parts:
        positions = part.config.frame.to_world(part.gaussians.positions.detach().numpy())
        opaque = part.decode_geometry().opacities.detach().numpy() >= 0.7
        expected.append(positions[opaque & ((positions >= box[:3]) & (positions <= box[3:])).all(axis=1)])
    assert all(0 < len(some) < len(part) for some, part in zip(expected, merged.parts, strict=True))
    read = FORMATS[".ply"].decode((tmp_path / "cut.ply").read_bytes(), "cut.ply")
    assert len(read) == sum(map(len, expected))
    assert cKDTree(read.positions).query(np.concatenate(expected))[0].max() < 1e-6


@pytest.fixture(scope="module")
def shells(tmp_path_factory) -> Path:
    """Return a merged file of two dense shells of radius 0.5 and 0.3, two units apart."""
    folder = tmp_path_factory.mktemp("shells")
    points = np.random.default_rng(3).normal(size=(2500, 3))
    points *= 0.5 / np.linalg.norm(points, axis=1, keepdims=True)
    cameras = [camera for height in (-2, 0, 2) for camera in ring(4, 4.0, height, width=64, height=64)]
    kept = {"cameras": provenance_cameras(cameras), "viewpoint": Viewpoint.from_cameras(cameras).to_json()}
    save_model(small_model(points, scale_logits=-3.5, opacity_logits=6.0), folder / "shell.hyrf", provenance=kept)
    moves = {"small": [Scale(0.6), Translate((2.0, 0.0, 0.0))]}
    (folder / "small.hyrf").write_bytes((folder / "shell.hyrf").read_bytes())
    merge_models([folder / "shell.hyrf", folder / "small.hyrf"], folder / "two.hyrf", moves)
    return folder / "two.hyrf"


@pytest.mark.usefixtures("quick_distances")
@pytest.mark.parametrize(
    ("name", "tolerance"),
    [pytest.param("two.mesh.ply", 0.1, marks=pytest.mark.acceptance), ("two.collision.obj", 0.15)],
)
def test_the_mesh_of_a_merged_file_lies_on_the_surfaces_of_all_parts(name, tolerance, shells, tmp_path):
    hyrfpack.export_model(shells, tmp_path / name, hyrfpack.ExportConfig(voxel=0.06))

    vertices = trimesh.load(tmp_path / name, process=False).vertices
    away = [np.linalg.norm(vertices, axis=1) - 0.5, np.linalg.norm(vertices - (2, 0, 0), axis=1) - 0.3]
    for own, other in (away, away[::-1]):
        near = np.abs(own) < np.abs(other)
        assert near.sum() > 30 and np.abs(np.median(own[near])) < tolerance

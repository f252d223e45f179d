"""An export of a rotated model is the rotated export of the model: shapes, colours, background, cameras and meshes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from exposures import map_with_gains
from scenes import camera_at, ring, small_model
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import hyrfpack
from hyrfpack.cameras.capture import provenance_cameras
from hyrfpack.cameras.files import cameras_from_json
from hyrfpack.cameras.paths import Viewpoint
from hyrfpack.cameras.placement import Placement
from hyrfpack.edit.transform import move_model, move_provenance, replace_config
from hyrfpack.export.background import make_background_splats, render_background_picture
from hyrfpack.export.bake import bake
from hyrfpack.format import save_model
from hyrfpack.ops.harmonics import harmonics_basis
from hyrfpack.rotations import IDENTITY
from hyrfpack.splats.splats import Splats
from hyrfpack.splats.table import FORMATS

FACTOR, OFFSET = 1.7, np.array([0.5, -0.3, 0.2])
TURN = Rotation.from_rotvec([0.9, -1.4, 0.6]).as_matrix()
STEP = Placement(FACTOR, TURN, OFFSET)
CAMERAS = ring(8)
# Errors of positions (world units), of covariances (relative to the largest entry) and of colours, by format.
TOLERANCES = {
    ".ply": (1e-6, 1e-5, 2e-5),
    ".glb": (1e-6, 1e-5, 2e-5),
    ".usda": (1e-6, 1e-5, 2e-5),
    ".usdz": (1e-6, 1e-5, 2e-5),
    ".splat": (1e-6, 0.06, 0.02),
    ".spz": (5e-4, 0.08, 0.15),
    ".sog": (2e-3, 0.1, 0.15),
}


def model_of_balls(**options):
    positions = np.random.default_rng(0).uniform(-0.6, 0.6, (60, 3))
    return small_model(positions, fields=2.0, direction_encoding="sh", background=True, **options)


def write_both(folder: Path, model) -> tuple[Path, Path]:
    """Write a model and the moved model, as training and an edit would."""
    kept = {"cameras": provenance_cameras(CAMERAS), "viewpoint": Viewpoint.from_cameras(CAMERAS).to_json()}
    before, after = folder / "before.hyrf", folder / "after.hyrf"
    save_model(model, before, provenance=kept)
    save_model(move_model(STEP, model), after, provenance=move_provenance(STEP, kept))
    return before, after


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> tuple[Path, Path]:
    return write_both(tmp_path_factory.mktemp("models"), model_of_balls())


def covariances(splats: Splats) -> np.ndarray:
    axes = Rotation.from_quat(np.roll(splats.quats.astype(np.float64), -1, axis=1)).as_matrix() * splats.scales[:, None]
    return axes @ axes.transpose(0, 2, 1)


def colors_along(splats: Splats, directions: np.ndarray) -> np.ndarray:
    """Evaluate the colours (N, D, 3) of all splats along directions (D, 3)."""
    basis = harmonics_basis(torch.from_numpy(directions), splats.degree).numpy()
    return 0.5 + np.einsum("dk,nkc->ndc", basis, splats.harmonics)


def assert_moved(before: Splats, after: Splats, tolerances=(1e-6, 1e-5, 2e-5)) -> None:
    """Assert that splats are others in new world coordinates, by the definition of the map; the order is free."""
    assert len(before) == len(after)
    position_error, covariance_error, color_error = tolerances
    distances, index = cKDTree(after.positions).query(FACTOR * before.positions @ TURN.T + OFFSET)
    assert distances.max() < position_error and len(set(index)) == len(before)
    expected = FACTOR**2 * TURN @ covariances(before) @ TURN.T
    np.testing.assert_allclose(covariances(after)[index], expected, rtol=0, atol=covariance_error * expected.max())
    np.testing.assert_allclose(after.opacities[index], before.opacities, rtol=0, atol=0.01)
    directions = np.random.default_rng(1).normal(size=(20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    # Along R d, the moved Gaussian has the colour that it had along d.
    np.testing.assert_allclose(
        colors_along(after, directions @ TURN.T)[index], colors_along(before, directions), rtol=0, atol=color_error
    )


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_bake_turns_shapes_and_harmonics_with_the_model(degree):
    model = model_of_balls()

    before = bake(model, CAMERAS, (degree,))[degree]
    after = bake(move_model(STEP, model), [STEP.move_camera(camera) for camera in CAMERAS], (degree,))[degree]

    assert degree == 0 or np.ptp(colors_along(before, np.eye(3)), axis=1).max() > 0.05  # colours depend on the view
    assert_moved(before, after)


def test_a_bake_applies_the_exposure_map_in_the_axes_of_the_frame():
    model = model_of_balls()
    model.exposure = map_with_gains(CAMERAS, model.config.frame, np.linspace(0.7, 1.4, 24).reshape(8, 3))

    before = bake(model, CAMERAS)[3]
    after = bake(move_model(STEP, model), [STEP.move_camera(camera) for camera in CAMERAS])[3]

    assert_moved(before, after)


@pytest.mark.parametrize("ending", TOLERANCES)
def test_exported_splats_of_a_rotated_model_read_back_as_the_moved_ones(ending, files, tmp_path):
    if FORMATS[ending].module:
        pytest.importorskip(FORMATS[ending].module)
    settings = hyrfpack.ExportConfig(degree=FORMATS[ending].max_degree, background=False)
    read = []
    for path in files:
        target = tmp_path / f"{path.stem}{ending}"
        hyrfpack.export_model(path, target, settings)
        read.append(FORMATS[ending].decode(target.read_bytes(), target.name))
    assert_moved(*read, TOLERANCES[ending])


def test_background_splats_turn_with_the_model():
    model = model_of_balls()

    before = make_background_splats(model, CAMERAS)
    after = make_background_splats(move_model(STEP, model), [STEP.move_camera(camera) for camera in CAMERAS])

    assert_moved(before, after, (1e-3, 1e-5, 1e-3))


def test_the_background_picture_has_the_axes_of_the_world():
    """After a quarter turn about y from z to x, the picture is moved by a quarter of its width, from z to x."""
    model = model_of_balls()
    turned = move_model(Placement.rotation_about_axis((0, 1, 0), 90), model)

    before, after = render_background_picture(model, 32), render_background_picture(turned, 32)

    assert np.abs(before - after).max() > 0.01
    np.testing.assert_allclose(after, np.roll(before, 16, axis=1), rtol=0, atol=1e-5)


def test_a_half_turn_about_x_turns_the_background_picture_upside_down():
    model = model_of_balls()
    turned = move_model(Placement.rotation_about_axis((1, 0, 0), 180), model)

    # (x, y, z) becomes (x, -y, -z): latitudes change their signs, and a longitude a becomes pi - a.
    expected = np.roll(render_background_picture(model, 32)[::-1, ::-1], 32, axis=1)

    np.testing.assert_allclose(render_background_picture(turned, 32), expected, rtol=0, atol=1e-5)


def test_exported_cameras_and_points_move_with_the_scene(files, tmp_path):
    read = []
    for path in files:
        hyrfpack.export_model(path, tmp_path / path.stem / "transforms.json")
        read.append([camera for _, camera in cameras_from_json(tmp_path / path.stem / "transforms.json")])
    for before, after in zip(*read, strict=True):
        np.testing.assert_allclose(after.position, FACTOR * TURN @ before.position + OFFSET, rtol=0, atol=1e-6)
        np.testing.assert_allclose(after.rotation, before.rotation @ TURN.T, rtol=0, atol=1e-7)


def test_a_crop_of_an_export_is_a_box_in_world_axes(files, tmp_path):
    box = (-0.2, -10.0, -10.0, 10.0, 10.0, 0.6)
    target = tmp_path / "cropped.ply"
    hyrfpack.export_model(files[1], target, hyrfpack.ExportConfig(degree=0, crop=box))
    positions = np.random.default_rng(0).uniform(-0.6, 0.6, (60, 3)) @ (FACTOR * TURN).T + OFFSET
    inside = ((positions >= box[:3]) & (positions <= box[3:])).all(axis=1)

    read = FORMATS[".ply"].decode(target.read_bytes(), "cropped.ply").positions

    assert 0 < inside.sum() < 60
    assert cKDTree(positions[inside]).query(read)[0].max() < 1e-5 and len(read) == inside.sum()


def test_the_mesh_of_a_rotated_model_lies_on_the_rotated_surface(tmp_path):
    """A dense shell of Gaussians of radius 0.5 has a mesh near the sphere, and one hole tells its directions apart."""
    points = np.random.default_rng(3).normal(size=(4000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    model = small_model(0.5 * points[points[:, 0] < 0.8], scale_logits=-4.0, opacity_logits=6.0)
    cameras = [camera for height in (-2, 0, 2) for camera in ring(8, elevation=height, width=64, height=64)]
    kept = {"cameras": provenance_cameras(cameras), "viewpoint": Viewpoint.from_cameras(cameras).to_json()}
    save_model(move_model(STEP, model), tmp_path / "shell.hyrf", provenance=move_provenance(STEP, kept))

    hyrfpack.export_model(tmp_path / "shell.hyrf", tmp_path / "shell.obj", hyrfpack.ExportConfig(voxel=0.06))

    vertices = trimesh.load(tmp_path / "shell.obj", process=False).vertices
    local = (vertices - OFFSET) @ TURN / FACTOR
    np.testing.assert_allclose(np.median(np.linalg.norm(local, axis=1)), 0.5, rtol=0, atol=0.05)
    assert len(local) > 200 and (local[:, 0] > 0.45).mean() < 0.02 < (local[:, 1] > 0.45).mean()


def test_a_page_of_a_rotated_model_keeps_cameras_and_up_in_world_axes(files, tmp_path):
    scenes = []
    for path in files:
        hyrfpack.export_model(path, tmp_path / f"{path.stem}.html")
        page = (tmp_path / f"{path.stem}.html").read_text()
        scenes.append(json.loads(page.split('<script type="text/plain" id="scene">')[1].split("</script>")[0]))
    before, after = scenes
    assert "rotation" not in before
    np.testing.assert_allclose(after["rotation"], move_model(STEP, model_of_balls()).config.frame.rotation)
    np.testing.assert_allclose(after["up"], TURN @ before["up"], rtol=0, atol=1e-8)


def test_a_rotated_model_without_a_viewpoint_is_seen_from_the_rotated_place():
    before, after = (
        Viewpoint.from_frame(frame.center, frame.scale, frame.rotation)
        for frame in (model.config.frame for model in (model_of_balls(), move_model(STEP, model_of_balls())))
    )
    np.testing.assert_allclose(after.up, TURN @ before.up, rtol=0, atol=1e-12)
    np.testing.assert_allclose(
        after.camera.camera_from_world, STEP.move_camera(before.camera).camera_from_world, rtol=0, atol=1e-12
    )


def test_pictures_are_those_of_the_moved_camera_in_double_precision():
    model = model_of_balls().double()
    moved = move_model(STEP, model)
    unrotated = replace_config(moved, frame=replace(moved.config.frame, rotation=IDENTITY))
    for position in np.random.default_rng(2).normal(size=(2, 3)):
        camera = camera_at(3 * position / np.linalg.norm(position))
        with torch.no_grad():
            before = hyrfpack.render_view(model, camera).rgb
            after = hyrfpack.render_view(moved, STEP.move_camera(camera)).rgb
            elsewhere = hyrfpack.render_view(unrotated, STEP.move_camera(camera)).rgb
        np.testing.assert_allclose(after.numpy(), before.numpy(), rtol=0, atol=1e-11)
        assert (elsewhere - before).abs().max() > 0.01

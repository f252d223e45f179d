"""The twelve real sets load, and their points, poses, lenses and pictures agree."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest
from layers import only_in_acceptance

from hyrfpack.data import load_scene

# Set -> number of photos and of points.
COLMAP_SETS = {
    "drone_brighton_beach": (18, 3383),
    "drone_caliterra": (75, 5000),
    "gerrard_hall": (75, 6000),
    "indoor_room": (66, 2954),
    "kitti_street": (51, 8000),
    "llff_fern": (20, 3074),
    "mipnerf360_bonsai": (98, 9000),
    "ngp_fox": (50, 6000),
    "shiny_can_nerfstudio": (71, 4390),
    "specular_gold_cape": (60, 6020),
    "street_lund": (25, 1597),
}
# The sets of the unit layer: a camera that moves forward, views from one side, and views all around an object.
QUICK_SETS = {"kitti_street", "llff_fern", "specular_gold_cape"}


@pytest.mark.parametrize("name", only_in_acceptance(COLMAP_SETS, COLMAP_SETS.keys() - QUICK_SETS))
def test_point_colours_agree_with_the_pictures_that_observe_them(shared_data, name):
    scene = load_scene(shared_data / name)
    observations = pycolmap.Reconstruction(str(shared_data / name / "sparse" / "0"))
    views = {view.name: view for view in scene.views}

    shown, known = [], []
    for image in observations.images.values():
        view = views[image.name]
        observed = [observations.points3D[p.point3D_id] for p in image.points2D if p.has_point3D()]
        points = np.array([point.xyz for point in observed]).reshape(-1, 3)
        local = points @ view.camera.rotation.T + view.camera.camera_from_world[:3, 3]
        u = np.floor(view.camera.fx * local[:, 0] / local[:, 2] + view.camera.cx).astype(int)
        v = np.floor(view.camera.fy * local[:, 1] / local[:, 2] + view.camera.cy).astype(int)
        inside = (u >= 0) & (u < view.camera.width) & (v >= 0) & (v < view.camera.height) & (local[:, 2] > 0)
        picture = view.load()
        if picture.mask is not None:
            inside[inside] = picture.mask[v[inside], u[inside]]
        shown.append(picture.rgb[v[inside], u[inside]])
        known.append(np.array([point.color for point in observed]).reshape(-1, 3)[inside])

    assert (len(scene.views), len(scene.points)) == COLMAP_SETS[name]
    assert np.corrcoef(np.concatenate(shown).ravel(), np.concatenate(known).ravel())[0, 1] > 0.7


def test_lego_keeps_its_split_and_frames_the_object(shared_data):
    scene = load_scene(shared_data / "nerf_synthetic_lego")

    assert (scene.layout, len(scene.train), len(scene.test), scene.has_alpha) == ("blender", 100, 50, True)
    for view in scene.train[::20]:
        alpha = view.load().alpha > 128
        center = view.camera.camera_from_world[
            :3, 3
        ]  # the image position of the world's origin, which is inside the object
        u, v = view.camera.fx * center[0] / center[2] + 100, view.camera.fy * center[1] / center[2] + 100
        assert center[2] > 0 and alpha[int(v), int(u)]


def test_fox_transforms_skip_frames_without_a_file(shared_data):
    scene = load_scene(shared_data / "ngp_fox", layout="nerfstudio")

    assert len(scene.views) == 50
    assert any("17 of 67" in note for note in scene.notes)


def test_both_descriptions_of_the_can_are_the_same_cameras_and_points(shared_data):
    colmap = load_scene(shared_data / "shiny_can_nerfstudio")
    nerfstudio = load_scene(shared_data / "shiny_can_nerfstudio", layout="nerfstudio")
    applied = np.eye(4)
    applied[:3] = [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]]  # the axis change of nerfstudio, as the file states it

    for a, b in zip(colmap.views, nerfstudio.views, strict=True):
        assert a.name == b.name
        np.testing.assert_allclose(b.camera.camera_from_world @ applied, a.camera.camera_from_world, atol=1e-6)
        np.testing.assert_allclose(b.camera.intrinsics, a.camera.intrinsics, atol=1e-9)
        np.testing.assert_allclose(b.load.lens.coefficients, a.load.lens.coefficients, atol=1e-12)
    moved = colmap.points @ applied[:3, :3].T
    order_a, order_b = (np.lexsort(np.round(points, 4).T) for points in (moved, nerfstudio.points))
    np.testing.assert_allclose(moved[order_a].mean(0), nerfstudio.points[order_b].mean(0), atol=1e-5)
    np.testing.assert_allclose(np.sort(moved, axis=0), np.sort(nerfstudio.points, axis=0), atol=1e-5)

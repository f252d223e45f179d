"""What all readers of other programs' layouts have in common, on synthetic sets and on real photos."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from exported_sets import WRITERS_BY_LAYOUT, PhotoCamera, photo_path, write_ply
from PIL import Image

from hyrfpack.cli.common import LAYOUTS as NAMES
from hyrfpack.data import LAYOUTS, load_scene
from hyrfpack.errors import HyrfDataError
from hyrfpack.outputs import Outputs

# These layouts have no points.
LAYOUTS_WITHOUT_POINTS = ("llff", "polycam", "record3d")


def write_set(pictures, poses_of, root: Path, layout: str, count: int = 5) -> list[PhotoCamera]:
    """Write a set of 32 x 24 photos in a layout, with points in front of its first camera; return the cameras."""
    cameras = []
    for index, (rotation, translation) in enumerate(poses_of(count)):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, translation
        cameras.append(PhotoCamera(f"{index:03d}.jpg", 32, 24, 30.0, 30.0, 16.0, 12.0, pose))
    pictures(root, [photo_path(layout, index, camera.name) for index, camera in enumerate(cameras)])
    points = np.array([[0.1, 0.2, 2, 1], [-0.1, 0, 3, 1], [0, 0.1, 4, 1]]) @ cameras[0].world_from_camera.T
    WRITERS_BY_LAYOUT[layout](root, cameras, points[:, :3], np.eye(3))
    return cameras


@pytest.fixture
def write(pictures, random_poses, tmp_path):
    """A function write(layout, count) that writes a set into tmp_path and returns its cameras."""
    return lambda layout, count=5: write_set(pictures, random_poses, tmp_path, layout, count)


def test_the_command_line_accepts_every_layout():
    assert tuple(LAYOUTS) == NAMES
    assert set(WRITERS_BY_LAYOUT) | {"colmap", "blender", "nerfstudio"} == set(LAYOUTS)


@pytest.mark.parametrize("layout", WRITERS_BY_LAYOUT)
def test_written_cameras_and_points_are_read_back(tmp_path, write, layout):
    cameras = write(layout)

    scene = load_scene(tmp_path, test_every=2)

    assert (scene.layout, len(scene.train), len(scene.test), scene.notes) == (layout, 2, 3, [])
    assert len(scene.points) == (0 if layout in LAYOUTS_WITHOUT_POINTS else 3)
    for view, camera in zip(scene.views, cameras, strict=True):
        np.testing.assert_allclose(view.camera.camera_from_world, camera.camera_from_world, atol=1e-9)
        np.testing.assert_allclose(view.camera.intrinsics, (30, 30, 16, 12), atol=1e-9)
        assert view.load().rgb.shape == (24, 32, 3)
    if layout not in LAYOUTS_WITHOUT_POINTS:
        np.testing.assert_allclose(scene.point_colors, np.eye(3), atol=1e-6)


@pytest.mark.parametrize("layout", WRITERS_BY_LAYOUT)
def test_missing_photos_are_counted(tmp_path, write, layout):
    cameras = write(layout)
    (tmp_path / photo_path(layout, 3, cameras[3].name)).unlink()

    if layout == "llff":
        with pytest.raises(HyrfDataError, match="the poses of 5 photos, but images holds 4"):
            load_scene(tmp_path)
    else:
        scene = load_scene(tmp_path)
        assert len(scene.views) == 4 and any("1 of 5 photos listed in" in note for note in scene.notes)


@pytest.mark.parametrize("layout", [layout for layout in WRITERS_BY_LAYOUT if layout != "llff"])
def test_a_set_without_photos_is_a_clear_error(tmp_path, write, layout):
    cameras = write(layout)
    for index, camera in enumerate(cameras):
        (tmp_path / photo_path(layout, index, camera.name)).unlink()

    with pytest.raises(HyrfDataError, match="none of the 5 photos that"):
        load_scene(tmp_path)


@pytest.mark.parametrize("layout", WRITERS_BY_LAYOUT)
def test_masks_beside_the_photos_are_used(tmp_path, write, layout):
    cameras = write(layout)
    name = Path(photo_path(layout, 1, cameras[1].name)).name
    (tmp_path / "masks").mkdir()
    Image.fromarray(np.zeros((24, 32), np.uint8)).save(tmp_path / "masks" / f"{name}.png")

    views = load_scene(tmp_path).views

    assert [view.load().mask is not None for view in views] == [False, True, False, False, False]


@pytest.mark.parametrize(
    "layout", [layout for layout in WRITERS_BY_LAYOUT if layout != "bundler"]
)  # a bundler file has no photo sizes
def test_smaller_files_scale_the_intrinsics(tmp_path, write, layout):
    cameras = write(layout, 2)
    for index, camera in enumerate(cameras):
        file = tmp_path / photo_path(layout, index, camera.name)
        Image.open(file).resize((16, 12)).save(file)

    assert load_scene(tmp_path).views[0].camera.intrinsics == pytest.approx((15, 15, 8, 6))


@pytest.mark.parametrize("layout", WRITERS_BY_LAYOUT)
def test_outputs_into_the_folders_of_a_set_are_rejected(tmp_path, write, layout):
    from hyrfpack.errors import HyrfError

    write(layout)
    scene = load_scene(tmp_path)

    for file in scene.files:
        with pytest.raises(HyrfError, match="input itself"):
            Outputs(scene=scene, overwrite=True).file(file)
    with pytest.raises(HyrfError, match="same command reads"):
        Outputs(scene=scene).file(tmp_path / "model.hyrf")


def test_a_colmap_model_is_preferred_to_other_layouts(tmp_path, write, colmap_folder):
    write("llff", 9)
    shutil.rmtree(tmp_path / "images")
    colmap_folder(tmp_path)

    assert load_scene(tmp_path).notes[0] == "there are poses in several layouts (colmap and llff); colmap is used"
    assert load_scene(tmp_path, layout="llff").layout == "llff"


def test_the_error_names_the_files_that_were_searched(tmp_path):
    with pytest.raises(HyrfDataError, match=r"sparse/0, transforms_train.json, .*poses_bounds.npy, .*Record3D"):
        load_scene(tmp_path)
    with pytest.raises(HyrfDataError, match=r"no metashape poses found \(looked for cameras of Metashape as .xml\)"):
        load_scene(tmp_path, layout="metashape")


@pytest.mark.parametrize("layout", ["bundler", "polycam", "record3d"])
def test_sets_with_photo_paths_reject_a_photo_folder(tmp_path, write, layout):
    write(layout)

    with pytest.raises(HyrfDataError, match="the folder 'images_2' cannot be chosen; leave out `images`"):
        load_scene(tmp_path, images="images_2")
    with pytest.raises(HyrfDataError, match="no COLMAP models"):
        load_scene(tmp_path, model="1")


@pytest.mark.parametrize("layout", ["llff", "metashape", "realityscan"])
def test_photos_may_lie_in_another_folder(tmp_path, tmp_path_factory, write, layout):
    write(layout)
    elsewhere = tmp_path_factory.mktemp("elsewhere") / "photos"
    (tmp_path / "images").rename(elsewhere)
    if layout != "llff":
        (elsewhere / "003.jpg").unlink()

    assert len(load_scene(tmp_path, images=str(elsewhere)).views) == (5 if layout == "llff" else 4)


@pytest.mark.parametrize("layout", ["llff", "metashape", "realityscan"])
@pytest.mark.parametrize("images", ["images_9", "x" * 300, "a\0b"])
def test_a_missing_photo_folder_is_a_clear_error(tmp_path, write, layout, images):
    write(layout)

    with pytest.raises(HyrfDataError, match="no photo folder"):
        load_scene(tmp_path, images=images)


@pytest.mark.parametrize("layout", ["metashape", "bundler", "realityscan"])
def test_photos_may_lie_beside_the_table(tmp_path, write, layout):
    write(layout)
    for photo in (tmp_path / "images").iterdir():
        photo.rename(tmp_path / photo.name)
    (tmp_path / "images").rmdir()

    assert len(load_scene(tmp_path).views) == 5


@pytest.mark.parametrize("layout", ["metashape", "realityscan"])
def test_points_of_another_frame_are_not_used(tmp_path, write, layout):
    write(layout)
    file = next(tmp_path.glob("*.ply"))
    write_ply(file, np.array([[5e5, 5e6, 100.0]] * 3), np.eye(3))

    scene = load_scene(tmp_path)

    assert len(scene.points) == 0
    assert any(f"the points of {file.name} do not lie where the cameras look" in note for note in scene.notes)


@pytest.mark.parametrize("layout", WRITERS_BY_LAYOUT)
def test_points_of_real_sets_project_to_pixels_of_their_colours(tmp_path, shared_data, layout):
    """A COLMAP model of real photos is written in another layout; its points project to pixels of their colours."""
    known = load_scene(shared_data / "llff_fern", test_every=0)
    cameras = [
        PhotoCamera(v.name, v.camera.width, v.camera.height, *v.camera.intrinsics, v.camera.camera_from_world)
        for v in known.views
    ]
    for index, camera in enumerate(cameras):
        place = tmp_path / photo_path(layout, index, camera.name)
        place.parent.mkdir(parents=True, exist_ok=True)
        place.symlink_to(shared_data / "llff_fern" / "images" / camera.name)
    WRITERS_BY_LAYOUT[layout](tmp_path, cameras, known.points, known.point_colors)

    scene = load_scene(tmp_path, test_every=0)
    shown, expected = [], []
    for view in scene.views:
        local = known.points @ view.camera.rotation.T + view.camera.camera_from_world[:3, 3]
        u = np.floor(view.camera.fx * local[:, 0] / local[:, 2] + view.camera.cx).astype(int)
        v = np.floor(view.camera.fy * local[:, 1] / local[:, 2] + view.camera.cy).astype(int)
        inside = (u >= 0) & (u < view.camera.width) & (v >= 0) & (v < view.camera.height) & (local[:, 2] > 0)
        shown.append(view.load().rgb[v[inside], u[inside]])
        expected.append(known.point_colors[inside])

    assert len(scene.points) == (0 if layout in LAYOUTS_WITHOUT_POINTS else len(known.points))
    assert np.corrcoef(np.concatenate(shown).ravel(), np.concatenate(expected).ravel())[0, 1] > 0.7

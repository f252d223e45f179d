from __future__ import annotations

import shutil
import struct
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import trimesh
from hypothesis import HealthCheck, given
from hypothesis import strategies as st
from PIL import Image
from property_tests import examples

from hyrfpack.data import load_scene
from hyrfpack.errors import HyrfDataError


def test_binary_model_gives_cameras_poses_points_and_split(tmp_path, colmap_folder):
    folder = colmap_folder(tmp_path, count=17)

    scene = load_scene(tmp_path)

    assert scene.layout == "colmap"
    assert [view.name for view in scene.test] == ["000.png", "008.png", "016.png"]
    assert len(scene.train) == 14
    assert [view.name for view in scene.views] == folder.names
    for index, view in enumerate(scene.views):
        np.testing.assert_allclose(view.camera.camera_from_world, folder.camera_from_world(index), atol=1e-12)
        assert view.camera.intrinsics == (30.0, 31.0, 17.0, 11.0)
        assert (view.camera.width, view.camera.height) == (32, 24)
    np.testing.assert_array_equal(scene.points, folder.points)
    np.testing.assert_allclose(scene.point_colors, folder.colors / 255, atol=1e-6)
    assert scene.notes == []


@pytest.mark.parametrize("place", ["sparse", "colmap/sparse/0"])
def test_a_model_is_found_in_all_known_folders(tmp_path, colmap_folder, place):
    folder = colmap_folder(tmp_path)
    moved = tmp_path / "moved"
    shutil.move(folder.model, moved)
    shutil.rmtree(tmp_path / "sparse")
    (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
    shutil.move(moved, tmp_path / place)

    assert len(load_scene(tmp_path).views) == 9


def test_text_model_equals_binary_model(tmp_path, colmap_folder):
    folder = colmap_folder(tmp_path, model=4, params=(30.0, 31, 17, 11, 0.1, 0.01, 0.001, 0.002))
    binary = load_scene(tmp_path)
    pycolmap.Reconstruction(str(folder.model)).write_text(str(folder.model))
    for table in folder.model.glob("*.bin"):
        table.unlink()

    text = load_scene(tmp_path)

    assert len(text.views) == len(binary.views)
    for a, b in zip(text.views, binary.views, strict=True):
        assert a.camera.intrinsics == b.camera.intrinsics
        np.testing.assert_allclose(a.camera.camera_from_world, b.camera.camera_from_world, atol=1e-12)
        assert a.load.lens == b.load.lens
    np.testing.assert_allclose(text.points, binary.points, atol=1e-12)


def test_a_model_with_rigs_and_frames_is_read_like_one_without(tmp_path, colmap_folder):
    folder = colmap_folder(tmp_path)
    plain = load_scene(tmp_path)
    pycolmap.Reconstruction(str(folder.model)).write_binary(str(folder.model))
    assert (folder.model / "rigs.bin").is_file() and (folder.model / "frames.bin").is_file()

    scene = load_scene(tmp_path)

    for a, b in zip(scene.views, plain.views, strict=True):
        np.testing.assert_allclose(a.camera.camera_from_world, b.camera.camera_from_world, atol=1e-12)


def test_smaller_pictures_scale_the_intrinsics(tmp_path, colmap_folder, pictures):
    folder = colmap_folder(tmp_path)
    pictures(tmp_path / "images_2", folder.names, size=(16, 12))

    view = load_scene(tmp_path, images="images_2").views[0]

    assert view.camera.intrinsics == (15.0, 15.5, 8.5, 5.5)
    assert view.load().rgb.shape == (12, 16, 3)


def test_masks_beside_images_are_used_under_each_naming(tmp_path, colmap_folder):
    folder = colmap_folder(tmp_path)
    shutil.move(tmp_path / "images" / "001.png", tmp_path / "images" / "001.jpg")
    folder.names[1] = "001.jpg"
    (folder.model / "images.bin").write_bytes(folder.tables()["images.bin"])
    (tmp_path / "masks").mkdir()
    pixels = np.full((24, 32), 255, np.uint8)
    pixels[:6] = 0
    for name in ("000.png", "001.png", "002.png.png"):
        Image.fromarray(pixels).save(tmp_path / "masks" / name)

    scene = load_scene(tmp_path)

    for view in scene.views[:3]:
        np.testing.assert_array_equal(view.load().mask, pixels > 0)
    assert scene.views[3].load().mask is None
    assert any("3 of 9 photos have a mask" in note for note in scene.notes)


def test_missing_photos_are_skipped_and_counted(tmp_path, colmap_folder):
    colmap_folder(tmp_path)
    (tmp_path / "images" / "004.png").unlink()

    scene = load_scene(tmp_path)

    assert len(scene.views) == 8
    assert any("1 of 9 photos" in note for note in scene.notes)


def test_photo_names_cannot_leave_the_folder(tmp_path, colmap_folder):
    folder = colmap_folder(tmp_path)
    folder.names[0] = "../images/000.png"
    (folder.model / "images.bin").write_bytes(folder.tables()["images.bin"])

    names = [view.name for view in load_scene(tmp_path).views]

    assert all(".." not in name and not name.startswith("/") for name in names)


def _break_nothing_on_disk(root: Path, folder) -> None:
    shutil.rmtree(root / "images")
    (root / "images").mkdir()


def _break_nan_pose(root: Path, folder) -> None:
    folder.poses[2] = (np.full(4, np.nan), np.zeros(3))
    (folder.model / "images.bin").write_bytes(folder.tables()["images.bin"])


def _break_infinite_translation(root: Path, folder) -> None:
    folder.poses[2] = (folder.poses[2][0], np.array([0, np.inf, 0]))
    (folder.model / "images.bin").write_bytes(folder.tables()["images.bin"])


def _break_zero_quaternion(root: Path, folder) -> None:
    folder.poses[2] = (np.zeros(4), np.zeros(3))
    (folder.model / "images.bin").write_bytes(folder.tables()["images.bin"])


def _break_camera_count(root: Path, folder) -> None:
    content = folder.tables()["cameras.bin"]
    (folder.model / "cameras.bin").write_bytes(struct.pack("<Q", 2) + content[8:])


def _break_point_count(root: Path, folder) -> None:
    content = folder.tables()["points3D.bin"]
    (folder.model / "points3D.bin").write_bytes(struct.pack("<Q", 2) + content[8:])


def _break_huge_count(root: Path, folder) -> None:
    content = folder.tables()["points3D.bin"]
    (folder.model / "points3D.bin").write_bytes(struct.pack("<Q", 2**63) + content[8:])


def _break_huge_track(root: Path, folder) -> None:
    content = bytearray(folder.tables()["points3D.bin"])
    content[8 + 8 + 24 + 3 + 8 : 8 + 8 + 24 + 3 + 16] = struct.pack("<Q", 2**61)
    (folder.model / "points3D.bin").write_bytes(bytes(content))


def _break_camera_model(root: Path, folder) -> None:
    folder.model_id = 99
    (folder.model / "cameras.bin").write_bytes(folder.tables()["cameras.bin"])


def _break_focal_length(root: Path, folder) -> None:
    folder.params = (0.0, 31, 17, 11)
    (folder.model / "cameras.bin").write_bytes(folder.tables()["cameras.bin"])


def _break_empty_picture(root: Path, folder) -> None:
    (root / "images" / "003.png").write_bytes(b"")


def _break_picture_size(root: Path, folder) -> None:
    Image.new("RGB", (24, 32)).save(root / "images" / "003.png")


def _break_mask_size(root: Path, folder) -> None:
    (root / "masks").mkdir()
    Image.new("L", (320, 32)).save(root / "masks" / "003.png")


def _break_duplicate_name(root: Path, folder) -> None:
    folder.names[4] = folder.names[3]
    (folder.model / "images.bin").write_bytes(folder.tables()["images.bin"])


def _break_missing_table(root: Path, folder) -> None:
    (folder.model / "cameras.bin").unlink()


def _break_empty_table(root: Path, folder) -> None:
    (folder.model / "images.bin").write_bytes(b"")


def _break_no_photo_folder(root: Path, folder) -> None:
    shutil.copytree(root / "images", root / "left")
    shutil.move(root / "images", root / "right")


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (_break_nothing_on_disk, "none of the [0-9] photos that"),
        (_break_nan_pose, "002.png"),
        (_break_infinite_translation, "002.png"),
        (_break_zero_quaternion, "002.png has no rotation"),
        (_break_camera_count, "cameras.bin"),
        (_break_point_count, "points3D.bin"),
        (_break_huge_count, "points3D.bin"),
        (_break_huge_track, "points3D.bin"),
        (_break_camera_model, "99"),
        (_break_focal_length, "intrinsics"),
        (_break_empty_picture, "003.png"),
        (_break_picture_size, "24 x 32"),
        (_break_mask_size, "320 x 32"),
        (_break_duplicate_name, "listed twice"),
        (_break_missing_table, "cameras.bin: the file is missing"),
        (_break_empty_table, "images.bin"),
        (_break_no_photo_folder, "there are the folders left, right, sparse.; .* `images`"),
    ],
)
def test_a_broken_model_is_a_clear_error(tmp_path, colmap_folder, damage, says):
    damage(tmp_path, colmap_folder(tmp_path))

    with pytest.raises(HyrfDataError, match=says) as caught:
        load_scene(tmp_path)

    assert "\n" not in str(caught.value) and str(tmp_path) in str(caught.value)


@pytest.mark.parametrize("table", ["cameras.bin", "images.bin", "points3D.bin"])
def test_every_truncation_of_a_table_is_rejected(tmp_path, colmap_folder, table):
    folder = colmap_folder(tmp_path, count=2)
    content = folder.tables()[table]

    for length in range(0, len(content), 3):
        (folder.model / table).write_bytes(content[:length])
        with pytest.raises(HyrfDataError, match=table):
            load_scene(tmp_path)


def test_a_text_table_with_missing_lines_is_rejected(tmp_path, colmap_folder):
    folder = colmap_folder(tmp_path)
    pycolmap.Reconstruction(str(folder.model)).write_text(str(folder.model))
    for table in folder.model.glob("*.bin"):
        table.unlink()
    lines = (folder.model / "points3D.txt").read_text().splitlines()
    (folder.model / "points3D.txt").write_text("\n".join(lines[:-1]) + "\n")

    with pytest.raises(HyrfDataError, match=r"points3D\.txt: says 3 entries but holds 2"):
        load_scene(tmp_path)


@pytest.mark.parametrize("name", ["{}", "view {} of five.png"], ids=["one word", "several words"])
def test_a_text_table_without_lines_of_points_is_rejected(tmp_path, colmap_folder, name):
    folder = colmap_folder(tmp_path)
    pycolmap.Reconstruction(str(folder.model)).write_text(str(folder.model))
    for table in folder.model.glob("*.bin"):
        table.unlink()
    lines = [line for line in (folder.model / "images.txt").read_text().splitlines() if not line.startswith("#")]
    photos = [f"{fields} {name.format(file)}" for fields, file in (line.rsplit(" ", 1) for line in lines[::2])]
    (folder.model / "images.txt").write_text("\n".join(photos) + "\n")

    with pytest.raises(HyrfDataError, match=r"images\.txt: line 2 is not a list of 2D points"):
        load_scene(tmp_path)


def test_garbage_in_text_tables_is_rejected(tmp_path, colmap_folder):
    folder = colmap_folder(tmp_path)
    pycolmap.Reconstruction(str(folder.model)).write_text(str(folder.model))
    for table in folder.model.glob("*.bin"):
        table.unlink()
    (folder.model / "cameras.txt").write_text("1 PINHOLE wide high 30 31 17 11\n")

    with pytest.raises(HyrfDataError):
        load_scene(tmp_path)


@pytest.fixture(scope="module")
def mutable_root(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("mutable")


@examples(60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_mutated_tables_raise_only_data_errors(mutable_root, colmap_folder, data):
    exists = (mutable_root / "images").is_dir()
    folder = colmap_folder(
        mutable_root, count=3, model=4, params=(30.0, 31, 17, 11, 0.1, 0.01, 0.001, 0.002), extra=not exists
    )
    table = data.draw(st.sampled_from(["cameras.bin", "images.bin", "points3D.bin"]))
    content = bytearray(folder.tables()[table])
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(content) - 1))
        patch = data.draw(st.one_of(st.binary(min_size=1, max_size=1), st.integers(0, 2**64 - 1).map(_eight_bytes)))
        content[at : at + len(patch)] = patch
    (folder.model / table).write_bytes(bytes(content))

    try:
        for view in load_scene(mutable_root).views:
            view.load()
    except HyrfDataError as error:
        assert "\n" not in str(error)


def _eight_bytes(value: int) -> bytes:
    return struct.pack("<Q", value)


# -- tracks ----------------------------------------------------------------------------------------------------------


def write_tracks(folder, seen: list[list[int]]) -> None:
    """Write tables in which photo n has found the points seen[n], and one feature without a point."""
    images, tracks = struct.pack("<Q", folder.count), [b""] * len(folder.points)
    for number, (quaternion, translation) in enumerate(folder.poses):
        images += struct.pack("<I4d3dI", number + 1, *quaternion, *translation, 7) + folder.names[number].encode()
        images += b"\0" + struct.pack("<Q", len(seen[number]) + 1) + struct.pack("<ddq", 1.0, 1.0, -1)
        for place, point in enumerate(seen[number]):
            images += struct.pack("<ddQ", 3.0 * place, 5.0, point + 1)
            tracks[point] += struct.pack("<II", number + 1, place + 1)
    points = struct.pack("<Q", len(tracks))
    for number, track in enumerate(tracks):
        color = (int(c) for c in folder.colors[number])
        points += struct.pack("<Q3d3BdQ", number + 1, *folder.points[number], *color, 0.5, len(track) // 8) + track
    (folder.model / "images.bin").write_bytes(images)
    (folder.model / "points3D.bin").write_bytes(points)


POINTS_BY_PHOTO = [[2, 0], [1], [], [0, 1, 2]]


@pytest.mark.parametrize("kind", ["binary", "text"])
def test_tracks_are_the_points_that_each_photo_found(tmp_path, colmap_folder, kind):
    folder = colmap_folder(tmp_path, count=4)
    write_tracks(folder, POINTS_BY_PHOTO)
    if kind == "text":
        pycolmap.Reconstruction(str(folder.model)).write_text(str(folder.model))
        for table in folder.model.glob("*.bin"):
            table.unlink()
    (tmp_path / "images" / "001.png").unlink()

    tracks = load_scene(tmp_path).tracks

    assert {name: rows.tolist() for name, rows in tracks.items()} == {
        "000.png": [0, 2],
        "002.png": [],
        "003.png": [0, 1, 2],
    }
    assert all(rows.dtype == np.int64 for rows in tracks.values())


def test_tracks_are_renumbered_when_points_are_dropped(tmp_path, colmap_folder):
    folder = colmap_folder(tmp_path, count=4)
    folder.points = folder.points.copy()
    folder.points[1, 2] = np.nan
    write_tracks(folder, POINTS_BY_PHOTO)

    scene = load_scene(tmp_path)

    assert [scene.tracks[name].tolist() for name in folder.names] == [[0, 1], [], [], [0, 1]]
    np.testing.assert_array_equal(scene.points, folder.points[[0, 2]])


def test_points_of_a_ply_file_have_no_tracks(tmp_path, colmap_folder):
    folder = colmap_folder(tmp_path)
    (folder.model / "points3D.bin").unlink()
    trimesh.PointCloud(np.ones((5, 3))).export(folder.model / "points3D.ply")

    scene = load_scene(tmp_path)

    assert len(scene.points) == 5 and scene.tracks == {}

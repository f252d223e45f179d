from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from hyrfpack import atomic
from hyrfpack.data import load_scene
from hyrfpack.errors import HyrfError
from hyrfpack.export.cameras import encode_transforms, fit_to_file, locate_photo, write_colmap
from hyrfpack.scene import Camera
from hyrfpack.splats.splats import Splats


def random_named_cameras(count: int = 9, kinds: int = 1) -> list[tuple[str, Camera]]:
    rng = np.random.default_rng(count)
    turns = Rotation.random(count, rng=rng).as_matrix()
    named = []
    for index, turn in enumerate(turns):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn, rng.normal(size=3) * 5
        width = 32 + 8 * (index % kinds)
        named.append((f"left/{index:03d}.png", Camera(width, 24, 30.0 + index % kinds, 31.25, 17.0, 11.0, pose)))
    return named


def random_splats(count: int = 200) -> Splats:
    rng = np.random.default_rng(0)
    quats = np.tile((1.0, 0, 0, 0), (count, 1))
    opacities = np.where(np.arange(count) % 2, 0.05, 0.9)
    return Splats(rng.normal(size=(count, 3)), np.ones((count, 3)), quats, opacities, rng.normal(size=(count, 1, 3)))


def add_photos(folder: Path, named: list[tuple[str, Camera]]) -> None:
    for name, camera in named:
        (folder / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (camera.width, camera.height)).save(folder / "images" / name)


def assert_same_cameras(folder: Path, named: list[tuple[str, Camera]], prefix: str = "") -> None:
    views = load_scene(folder).views
    assert [view.name for view in views] == [prefix + name for name, _ in named]
    for view, (_, camera) in zip(views, named, strict=True):
        assert (view.camera.width, view.camera.height) == (camera.width, camera.height)
        assert view.camera.intrinsics == camera.intrinsics
        np.testing.assert_allclose(view.camera.camera_from_world, camera.camera_from_world, rtol=0, atol=1e-12)


@pytest.mark.parametrize("kinds", [1, 3])
def test_a_colmap_model_round_trips(tmp_path, kinds):
    named, points = random_named_cameras(kinds=kinds), random_splats()
    write_colmap(named, tmp_path, points)
    add_photos(tmp_path, named)

    assert_same_cameras(tmp_path, named)
    scene, solid = load_scene(tmp_path), points.opacities > 0.5
    assert scene.layout == "colmap"
    np.testing.assert_array_equal(scene.points, points.positions[solid])
    srgb = np.clip(0.5 + points.harmonics[solid, 0] / np.sqrt(4 * np.pi), 0, 1)
    np.testing.assert_allclose(scene.point_colors, srgb, atol=0.51 / 255)


def test_photos_with_equal_intrinsics_share_a_colmap_camera(tmp_path):
    import pycolmap

    write_colmap(random_named_cameras(9, kinds=2), tmp_path, None)
    model = pycolmap.Reconstruction(str(tmp_path / "sparse" / "0"))
    kinds = {number: (camera.model.name, camera.width) for number, camera in model.cameras.items()}
    assert kinds == {1: ("PINHOLE", 32), 2: ("PINHOLE", 40)}
    assert (model.num_reg_images(), model.num_points3D()) == (9, 0)


def test_surplus_points_are_sampled_evenly(tmp_path, monkeypatch):
    import pycolmap

    monkeypatch.setattr("hyrfpack.export.cameras.MAX_COLMAP_POINTS", 11)
    points = random_splats()
    write_colmap(random_named_cameras(2), tmp_path, points)
    model = pycolmap.Reconstruction(str(tmp_path / "sparse" / "0"))
    picked = np.array([point.xyz for _, point in sorted(model.points3D.items())])
    np.testing.assert_array_equal(picked, points.positions[::2][np.linspace(0, 99, 11).round().astype(int)])


def test_colmap_tables_are_deterministic(tmp_path):
    for folder in ("a", "b"):
        write_colmap(random_named_cameras(), tmp_path / folder, random_splats())
    first, second = (sorted((tmp_path / folder).rglob("*.bin")) for folder in ("a", "b"))
    assert len(first) >= 3
    assert [file.read_bytes() for file in first] == [file.read_bytes() for file in second]


def test_a_failed_write_keeps_the_old_colmap_model(tmp_path, monkeypatch):
    write_colmap(random_named_cameras(3), tmp_path, None)
    before = {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()}
    write_bytes = Path.write_bytes

    def fail_when_large(self: Path, data: bytes) -> int:
        if atomic.TEMPORARY_PREFIX in str(self) and len(data) > 500:
            raise OSError(28, "No space left on device")
        return write_bytes(self, data)

    monkeypatch.setattr(Path, "write_bytes", fail_when_large)
    with pytest.raises(HyrfError, match="disk is full"):
        write_colmap(random_named_cameras(9), tmp_path, random_splats())
    assert {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()} == before


@pytest.mark.parametrize("kinds", [1, 3])
def test_transforms_round_trip(tmp_path, kinds):
    named = random_named_cameras(kinds=kinds)
    (tmp_path / "transforms.json").write_bytes(encode_transforms([(f"images/{name}", cam) for name, cam in named]))
    add_photos(tmp_path, named)
    assert load_scene(tmp_path).layout == "nerfstudio"
    assert_same_cameras(tmp_path, named)


def test_transforms_store_shared_intrinsics_once():
    shared, own = (json.loads(encode_transforms(random_named_cameras(kinds=kinds))) for kinds in (1, 2))
    assert shared["fl_x"] == 30.0 and set(shared["frames"][0]) == {"file_path", "transform_matrix"}
    assert "fl_x" not in own and own["frames"][1]["fl_x"] == 31.0
    assert encode_transforms(random_named_cameras()) == encode_transforms(random_named_cameras())


def test_an_opengl_camera_looks_along_minus_z_with_y_up():
    camera = Camera(32, 24, 30.0, 30.0, 16.0, 12.0, np.eye(4))  # looks along +z of a world with y down
    (frame,) = json.loads(encode_transforms([("a.png", camera)]))["frames"]
    np.testing.assert_array_equal(frame["transform_matrix"], np.diag([1.0, -1, -1, 1]))


def write_blender_set(folder: Path, side: int) -> None:
    for split in ("train", "test"):
        (folder / split).mkdir(parents=True)
        Image.new("RGB", (side, side)).save(folder / split / "r_0.png")
        frame = {"file_path": f"./{split}/r_0", "transform_matrix": np.eye(4).tolist()}
        (folder / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": 0.8, "frames": [frame]}))


def test_cameras_fit_the_photo_files_even_if_these_are_loaded_smaller(tmp_path):
    write_blender_set(tmp_path, 64)
    (small,), (stored,) = (load_scene(tmp_path, max_size=size).train for size in (24, 0))
    assert small.camera.width == 24 and fit_to_file(stored) == stored.camera
    fitted = fit_to_file(small)
    assert (fitted.width, fitted.height) == (64, 64)
    np.testing.assert_allclose(fitted.intrinsics, stored.camera.intrinsics, rtol=1e-12)


def test_paths_of_photos_lead_to_their_files_from_any_folder(tmp_path):
    write_blender_set(tmp_path / "set", 8)
    (view,) = load_scene(tmp_path / "set").train
    assert locate_photo(view, tmp_path / "set") == "train/r_0.png"
    assert locate_photo(view, tmp_path / "set" / "train") == "r_0.png"
    (tmp_path / "out" / "deep").mkdir(parents=True)
    (tmp_path / "link").symlink_to(tmp_path / "out" / "deep")
    for folder in (tmp_path / "out", tmp_path / "link", tmp_path / "missing"):
        assert locate_photo(view, folder).startswith("..")
        if folder.exists():
            assert (folder / locate_photo(view, folder)).samefile(tmp_path / "set" / "train" / "r_0.png")


def test_photos_in_an_archive_are_named_as_in_a_folder_of_images(tmp_path):
    write_blender_set(tmp_path / "set", 8)
    archive = shutil.make_archive(str(tmp_path / "set"), "zip", tmp_path / "set")
    (view,) = load_scene(archive).train
    assert locate_photo(view, tmp_path) == "images/train/r_0.png"

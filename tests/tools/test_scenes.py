"""The generated photo sets: files, geometry, sparse points and antialiasing."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

import hyrfpack
from hyrfpack.errors import HyrfError
from hyrfpack.parallel.threads import thread_count
from hyrfpack.scene import Camera
from tools.command import run_command
from tools.scenes import write_set as command
from tools.scenes.catalog import LAYOUTS, SceneDescription, make_scene
from tools.scenes.geometry import BOX, CYLINDER_Y, ELLIPSOID, SceneArrays
from tools.scenes.render import render_depth, render_picture
from tools.scenes.write_set import write_set

PHOTO_COUNT, PHOTO_WIDTH, PHOTO_HEIGHT = 12, 96, 64


@pytest.fixture(scope="module")
def written_set(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("sets") / "object"
    write_set(folder, "object", photos=PHOTO_COUNT, width=PHOTO_WIDTH, seed=3)
    return folder


@pytest.fixture(scope="module")
def scenes() -> dict[str, SceneDescription]:
    return {name: make_scene(name, PHOTO_COUNT, PHOTO_WIDTH, PHOTO_HEIGHT, 3) for name in LAYOUTS}


@pytest.fixture
def reconstruction(written_set) -> pycolmap.Reconstruction:
    return pycolmap.Reconstruction(str(written_set / "sparse" / "0"))


def contents(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def nearest_hits(scene: SceneArrays, origin: np.ndarray, direction: np.ndarray) -> float:
    """Return the distance to the first surface along a ray, from the equations of planes and quadrics."""
    distances = [np.inf]
    for i, shape in enumerate(scene.shape):
        c, s = scene.yaw[i]
        axes = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        start, along, half = axes @ (origin - scene.center[i]), axes @ direction, scene.half[i]
        if shape == BOX:
            for axis in range(3):
                for side in (-1, 1):
                    t = (side * half[axis] - start[axis]) / along[axis]
                    rest = np.delete(np.abs(start + t * along) - half, axis)
                    if t > 0 and (rest <= 0).all():
                        distances.append(t)
            continue
        height_axis = {CYLINDER_Y: 1}.get(int(shape), 2)
        weights = 1 / half**2
        if shape != ELLIPSOID:
            weights[height_axis] = 0
        roots = np.roots([weights @ along**2, 2 * weights @ (start * along), weights @ start**2 - 1])
        for t in roots[np.isreal(roots)].real:
            if t > 0 and (shape == ELLIPSOID or abs(start + t * along)[height_axis] <= half[height_axis]):
                distances.append(t)
        if shape != ELLIPSOID:
            for side in (-1, 1):
                t = (side * half[height_axis] - start[height_axis]) / along[height_axis]
                if t > 0 and weights @ (start + t * along) ** 2 <= 1:
                    distances.append(t)
    return min(distances)


def test_the_set_loads_with_its_cameras_and_points(written_set, scenes):
    scene = hyrfpack.load_scene(written_set)
    assert len(scene.views) == PHOTO_COUNT and len(scene.points) > 100
    for view, camera in zip(sorted(scene.views, key=lambda view: view.name), scenes["object"].cameras, strict=True):
        np.testing.assert_allclose(view.camera.camera_from_world, camera.camera_from_world, atol=1e-9)
        np.testing.assert_allclose(view.camera.intrinsics, camera.intrinsics)
        assert view.load().rgb.shape == (PHOTO_HEIGHT, PHOTO_WIDTH, 3)


def test_the_same_seed_writes_the_same_bytes_with_any_number_of_threads(written_set, tmp_path, monkeypatch):
    monkeypatch.setenv("HYRFPACK_THREADS", "3" if thread_count() == 1 else "1")
    write_set(tmp_path / "again", "object", photos=PHOTO_COUNT, width=PHOTO_WIDTH, seed=3)
    assert contents(tmp_path / "again") == contents(written_set)


def test_another_seed_writes_other_photos(written_set, tmp_path):
    write_set(tmp_path / "other", "object", photos=PHOTO_COUNT, width=PHOTO_WIDTH, seed=4)
    first, other = contents(written_set), contents(tmp_path / "other")
    assert first.keys() == other.keys() and all(first[name] != other[name] for name in first if "cameras" not in name)


@pytest.mark.parametrize("name", LAYOUTS)
def test_depth_maps_agree_with_the_equations_of_the_surfaces(scenes, name):
    scene, rng = scenes[name], np.random.default_rng(0)
    for camera in scene.cameras[::5]:
        depth = render_depth(scene.arrays, camera)
        assert depth.dtype == np.float32
        for x, y in zip(rng.integers(0, PHOTO_WIDTH, 8), rng.integers(0, PHOTO_HEIGHT, 8), strict=True):
            local = np.array([(x + 0.5 - camera.cx) / camera.fx, (y + 0.5 - camera.cy) / camera.fy, 1.0])
            # A vector with the view axis's component 1 makes the distance a depth.
            expected = nearest_hits(scene.arrays, camera.position, camera.rotation.T @ local)
            np.testing.assert_allclose(depth[y, x], expected, rtol=1e-6)


@pytest.mark.parametrize("name", LAYOUTS)
def test_no_camera_is_inside_or_close_to_a_surface(scenes, name):
    for camera in scenes[name].cameras:
        assert render_depth(scenes[name].arrays, camera).min() > 0.12


def test_points_have_tracks_of_visible_photos_and_small_errors(reconstruction, scenes):
    scene, rng = scenes["object"], np.random.default_rng(0)
    errors = []
    for point in reconstruction.points3D.values():
        assert len({element.image_id for element in point.track.elements}) == len(point.track.elements) >= 3
        residuals = []
        for element in point.track.elements:
            camera = scene.cameras[element.image_id - 1]
            local = camera.rotation @ (point.xyz - camera.position)
            pixel = local[:2] / local[2] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
            observed = reconstruction.images[element.image_id].points2D[element.point2D_idx]
            assert observed.point3D_id in reconstruction.points3D
            residuals.append(np.linalg.norm(pixel - observed.xy))
        assert max(residuals) < 6
        np.testing.assert_allclose(point.error, np.mean(residuals), atol=2e-3)
        errors.append(point.error)
    assert 0.2 < np.mean(errors) < 0.8
    for number in rng.choice(sorted(reconstruction.points3D), 12, replace=False):
        point = reconstruction.points3D[number]
        for element in point.track.elements:
            camera = scene.cameras[element.image_id - 1]
            # In such small photos, the noise moves a triangulated point by several percent of its distance.
            hit = nearest_hits(scene.arrays, camera.position, point.xyz - camera.position)
            assert hit > 0.8


def test_points_lie_near_a_surface(reconstruction, scenes):
    scene = scenes["object"]
    distances = []
    for point in reconstruction.points3D.values():
        for element in point.track.elements:
            camera = scene.cameras[element.image_id - 1]
            local = camera.rotation @ (point.xyz - camera.position)
            center = replace(camera, width=1, height=1, cx=0.5 - local[0] / local[2] * camera.fx,
                             cy=0.5 - local[1] / local[2] * camera.fy)  # fmt: skip
            distances.append(abs(render_depth(scene.arrays, center)[0, 0] / local[2] - 1))
    assert np.median(distances) < 0.01


@pytest.mark.parametrize("name", LAYOUTS)
def test_details_are_close_to_the_average_of_details_of_twice_the_size(scenes, name):
    scene = scenes[name]
    for camera in scene.cameras[::4]:
        fx, fy = (
            1600 / PHOTO_WIDTH * camera.fx,
            1600 / PHOTO_WIDTH * camera.fy,
        )  # the middle of a photo that is 1,600 pixels wide
        small = replace(camera, fx=fx, fy=fy)
        large = Camera(
            2 * PHOTO_WIDTH, 2 * PHOTO_HEIGHT, 2 * fx, 2 * fy, PHOTO_WIDTH, PHOTO_HEIGHT, camera.camera_from_world
        )
        fine = render_picture(scene.arrays, large, scene.exposure)
        average = fine.reshape(PHOTO_HEIGHT, 2, PHOTO_WIDTH, 2, 3).mean(axis=(1, 3))
        difference = np.abs(render_picture(scene.arrays, small, scene.exposure) - average).mean()
        # Every other pixel of the larger picture has the aliases of a picture without a filter.
        assert difference < 0.8 * np.abs(fine[::2, ::2] - average).mean() and difference < 0.01


def test_existing_files_are_kept_without_overwrite(written_set, capsys):
    before = contents(written_set)
    with pytest.raises(HyrfError, match="this folder holds files"):
        write_set(written_set, "object", photos=PHOTO_COUNT, width=PHOTO_WIDTH)
    with pytest.raises(SystemExit) as exit_info:
        run_command(lambda: command.main(["--out", str(written_set.parent), "--scenes", "object"]))
    assert exit_info.value.code == 2 and "--overwrite" in capsys.readouterr().err
    assert contents(written_set) == before


def test_a_folder_with_other_files_is_kept_with_overwrite(tmp_path):
    (tmp_path / "object").mkdir()
    (tmp_path / "object" / "notes.txt").write_text("mine")
    with pytest.raises(HyrfError, match=r"notes\.txt"):
        write_set(tmp_path / "object", "object", photos=3, width=48, overwrite=True)
    assert contents(tmp_path) == {"object/notes.txt": b"mine"}


def test_a_set_replaces_an_earlier_one_with_more_photos(tmp_path, capsys):
    arguments = ["--out", str(tmp_path), "--scenes", "object", "--width", "48", "--photos"]
    command.main([*arguments, "4"])
    command.main([*arguments, "3", "--overwrite"])
    assert sorted(os.listdir(tmp_path)) == ["object"]
    assert sorted(os.listdir(tmp_path / "object" / "images")) == ["0000.jpg", "0001.jpg", "0002.jpg"]
    assert "3 photos of 48 x 32 pixels" in capsys.readouterr().out


def test_a_set_without_points_gets_a_note(tmp_path, capsys):
    command.main(["--out", str(tmp_path), "--scenes", "object", "--width", "48", "--photos", "3"])
    assert "0 points" in (printed := capsys.readouterr().out)
    assert f"{tmp_path / 'object'}: it has no points; render more or larger photos" in printed


def test_a_failure_leaves_nothing_half_written(tmp_path, monkeypatch):
    def fail(*arguments: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "make_sparse_points", fail)
    with pytest.raises(KeyboardInterrupt):
        write_set(tmp_path / "sets" / "object", "object", photos=3, width=48)
    assert contents(tmp_path) == {}


@pytest.mark.parametrize(
    "options",
    [["--photos", "2"], ["--width", "20"], ["--seed", "-1"], ["--scenes", "moon"], ["--photos", "many"]],
)
def test_bad_options_are_rejected_with_one_message(tmp_path, capsys, options):
    with pytest.raises(SystemExit) as raised:
        command.main(["--out", str(tmp_path), *options])
    assert raised.value.code == 2 and options[1] in capsys.readouterr().err
    assert not list(tmp_path.iterdir())

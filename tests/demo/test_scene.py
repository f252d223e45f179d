from __future__ import annotations

import numpy as np
import pytest

from hyrfpack.data import load_scene
from hyrfpack.demo.scene import write_demo_scene


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    return write_demo_scene(tmp_path_factory.mktemp("demo"), views=10, size=96)


def test_ordinary_reader_reads_it(demo):
    scene = load_scene(demo)

    assert (scene.layout, len(scene.train), len(scene.test), scene.notes) == ("nerfstudio", 8, 2, [])
    assert 3000 < len(scene.points) < 4500
    assert scene.views[0].load().rgb.shape == (96, 96, 3)


def test_points_lie_on_what_the_pictures_show(demo):
    scene = load_scene(demo)
    shown = np.full((len(scene.views), len(scene.points), 3), np.nan)
    for index, view in enumerate(scene.views):
        local = scene.points @ view.camera.rotation.T + view.camera.camera_from_world[:3, 3]
        u = (view.camera.fx * local[:, 0] / local[:, 2] + view.camera.cx).astype(int)
        v = (view.camera.fy * local[:, 1] / local[:, 2] + view.camera.cy).astype(int)
        inside = (local[:, 2] > 0) & (u >= 0) & (u < 96) & (v >= 0) & (v < 96)
        shown[index, inside] = view.load().rgb[v[inside], u[inside]] / 255

    # Some views have an object in front of the point or a reflection on it; the median view does not.
    usual = np.nanmedian(shown, axis=0)

    assert np.corrcoef(usual.ravel(), scene.point_colors.ravel())[0, 1] > 0.8


def test_cameras_look_at_the_objects_from_all_sides(demo):
    cameras = [view.camera for view in load_scene(demo).views]

    for camera in cameras:
        assert camera.forward @ -camera.position / np.linalg.norm(camera.position) > 0.9
        assert camera.position[2] > 0.3
    angles = np.sort([np.arctan2(camera.position[1], camera.position[0]) for camera in cameras])
    assert np.diff(angles).max() < 1.5


def test_same_seed_writes_the_same_bytes(tmp_path):
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        write_demo_scene(tmp_path / name, views=2, size=32, seed=seed)

    def content(name: str) -> list[bytes]:
        return [file.read_bytes() for file in sorted((tmp_path / name).rglob("*")) if file.is_file()]

    assert content("a") == content("b") != content("c")


def test_senseless_sizes_are_refused(tmp_path):
    with pytest.raises(ValueError, match="2 views"):
        write_demo_scene(tmp_path, views=1)

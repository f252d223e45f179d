"""Record3D's metadata.

The numbers of a real recording are from EXR_RGBD/metadata.json in github.com/YaroslavGladun/door_handle_detection,
whose phone was held upright.
"""

from __future__ import annotations

import json
import zipfile

import numpy as np
import pytest

from hyrfpack.data import load_scene
from hyrfpack.errors import HyrfDataError

REAL_METADATA = {
    "w": 1440,
    "h": 1920,
    "fps": 60,
    "K": [1404.302978515625, 0, 0, 0, 1404.302978515625, 0, 724.6458740234375, 963.78375244140625, 1],
    "poses": [
        [0.24366383, 0.75411069, 0.35214099, -0.49793744, 0.27216407, -0.04384616, 0.95833921],
        [-0.21963354, -0.76376408, -0.30827906, 0.52286642, 0.25601181, -0.04911580, 0.96142214],
        [0.12694686, -0.79674470, 0.19769801, 0.55677449, 0.19070652, -0.36354291, 0.95101261],
    ],
    "initPose": [0, 0, 0, 1, 0, 0, 0],
}


@pytest.fixture
def folder(tmp_path, pictures):
    pictures(tmp_path / "rgbd", ["0.jpg", "1.jpg", "2.jpg"], size=(30, 40))
    (tmp_path / "metadata").write_text(json.dumps(REAL_METADATA))
    return tmp_path


def test_a_phone_held_upright_is_level_in_the_gravity_aligned_world(folder):
    """The picture's rows are horizontal, its top is up, and the camera looks along the middle of the view."""
    for view in load_scene(folder, test_every=0).views:
        right, down, _ = view.camera.rotation
        assert abs(right[1]) < 0.06
        assert -down[1] > 0.6
        np.testing.assert_allclose(view.camera.intrinsics[:2], 1404.303 * 30 / 1440, rtol=1e-6)
        np.testing.assert_allclose(view.camera.intrinsics[2:], (724.6459 / 48, 963.78375 / 48), rtol=1e-6)
    np.testing.assert_allclose(load_scene(folder).views[0].camera.position, REAL_METADATA["poses"][0][4:], atol=1e-7)


def test_each_frame_may_have_its_own_intrinsics(folder):
    own = [[1400.0 + frame, 1400.0, 720.0, 960.0] for frame in range(3)]
    (folder / "metadata").write_text(json.dumps({**REAL_METADATA, "perFrameIntrinsicCoeffs": own}))

    assert load_scene(folder).views[2].camera.fx == pytest.approx(1402 / 48)


def test_the_folders_of_exr_and_jpg_exports_are_read(folder):
    (folder / "EXR_RGBD").mkdir()
    (folder / "metadata").rename(folder / "EXR_RGBD" / "metadata.json")
    (folder / "rgbd").rename(folder / "EXR_RGBD" / "rgb")

    assert load_scene(folder).layout == load_scene(folder / "EXR_RGBD").layout == "record3d"


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"poses": None}, "no list of 'poses'"),
        ({"poses": [[0, 0, 0, 1, 0, 0]]}, "no list of 'poses'"),
        ({"poses": [[0, 0, 0, 0, 0, 0, 0]] * 3}, "not finite"),
        ({"poses": [[0, 0, 0, 1, float("nan"), 0, 0]] * 3}, "no list of 'poses'"),
        ({"K": [1, 2, 3]}, "neither 'K'"),
        ({"K": None}, "neither 'K'"),
        ({"w": 10**400}, "'w'"),
        ({"w": 0}, "unusable intrinsics"),
        ({"w": 1920, "h": 1440}, "not a uniform rescaling"),
    ],
)
def test_broken_metadata_are_a_clear_error(folder, change, says):
    (folder / "metadata").write_text(json.dumps({**REAL_METADATA, **change}))

    with pytest.raises(HyrfDataError, match=says) as caught:
        load_scene(folder)

    assert "\n" not in str(caught.value) and str(folder) in str(caught.value)


def test_a_shared_recording_is_read_from_its_archive(folder, tmp_path_factory, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
    recording = tmp_path_factory.mktemp("shared") / "walk.r3d"
    with zipfile.ZipFile(recording, "w") as archive:
        for file in ("metadata", "rgbd/0.jpg", "rgbd/1.jpg", "rgbd/2.jpg"):
            archive.write(folder / file, file)

    scene = load_scene(recording)

    assert scene.layout == "record3d" and len(scene.views) == 3 and str(recording) in scene.files

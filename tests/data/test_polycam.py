from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image

from hyrfpack.data import load_scene
from hyrfpack.errors import HyrfDataError

# A phone held level, one metre up, looks along the world's -z; axes as in ARKit's documents.
CAMERA_ENTRIES = {"fx": 30.0, "fy": 31.0, "cx": 17.0, "cy": 11.0, "width": 32, "height": 24, "blur_score": 90.0}
CAMERA_ENTRIES |= {"t_00": 1, "t_01": 0, "t_02": 0, "t_10": 0, "t_11": 1, "t_12": 0, "t_20": 0, "t_21": 0, "t_22": 1}
CAMERA_ENTRIES |= {"t_03": 0, "t_13": 1, "t_23": 0}
PHOTO_STEMS = ("1442008525605", "1442008775743")


@pytest.fixture
def folder(tmp_path, pictures):
    """A session with recorded and corrected cameras; the corrected ones are half a metre to the right."""
    for cameras, images, shift in (("cameras", "images", 0.0), ("corrected_cameras", "corrected_images", 0.5)):
        pictures(tmp_path / "keyframes" / images, [f"{stem}.jpg" for stem in PHOTO_STEMS])
        (tmp_path / "keyframes" / cameras).mkdir()
        for index, stem in enumerate(PHOTO_STEMS):
            content = {**CAMERA_ENTRIES, "t_03": shift, "t_23": index}
            (tmp_path / "keyframes" / cameras / f"{stem}.json").write_text(json.dumps(content))
    return tmp_path


def edit_camera(root, **entries) -> None:
    file = root / "keyframes" / "corrected_cameras" / f"{PHOTO_STEMS[1]}.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **entries}))


def test_corrected_cameras_are_preferred(folder):
    scene = load_scene(folder, test_every=0)

    assert (scene.layout, scene.notes) == ("polycam", [])
    np.testing.assert_allclose([view.camera.position for view in scene.views], [(0.5, 1, 0), (0.5, 1, 1)])
    np.testing.assert_allclose(scene.views[0].camera.forward, (0, 0, -1))
    np.testing.assert_allclose(scene.views[0].camera.rotation[1], (0, -1, 0))  # the rows of the picture run downwards
    assert scene.views[0].camera.intrinsics == (30, 31, 17, 11)


def test_recorded_cameras_replace_missing_corrected_ones_with_a_note(folder):
    for file in (folder / "keyframes" / "corrected_cameras").iterdir():
        file.unlink()

    scene = load_scene(folder, test_every=0)

    assert scene.views[0].camera.position[0] == 0 and "tracked by the phone" in scene.notes[0]


@pytest.mark.parametrize(
    ("entries", "says"),
    [
        ({"fx": None}, "has no 'fx'"),
        ({"t_13": "high"}, "'t_13'"),
        ({"t_00": 2}, "not rigid"),
        ({"t_00": float("nan")}, "'t_00'"),
        ({"width": 1e300}, "unusable intrinsics"),
        ({"width": 24, "height": 32}, "not a uniform rescaling"),
        ({"fx": -1}, "unusable intrinsics"),
    ],
)
def test_a_broken_camera_is_a_clear_error(folder, entries, says):
    edit_camera(folder, **entries)

    with pytest.raises(HyrfDataError, match=says) as caught:
        load_scene(folder)

    assert "\n" not in str(caught.value) and str(folder) in str(caught.value)


@pytest.mark.parametrize("content", ["", "[]", "{", "[" * 100_000])
def test_a_camera_that_is_no_json_object_is_a_clear_error(folder, content):
    (folder / "keyframes" / "corrected_cameras" / f"{PHOTO_STEMS[0]}.json").write_text(content)

    with pytest.raises(HyrfDataError, match="JSON"):
        load_scene(folder)


@pytest.mark.parametrize("place", ["keyframes/masks", "masks"])
def test_masks_lie_beside_the_photos_or_in_the_scene(folder, place):
    (folder / place).mkdir()
    for stem in PHOTO_STEMS:
        Image.new("L", (32, 24), 0).save(folder / place / f"{stem}.png")
    assert not any(view.load().mask.any() for view in load_scene(folder, test_every=0).views)

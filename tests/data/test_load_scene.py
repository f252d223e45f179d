from __future__ import annotations

import json
import subprocess
import sys

import pytest

from hyrfpack.data import load_scene
from hyrfpack.errors import HyrfDataError


def test_colmap_comes_before_transforms_and_notes_say_so(tmp_path, colmap_folder, opengl_frames):
    folder = colmap_folder(tmp_path)
    frames, _ = opengl_frames([f"images/{name}" for name in folder.names[:5]])
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 30.0, "frames": frames}))

    preferred, forced = load_scene(tmp_path), load_scene(tmp_path, layout="nerfstudio")

    assert (preferred.layout, len(preferred.views)) == ("colmap", 9)
    assert (forced.layout, len(forced.views)) == ("nerfstudio", 5)
    assert any("colmap was taken" in note for note in preferred.notes)
    assert any("nerfstudio was taken" in note for note in forced.notes)


def test_zero_holds_out_nothing(tmp_path, colmap_folder):
    colmap_folder(tmp_path)

    scene = load_scene(tmp_path, test_every=0)

    assert (len(scene.train), len(scene.test)) == (9, 0)


def test_holding_out_everything_is_refused(tmp_path, colmap_folder):
    colmap_folder(tmp_path)

    with pytest.raises(HyrfDataError, match="none is left to train on"):
        load_scene(tmp_path, test_every=1)


def test_paths_that_are_no_scene_are_refused(tmp_path):
    (tmp_path / "file").write_text("")

    for path, says in (
        (tmp_path / "gone", "no such folder"),
        (tmp_path / "file", "not a folder"),
        (tmp_path, "no poses"),
    ):
        with pytest.raises(HyrfDataError, match=says):
            load_scene(path)


def test_forced_layout_that_is_not_there_is_refused(tmp_path, colmap_folder):
    colmap_folder(tmp_path)

    with pytest.raises(HyrfDataError, match="no blender poses"):
        load_scene(tmp_path, layout="blender")
    with pytest.raises(ValueError, match="no layout"):
        load_scene(tmp_path, layout="llff")


def test_importing_the_readers_loads_no_heavy_library():
    code = "import sys, hyrfpack.data; print([m for m in ('pycolmap', 'trimesh', 'PIL', 'torch') if m in sys.modules])"

    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout

    assert printed.strip() == "[]"

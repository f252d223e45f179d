from __future__ import annotations

import json
import shutil
import subprocess
import sys

import pytest
import trimesh

from hyrfpack.data import load_scene
from hyrfpack.errors import HyrfDataError


def test_colmap_is_preferred_to_transforms_and_that_is_noted(tmp_path, colmap_folder, opengl_frames):
    folder = colmap_folder(tmp_path)
    frames, _ = opengl_frames([f"images/{name}" for name in folder.names[:5]])
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 30.0, "frames": frames}))

    preferred, forced = load_scene(tmp_path), load_scene(tmp_path, layout="nerfstudio")

    assert (preferred.layout, len(preferred.views)) == ("colmap", 9)
    assert (forced.layout, len(forced.views)) == ("nerfstudio", 5)
    assert any("colmap is used" in note for note in preferred.notes)
    assert any("nerfstudio is used" in note for note in forced.notes)


def test_test_every_0_holds_out_nothing(tmp_path, colmap_folder):
    colmap_folder(tmp_path)

    scene = load_scene(tmp_path, test_every=0)

    assert (len(scene.train), len(scene.test)) == (9, 0)


def test_named_photos_are_held_out_instead_of_every_nth(tmp_path, colmap_folder):
    colmap_folder(tmp_path)

    scene = load_scene(tmp_path, held_out=["004.png"], test_every=2)

    assert [view.name for view in scene.test] == ["004.png"] and len(scene.train) == 8
    assert load_scene(**scene.reading).test[0].name == "004.png"


def test_holding_out_an_unknown_name_is_rejected(tmp_path, colmap_folder):
    colmap_folder(tmp_path)

    with pytest.raises(HyrfDataError, match="no photo is named 999.png"):
        load_scene(tmp_path, held_out=["999.png"])


def test_holding_out_everything_is_rejected(tmp_path, colmap_folder):
    colmap_folder(tmp_path)

    with pytest.raises(HyrfDataError, match="none is left to train on"):
        load_scene(tmp_path, test_every=1)


def test_paths_without_a_scene_are_rejected(tmp_path):
    (tmp_path / "file").write_text("")

    for path, says in (
        (tmp_path / "gone", "no such folder"),
        (tmp_path / "file", "not a folder"),
        (tmp_path, "no poses"),
    ):
        with pytest.raises(HyrfDataError, match=says):
            load_scene(path)


def test_a_requested_layout_that_is_missing_is_rejected(tmp_path, colmap_folder):
    colmap_folder(tmp_path)

    with pytest.raises(HyrfDataError, match="no blender poses"):
        load_scene(tmp_path, layout="blender")
    with pytest.raises(ValueError, match="no layout"):
        load_scene(tmp_path, layout="openmvg")


@pytest.mark.integration
def test_importing_the_readers_loads_no_heavy_library():
    code = "import sys, hyrfpack.data; print([m for m in ('pycolmap', 'trimesh', 'PIL', 'torch') if m in sys.modules])"

    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout

    assert printed.strip() == "[]"


def test_a_scene_lists_every_file_that_it_is_read_from(tmp_path, colmap_folder, nerfstudio_folder):
    colmap_folder(tmp_path, count=3)
    (tmp_path / "masks").mkdir()
    shutil.copy(tmp_path / "images" / "001.png", tmp_path / "masks" / "001.png")
    (tmp_path / "stray.txt").write_text("not read")
    pictures = {"images/000.png", "images/001.png", "images/002.png", "masks/001.png"}
    nerfstudio_folder(3, ply_file_path="points.ply")
    trimesh.PointCloud([[0.0, 0.0, 1.0]]).export(tmp_path / "points.ply")

    colmap = load_scene(tmp_path, layout="colmap").files
    nerfstudio = load_scene(tmp_path, layout="nerfstudio").files

    tables = {f"sparse/0/{table}.bin" for table in ("cameras", "images", "points3D")}
    assert sorted(colmap) == sorted(str(tmp_path / name) for name in tables | pictures)
    assert sorted(nerfstudio) == sorted(str(tmp_path / name) for name in {"transforms.json", "points.ply"} | pictures)

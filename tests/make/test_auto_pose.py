"""Poses in the folder of a training run belong to its photos."""

from __future__ import annotations

import shutil

import pytest

from hyrfpack.errors import HyrfError
from hyrfpack.make.auto_pose import auto_pose


def test_poses_are_estimated_once_for_the_same_photos_wherever_they_lie(photos, poses, tmp_path):
    scene = auto_pose(photos, tmp_path / "run")
    moved = photos.rename(tmp_path / "moved")
    assert auto_pose(moved, tmp_path / "run", resume=True) == scene == tmp_path / "run" / "scene"
    assert poses == [photos]


def test_poses_of_other_photos_are_refused_unless_they_may_be_replaced(photos, poses, tmp_path):
    auto_pose(photos, tmp_path / "run")
    shutil.copy(sorted(photos.iterdir())[0], photos / "one_more.png")
    for resume in (False, True):
        with pytest.raises(HyrfError, match="scene: these poses were estimated from other photos.*overwrite=True"):
            auto_pose(photos, tmp_path / "run", resume=resume)
    auto_pose(photos, tmp_path / "run", overwrite=True)
    auto_pose(photos, tmp_path / "run", resume=True)
    assert poses == [photos, photos]


def test_poses_depend_on_masks_but_not_on_other_files_beside_them(photos, poses, tmp_path):
    (photos / "masks").mkdir()
    shutil.copy(next(photos.glob("*.png")), photos / "masks")
    auto_pose(photos, tmp_path / "run")
    (photos / "masks" / ".DS_Store").write_bytes(b"written by a file manager")
    (photos / "masks" / "Thumbs.db").write_bytes(b"written by a file manager")
    auto_pose(photos, tmp_path / "run", resume=True)

    shutil.copy(sorted(photos.glob("*.png"))[1], photos / "masks")

    with pytest.raises(HyrfError, match="these poses were estimated from other photos"):
        auto_pose(photos, tmp_path / "run", resume=True)

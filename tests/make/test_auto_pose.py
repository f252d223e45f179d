"""Poses in the folder of a training run belong to its photos."""

from __future__ import annotations

import shutil
import sys

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


class KilledError(BaseException):
    """Stands for a kill: nothing in the library handles it."""


@pytest.fixture
def kill_after_estimation(poses, monkeypatch):
    """The next estimation of poses is finished, and then the process is killed."""
    module = sys.modules["hyrfpack.poses"]

    def estimate_and_die(*arguments, **options):
        finished(*arguments, **options)
        module.estimate_poses = finished
        raise KilledError

    finished = module.estimate_poses
    monkeypatch.setattr(module, "estimate_poses", estimate_and_die)


def add_photo(photos):
    shutil.copy(sorted(photos.iterdir())[0], photos / "one_more.png")


@pytest.mark.usefixtures("kill_after_estimation")
def test_a_kill_right_after_the_estimation_does_not_leave_poses_without_a_record(photos, poses, tmp_path):
    with pytest.raises(KilledError):
        auto_pose(photos, tmp_path / "run")

    auto_pose(photos, tmp_path / "run")
    assert poses == [photos], "the poses are reused"
    add_photo(photos)
    with pytest.raises(HyrfError, match="these poses were estimated from other photos"):
        auto_pose(photos, tmp_path / "run")


def test_a_kill_while_poses_are_replaced_does_not_leave_the_record_of_other_photos(photos, poses, tmp_path, request):
    auto_pose(photos, tmp_path / "run")
    old = (tmp_path / "run" / "scene" / "photos.digest").read_bytes()
    add_photo(photos)
    request.getfixturevalue("kill_after_estimation")
    with pytest.raises(KilledError):
        auto_pose(photos, tmp_path / "run", overwrite=True)

    (photos / "one_more.png").unlink()
    with pytest.raises(HyrfError, match=r"no record \(photos.digest\) of the photos.*overwrite=True"):
        auto_pose(photos, tmp_path / "run")
    auto_pose(photos, tmp_path / "run", overwrite=True)
    assert (tmp_path / "run" / "scene" / "photos.digest").read_bytes() == old


def test_a_failed_estimation_leaves_what_was_there(photos, poses, tmp_path, monkeypatch):
    def fail(*arguments, **options):
        raise HyrfError("the photos do not overlap", fix="take more")

    usual = sys.modules["hyrfpack.poses"].estimate_poses
    monkeypatch.setattr(sys.modules["hyrfpack.poses"], "estimate_poses", fail)
    with pytest.raises(HyrfError, match="do not overlap"):
        auto_pose(photos, tmp_path / "run")
    assert not (tmp_path / "run").exists()

    monkeypatch.setattr(sys.modules["hyrfpack.poses"], "estimate_poses", usual)
    auto_pose(photos, tmp_path / "run")
    old = (tmp_path / "run" / "scene" / "photos.digest").read_bytes()
    add_photo(photos)
    monkeypatch.setattr(sys.modules["hyrfpack.poses"], "estimate_poses", fail)
    with pytest.raises(HyrfError, match="do not overlap"):
        auto_pose(photos, tmp_path / "run", overwrite=True)
    assert (tmp_path / "run" / "scene" / "photos.digest").read_bytes() == old

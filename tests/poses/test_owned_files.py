"""Nothing is removed from a scene's folder but what an estimation put there and does not read."""

from __future__ import annotations

import errno
import os
import shutil
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import hyrfpack
from hyrfpack.lock import exclusive_folder
from hyrfpack.poses.job import Job
from hyrfpack.poses.owned_files import unchanged_files


def photos(folder: Path, seed: int = 0, count: int = 4) -> Path:
    folder.mkdir(parents=True)
    rng = np.random.default_rng(seed)
    for number in range(count):
        Image.fromarray(rng.integers(0, 255, (20, 30, 3), np.uint8)).save(folder / f"{number}.png")
    return folder


def begin(source: Path, scene: Path, **settings) -> None:
    """Estimate until the photos are made ready."""

    def stop(*arguments) -> None:
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("hyrfpack.poses.estimate.run_stage", stop)
        hyrfpack.estimate_poses(source, scene, **settings)


def finished(source: Path, scene: Path, **settings) -> None:
    """Estimate, with answers of stages that are made up, and an empty model."""

    def answer(job: Path, stage: str, *more) -> dict:
        (job.parent / "chosen").mkdir(exist_ok=True)
        names = Job.load(job).names
        return {
            "features": {"keypoints": dict.fromkeys(names, 99), "sharpness": dict.fromkeys(names, 1), "unreadable": {}},
            "matches": {"matched": names, "pairs": 6, "turned": 0},
            "finish": {"registered": names, "sure": names, "apart": [], "mapper": "global", "why": "", "doubt": "",
                       "angle": 30},
        }.get(stage, {"models": []})  # fmt: skip

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hyrfpack.poses.estimate.run_stage", answer)
        hyrfpack.estimate_poses(source, scene, **settings)


def pictures(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.glob("*.png"))


def same_bytes(first: Path, second: Path) -> bool:
    return first.read_bytes() == second.read_bytes()


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_copies_that_are_all_that_is_left_of_the_photos_are_posed_again_in_place(tmp_path):
    finished(photos(tmp_path / "photos"), tmp_path / "scene")
    shutil.rmtree(tmp_path / "photos")
    for source in (tmp_path / "scene", tmp_path / "scene" / "images"):
        begin(source, tmp_path / "scene", overwrite=True)
        assert pictures(tmp_path / "scene" / "images") == ["0.png", "1.png", "2.png", "3.png"]
        finished(source, tmp_path / "scene", overwrite=True)
        assert pictures(tmp_path / "scene" / "images") == ["0.png", "1.png", "2.png", "3.png"]


def test_photos_beside_the_copies_of_them_continue_where_they_were(tmp_path):
    scene, said = photos(tmp_path / "scene"), []
    begin(scene, scene)
    begin(scene, scene, say=said.append)
    assert said[0] == "resuming an interrupted estimation"
    begin(scene, scene, seed=1)
    finished(scene, scene, seed=1)
    assert pictures(scene) == pictures(scene / "images") == ["0.png", "1.png", "2.png", "3.png"]


def test_other_photos_take_the_place_of_those_that_we_put_there_and_of_no_others(tmp_path):
    finished(photos(tmp_path / "photos"), tmp_path / "scene")
    begin(photos(tmp_path / "others", 1), tmp_path / "scene", overwrite=True)
    images = tmp_path / "scene" / "images"
    assert same_bytes(images / "0.png", tmp_path / "photos" / "0.png")  # as long as there are no new poses
    finished(tmp_path / "others", tmp_path / "scene", overwrite=True)
    assert same_bytes(images / "0.png", tmp_path / "others" / "0.png")
    Image.new("RGB", (30, 20)).save(images / "mine.png")
    with pytest.raises(hyrfpack.HyrfError, match="do not belong to these photos"):
        hyrfpack.estimate_poses(tmp_path / "photos", tmp_path / "scene", overwrite=True)
    assert pictures(images) == ["0.png", "1.png", "2.png", "3.png", "mine.png"]


def test_photos_that_are_rejected_leave_what_is_there(tmp_path):
    finished(photos(tmp_path / "photos"), tmp_path / "scene")
    (tmp_path / "none").mkdir()
    with pytest.raises(hyrfpack.HyrfDataError, match="no photos here"):
        hyrfpack.estimate_poses(tmp_path / "none", tmp_path / "scene", overwrite=True)
    assert len(pictures(tmp_path / "scene" / "images")) == 4


def test_a_call_that_fails_leaves_old_poses_with_their_own_photos(tmp_path, monkeypatch):
    scene = tmp_path / "scene"
    finished(photos(tmp_path / "photos"), scene)
    before = contents(scene)

    def refuse(*arguments) -> dict:
        raise hyrfpack.HyrfDataError("these photos cannot be matched", fix="take others")

    monkeypatch.setattr("hyrfpack.poses.estimate.run_stage", refuse)
    with pytest.raises(hyrfpack.HyrfDataError, match="cannot be matched"):
        hyrfpack.estimate_poses(photos(tmp_path / "others", 1), scene, overwrite=True)
    assert contents(scene) == before


@pytest.mark.parametrize("moment", range(7))
def test_old_poses_never_lie_beside_new_photos(moment, tmp_path, monkeypatch):
    """Killed at any moment of the end: what lies there then is of one estimation, and the same call resumes."""
    scene, replace = tmp_path / "scene", os.replace
    finished(photos(tmp_path / "photos"), scene)
    photos(tmp_path / "others", 1)
    calls: list[Path] = []

    def kill(source: Path, target: Path) -> None:
        if calls or target.name == "replaced":
            calls.append(target)
        if len(calls) > moment:
            raise KeyboardInterrupt
        replace(source, target)

    with monkeypatch.context() as patch, suppress(KeyboardInterrupt):
        patch.setattr("os.replace", kill)
        finished(tmp_path / "others", scene, overwrite=True)
    assert [path.name for path in calls] == ["replaced", "poses.json", "images", "poses.json", "0", "sparse"][
        : moment + 1
    ]
    if (scene / "sparse").exists():
        source = "photos" if moment == 0 else "others"
        assert all(same_bytes(scene / "images" / f"{n}.png", tmp_path / source / f"{n}.png") for n in range(4))
    if moment < 6:
        finished(tmp_path / "others", scene, overwrite=moment == 0)
    assert same_bytes(scene / "images" / "0.png", tmp_path / "others" / "0.png")
    assert sorted(os.listdir(scene)) == ["images", "poses.json", "sparse"]


def test_what_is_rejected_or_fails_before_anything_is_done_leaves_nothing(tmp_path, monkeypatch):
    out = tmp_path / "new" / "scene"
    with pytest.raises(hyrfpack.HyrfDataError, match="2 photos are too few"):
        hyrfpack.estimate_poses(photos(tmp_path / "two", count=2), out)

    def refuse(*arguments) -> dict:
        raise hyrfpack.HyrfDataError("these photos cannot be matched", fix="take others")

    monkeypatch.setattr("hyrfpack.poses.estimate.run_stage", refuse)
    with pytest.raises(hyrfpack.HyrfDataError, match="cannot be matched"):
        hyrfpack.estimate_poses(photos(tmp_path / "photos"), out)

    def full(*arguments) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("hyrfpack.poses.estimate.make_images", full)
    with pytest.raises(hyrfpack.HyrfError, match="the disk is full"):
        hyrfpack.estimate_poses(tmp_path / "photos", out)
    assert sorted(os.listdir(tmp_path)) == ["photos", "two"]


def test_two_calls_for_one_scene_are_kept_apart(tmp_path):
    pytest.importorskip("fcntl", reason="locks are of Unix")
    scene = tmp_path / "scene"
    with exclusive_folder(scene), pytest.raises(hyrfpack.HyrfError) as refusal:
        hyrfpack.estimate_poses(photos(tmp_path / "photos"), scene)
    assert str(refusal.value) == (
        f"{scene}: another hyrfpack command is at work in this folder; wait until it has ended, or name another folder"
    )
    assert not scene.exists()
    begin(tmp_path / "photos", scene)


def test_poses_that_another_program_puts_there_meanwhile_are_kept_and_the_work_too(tmp_path):
    scene = tmp_path / "scene"

    def appear(doing: str, share: float) -> None:
        (scene / "sparse" / "0").mkdir(parents=True, exist_ok=True)
        (scene / "sparse" / "0" / "cameras.bin").write_bytes(b"of another program")

    with pytest.raises(hyrfpack.HyrfError, match="poses of another program, which are kept"):
        finished(photos(tmp_path / "photos"), scene, report=appear)
    assert (scene / "sparse" / "0" / "cameras.bin").read_bytes() == b"of another program"
    shutil.rmtree(scene / "sparse")
    said = []
    finished(tmp_path / "photos", scene, say=said.append)
    assert said[0] == "resuming an interrupted estimation" and (scene / "sparse" / "0").is_dir()


def test_masks_that_lie_there_are_not_taken_for_those_that_were_named(tmp_path):
    photos(tmp_path / "photos")
    for folder, level in (("named", 255), ("scene/masks", 0)):
        (tmp_path / folder).mkdir(parents=True)
        Image.new("L", (30, 20), level).save(tmp_path / folder / "0.png")
    with pytest.raises(hyrfpack.HyrfError, match="masks: the folder holds files that do not belong to these photos"):
        hyrfpack.estimate_poses(tmp_path / "photos", tmp_path / "scene", masks=tmp_path / "named")
    shutil.rmtree(tmp_path / "scene" / "masks")
    finished(tmp_path / "photos", tmp_path / "scene", masks=tmp_path / "named")
    assert same_bytes(tmp_path / "scene" / "masks" / "0.png.png", tmp_path / "named" / "0.png")


@pytest.mark.parametrize("forged", ["{", "[]", '{"made": ["images"]}'])
def test_a_report_of_another_program_gives_nothing_away(forged, tmp_path):
    finished(photos(tmp_path / "photos"), tmp_path / "scene")
    (tmp_path / "scene" / "poses.json").write_text(forged)
    with pytest.raises(hyrfpack.HyrfError, match="poses of another program"):
        hyrfpack.estimate_poses(tmp_path / "photos", tmp_path / "scene", overwrite=True)
    assert (tmp_path / "scene" / "sparse" / "0").is_dir()


def test_a_record_lists_nothing_outside_the_scene_nor_what_has_changed(tmp_path):
    photos(tmp_path / "photos")
    images = photos(tmp_path / "scene" / "images")
    size = (images / "0.png").stat().st_size
    (tmp_path / "scene" / "masks").symlink_to(tmp_path / "photos")
    (tmp_path / "scene" / "own.txt").write_text("mine")
    forged = {
        "images/0.png": size,
        "images/1.png": 1,
        "images/../../photos/0.png": size,
        "masks/0.png": size,
        str(tmp_path / "photos" / "0.png"): size,
        "own.txt": 4,
        "": 0,
    }
    assert unchanged_files(tmp_path / "scene", forged) == {"images/0.png": size}

"""An estimation removes only those files from a scene's folder that it has written and does not read."""

from __future__ import annotations

import errno
import json
import os
import shutil
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import hyrfpack
from hyrfpack.context import RunContext
from hyrfpack.lock import exclusive_folder
from hyrfpack.poses.job import Job
from hyrfpack.poses.owned_files import unchanged_files
from hyrfpack.progress import TaskEvent


def write_photos(folder: Path, seed: int = 0, count: int = 4) -> Path:
    folder.mkdir(parents=True)
    rng = np.random.default_rng(seed)
    for number in range(count):
        Image.fromarray(rng.integers(0, 255, (20, 30, 3), np.uint8)).save(folder / f"{number}.png")
    return folder


def prepare_photos(source: Path, scene: Path, **settings) -> None:
    """Estimate poses until the photos are prepared."""

    def stop(*arguments) -> None:
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("hyrfpack.poses.estimate.run_stage", stop)
        hyrfpack.estimate_poses(source, scene, **settings)


def estimate_with_fake_stages(source: Path, scene: Path, at_end=lambda: None, **settings) -> None:
    """Estimate poses with fake results of the stages and a fake model; `at_end` is called in the last stage."""

    def answer(job: Path, stage: str, *more) -> dict:
        (job.parent / "chosen").mkdir(exist_ok=True)
        (job.parent / "chosen" / "cameras.bin").write_bytes(b"cameras")
        if stage == "finish":
            at_end()
        names = Job.load(job).names
        return {
            "features": {"keypoints": dict.fromkeys(names, 99), "sharpness": dict.fromkeys(names, 1), "unreadable": {}},
            "matches": {"matched": names, "pairs": 6, "turned": 0},
            "finish": {"registered": names, "sure": names, "in_other_pieces": [], "mapper": "global", "why": "",
                       "warning": "", "angle": 30},
        }.get(stage, {"models": []})  # fmt: skip

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hyrfpack.poses.estimate.run_stage", answer)
        hyrfpack.estimate_poses(source, scene, **settings)


def png_names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.glob("*.png"))


def same_bytes(first: Path, second: Path) -> bool:
    return first.read_bytes() == second.read_bytes()


def read_files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_copies_whose_originals_are_gone_are_posed_again_in_place(tmp_path):
    estimate_with_fake_stages(write_photos(tmp_path / "photos"), tmp_path / "scene")
    shutil.rmtree(tmp_path / "photos")
    for source in (tmp_path / "scene", tmp_path / "scene" / "images"):
        prepare_photos(source, tmp_path / "scene", overwrite=True)
        assert png_names(tmp_path / "scene" / "images") == ["0.png", "1.png", "2.png", "3.png"]
        estimate_with_fake_stages(source, tmp_path / "scene", overwrite=True)
        assert png_names(tmp_path / "scene" / "images") == ["0.png", "1.png", "2.png", "3.png"]


def test_an_estimation_resumes_from_the_original_photos_beside_their_copies(tmp_path, caplog):
    scene = write_photos(tmp_path / "scene")
    prepare_photos(scene, scene)
    caplog.clear()
    prepare_photos(scene, scene)
    assert caplog.messages[0] == "resuming an interrupted estimation"
    prepare_photos(scene, scene, config=hyrfpack.PosesConfig(seed=1))
    estimate_with_fake_stages(scene, scene, config=hyrfpack.PosesConfig(seed=1))
    assert png_names(scene) == png_names(scene / "images") == ["0.png", "1.png", "2.png", "3.png"]


def test_new_photos_replace_only_earlier_copies_and_no_other_files(tmp_path):
    estimate_with_fake_stages(write_photos(tmp_path / "photos"), tmp_path / "scene")
    prepare_photos(write_photos(tmp_path / "others", 1), tmp_path / "scene", overwrite=True)
    images = tmp_path / "scene" / "images"
    assert same_bytes(images / "0.png", tmp_path / "photos" / "0.png")  # until there are new poses
    estimate_with_fake_stages(tmp_path / "others", tmp_path / "scene", overwrite=True)
    assert same_bytes(images / "0.png", tmp_path / "others" / "0.png")
    Image.new("RGB", (30, 20)).save(images / "mine.png")
    with pytest.raises(hyrfpack.HyrfError, match="do not belong to these photos"):
        hyrfpack.estimate_poses(tmp_path / "photos", tmp_path / "scene", overwrite=True)
    assert png_names(images) == ["0.png", "1.png", "2.png", "3.png", "mine.png"]


def test_rejected_photos_leave_the_scene_unchanged(tmp_path):
    estimate_with_fake_stages(write_photos(tmp_path / "photos"), tmp_path / "scene")
    (tmp_path / "none").mkdir()
    with pytest.raises(hyrfpack.HyrfDataError, match="no photos here"):
        hyrfpack.estimate_poses(tmp_path / "none", tmp_path / "scene", overwrite=True)
    assert len(png_names(tmp_path / "scene" / "images")) == 4


def test_a_failed_call_keeps_old_poses_with_their_photos(tmp_path, monkeypatch):
    scene = tmp_path / "scene"
    estimate_with_fake_stages(write_photos(tmp_path / "photos"), scene)
    before = read_files(scene)

    def refuse(*arguments) -> dict:
        raise hyrfpack.HyrfDataError("these photos cannot be matched", fix="take others")

    monkeypatch.setattr("hyrfpack.poses.estimate.run_stage", refuse)
    with pytest.raises(hyrfpack.HyrfDataError, match="cannot be matched"):
        hyrfpack.estimate_poses(write_photos(tmp_path / "others", 1), scene, overwrite=True)
    assert read_files(scene) == before


@pytest.mark.parametrize("moment", range(7))
def test_old_poses_never_lie_beside_new_photos(moment, tmp_path, monkeypatch):
    """After a kill at any moment of the final moves all files belong to one estimation, and the same call resumes."""
    scene, replace = tmp_path / "scene", os.replace
    estimate_with_fake_stages(write_photos(tmp_path / "photos"), scene)
    write_photos(tmp_path / "others", 1)
    calls: list[Path] = []

    def kill(source: Path, target: Path) -> None:
        if calls or target.name == "replaced":
            calls.append(target)
        if len(calls) > moment:
            raise KeyboardInterrupt
        replace(source, target)

    with monkeypatch.context() as patch, suppress(KeyboardInterrupt):
        patch.setattr("os.replace", kill)
        estimate_with_fake_stages(tmp_path / "others", scene, overwrite=True)
    assert [path.name for path in calls] == ["replaced", "poses.json", "images", "poses.json", "0", "sparse"][
        : moment + 1
    ]
    if (scene / "sparse").exists():
        source = "photos" if moment == 0 else "others"
        assert all(same_bytes(scene / "images" / f"{n}.png", tmp_path / source / f"{n}.png") for n in range(4))
    if moment < 6:
        estimate_with_fake_stages(tmp_path / "others", scene, overwrite=moment == 0)
    assert same_bytes(scene / "images" / "0.png", tmp_path / "others" / "0.png")
    assert sorted(os.listdir(scene)) == ["images", "poses.json", "sparse"]


def test_an_early_error_leaves_no_files(tmp_path, monkeypatch):
    out = tmp_path / "new" / "scene"
    with pytest.raises(hyrfpack.HyrfDataError, match="2 photos are too few"):
        hyrfpack.estimate_poses(write_photos(tmp_path / "two", count=2), out)

    def refuse(*arguments) -> dict:
        raise hyrfpack.HyrfDataError("these photos cannot be matched", fix="take others")

    monkeypatch.setattr("hyrfpack.poses.estimate.run_stage", refuse)
    with pytest.raises(hyrfpack.HyrfDataError, match="cannot be matched"):
        hyrfpack.estimate_poses(write_photos(tmp_path / "photos"), out)

    def full(*arguments) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("hyrfpack.poses.estimate.make_images", full)
    with pytest.raises(hyrfpack.HyrfError, match="the disk is full"):
        hyrfpack.estimate_poses(tmp_path / "photos", out)
    assert sorted(os.listdir(tmp_path)) == ["photos", "two"]


def test_a_second_call_for_the_same_scene_is_rejected(tmp_path):
    pytest.importorskip("fcntl", reason="locks are of Unix")
    scene = tmp_path / "scene"
    with exclusive_folder(scene), pytest.raises(hyrfpack.HyrfError) as refusal:
        hyrfpack.estimate_poses(write_photos(tmp_path / "photos"), scene)
    assert str(refusal.value) == (
        f"{scene}: another hyrfpack command is at work in this folder; wait until it has ended, or name another folder"
    )
    assert not scene.exists()
    prepare_photos(tmp_path / "photos", scene)


def test_poses_that_another_program_writes_meanwhile_are_kept_and_so_is_the_work(tmp_path, caplog):
    scene = tmp_path / "scene"

    def appear(event: TaskEvent) -> None:
        (scene / "sparse" / "0").mkdir(parents=True, exist_ok=True)
        (scene / "sparse" / "0" / "cameras.bin").write_bytes(b"of another program")

    with pytest.raises(hyrfpack.HyrfError, match="poses of another program, which are kept"):
        estimate_with_fake_stages(write_photos(tmp_path / "photos"), scene, context=RunContext(progress=appear))
    assert (scene / "sparse" / "0" / "cameras.bin").read_bytes() == b"of another program"
    shutil.rmtree(scene / "sparse")
    caplog.clear()
    estimate_with_fake_stages(tmp_path / "photos", scene)
    assert caplog.messages[0] == "resuming an interrupted estimation" and (scene / "sparse" / "0").is_dir()


@pytest.mark.parametrize("name", ["sparse/1/cameras.bin", "sparse/0/points3D.ply"])
@pytest.mark.parametrize("has_list", [True, False], ids=["", "report of an earlier version"])
def test_files_beside_the_model_are_never_removed(name, has_list, tmp_path):
    scene, photos = tmp_path / "scene", write_photos(tmp_path / "photos")
    estimate_with_fake_stages(photos, scene)
    if not has_list:
        report = json.loads((scene / "poses.json").read_text())
        assert list(report.pop("model_files")) == ["sparse/0/cameras.bin"]
        (scene / "poses.json").write_text(json.dumps(report))
    (scene / "sparse" / ".DS_Store").write_bytes(b"of the file manager")
    (scene / name).parent.mkdir(exist_ok=True)
    (scene / name).write_bytes(b"mine")
    with pytest.raises(hyrfpack.HyrfError, match=f"{name}: this file would be removed, but no estimation"):
        estimate_with_fake_stages(photos, scene, overwrite=True)
    assert (scene / name).read_bytes() == b"mine"
    (scene / name).unlink()
    estimate_with_fake_stages(photos, scene, overwrite=True)


def test_an_edited_photo_of_the_same_size_is_kept_and_a_copied_one_is_replaced(tmp_path):
    scene, photos = tmp_path / "scene", write_photos(tmp_path / "photos")
    estimate_with_fake_stages(photos, scene)
    photo = scene / "images" / "0.png"
    written = photo.read_bytes()
    photo.write_bytes(written[:-1] + b"x")
    with pytest.raises(hyrfpack.HyrfError, match="images: the folder holds files that do not belong"):
        estimate_with_fake_stages(photos, scene, overwrite=True)
    photo.write_bytes(written)
    os.utime(photo, (1, 1))
    estimate_with_fake_stages(photos, scene, overwrite=True)


def test_a_refined_model_of_the_same_size_is_kept(tmp_path):
    scene, photos = tmp_path / "scene", write_photos(tmp_path / "photos")
    estimate_with_fake_stages(photos, scene)
    (scene / "sparse" / "0" / "cameras.bin").write_bytes(b"refined")
    with pytest.raises(hyrfpack.HyrfError, match=r"cameras\.bin: this file would be removed"):
        estimate_with_fake_stages(photos, scene, overwrite=True)
    assert (scene / "sparse" / "0" / "cameras.bin").read_bytes() == b"refined"


def test_a_model_that_was_replaced_is_kept(tmp_path):
    scene, photos = tmp_path / "scene", write_photos(tmp_path / "photos")
    estimate_with_fake_stages(photos, scene)
    estimate_with_fake_stages(photos, scene, overwrite=True)
    (scene / "sparse" / "0" / "cameras.bin").write_bytes(b"of another program")
    with pytest.raises(hyrfpack.HyrfError, match=r"cameras\.bin: this file would be removed"):
        estimate_with_fake_stages(photos, scene, overwrite=True)
    assert (scene / "sparse" / "0" / "cameras.bin").read_bytes() == b"of another program"


@pytest.mark.parametrize("name", [".DS_Store", "Thumbs.db"])
def test_files_of_file_managers_do_not_stand_in_the_way(name, tmp_path):
    scene = tmp_path / "scene"
    estimate_with_fake_stages(write_photos(tmp_path / "photos"), scene)
    (scene / "images" / name).write_bytes(b"of the file manager")
    estimate_with_fake_stages(write_photos(tmp_path / "others", seed=1), scene, overwrite=True)
    assert (scene / "sparse" / "0").is_dir() and same_bytes(scene / "images" / "0.png", tmp_path / "others" / "0.png")


def test_a_folder_with_nothing_but_files_of_file_managers_counts_as_empty(tmp_path):
    scene = tmp_path / "scene"
    (scene / "images").mkdir(parents=True)
    (scene / "images" / ".DS_Store").write_bytes(b"of the file manager")
    estimate_with_fake_stages(write_photos(tmp_path / "photos"), scene)
    assert png_names(scene / "images") == png_names(tmp_path / "photos")


def test_a_file_that_appears_during_the_estimation_leaves_old_photos_and_poses(tmp_path):
    scene = tmp_path / "scene"
    estimate_with_fake_stages(write_photos(tmp_path / "photos"), scene)

    def appear() -> None:
        assert (scene / ".poses" / "images").is_dir()
        (scene / "images" / "mine.txt").write_text("mine")

    with pytest.raises(hyrfpack.HyrfError, match="images: the folder holds files that do not belong"):
        estimate_with_fake_stages(write_photos(tmp_path / "others", seed=1), scene, appear, overwrite=True)
    assert (scene / "sparse" / "0").is_dir() and same_bytes(scene / "images" / "0.png", tmp_path / "photos" / "0.png")


def test_leftover_masks_are_not_used_in_place_of_the_given_ones(tmp_path):
    write_photos(tmp_path / "photos")
    for folder, level in (("named", 255), ("scene/masks", 0)):
        (tmp_path / folder).mkdir(parents=True)
        Image.new("L", (30, 20), level).save(tmp_path / folder / "0.png")
    with pytest.raises(hyrfpack.HyrfError, match="masks: the folder holds files that do not belong to these photos"):
        hyrfpack.estimate_poses(tmp_path / "photos", tmp_path / "scene", masks=tmp_path / "named")
    shutil.rmtree(tmp_path / "scene" / "masks")
    estimate_with_fake_stages(tmp_path / "photos", tmp_path / "scene", masks=tmp_path / "named")
    assert same_bytes(tmp_path / "scene" / "masks" / "0.png.png", tmp_path / "named" / "0.png")


@pytest.mark.parametrize("forged", ["{", "[]", '{"made": ["images"]}'])
def test_files_listed_by_a_forged_record_are_not_replaced(forged, tmp_path):
    estimate_with_fake_stages(write_photos(tmp_path / "photos"), tmp_path / "scene")
    (tmp_path / "scene" / "poses.json").write_text(forged)
    with pytest.raises(hyrfpack.HyrfError, match="poses of another program"):
        hyrfpack.estimate_poses(tmp_path / "photos", tmp_path / "scene", overwrite=True)
    assert (tmp_path / "scene" / "sparse" / "0").is_dir()


def test_a_record_lists_only_unchanged_files_inside_the_scene(tmp_path):
    write_photos(tmp_path / "photos")
    images = write_photos(tmp_path / "scene" / "images")
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
        "images/2.png": [size],
        "images/3.png": None,
    }
    assert unchanged_files(tmp_path / "scene", forged) == {"images/0.png": size}

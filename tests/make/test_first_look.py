"""The first look: reduced photos, a coarse model that only an observer sees, and no effect on the result."""

from __future__ import annotations

import logging
import shutil
import sys
from functools import partial
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from PIL import Image
from scenes import QUIET_CONTEXT

from hyrfpack.config.make import MakeConfig
from hyrfpack.errors import HyrfDataError
from hyrfpack.make import Stopped, first_look, make_scene

pytestmark = pytest.mark.usefixtures("quick_calibration")
ORIENTATION_TAG = 0x0112


@pytest.fixture(autouse=True)
def short_first_look(monkeypatch) -> None:
    """A first look of few steps on the small photos of these tests."""
    monkeypatch.setattr(first_look, "MAX_PHOTO_SIZE", 16)
    monkeypatch.setattr(first_look, "FIRST_LOOK_STEPS", 3)


@pytest.fixture
def make(photos, tmp_path):
    """`make_scene` on the photos without poses."""
    return partial(make_scene, photos, tmp_path / "scene.hyrf", MakeConfig(quality="draft"), context=QUIET_CONTEXT)


@pytest.mark.acceptance
def test_an_observer_sees_a_first_look_before_the_training_and_gets_the_same_result(make, photos, poses, tmp_path):
    kinds, steps = [], []

    def observe(trainer) -> None:
        kinds.append(trainer.kind)
        steps.append(trainer.step)

    result = make(observer=observe)
    assert kinds == ["first look"] * 3 + [""] * 6 and steps == [1, 2, 3, *range(1, 7)]
    assert poses == [result.work / "first_look" / "photos", photos]
    assert not (result.work / "first_look").exists()
    watched = result.output.read_bytes()
    shutil.rmtree(result.work)
    result.output.unlink()
    assert make().output.read_bytes() == watched and poses[2:] == [photos]


@pytest.mark.usefixtures("fake_stages")
def test_poses_of_an_earlier_call_need_no_first_look(make, poses):
    make()
    kinds = []
    make(observer=lambda trainer: kinds.append(trainer.kind))
    assert len(poses) == 1 and kinds == []


@pytest.mark.usefixtures("fake_stages")
def test_photos_that_are_hardly_larger_get_no_first_look(make, photos, poses, monkeypatch):
    monkeypatch.setattr(first_look, "MAX_PHOTO_SIZE", 24)
    kinds = []
    make(observer=lambda trainer: kinds.append(trainer.kind))
    assert poses == [photos] and kinds == []


@pytest.mark.usefixtures("fake_stages")
def test_a_failed_first_look_is_logged_and_the_estimation_goes_on(make, photos, poses, monkeypatch, caplog):
    estimate, notes = sys.modules["hyrfpack.poses"].estimate_poses, logging.getLogger("hyrfpack.poses.estimate")

    def fail_first(source, *args, **options):
        notes.info(f"a note on {source.name}")
        if source.parent.name == "first_look":
            raise HyrfDataError("no two photos overlap", fix="take more photos")
        estimate(source, *args, **options)

    monkeypatch.setattr(sys.modules["hyrfpack.poses"], "estimate_poses", fail_first)
    with caplog.at_level(logging.INFO, "hyrfpack"):
        result = make(observer=lambda trainer: None)
    assert sum("the first look is skipped: no two photos overlap" in message for message in caplog.messages) == 1
    assert [message for message in caplog.messages if message.startswith("a note")] == [f"a note on {photos.name}"]
    assert result.output.is_file() and not (result.work / "first_look").exists()


@pytest.mark.usefixtures("fake_stages")
@pytest.mark.parametrize(
    ("error", "reason"), [(MemoryError(), "MemoryError"), (RuntimeError("no kernel"), "no kernel")]
)
def test_no_error_in_the_first_look_ends_the_call(error, reason, make, photos, poses, caplog):
    def fail(trainer) -> None:
        if trainer.kind == "first look":
            raise error

    with caplog.at_level(logging.INFO, "hyrfpack"):
        result = make(observer=fail)
    assert f"the first look is skipped: {reason}" in caplog.messages
    assert result.output.is_file() and not (result.work / "first_look").exists()


def test_photos_may_lie_in_a_folder_and_its_subfolders(photos, tmp_path):
    paths = sorted(photos.iterdir())
    for depth, path in enumerate(paths[:6]):
        target = photos.joinpath(*"abcdef"[:depth], path.name)
        target.parent.mkdir(exist_ok=True)
        path.rename(target)
    assert first_look._reduce_photos(photos, tmp_path / "reduced")
    assert len(list((tmp_path / "reduced").rglob("*.jpg"))) == min(len(paths), first_look.MAX_PHOTOS)


@pytest.mark.usefixtures("fake_stages")
def test_an_interrupted_first_look_leaves_nothing_and_the_same_call_resumes(make, photos, poses):
    def interrupt(trainer) -> None:
        raise KeyboardInterrupt

    with pytest.raises(Stopped, match="stopped in poses") as stopped:
        make(observer=interrupt)
    work = Path(make().work)
    assert stopped.value.scene is None and poses[1:] == [photos] and not (work / "first_look").exists()


@pytest.mark.usefixtures("fake_stages")
def test_frames_of_a_video_are_reduced(poses, tmp_path, monkeypatch):
    taken = []

    def choose_frames(video, folder, *, max_frames, progress):
        folder.mkdir(parents=True)
        for number in range(max_frames):
            Image.new("RGB", (32, 24)).save(folder / f"frame_{number:06}.jpg")
        taken.append(video)

    frames = ModuleType("hyrfpack.poses.frames")
    frames.choose_frames = choose_frames
    monkeypatch.setitem(sys.modules, "hyrfpack.poses.frames", frames)
    (tmp_path / "clip.mp4").write_bytes(b"frames")
    kinds = []
    result = make_scene(
        tmp_path / "clip.mp4", tmp_path / "scene.hyrf", MakeConfig(quality="draft"), context=QUIET_CONTEXT,
        observer=lambda trainer: kinds.append(trainer.kind),
    )  # fmt: skip
    assert taken == [tmp_path / "clip.mp4"] and poses == [result.work / "first_look" / "photos", *taken]
    assert kinds == ["first look"] * 3


def test_reduced_photos_are_upright_and_evenly_spaced_and_keep_their_cameras_folders(tmp_path, monkeypatch):
    monkeypatch.setattr(first_look, "MAX_PHOTOS", 3)
    source = tmp_path / "photos"
    for folder, numbers in {"left": range(4), "right": range(5)}.items():
        (source / folder).mkdir(parents=True)
        for number in numbers:
            Image.new("RGB", (40, 20), (200, 20 * number, 0)).save(source / folder / f"{number}.png")
    turned = Image.new("RGB", (40, 20), (0, 0, 200))
    tags = turned.getexif()
    tags[ORIENTATION_TAG] = 6
    turned.save(source / "right" / "4.png", exif=tags)
    (source / "right" / "0.png").write_bytes(b"no picture")  # it is the middle one of the nine photos
    assert first_look._reduce_photos(source, tmp_path / "reduced")
    written = sorted(
        path.relative_to(tmp_path / "reduced").as_posix() for path in (tmp_path / "reduced").rglob("*.jpg")
    )
    assert written == ["left/0000.jpg", "right/0002.jpg"]
    sizes = [Image.open(tmp_path / "reduced" / name).size for name in written]
    assert sizes == [(16, 8), (8, 16)]
    colors = [np.asarray(Image.open(tmp_path / "reduced" / name))[4, 4] for name in written]
    np.testing.assert_allclose(colors, [(200, 0, 0), (0, 0, 200)], atol=3)


def test_a_folder_without_a_readable_photo_gets_no_first_look(tmp_path):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "0.jpg").write_bytes(b"no picture")
    assert not first_look._reduce_photos(tmp_path / "photos", tmp_path / "reduced")
    assert not (tmp_path / "reduced").exists()

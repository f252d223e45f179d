"""Photos that cannot be used are an error before the first step, not after the last."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest
from commands import refused
from PIL import Image
from scenes import QUIET_CONTEXT, ball_scene

from hyrfpack.context import RunContext
from hyrfpack.data import PictureCache, load_scene
from hyrfpack.errors import HyrfDataError, HyrfTrainingError
from hyrfpack.scene import Picture, Scene, View
from hyrfpack.train import TrainConfig, Trainer, median_color, train_model

TINY_TRAIN_CONFIG = TrainConfig(steps=2, max_gaussians=60)


@pytest.fixture
def fail_at_first_step(monkeypatch):
    """Training fails at its first step, so that an error has to come before it."""

    def step(*_, **__):
        raise AssertionError("a step was taken")

    monkeypatch.setattr(Trainer, "_train_step", step)


@pytest.fixture
def photos(data, tmp_path) -> Path:
    """A copy of ten small photos that a test may damage; 0000.png and 0008.png are held out."""
    return shutil.copytree(data, tmp_path / "photos")


def mask_all_pixels(view: View) -> View:
    picture = view.load()
    black = Picture(picture.rgb, None, np.zeros(picture.rgb.shape[:2], bool))
    return dataclasses.replace(view, load=lambda: black)


def make_split_scene(train=lambda view: view, test=lambda view: view) -> Scene:
    scene = ball_scene(views=6, points=60, side=24)
    return dataclasses.replace(scene, train=[*map(train, scene.train[2:])], test=[*map(test, scene.train[:2])])


def test_black_masks_of_all_photos_are_rejected_before_the_first_step(fail_at_first_step, tmp_path):
    with pytest.raises(HyrfTrainingError, match=r"all 4 photos to train on leave no pixels \(for example, 002\.png\)"):
        train_model(make_split_scene(train=mask_all_pixels), tmp_path, TINY_TRAIN_CONFIG, context=QUIET_CONTEXT)


def test_black_masks_of_all_held_out_photos_are_rejected_before_the_first_step(fail_at_first_step, tmp_path):
    with pytest.raises(HyrfTrainingError, match=r"all 2 photos to score leave no pixels \(for example, 000\.png\)"):
        train_model(make_split_scene(test=mask_all_pixels), tmp_path, TINY_TRAIN_CONFIG, context=QUIET_CONTEXT)


def test_a_black_mask_file_for_every_photo_is_rejected_by_the_command(fail_at_first_step, photos, tmp_path):
    (photos / "masks").mkdir()
    for number in range(10):
        Image.new("L", (48, 48)).save(photos / "masks" / f"{number:04d}.png")

    assert "leave no pixel" in refused("train", photos, "-o", tmp_path / "run", "--steps", 2)


def test_one_photo_with_a_pixel_to_train_on_and_one_to_score_are_enough(tmp_path):
    scene = make_split_scene()
    first, *others = scene.train
    scene = dataclasses.replace(
        scene, train=[mask_all_pixels(first), *others], test=[mask_all_pixels(scene.test[0]), scene.test[1]], notes=[]
    )

    result = train_model(scene, tmp_path, dataclasses.replace(TINY_TRAIN_CONFIG, steps=8), context=QUIET_CONTEXT)

    assert result.metrics["evaluation"]["skipped"] == ["000.png"]


def test_a_truncated_held_out_photo_is_rejected_before_the_first_step_and_named(fail_at_first_step, photos, tmp_path):
    whole = (photos / "images" / "0008.png").read_bytes()
    (photos / "images" / "0008.png").write_bytes(whole[: len(whole) // 2])

    with pytest.raises(HyrfDataError, match=r"0008\.png: cannot decode the picture"):
        train_model(load_scene(photos), tmp_path / "run", TINY_TRAIN_CONFIG, context=QUIET_CONTEXT)


def test_training_photos_are_not_all_read_before_the_first_step(tmp_path, monkeypatch):
    monkeypatch.setattr(median_color, "MAX_PHOTOS", 1)
    read = []

    def counted(view: View) -> View:
        return dataclasses.replace(view, load=lambda: read.append(view.name) or view.load())

    scene = dataclasses.replace(make_split_scene(train=counted), test=[])
    train_model(
        scene,
        tmp_path,
        dataclasses.replace(TINY_TRAIN_CONFIG, steps=1),
        context=RunContext(cache=PictureCache(), progress=None),
    )

    # The photo of the median colour, the first photo with an unmasked pixel, and the photo of the step.
    assert len(read) <= 3 < len(scene.train)

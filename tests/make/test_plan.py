"""Plans of a pipeline: training steps by the size of the photos, and the first estimates of time."""

from __future__ import annotations

import pytest
import torch

from hyrfpack.make.plan import (
    DEPTH_MAP_SECONDS_PER_PHOTO,
    QUALITIES,
    Plan,
    estimate_photos_seconds,
    estimate_seconds,
    expected_photo_size,
)
from hyrfpack.train.resolution import PhotoSize
from hyrfpack.train.setup import LARGE_PHOTO_PIXELS, SMALL_PHOTO_PIXELS
from hyrfpack.train.teachers import count_teachers

CPU_DEVICE, GPU_DEVICE = torch.device("cpu"), torch.device("cuda")
REAL_QUALITIES = dict(QUALITIES)  # while tests run, quick ones replace them (conftest.py)


@pytest.mark.parametrize("pixels", [1, 200 * 200, SMALL_PHOTO_PIXELS])
def test_normal_quality_takes_3000_steps_on_small_photos(pixels):
    assert REAL_QUALITIES["normal"].training_steps(pixels, CPU_DEVICE) == 3_000


@pytest.mark.parametrize("pixels", [LARGE_PHOTO_PIXELS, 1600 * 1200, 4000 * 3000])
def test_normal_quality_takes_2000_steps_on_large_photos(pixels):
    assert REAL_QUALITIES["normal"].training_steps(pixels, CPU_DEVICE) == 2_000


def test_training_steps_fall_steadily_between_small_and_large_photos():
    normal = REAL_QUALITIES["normal"]
    steps = [
        normal.training_steps(pixels, CPU_DEVICE) for pixels in range(SMALL_PHOTO_PIXELS, LARGE_PHOTO_PIXELS, 50_000)
    ]
    assert steps == sorted(steps, reverse=True) and len(set(steps)) == len(steps)
    # Half-way on a logarithmic scale is the geometric mean.
    middle = (SMALL_PHOTO_PIXELS * LARGE_PHOTO_PIXELS) ** 0.5
    assert normal.training_steps(middle, CPU_DEVICE) == pytest.approx((3_000 * 2_000) ** 0.5, abs=1)


@pytest.mark.parametrize(("quality", "steps"), [("draft", 600), ("best", 10_000)])
@pytest.mark.parametrize("pixels", [SMALL_PHOTO_PIXELS, LARGE_PHOTO_PIXELS])
def test_only_normal_quality_depends_on_the_size_of_photos(quality, steps, pixels):
    assert REAL_QUALITIES[quality].training_steps(pixels, CPU_DEVICE) == steps


@pytest.mark.parametrize("name", REAL_QUALITIES)
def test_steps_on_a_gpu_do_not_depend_on_the_size_of_photos(name):
    quality = REAL_QUALITIES[name]
    assert {quality.training_steps(pixels, GPU_DEVICE) for pixels in (10_000, 2_000_000)} == {quality.gpu_steps}


def test_photos_are_expected_at_the_size_to_which_they_are_shrunk():
    assert expected_photo_size((4000, 3000), 1600) == PhotoSize(1600 * 1200, 1200)
    assert expected_photo_size((4000, 3000), 0) == PhotoSize(4000 * 3000, 3000)
    assert expected_photo_size((640, 480), 1600) == PhotoSize(640 * 480, 480)


def test_frames_of_a_video_are_expected_in_full_hd():
    assert expected_photo_size(None, 1600) == PhotoSize(1600 * 900, 900)


def test_the_estimate_grows_with_photos_pixels_and_steps():
    def seconds(count, side, steps):
        plan = Plan(steps, max_size=1600)
        return estimate_photos_seconds(count, expected_photo_size((side, side), 1600), plan, CPU_DEVICE)

    usual = seconds(60, 800, 1_000)
    assert all((value > 0) == (part != "teachers") for part, value in usual.items())
    assert seconds(120, 800, 1_000)["poses"] > usual["poses"]
    assert seconds(60, 1600, 1_000)["training"] > usual["training"]
    assert seconds(60, 800, 3_000)["training"] > usual["training"]


def test_few_photos_take_time_for_teacher_runs():
    def seconds(count, side=800, steps=3_000):
        plan = Plan(steps, max_size=1600)
        return estimate_photos_seconds(count, expected_photo_size((side, side), 1600), plan, CPU_DEVICE)["teachers"]

    assert 0 < seconds(18) < seconds(18, 1600)
    assert seconds(18, steps=1_999) == seconds(20) == 0


@pytest.mark.parametrize("sizes", [[(480, 320)], [(900, 600), (640, 480), (1201, 799)], [(1600, 1066), (1600, 1200)]])
def test_a_plan_for_few_photos_has_teacher_runs_whatever_their_size(sizes):
    size = PhotoSize.of(sizes)
    steps = REAL_QUALITIES["normal"].training_steps(size.pixels, CPU_DEVICE)
    assert count_teachers(12, size, Plan(steps, max_size=1600).train_config(seed=0)) == 3


def test_the_estimate_of_the_training_includes_depth_maps_of_at_most_100_photos():
    def training_seconds(trained):
        return estimate_seconds(PhotoSize(250_000, 500), Plan(1_000, 800), 5_000, trained, 0, 0, CPU_DEVICE, 1)[
            "training"
        ]

    assert training_seconds(50) - training_seconds(0) == pytest.approx(50 * DEPTH_MAP_SECONDS_PER_PHOTO)
    assert training_seconds(1_000) == training_seconds(100) > training_seconds(99)

from __future__ import annotations

import numpy as np
import pytest
import torch
from scenes import ball_points, small_model

from hyrfpack.cameras.sampling import MAX_BACKGROUND_STRIDE
from hyrfpack.config.train import DensityConfig, TrainConfig
from hyrfpack.data.cache import DEFAULT_PREFETCHED_PICTURES
from hyrfpack.data.reduced import reduce_camera
from hyrfpack.render import RenderSettings, render_view
from hyrfpack.scene import Camera, Picture, Scene, View
from hyrfpack.train import resolution
from hyrfpack.train.resolution import PhotoSize, ResolutionSchedule, background_stride, reduced_low_pass_variance
from hyrfpack.train.trainer import Trainer

LARGE_PHOTO = PhotoSize(1600 * 1066, 1066)


def make_view(width: int, height: int, name: str = "a.png", distance: float = 3.0) -> View:
    pose = np.eye(4)
    pose[2, 3] = distance
    camera = Camera(width, height, float(width), float(width), width / 2, height / 2, pose)
    values = np.random.default_rng(len(name)).integers(0, 256, (height, width, 3), dtype=np.uint8)
    return View(name, camera, lambda: Picture(values))


def test_a_reduced_step_has_enough_pixels_for_each_gaussian() -> None:
    limits = [LARGE_PHOTO.pixels / factor**2 / resolution.MIN_PIXELS_PER_GAUSSIAN for factor in (2, 4)]

    assert LARGE_PHOTO.reduction_for(limits[0]) == 2 and LARGE_PHOTO.reduction_for(limits[0] + 1) == 1
    assert LARGE_PHOTO.reduction_for(limits[1]) == 4 and LARGE_PHOTO.reduction_for(limits[1] + 1) == 2
    assert PhotoSize(10**12, 10**6).reduction_for(1) == resolution.MAX_REDUCTION


def test_small_photos_are_not_reduced() -> None:
    side = 2 * resolution.MIN_REDUCED_SIDE_PIXELS

    assert PhotoSize(side**2, side).reduction_for(1) == 2
    assert PhotoSize(10 * side**2, side - 1).reduction_for(1) == 1


def test_the_resolution_grows_with_the_gaussians_and_never_falls() -> None:
    schedule = ResolutionSchedule([make_view(1600, 1066)], 1000, 100)
    coarsest = schedule.factor(1)
    few, many = 100, 10**7

    schedule.update(100, few)
    schedule.update(200, many)
    schedule.update(300, few)

    assert coarsest == LARGE_PHOTO.reduction_for(100) > 1
    assert [schedule.factor(step) for step in (100, 200, 200 + DEFAULT_PREFETCHED_PICTURES)] == [coarsest] * 3
    assert [schedule.factor(step) for step in (201 + DEFAULT_PREFETCHED_PICTURES, 400, 1000)] == [1] * 3


def test_the_last_steps_are_at_full_resolution() -> None:
    schedule = ResolutionSchedule([make_view(1600, 1066)], 1000, 100)
    last = int(resolution.FULL_RESOLUTION_START * 1000)

    assert schedule.factor(last) > 1 and schedule.factor(last + 1) == 1


def test_only_changes_that_took_effect_are_described() -> None:
    schedule = ResolutionSchedule([make_view(1600, 1066)], 30, 100)
    middle = LARGE_PHOTO.pixels / 4
    schedule.update(
        24 - DEFAULT_PREFETCHED_PICTURES, int(middle)
    )  # takes effect at step 25, which is at full resolution anyway

    assert [schedule.factor(step) for step in (1, 24, 25)] == [4, 4, 1]
    assert schedule.describe() == "photos reduced by 4 until step 24"


def test_a_run_of_one_step_describes_no_reduction() -> None:
    schedule = ResolutionSchedule([make_view(1600, 1066)], 1, 100)

    assert schedule.factor(1) == 1 and schedule.describe() == ""


def test_each_part_of_a_run_is_described_with_its_last_step() -> None:
    schedule = ResolutionSchedule([make_view(1600, 1066)], 1000, 100)
    schedule.update(200, int(LARGE_PHOTO.pixels / 4))

    last = 200 + DEFAULT_PREFETCHED_PICTURES
    assert [schedule.factor(step) for step in (last, last + 1, 800, 801)] == [4, 2, 2, 1]
    assert schedule.describe() == f"photos reduced by 4 until step {last}, by 2 until step 800"


def test_a_schedule_that_is_off_reduces_nothing() -> None:
    schedule = ResolutionSchedule([make_view(1600, 1066)], 10, 100, is_on=False)

    assert {schedule.factor(step) for step in range(1, 11)} == {1}
    assert [schedule.share_done(step) for step in (1, 5, 10)] == pytest.approx([0.1, 0.5, 1.0])


@pytest.mark.parametrize("steps", [1, 2, 7, 1000])
def test_the_share_of_work_grows_to_one_and_counts_full_steps_for_more(steps: int) -> None:
    schedule = ResolutionSchedule([make_view(1600, 1066)], steps, 100)
    shares = [0.0, *(schedule.share_done(step) for step in range(1, steps + 1))]

    costs = np.diff(shares)
    assert shares[-1] == pytest.approx(1.0) and (costs > 0).all()
    if steps == 1000:
        full = resolution.FIXED_STEP_COST + 1
        coarse = resolution.FIXED_STEP_COST + 1 / schedule.factor(1) ** 2
        assert costs[-1] / costs[0] == pytest.approx(full / coarse)


def test_the_estimated_cost_is_that_of_the_steps_taken() -> None:
    density, initial, budget, steps = DensityConfig(), 5_000, 20_000, 2000
    schedule = ResolutionSchedule([make_view(1600, 1066)], steps, initial)
    times, counts = zip(*density.planned_counts(initial, budget), strict=True)
    costs = []
    for step in range(1, steps + 1):
        costs.append(resolution.step_cost(schedule.factor(step)))
        schedule.update(step, int(np.interp(step / steps, times, counts)))

    assert LARGE_PHOTO.mean_step_cost(density, initial, budget) == pytest.approx(np.mean(costs), rel=0.05)
    assert PhotoSize(40_000, 200).mean_step_cost(density, initial, budget) == 1


def test_a_reduced_image_is_the_mean_of_blocks_of_the_full_image() -> None:
    model, factor = small_model(ball_points(300)[0]), 4
    camera = make_view(128, 96).camera
    everything = {"transmittance_min": 0.0, "background_stride": 1, "background_threshold": 0.0}

    with torch.no_grad():
        full = render_view(model, camera, RenderSettings(**everything)).alpha
        expected = full.reshape(24, factor, 32, factor).mean((1, 3))
        errors = {
            variance: float(
                (
                    render_view(
                        model, reduce_camera(camera, factor), RenderSettings(low_pass_variance=variance, **everything)
                    ).alpha
                    - expected
                )
                .square()
                .mean()
            )
            for variance in (reduced_low_pass_variance(factor), RenderSettings().low_pass_variance)
        }

    consistent, usual = errors.values()
    assert float(expected.max()) > 0.3 and consistent < 0.2 * usual


def test_a_full_image_keeps_its_filter() -> None:
    assert reduced_low_pass_variance(1) == RenderSettings().low_pass_variance


def test_large_steps_evaluate_the_background_at_few_pixels() -> None:
    for width, height in ((1600, 1066), (4000, 3000)):
        stride = background_stride(make_view(width, height).camera)
        assert width * height / stride**2 <= resolution.MAX_BACKGROUND_NODES < width * height / (stride - 1) ** 2
    assert background_stride(make_view(400, 266).camera) == resolution.MIN_BACKGROUND_STRIDE


def test_the_largest_photos_are_rendered_with_an_allowed_stride() -> None:
    assert background_stride(make_view(16384, 16384).camera) == MAX_BACKGROUND_STRIDE


@pytest.mark.parametrize(("is_on", "coarse"), [(True, resolution.COARSE_BACKGROUND_STRIDE), (False, 2)])
def test_the_last_steps_evaluate_the_background_at_more_pixels(is_on: bool, coarse: int) -> None:
    tiny, small, large = (make_view(*size) for size in ((127, 150), (400, 266), (1600, 1066)))
    schedule = ResolutionSchedule([tiny, small, large], 1000, 60_000, is_on=is_on)
    last_coarse_step = int(resolution.FULL_RESOLUTION_START * 1000)

    for view, first, last in ((tiny, 2, 2), (small, coarse, 2), (large, 7, 7)):
        strides = [schedule.render_settings(view.camera, step).background_stride for step in range(1, 1001)]
        assert strides == [first] * last_coarse_step + [last] * (1000 - last_coarse_step)


def test_reduced_photos_keep_the_stride_of_the_background() -> None:
    large = make_view(1600, 1066)
    schedule = ResolutionSchedule([large], 1000, 2_000)
    assert schedule.factor(1) == 4
    camera = schedule.reduce_view(large, 1).camera
    assert schedule.render_settings(camera, 1).background_stride == background_stride(camera) == 2


def make_large_scene() -> Scene:
    side = 2 * resolution.MIN_REDUCED_SIDE_PIXELS
    views = [make_view(side, side, f"{number}.png", distance=3 + number / 10) for number in range(4)]
    points = np.random.default_rng(0).normal(size=(60, 3)) * 0.3
    return Scene("made up", "colmap", views, [], points, np.full((60, 3), 0.5, np.float32))


SHORT_RUN = TrainConfig(steps=24, max_gaussians=60, exposure=False, density=DensityConfig(stop=0.9, peak=0.5))


def test_training_reduces_photos_and_renders_at_their_size() -> None:
    trainer = Trainer(make_large_scene(), SHORT_RUN)
    trainer.run()

    assert trainer.resolution.changes[0] == (1, 2)
    assert all(np.isfinite(record["loss"]) for record in trainer.records)


@pytest.mark.acceptance
def test_a_resumed_run_takes_the_same_steps_when_the_resolution_changes(tmp_path, monkeypatch) -> None:
    side = 64
    monkeypatch.setattr(resolution, "MIN_REDUCED_SIDE_PIXELS", side // 2)
    # The first rounds add Gaussians beyond the limit for reduced photos.
    monkeypatch.setattr(resolution, "MIN_PIXELS_PER_GAUSSIAN", side**2 / 4 / 65)
    whole, first, second = (Trainer(make_large_scene(), SHORT_RUN) for _ in range(3))
    whole.run()
    changed = whole.resolution.changes[1][0]
    # Before photos of the new size are prefetched, with the first of them, and after the last step of the old size.
    for stop in (max(1, changed - DEFAULT_PREFETCHED_PICTURES - 1), changed - DEFAULT_PREFETCHED_PICTURES, changed):
        first = Trainer(make_large_scene(), SHORT_RUN)
        first.run(checkpoint=tmp_path / "c.pt", stop=lambda trainer=first, stop=stop: trainer.step >= stop)
        second = Trainer(make_large_scene(), SHORT_RUN)
        second.load(tmp_path / "c.pt")
        second.run()

        assert second.resolution.changes == whole.resolution.changes
        for (name, expected), actual in zip(whole.model.named_parameters(), second.model.parameters(), strict=True):
            assert torch.equal(expected, actual), (stop, name)

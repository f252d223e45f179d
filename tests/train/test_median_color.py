"""The colour at which the radiance field starts: the median of the photos."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from scenes import ball_scene, small_model, view_of

from hyrfpack.data import PictureCache
from hyrfpack.evaluate import evaluate_model
from hyrfpack.render import render_view
from hyrfpack.scene import Picture, Scene
from hyrfpack.train import TrainConfig, Trainer
from hyrfpack.train.median_color import MAX_PHOTO_PIXELS, first_color, median_color, start_fields_at


def scene_of(*pictures: Picture) -> Scene:
    """Return a scene of pictures; its cameras have another size, which does not matter here."""
    camera = ball_scene(views=1).train[0].camera
    views = [view_of(f"{number}.png", camera, picture) for number, picture in enumerate(pictures)]
    return Scene("made up", "colmap", views, [], np.zeros((0, 3)), np.zeros((0, 3), np.float32))


def picture_of(levels, **parts) -> Picture:
    """Return a picture of one row with these levels in red, half of them in green and none in blue."""
    levels = np.asarray(levels, np.uint8)
    return Picture(np.stack((levels, levels // 2, 0 * levels), axis=1)[None], **parts)


def median_of(*pictures: Picture, solid=None) -> np.ndarray:
    return 255 * median_color(scene_of(*pictures), PictureCache(), solid)


def test_each_channel_has_the_median_of_all_photos_and_no_colour_is_black_or_white():
    np.testing.assert_allclose(median_of(picture_of([10, 20, 30]), picture_of([200, 90])), [30, 15, 0.5])
    np.testing.assert_allclose(median_of(Picture(np.full((2, 2, 3), 255, np.uint8))), [254.5] * 3)


def test_masked_pixels_do_not_count_and_without_others_the_colour_is_grey():
    masked = picture_of([10, 20, 200], mask=np.array([[True, False, True]]))
    np.testing.assert_allclose(median_of(masked, picture_of([60])), [60, 30, 0.5])
    np.testing.assert_allclose(median_of(picture_of([7], mask=np.array([[False]]))), [127.5] * 3)


def test_transparent_pixels_count_only_where_a_sphere_colours_them():
    picture = picture_of([100, 100, 40], alpha=np.array([[0, 0, 255]], np.uint8))
    np.testing.assert_allclose(median_of(picture), [40, 20, 0.5])
    np.testing.assert_allclose(median_of(picture, solid=np.ones(3, np.float32)), [254.5] * 3)


def test_large_photos_are_reduced():
    """Their darker left half has one more column, so that its level is the median."""
    rgb = np.full((700, 801, 3), 90, np.uint8)
    assert rgb.shape[0] * rgb.shape[1] > MAX_PHOTO_PIXELS
    rgb[:, :401] = 50
    np.testing.assert_allclose(median_of(Picture(rgb)), [50] * 3)


@pytest.mark.parametrize(("level", "first"), [(0, 0.5), (30, 30), (60, 127.5), (200, 127.5), (230, 230), (255, 254.5)])
def test_fields_start_at_the_median_of_dark_and_bright_photos_alone(level, first):
    scene = scene_of(Picture(np.full((2, 2, 3), level, np.uint8)))
    np.testing.assert_allclose(255 * first_color(scene, PictureCache(), None), [first] * 3)


@pytest.mark.parametrize("background", [False, True])
def test_fields_start_at_the_colour_and_gaussians_keep_theirs(background):
    view = ball_scene(points=0).train[0]
    model = small_model(np.random.default_rng(0).uniform(-0.3, 0.3, (20, 3)), background=background, color_logits=0.7)
    before = render_view(model, view.camera)
    start_fields_at(model, np.array([0.9, 0.1, 0.02]))
    after = render_view(model, view.camera)

    light = 1 - before.alpha[..., None]
    behind = torch.tensor([0.9, 0.1, 0.02]) - 0.5 if background else 0.0  # the field of `small_model` is grey
    torch.testing.assert_close(after.rgb, before.rgb + light * behind, rtol=0, atol=1e-5)


def on_wall(scene: Scene, level: int) -> Scene:
    """Return opaque photos of the scene's transparent ones, before a wall of this level."""
    views = []
    for view in scene.train:
        rgb = view.load().composite(np.full(3, level / 255, np.float32))
        views.append(view_of(view.name, view.camera, Picture((rgb * 255 + 0.5).astype(np.uint8))))
    return dataclasses.replace(scene, train=views, has_alpha=False)


@pytest.mark.parametrize("level", [0, 255])
@pytest.mark.acceptance
def test_an_object_before_a_black_or_white_wall_is_learnt(level):
    """Fields that start at grey render nothing but the black wall after 20 steps, and never recover (16.5 dB)."""
    scene = on_wall(ball_scene(points=30, alpha=True), level)
    trainer = Trainer(scene, TrainConfig(steps=150, max_gaussians=300))
    trainer.run()
    assert evaluate_model(trainer.model, scene.train).psnr > 24


def test_transparent_photos_have_the_same_background_in_training_and_in_scores():
    scene = ball_scene(points=30, alpha=True)
    trainer = Trainer(scene, TrainConfig(steps=1, background=True, background_color="white"))
    np.testing.assert_array_equal(trainer._choose_background_color(1), [1, 1, 1])

"""Scores of models with an exposure map, and the gains and colour maps that are fitted to photos."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from exposures import random_map
from scenes import ball_points, ball_scene, small_model

from hyrfpack.evaluate import evaluate_model
from hyrfpack.evaluate.exposure import correct_colors, fit_gains
from hyrfpack.evaluate.metrics import IDENTICAL_PSNR, psnr, ssim, to_8bit
from hyrfpack.model import HybridModel
from hyrfpack.model.exposure import apply_exposure_gains
from hyrfpack.render import RenderSettings, render_view
from hyrfpack.scene import Picture, View

GAINS = np.array([0.8, 1.0, 1.3])


def a_picture(height: int = 40, width: int = 30, seed: int = 0) -> torch.Tensor:
    return torch.rand(height, width, 3, generator=torch.Generator().manual_seed(seed)) * 0.7 + 0.05


def test_gains_are_found_beside_things_the_render_has_wrong_and_pixels_that_are_clipped():
    image = a_picture()
    photo = apply_exposure_gains(image, torch.from_numpy(GAINS).float())
    photo[:8] = a_picture(8, 30, seed=1)  # a fifth of the picture shows something else
    photo[8:12] *= 9

    np.testing.assert_allclose(fit_gains(image, photo.clamp(0, 1)), GAINS, rtol=0.01)


def test_masked_pixels_have_no_part_in_gains_and_corrections():
    image, mask = a_picture(), torch.zeros(40, 30, dtype=torch.bool)
    mask[10:30] = True
    photo = torch.where(mask[..., None], apply_exposure_gains(image, torch.full((3,), 0.6)), 1.0 - image)

    np.testing.assert_allclose(fit_gains(image, photo, mask), 0.6, rtol=1e-4)
    assert psnr(correct_colors(image, photo, mask), to_8bit(photo), mask) > 35


@pytest.mark.parametrize("shape", [(1, 1), (3, 5)])
def test_too_few_pixels_leave_the_exposure_as_it_is(shape):
    np.testing.assert_array_equal(fit_gains(torch.full((*shape, 3), 0.2), torch.full((*shape, 3), 0.4)), 1)


@pytest.mark.parametrize("level", [0.0, 1.0])
def test_black_and_white_pictures_leave_the_exposure_as_it_is(level):
    np.testing.assert_array_equal(fit_gains(torch.full((9, 9, 3), level), torch.full((9, 9, 3), 0.4)), 1)


def test_a_correction_undoes_any_affine_map_of_colours():
    photo = a_picture()
    map_of_colours = torch.tensor([[0.8, 0.1, 0.0], [0.05, 0.9, 0.1], [0.0, -0.1, 0.7]])

    assert psnr(correct_colors(photo @ map_of_colours + 0.03, photo), to_8bit(photo)) > 60


@pytest.mark.parametrize("shape", [(1, 1), (6, 6)])
def test_a_picture_of_one_colour_is_corrected_to_the_mean_of_its_photo(shape):
    photo = a_picture(*shape)
    expected = to_8bit(photo.mean((0, 1)).expand_as(photo))

    torch.testing.assert_close(correct_colors(torch.full_like(photo, 0.3), photo), expected, atol=1.01 / 255, rtol=0)


@pytest.mark.parametrize("function", [fit_gains, correct_colors])
def test_pictures_that_are_not_finite_are_rejected(function):
    picture, broken = a_picture(), a_picture()
    broken[3, 4, 1] = torch.nan
    for pair in ((picture, broken), (broken, picture)):
        with pytest.raises(ValueError, match="not finite"):
            function(*pair)


def exposed_by_formula(image: torch.Tensor, gains: np.ndarray) -> np.ndarray:
    """A render as a camera with these gains shows it, in 8 bits: y' = g y / (1 + (g - 1) y), in float64."""
    image = image.double().numpy()
    return np.rint(255 * gains * image / (1 + (gains - 1) * image)) / 255


@pytest.fixture
def plain() -> HybridModel:
    """A model of the balls, without an exposure map."""
    points, colors = ball_points(150)
    return small_model(points, color_logits=torch.from_numpy(colors) * 4 - 2, scale_logits=-1.5)


@pytest.fixture
def mapped(plain) -> HybridModel:
    """The same model with an exposure map of another exposure in every place."""
    model = copy.copy(plain)
    model.exposure = random_map(3, centers=6)
    return model


def test_psnr_is_of_renders_as_photographed_and_psnr_consistent_of_those_at_one_exposure(plain, mapped):
    views = ball_scene(4).train

    scores = evaluate_model(mapped, views)

    for view, score in zip(views, scores.views, strict=True):
        photo = view.load().rgb / 255
        image = render_view(plain, view.camera).rgb.detach()
        gains = mapped.exposure.predict_gains(plain.config.frame.local_pose(view.camera))
        assert np.abs(np.log(gains)).max() > 0.1
        for told, drawn in ((score.psnr, gains), (score.psnr_consistent, np.ones(3))):
            expected = -10 * np.log10(np.mean((exposed_by_formula(image, drawn) - photo) ** 2))
            assert told == pytest.approx(expected, abs=0.01)
    for name in ("psnr", "psnr_consistent", "psnr_corrected", "ssim"):
        assert getattr(scores, name) == pytest.approx(np.mean([getattr(score, name) for score in scores.views]))


def test_the_scores_are_of_the_very_pictures_that_render_shows_at_each_exposure(plain, mapped):
    views = ball_scene(3).train
    photos = [torch.from_numpy(view.load().rgb) / 255 for view in views]

    for exposure, model in (("as-photographed", mapped), ("consistent", plain)):
        scores = evaluate_model(mapped, views, settings=RenderSettings(exposure=exposure))
        images = [to_8bit(render_view(mapped, view.camera, RenderSettings(exposure=exposure)).rgb) for view in views]
        pairs = list(zip(images, photos, strict=True))
        assert [score.psnr for score in scores.views] == pytest.approx([psnr(*pair) for pair in pairs], abs=1e-6)
        assert [score.ssim for score in scores.views] == pytest.approx([ssim(*pair) for pair in pairs], abs=1e-6)
        assert scores.psnr_consistent == evaluate_model(plain, views).psnr
        for image, view in zip(images, views, strict=True):
            assert torch.equal(image, to_8bit(render_view(model, view.camera).rgb))


def test_a_map_of_the_photos_gains_scores_what_the_model_without_it_scores_on_unexposed_photos(plain, mapped):
    cameras = [view.camera for view in ball_scene(4).train]
    unexposed, exposed = [], []
    for number, camera in enumerate(cameras):
        image = render_view(plain, camera).rgb.detach()
        gains = mapped.exposure.predict_gains(plain.config.frame.local_pose(camera))
        for views, by in ((unexposed, np.ones(3)), (exposed, gains)):
            pixels = (255 * exposed_by_formula(image, by)).round().astype(np.uint8)
            views.append(View(str(number), camera, lambda pixels=pixels: Picture(pixels)))

    scores = evaluate_model(mapped, exposed)

    assert evaluate_model(plain, unexposed).psnr == IDENTICAL_PSNR
    assert scores.psnr > 70  # a few values round to the other of two levels
    assert scores.psnr_consistent == evaluate_model(plain, exposed).psnr < 35


def test_without_an_exposure_map_nothing_is_said_of_one_exposure_and_both_exposures_score_alike(plain):
    views = ball_scene(2).train

    scores = evaluate_model(plain, views)

    assert scores.psnr_consistent is None and {score.psnr_consistent for score in scores.views} == {None}
    consistent = evaluate_model(plain, views, settings=RenderSettings(exposure="consistent"))
    assert (scores.psnr, scores.ssim) == (consistent.psnr, consistent.ssim)

"""Scores of models with an exposure map, and fits of gains and colour maps to photos."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from exposures import random_map
from scenes import ball_points, ball_scene, small_model

from hyrfpack.evaluate import evaluate_model, metrics
from hyrfpack.evaluate.exposure import correct_colors, fit_gains
from hyrfpack.evaluate.metrics import iterate_counted_pixels, psnr, ssim, to_8bit
from hyrfpack.measure.psnr import IDENTICAL_PSNR
from hyrfpack.model import HybridModel
from hyrfpack.model.exposure import apply_exposure_gains
from hyrfpack.render import RenderSettings, render_view
from hyrfpack.scene import Picture, View

KNOWN_GAINS = np.array([0.8, 1.0, 1.3])


def random_picture(height: int = 40, width: int = 30, seed: int = 0) -> torch.Tensor:
    return torch.rand(height, width, 3, generator=torch.Generator().manual_seed(seed)) * 0.7 + 0.05


def test_gains_are_recovered_despite_wrong_and_clipped_pixels():
    image = random_picture()
    photo = apply_exposure_gains(image, torch.from_numpy(KNOWN_GAINS).float())
    photo[:8] = random_picture(8, 30, seed=1)  # a fifth of the picture shows something else
    photo[8:12] *= 9

    np.testing.assert_allclose(fit_gains(image, photo.clamp(0, 1)), KNOWN_GAINS, rtol=0.01)


def test_masked_pixels_do_not_affect_gains_and_corrections():
    image, mask = random_picture(), torch.zeros(40, 30, dtype=torch.bool)
    mask[10:30] = True
    photo = torch.where(mask[..., None], apply_exposure_gains(image, torch.full((3,), 0.6)), 1.0 - image)

    np.testing.assert_allclose(fit_gains(image, photo, mask), 0.6, rtol=1e-4)
    assert psnr(correct_colors(image, photo, mask), to_8bit(photo), mask) > 35


@pytest.mark.parametrize("masked", [False, True])
def test_large_pictures_are_compared_in_parts(masked, monkeypatch):
    image, photo = random_picture(), random_picture(seed=1) * 0.4 + random_picture() * 0.6
    mask = random_picture(seed=2)[..., 0] > 0.3 if masked else None
    whole = psnr(image, photo, mask), fit_gains(image, photo, mask), correct_colors(image, photo, mask)
    monkeypatch.setattr(metrics, "MAX_PART_PIXELS", 70)
    assert {len(part) for part, _ in iterate_counted_pixels(image, photo, None)} == {70, 1200 % 70}
    parts = psnr(image, photo, mask), fit_gains(image, photo, mask), correct_colors(image, photo, mask)
    for found, expected in zip(parts, whole, strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-12)
    difference = (image.double() - photo.double())[slice(None) if mask is None else mask]
    assert parts[0] == pytest.approx(-10 * np.log10(difference.square().mean().item()), rel=1e-12)


def test_nan_gives_no_psnr():
    image = random_picture()
    image[3, 4] = torch.nan
    assert np.isnan(psnr(image, random_picture()))


@pytest.mark.parametrize("shape", [(1, 1), (3, 5)])
def test_too_few_pixels_give_unit_gains(shape):
    np.testing.assert_array_equal(fit_gains(torch.full((*shape, 3), 0.2), torch.full((*shape, 3), 0.4)), 1)


@pytest.mark.parametrize("level", [0.0, 1.0])
def test_black_and_white_pictures_give_unit_gains(level):
    np.testing.assert_array_equal(fit_gains(torch.full((9, 9, 3), level), torch.full((9, 9, 3), 0.4)), 1)


def test_a_correction_undoes_any_affine_map_of_colours():
    photo = random_picture()
    map_of_colours = torch.tensor([[0.8, 0.1, 0.0], [0.05, 0.9, 0.1], [0.0, -0.1, 0.7]])

    assert psnr(correct_colors(photo @ map_of_colours + 0.03, photo), to_8bit(photo)) > 60


@pytest.mark.parametrize("shape", [(1, 1), (6, 6)])
def test_a_picture_of_one_colour_is_corrected_to_the_mean_of_its_photo(shape):
    photo = random_picture(*shape)
    expected = to_8bit(photo.mean((0, 1)).expand_as(photo))

    torch.testing.assert_close(correct_colors(torch.full_like(photo, 0.3), photo), expected, atol=1.01 / 255, rtol=0)


@pytest.mark.parametrize("function", [fit_gains, correct_colors])
def test_pictures_that_are_not_finite_are_rejected(function):
    picture, broken = random_picture(), random_picture()
    broken[3, 4, 1] = torch.nan
    for pair in ((picture, broken), (broken, picture)):
        with pytest.raises(ValueError, match="not finite"):
            function(*pair)


def expose_by_formula(image: torch.Tensor, gains: np.ndarray) -> np.ndarray:
    """Return the render of a camera with these gains in 8 bits: y' = g y / (1 + (g - 1) y), in float64."""
    image = image.double().numpy()
    return np.rint(255 * gains * image / (1 + (gains - 1) * image)) / 255


@pytest.fixture
def plain_model() -> HybridModel:
    """A model of the balls without an exposure map."""
    points, colors = ball_points(150)
    return small_model(points, color_logits=torch.from_numpy(colors) * 4 - 2, scale_logits=-1.5)


@pytest.fixture
def model_with_map(plain_model) -> HybridModel:
    """The same model with an exposure map that differs from place to place."""
    model = copy.copy(plain_model)
    model.exposure = random_map(3, centers=6)
    return model


def test_psnr_uses_renders_as_photographed_and_psnr_consistent_those_at_one_exposure(plain_model, model_with_map):
    views = ball_scene(4).train

    scores = evaluate_model(model_with_map, views)

    for view, score in zip(views, scores.views, strict=True):
        photo = view.load().rgb / 255
        image = render_view(plain_model, view.camera).rgb.detach()
        gains = model_with_map.exposure.predict_gains(plain_model.config.frame.local_pose(view.camera))
        assert np.abs(np.log(gains)).max() > 0.1
        for messages, drawn in ((score.psnr, gains), (score.psnr_consistent, np.ones(3))):
            expected = -10 * np.log10(np.mean((expose_by_formula(image, drawn) - photo) ** 2))
            assert messages == pytest.approx(expected, abs=0.01)
    for name in ("psnr", "psnr_consistent", "psnr_corrected", "ssim"):
        assert getattr(scores, name) == pytest.approx(np.mean([getattr(score, name) for score in scores.views]))


def test_scores_equal_those_of_rendered_pictures_at_each_exposure(plain_model, model_with_map):
    views = ball_scene(3).train
    photos = [torch.from_numpy(view.load().rgb) / 255 for view in views]

    for exposure, model in (("as-photographed", model_with_map), ("consistent", plain_model)):
        scores = evaluate_model(model_with_map, views, settings=RenderSettings(exposure=exposure))
        images = [
            to_8bit(render_view(model_with_map, view.camera, RenderSettings(exposure=exposure)).rgb) for view in views
        ]
        pairs = list(zip(images, photos, strict=True))
        assert [score.psnr for score in scores.views] == pytest.approx([psnr(*pair) for pair in pairs], abs=1e-6)
        assert [score.ssim for score in scores.views] == pytest.approx([ssim(*pair) for pair in pairs], abs=1e-6)
        assert scores.psnr_consistent == evaluate_model(plain_model, views).psnr
        for image, view in zip(images, views, strict=True):
            assert torch.equal(image, to_8bit(render_view(model, view.camera).rgb))


def test_a_model_with_a_map_of_the_true_gains_scores_like_the_model_on_unexposed_photos(plain_model, model_with_map):
    cameras = [view.camera for view in ball_scene(4).train]
    unexposed, exposed = [], []
    for number, camera in enumerate(cameras):
        image = render_view(plain_model, camera).rgb.detach()
        gains = model_with_map.exposure.predict_gains(plain_model.config.frame.local_pose(camera))
        for views, by in ((unexposed, np.ones(3)), (exposed, gains)):
            pixels = (255 * expose_by_formula(image, by)).round().astype(np.uint8)
            views.append(View(str(number), camera, lambda pixels=pixels: Picture(pixels)))

    scores = evaluate_model(model_with_map, exposed)

    assert evaluate_model(plain_model, unexposed).psnr == IDENTICAL_PSNR
    assert scores.psnr > 70  # a few values round to the other of two levels
    assert scores.psnr_consistent == evaluate_model(plain_model, exposed).psnr < 35


def test_without_an_exposure_map_psnr_consistent_is_none_and_both_exposures_agree(plain_model):
    views = ball_scene(2).train

    scores = evaluate_model(plain_model, views)

    assert scores.psnr_consistent is None and {score.psnr_consistent for score in scores.views} == {None}
    consistent = evaluate_model(plain_model, views, settings=RenderSettings(exposure="consistent"))
    assert (scores.psnr, scores.ssim) == (consistent.psnr, consistent.ssim)

"""PSNR without what exposure and white balance take from it: gains and maps of colour that are known."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from scenes import ball_points, ball_scene, small_model

from hyrfpack.evaluate import evaluate
from hyrfpack.evaluate.exposure import corrected, fitted_gains, predicted_gains
from hyrfpack.evaluate.metrics import IDENTICAL_PSNR, psnr, ssim, to_8bit
from hyrfpack.model.exposure import expose
from hyrfpack.render import render
from hyrfpack.scene import Picture, View

GAINS = np.array([0.8, 1.0, 1.3])


def a_picture(height: int = 40, width: int = 30, seed: int = 0) -> torch.Tensor:
    return torch.rand(height, width, 3, generator=torch.Generator().manual_seed(seed)) * 0.7 + 0.05


def test_gains_are_found_beside_things_the_render_has_wrong_and_pixels_that_are_clipped():
    image = a_picture()
    photo = expose(image, torch.from_numpy(GAINS).float())
    photo[:8] = a_picture(8, 30, seed=1)  # a fifth of the picture shows something else
    photo[8:12] *= 9

    np.testing.assert_allclose(fitted_gains(image, photo.clamp(0, 1)), GAINS, rtol=0.01)


def test_masked_pixels_have_no_part_in_gains_and_corrections():
    image, mask = a_picture(), torch.zeros(40, 30, dtype=torch.bool)
    mask[10:30] = True
    photo = torch.where(mask[..., None], expose(image, torch.full((3,), 0.6)), 1.0 - image)

    np.testing.assert_allclose(fitted_gains(image, photo, mask), 0.6, rtol=1e-4)
    assert psnr(corrected(image, photo, mask), to_8bit(photo), mask) > 35


@pytest.mark.parametrize("shape", [(1, 1), (3, 5)])
def test_too_few_pixels_leave_the_exposure_as_it_is(shape):
    np.testing.assert_array_equal(fitted_gains(torch.full((*shape, 3), 0.2), torch.full((*shape, 3), 0.4)), 1)


@pytest.mark.parametrize("level", [0.0, 1.0])
def test_black_and_white_pictures_leave_the_exposure_as_it_is(level):
    np.testing.assert_array_equal(fitted_gains(torch.full((9, 9, 3), level), torch.full((9, 9, 3), 0.4)), 1)


def test_a_correction_undoes_any_affine_map_of_colours():
    photo = a_picture()
    map_of_colours = torch.tensor([[0.8, 0.1, 0.0], [0.05, 0.9, 0.1], [0.0, -0.1, 0.7]])

    assert psnr(corrected(photo @ map_of_colours + 0.03, photo), to_8bit(photo)) > 60


@pytest.mark.parametrize("shape", [(1, 1), (6, 6)])
def test_a_picture_of_one_colour_is_corrected_to_the_mean_of_its_photo(shape):
    photo = a_picture(*shape)
    expected = to_8bit(photo.mean((0, 1)).expand_as(photo))

    torch.testing.assert_close(corrected(torch.full_like(photo, 0.3), photo), expected, atol=1.01 / 255, rtol=0)


@pytest.mark.parametrize("function", [fitted_gains, corrected])
def test_pictures_that_are_not_finite_are_refused(function):
    picture, broken = a_picture(), a_picture()
    broken[3, 4, 1] = torch.nan
    for pair in ((picture, broken), (broken, picture)):
        with pytest.raises(ValueError, match="not finite"):
            function(*pair)


def test_gains_are_predicted_by_the_nearest_names_the_nearer_the_more():
    known = {"a": 9.0, "b": 1.0, "d": 8.0, "z": 5.0}

    def gains_of(name: str) -> np.ndarray:
        return np.full(3, known[name])

    def predicted(name: str) -> float:
        return predicted_gains(name, list(known), gains_of)[0]

    assert predicted("c") == pytest.approx(8**0.5)  # one place from b and from d
    assert predicted("zz") == pytest.approx(5 ** (2 / 3) * 8 ** (1 / 3))  # one place from z, two from d
    assert predicted("b") == pytest.approx(72**0.5), "its own gains are not asked for"
    assert predicted_gains("c", ["a"], gains_of)[0] == pytest.approx(9)


def exposed(view: View, model, gains) -> View:
    """The view's photo is what the model renders there, exposed by gains."""
    image = expose(render(model, view.camera).rgb.detach(), torch.as_tensor(gains, dtype=torch.float32))
    picture = Picture((to_8bit(image) * 255).byte().numpy())
    return dataclasses.replace(view, load=lambda: picture)


def test_three_scores_leave_out_what_they_say():
    points, colors = ball_points(150)
    model = small_model(points, color_logits=torch.from_numpy(colors) * 4 - 2, scale_logits=-1.5)
    gains = [0.5, 0.7, 0.9 * GAINS, 0.8, 0.7]
    views = [exposed(view, model, gain) for view, gain in zip(ball_scene(5).train, gains, strict=True)]
    held_out, training = [views[1], views[3]], views[::2]

    scores = evaluate(model, held_out, training=training)

    for score, own, beside in zip(scores.views, (gains[1], gains[3]), ((0, 2), (2, 4)), strict=True):
        view = next(view for view in held_out if view.name == score.name)
        image = render(model, view.camera).rgb.detach()
        predicted = torch.as_tensor(np.sqrt(gains[beside[0]] * gains[beside[1]]) * np.ones(3)).float()
        photo = torch.from_numpy(view.load().rgb) / 255
        assert score.psnr_predicted == pytest.approx(psnr(to_8bit(expose(image, predicted)), photo), abs=0.3)
        assert score.ssim_predicted == pytest.approx(ssim(to_8bit(expose(image, predicted)), photo), abs=0.01)
        assert score.ssim < score.ssim_predicted <= 1
        assert score.psnr < score.psnr_predicted < 42 < score.psnr_corrected <= IDENTICAL_PSNR
        assert score.psnr == pytest.approx(psnr(to_8bit(image), photo)) and np.all(own != 1)
    assert scores.psnr_predicted == pytest.approx(np.mean([score.psnr_predicted for score in scores.views]))
    assert scores.ssim_predicted == pytest.approx(np.mean([score.ssim_predicted for score in scores.views]))
    assert scores.psnr_corrected == pytest.approx(np.mean([score.psnr_corrected for score in scores.views]))


def test_without_training_photos_nothing_is_predicted_and_nothing_else_changes():
    points, colors = ball_points(60)
    model, views = small_model(points), ball_scene(3).train

    alone, beside = evaluate(model, views[:1]), evaluate(model, views[:1], training=views)

    for score in (alone, alone.views[0]):
        assert score.psnr_predicted is None and score.ssim_predicted is None
    assert (alone.psnr, alone.psnr_corrected, alone.ssim) == (beside.psnr, beside.psnr_corrected, beside.ssim)
    assert evaluate(model, views[:1], training=views[:1]).psnr_predicted is None

"""Exposure compensation recovers known gains from tracks, keeps them in training and keeps the model free of them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from scenes import alternating_gains, ball_scene, exposed_scene

from hyrfpack.data import PictureCache
from hyrfpack.errors import HyrfTrainingError
from hyrfpack.evaluate import evaluate_model
from hyrfpack.model import Frame
from hyrfpack.scene import Scene, View
from hyrfpack.train import TrainConfig, Trainer
from hyrfpack.train.exposure import (
    GAIN_DECAY,
    MIN_PIXEL_LEVEL,
    MIN_POINTS_PER_PHOTO,
    Exposures,
    Observations,
    estimate_log_gains,
    observe,
)

CPU_DEVICE = torch.device("cpu")
SHORT_CONFIG = TrainConfig(steps=30, seed=3, max_gaussians=160, exposure=True)


def centred_log_gains(gains: np.ndarray) -> np.ndarray:
    logs = np.log(np.broadcast_to(gains, (len(gains), 3)))
    return logs - logs.mean(0)


# -- gains from tracks -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("occluded", [0.0, 0.2])
def test_gains_are_recovered_despite_occluded_points(occluded):
    rng = np.random.default_rng(0)
    logs = rng.normal(0, 0.4, (12, 3))
    colors = rng.normal(-0.5, 1, (200, 3))
    photo, point = np.nonzero(rng.random((12, 200)) < 0.3)
    logits = logs[photo] + colors[point] + rng.normal(0, 0.03, (len(photo), 3))
    wrong = rng.random(len(photo)) < occluded
    logits[wrong] = rng.normal(1, 1, (wrong.sum(), 3))

    found = estimate_log_gains(Observations(photo, point, logits), 12)

    np.testing.assert_allclose(found, logs - logs.mean(0), atol=0.04)
    np.testing.assert_allclose(found.mean(0), 0, atol=1e-12)


def test_photos_without_tracks_have_unit_gains_and_unconnected_groups_stay_separate():
    photo, point = np.repeat([0, 1, 3, 4], 50), np.tile(np.arange(50), 4) + np.repeat([0, 50], 100)
    logits = np.repeat([0.3, -0.3, 0.1, -0.1], 50)[:, None] * np.ones(3) + np.linspace(-2, 2, 50)[point % 50, None]

    found = estimate_log_gains(Observations(photo, point, logits), 5)

    np.testing.assert_allclose(found, np.array([0.3, -0.3, 0, 0.1, -0.1])[:, None] * np.ones(3), atol=1e-3)
    assert not estimate_log_gains(Observations(photo[:9], point[:9], logits[:9]), 2).any()


def test_two_glossy_points_between_two_groups_of_photos_do_not_shift_their_gains():
    """The points are one logit unit lighter from one side, although all photos have the same exposure."""
    rng = np.random.default_rng(0)
    seen = [(photo, 200 * (photo // 10) + row) for photo in range(20) for row in rng.choice(200, 60, replace=False)]
    glossy = [(photo, point) for point in (400, 401) for photo in (3, 4, 13, 14)]
    photo, point = np.array(seen + glossy).T
    logits = rng.normal(size=(402, 3))[point] + rng.normal(0, 0.05, (len(photo), 3))
    logits[(point >= 400) & (photo >= 10)] += 1

    found = estimate_log_gains(Observations(photo, point, logits), 20)
    assert abs(found[10:].mean() - found[:10].mean()) < 0.02

    # Forty points that agree are enough to believe them.
    shared = np.array([(photo, point) for point in range(400, 440) for photo in (3, 4, 13, 14)]).T
    photo, point = np.concatenate((np.array(seen).T, shared), 1)
    logits = rng.normal(size=(440, 3))[point] + rng.normal(0, 0.05, (len(photo), 3))
    logits[photo >= 10] += 1
    found = estimate_log_gains(Observations(photo, point, logits), 20)
    assert found[10:].mean() - found[:10].mean() == pytest.approx(1, abs=0.05)


def test_each_photo_is_read_once_and_masked_clipped_or_outside_points_are_ignored():
    scene, reads = exposed_scene(np.ones((4, 1))), []
    black, masked, see_through, usual = scene.train

    def changed(view: View, **parts) -> View:
        picture = dataclasses.replace(view.load(), **parts)
        return dataclasses.replace(view, load=lambda: reads.append(view.name) or picture)

    views = [
        changed(black, rgb=np.full((64, 64, 3), MIN_PIXEL_LEVEL - 1, np.uint8)),
        changed(masked, mask=np.arange(64)[:, None] < np.full(64, 32)),
        changed(see_through, alpha=np.full((64, 64), 254, np.uint8)),
        changed(usual),
        changed(dataclasses.replace(usual, name="again.png")),
    ]
    away = dataclasses.replace(scene.train[0].camera, cx=1e4)
    views.append(dataclasses.replace(views[-1], name="away.png", camera=away))
    tracks = {**scene.tracks, "again.png": scene.tracks[usual.name], "away.png": scene.tracks[usual.name]}

    found = observe(dataclasses.replace(scene, train=views, tracks=tracks), PictureCache(0))

    assert len(reads) == len(views)
    assert set(found.photo) <= {1, 3, 4} and {3, 4} <= set(found.photo)
    assert (np.bincount(found.point)[found.point] > 1).all()


# -- a step ----------------------------------------------------------------------------------------------------------


def test_gain_gradients_match_the_equation_in_float64():
    views = ball_scene(2).train
    exposures = Exposures(views, np.array([[0.3, -0.2, 0.1], [-0.3, 0.2, -0.1]]), CPU_DEVICE)
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(7, 5, 3, generator=generator).requires_grad_()
    weights = torch.rand(7, 5, 3, generator=generator)

    (exposures.exposed(image, exposures.row(views[1])) * weights).sum().backward()

    y, w, logs = image.detach().double(), weights.double(), exposures.values.detach()[1].double()
    odds = y / (1 - y) * logs.exp()
    shown = odds / (1 + odds)
    torch.testing.assert_close(
        exposures.values.grad[1].double(), (w * shown * (1 - shown)).sum((0, 1)), rtol=1e-4, atol=1e-6
    )
    expected = w * shown * (1 - shown) / (y * (1 - y))
    torch.testing.assert_close(image.grad.double(), expected, rtol=1e-4, atol=1e-5)


def test_steps_are_adam_with_a_pull_to_unit_gains_and_keep_the_mean():
    views = ball_scene(3).train
    start = np.array([[0.3, -0.2, 0.1], [-0.1, 0.4, 0.0], [0.2, 0.1, -0.3]])
    exposures = Exposures(views, start, CPU_DEVICE)
    torch.testing.assert_close(exposures.values.detach().double().numpy(), start - start.mean(0), rtol=1e-5, atol=1e-6)
    expected = [torch.from_numpy(row).requires_grad_() for row in start - start.mean(0)]
    optimizers = [torch.optim.Adam([row], lr=0.01, eps=1e-15) for row in expected]
    image = torch.rand(5, 4, 3, generator=torch.Generator().manual_seed(1))

    for number in (0, 2, 2, 1, 0, 2):
        (exposures.exposed(image, exposures.row(views[number])) ** 2).mean().backward()
        assert not exposures.step(0.01, [views[number]])
        odds = image.double() / (1 - image.double()) * expected[number].exp()
        loss = ((odds / (1 + odds)) ** 2).mean() + GAIN_DECAY / 2 * expected[number].square().sum()
        expected[number].grad = None
        loss.backward()
        optimizers[number].step()
        with torch.no_grad():
            mean = torch.stack(expected).mean(0)
            for row in expected:
                row -= mean

        torch.testing.assert_close(
            exposures.values.detach().double(), torch.stack(expected).detach(), rtol=1e-4, atol=1e-6
        )
        assert exposures.values.mean(0).abs().max() < 1e-7


def test_virtual_views_keep_the_exposure_of_the_model():
    *views, virtual = ball_scene(3).train
    start = np.array([[0.3, -0.2, 0.1], [-0.1, 0.4, 0.0]])
    alone, exposures = Exposures(views, start, CPU_DEVICE), Exposures(views, start, CPU_DEVICE, [virtual])
    image = torch.rand(5, 4, 3, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(exposures.exposed(image, exposures.row(virtual)), image)

    (exposures.exposed(image, exposures.row(virtual)) ** 2).mean().backward()
    assert not exposures.step(0.01, [virtual]) and exposures.values.grad is None
    for each in (alone, exposures):
        (each.exposed(image, each.row(views[1])) ** 2).mean().backward()
        assert not each.step(0.01, [views[1]])
    assert torch.equal(exposures.values[:2], alone.values) and not exposures.values[2].any()
    assert exposures.to_dict() == alone.to_dict()
    frame = Frame((0.0, 0.0, 0.0), 1.0, (1.0, 1.0, 1.0))
    first, second = (each.fit_map(frame, views) for each in (alone, exposures))
    assert first.leave_one_out_error == second.leave_one_out_error
    assert np.array_equal(first.map.weights, second.map.weights)


def test_a_gradient_that_is_not_finite_is_reported_and_changes_nothing():
    views = ball_scene(2).train
    exposures = Exposures(views, np.array([[0.3, 0.3, 0.3], [-0.3, -0.3, -0.3]]), CPU_DEVICE)
    before = exposures.values.detach().clone()
    (exposures.exposed(torch.full((2, 2, 3), 0.5), exposures.row(views[0])) * torch.nan).sum().backward()

    assert exposures.step(0.1, [views[0]])
    assert torch.equal(exposures.values, before)


# -- a run -----------------------------------------------------------------------------------------------------------


def records_without_times(trainer: Trainer) -> list[dict]:
    return [{name: value for name, value in record.items() if name != "seconds"} for record in trainer.records]


def parameter_bytes(trainer: Trainer) -> dict[str, bytes]:
    return {name: p.detach().numpy().tobytes() for name, p in trainer.model.named_parameters()}


def train_trainer(scene: Scene, config: TrainConfig = SHORT_CONFIG) -> Trainer:
    trainer = Trainer(scene, config)
    assert trainer.run()
    return trainer


def test_known_gains_are_learnt_and_the_model_keeps_their_mean():
    gains = alternating_gains(8) * np.array([1.1, 1.0, 0.9]) ** np.linspace(-1, 1, 8)[:, None]
    scene = exposed_scene(gains, side=128)

    trainer = train_trainer(scene, dataclasses.replace(SHORT_CONFIG, steps=60))

    assert trainer.choices["exposure"].startswith("per-image gains; by their tracks the photos differ by 0.5")
    np.testing.assert_allclose(trainer.exposures.values.detach(), centred_log_gains(gains), atol=0.05)


def test_gains_are_not_learnt_by_default_even_where_photos_differ_by_a_stop():
    scene = exposed_scene(alternating_gains(6, stops=1.0))
    default = dataclasses.replace(SHORT_CONFIG, exposure=TrainConfig().exposure)

    by_default, without = train_trainer(scene, default), train_trainer(dataclasses.replace(scene, tracks={}), default)

    assert by_default.exposures is None and by_default.choices["exposure"] == "off"
    assert parameter_bytes(by_default) == parameter_bytes(without) and records_without_times(
        by_default
    ) == records_without_times(without)


def test_gains_of_photos_without_tracks_start_at_one():
    trainer = Trainer(dataclasses.replace(exposed_scene(alternating_gains(6)), tracks={}), SHORT_CONFIG)
    assert trainer.choices["exposure"] == "per-image gains; too few tracks show the photos' exposures"
    assert torch.equal(trainer.exposures.values, torch.zeros(6, 3))


def test_too_few_points_to_compare_photos_are_not_reported_as_equal_exposures():
    scene = exposed_scene(alternating_gains(6))
    few = {name: rows[: MIN_POINTS_PER_PHOTO - 1] for name, rows in scene.tracks.items()}
    trainer = Trainer(dataclasses.replace(scene, tracks=few), SHORT_CONFIG)
    assert trainer.choices["exposure"] == "per-image gains; too few tracks show the photos' exposures"


@pytest.mark.acceptance
def test_an_interrupted_run_continues_to_the_same_bytes(tmp_path):
    scene, path = exposed_scene(alternating_gains(6)), tmp_path / "checkpoint.pt"
    whole, first = train_trainer(scene), Trainer(scene, SHORT_CONFIG)
    assert not first.run(checkpoint=path, stop=lambda: first.step == 17)

    second = Trainer(scene, SHORT_CONFIG)
    second.load(path)
    second.run()

    assert parameter_bytes(second) == parameter_bytes(whole) and records_without_times(second) == records_without_times(
        whole
    )
    assert torch.equal(second.exposures.values, whole.exposures.values)
    with pytest.raises(HyrfTrainingError, match=r"other settings \(exposure\)"):
        Trainer(scene, dataclasses.replace(SHORT_CONFIG, exposure=False)).load(path)


def test_exposure_of_photos_with_transparency_is_rejected():
    with pytest.raises(
        HyrfTrainingError, match=r"balls: per-image gains do not work with transparent photos.*leave out `exposure`"
    ):
        Trainer(ball_scene(4, alpha=True), SHORT_CONFIG)


@pytest.mark.acceptance
def test_drifting_exposure_stays_out_of_the_model():
    """As when a cloud passes: half a stop lighter, half a stop darker. Every fourth photo is held out."""
    drift = 0.5 * 2 ** (0.5 * np.sin(np.arange(16) / 16 * 2 * np.pi) / 2.2)
    scene = exposed_scene((drift / (1 - drift))[:, None], side=32)
    split = dataclasses.replace(
        scene, train=[v for n, v in enumerate(scene.train) if n % 4 != 2], test=scene.train[2::4]
    )

    model = train_trainer(split, dataclasses.replace(SHORT_CONFIG, steps=200)).model
    scores = evaluate_model(model, split.test)

    assert scores.psnr_consistent is not None and scores.psnr > scores.psnr_consistent + 1

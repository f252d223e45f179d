from __future__ import annotations

import numpy as np
import pytest
import torch
from explicit_balls import ball_splats
from scipy.spatial.transform import Rotation

from hyrfpack.distill import initialize
from hyrfpack.distill.initialize import initial_model, rotations
from hyrfpack.distill.reference import reference_scene
from hyrfpack.splats.draw import Drawable
from hyrfpack.splats.splats import Splats
from hyrfpack.splats.viewpoints import WeightedSplats, sample_viewpoints
from hyrfpack.train import DensityConfig, TrainConfig, Trainer


def make_drawable(splats: Splats) -> tuple[Drawable, list]:
    weighted = WeightedSplats.from_splats(splats, "x")
    drawable = Drawable.from_splats(splats, weighted.frame)
    return drawable, sample_viewpoints(weighted, drawable, 24, 32, 0)


def covariances(scales, quats) -> np.ndarray:
    turns = Rotation.from_quat(np.asarray(quats), scalar_first=True).as_matrix()
    return turns * np.asarray(scales, np.float64)[:, None] ** 2 @ turns.transpose(0, 2, 1)


def test_rotations_match_scipy() -> None:
    quats = torch.randn(20, 4, generator=torch.Generator().manual_seed(0))
    np.testing.assert_allclose(
        rotations(quats).permute(2, 0, 1), Rotation.from_quat(quats.numpy(), scalar_first=True).as_matrix(), atol=1e-6
    )


@pytest.mark.parametrize("degree", [0, 1])
def test_fields_learn_shapes_and_colours(degree: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(initialize, "MIN_STEPS", 200)
    splats = ball_splats(100, degree)
    drawable, cameras = make_drawable(splats)
    model = initial_model(drawable, torch.ones(100), cameras, 0)
    with torch.no_grad():
        made = model.decode_geometry()
        place = torch.tensor((3.0, 1.0, 0.0))
        colors = model.decode_colors(place)
        wanted = drawable.evaluate_colors(place, torch.arange(100)).clamp(0, 1)
    # Ellipsoids are compared, because the order of their axes is arbitrary. Sizes and opacities are stored exactly.
    expected = covariances(drawable.scales, drawable.quats)
    error = np.linalg.norm(covariances(made.scales, made.quats) - expected, axis=(1, 2))
    assert np.median(error / np.linalg.norm(expected, axis=(1, 2))) < 0.1
    np.testing.assert_allclose(made.opacities, drawable.opacities, rtol=1e-4)
    np.testing.assert_allclose(made.scales.log().mean(1), drawable.scales.log().mean(1), atol=0.05)
    assert float((colors - wanted).abs().mean()) < (0.01 if degree == 0 else 0.1)


def test_many_gaussians_take_fewer_steps_of_larger_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    taken = []

    def watched(*arguments):
        for some in batches(*arguments):
            taken.append(len(some))
            yield some

    batches = initialize._batches
    monkeypatch.setattr(initialize, "_batches", watched)
    monkeypatch.setattr(initialize, "MIN_BATCH_GAUSSIANS", 8)
    monkeypatch.setattr(initialize, "TARGET_EPOCHS", 16)
    drawable, cameras = make_drawable(ball_splats(100))
    for work, steps, batch in ((10**9, 200, 8), (100 * 40, 40, 40), (100, 1, 100)):
        taken.clear()
        monkeypatch.setattr(initialize, "MAX_STEPS_TIMES_GAUSSIANS", work)
        initial_model(drawable, torch.ones(100), cameras, 0)
        assert len(taken) in (steps, steps + 1) and max(taken) == batch


def test_the_trainer_continues_from_a_given_model() -> None:
    splats = ball_splats(50)
    drawable, cameras = make_drawable(splats)
    model = initial_model(drawable, torch.ones(50), cameras, 0)
    before = model.gaussians.color_logits.detach().clone()
    scene = reference_scene("ball", drawable, cameras, [])
    trainer = Trainer(scene, TrainConfig(steps=2, density=DensityConfig(stop=0.0)), model=model)
    assert trainer.run()
    assert trainer.model is model
    assert len(model) == 50
    assert not torch.equal(model.gaussians.color_logits, before)

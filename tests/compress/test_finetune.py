"""Fine-tuning a quantised model: what moves, what stays, and that it is worth it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from scenes import ball_scene

from hyrfpack.compress.finetune import finetune
from hyrfpack.compress.plan import make_plan
from hyrfpack.compress.quantize import decide, quantize
from hyrfpack.compress.sensitivity import Sensitivity, measure_sensitivity
from hyrfpack.data import PictureCache
from hyrfpack.errors import HyrfTrainingError
from hyrfpack.evaluate import evaluate_model
from hyrfpack.format import decode_model, encode_model
from hyrfpack.format.compact.plan import Plan
from hyrfpack.model import HybridModel
from hyrfpack.scene import Picture, Scene
from hyrfpack.train import TrainConfig, Trainer

DISTORTION = 2e-3  # 27 dB between pictures before and after: there is something to mend


@pytest.fixture(scope="module")
def scene() -> Scene:
    return ball_scene(views=8, points=80, side=32)


@pytest.fixture(scope="module")
def trained(scene) -> HybridModel:
    trainer = Trainer(scene, TrainConfig(steps=150, max_gaussians=300))
    assert trainer.run()
    return trainer.model


@pytest.fixture(scope="module")
def sensitivity(trained, scene) -> Sensitivity:
    return measure_sensitivity(trained, [view.camera for view in scene.train])


@pytest.fixture(scope="module")
def plan(trained, sensitivity) -> Plan:
    return make_plan(trained, sensitivity, DISTORTION)


def decoded(tuned: HybridModel, plan: Plan, sensitivity: Sensitivity, reach: int = 0) -> tuple[HybridModel, int]:
    """A fine-tuned model as its file gives it back, and the bytes of that."""
    data = encode_model(tuned, "compact", quantized=quantize(tuned, plan, sensitivity, reach=reach))
    return decode_model(data), len(data)


def test_fine_tuning_is_worth_more_than_the_same_bytes_of_finer_steps(trained, plan, sensitivity, scene):
    finer = encode_model(trained, "compact", quantized=decide(trained, sensitivity, DISTORTION / 3))
    without = evaluate_model(decode_model(finer), scene.train).psnr
    steps = []

    tuned, moved = finetune(
        trained, plan, sensitivity, scene.train, 150, report=lambda step, loss: steps.append((step, loss))
    )

    model, size = decoded(tuned, moved, sensitivity)
    after = evaluate_model(model, scene.train).psnr
    assert size < len(finer)
    assert after > without + 0.5
    assert [step for step, _ in steps] == list(range(1, 151))
    assert np.mean([loss for _, loss in steps[-8:]]) < np.mean([loss for _, loss in steps[:8]])


def test_fields_and_logits_move_and_the_model_given_is_not_touched(trained, plan, sensitivity, scene):
    before = {name: value.clone() for name, value in trained.state_dict().items()}
    planned = plan.apply(trained)

    tuned, moved = finetune(trained, plan, sensitivity, scene.train, 5)

    for name, value in trained.state_dict().items():
        assert torch.equal(value, before[name]), name
    assert all(parameter.grad is None for parameter in trained.parameters())
    assert all(parameter.requires_grad for parameter in tuned.parameters())
    for name in ("gaussians.color_logits", "gaussians.opacity_logits", "geometry.grid.table", "radiance.weights.0"):
        assert not torch.equal(tuned.state_dict()[name], planned.state_dict()[name]), name
    assert sorted(moved.kept) == sorted(plan.kept)


def test_positions_move_on_the_lattice_and_stay_in_their_class(trained, sensitivity, scene):
    plan = make_plan(trained, sensitivity, DISTORTION / 1000)

    tuned, moved = finetune(trained, plan, sensitivity, scene.train, 5)

    model, _ = decoded(tuned, moved, sensitivity)
    assert torch.equal(model.gaussians.positions, tuned.gaussians.positions)
    in_order = np.argsort(plan.kept)[np.argsort(np.argsort(moved.kept))]
    assert not torch.equal(tuned.gaussians.positions, plan.apply(trained).gaussians.positions[in_order])
    before = trained.gaussians.positions[moved.kept].detach()
    distance = (tuned.gaussians.positions.detach() - before).norm(dim=1).numpy()
    assert np.median(distance) < 0.02
    classes = np.empty(len(trained), np.uint8)
    classes[plan.kept] = np.concatenate([layer.points.classes for layer in plan.layers])
    assert np.array_equal(classes[moved.kept], np.concatenate([layer.points.classes for layer in moved.layers]))


def test_what_is_decoded_is_the_nearest_to_the_fitted_numbers(trained, plan, sensitivity, scene):
    """Fitted numbers sit where they shall be rounded to: with `reach` 0 nothing is traded for bits any more."""
    tuned, moved = finetune(trained, plan, sensitivity, scene.train, 5)

    model, _ = decoded(tuned, moved, sensitivity)

    for name in ("color_logits", "scale_logits"):
        off = getattr(model.gaussians, name) - getattr(tuned.gaussians, name)
        traded = decoded(tuned, moved, sensitivity, reach=1)[0].gaussians
        assert off.abs().mean() < (getattr(traded, name) - getattr(tuned.gaussians, name)).abs().mean()


def test_the_same_seed_gives_the_same_model_and_another_another(trained, plan, sensitivity, scene):
    first, again, other = (finetune(trained, plan, sensitivity, scene.train, 6, seed=seed)[0] for seed in (0, 0, 1))

    pairs = list(zip(first.parameters(), again.parameters(), other.parameters(), strict=True))
    assert all(torch.equal(a, b) for a, b, _ in pairs)
    assert not all(torch.equal(a, c) for a, _, c in pairs)


def test_each_epoch_takes_every_view_once(trained, plan, sensitivity, scene):
    seen = []

    def watched(view):
        return dataclasses.replace(view, load=lambda: seen.append(view.name) or view.load())

    finetune(trained, plan, sensitivity, [watched(view) for view in scene.train], 16, cache=PictureCache(0))

    names = {view.name for view in scene.train}
    assert set(seen[:8]) == set(seen[8:16]) == names


def test_a_photo_of_nan_stops_it_with_the_step_and_the_view(trained, plan, sensitivity, scene):
    class Broken(Picture):
        def composite(self, solid=None):
            return np.full((32, 32, 3), np.nan, np.float32)

    view = dataclasses.replace(scene.train[2], load=lambda: Broken(np.zeros((32, 32, 3), np.uint8)))

    with pytest.raises(HyrfTrainingError, match="stopped at step 1 on view '002.png'.*without `finetune_steps`"):
        finetune(trained, plan, sensitivity, [view], 3)


def test_a_model_that_was_loaded_is_fitted_too(trained, plan, sensitivity, scene):
    loaded = decode_model(encode_model(trained))
    tuned, _ = finetune(loaded, plan, sensitivity, scene.train, 1)
    assert not torch.equal(tuned.gaussians.color_logits, plan.apply(loaded).gaussians.color_logits)

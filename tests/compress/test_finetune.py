"""Fine-tuning a quantised model improves its PSNR, keeps classes and depends only on the seed."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from scenes import alternating_gains, exposed_scene

from hyrfpack.compress.finetune import finetune
from hyrfpack.compress.plan import make_plan
from hyrfpack.compress.quantize import plan_and_quantize, quantize
from hyrfpack.compress.sensitivity import Sensitivity, measure_sensitivity
from hyrfpack.data import PictureCache
from hyrfpack.errors import HyrfTrainingError
from hyrfpack.evaluate import evaluate_model
from hyrfpack.format import decode_model, encode_model, load_model
from hyrfpack.format.compact.plan import Plan
from hyrfpack.model import HybridModel
from hyrfpack.scene import Picture, Scene
from tools.safety.train_golden import EXPOSED_MODEL_FILE

# Packing costs 9 dB of PSNR on the photos, which leaves room for improvement.
COARSE_DISTORTION = 5e-4


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Return photos at the mean exposure of the golden model."""
    mean_gain = np.exp(np.log(alternating_gains(8, stops=1.0)).mean())
    return exposed_scene(np.full((8, 1), mean_gain), side=32)


@pytest.fixture(scope="module")
def trained_model() -> HybridModel:
    """Return the golden model without its exposure map."""
    model = load_model(EXPOSED_MODEL_FILE)
    model.exposure = None
    return model


@pytest.fixture(scope="module")
def sensitivity(trained_model, scene) -> Sensitivity:
    return measure_sensitivity(trained_model, [view.camera for view in scene.train])


@pytest.fixture(scope="module")
def plan(trained_model, sensitivity) -> Plan:
    return make_plan(trained_model, sensitivity, COARSE_DISTORTION)


def encode_and_decode(
    tuned: HybridModel, plan: Plan, sensitivity: Sensitivity, reach: int = 0
) -> tuple[HybridModel, int]:
    """Encode a fine-tuned model; return the decoded model and the size of the file in bytes."""
    data = encode_model(tuned, "compact", quantized=quantize(tuned, plan, sensitivity, reach=reach))
    return decode_model(data), len(data)


@pytest.mark.acceptance
def test_finetuning_gains_more_psnr_than_finer_steps_of_the_same_size(trained_model, plan, sensitivity, scene):
    finer = encode_model(
        trained_model, "compact", quantized=plan_and_quantize(trained_model, sensitivity, COARSE_DISTORTION / 3)
    )
    without = evaluate_model(decode_model(finer), scene.train).psnr
    start, _ = encode_and_decode(plan.apply(trained_model), plan, sensitivity)
    events = []

    tuned, moved = finetune(trained_model, plan, sensitivity, scene.train, 80, progress=events.append)

    model, size = encode_and_decode(tuned, moved, sensitivity)
    after = evaluate_model(model, scene.train).psnr
    assert size < len(finer)
    assert after > max(without, evaluate_model(start, scene.train).psnr) + 0.5
    assert [(event.task, event.share) for event in events] == [
        (f"fine-tuning, step {step}/80", step / 80) for step in range(1, 81)
    ]


def test_finetuning_changes_fields_and_logits_but_not_the_input_model(trained_model, plan, sensitivity, scene):
    before = {name: value.clone() for name, value in trained_model.state_dict().items()}
    planned = plan.apply(trained_model)

    tuned, moved = finetune(trained_model, plan, sensitivity, scene.train, 5)

    for name, value in trained_model.state_dict().items():
        assert torch.equal(value, before[name]), name
    assert all(parameter.grad is None for parameter in trained_model.parameters())
    assert all(parameter.requires_grad for parameter in tuned.parameters())
    for name in ("gaussians.color_logits", "gaussians.opacity_logits", "geometry.grid.table", "radiance.weights.0"):
        assert not torch.equal(tuned.state_dict()[name], planned.state_dict()[name]), name
    assert sorted(moved.kept) == sorted(plan.kept)


def test_positions_move_on_the_lattice_and_stay_in_their_class(trained_model, sensitivity, scene):
    plan = make_plan(trained_model, sensitivity, COARSE_DISTORTION / 1000)

    tuned, moved = finetune(trained_model, plan, sensitivity, scene.train, 5)

    model, _ = encode_and_decode(tuned, moved, sensitivity)
    assert torch.equal(model.gaussians.positions, tuned.gaussians.positions)
    in_order = np.argsort(plan.kept)[np.argsort(np.argsort(moved.kept))]
    assert not torch.equal(tuned.gaussians.positions, plan.apply(trained_model).gaussians.positions[in_order])
    before = trained_model.gaussians.positions[moved.kept].detach()
    distance = (tuned.gaussians.positions.detach() - before).norm(dim=1).numpy()
    assert np.median(distance) < 0.02
    classes = np.empty(len(trained_model), np.uint8)
    classes[plan.kept] = np.concatenate([layer.points.classes for layer in plan.layers])
    assert np.array_equal(classes[moved.kept], np.concatenate([layer.points.classes for layer in moved.layers]))


def test_decoded_values_are_nearest_to_the_finetuned_ones(trained_model, plan, sensitivity, scene):
    """Fine-tuned values are trained through the quantiser, and with `reach` 0 each is rounded to the nearest step."""
    tuned, moved = finetune(trained_model, plan, sensitivity, scene.train, 5)

    model, _ = encode_and_decode(tuned, moved, sensitivity)

    for name in ("color_logits", "scale_logits"):
        off = getattr(model.gaussians, name) - getattr(tuned.gaussians, name)
        traded = encode_and_decode(tuned, moved, sensitivity, reach=1)[0].gaussians
        assert off.abs().mean() < (getattr(traded, name) - getattr(tuned.gaussians, name)).abs().mean()


def test_the_finetuned_model_depends_on_the_seed(trained_model, plan, sensitivity, scene):
    first, again, other = (
        finetune(trained_model, plan, sensitivity, scene.train, 6, seed=seed)[0] for seed in (0, 0, 1)
    )

    pairs = list(zip(first.parameters(), again.parameters(), other.parameters(), strict=True))
    assert all(torch.equal(a, b) for a, b, _ in pairs)
    assert not all(torch.equal(a, c) for a, _, c in pairs)


def test_each_epoch_visits_every_view_once(trained_model, plan, sensitivity, scene):
    seen = []

    def recording_view(view):
        return dataclasses.replace(view, load=lambda: seen.append(view.name) or view.load())

    finetune(
        trained_model, plan, sensitivity, [recording_view(view) for view in scene.train], 16, cache=PictureCache(0)
    )

    names = {view.name for view in scene.train}
    assert set(seen[:8]) == set(seen[8:16]) == names


def test_a_photo_with_nan_stops_finetuning_with_the_step_and_the_view(trained_model, plan, sensitivity, scene):
    class NanPicture(Picture):
        def composite(self, solid=None):
            return np.full((32, 32, 3), np.nan, np.float32)

    view = dataclasses.replace(scene.train[2], load=lambda: NanPicture(np.zeros((32, 32, 3), np.uint8)))

    with pytest.raises(HyrfTrainingError, match="stopped at step 1 on view '002.png'.*without `finetune_steps`"):
        finetune(trained_model, plan, sensitivity, [view], 3)


def test_a_loaded_model_can_be_finetuned(trained_model, plan, sensitivity, scene):
    loaded = decode_model(encode_model(trained_model))
    tuned, _ = finetune(loaded, plan, sensitivity, scene.train, 1)
    assert not torch.equal(tuned.gaussians.color_logits, plan.apply(loaded).gaussians.color_logits)

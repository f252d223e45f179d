"""The training loop: what a run computes, records and refuses."""

from __future__ import annotations

import dataclasses
from contextlib import nullcontext

import numpy as np
import pytest
import torch
from scenes import view_of
from short_runs import (
    SHORT_CONFIG,
    TRAINING_SETTINGS,
    make_scene,
    mean_training_psnr,
    parameter_bytes,
    records_without_times,
    train_trainer,
)

from hyrfpack.config.train import FIELD_WARMUP_STEPS
from hyrfpack.errors import HyrfError, HyrfTrainingError
from hyrfpack.format import decode_model, encode_model
from hyrfpack.ops.adam import adam_step
from hyrfpack.render import render_view
from hyrfpack.scene import Picture
from hyrfpack.train import TrainConfig, Trainer
from hyrfpack.train.density import spatial_order


@pytest.fixture(scope="module")
def uninterrupted_trainer() -> Trainer:
    """The trainer of the uninterrupted run."""
    return train_trainer()


def test_training_reduces_the_loss_and_raises_the_psnr():
    trainer = Trainer(make_scene(side=32), TrainConfig(steps=60, max_gaussians=160))
    before, losses = mean_training_psnr(trainer), []

    trainer.run(progress=lambda event: losses.append(event.loss))

    assert len(losses) == trainer.step == 60
    assert np.mean(losses[-6:]) < 0.5 * np.mean(losses[:6])
    assert mean_training_psnr(trainer) > before + 4


@pytest.mark.parametrize("alpha_color", ["black", "white", "random"])
def test_objects_with_coverage_train_over_any_colour(alpha_color):
    config = TrainConfig(steps=40, max_gaussians=160, background_color=alpha_color)
    trainer = Trainer(make_scene(alpha=True), config)
    losses = []
    trainer.run(progress=lambda event: losses.append(event.loss))
    assert trainer.model.config.background is False
    assert np.mean(losses[-6:]) < 0.9 * np.mean(losses[:6])


def test_the_same_seed_gives_the_same_bytes(uninterrupted_trainer):
    assert parameter_bytes(train_trainer()) == parameter_bytes(uninterrupted_trainer)


@pytest.mark.acceptance
def test_another_seed_gives_another_model(uninterrupted_trainer):
    other = train_trainer(dataclasses.replace(SHORT_CONFIG, seed=4))
    assert parameter_bytes(other) != parameter_bytes(uninterrupted_trainer)


def test_the_budget_is_kept_at_every_step():
    counts = []
    trainer = Trainer(make_scene(), dataclasses.replace(SHORT_CONFIG, max_gaussians=75))
    trainer.run(progress=lambda event: counts.append(event.gaussians))
    assert max(counts) <= 75 and counts[-1] > 60


def test_the_reference_run_adds_gaussians_and_resets_opacities(uninterrupted_trainer):
    """Otherwise the tests of resuming and determinism would prove little."""
    counts = [record["gaussians"] for record in uninterrupted_trainer.records]
    assert counts[0] != counts[7] != counts[-1]
    assert (
        uninterrupted_trainer.strategy.first,
        uninterrupted_trainer.strategy.interval,
        uninterrupted_trainer.strategy.last,
    ) == (2, 5, 27)


def test_every_epoch_shows_every_view_once_in_another_order():
    trainer = Trainer(make_scene(views=5), dataclasses.replace(SHORT_CONFIG, steps=20))
    names = [view.name for view in trainer._order()]
    epochs = [tuple(names[i : i + 5]) for i in range(0, 20, 5)]
    assert all(set(epoch) == {view.name for view in trainer.scene.train} for epoch in epochs)
    assert len(set(epochs)) > 1


def test_records_and_times_describe_the_run(uninterrupted_trainer):
    assert [record["step"] for record in uninterrupted_trainer.records] == list(range(1, 41))
    assert uninterrupted_trainer.records[-1]["gaussians"] == len(uninterrupted_trainer.model)
    seconds = [record["seconds"] for record in uninterrupted_trainer.records]
    assert seconds == sorted(seconds) and seconds[-1] == pytest.approx(uninterrupted_trainer.elapsed, abs=1e-3)
    assert all(
        set(record) == {"step", "loss", "psnr", "gaussians", "seconds"} for record in uninterrupted_trainer.records
    )
    assert {"data", "cull", "decode", "loss", "backward", "density", "optimizer"} <= set(uninterrupted_trainer.seconds)


def test_absolute_gradients_are_computed_only_while_they_are_used(monkeypatch):
    asked = []

    def spy(*arguments, absgrad, **options):
        asked.append(absgrad)
        return render_view(*arguments, absgrad=absgrad, **options)

    monkeypatch.setattr("hyrfpack.train.gradients.render_view", spy)
    train_trainer()
    assert asked == [True] * 27 + [False] * 13


class Clock:
    """A replacement of the time module in which time passes only when a test advances it."""

    now = 0.0

    def perf_counter(self) -> float:
        return self.now


def use_clock(trainer: Trainer, clock: Clock, monkeypatch) -> None:
    """Make the optimiser advance the clock by 2 seconds in every step."""
    step = trainer.optimizer.step

    def slow(*arguments):
        clock.now += 2
        return step(*arguments)

    monkeypatch.setattr(trainer.optimizer, "step", slow)


def test_elapsed_seconds_are_those_of_the_steps_over_all_parts_of_a_run(tmp_path, monkeypatch):
    clock, path = Clock(), tmp_path / "checkpoint.pt"
    for module in ("train.trainer", "measure.stages"):
        monkeypatch.setattr(f"hyrfpack.{module}.time", clock)
    config = dataclasses.replace(SHORT_CONFIG, steps=12)

    def meanwhile(*_) -> None:
        clock.now += 1000  # time spent on the report does not count as training

    first, second = Trainer(make_scene(), config), Trainer(make_scene(), config)
    use_clock(first, clock, monkeypatch)
    first.run(checkpoint=path, progress=meanwhile, stop=lambda: first.step == 5)
    assert first.elapsed == 10
    second.load(path)
    assert second.elapsed == 10 and second.seconds["optimizer"] == 10
    use_clock(second, clock, monkeypatch)
    second.run(progress=meanwhile)

    assert second.elapsed == 24 and second.seconds["optimizer"] == 24 and second.seconds["backward"] == 0


@pytest.mark.parametrize("fails", [False, True])
def test_torch_computes_on_one_thread_while_training_and_on_as_many_as_before_after(fails):
    trainer, seen, before = (
        Trainer(make_scene(), dataclasses.replace(SHORT_CONFIG, steps=2)),
        [],
        torch.get_num_threads(),
    )

    def look(*_) -> None:
        seen.append(torch.get_num_threads())
        if fails:
            raise KeyboardInterrupt

    try:
        torch.set_num_threads(2)
        with pytest.raises(KeyboardInterrupt) if fails else nullcontext():
            trainer.run(progress=look)
        assert set(seen) == {1} and torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_reported_errors_are_those_of_the_picture():
    """With one view and no learning, step 1 reports the mean squared error of the untrained model."""
    trainer = Trainer(make_scene(views=1), TrainConfig(steps=1, max_gaussians=80))
    before, seen = mean_training_psnr(trainer), []
    trainer.run(progress=lambda event: seen.append(event.mse))
    assert -10 * np.log10(seen[0]) == pytest.approx(before, abs=1e-3)


def test_learning_rates_fall_from_the_first_value_to_the_last_after_the_warm_up_of_the_fields(monkeypatch):
    rates = []

    def recorded(*arguments, rate, **others):
        rates.append(rate[:5])  # the first rate of each group, because the fields have many parameters of one rate
        return adam_step(*arguments, rate=rate, **others)

    monkeypatch.setattr("hyrfpack.train.optimizer.adam_step", recorded)
    trainer = Trainer(make_scene(), dataclasses.replace(SHORT_CONFIG, steps=30))
    trainer.run()
    asked, warm_up = trainer.learning_rates, np.minimum(np.arange(1, 31) / 20, 1)
    for name, found in zip(trainer.optimizer.groups, np.reshape(rates, (30, -1)).T, strict=True):
        first, last = getattr(asked, name)
        scheduled = 30**0.5 * np.geomspace(first, last, 31)[:30]
        np.testing.assert_allclose(found, scheduled * warm_up if name == "fields" else scheduled, rtol=1e-9)


def test_masked_pixels_do_not_affect_training():
    """Photos that differ only under the mask train the same model and report the same errors.

    The loss is L1 alone, because it has no window.
    """
    scene = make_scene(views=2)
    mask = np.ones((24, 24), bool)
    mask[6:18, :10] = False
    models, records = [], []
    for fill in (0, 255):
        views = []
        for view in scene.train:
            rgb = view.load().rgb.copy()
            rgb[~mask] = fill
            views.append(view_of(view.name, view.camera, Picture(rgb, None, mask)))
        config = dataclasses.replace(SHORT_CONFIG, steps=6, ssim_weight=0.0)
        trainer = Trainer(dataclasses.replace(scene, train=views), config)
        trainer.run()
        models.append(parameter_bytes(trainer))
        records.append(trainer.records)
    assert models[0] == models[1]
    assert records_without_times(records[0]) == records_without_times(records[1])


def test_reported_errors_are_those_outside_the_mask():
    scene = make_scene(views=1)
    view, mask = scene.train[0], np.zeros((24, 24), bool)
    mask[4:15, 7:20] = True
    masked = view_of(view.name, view.camera, Picture(view.load().rgb, None, mask))
    trainer = Trainer(dataclasses.replace(scene, train=[masked]), TrainConfig(steps=1, max_gaussians=80))
    with torch.no_grad():
        rgb = render_view(trainer.model, view.camera, TRAINING_SETTINGS).rgb.double().numpy()
    seen = []
    trainer.run(progress=lambda event: seen.append(event.mse))
    errors = (rgb - view.load().rgb / 255) ** 2
    assert seen[0] == pytest.approx(errors[4:15, 7:20].mean(), rel=1e-4)
    assert abs(seen[0] - errors.mean()) > 0.01 * errors.mean()  # otherwise the mask would make no difference


def test_a_completely_masked_photo_does_not_change_the_model():
    scene = make_scene(views=1)
    view = scene.train[0]
    masked = view_of(view.name, view.camera, Picture(view.load().rgb, None, np.zeros((24, 24), bool)))
    trainer = Trainer(dataclasses.replace(scene, train=[masked]), dataclasses.replace(SHORT_CONFIG, steps=1))
    trainer.optimizer.reorder_gaussians(spatial_order(trainer.model))  # as the round after the step would do
    before, said = parameter_bytes(trainer), []
    trainer.run(progress=lambda event: said.append((event.loss, event.mse)))
    assert said[0][0] == 0 and np.isnan(said[0][1])
    assert trainer.records == [] and parameter_bytes(trainer) == before


def test_a_photo_with_nan_stops_the_run_and_is_named():
    scene = make_scene()
    broken = np.array(scene.train[4].load().rgb, np.float32)
    broken[3, 5, 1] = np.nan
    trainer = Trainer(scene, SHORT_CONFIG)
    scene.train[4] = view_of("bad.png", scene.train[4].camera, Picture(broken))
    step = 1 + next(i for i, view in enumerate(trainer._order()) if view.name == "bad.png")

    with pytest.raises(HyrfTrainingError, match=rf"step {step} on view 'bad.png'.*not finite.*photo"):
        trainer.run()


@pytest.mark.parametrize("name", ["gaussians.color_logits", "radiance.biases.2", "radiance.grid.table"])
def test_a_parameter_that_is_not_finite_stops_the_run_and_is_named(name):
    trainer = Trainer(make_scene(), SHORT_CONFIG)
    with torch.no_grad():
        dict(trainer.model.named_parameters())[name].view(-1)[::3] = float("nan")
    first = next(trainer._order()).name
    with pytest.raises(HyrfTrainingError) as caught:
        trainer.run()
    message = str(caught.value)
    assert "step 1 " in message and f"'{first}'" in message
    assert name in message


def test_a_view_that_cannot_be_rendered_is_named_with_the_reason_and_its_fix(monkeypatch):
    trainer = Trainer(make_scene(), SHORT_CONFIG)

    def fail(*_, **__):
        raise HyrfError("the view's pose: a number is infinite", fix="correct the pose")

    monkeypatch.setattr(trainer.renderer, "compute_gradients", fail)
    first = next(trainer._order()).name
    with pytest.raises(HyrfTrainingError) as caught:
        trainer.run()
    assert (
        caught.value.problem == f"training stopped at step 1 on view '{first}': the view's pose: a number is infinite"
    )
    assert caught.value.fix == "correct the pose"


def test_a_gradient_that_is_not_finite_stops_the_run_before_it_spreads():
    trainer = Trainer(make_scene(), SHORT_CONFIG)
    trainer.model.gaussians.color_logits.register_hook(lambda grad: grad * float("nan"))
    before = trainer.model.gaussians.color_logits.detach().clone()
    with pytest.raises(HyrfTrainingError, match=r"step 1 on view .*gradient is not finite.*color_logits"):
        trainer.run()
    assert torch.equal(trainer.model.gaussians.color_logits, before)
    assert all(torch.isfinite(p).all() for p in trainer.model.parameters())


@pytest.mark.parametrize("name", ["positions", "scale_logits", "opacity_logits"])
def test_one_broken_gaussian_neither_crashes_nor_spreads(name):
    """The rasteriser skips it, and the next round removes it."""
    trainer = Trainer(make_scene(), SHORT_CONFIG)
    with torch.no_grad():
        getattr(trainer.model.gaussians, name)[7] = float("nan")
    try:
        trainer.run()
    except HyrfTrainingError as error:
        assert name in str(error)
    else:
        assert all(torch.isfinite(p).all() for p in trainer.model.parameters())


def test_only_untrained_models_have_a_warm_up():
    untrained = Trainer(make_scene(), SHORT_CONFIG)
    continued = Trainer(make_scene(), SHORT_CONFIG, model=untrained.model)
    assert (untrained.optimizer.warmup_steps, continued.optimizer.warmup_steps) == (FIELD_WARMUP_STEPS, 0)


@pytest.mark.parametrize("budget", [1, 2])
def test_the_smallest_budgets_train(budget):
    trainer = train_trainer(dataclasses.replace(SHORT_CONFIG, steps=20, max_gaussians=budget))
    assert len(trainer.model) == budget


@pytest.mark.acceptance
def test_millimetres_and_kilometres_train_to_the_same_quality(uninterrupted_trainer):
    in_mm, in_km = mean_training_psnr(train_trainer(scale=1e3)), mean_training_psnr(train_trainer(scale=1e-3))
    assert in_mm == pytest.approx(in_km, abs=0.1)
    assert in_mm == pytest.approx(mean_training_psnr(uninterrupted_trainer), abs=0.1)


def test_a_scene_a_million_units_from_the_origin_trains_as_well(uninterrupted_trainer):
    assert mean_training_psnr(train_trainer(offset=(1e6, -1e6, 5e5))) == pytest.approx(
        mean_training_psnr(uninterrupted_trainer), abs=0.1
    )


def test_a_loaded_model_can_be_trained_further():
    model = decode_model(encode_model(Trainer(make_scene(), SHORT_CONFIG).model))
    before = model.gaussians.color_logits.clone()
    trainer = Trainer(make_scene(), dataclasses.replace(SHORT_CONFIG, steps=1), model=model)
    trainer.run()
    assert not torch.equal(trainer.model.gaussians.color_logits, before)


@pytest.mark.parametrize("name", ["shape_residuals", "color_residuals"])
def test_a_model_with_residuals_is_not_trained(name):
    model = Trainer(make_scene(), SHORT_CONFIG).model
    setattr(model.gaussians, name, torch.zeros(len(model), 5))
    with pytest.raises(HyrfTrainingError, match="has residuals"):
        Trainer(make_scene(), SHORT_CONFIG, model=model)


def test_pixel_sizes_of_a_loaded_model_do_not_affect_its_training():
    parameters = []
    for size in (None, 1.0):  # of a photo's pixel at each Gaussian, in local units
        model = decode_model(encode_model(Trainer(make_scene(), SHORT_CONFIG).model))
        model.gaussians.pixel_sizes = None if size is None else torch.full((len(model),), size)
        trainer = Trainer(make_scene(), dataclasses.replace(SHORT_CONFIG, steps=20), model=model)
        trainer.run()
        parameters.append(parameter_bytes(trainer))
    assert parameters[0] == parameters[1]


def test_frozen_parameters_stay_frozen():
    model = Trainer(make_scene(), SHORT_CONFIG).model
    model.geometry.requires_grad_(False)
    trainer = Trainer(make_scene(), dataclasses.replace(SHORT_CONFIG, steps=1), model=model)
    assert not any(parameter.requires_grad for parameter in trainer.model.geometry.parameters())

"""A run that is interrupted and resumed gives the bytes of the whole run, and rejects what does not belong to it."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch
from short_runs import SHORT_CONFIG, make_scene, parameter_bytes, records_without_times, train_trainer

from hyrfpack.errors import HyrfError, HyrfTrainingError
from hyrfpack.train import LearningRates, TrainConfig, Trainer
from hyrfpack.train.checkpoint import load_checkpoint, save_checkpoint


@pytest.fixture(scope="module")
def uninterrupted_trainer() -> Trainer:
    """The trainer of the uninterrupted run."""
    return train_trainer()


def stop_at(step: int, path: Path, config: TrainConfig = SHORT_CONFIG, **options) -> Trainer:
    trainer = Trainer(make_scene(**options), config)
    assert not trainer.run(checkpoint=path, stop=lambda: trainer.step == step)
    assert trainer.step == step
    return trainer


# 1: before the first regular checkpoint; 2 and 12: directly after a round (and a reset); 14: between rounds, with
# collected gradients; 30: after density control; 39: one step before the end.
@pytest.mark.parametrize(
    "step", [2, 14, *(pytest.param(step, marks=pytest.mark.acceptance) for step in (1, 12, 30, 39))]
)
def test_resuming_gives_the_bytes_of_the_uninterrupted_run(step, uninterrupted_trainer, tmp_path):
    path = tmp_path / "checkpoint.pt"
    stop_at(step, path)

    resumed = Trainer(make_scene(), SHORT_CONFIG)
    resumed.load(path)
    assert resumed.step == step and resumed.run(checkpoint=path)

    assert parameter_bytes(resumed) == parameter_bytes(uninterrupted_trainer)
    assert records_without_times(resumed.records) == records_without_times(uninterrupted_trainer.records)


@pytest.mark.acceptance
def test_resuming_again_and_again_gives_the_same_bytes(uninterrupted_trainer, tmp_path):
    path = tmp_path / "checkpoint.pt"
    stop_at(5, path)
    for step in (6, 13, 27):
        trainer = Trainer(make_scene(), SHORT_CONFIG)
        trainer.load(path)
        assert not trainer.run(checkpoint=path, stop=lambda t=trainer, s=step: t.step == s)
    last = Trainer(make_scene(), SHORT_CONFIG)
    last.load(path)
    last.run()
    assert parameter_bytes(last) == parameter_bytes(uninterrupted_trainer)


def test_a_resumed_run_keeps_the_learning_rates_of_its_first_gaussians(tmp_path):
    trainer = Trainer(make_scene(), SHORT_CONFIG)
    trainer.spacing = 0.5  # as if the first Gaussians had been found in another way
    trainer.save(tmp_path / "c.pt")
    resumed = Trainer(make_scene(), SHORT_CONFIG)
    resumed.load(tmp_path / "c.pt")
    assert resumed.learning_rates == LearningRates().at_spacing(0.5)
    assert resumed.optimizer.rates == resumed.learning_rates


@pytest.mark.parametrize(
    "damage",
    [
        lambda tensors, progress: progress.clear(),
        lambda tensors, progress: tensors.clear(),
        lambda tensors, progress: progress.update(step=[1]),
        lambda tensors, progress: progress.update(step=41),
        lambda tensors, progress: progress.update(resolution=3),
        lambda tensors, progress: progress.update(records=3),
        lambda tensors, progress: progress.update(elapsed="x"),
        lambda tensors, progress: progress.update(elapsed=float("nan")),
        lambda tensors, progress: tensors.update({"model.gaussians.positions": torch.zeros(3, 2)}),
        lambda tensors, progress: tensors.update({"model.geometry.grid.table": None}),
    ],
)
def test_a_checkpoint_with_missing_or_wrong_values_is_a_clear_error(damage, tmp_path):
    path, trainer = tmp_path / "c.pt", Trainer(make_scene(), SHORT_CONFIG)
    trainer.save(path)
    tensors, progress = load_checkpoint(path, trainer._settings())
    damage(tensors, progress)
    save_checkpoint(path, settings=trainer._settings(), tensors=tensors, progress=progress)
    with pytest.raises(HyrfTrainingError, match="the checkpoint is damaged"):
        Trainer(make_scene(), SHORT_CONFIG).load(path)


def test_running_out_of_memory_on_resume_does_not_blame_the_checkpoint(tmp_path, monkeypatch):
    path, trainer = tmp_path / "c.pt", Trainer(make_scene(), SHORT_CONFIG)
    trainer.save(path)

    def fail(*_):
        raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr(trainer, "_restore", fail)
    with pytest.raises(HyrfError, match="the GPU's memory ran out"):
        trainer.load(path)


def test_random_backgrounds_resume_too(tmp_path):
    config = dataclasses.replace(SHORT_CONFIG, steps=16, background_color="random")
    expected = train_trainer(config, alpha=True)
    stop_at(9, tmp_path / "checkpoint.pt", config, alpha=True)
    resumed = Trainer(make_scene(alpha=True), config)
    resumed.load(tmp_path / "checkpoint.pt")
    resumed.run()
    assert parameter_bytes(resumed) == parameter_bytes(expected)


def test_regular_checkpoints_are_written_while_running(tmp_path):
    path, found = tmp_path / "checkpoint.pt", []
    trainer = Trainer(make_scene(), dataclasses.replace(SHORT_CONFIG, steps=12, checkpoint_every=5))
    trainer.run(checkpoint=path, progress=lambda _: found.append(path.exists()))
    assert found == [step > 5 for step in range(1, 13)]
    trainer.load(path)
    assert trainer.step == 10


def test_saving_what_was_loaded_gives_the_same_state(tmp_path):
    stopped = stop_at(14, tmp_path / "a.pt")
    loaded = Trainer(make_scene(), SHORT_CONFIG)
    loaded.load(tmp_path / "a.pt")
    assert parameter_bytes(loaded) == parameter_bytes(stopped)
    for name in ("gradients", "views"):
        assert torch.equal(getattr(loaded.strategy, name), getattr(stopped.strategy, name))
    states = stopped.optimizer.state_dict(), loaded.optimizer.state_dict()
    assert states[0].keys() == states[1].keys()
    assert all(torch.equal(states[0][key], states[1][key]) for key in states[0])


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"seed": 4}, "seed"),
        ({"steps": 41}, "steps"),
        ({"max_gaussians": 161}, "max_gaussians"),
        ({"learning_rates": LearningRates(color_logits=(1e-3, 1e-3))}, "learning_rates"),
        ({"background": False}, "background"),
    ],
)
def test_a_run_with_other_settings_is_not_resumed(change, named, tmp_path):
    stop_at(1, tmp_path / "checkpoint.pt")
    with pytest.raises(HyrfTrainingError, match=rf"other settings \(.*{named}"):
        Trainer(make_scene(), dataclasses.replace(SHORT_CONFIG, **change)).load(tmp_path / "checkpoint.pt")


@pytest.mark.parametrize("options", [{"views": 5}, {"side": 20}])
def test_a_run_on_other_photos_is_not_resumed(options, tmp_path):
    stop_at(1, tmp_path / "checkpoint.pt")
    with pytest.raises(HyrfTrainingError, match=r"other settings \(.*views"):
        Trainer(make_scene(**options), SHORT_CONFIG).load(tmp_path / "checkpoint.pt")


def test_a_run_on_moved_cameras_is_not_resumed(tmp_path):
    stop_at(1, tmp_path / "checkpoint.pt")
    with pytest.raises(HyrfTrainingError, match="other settings"):
        Trainer(make_scene(scale=2.0), SHORT_CONFIG).load(tmp_path / "checkpoint.pt")

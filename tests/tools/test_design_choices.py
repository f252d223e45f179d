"""The settings of models that only the study of design choices changes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from scenes import ball_scene, small_model

from hyrfpack.config.train import LearningRates
from hyrfpack.scene import Scene
from hyrfpack.train import DensityConfig, TrainConfig, Trainer
from hyrfpack.train.density import DensityControl
from hyrfpack.train.optimizer import Optimizer
from tools.studies.design_choices import CHOICES_BY_VARIANT, run_folder, train_models_with


def point_sizes(points: np.ndarray) -> np.ndarray:
    """Return the rms distance of each point to its 3 nearest ones, (N, 3)."""
    gaps = np.sort(np.linalg.norm(points[:, None] - points[None], axis=2), axis=1)[:, 1:4]
    return np.repeat(np.sqrt((gaps**2).mean(1))[:, None], 3, 1)


@pytest.mark.parametrize(
    ("settings", "shift"), [({"scale_rule": "product"}, 0), ({"scale_grows": False}, 0), ({"scale_grows": False}, 30)]
)
def test_first_gaussians_have_the_sizes_of_the_points(settings: dict, shift: float) -> None:
    scene = ball_scene(points=80)
    scene = Scene("shifted", "colmap", scene.train, [], scene.points + (shift, 0, 0), scene.point_colors)
    with train_models_with(**settings):
        model = Trainer(scene, TrainConfig(steps=1, surface_points=False)).model
    assert settings.items() <= dataclasses.asdict(model.config).items()
    with torch.no_grad():
        scales = model.decode_geometry().scales.numpy()
    np.testing.assert_allclose(scales, point_sizes(model.config.frame.to_local(scene.points)), rtol=0.02)


@pytest.mark.parametrize("scale_logit", [-3.0, -1.0, 0.3])
def test_children_of_the_product_rule_are_decoded_as_their_parent_over_1_6(scale_logit: float) -> None:
    config = DensityConfig(start=0.5, stop=1.0, gradient=0.0, split_scale=0.01, prune_scale=1.0, resets=0)
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (20, 3))
    model = small_model(points, scale_logits=scale_logit, scale_rule="product", scale_grows=False)
    optimizer, control = Optimizer(model, LearningRates()), DensityControl(config, 100, 40, 20, 0)
    control.gradients += 1
    control.views += 1
    with torch.no_grad(), train_models_with(scale_rule="product"):
        parents = model.decode_geometry().scales
        control.act(50, model, optimizer)
        children = model.decode_geometry().scales
    assert len(model) == 40
    torch.testing.assert_close(children, parents.repeat(2, 1) / 1.6, rtol=1e-4, atol=0)


def test_each_variant_keeps_its_own_runs_wherever_it_stands_in_the_table(tmp_path) -> None:
    folders = {variant: run_folder(tmp_path, variant, "demo", 0).name for variant in CHOICES_BY_VARIANT}
    assert len(set(folders.values())) == len(CHOICES_BY_VARIANT)
    assert folders["no background sphere"] == "no-background-sphere-demo-0"


@pytest.mark.parametrize("name", [name for name, choice in CHOICES_BY_VARIANT.items() if choice.model])
def test_every_choice_of_the_model_trains(name: str) -> None:
    choice = CHOICES_BY_VARIANT[name]
    config = dataclasses.replace(TrainConfig(steps=20, log2_table_size=6, max_gaussians=60), **choice.training)
    with train_models_with(**choice.model):
        trainer = Trainer(ball_scene(3, 40, side=16), config)
        trainer.run()
    assert choice.model.items() <= dataclasses.asdict(trainer.model.config).items()
    assert all(torch.isfinite(parameter).all() for parameter in trainer.model.parameters())

"""Invalid settings are rejected when the configuration is created, with an error that names them."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest
import torch
from scenes import ball_scene

from hyrfpack.config.settings import LARGEST_SEED
from hyrfpack.train import DensityConfig, DensityControl, LearningRates, TrainConfig, Trainer

NON_INTEGERS = (2.5, math.nan, math.inf, True, "3", (3,), np.int64(3))
NON_FLOATS = (math.nan, math.inf, -math.inf, True, "0.1", None, np.float32(0.1))
INVALID_SETTINGS = {
    "steps": (0, -1, None, *NON_INTEGERS),
    "seed": (-1, LARGEST_SEED + 1, None, *NON_INTEGERS),
    "max_gaussians": (0, -1, *NON_INTEGERS),
    "budget_factor": (0.0, -1.0, 1e4, *(value for value in NON_FLOATS if value is not None)),
    "target_bytes": (0, -1, *NON_INTEGERS),
    "checkpoint_every": (0, -1, *NON_INTEGERS),
    "log2_table_size": (3, 25, 40, -1, *NON_INTEGERS),
    "preset": ("indoor", None, 1),
    "precision": ("float16", None),
    "background": (1, "no", math.nan),
    "exposure": (1, "no", math.nan),
    "early_stop": (None, 1, "yes"),
    "resolution_schedule": (None, 1, "yes"),
    "surface_points": (None, 1, "yes"),
    "virtual_views": (None, 1, "yes"),
    "background_color": ("grey", None),
    "antialiased": (None, 1, "yes"),
    "ssim_weight": (1.1, -0.1, *NON_FLOATS),
    "direction_encoding": ("none", None),
    "grid_resolutions": ((64, 32), (1, 32), (8, 65537), (8,), (8, 16, 32), (8.5, 32), (8, math.nan), 8, None, "ab"),
    "learning_rates": (None, {}, 1e-3),
    "density": (None, {}, DensityConfig),
}
INVALID_DENSITY_SETTINGS = {
    **dict.fromkeys(("start", "stop", "peak", "prune_opacity"), (-0.1, 1.1, *NON_FLOATS)),
    **dict.fromkeys(("gradient", "split_scale", "prune_scale"), (-1e-9, *NON_FLOATS)),
    "excess": (0.99, -2.0, *NON_FLOATS),
    "rounds": (0, -1, None, *NON_INTEGERS),
    "resets": (-1, None, *NON_INTEGERS),
    "reset_opacity": (0, 1, *NON_FLOATS),
}
INVALID_LEARNING_RATES = (
    (0.0, 1e-3),
    (1e-3, 0.0),
    (-1e-3, 1e-3),
    (1e-3,),
    (1e-3, 1e-3, 1e-3),
    1e-3,
    None,
    (1e-3, math.nan),
)


@pytest.mark.parametrize(
    ("kind", "wrong"),
    [(TrainConfig, INVALID_SETTINGS), (DensityConfig, INVALID_DENSITY_SETTINGS)],
    ids=["TrainConfig", "DensityConfig"],
)
def test_each_setting_out_of_range_or_of_another_type_is_a_clear_error_that_names_it(kind, wrong):
    assert set(wrong) == {field.name for field in dataclasses.fields(kind)}
    for name, values in wrong.items():
        for value in values:
            with pytest.raises(ValueError, match=rf"^[^\n]*\b{name} is [^\n]*; it must be [^\n]*$"):
                kind(**{name: value})


@pytest.mark.parametrize("group", [field.name for field in dataclasses.fields(LearningRates)])
@pytest.mark.parametrize("rates", INVALID_LEARNING_RATES, ids=str)
def test_learning_rates_are_two_positive_numbers(group, rates):
    with pytest.raises(ValueError, match=f"{group} is "):
        LearningRates(**{group: rates})


def test_the_limits_of_each_range_are_valid():
    for taken in ({"seed": LARGEST_SEED}, {"log2_table_size": 4}, {"log2_table_size": 24}, {"ssim_weight": 1}):
        json.dumps(TrainConfig(**taken).to_dict(), allow_nan=False)
    DensityConfig(start=1, stop=0, gradient=0, split_scale=0, prune_opacity=0, resets=0, rounds=1)


@pytest.mark.integration
@pytest.mark.parametrize("seed", [2**32, 18_446_744_073_710, 2**63, LARGEST_SEED])
def test_training_with_any_seed_of_64_bits_splits_gaussians_and_ends(seed):
    """Splitting draws from a generator of the seed and the step."""
    density = DensityConfig(start=0.2, stop=1.0, rounds=2, gradient=0.0, split_scale=0.0)
    trainer = Trainer(ball_scene(views=2, side=24), TrainConfig(steps=4, seed=seed, max_gaussians=200, density=density))
    before = len(trainer.model)

    assert trainer.run() and len(trainer.model) > before
    assert all(torch.isfinite(values).all() for values in trainer.model.parameters())


@pytest.mark.parametrize("config", [DensityConfig(), DensityConfig(start=0.1, stop=0.9, peak=0.9, excess=1.0)])
def test_the_mean_count_agrees_with_the_targets_of_the_rounds(config):
    control = DensityControl(dataclasses.replace(config, rounds=10_000), 10_000, 500, 100, 0)
    steps = range(1, 10_001)
    counts = [100 if step < control.first else control.target(min(step, control.last)) for step in steps]
    assert config.mean_count(100, 500) == pytest.approx(np.mean(counts), rel=2e-3)


@pytest.mark.parametrize(
    ("sizes", "named"),
    [
        ({"max_gaussians": 100, "target_bytes": 20_000}, "a number of Gaussians and a target size"),
        ({"max_gaussians": 100, "budget_factor": 0.5}, "a number of Gaussians and a factor"),
        ({"target_bytes": 20_000, "budget_factor": 0.5}, "a target size and a factor"),
    ],
)
def test_two_settings_of_the_model_size_are_rejected(sizes, named):
    with pytest.raises(ValueError, match=f"{named} each decide .* give one"):
        TrainConfig(**sizes)

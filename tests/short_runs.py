"""Short runs of a trainer on a small scene, and what tests compare of them."""

from __future__ import annotations

import numpy as np
import torch
from scenes import ball_scene

from hyrfpack.render import RenderSettings, render_view
from hyrfpack.scene import Scene
from hyrfpack.train import DensityConfig, TrainConfig, Trainer
from hyrfpack.train.resolution import MIN_BACKGROUND_STRIDE

# Density control acts after steps 2, 7, 12, 17, 22 and 27, with resets after 12 and 22, all within a short run.
EARLY_DENSITY_CONFIG = DensityConfig(start=0.05, stop=0.68, peak=0.68, excess=1.0, rounds=5, gradient=1e-5, resets=2)
TRAINING_SETTINGS = RenderSettings(background_stride=MIN_BACKGROUND_STRIDE)  # on small photos
SHORT_CONFIG = TrainConfig(steps=40, seed=3, max_gaussians=160, density=EARLY_DENSITY_CONFIG)


def make_scene(**options) -> Scene:
    return ball_scene(**{"views": 6, "points": 60, "side": 24, **options})


def train_trainer(config: TrainConfig = SHORT_CONFIG, **options) -> Trainer:
    trainer = Trainer(make_scene(**options), config)
    assert trainer.run()
    return trainer


def parameter_bytes(trainer: Trainer) -> dict[str, bytes]:
    return {name: p.detach().numpy().tobytes() for name, p in trainer.model.named_parameters()}


def records_without_times(records: list[dict]) -> list[dict]:
    return [{name: value for name, value in record.items() if name != "seconds"} for record in records]


def mean_training_psnr(trainer: Trainer) -> float:
    """Return the mean PSNR of fresh renders over the training views."""
    values = []
    for view in trainer.scene.train:
        with torch.no_grad():
            rgb = render_view(trainer.model, view.camera, TRAINING_SETTINGS).rgb.double().numpy()
        values.append(-10 * np.log10(np.mean((rgb - view.load().composite()) ** 2)))
    return float(np.mean(values))

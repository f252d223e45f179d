"""Loads and compiles what `rank_processes` needs, once, in the process from which it forks others."""

from __future__ import annotations

import torch
from scenes import ball_scene

import hyrfpack.compress
import hyrfpack.evaluate  # noqa: F401
from hyrfpack.train import TrainConfig, Trainer

torch.set_num_threads(1)
Trainer(ball_scene(2, 20, side=16), TrainConfig(steps=1)).run()  # compiles the kernels

"""Fit the Gaussians of a coarse level to renders of the finest level, at the resolution at which views show it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from hyrfpack.model import HybridModel
from hyrfpack.model.merged import MergedModel, parts_of
from hyrfpack.ops.adam import adam_step
from hyrfpack.progress import Progress, TaskEvent, ignore_progress
from hyrfpack.render import render_view
from hyrfpack.scene import Camera

# Learning rates at the start; they fall to zero along a cosine.
LEARNING_RATES = {"color_logits": 0.1, "opacity_logits": 0.1, "scale_logits": 0.04}
# The learning rate of positions, relative to N^(-1/3), about the mean distance of N Gaussians in local units.
RELATIVE_POSITION_LEARNING_RATE = 0.04


def refit_level(
    level: HybridModel | MergedModel,
    finest: HybridModel | MergedModel,
    cameras: Sequence[Camera],
    steps: int,
    seed: int = 0,
    progress: Progress = ignore_progress,
) -> None:
    """Fit the Gaussians of a level to renders of the finest level, in place; fields stay as they are.

    All parts of a merged model are fitted together.

    Args:
        level: the model of the level, which shares its fields with `finest`.
        finest: the finest level.
        cameras: views at the resolution at which the level is seen, world units.
        steps: optimiser steps, each on one view.
        seed: random seed of the order of the views.
        progress: called with `TaskEvent`s.
    """
    if not steps or not cameras:
        return
    with torch.no_grad():
        decoded = finest.decode()
        targets = [render_view(finest, camera, decoded=decoded).rgb for camera in cameras]
    values, rates = [], []
    for part in filter(len, parts_of(level)):
        for name, rate in {
            **LEARNING_RATES,
            "positions": RELATIVE_POSITION_LEARNING_RATE * len(part) ** (-1 / 3),
        }.items():
            values.append(getattr(part.gaussians, name).requires_grad_())
            rates.append(rate)
    moments = [[torch.zeros_like(value) for value in values] for _ in range(2)]
    generator = torch.Generator().manual_seed(seed)
    order: list[int] = []
    for step in range(steps):
        progress(TaskEvent(f"fitting a level, step {step + 1}/{steps}", step / steps))
        order = order or torch.randperm(len(cameras), generator=generator).tolist()
        number = order.pop()
        loss = (render_view(level, cameras[number]).rgb - targets[number]).square().mean()
        if not loss.requires_grad:  # no Gaussian is in view
            continue
        gradients = torch.autograd.grad(loss, values, materialize_grads=True)  # a part may be out of view
        decay = (1 + math.cos(math.pi * step / steps)) / 2
        adam_step(values, gradients, *moments, step=step + 1, rate=[decay * rate for rate in rates])
    for value in values:
        value.requires_grad_(False)

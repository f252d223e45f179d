"""Draw the same frame and take the same training step twice, and say which results have the same bits."""

from __future__ import annotations

import copy
from collections.abc import Iterator

import torch
from torch import Tensor

from hyrfpack.model import HybridModel
from hyrfpack.render import render_view
from hyrfpack.scene import Scene
from tools.gpu.rows import Row
from tools.gpu.scene import TRAINED_LOOK, make_cameras, make_model, make_scene, perturb
from tools.gpu.setup import Setup

TABLE_NAME = "The same twice"
# The gradient of a hash table is a sum of atomic additions, whose order is not fixed.
UNORDERED_WORD = "table"


def items(setup: Setup) -> list[str]:
    """Return what is repeated."""
    return ["frame", "step"]


def run(item: str, setup: Setup) -> Iterator[Row]:
    """Yield one row for a frame, or one for each parameter of the model after a step."""
    count, device = min(setup.trained_gaussians), setup.torch_device
    cameras = make_cameras(setup.views, setup.width, setup.height)
    truth = make_model(count, device, TRAINED_LOOK)
    if item == "frame":
        with torch.no_grad():
            first, second = (render_view(truth, cameras[1]).rgb for _ in range(2))
        yield compare("picture", first, second)
        return
    scene, model = make_scene(truth, cameras), perturb(truth)
    first, second = (_parameters_after_step(scene, copy.deepcopy(model), setup) for _ in range(2))
    for name, values in first.items():
        yield compare(name, values, second[name])


def compare(name: str, first: Tensor, second: Tensor) -> Row:
    """Return the row of one result; it has failed if bits differ where the order of all sums is fixed."""
    has_same_bits = torch.equal(first, second)
    difference = float((first - second).abs().max()) if first.numel() else 0.0
    row: Row = {"table": TABLE_NAME, "result": name, "same bits": "yes" if has_same_bits else "no"}
    row |= {"largest difference": difference}
    if not has_same_bits and UNORDERED_WORD not in name:
        row |= {"status": "failed", "note": "two equal calls differ, though no kernel of theirs adds in any order"}
    return row


def _parameters_after_step(scene: Scene, model: HybridModel, setup: Setup) -> dict[str, Tensor]:
    """Return the parameters after the first training step."""
    from hyrfpack.train import TrainConfig, Trainer
    from tools.gpu.training import advance

    config = TrainConfig(steps=1000, max_gaussians=len(model), resolution_schedule=False)
    trainer = Trainer(scene, config, device=setup.torch_device, model=model)
    advance(trainer, 1, setup.step_seconds, [])
    return {name: parameter.detach().clone() for name, parameter in trainer.model.named_parameters()}

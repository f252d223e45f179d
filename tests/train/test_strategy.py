"""The trainer with a strategy of density control that is not its own."""

from __future__ import annotations

import pytest
import torch
from scenes import ball_scene
from torch import Tensor

from hyrfpack.errors import HyrfTrainingError
from hyrfpack.model import HybridModel
from hyrfpack.model.gaussians import Gaussians
from hyrfpack.render import Rendering
from hyrfpack.scene import Camera
from hyrfpack.train import Strategy, TrainConfig, Trainer
from hyrfpack.train.optimizer import Optimizer

CONFIG = TrainConfig(steps=12, max_gaussians=100)


class LeastSeen:
    """Every fourth step, the Gaussian that the fewest pictures lean on goes: the sum of squared opacity gradients."""

    def __init__(self) -> None:
        self.sums = torch.zeros(0)
        self.steps: list[int] = []
        self.sizes: list[tuple[int, int]] = []

    def watching(self, step: int) -> bool:
        self.steps.append(step)
        return step % 2 == 0

    def observe(self, rendering: Rendering, camera: Camera, model: HybridModel) -> None:
        assert (rendering.absgrad is not None) == (self.steps[-1] % 2 == 0)
        self.sizes.append((camera.width, camera.height))
        gradient = model.gaussians.opacity_logits.grad
        assert gradient is not None
        if len(self.sums) != len(model):
            self.sums = torch.zeros(len(model))
        self.sums += gradient[:, 0].square()

    def act(self, step: int, model: HybridModel, optimizer: Optimizer) -> None:
        if step % 4 == 0:
            keep = torch.arange(len(model)) != self.sums.argmin()
            optimizer.replace_gaussians(
                keep.nonzero().squeeze(1),
                {name: getattr(model.gaussians, name)[:0] for name in Gaussians.PARAMETER_NAMES},
            )
            self.sums = self.sums[keep]

    def state_dict(self) -> dict[str, Tensor]:
        return {"sums": self.sums}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        self.sums = state["sums"]


def a_trainer(strategy: Strategy | None) -> Trainer:
    return Trainer(ball_scene(views=6, points=60, side=24), CONFIG, strategy=strategy)


def test_a_strategy_of_ones_own_decides_which_gaussians_there_are():
    strategy = LeastSeen()
    trainer = a_trainer(strategy)
    trainer.run()

    assert len(trainer.model) == 57
    assert strategy.steps == list(range(1, 13)) and strategy.sizes == [(24, 24)] * 12


def test_it_continues_from_a_checkpoint_with_what_it_had_collected(tmp_path):
    whole, first, then = a_trainer(LeastSeen()), a_trainer(LeastSeen()), a_trainer(LeastSeen())
    whole.run()
    first.run(checkpoint=tmp_path / "checkpoint", stop=lambda: first.step == 6)
    then.load(tmp_path / "checkpoint")
    then.run()

    assert len(then.model) == 57
    assert all(torch.equal(a, b) for a, b in zip(then.model.parameters(), whole.model.parameters(), strict=True))


def test_a_run_is_not_gone_on_with_by_another_strategy(tmp_path):
    trainer = a_trainer(LeastSeen())
    trainer.run(checkpoint=tmp_path / "checkpoint", stop=lambda: trainer.step == 2)
    with pytest.raises(HyrfTrainingError, match=r"other settings \(strategy\)"):
        a_trainer(None).load(tmp_path / "checkpoint")

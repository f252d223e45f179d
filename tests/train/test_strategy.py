"""The trainer with a custom strategy of density control."""

from __future__ import annotations

import pytest
import torch
from scenes import ball_scene
from torch import Tensor

from hyrfpack.errors import HyrfTrainingError
from hyrfpack.model import HybridModel
from hyrfpack.model.gaussians import Gaussians
from hyrfpack.parallel.ranks import Ranks
from hyrfpack.render import Rendering
from hyrfpack.scene import Camera
from hyrfpack.train import Strategy, TrainConfig, Trainer
from hyrfpack.train.optimizer import Optimizer

SHORT_CONFIG = TrainConfig(steps=12, max_gaussians=100)


class PruneLeastSeen:
    """Prunes, every fourth step, the Gaussian with the smallest sum of squared opacity gradients."""

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

    def acting(self, step: int) -> bool:
        return step % 4 == 0

    def act(self, step: int, model: HybridModel, optimizer: Optimizer) -> None:
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


def make_trainer(strategy: Strategy | None) -> Trainer:
    return Trainer(ball_scene(views=6, points=60, side=24), SHORT_CONFIG, strategy=strategy)


def test_a_custom_strategy_decides_which_gaussians_exist():
    strategy = PruneLeastSeen()
    trainer = make_trainer(strategy)
    trainer.run()

    assert len(trainer.model) == 57
    assert strategy.steps == list(range(1, 13)) and strategy.sizes == [(24, 24)] * 12


def test_a_custom_strategy_resumes_with_its_state(tmp_path):
    whole, first, then = make_trainer(PruneLeastSeen()), make_trainer(PruneLeastSeen()), make_trainer(PruneLeastSeen())
    whole.run()
    first.run(checkpoint=tmp_path / "checkpoint", stop=lambda: first.step == 6)
    then.load(tmp_path / "checkpoint")
    then.run()

    assert len(then.model) == 57
    assert all(torch.equal(a, b) for a, b in zip(then.model.parameters(), whole.model.parameters(), strict=True))


def test_a_run_does_not_resume_with_another_strategy(tmp_path):
    trainer = make_trainer(PruneLeastSeen())
    trainer.run(checkpoint=tmp_path / "checkpoint", stop=lambda: trainer.step == 2)
    with pytest.raises(HyrfTrainingError, match=r"other settings \(strategy\)"):
        make_trainer(None).load(tmp_path / "checkpoint")


class _BesideAnother(Ranks):
    """Process 1 of 2, which differs from process 0 and receives what that one holds."""

    def all_gather(self, item):
        return ["digest of process 0", item]

    def broadcast(self, item):
        return {name: self.main[name] for name in item} if set(item) <= set(self.main) else self.main


def test_a_process_whose_gaussians_differ_gets_those_of_process_0_and_sums_that_fit_them():
    main, other = make_trainer(None), make_trainer(None)
    keep = torch.arange(len(main.model))[:-7]
    nothing = {name: getattr(main.model.gaussians, name)[:0] for name in Gaussians.PARAMETER_NAMES}
    main.optimizer.replace_gaussians(keep, nothing)
    main.strategy.load_state_dict({name: value[keep] for name, value in main.strategy.state_dict().items()})
    ranks = _BesideAnother(rank=1, size=2, local_rank=1, local_size=2)
    object.__setattr__(ranks, "main", {**main._collect_tensors(), **main.strategy.state_dict()})
    other.ranks = ranks

    other._synchronize()

    assert all(torch.equal(a, b) for a, b in zip(other.model.parameters(), main.model.parameters(), strict=True))
    sums = other.strategy.state_dict()
    assert {name: len(value) for name, value in sums.items()} == dict.fromkeys(sums, len(keep))
    assert not any(value.any() for value in sums.values())
    other.ranks = main.ranks
    other.run()  # takes all steps with the sums

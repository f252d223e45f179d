"""What decides, while a model trains, how many Gaussians there are and where."""

from __future__ import annotations

from typing import Protocol

from torch import Tensor

from hyrfpack.model import HybridModel
from hyrfpack.render import Rendering
from hyrfpack.scene import Camera
from hyrfpack.train.optimizer import Optimizer


class Strategy(Protocol):
    """A strategy of density control: `Trainer(scene, config, strategy=...)` trains with one of your own.

    The trainer calls it in every step: `watching` before the view is rendered, `observe` when its gradients are there,
    `act` after the optimiser's step. What it draws at random it draws from the seed and the step, and what it collects
    is in its state, so that a run that goes on from a checkpoint ends like one that never stopped. Of several processes
    each has a strategy that observes its own views: what decides has to be summed first, as by `Ranks.add`, so that all
    decide alike.

    `hyrfpack.train.DensityControl` is the one that there is by default.

    Example:
        >>> class Faintest:  # leaves out whatever has become fainter than a hundredth, every hundred steps
        ...     def watching(self, step):
        ...         return False
        ...     def observe(self, rendering, camera, model):
        ...         pass
        ...     def act(self, step, model, optimizer):
        ...         if step % 100 == 0:
        ...             keep = (model.decode_geometry().opacities >= 0.01).nonzero().squeeze(1)
        ...             nothing = {name: getattr(model.gaussians, name)[:0] for name in model.gaussians.PARAMETER_NAMES}
        ...             optimizer.replace_gaussians(keep, nothing)
        ...     def state_dict(self):
        ...         return {}
        ...     def load_state_dict(self, state):
        ...         pass
        >>> trainer = Trainer(scene, TrainConfig(steps=2000), strategy=Faintest())
    """

    def watching(self, step: int) -> bool:
        """Whether absolute gradients of projected centres are wanted in this step, counted from 1."""

    def observe(self, rendering: Rendering, camera: Camera, model: HybridModel) -> None:
        """Look at one view after backward: what was rendered, and the gradients of the model's parameters."""

    def act(self, step: int, model: HybridModel, optimizer: Optimizer) -> None:
        """Change which Gaussians there are, through the optimiser, which keeps their moments with them."""

    def state_dict(self) -> dict[str, Tensor]:
        """All that was collected since the start and is still needed."""

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """The inverse of `state_dict`; the model has the Gaussians that it had then."""

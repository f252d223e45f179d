"""The interface of density control strategies, which add and remove Gaussians during training."""

from __future__ import annotations

from typing import Protocol

from torch import Tensor

from hyrfpack.model import HybridModel
from hyrfpack.render import Rendering
from hyrfpack.scene import Camera
from hyrfpack.train.optimizer import Optimizer


class Strategy(Protocol):
    """Interface of a density control strategy, for `Trainer(scene, config, strategy=...)`.

    In every step the trainer calls `watching` before it renders the view and `observe` after the backward pass. After
    the optimiser's step it calls `act` if `acting` returned True. A resumed run must give the same result as an
    uninterrupted one. So a strategy seeds random numbers by the run's seed and the step, and its state contains all its
    observations. On several processes each strategy observes its own views. It must sum its observations over the ranks
    (`Ranks.all_reduce`) before it decides, so that all take the same decisions.

    The default strategy is `hyrfpack.train.DensityControl`.

    Example:
        >>> class PruneFaint:  # every hundred steps, prunes Gaussians of less than 1 % opacity
        ...     def watching(self, step):
        ...         return False
        ...     def observe(self, rendering, camera, model):
        ...         pass
        ...     def acting(self, step):
        ...         return step % 100 == 0
        ...     def act(self, step, model, optimizer):
        ...         keep = (model.decode_geometry().opacities >= 0.01).nonzero().squeeze(1)
        ...         nothing = {name: getattr(model.gaussians, name)[:0] for name in model.gaussians.PARAMETER_NAMES}
        ...         optimizer.replace_gaussians(keep, nothing)
        ...     def state_dict(self):
        ...         return {}
        ...     def load_state_dict(self, state):
        ...         pass
        >>> trainer = Trainer(scene, TrainConfig(steps=2000), strategy=PruneFaint())
    """

    def watching(self, step: int) -> bool:
        """Return whether this step, counted from 1, needs absolute gradients of the projected centres."""

    def observe(self, rendering: Rendering, camera: Camera, model: HybridModel) -> None:
        """Observe the rendering of one view and the gradients of the model's parameters, after the backward pass.

        On a GPU the rendering may have `valid`, a flag on the device. If it is False, the step is taken again, so that
        what is observed now must be dropped, without reading the flag. The next step may write to the same memory, so a
        strategy copies what it keeps of the rendering and of gradients.
        """

    def acting(self, step: int) -> bool:
        """Return whether `act` is due after this step, counted from 1. On a GPU the host then waits for the step."""

    def act(self, step: int, model: HybridModel, optimizer: Optimizer) -> None:
        """Add and remove Gaussians after this step, counted from 1, by methods of the optimiser.

        The optimiser keeps the moments of the other Gaussians.
        """

    def state_dict(self) -> dict[str, Tensor]:
        """Return everything observed that later steps need."""

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore what `state_dict` returned for a model with the same Gaussians."""

"""Adam for a HybridModel to which density control adds and removes Gaussians."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from hyrfpack.config.train import LearningRates
from hyrfpack.model import HybridModel
from hyrfpack.model.gaussians import Gaussians
from hyrfpack.ops.adam import adam_step

MOMENT_NAMES = ("exp_avg", "exp_avg_sq")
ADAM_BETAS = 0.9, 0.999


@dataclass
class _State:
    """Adam's state of one parameter: running means of gradients and of squared gradients, and the steps taken."""

    exp_avg: Tensor
    exp_avg_sq: Tensor
    step: int = 0


class Optimizer:
    """Adam (betas 0.9, 0.999, eps 1e-15) with one group for each kind of Gaussian property and one for the fields.

    If a step uses the mean gradient of W views, each beta b becomes 1 - W (1 - b). The running means then cover as many
    views as with one view per step.

    Attributes:
        groups: the parameters of each group by its name, which is also the name of its learning rate.
    """

    def __init__(self, model: HybridModel, rates: LearningRates, views: int = 1, warmup_steps: int = 0) -> None:
        """Start without any state.

        Args:
            views: W, the number of views of each step.
            warmup_steps: number of first steps over which the learning rate of the fields rises linearly to the
                scheduled one; 0 for none.
        """
        self.model = model
        self.rates = rates
        self.views = views
        self.warmup_steps = warmup_steps
        first, second = (beta if views == 1 else max(0.0, 1 - views * (1 - beta)) for beta in ADAM_BETAS)
        self.betas = first, second
        self.groups: dict[str, list[nn.Parameter]] = {
            name: [getattr(model.gaussians, name)] for name in Gaussians.PARAMETER_NAMES
        }
        self.groups["fields"] = [*model.geometry.parameters(), *model.radiance.parameters()]
        self._states: dict[nn.Parameter, _State] = {}
        self._stepped: dict[nn.Parameter, str] = {}  # The group of each parameter that the last step updated.

    def step(self, step: int, steps: int, enabled: Tensor | None = None) -> Tensor:
        """Take one step with the learning rates of `step` (from 0) of `steps`, and clear the gradients.

        Args:
            enabled: bool scalar on the model's device; if it is False, no parameter changes. Then call `retract_step`.

        Returns:
            (tensors,) float32 flags on the model's device, to be passed to `names`: not 0 for each parameter that has
            a gradient that is not finite. Elements with such gradients stay as they are. The host does not wait for
            the device.
        """
        stepped = [(name, p) for name, group in self.groups.items() for p in group if p.grad is not None]
        self._stepped = {parameter: name for name, parameter in stepped}
        if not stepped:
            return self.model.gaussians.positions.new_zeros(0)
        for _, parameter in stepped:
            if parameter not in self._states:
                zeros = torch.zeros_like(parameter, memory_format=torch.contiguous_format)
                self._states[parameter] = _State(zeros, zeros.clone())
            self._states[parameter].step += 1
        states = [self._states[parameter] for _, parameter in stepped]
        rates = {name: self._rate(name, step, steps) for name in self.groups}
        broken = adam_step(
            [parameter.detach() for _, parameter in stepped],
            [parameter.grad for _, parameter in stepped if parameter.grad is not None],
            [state.exp_avg for state in states],
            [state.exp_avg_sq for state in states],
            step=[state.step for state in states],
            rate=[rates[name] for name, _ in stepped],
            betas=self.betas,
            enabled=enabled,
        )
        for _, parameter in stepped:
            parameter.grad = None
        return broken.float()

    def gradients(self) -> list[Tensor]:
        """Return the gradients of the parameters that have one, in the order of the flags that `step` returns."""
        return [parameter.grad for parameter in self.parameters() if parameter.grad is not None]

    def parameters(self) -> list[nn.Parameter]:
        """Return all parameters, in the order of the flags that `step` returns."""
        return [parameter for group in self.groups.values() for parameter in group]

    def retract_step(self) -> None:
        """Discount the last step, which was not enabled and is to be taken again."""
        for parameter in self._stepped:
            self._states[parameter].step -= 1

    def _rate(self, name: str, step: int, steps: int) -> float:
        """Return the learning rate of the group `name` at `step` (from 0) of `steps`."""
        rate = self.rates.at(name, step, steps, self.views)
        if name == "fields" and step < self.warmup_steps:
            rate *= (step + 1) / self.warmup_steps
        return rate

    def names(self, broken: Sequence[float]) -> list[str]:
        """Return the names of the groups that the last `step` flagged as broken."""
        return list(dict.fromkeys(name for name, flag in zip(self._stepped.values(), broken, strict=True) if flag))

    def replace_gaussians(self, keep: Tensor, new: dict[str, Tensor]) -> None:
        """Keep the rows at `keep` (int64), with their moments, and append new rows with moments of zero."""

        def edit(name: str, rows: Tensor) -> None:
            self._edit(
                name,
                lambda values: torch.cat((values[keep], rows)),
                lambda moment: torch.cat((moment[keep], torch.zeros_like(rows))),
            )

        for name in Gaussians.PARAMETER_NAMES:
            edit(name, new[name])

    def reorder_gaussians(self, order: Tensor) -> None:
        """Move the Gaussian at order[i] (int64), with its moments, to place i, for all i."""
        for name in Gaussians.PARAMETER_NAMES:
            self._edit(name, lambda values: values[order], lambda moment: moment[order])

    def reset(self, name: str, values: Tensor) -> None:
        """Set the Gaussian property `name` to `values`, and reset its moments to zero."""
        self._edit(name, lambda _: values, torch.zeros_like)

    def _edit(self, name: str, values: Callable[[Tensor], Tensor], moments: Callable[[Tensor], Tensor]) -> None:
        (old,) = self.groups[name]
        new = nn.Parameter(values(old.detach()).contiguous())
        self._stepped.pop(old, None)  # Otherwise its memory would be kept until the next step.
        state = self._states.pop(old, None)
        if state is not None:
            exp_avg, exp_avg_sq = (moments(getattr(state, moment)).contiguous() for moment in MOMENT_NAMES)
            self._states[new] = _State(exp_avg, exp_avg_sq, state.step)
        self.groups[name] = [new]
        setattr(self.model.gaussians, name, new)

    def state_dict(self) -> dict[str, Tensor]:
        """Return moments and step counts as tensors, by group and by place in the group."""
        return {
            f"{name}.{i}.{key}": torch.as_tensor(getattr(self._states[parameter], key))
            for name, parameters in self.groups.items()
            for i, parameter in enumerate(parameters)
            if parameter in self._states
            for key in (*MOMENT_NAMES, "step")
        }

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore what `state_dict` returned for parameters of the same shapes."""
        for name, parameters in self.groups.items():
            for i, parameter in enumerate(parameters):
                if (step := state.get(f"{name}.{i}.step")) is not None:
                    first, second = (
                        state[f"{name}.{i}.{moment}"].to(parameter.device).clone() for moment in MOMENT_NAMES
                    )
                    self._states[parameter] = _State(first, second, int(step))

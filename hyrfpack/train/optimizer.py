"""Adam over a HybridModel whose Gaussians come and go."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from hyrfpack.model import HybridModel
from hyrfpack.model.gaussians import Gaussians
from hyrfpack.train.config import LearningRates

MOMENTS = ("exp_avg", "exp_avg_sq")


class Optimizer:
    """Adam (betas 0.9, 0.999, eps 1e-15) with one parameter group for each kind of Gaussian property and one for
    the fields."""

    def __init__(self, model: HybridModel, rates: LearningRates) -> None:
        self.model = model
        self.rates = rates
        groups = [{"name": name, "params": [getattr(model.gaussians, name)]} for name in Gaussians.NAMES]
        groups.append({"name": "fields", "params": [*model.geometry.parameters(), *model.radiance.parameters()]})
        self.adam = torch.optim.Adam(groups, lr=0.0, eps=1e-15, fused=True)

    def step(self, step: int, steps: int) -> None:
        """Take one step with the learning rates due at `step` (from 0) of `steps`, and clear the gradients."""
        for group in self.adam.param_groups:
            group["lr"] = self.rates.at(group["name"], step, steps)
        self.adam.step()
        self.adam.zero_grad(set_to_none=True)

    def nonfinite_groups(self) -> list[str]:
        """Names of the groups that hold a gradient that is not finite."""
        return [
            group["name"]
            for group in self.adam.param_groups
            if any(p.grad is not None and not torch.isfinite(p.grad).all() for p in group["params"])
        ]

    def replace_gaussians(self, keep: Tensor, new: dict[str, Tensor]) -> None:
        """Keep the rows at `keep` (int64), with their moments, and append new rows with moments of zero."""

        for name in Gaussians.NAMES:
            rows = new[name]
            self._edit(
                name,
                lambda values, rows=rows: torch.cat((values[keep], rows)),
                lambda moment, rows=rows: torch.cat((moment[keep], torch.zeros_like(rows))),
            )

    def reset(self, name: str, values: Tensor) -> None:
        """Set one kind of Gaussian property and forget its moments."""
        self._edit(name, lambda _: values, torch.zeros_like)

    def _edit(self, name: str, values: Callable[[Tensor], Tensor], moments: Callable[[Tensor], Tensor]) -> None:
        group = next(group for group in self.adam.param_groups if group["name"] == name)
        old = group["params"][0]
        new = nn.Parameter(values(old.detach()).contiguous())
        state = self.adam.state.pop(old, None)
        if state:
            for moment in MOMENTS:
                state[moment] = moments(state[moment]).contiguous()
            self.adam.state[new] = state
        group["params"][0] = new
        setattr(self.model.gaussians, name, new)

    def state_dict(self) -> dict:
        """Moments and step counts, tensors only, by group and position."""
        return {
            f"{group['name']}.{i}.{key}": value
            for group in self.adam.param_groups
            for i, parameter in enumerate(group["params"])
            for key, value in self.adam.state.get(parameter, {}).items()
        }

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """The inverse of `state_dict`; the parameters must have the shapes they had then."""
        for group in self.adam.param_groups:
            for i, parameter in enumerate(group["params"]):
                entry = {key: state.get(f"{group['name']}.{i}.{key}") for key in (*MOMENTS, "step")}
                if entry["step"] is not None:
                    self.adam.state[parameter] = {key: value.clone() for key, value in entry.items()}

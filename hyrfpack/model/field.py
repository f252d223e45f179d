"""A neural field: a hash grid read by a small decoder."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from hyrfpack.model.hash_grid import HashGrid, HashGridConfig, uniform
from hyrfpack.ops.mlp import mlp


class Field(nn.Module):
    """Hash features, with extra inputs appended, through two hidden ReLU layers to raw outputs."""

    def __init__(
        self,
        grid: HashGridConfig,
        outputs: int,
        hidden: int,
        extra_inputs: int = 0,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        self.grid = HashGrid(grid, generator)
        widths = [self.grid.features + extra_inputs, hidden, hidden, outputs]
        self.weights = nn.ParameterList()
        self.biases = nn.ParameterList()
        for fan_in, fan_out in zip(widths, widths[1:], strict=False):
            bound = math.sqrt(6 / (fan_in + fan_out))  # Xavier uniform
            self.weights.append(nn.Parameter(uniform(fan_out, fan_in, bound=bound, generator=generator)))
            self.biases.append(nn.Parameter(torch.zeros(fan_out)))

    @property
    def silent(self) -> bool:
        """Whether it says 0 wherever it is asked, and learns nothing: then nobody needs to ask. On a GPU, False."""
        last = self.weights[-1], self.biases[-1]
        if last[0].is_cuda or torch.is_grad_enabled() and any(values.requires_grad for values in self.parameters()):
            return False
        return not any(bool(values.any()) for values in last)

    def forward(self, coords: Tensor, extra: Tensor | None = None, *, mixed: bool = False) -> Tensor:
        """Raw outputs (N, outputs) at coords (N, 3) in the unit cube, with extra inputs (N, E); `mixed` as in `mlp`."""
        return mlp(self.features(coords, extra), list(self.weights), list(self.biases), mixed=mixed)

    def features(self, coords: Tensor, extra: Tensor | None = None) -> Tensor:
        """What the decoder reads (N, 2 levels + E): hash features, then the extra inputs."""
        features = self.grid(coords)
        if extra is None:
            return features
        # Hash features are stored by columns; joining them that way saves a transposed copy in backward.
        return torch.cat((features.T, extra.T)).T

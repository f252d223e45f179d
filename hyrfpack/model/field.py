"""A neural field: a hash grid whose features a small decoder maps to outputs."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from hyrfpack.model.hash_grid import HashGrid, HashGridConfig, draw_uniform
from hyrfpack.ops.mlp import mlp


class Field(nn.Module):
    """A hash grid and a decoder of two hidden ReLU layers, which maps features and extra inputs to raw outputs."""

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
        widths = [self.grid.feature_count + extra_inputs, hidden, hidden, outputs]
        self.weights = nn.ParameterList()
        self.biases = nn.ParameterList()
        for fan_in, fan_out in zip(widths, widths[1:], strict=False):
            bound = math.sqrt(6 / (fan_in + fan_out))  # Xavier uniform
            self.weights.append(nn.Parameter(draw_uniform(fan_out, fan_in, bound=bound, generator=generator)))
            self.biases.append(nn.Parameter(torch.zeros(fan_out)))

    @property
    def is_constant_zero(self) -> bool:
        """Return whether all outputs are 0 and no gradients are recorded, so that the field need not be evaluated.

        On a GPU it is always False, because the check would wait for the device.
        """
        last = self.weights[-1], self.biases[-1]
        if last[0].is_cuda or torch.is_grad_enabled() and any(values.requires_grad for values in self.parameters()):
            return False
        return not any(bool(values.any()) for values in last)

    def forward(
        self, coords: Tensor, extra: Tensor | None = None, *, mixed: bool = False, used: Tensor | None = None
    ) -> Tensor:
        """Compute raw outputs (N, outputs) at coords (N, 3) in the unit cube.

        Args:
            coords: (N, 3) points in the unit cube.
            extra: (N, E) extra inputs of the decoder.
            mixed: whether to multiply in mixed precision, see `mlp`.
            used: the number of points in use, see `hyrfpack.ops.rows`; None if all are.
        """
        features = self.features(coords, extra, used)
        return mlp(features, list(self.weights), list(self.biases), mixed=mixed, used=used)

    def features(self, coords: Tensor, extra: Tensor | None = None, used: Tensor | None = None) -> Tensor:
        """Return the inputs (N, 2 levels + E) of the decoder: hash features, then the extra inputs."""
        features = self.grid(coords, used)
        if extra is None:
            return features
        # Hash features are stored column by column; joining them in this layout saves a transposed copy in backward.
        return torch.cat((features.T, extra.T)).T

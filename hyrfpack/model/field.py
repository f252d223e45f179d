"""A neural field: a hash grid read by a small decoder."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from hyrfpack.model.hash_grid import HashGrid, HashGridConfig
from hyrfpack.ops.mlp import mlp

FREQUENCY_OCTAVES = 4
DIRECTION_FEATURES = {"sh": 9, "frequency": 6 * FREQUENCY_OCTAVES}


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
            self.weights.append(nn.Parameter((torch.rand(fan_out, fan_in, generator=generator) * 2 - 1) * bound))
            self.biases.append(nn.Parameter(torch.zeros(fan_out)))

    def forward(self, coords: Tensor, extra: Tensor | None = None) -> Tensor:
        """Raw outputs (N, outputs) at coords (N, 3) in the unit cube, with extra inputs (N, E)."""
        return mlp(self.features(coords, extra), list(self.weights), list(self.biases))

    def features(self, coords: Tensor, extra: Tensor | None = None) -> Tensor:
        """What the decoder reads (N, 2 levels + E): hash features, then the extra inputs."""
        features = self.grid(coords)
        if extra is None:
            return features
        # Hash features are stored by columns; joining them that way saves a transposed copy in backward.
        return torch.cat((features.T, extra.T)).T


def spherical_harmonics(directions: Tensor) -> Tensor:
    """Real spherical harmonics of bands 0 to 2, orthonormal on the unit sphere.

    Args:
        directions: (N, 3) unit vectors.

    Returns:
        (N, 9): Y00; Y1-1, Y10, Y11; Y2-2 ... Y22, without the Condon-Shortley phase.
    """
    x, y, z = directions.unbind(-1)
    return torch.stack(
        (
            torch.full_like(x, 0.28209479177387814),
            0.4886025119029199 * y,
            0.4886025119029199 * z,
            0.4886025119029199 * x,
            1.0925484305920792 * x * y,
            1.0925484305920792 * y * z,
            0.31539156525252005 * (3 * z * z - 1),
            1.0925484305920792 * x * z,
            0.5462742152960396 * (x * x - y * y),
        ),
        dim=-1,
    )


def frequency_encoding(directions: Tensor) -> Tensor:
    """NeRF's positional encoding (Mildenhall et al. 2020, eq. 4) of directions (N, 3): (N, 24), octaves 0 to 3."""
    octaves = math.pi * 2 ** torch.arange(FREQUENCY_OCTAVES, dtype=directions.dtype, device=directions.device)
    phases = (directions[:, None, :] * octaves[:, None]).flatten(1)
    return torch.cat((phases.sin(), phases.cos()), dim=-1)


def encode_directions(directions: Tensor, encoding: str) -> Tensor:
    """Unit vectors (N, 3) to the decoder's direction inputs; `encoding` is "sh" or "frequency"."""
    return spherical_harmonics(directions) if encoding == "sh" else frequency_encoding(directions)

"""What a decoder sees of a viewing direction."""

from __future__ import annotations

import math

import torch
from torch import Tensor

FREQUENCY_OCTAVES = 4
DIRECTION_FEATURES = {"sh": 9, "frequency": 6 * FREQUENCY_OCTAVES}


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
    """Unit vectors (N, 3) to the decoder's direction inputs; `encoding` is "sh" or "frequency".

    Example:
        >>> encode_directions(torch.tensor([[0.0, 0.0, 1.0]]), "sh").shape
        torch.Size([1, 9])
    """
    return spherical_harmonics(directions) if encoding == "sh" else frequency_encoding(directions)

"""Real spherical harmonics with the Condon-Shortley phase, bands 0 to 3, as files of 3D Gaussians hold colours."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from hyrfpack.ops.shade.directions import spherical_harmonics

MAX_DEGREE = 3
BAND_0 = 0.28209479177387814  # Y00 = 1 / (2 sqrt(pi))


def terms_of(degree: int) -> int:
    """How many basis functions the bands 0 to `degree` have: (degree + 1)^2."""
    return (degree + 1) ** 2


def harmonics_basis(directions: Tensor, degree: int = MAX_DEGREE) -> Tensor:
    """The basis at directions, orthonormal on the unit sphere.

    Within a band l the order is m = -l ... l. With the Condon-Shortley phase Y1-1, Y10, Y11 are proportional to
    -y, z, -x.

    Args:
        directions: (N, 3) unit vectors.
        degree: highest band, 0 to 3.

    Returns:
        (N, (degree + 1)^2).
    """
    x, y, z = directions.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    phase = directions.new_tensor((1, -1, 1, -1, 1, -1, 1, -1, 1))
    lower = spherical_harmonics(directions) * phase
    if degree < MAX_DEGREE:
        return lower[:, : terms_of(degree)]
    third = (
        -0.5900435899266435 * y * (3 * xx - yy),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (5 * zz - 1),
        0.3731763325901154 * z * (5 * zz - 3),
        -0.4570457994644658 * x * (5 * zz - 1),
        1.445305721320277 * z * (xx - yy),
        -0.5900435899266435 * x * (xx - 3 * yy),
    )
    return torch.cat((lower, torch.stack(third, -1)), -1)


def harmonics_rotation(rotation: np.ndarray, degree: int) -> np.ndarray:
    """What a rotation of space does to coefficients: M with M k the coefficients of d -> f(R^T d), f those of k.

    Harmonics of one band turn into one another, so M solves B(R^T d) = B(d) M at enough directions d, exactly.

    Args:
        rotation: (3, 3) proper rotation R.
        degree: highest band, 0 to 3.

    Returns:
        (K, K) float64, K = (degree + 1)^2; orthogonal, block-diagonal by bands.
    """
    directions = fibonacci_sphere(64).numpy()  # well-conditioned for 16 unknowns
    turned = directions @ np.asarray(rotation, np.float64)  # rows R^T d
    before, after = (harmonics_basis(torch.from_numpy(rows), degree).numpy() for rows in (turned, directions))
    blocks = np.zeros((terms_of(degree), terms_of(degree)))
    for band in range(degree + 1):
        own = slice(band**2, terms_of(band))
        blocks[own, own] = np.linalg.lstsq(after[:, own], before[:, own], rcond=None)[0]
    return blocks


def fibonacci_sphere(count: int) -> Tensor:
    """(count, 3) float64 unit vectors spread evenly over the sphere: points of a Fibonacci lattice."""
    numbers = torch.arange(count, dtype=torch.float64)
    heights, angles = 1 - (2 * numbers + 1) / count, torch.pi * (1 + 5**0.5) * numbers
    radii = (1 - heights.square()).sqrt()
    return torch.stack((radii * angles.cos(), radii * angles.sin(), heights), -1)

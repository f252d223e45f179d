"""Real spherical harmonics of bands 0 to 3 with the Condon-Shortley phase, as used in files of 3D Gaussians."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from hyrfpack.ops.shade.directions import spherical_harmonics

MAX_DEGREE = 3
SH_C0 = 0.28209479177387814  # Y00 = 1 / (2 sqrt(pi))


def num_sh_bases(degree: int) -> int:
    """Return the number of basis functions of bands 0 to `degree`: (degree + 1)^2."""
    return (degree + 1) ** 2


def harmonics_basis(directions: Tensor, degree: int = MAX_DEGREE) -> Tensor:
    """Evaluate the spherical harmonics, which are orthonormal on the unit sphere, at directions.

    Within a band l the order is m = -l ... l. With the Condon-Shortley phase Y1-1, Y10, Y11 are proportional to
    -y, z, -x.

    Args:
        directions: (N, 3) unit vectors.
        degree: highest band, 0 to 3.

    Returns:
        (N, (degree + 1)^2) values of the basis functions.
    """
    x, y, z = directions.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    phase = directions.new_tensor((1, -1, 1, -1, 1, -1, 1, -1, 1))
    lower = spherical_harmonics(directions) * phase
    if degree < MAX_DEGREE:
        return lower[:, : num_sh_bases(degree)]
    band_3 = (
        -0.5900435899266435 * y * (3 * xx - yy),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (5 * zz - 1),
        0.3731763325901154 * z * (5 * zz - 3),
        -0.4570457994644658 * x * (5 * zz - 1),
        1.445305721320277 * z * (xx - yy),
        -0.5900435899266435 * x * (xx - 3 * yy),
    )
    return torch.cat((lower, torch.stack(band_3, -1)), -1)


def harmonics_rotation(rotation: np.ndarray, degree: int) -> np.ndarray:
    """Compute the matrix that rotates coefficients of spherical harmonics.

    If k are the coefficients of a function f, then M k are those of the rotated function d -> f(R^T d). A rotation maps
    each band to itself, so M solves B(R^T d) = B(d) M exactly, with the basis B at enough directions d.

    Args:
        rotation: (3, 3) proper rotation R.
        degree: highest band, 0 to 3.

    Returns:
        (K, K) float64 matrix M, K = (degree + 1)^2; orthogonal and block-diagonal by bands.
    """
    directions = fibonacci_sphere(64).numpy()  # enough to be well-conditioned for 16 unknowns
    turned = directions @ np.asarray(rotation, np.float64)  # rows R^T d
    before, after = (harmonics_basis(torch.from_numpy(rows), degree).numpy() for rows in (turned, directions))
    blocks = np.zeros((num_sh_bases(degree), num_sh_bases(degree)))
    for band in range(degree + 1):
        in_band = slice(band**2, num_sh_bases(band))
        blocks[in_band, in_band] = np.linalg.lstsq(after[:, in_band], before[:, in_band], rcond=None)[0]
    return blocks


def fibonacci_sphere(count: int) -> Tensor:
    """Return (count, 3) float64 unit vectors that a Fibonacci lattice spreads evenly over the sphere."""
    numbers = torch.arange(count, dtype=torch.float64)
    heights, angles = 1 - (2 * numbers + 1) / count, torch.pi * (1 + 5**0.5) * numbers
    radii = (1 - heights.square()).sqrt()
    return torch.stack((radii * angles.cos(), radii * angles.sin(), heights), -1)

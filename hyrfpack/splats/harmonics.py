"""Rotation of spherical harmonics, and directions that sample them."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from hyrfpack.ops.harmonics import harmonics_basis, num_sh_bases

SH_C0 = 0.28209479177387814  # Y00 = 1 / (2 sqrt(pi))


def compute_harmonics_rotation(rotation: np.ndarray, degree: int) -> np.ndarray:
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
    rotated_basis, basis = (harmonics_basis(torch.from_numpy(rows), degree).numpy() for rows in (turned, directions))
    blocks = np.zeros((num_sh_bases(degree), num_sh_bases(degree)))
    for band in range(degree + 1):
        in_band = slice(band**2, num_sh_bases(band))
        blocks[in_band, in_band] = np.linalg.lstsq(basis[:, in_band], rotated_basis[:, in_band], rcond=None)[0]
    return blocks


def fibonacci_sphere(count: int) -> Tensor:
    """Return (count, 3) float64 unit vectors that a Fibonacci lattice spreads evenly over the sphere."""
    numbers = torch.arange(count, dtype=torch.float64)
    heights, angles = 1 - (2 * numbers + 1) / count, torch.pi * (1 + 5**0.5) * numbers
    radii = (1 - heights.square()).sqrt()
    return torch.stack((radii * angles.cos(), radii * angles.sin(), heights), -1)

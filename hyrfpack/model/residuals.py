"""Residuals: explicit corrections of the shapes and colours that the fields give Gaussians.

The fields reproduce the shapes and the view-dependent colours of imported Gaussians only roughly. A residual corrects
the difference for a single Gaussian. A Gaussian without residuals has zeros.
"""

from __future__ import annotations

import torch
from torch import Tensor

from hyrfpack.ops.harmonics import harmonics_basis, num_sh_bases

SHAPE_RESIDUALS = 5  # two of scale logits and three of the rotation


def count_color_residuals(degree: int) -> int:
    """Return the number of colour residuals of a Gaussian: three for each harmonic of bands 0 to `degree`."""
    return 3 * num_sh_bases(degree)


def add_shape_residuals(raw: Tensor, residuals: Tensor) -> Tensor:
    """Correct the outputs of the geometry field by the shape residuals (a, b, x, y, z) of each Gaussian.

        s' = s_n + (a, b, -a - b)            r' + (1, 0, 0, 0) = (r_n + (1, 0, 0, 0)) (1, x, y, z)

    The second product is that of quaternions, so (1, x, y, z) turns the Gaussian about its own axes. The explicit scale
    logit moves all three scales together, hence two numbers are enough for the scales.

    Args:
        raw: (N, 8) outputs of the geometry field: a_n, s_n (3), r_n (4).
        residuals: (N, 5).

    Returns:
        (N, 8) corrected outputs. Differentiable in both arguments.

    Example:
        >>> add_shape_residuals(torch.zeros(1, 8), torch.tensor([[1.0, 2.0, 0.1, 0.2, 0.3]]))
        tensor([[ 0.0000,  1.0000,  2.0000, -3.0000,  0.0000,  0.1000,  0.2000,  0.3000]])
    """
    a, b, x, y, z = residuals.unbind(1)
    opacity, s0, s1, s2, w, i, j, k = raw.unbind(1)
    w = w + 1
    turned = (-i * x - j * y - k * z, w * x + j * z - k * y, w * y + k * x - i * z, w * z + i * y - j * x)
    rotation = (value + change for value, change in zip((w - 1, i, j, k), turned, strict=True))
    return torch.stack((opacity, s0 + a, s1 + b, s2 - a - b, *rotation), 1)


def add_color_residuals(colors: Tensor, residuals: Tensor, directions: Tensor) -> Tensor:
    """Correct the colours that Gaussians have along directions d by their colour residuals h.

        colour' = max(0, colour + sum over k of h_k Y_k(d))

    Args:
        colors: (N, 3) colours of the model without residuals.
        residuals, directions: as in `color_differences`.

    Returns:
        (N, 3), 0 or more.
    """
    return (colors + color_differences(residuals, directions)).clamp_min(0)


def color_differences(residuals: Tensor, directions: Tensor) -> Tensor:
    """Return what colour residuals add to the colours (N, 3) of Gaussians along directions.

    Args:
        residuals: (N, 3 K) coefficients of K harmonics Y_k, see `harmonics_basis`; red, green and blue of the first
            harmonic first.
        directions: (N, 3), or (1, 3) for all, unit vectors from the viewpoint to the Gaussians.
    """
    parts = residuals.view(len(residuals), residuals.shape[1] // 3, 3)
    basis = harmonics_basis(directions, round(parts.shape[1] ** 0.5) - 1)
    return (basis[:, :, None] * parts).sum(1)

"""Real spherical harmonics of bands 0 to 3 with the Condon-Shortley phase, as used in files of 3D Gaussians."""

from __future__ import annotations

import torch
from torch import Tensor

from hyrfpack.ops.shade.directions import spherical_harmonics

MAX_DEGREE = 3


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

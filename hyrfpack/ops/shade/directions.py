"""Encodes viewing directions as inputs of the colour decoder."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from hyrfpack.ops.dispatch import choose_implementation

FREQUENCY_OCTAVES = 4
# Number of features per direction, by encoding.
DIRECTION_FEATURES = {"sh": 9, "frequency": 6 * FREQUENCY_OCTAVES}


def spherical_harmonics(directions: Tensor) -> Tensor:
    """Evaluate the real spherical harmonics of bands 0 to 2, orthonormal on the unit sphere.

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
    """Return NeRF's positional encoding (N, 24) of directions (N, 3), octaves 0-3 (Mildenhall et al. 2020, eq. 4)."""
    octaves = math.pi * 2 ** torch.arange(FREQUENCY_OCTAVES, dtype=directions.dtype, device=directions.device)
    phases = (directions[:, None, :] * octaves[:, None]).flatten(1)
    return torch.cat((phases.sin(), phases.cos()), dim=-1)


def encode_directions(directions: Tensor, encoding: str) -> Tensor:
    """Encode unit vectors (N, 3) as the decoder's direction inputs (N, E); `encoding` is "sh" or "frequency".

    Example:
        >>> encode_directions(torch.tensor([[0.0, 0.0, 1.0]]), "sh").shape
        torch.Size([1, 9])
    """
    return spherical_harmonics(directions) if encoding == "sh" else frequency_encoding(directions)


def encode_views(
    points: Tensor, viewpoint: Tensor, encoding: str, *, used: Tensor | None = None, implementation: str = "auto"
) -> Tensor:
    """Encode the viewing directions of points: e(d) with d = (p - o) / |p - o|.

    Args:
        points: (N, 3) p.
        viewpoint: (3,) o, in the same units, or (N, 3), one for each point.
        encoding: "sh" or "frequency", see `encode_directions`.
        used: the number of points in use, see `hyrfpack.ops.rows`; None if all are.
        implementation: "auto", "reference", "cpu" or "gpu" (both float32, one viewpoint). "cpu" and "gpu" have no
            backward pass and are available only if no gradient is needed.

    Returns:
        (N, E), see `DIRECTION_FEATURES`. For a point at the viewpoint itself, d = (0, 0, 0).

    Raises:
        ValueError: shapes, dtypes or devices do not match, or the encoding is unknown.

    Example:
        >>> encode_views(torch.tensor([[0.0, 0.0, 5.0]]), torch.zeros(3), "sh").shape
        torch.Size([1, 9])
    """
    is_single_viewpoint = viewpoint.shape == (3,)
    if (
        points.shape[1:] != (3,)
        or not (is_single_viewpoint or viewpoint.shape == points.shape)
        or encoding not in DIRECTION_FEATURES
    ):
        raise ValueError(f"points {tuple(points.shape)} from {tuple(viewpoint.shape)}, encoding '{encoding}'")
    needs_grad = torch.is_grad_enabled() and (points.requires_grad or viewpoint.requires_grad)
    available = ("reference", "cpu", "gpu") if is_single_viewpoint and not needs_grad else ("reference",)
    chosen = choose_implementation("encode_views", implementation, available, points, viewpoint)
    if chosen == "cpu":
        from hyrfpack.ops.shade import cpu_directions

        return cpu_directions.encode_views(points, viewpoint, encoding)
    if chosen == "gpu":
        from hyrfpack.ops.shade import gpu_directions

        return gpu_directions.encode_views(points, viewpoint, encoding, DIRECTION_FEATURES[encoding], used)
    return encode_directions(torch.nn.functional.normalize(points - viewpoint, dim=-1, eps=1e-12), encoding)

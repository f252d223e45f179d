"""Computes the shape residuals that give Gaussians their shapes: the inverse of `add_shape_residuals`."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor

from hyrfpack.ops.rasterize.reference import quats_to_rotations


def compute_shape_residuals(raw: Tensor, scale_logits: Tensor, quats: Tensor) -> tuple[Tensor, Tensor]:
    """Return the shape residuals (N, 5) and explicit scale logits (N, 1) that give Gaussians their shapes.

    A Gaussian stays the same if its axes are exchanged or reversed, which 24 rotations do. Of these, the result is the
    one nearest to the rotation that the field predicts.

    Args:
        raw: (N, 8) outputs of the geometry field.
        scale_logits: (N, 3) total logits of the scales.
        quats: (N, 4) rotations wxyz, of any length above 0.
    """
    exchanges = _axis_exchanges().to(raw)
    identity = torch.eye(1, 4, device=raw.device)
    predicted = torch.nn.functional.normalize(raw[:, 4:] + identity, dim=1)
    difference = _multiply(_conjugate(predicted), torch.nn.functional.normalize(quats, dim=1))
    # The w of the product of two quaternions is the dot product with the conjugate.
    nearest = (difference @ _conjugate(exchanges).T).abs().argmax(dim=1)
    turned = _multiply(difference, exchanges[nearest])
    cosine = turned[:, :1]
    rotation = turned[:, 1:] / torch.where(cosine == 0, 1, cosine)  # it is 0 only if the field predicts no rotation
    order = quats_to_rotations(exchanges).abs().argmax(dim=1)[nearest]  # the old axis along each new one
    logits = scale_logits.gather(1, order) - raw[:, 1:4]
    mean = logits.mean(dim=1, keepdim=True)
    return torch.cat(((logits - mean)[:, :2], rotation), dim=1), mean


def _conjugate(quats: Tensor) -> Tensor:
    return quats * quats.new_tensor((1, -1, -1, -1))


def _multiply(first: Tensor, second: Tensor) -> Tensor:
    """Return the Hamilton products (N, 4) of quaternions (N, 4) wxyz."""
    w, x, y, z = first.unbind(1)
    s, i, j, k = second.unbind(1)
    products = (
        w * s - x * i - y * j - z * k,
        w * i + x * s + y * k - z * j,
        w * j - x * k + y * s + z * i,
        w * k + x * j - y * i + z * s,
    )
    return torch.stack(products, dim=1)


def _axis_exchanges() -> Tensor:
    """Return the 24 rotations (24, 4) wxyz that map the axes onto each other."""
    quats: list[tuple[int, ...]] = [(1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)]
    quats += list(itertools.product((1,), (1, -1), (1, -1), (1, -1)))
    for first, second in itertools.combinations(range(4), 2):
        for sign in (1, -1):
            quat = [0, 0, 0, 0]
            quat[first], quat[second] = 1, sign
            quats.append(tuple(quat))
    return torch.nn.functional.normalize(torch.tensor(quats, dtype=torch.float64), dim=1)

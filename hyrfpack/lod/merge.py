"""Merge clusters of Gaussians so that they keep their mean, covariance, colour and covered area."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from hyrfpack.lod.partition import cluster
from hyrfpack.model import Geometry, HybridModel
from hyrfpack.model.gaussians import LOGIT_LIMIT, Gaussians, logit
from hyrfpack.model.residuals import add_shape_residuals, color_differences
from hyrfpack.model.shape_residuals import compute_shape_residuals
from hyrfpack.ops.rasterize.reference import ALPHA_MAX
from hyrfpack.rotations import rotation_matrices

_BISECTIONS = 40


@dataclass(frozen=True)
class Moments:
    """Gaussians, described by their moments.

    Attributes:
        means: (N, 3) float64.
        covariances: (N, 3, 3) float64.
        opacities: (N,) float64.
        colors: (N, C) float64, any numbers that are averaged by light.
    """

    means: np.ndarray
    covariances: np.ndarray
    opacities: np.ndarray
    colors: np.ndarray

    @property
    def areas(self) -> np.ndarray:
        """Geometric means of the projected areas along the axes, up to a constant: det(covariance)^(1/3)."""
        return np.cbrt(np.maximum(np.linalg.det(self.covariances), 1e-60))


def merge_moments(gaussians: Moments, labels: np.ndarray, count: int) -> Moments:
    """Merge the Gaussians of each cluster into one.

    With the weights m_i = opacity_i area_i, the merged Gaussian has the mean and the covariance of the mixture,

        mean = sum m_i p_i / sum m_i      covariance = sum m_i (C_i + (p_i - mean) (p_i - mean)^T) / sum m_i,

    the mean colour, and the opacity sum m_i / area, at most ALPHA_MAX, so that it covers the same area as its
    cluster. If all opacities of a cluster are 0, its Gaussians have equal weights.

    Args:
        gaussians: N Gaussians.
        labels: (N,) cluster of each, 0 to count - 1; no cluster is empty.
        count: number of clusters.
    """
    light = gaussians.opacities * gaussians.areas
    total = np.bincount(labels, light, count)
    weights = np.where(total[labels] > 0, light, 1.0)
    weight_sums = np.bincount(labels, weights, count)

    def average(values: np.ndarray) -> np.ndarray:
        flat = (weights[:, None] * values.reshape(len(values), -1)).T
        sums = np.stack([np.bincount(labels, column, count) for column in flat], axis=1)
        return (sums / weight_sums[:, None]).reshape(count, *values.shape[1:])

    means = average(gaussians.means)
    offsets = gaussians.means - means[labels]
    covariances = average(gaussians.covariances + offsets[:, :, None] * offsets[:, None, :])
    merged = Moments(means, covariances, np.ones(count), average(gaussians.colors))
    return Moments(means, covariances, np.minimum(total / merged.areas, ALPHA_MAX), merged.colors)


@torch.no_grad()
def merge_gaussians(model: HybridModel, geometry: Geometry, viewpoints: Sequence[Tensor], count: int) -> Gaussians:
    """Merge the Gaussians of a model into `count` Gaussians, whose other values come from the model's fields.

    The fields give the shape and the rotation of a Gaussian at its position. So a merged Gaussian has the volume of the
    covariance of its cluster, but the fields' shape. In a model with residuals it has the whole covariance, and the
    mean colour residuals of its cluster.

    Args:
        model: the model, on the CPU.
        geometry: result of `model.decode_geometry()`.
        viewpoints: points (3,) in local units from which colours are matched.
        count: number of merged Gaussians, at most that of the model.
    """
    colors = torch.cat([model.decode_colors(viewpoint) for viewpoint in viewpoints], dim=1).double().numpy()
    positions, residuals = model.gaussians.positions, model.gaussians.color_residuals
    if residuals is not None:
        colors = np.concatenate((colors, residuals.double().numpy()), axis=1)
    cube = model.cube_coords(positions).double().numpy()
    labels = cluster(cube, count)
    rotations = rotation_matrices(torch.nn.functional.normalize(geometry.quats).double().numpy())
    axes = rotations * geometry.scales.double().numpy()[:, None, :]
    covariances = axes @ axes.transpose(0, 2, 1)
    opacities = geometry.opacities.double().numpy()
    merged = merge_moments(Moments(positions.double().numpy(), covariances, opacities, colors), labels, count)
    return fit_logits(model, merged, viewpoints)


@torch.no_grad()
def fit_logits(model: HybridModel, merged: Moments, viewpoints: Sequence[Tensor]) -> Gaussians:
    """Return Gaussians that have, with the fields of a model, the volumes and the colours of `merged`.

    Args:
        model: the model, on the CPU.
        merged: M Gaussians in local units; `colors` (M, 3 V) from each of V viewpoints, followed by the colour
            residuals (M, 3 K) of a model that has them.
        viewpoints: V points (3,) in local units.
    """
    count = len(merged.means)
    zeros = torch.zeros(count, 1)
    means = torch.from_numpy(merged.means).float()
    plain = model.with_gaussians(
        Gaussians(means, zeros.expand(-1, 3), zeros, zeros), replace(model.config, residual_degree=None)
    )
    raw = plain.geometry(plain.cube_coords(means))
    shapes = None
    if model.config.residual_degree is None:
        scale_logits = _match_volumes(plain, raw, merged)
    else:
        shapes, scale_logits = _match_shapes(plain, raw, merged)
        raw = add_shape_residuals(raw, shapes)
    scales = plain.activate(raw, means, scale_logits, zeros).scales.double()
    # Where the volume cannot be reached, the opacity makes up for the area.
    light = torch.from_numpy(merged.opacities * merged.areas)
    opacities = (light / scales.prod(dim=1) ** (2 / 3)).clamp(max=ALPHA_MAX)
    neural = logit(plain.activate(raw, means, scale_logits, zeros).opacities)
    opacity_logits = (logit(opacities) - neural)[:, None]
    seen, residuals = torch.from_numpy(merged.colors).tensor_split([3 * len(viewpoints)], dim=1)
    offsets = []
    for viewpoint, colors in zip(viewpoints, seen.split(3, dim=1), strict=True):
        if shapes is not None:
            colors = colors - color_differences(residuals, torch.nn.functional.normalize(means - viewpoint))
        offsets.append(logit(colors) - logit(plain.decode_colors(viewpoint)))
    return Gaussians(
        means,
        torch.stack(offsets).mean(dim=0),
        scale_logits,
        opacity_logits,
        shapes,
        None if shapes is None else residuals,
    )


def _match_volumes(plain: HybridModel, raw: Tensor, merged: Moments) -> Tensor:
    """Return the scale logits (M, 1) with which Gaussians of the fields' shapes have the volumes of `merged`."""
    means, zeros = plain.gaussians.positions, plain.gaussians.scale_logits
    target = torch.from_numpy(np.linalg.slogdet(merged.covariances)[1] / 2)
    low, high = torch.full_like(zeros, -LOGIT_LIMIT), torch.full_like(zeros, LOGIT_LIMIT)
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        scales = plain.activate(raw, means, middle, zeros).scales
        is_small = (scales.double().log().sum(dim=1) < target)[:, None]
        low, high = torch.where(is_small, middle, low), torch.where(is_small, high, middle)
    return high


def _match_shapes(plain: HybridModel, raw: Tensor, merged: Moments) -> tuple[Tensor, Tensor]:
    """Return the shape residuals (M, 5) and scale logits (M, 1) that give the covariances of `merged`."""
    variances, axes = np.linalg.eigh(merged.covariances)
    axes *= np.sign(np.linalg.det(axes))[:, None, None]
    quats = Rotation.from_matrix(axes).as_quat(scalar_first=True)
    sizes = torch.from_numpy(np.sqrt(np.maximum(variances, 0))) / plain.scale_bounds(plain.gaussians.positions)
    return compute_shape_residuals(raw, logit(sizes), torch.from_numpy(quats).float())

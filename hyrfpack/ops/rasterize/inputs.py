"""The inputs of the rasteriser: 3D Gaussians and settings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from torch import Tensor

TRANSMITTANCE_MIN = 1 / 512  # This is half a quantisation step of 8-bit images.
LOW_PASS_VARIANCE = 0.3  # in squared pixels, as in 3DGS
# The shape of each input tensor for one Gaussian.
INPUT_SHAPES = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "colors": (3,)}


class Gaussians3D(NamedTuple):
    """N activated 3D Gaussians without colours.

    Attributes:
        means: (N, 3) centres in world units.
        quats: (N, 4) wxyz of any length; they are normalised. Zero means no rotation.
        scales: (N, 3) standard deviations along the rotated axes, in world units, > 0.
        opacities: (N,) in [0, 1].
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor

    def select(self, index: Tensor) -> Gaussians3D:
        """Return the Gaussians at `index` (n,) int64."""
        return Gaussians3D(*(tensor[index] for tensor in self))


@dataclass(frozen=True)
class RasterSettings:
    """Settings of the rasteriser.

    Attributes:
        near: distance of the near plane in world units, >= 0. Gaussians with camera z <= near are skipped.
        antialiased: scale opacities by sqrt(det(Sigma) / det(Sigma + v I)), so that the low-pass filter adds no light;
            v is `low_pass_variance`.
        transmittance_min: transmittance at which a pixel is finished, in [0, 1); 0 blends all Gaussians.
        depth: also compute depth.
        cull_tolerance: how far outside the image the centre of a Gaussian may project, as a fraction of half the
            image's size. Only Gaussians whose colours are decoded while they are drawn are culled by it.
        low_pass_variance: variance in px^2 that is added to the diagonal of every 2D covariance, > 0.

    Raises:
        ValueError: a setting is out of range.
    """

    near: float = 0.01
    antialiased: bool = False
    transmittance_min: float = TRANSMITTANCE_MIN
    depth: bool = False
    cull_tolerance: float = 0.3
    low_pass_variance: float = LOW_PASS_VARIANCE

    def __post_init__(self) -> None:
        if not self.near >= 0:
            raise ValueError(f"near is {self.near}, expected a distance in front of the camera")
        if not 0 <= self.transmittance_min < 1:
            raise ValueError(f"transmittance_min is {self.transmittance_min}; it must lie in [0, 1)")
        if not self.cull_tolerance >= 0:
            raise ValueError(f"cull_tolerance is {self.cull_tolerance}, expected 0 or more")
        if not self.low_pass_variance > 0:
            raise ValueError(f"low_pass_variance is {self.low_pass_variance}, expected more than 0")


def check_shapes(gaussians: Gaussians3D, colors: Tensor | None = None) -> None:
    """Raise ValueError unless all tensors have the shapes of `INPUT_SHAPES` for the same number of Gaussians."""
    count = len(gaussians.means)
    inputs = gaussians if colors is None else (*gaussians, colors)
    for tensor, (name, shape) in zip(inputs, INPUT_SHAPES.items(), strict=False):
        if tensor.shape != (count, *shape):
            raise ValueError(f"{name} is {tuple(tensor.shape)}, expected {(count, *shape)}")

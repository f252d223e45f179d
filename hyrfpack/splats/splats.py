"""The class Splats, explicit 3D Gaussians as numpy arrays, and operations on it; independent of models."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hyrfpack.counts import format_count
from hyrfpack.ops.harmonics import MAX_DEGREE, num_sh_bases
from hyrfpack.rotations import multiply_quats, quaternion_from_matrix
from hyrfpack.splats.harmonics import SH_C0, compute_harmonics_rotation

_LOG = logging.getLogger(__name__)

# A colour of this coefficient saturates each pixel in which it weighs 0.004 % or more, so that larger ones hardly
# change a picture. Sensitivities of far larger ones overflow, and their residuals take too many steps for a file.
MAX_ABS_HARMONIC = 1e5


@dataclass(frozen=True)
class Splats:
    """Explicit 3D Gaussians (3D Gaussian Splatting, Kerbl et al. 2023) in world units, activated.

    A Gaussian seen along the unit vector d, from the camera to its centre, has the display-referred sRGB colour

        max(0, 0.5 + sum_k harmonics_k Y_k(d))

    with the basis Y of `hyrfpack.ops.harmonics`.

    Attributes:
        positions: (N, 3) float64 centres, world units.
        scales: (N, 3) float32 standard deviations along the rotated axes, world units, >= 0.
        quats: (N, 4) float32 rotations, wxyz, unit length.
        opacities: (N,) float32 in [0, 1].
        harmonics: (N, (degree + 1)^2, 3) float32 coefficients of RGB, degree 0 to 3.
        antialiased: whether opacities are meant to be compensated for the rasteriser's low-pass filter (Mip-Splatting).

    Raises:
        ValueError: shapes do not fit together, or a number is not finite or out of its range.
    """

    positions: np.ndarray
    scales: np.ndarray
    quats: np.ndarray
    opacities: np.ndarray
    harmonics: np.ndarray
    antialiased: bool = False

    def __post_init__(self) -> None:
        count = len(self.positions)
        shapes = {"positions": (count, 3), "scales": (count, 3), "quats": (count, 4), "opacities": (count,)}
        shapes["harmonics"] = (count, num_sh_bases(self.degree), 3)
        for name, shape in shapes.items():
            values = getattr(self, name)
            if values.shape != shape:
                raise ValueError(f"{name} has shape {values.shape}; {shape} is needed")
            with np.errstate(over="ignore", invalid="ignore"):  # infinite results are rejected below; a NaN may warn
                values = np.ascontiguousarray(values, np.float64 if name == "positions" else np.float32)
            if not np.isfinite(values).all():
                raise ValueError(f"{name} must be finite")
            object.__setattr__(self, name, values)
        if not 0 <= self.degree <= MAX_DEGREE:
            raise ValueError(f"the harmonics have degree {self.degree}; 0 to {MAX_DEGREE} are known")
        if (self.scales < 0).any() or not ((self.opacities >= 0) & (self.opacities <= 1)).all():
            raise ValueError("scales must not be negative, and opacities lie in [0, 1]")

    def __len__(self) -> int:
        return len(self.positions)

    def __getitem__(self, index: np.ndarray | slice) -> Splats:
        """Return the splats at `index`: integers, booleans or a slice."""
        names = ("positions", "scales", "quats", "opacities", "harmonics")
        return replace(self, **{name: getattr(self, name)[index] for name in names})

    @property
    def degree(self) -> int:
        """The degree of the spherical harmonics."""
        return round(self.harmonics.shape[1] ** 0.5) - 1

    @property
    def base_colors(self) -> np.ndarray:
        """The colours of degree 0, which do not depend on the direction: (N, 3) float32, clamped to [0, 1]."""
        return np.clip(0.5 + np.float32(SH_C0) * self.harmonics[:, 0], 0, 1)

    def with_degree(self, degree: int) -> Splats:
        """Return a copy whose harmonics are truncated, or padded with zeros, to another degree."""
        terms = num_sh_bases(degree)
        harmonics = self.harmonics[:, :terms]
        missing = ((0, 0), (0, terms - harmonics.shape[1]), (0, 0))
        return replace(self, harmonics=np.pad(harmonics, missing))

    def rotated(self, rotation: np.ndarray) -> Splats:
        """Return a copy rotated about the origin: positions, axes and colours.

        Args:
            rotation: (3, 3) proper rotation R, which moves a point x to R x.
        """
        turn = quaternion_from_matrix(rotation)
        quats = normalize_quats(multiply_quats(turn, self.quats.astype(np.float64)))
        harmonics = np.einsum("jk,nkc->njc", compute_harmonics_rotation(rotation, self.degree), self.harmonics)
        return replace(self, positions=self.positions @ np.asarray(rotation).T, quats=quats, harmonics=harmonics)


def concatenate(parts: Sequence[Splats]) -> Splats:
    """Join parts into one, in order, at their highest degree; `antialiased` is that of the first part."""
    degree = max(part.degree for part in parts)
    padded = [part.with_degree(degree) for part in parts]
    return replace(
        padded[0],
        positions=np.concatenate([part.positions for part in padded]),
        scales=np.concatenate([part.scales for part in padded]),
        quats=np.concatenate([part.quats for part in padded]),
        opacities=np.concatenate([part.opacities for part in padded]),
        harmonics=np.concatenate([part.harmonics for part in padded]),
    )


def normalize_quats(quats: np.ndarray) -> np.ndarray:
    """Normalise quaternions (N, 4) wxyz to unit length and w >= 0, float32; zero quaternions become the identity."""
    quats = np.array(quats, np.float64)
    lengths = np.linalg.norm(quats, axis=1, keepdims=True)
    quats = np.where(lengths > 0, quats / np.where(lengths > 0, lengths, 1), [1.0, 0.0, 0.0, 0.0])
    return np.where(quats[:, :1] < 0, -quats, quats).astype(np.float32)


def clamp_harmonics(splats: Splats, name: str) -> Splats:
    """Return splats with harmonics of at most MAX_ABS_HARMONIC, and log a warning if some are clamped."""
    is_clamped = (np.abs(splats.harmonics) > MAX_ABS_HARMONIC).any(axis=(1, 2))
    if not is_clamped.any():
        return splats
    _LOG.warning(
        f"{name}: harmonics of {is_clamped.sum():,} of {format_count(len(splats), 'Gaussian')} are beyond "
        f"{MAX_ABS_HARMONIC:,.0f}, as if the file were damaged or its training had failed, and are clamped to it; "
        "export the file again, or remove such Gaussians"
    )
    return replace(splats, harmonics=splats.harmonics.clip(-MAX_ABS_HARMONIC, MAX_ABS_HARMONIC))

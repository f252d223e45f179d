"""Describe 3D Gaussians independently of any format, and measure how much two descriptions differ.

The code follows the formats' public descriptions and uses no encoder or decoder of hyrfpack; rotations and spherical
harmonics come from scipy.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass, replace

import numpy as np
from independent.ply_files import StoredSplats
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y

from hyrfpack.splats.splats import Splats

# The half turn leads from SPZ's axes (right, up, back) to those of a PLY.
HALF_TURN_ABOUT_X = np.diag([1.0, -1.0, -1.0])
HARMONICS_PALETTE_SIZE = 24
BAND_0_VALUE = 0.5 / np.sqrt(np.pi)


@dataclass(frozen=True)
class Cloud:
    """Gaussians described by covariances, which do not depend on a quaternion's sign or the order of axes.

    Attributes:
        positions: (N, 3) float64.
        covariances: (N, 3, 3).
        opacities: (N,) in [0, 1].
        harmonics: (N, (degree + 1)^2, 3); a colour is 0.5 + their sum weighted by `evaluate_harmonics`.
        deviations: (N, 3) standard deviations in ascending order, or None where a program reports only covariances.
    """

    positions: np.ndarray
    covariances: np.ndarray
    opacities: np.ndarray
    harmonics: np.ndarray
    deviations: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.positions)

    @property
    def degree(self) -> int:
        return round(self.harmonics.shape[1] ** 0.5) - 1


def cloud_from_parameters(
    positions: np.ndarray, scales: np.ndarray, quats: np.ndarray, opacities: np.ndarray, harmonics: np.ndarray
) -> Cloud:
    """Make a cloud from standard deviations (N, 3) and quaternions (N, 4) wxyz of any length."""
    axes = Rotation.from_quat(np.float64(quats)[:, [1, 2, 3, 0]]).as_matrix()
    scales = np.float64(scales)
    covariances = np.einsum("nij,nj,nkj->nik", axes, scales**2, axes)
    return Cloud(
        np.float64(positions), covariances, np.float64(opacities), np.float64(harmonics), np.sort(scales, axis=1)
    )


def cloud_from_splats(splats: Splats) -> Cloud:
    return cloud_from_parameters(splats.positions, splats.scales, splats.quats, splats.opacities, splats.harmonics)


def cloud_from_ply(splats: StoredSplats) -> Cloud:
    """Make a cloud from the content of a 3D Gaussian Splatting PLY: logarithms of scales, logits of opacities."""
    opacities = 1 / (1 + np.exp(-np.float64(splats.opacity_logits)))
    return cloud_from_parameters(
        splats.positions, np.exp(np.float64(splats.log_scales)), splats.quats, opacities, splats.harmonics
    )


def ply_from_splats(splats: Splats) -> StoredSplats:
    """Return the content of a 3D Gaussian Splatting PLY, for `write_ply`."""
    opacities = np.float64(splats.opacities)
    logits = np.log(opacities / (1 - opacities)).astype(np.float32)
    return StoredSplats(
        splats.positions.astype(np.float32), np.log(splats.scales), splats.quats, logits, splats.harmonics
    )


def sample_splats(degree: int, count: int = 300) -> Splats:
    """Return splats without any symmetry: a rotation, a mirror image or exchanged axes or channels change their look.

    The higher harmonics are HARMONICS_PALETTE_SIZE different sets, so that a palette loses almost nothing.
    """
    random = np.random.default_rng(7 + degree)
    positions = random.normal(size=(count, 3)) * [1.5, 0.4, 3.0] + [-2.0, 0.7, 4.0]
    scales = np.exp(random.uniform(np.log(0.002), np.log(2.0), (count, 3)))
    opacities = random.uniform(0.01, 0.99, count)
    bands = np.concatenate([np.full(2 * band + 1, size) for band, size in enumerate((0.5, 0.25, 0.15, 0.1))])
    harmonics = (
        random.normal(size=(HARMONICS_PALETTE_SIZE, 16, 3))[random.integers(HARMONICS_PALETTE_SIZE, size=count)]
        * bands[:, None]
    )
    harmonics[:, 1:] += np.outer(bands[1:], [0.5, 0.1, -0.4])  # harmonics with a mean make sign errors visible
    harmonics = np.clip(harmonics, -0.95, 0.95)
    harmonics[:, 0] = (random.uniform(0.05, 0.95, (count, 3)) - 0.5) / BAND_0_VALUE
    quats = Rotation.random(count, rng=random).as_quat()[:, [3, 0, 1, 2]]
    return Splats(positions, scales, quats, opacities, harmonics[:, : (degree + 1) ** 2])


def evaluate_harmonics(directions: np.ndarray, degree: int) -> np.ndarray:
    """Evaluate (M, (degree + 1)^2) real spherical harmonics with the Condon-Shortley phase at unit vectors (M, 3)."""
    polar, azimuth = np.arccos(np.clip(directions[:, 2], -1, 1)), np.arctan2(directions[:, 1], directions[:, 0])
    columns = []
    for band in range(degree + 1):
        for order in range(-band, band + 1):
            value = sph_harm_y(band, abs(order), polar, azimuth)
            columns.append(value.real if order == 0 else np.sqrt(2) * (value.imag if order < 0 else value.real))
    return np.stack(columns, axis=1)


def undo_rotation(cloud: Cloud, turn: np.ndarray) -> Cloud:
    """Return the cloud in its original axes, given that its coordinates are `turn` (3, 3) times the original ones."""
    directions = Rotation.random(64, rng=np.random.default_rng(0)).apply([0.0, 0.0, 1.0])
    colors = np.einsum("mk,nkc->nmc", evaluate_harmonics(directions @ turn.T, cloud.degree), cloud.harmonics)
    return replace(
        cloud,
        positions=cloud.positions @ turn,
        covariances=turn.T @ cloud.covariances @ turn,
        harmonics=np.einsum("km,nmc->nkc", np.linalg.pinv(evaluate_harmonics(directions, cloud.degree)), colors),
    )


@dataclass(frozen=True)
class Differences:
    """The largest difference of each property between two clouds, or the limits that a format's precision sets.

    Attributes:
        position: of a coordinate in world units; infinite where two Gaussians have the same nearest neighbour.
        deviation: of the logarithm of a standard deviation; 0 where a cloud has none.
        covariance: of a covariance matrix, relative to its norm; includes the orientation.
        opacity: of an opacity in [0, 1].
        color: of a colour in [0, 1], over all view directions.
        harmonic: of one harmonic coefficient.
    """

    position: float
    deviation: float
    covariance: float
    opacity: float
    color: float
    harmonic: float

    def is_within(self, limits: Differences) -> bool:
        return all(getattr(self, name) <= limit for name, limit in vars(limits).items())

    def __add__(self, other: Differences) -> Differences:
        return Differences(*(mine + theirs for mine, theirs in zip(astuple(self), astuple(other), strict=True)))


FLOAT32_PRECISION = Differences(position=1e-6, deviation=1e-6, covariance=1e-6, opacity=1e-6, color=2e-6, harmonic=1e-6)


def compare_clouds(ours: Cloud, theirs: Cloud) -> Differences:
    """Measure the differences between two clouds in any order, each Gaussian against its nearest neighbour.

    Raises:
        AssertionError: The clouds have different numbers of Gaussians or different degrees.
    """
    assert len(theirs) == len(ours), f"{len(theirs)} Gaussians instead of {len(ours)}"
    assert theirs.degree == ours.degree, f"degree {theirs.degree} instead of {ours.degree}"
    pair = cKDTree(theirs.positions).query(ours.positions)[1]
    directions = Rotation.random(64, rng=np.random.default_rng(1)).apply([0.0, 0.0, 1.0])
    coefficients = theirs.harmonics[pair] - ours.harmonics
    colors = np.einsum("mk,nkc->nmc", evaluate_harmonics(directions, ours.degree), coefficients)
    covariances = np.linalg.norm(theirs.covariances[pair] - ours.covariances, axis=(1, 2))
    both = ours.deviations is not None and theirs.deviations is not None
    deviations = np.log(theirs.deviations[pair] / ours.deviations) if both else np.zeros(1)
    one_to_one = len(np.unique(pair)) == len(ours)
    return Differences(
        position=float(np.abs(theirs.positions[pair] - ours.positions).max()) if one_to_one else np.inf,
        deviation=float(np.abs(deviations).max()),
        covariance=float((covariances / np.linalg.norm(ours.covariances, axis=(1, 2))).max()),
        opacity=float(np.abs(theirs.opacities[pair] - ours.opacities).max()),
        color=float(np.abs(colors).max()),
        harmonic=float(np.abs(coefficients).max()),
    )

"""What is stored of a model, and how finely: the decisions that come before any number is coded."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import torch

from hyrfpack.format.arrays import decoder_widths, grids, to_arrays, to_model
from hyrfpack.format.compact.groups import Groups
from hyrfpack.format.compact.quantize import ERROR_PER_BIT
from hyrfpack.format.compact.sensitivity import Sensitivity
from hyrfpack.model.config import ModelConfig
from hyrfpack.model.frame import Frame, expand
from hyrfpack.model.hash_grid import FEATURES
from hyrfpack.model.hybrid import HybridModel
from hyrfpack.quant.morton import MAX_BITS
from hyrfpack.quant.points import Points, encode_points

CLASSES = 6
CLASS_WIDTH = 3.0  # log2 of sensitivity that a class spans: classes much narrower or wider cost more
ABOVE_MEAN = 2  # classes for what matters more than the mean
BITS_OF_A_GAUSSIAN = 10  # that pruning counts as saved: those it takes are cheap ones
USAGE_CLASSES = 16
COUNTED = 1 << 16  # Gaussians whose reading of the tables is counted; of more, every n-th


@dataclass(frozen=True)
class Plan:
    """What is stored of a model, and how finely.

    Attributes:
        kept: (M,) int64, the Gaussians that are stored, in the file's order.
        points: where they are on the lattice, and what class each is in.
        positions: the bytes of `points`.
        basis: (3, 3) float32, the columns of an orthonormal transform of colour logits, most varied first.
        groups: which numbers of the tables and decoders share a step, by section.
        sensitivity: of what is stored.
        distortion: D, the error in pictures that each number may add.
        reach: how many steps from the nearest symbol are tried; 0 takes the nearest.
    """

    kept: np.ndarray
    points: Points
    positions: bytes
    basis: np.ndarray
    groups: dict[str, Groups]
    sensitivity: Sensitivity
    distortion: float
    reach: int = 1

    def apply(self, model: HybridModel) -> HybridModel:
        """The part of a model that is stored: the Gaussians kept, in order, moved to the lattice."""
        arrays = to_arrays(model)
        for group in ("COLO", "SCAL", "OPAC"):
            arrays[group] = arrays[group][self.kept]
        arrays["POSI"] = from_lattice(self.points, model.config.frame)
        return to_model(model.config, arrays)

    def of_applied(self) -> Plan:
        """The same plan for the model that `apply` gave."""
        return replace(self, kept=np.arange(len(self.kept)))


def make_plan(model: HybridModel, sensitivity: Sensitivity, noise: float, prune: bool = True) -> Plan:
    """Decide what is stored, and how finely, so that pictures get about `noise` mean squared error.

    Args:
        noise: of colours in [0, 1]; 1e-5 is 50 dB between pictures before and after.
        prune: leave out Gaussians that cost more in bytes than they give to pictures.
    """
    with torch.no_grad():
        cube = model.cube_coords(model.gaussians.positions.double()).cpu().numpy()
        opacities = model.decode_geometry().opacities.double().cpu().numpy()
    distortion = noise / sum(parameter.numel() for parameter in model.parameters())
    kept = np.arange(len(cube))
    if prune:
        kept = np.flatnonzero(~negligible(sensitivity.opacities, opacities, distortion))
        sensitivity = sensitivity.of(kept)
    classes = importance_classes(sensitivity)
    bits = position_bits(sensitivity.positions, classes, distortion)
    side = (1 << bits)[classes][:, None]
    cells = np.clip(np.floor(cube[kept] * side), 0, side - 1).astype(np.int64)
    data, order, points = encode_points(Points(cells, classes, bits))
    kept = kept[order]
    basis = color_basis(to_arrays(model)["COLO"][kept])
    groups = {group: groups_of(group, model.config, points) for group in ("GTAB", "GMLP", "RTAB", "RMLP")}
    return Plan(kept, points, data, basis, groups, sensitivity.of(order), distortion)


def importance_classes(sensitivity: Sensitivity) -> np.ndarray:
    """(N,) uint8, 0 for the Gaussians that matter most: by the geometric mean of the sensitivities of all 8 numbers."""
    logs = np.zeros(len(sensitivity.positions))
    for values, numbers in (
        (sensitivity.positions, 3),
        (sensitivity.colors, 3),
        (sensitivity.scales, 1),
        (sensitivity.opacities, 1),
    ):
        logs += numbers / 8 * np.log2(values / max(float(values.mean()), 1e-300)) if len(values) else 0
    return np.clip(np.round(-logs / CLASS_WIDTH) + ABOVE_MEAN, 0, CLASSES - 1).astype(np.uint8)


def position_bits(sensitivity: np.ndarray, classes: np.ndarray, distortion: float) -> np.ndarray:
    """(CLASSES,) bits of an axis for each class: the lattice step nearest to sqrt(12 D / s)."""
    bits = np.ones(CLASSES, np.int64)
    for kind in np.unique(classes):
        step = np.sqrt(12 * distortion / sensitivity[classes == kind].mean())
        bits[kind] = np.clip(np.round(-np.log2(step)), 1, MAX_BITS)
    return bits


def negligible(sensitivity: np.ndarray, opacities: np.ndarray, distortion: float) -> np.ndarray:
    """(N,) bool: Gaussians whose removal adds less error than their bits are worth.

    Args:
        sensitivity: (N,) by the opacity logits; by the opacity o itself it is s / (o (1 - o))^2.
        opacities: (N,) in [0, 1].
    """
    by_opacity = sensitivity / np.maximum(opacities * (1 - opacities), 1e-4) ** 2
    return by_opacity * opacities**2 < ERROR_PER_BIT * distortion * BITS_OF_A_GAUSSIAN


def from_lattice(points: Points, frame: Frame) -> np.ndarray:
    """Local positions (N, 3) float32 of the centres of the points' cells."""
    cube = torch.from_numpy(points.centers() / float(2 << MAX_BITS))
    return (expand(cube) * cube.new_tensor(frame.half_extent)).float().numpy()


def color_basis(colors: np.ndarray) -> np.ndarray:
    """The eigenvectors of the covariance of colour logits (N, 3), as columns (3, 3) float32, most varied first.

    In it the channels do not repeat each other (Karhunen-Loeve transform).
    """
    if len(colors) < 2:
        return np.eye(3, dtype=np.float32)
    basis = np.linalg.eigh(np.cov(colors.T.astype(np.float64)))[1][:, ::-1]
    return (basis * np.where(basis.sum(axis=0) < 0, -1, 1)).astype(np.float32)


def groups_of(group: str, config: ModelConfig, points: Points | None) -> Groups:
    """Which numbers of a section "GTAB", "RTAB", "GMLP" or "RMLP" share a step.

    Rows of a table by level and usage class: 0 if no Gaussian reads the row, else 1 + floor(log4 n), n being how many
    corners of cells with a Gaussian in them have this row. Numbers of a decoder by layer and output, biases of a layer
    together; that takes no points.
    """
    field, kind = group[0], group[1:]
    if kind == "MLP":
        pairs = pairwise(decoder_widths(config)[field])
        sizes = [size for inputs, outputs in pairs for size in (*[inputs] * outputs, outputs)]
        return Groups(np.repeat(np.arange(len(sizes)), sizes), len(sizes))
    grid = grids(config)[field]
    every = max(1, -(-len(points.cells) // COUNTED))
    counted = Points(points.cells[::every], points.classes[::every], points.bits)
    usage = grid.usage(counted.centers(), MAX_BITS + 1)
    length = np.frexp(usage.astype(np.float64))[1]  # of the binary number; 0 for 0
    level = np.repeat(np.arange(grid.levels), np.diff(grid.offsets))
    index = level * USAGE_CLASSES + np.minimum((length + 1) // 2, USAGE_CLASSES - 1)
    return Groups(np.repeat(index, FEATURES), grid.levels * USAGE_CLASSES)

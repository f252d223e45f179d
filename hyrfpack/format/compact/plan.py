"""What is stored of a model, and how finely: the decisions that come before any number is coded."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import torch

from hyrfpack.format.arrays import decoder_widths, grids, to_arrays, to_model
from hyrfpack.format.compact.channels import LIMIT
from hyrfpack.format.compact.groups import Groups
from hyrfpack.format.compact.quantize import ERROR_PER_BIT
from hyrfpack.format.compact.sensitivity import Sensitivity
from hyrfpack.format.sections import COLORS, LOGITS, MLPS, POSITIONS, TABLES
from hyrfpack.model import expand
from hyrfpack.model.config import ModelConfig
from hyrfpack.model.frame import Frame
from hyrfpack.model.hash_grid import FEATURES
from hyrfpack.model.hybrid import HybridModel
from hyrfpack.quant.morton import MAX_BITS
from hyrfpack.quant.points import Points, encode_points

CLASSES = 6
CLASS_WIDTH = 3.0  # log2 of sensitivity that a class spans: classes much narrower or wider cost more
ABOVE_MEAN = 2  # classes for what matters more than the mean
BITS_OF_A_GAUSSIAN = 16  # that pruning counts as saved: those it takes are cheap ones
USAGE_CLASSES = 16
COUNTED = 1 << 16  # Gaussians whose reading of the tables is counted; of more, every n-th
LEAST_OF_LAYER = 5000, 8  # Gaussians of a layer: at least so many, and so much of all; smaller ones cost over 1 %
PLACED = 1 << 13  # Gaussians whose positions are worked out at once: too few for torch to wake its own threads for


@dataclass(frozen=True)
class Layer:
    """Gaussians that are stored together: the first layers of a file make a coarser model.

    Attributes:
        points: where they are on the lattice, and what class each is in.
        positions: the bytes of `points`.
    """

    points: Points
    positions: bytes


@dataclass(frozen=True)
class Plan:
    """What is stored of a model, and how finely.

    Attributes:
        kept: (M,) int64, the Gaussians that are stored, in the file's order.
        layers: they in parts, the most important first.
        basis: (3, 3) float32, the columns of an orthonormal transform of colour logits, most varied first.
        groups: which numbers of the tables and decoders share a step, by section.
        sensitivity: of what is stored.
        distortion: D, the error in pictures that each number may add.
        reach: how many steps from the nearest symbol are tried; 0 takes the nearest.
    """

    kept: np.ndarray
    layers: tuple[Layer, ...]
    basis: np.ndarray
    groups: dict[str, Groups]
    sensitivity: Sensitivity
    distortion: float
    reach: int = 1

    def apply(self, model: HybridModel) -> HybridModel:
        """The part of a model that is stored: the Gaussians kept, in order, moved to the lattice."""
        arrays = to_arrays(model)
        for group in LOGITS:
            arrays[group] = arrays[group][self.kept]
        places = [from_lattice(layer.points, model.config.frame) for layer in self.layers]
        arrays[POSITIONS] = np.concatenate(places)
        return to_model(model.config, arrays)

    @property
    def parts(self) -> list[slice]:
        """Which of the Gaussians each layer has."""
        stops = np.cumsum([len(layer.points.classes) for layer in self.layers]).tolist()
        return [slice(start, stop) for start, stop in zip([0, *stops], stops, strict=False)]

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
    distortion = noise / sum(parameter.numel() for parameter in model.parameters())
    kept = np.arange(len(cube))
    if prune:
        with torch.no_grad():
            opacities = model.decode_geometry().opacities.double().cpu().numpy()
        kept = np.flatnonzero(~negligible(sensitivity.opacities, opacities, distortion))
        sensitivity = sensitivity.of(kept)
    classes = importance_classes(sensitivity)
    bits = position_bits(sensitivity.positions, classes, distortion)
    layers, order = [], []
    for kinds in _layer_classes(np.bincount(classes, minlength=CLASSES)):
        members = np.flatnonzero(np.isin(classes, kinds))
        layer, index = _layer(cube[kept[members]], classes[members], bits)
        layers.append(layer)
        order.append(members[index])
    order = np.concatenate(order)
    kept = kept[order]
    basis = color_basis(to_arrays(model)[COLORS][kept])
    groups = {group: groups_of(group, model.config, layers[0].points) for group in (*TABLES, *MLPS)}
    return Plan(kept, tuple(layers), basis, groups, sensitivity.of(order), distortion)


def _layer(cube: np.ndarray, classes: np.ndarray, bits: np.ndarray) -> tuple[Layer, np.ndarray]:
    """A layer of the points (n, 3) of the cube, and which of them comes at each place."""
    while True:
        side = (1 << bits)[classes][:, None]
        cells = np.clip(np.floor(cube * side), 0, side - 1).astype(np.int64)
        data, order, points = encode_points(Points(cells, classes, bits))
        # A class coarser than all share was made finer: its points are placed anew, in the middle of their cells.
        if (points.bits == bits).all():
            return Layer(points, data), order
        bits = points.bits


def _layer_classes(members: np.ndarray) -> list[list[int]]:
    """The classes of each layer, from the numbers of their members: in order, and no layer with few Gaussians."""
    fewest, share = LEAST_OF_LAYER
    least = max(fewest, members.sum() / share)
    layers: list[list[int]] = [[]]
    for kind in range(len(members)):
        if members[layers[-1]].sum() >= least and members[kind:].sum() >= least:
            layers.append([])
        layers[-1].append(kind)
    return layers


def importance_classes(sensitivity: Sensitivity) -> np.ndarray:
    """(N,) uint8, 0 for the Gaussians that matter most: by the geometric mean of the sensitivities of all 8 numbers."""
    logs = np.zeros(len(sensitivity.positions))
    for values, numbers in (
        (sensitivity.positions, 3),
        (sensitivity.colors, 3),
        (sensitivity.scales, 1),
        (sensitivity.opacities, 1),
    ):
        if len(values):
            logs += numbers / 8 * np.log2(np.maximum(values, 1e-300) / max(float(values.mean()), 1e-300))
    return np.clip(np.round(-logs / CLASS_WIDTH) + ABOVE_MEAN, 0, CLASSES - 1).astype(np.uint8)


def position_bits(sensitivity: np.ndarray, classes: np.ndarray, distortion: float) -> np.ndarray:
    """(CLASSES,) bits of an axis for each class: the lattice step nearest to sqrt(12 D / s)."""
    bits = np.ones(CLASSES, np.int64)
    for kind in np.unique(classes):
        step = np.sqrt(12 * distortion / max(float(sensitivity[classes == kind].mean()), 1e-300))
        bits[kind] = np.clip(np.round(-np.log2(max(step, 2.0**-MAX_BITS))), 1, MAX_BITS)
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
    local = np.empty(points.cells.shape, np.float32)
    for first in range(0, len(local), PLACED):
        part = slice(first, first + PLACED)
        cube = torch.from_numpy(points[part].centers() / float(2 << MAX_BITS))
        local[part] = (expand(cube) * cube.new_tensor(frame.half_extent)).float().numpy()
    return local


def color_basis(colors: np.ndarray) -> np.ndarray:
    """The eigenvectors of the covariance of colour logits (N, 3), as columns (3, 3) float32, most varied first.

    In it the channels do not repeat each other (Karhunen-Loeve transform).
    """
    if len(colors) < 2:
        return np.eye(3, dtype=np.float32)
    within = np.clip(colors.T.astype(np.float64), -LIMIT / 2, LIMIT / 2)
    basis = np.linalg.eigh(np.cov(within))[1][:, ::-1]
    return (basis * np.where(basis.sum(axis=0) < 0, -1, 1)).astype(np.float32)


def groups_of(group: str, config: ModelConfig, points: Points | None) -> Groups:
    """Which numbers of a table's or decoder's section share a step.

    Rows of a table by level and usage class: 0 if no Gaussian reads the row, else 1 + floor(log4 n), n being how many
    corners of cells with a Gaussian in them have this row. Numbers of a decoder by layer and output, biases of a layer
    together; that takes no points.
    """
    if group in MLPS:
        pairs = pairwise(decoder_widths(config)[group])
        sizes = [size for inputs, outputs in pairs for size in (*[inputs] * outputs, outputs)]
        return Groups(np.repeat(np.arange(len(sizes)), sizes), len(sizes))
    grid = grids(config)[group]
    every = max(1, -(-len(points.cells) // COUNTED))
    usage = grid.usage(points[::every].centers(), MAX_BITS + 1)
    index, count = np.empty((grid.rows, FEATURES), np.uint16), grid.levels * USAGE_CLASSES
    for level, (first, last) in enumerate(pairwise(grid.offsets)):
        length = np.frexp(usage[first:last].astype(np.float64))[1]  # of the binary number; 0 for 0
        usage_class = np.minimum((length + 1) // 2, USAGE_CLASSES - 1)
        index[first:last] = (level * USAGE_CLASSES + usage_class)[:, None]
    return Groups(index.ravel(), count)

"""The plan of a compact file: which Gaussians are stored, where they are, and which numbers share a step."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch

from hyrfpack.format.arrays import decoder_widths, grid_configs, residual_widths, to_arrays, to_model
from hyrfpack.format.compact.groups import StepGroups
from hyrfpack.format.sections import DECODER_SECTIONS, LOGIT_SECTIONS, POSITIONS
from hyrfpack.model import expand
from hyrfpack.model.config import ModelConfig
from hyrfpack.model.frame import Frame
from hyrfpack.model.hash_grid import FEATURES_PER_LEVEL
from hyrfpack.model.hybrid import HybridModel
from hyrfpack.quant.morton import MAX_BITS_PER_AXIS
from hyrfpack.quant.points import LatticePoints

USAGE_CLASS_COUNT = 16
MAX_COUNTED_GAUSSIANS = 1 << 16  # in larger models, only every n-th Gaussian is counted, which saves time
GAUSSIANS_PER_BLOCK = 1 << 13  # small enough that torch does not start its own threads for a block


@dataclass(frozen=True)
class Layer:
    """Gaussians that are stored together; the first layers of a file make a coarser model.

    Attributes:
        points: lattice cell and class of each Gaussian, sorted by `quant.points.sort_points`.
        base_bits: the bits of each axis that they are sorted by.
    """

    points: LatticePoints
    base_bits: int


@dataclass(frozen=True)
class Plan:
    """Selection, order and grouping of the numbers of a model that are stored.

    Attributes:
        kept: (M,) int64 indices of the Gaussians that are stored, in file order.
        layers: the stored Gaussians in layers, the most important first.
        basis: (3, 3) float32 whose columns are an orthonormal basis of colour logits, the largest variance first.
        groups: groups of numbers of the tables and decoders that share a step, by section.
        distortion_per_number: mean squared error that each number may add to renders; the file states it, but no
            decoder needs it.
        gaussians_before: number of Gaussians of the model before pruning; the file states it likewise.
    """

    kept: np.ndarray
    layers: tuple[Layer, ...]
    basis: np.ndarray
    groups: dict[str, StepGroups]
    distortion_per_number: float
    gaussians_before: int

    def apply(self, model: HybridModel) -> HybridModel:
        """Return a model of the stored Gaussians, in file order, at their positions on the lattice.

        It is on the device of `model` and has its exposure map and its photos' sampling.
        """
        arrays = to_arrays(model)
        for group in (*LOGIT_SECTIONS, *residual_widths(model.config)):
            arrays[group] = arrays[group][self.kept]
        positions = [lattice_to_local(layer.points, model.config.frame) for layer in self.layers]
        arrays[POSITIONS] = np.concatenate(positions)
        stored = to_model(model.config, arrays).to(model.gaussians.positions.device)
        sizes = model.gaussians.pixel_sizes
        stored.gaussians.pixel_sizes = None if sizes is None else sizes[torch.from_numpy(self.kept).to(sizes.device)]
        stored.copy_settings(model)
        return stored


def lattice_to_local(points: LatticePoints, frame: Frame) -> np.ndarray:
    """Return local positions (N, 3) float32 of the centres of the points' cells."""
    local = np.empty(points.cells.shape, np.float32)
    for first in range(0, len(local), GAUSSIANS_PER_BLOCK):
        block = slice(first, first + GAUSSIANS_PER_BLOCK)
        cube = torch.from_numpy(points[block].centers() / float(2 << MAX_BITS_PER_AXIS))
        local[block] = (expand(cube) * cube.new_tensor(frame.half_extent)).float().numpy()
    return local


def build_step_groups(group: str, config: ModelConfig, points: LatticePoints | None = None) -> StepGroups:
    """Group the numbers of a hash table or decoder that share a step.

    Rows of a table are grouped by level and usage class: 0 if no Gaussian reads the row, else 1 + floor(log4 n). Here n
    is the number of cell corners that have this row, among all cells that hold a Gaussian. Numbers of a decoder are
    grouped by layer and output; the biases of a layer form one group.

    Args:
        group: section of the table or decoder.
        config: configuration of the model.
        points: lattice points of the first layer; needed for tables only.
    """
    if group in DECODER_SECTIONS:
        pairs = pairwise(decoder_widths(config)[group])
        sizes = [size for inputs, outputs in pairs for size in (*[inputs] * outputs, outputs)]
        return StepGroups(np.repeat(np.arange(len(sizes)), sizes), len(sizes))
    assert points is not None
    grid = grid_configs(config)[group]
    stride = max(1, -(-len(points.cells) // MAX_COUNTED_GAUSSIANS))
    usage = grid.count_row_reads(points[::stride].centers(), MAX_BITS_PER_AXIS + 1)
    index, count = np.empty((grid.rows, FEATURES_PER_LEVEL), np.uint16), grid.levels * USAGE_CLASS_COUNT
    for level, (first, last) in enumerate(pairwise(grid.offsets)):
        length = np.frexp(usage[first:last].astype(np.float64))[1]  # number of binary digits, 0 for 0
        usage_class = np.minimum((length + 1) // 2, USAGE_CLASS_COUNT - 1)
        index[first:last] = (level * USAGE_CLASS_COUNT + usage_class)[:, None]
    return StepGroups(index.ravel(), count)

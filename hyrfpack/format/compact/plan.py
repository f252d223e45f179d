"""What is stored of a model, and what a reader tells from it: where Gaussians are, and which numbers share a step."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch

from hyrfpack.format.arrays import decoder_widths, grids, to_arrays, to_model
from hyrfpack.format.compact.groups import StepGroups
from hyrfpack.format.sections import LOGITS, MLPS, POSITIONS
from hyrfpack.model import expand
from hyrfpack.model.config import ModelConfig
from hyrfpack.model.frame import Frame
from hyrfpack.model.hash_grid import FEATURES
from hyrfpack.model.hybrid import HybridModel
from hyrfpack.quant.morton import MAX_BITS
from hyrfpack.quant.points import Points

USAGE_CLASSES = 16
COUNTED = 1 << 16  # Gaussians whose reading of the tables is counted; of more, every n-th
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
    """What is stored of a model, and in what order.

    Attributes:
        kept: (M,) int64, the Gaussians that are stored, in the file's order.
        layers: they in parts, the most important first.
        basis: (3, 3) float32, the columns of an orthonormal transform of colour logits, most varied first.
        groups: which numbers of the tables and decoders share a step, by section.
        distortion_per_number: mean squared error that each number may add to pictures; kept in the file for people.
    """

    kept: np.ndarray
    layers: tuple[Layer, ...]
    basis: np.ndarray
    groups: dict[str, StepGroups]
    distortion_per_number: float

    def apply(self, model: HybridModel) -> HybridModel:
        """The part of a model that is stored, on its device: the Gaussians kept, in order, moved to the lattice.

        The exposure map goes along.
        """
        arrays = to_arrays(model)
        for group in LOGITS:
            arrays[group] = arrays[group][self.kept]
        places = [from_lattice(layer.points, model.config.frame) for layer in self.layers]
        arrays[POSITIONS] = np.concatenate(places)
        stored = to_model(model.config, arrays).to(model.gaussians.positions.device)
        stored.precision, stored.exposure = model.precision, model.exposure
        return stored


def from_lattice(points: Points, frame: Frame) -> np.ndarray:
    """Local positions (N, 3) float32 of the centres of the points' cells."""
    local = np.empty(points.cells.shape, np.float32)
    for first in range(0, len(local), PLACED):
        part = slice(first, first + PLACED)
        cube = torch.from_numpy(points[part].centers() / float(2 << MAX_BITS))
        local[part] = (expand(cube) * cube.new_tensor(frame.half_extent)).float().numpy()
    return local


def groups_of(group: str, config: ModelConfig, points: Points | None = None) -> StepGroups:
    """Which numbers of a table's or decoder's section share a step.

    Rows of a table by level and usage class: 0 if no Gaussian reads the row, else 1 + floor(log4 n), n being how many
    corners of cells with a Gaussian in them have this row. Numbers of a decoder by layer and output, biases of a layer
    together; that takes no points.
    """
    if group in MLPS:
        pairs = pairwise(decoder_widths(config)[group])
        sizes = [size for inputs, outputs in pairs for size in (*[inputs] * outputs, outputs)]
        return StepGroups(np.repeat(np.arange(len(sizes)), sizes), len(sizes))
    assert points is not None  # of a table
    grid = grids(config)[group]
    every = max(1, -(-len(points.cells) // COUNTED))
    usage = grid.usage(points[::every].centers(), MAX_BITS + 1)
    index, count = np.empty((grid.rows, FEATURES), np.uint16), grid.levels * USAGE_CLASSES
    for level, (first, last) in enumerate(pairwise(grid.offsets)):
        length = np.frexp(usage[first:last].astype(np.float64))[1]  # of the binary number; 0 for 0
        usage_class = np.minimum((length + 1) // 2, USAGE_CLASSES - 1)
        index[first:last] = (level * USAGE_CLASSES + usage_class)[:, None]
    return StepGroups(index.ravel(), count)

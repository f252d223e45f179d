"""Multiresolution hash grids (Mueller et al. 2022): configuration and table; `ops.hash_encode` looks up features."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor, nn

from hyrfpack.ops.hash_encode import hash_encode, level_offsets, level_resolutions
from hyrfpack.ops.hash_encode.reference import PRIME_Y, PRIME_Z

FEATURES_PER_LEVEL = 2


@dataclass(frozen=True)
class HashGridConfig:
    """The configuration of one hash grid.

    Attributes:
        log2_table_size: a level has min(resolution^3, 2^log2_table_size) rows.
        levels: number of levels; their resolutions form a geometric progression.
        base, finest: vertices per axis of the first and the last level.
    """

    log2_table_size: int
    levels: int = 16
    base: int = 8
    finest: int = 512

    def __post_init__(self) -> None:
        if not 1 <= self.levels <= 32:
            raise ValueError(f"levels is {self.levels}; it must lie in [1, 32]")
        if not 4 <= self.log2_table_size <= 24:
            raise ValueError(f"log2_table_size is {self.log2_table_size}; it must lie in [4, 24]")
        if not 2 <= self.base <= self.finest <= 65536:
            raise ValueError(f"resolutions {self.base} to {self.finest} must rise within [2, 65536]")

    @cached_property
    def resolutions(self) -> tuple[int, ...]:
        """Return the vertices per axis of each level."""
        return level_resolutions(self.levels, self.base, self.finest)

    @cached_property
    def offsets(self) -> tuple[int, ...]:
        """Return the first row of each level in the table, followed by the total number of rows: (levels + 1,)."""
        return level_offsets(self.resolutions, self.log2_table_size)

    @property
    def rows(self) -> int:
        """Return the number of rows of the whole table."""
        return self.offsets[-1]

    def count_row_reads(self, points: np.ndarray, bits: int) -> np.ndarray:
        """Count how often each row of the table is read when features are looked up at the given points.

        Each point reads the rows of the 8 corners of its cell on every level. All arithmetic is in integers, so that
        every decoder gets the same counts.

        Args:
            points: (N, 3) int64 in units of 2^-bits of the unit cube, 0 to 2^bits - 1.
            bits: number of bits per coordinate; this and the bits of the finest resolution add up to at most 62.

        Returns:
            (rows,) int64.
        """
        counts = np.zeros(self.rows, np.int64)
        for level, resolution in enumerate(self.resolutions):
            first, last = self.offsets[level : level + 2]
            cells = (points * (resolution - 1) >> bits).astype(np.uint32)
            dense = resolution**3 <= 1 << self.log2_table_size
            factors = (1, resolution, resolution**2) if dense else (1, PRIME_Y, PRIME_Z)
            # Products wrap around at 32 bits, as the hash function requires.
            sides = [
                [(cells[:, axis] + np.uint32(side)) * np.uint32(factor) for side in (0, 1)]
                for axis, factor in enumerate(factors)
            ]
            for corner in range(8):
                x, y, z = (sides[axis][corner >> axis & 1] for axis in range(3))
                rows = x + y + z if dense else (x ^ y ^ z) & np.uint32((1 << self.log2_table_size) - 1)
                counts[first:last] += np.bincount(rows, minlength=last - first)
        return counts


def draw_uniform(rows: int, columns: int, *, bound: float, generator: torch.Generator | None = None) -> Tensor:
    """Return (rows, columns) numbers drawn uniformly from -bound to bound.

    The operations are in place, because the model of a file is built on the device "meta". Other operations there would
    make torch import its compiler, which takes longer than reading the file.
    """
    return torch.rand(rows, columns, generator=generator).mul_(2).sub_(1).mul_(bound)


class HashGrid(nn.Module):
    """A hash grid with a trainable table (rows, 2) that holds all levels one after another."""

    def __init__(self, config: HashGridConfig, generator: torch.Generator | None = None) -> None:
        super().__init__()
        self.config = config
        self.table = nn.Parameter(draw_uniform(config.rows, FEATURES_PER_LEVEL, bound=1e-4, generator=generator))

    @property
    def feature_count(self) -> int:
        """Return the number of features per point."""
        return self.config.levels * FEATURES_PER_LEVEL

    def forward(self, coords: Tensor, used: Tensor | None = None) -> Tensor:
        """Return the features (N, levels * 2) of points (N, 3) in the unit cube.

        `used` is the number of points in use, see `hyrfpack.ops.rows`; None if all are.
        """
        return hash_encode(coords, self.table, self.config.resolutions, self.config.log2_table_size, used=used)

"""Encode residuals in the chunks of a compact model: those of the file, exactly, and those of merged Gaussians."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hyrfpack.compress.residuals import split_colors
from hyrfpack.format.compact.residuals import (
    ResidualSymbols,
    decode_residual_symbols,
    encode_residuals,
    residual_bands,
)
from hyrfpack.quant.steps import FIXED_POINT_ONE, MAX_ABS_SYMBOL, decode_step


@dataclass(frozen=True)
class LayerResiduals:
    """The residuals of a section in one layer of a file.

    Attributes:
        group: section type in the first layer.
        symbols: the residuals.
        basis: (3, 3) float32 basis of colours; None for shapes.
    """

    group: str
    symbols: ResidualSymbols
    basis: np.ndarray | None

    @classmethod
    def from_section(cls, group: str, data: memoryview, classes: np.ndarray, columns: int) -> LayerResiduals:
        """Decode a section. The arguments and errors are those of `decode_residual_symbols`."""
        return cls(group, *decode_residual_symbols(group, data, classes, columns))

    def encode_subset(self, index: np.ndarray, classes: np.ndarray) -> bytes:
        """Encode the residuals of the Gaussians at `index` (n,) int64, which have the `classes` (n,)."""
        flags = self.symbols.flags
        rows = (np.cumsum(flags) - 1)[index][flags[index]]
        symbols = [band[rows] for band in self.symbols.symbols]
        return encode_residuals(
            self.group, ResidualSymbols(flags[index], self.symbols.codes, symbols), classes, self.basis
        )

    def encode_values(self, values: np.ndarray, classes: np.ndarray) -> bytes:
        """Encode new residuals (n, columns) of Gaussians with the `classes` (n,), with the steps of this layer."""
        numbers = values.astype(np.float64) if self.basis is None else split_colors(values, self.basis)
        symbols, start = [], 0
        for band, codes in zip(residual_bands(self.group, values.shape[1]), self.symbols.codes, strict=True):
            steps = (decode_step(codes) / FIXED_POINT_ONE)[classes][:, None]
            rounded = np.rint(numbers[:, start : (start := start + band.width)] / steps)
            symbols.append(np.clip(rounded, -MAX_ABS_SYMBOL, MAX_ABS_SYMBOL).astype(np.int64))
        flags = np.any([(band != 0).any(axis=1) for band in symbols], axis=0)
        chosen = ResidualSymbols(flags, self.symbols.codes, [band[flags] for band in symbols])
        return encode_residuals(self.group, chosen, classes, self.basis)

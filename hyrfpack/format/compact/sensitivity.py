"""How much each number of a model matters to pictures: the weights of the rate-distortion rule."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Sensitivity:
    """Mean squared derivatives of pictures by each number of a model.

    For a number x it is s = mean over views, pixels and channels of (d colour / d x)^2, so that an error e in x adds
    about s e^2 to the pictures' mean squared error. All are float64, 0 or more.

    Attributes:
        positions: (N,) by a coordinate in the contracted cube, mean of the three axes.
        colors: (N,) by a colour logit, mean of the three.
        scales, opacities: (N,) by the explicit logits.
        tables: by an entry of the hash tables: "GTAB" and "RTAB", (rows * 2,).
        decoders: by the decoders' numbers, laid out as in the file: "GMLP" and "RMLP", (numbers,).
    """

    positions: np.ndarray
    colors: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    tables: dict[str, np.ndarray]
    decoders: dict[str, np.ndarray]

    def of(self, index: np.ndarray) -> Sensitivity:
        """That of the Gaussians at `index` (n,) int64."""
        parts = (getattr(self, name)[index] for name in ("positions", "colors", "scales", "opacities"))
        return Sensitivity(*parts, self.tables, self.decoders)

"""Choosing Gaussians: a box, and how faint they may be."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hyrfpack.errors import HyrfError
from hyrfpack.splats.splats import Splats


def chosen(splats: Splats, crop: Sequence[float] | None = None, min_opacity: float = 0.0) -> Splats:
    """Those with centres in the box `crop` and not fainter than `min_opacity`; see `export`.

    Raises:
        HyrfError: none is left.
    """
    keep = kept_of(splats.positions, splats.opacities, crop, min_opacity)
    return splats if keep.all() else splats[keep]


def kept_of(
    positions: np.ndarray, opacities: np.ndarray, crop: Sequence[float] | None, min_opacity: float
) -> np.ndarray:
    """(N,) bool: which Gaussians with positions (N, 3) and opacities (N,) `chosen` keeps. HyrfError when none."""
    keep = opacities >= min_opacity
    if crop is not None:
        keep &= ((positions >= crop[:3]) & (positions <= crop[3:])).all(axis=1)
    if not len(positions):
        raise HyrfError("no Gaussian is left: no camera sees any; name the photos with --data, or train again")
    if not keep.any():
        low, high = (corner.round(4).tolist() for corner in (positions.min(0), positions.max(0)))
        raise HyrfError(
            f"no Gaussian is left: centres lie between {low} and {high}, opacities reach {opacities.max():.3f}; "
            "widen --crop or lower --min-opacity"
        )
    return keep

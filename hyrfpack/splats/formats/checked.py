"""The door through which numbers of a foreign file become Splats."""

from __future__ import annotations

import numpy as np

from hyrfpack.errors import HyrfDataError
from hyrfpack.splats.splats import Splats, normalized_quats


def checked_splats(
    name: str,
    positions: np.ndarray,
    scales: np.ndarray,
    quats: np.ndarray,
    opacities: np.ndarray,
    harmonics: np.ndarray,
    antialiased: bool = False,
) -> Splats:
    """Splats of decoded numbers, of which nothing is known but the shapes.

    Args:
        name: what messages call the file.
        positions, scales, opacities, harmonics: as in Splats.
        quats: (N, 4) wxyz of any length; brought to unit length, and to no rotation where that is impossible.
        antialiased: as in Splats.

    Raises:
        HyrfDataError: a number is not finite in the precision that Splats keep.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # what becomes infinite is refused; NaN may signal
        positions = np.asarray(positions, np.float64)
        scales, quats, opacities, harmonics = (
            np.asarray(values, np.float32) for values in (scales, quats, opacities, harmonics)
        )
    named = {"position": positions, "scale": scales, "rotation": quats, "opacity": opacities, "colour": harmonics}
    for part, values in named.items():
        if not np.isfinite(values).all():
            bad = int(np.flatnonzero(~np.isfinite(values.reshape(len(values), -1)).all(axis=1))[0])
            raise HyrfDataError(
                f"{name}: the {part} of Gaussian {bad:,} of {len(values):,} is not a finite number; the file is "
                "damaged, or its training failed; export it again"
            )
    return Splats(positions, scales, normalized_quats(quats), opacities, harmonics, antialiased)

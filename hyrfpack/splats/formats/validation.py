"""Validation of the numbers that decoders read from foreign files, before they become Splats."""

from __future__ import annotations

import numpy as np

from hyrfpack.errors import HyrfDataError
from hyrfpack.splats.splats import Splats, normalize_quats


def build_valid_splats(
    name: str,
    positions: np.ndarray,
    scales: np.ndarray,
    quats: np.ndarray,
    opacities: np.ndarray,
    harmonics: np.ndarray,
    antialiased: bool = False,
) -> Splats:
    """Build Splats from decoded arrays and raise an error for numbers that are not finite.

    The caller guarantees only the shapes of the arrays.

    Args:
        name: the file's name in error messages.
        positions, scales, opacities, harmonics: as in Splats.
        quats: (N, 4) wxyz quaternions of any length. They are normalised; a quaternion of length 0 becomes the
            identity rotation.
        antialiased: as in Splats.

    Raises:
        HyrfDataError: a number is not finite in the precision that Splats store.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # infinite results are rejected below; a NaN may warn
        positions = np.asarray(positions, np.float64)
        scales, quats, opacities, harmonics = (
            np.asarray(values, np.float32) for values in (scales, quats, opacities, harmonics)
        )
    values_by_part = {
        "position": positions,
        "scale": scales,
        "rotation": quats,
        "opacity": opacities,
        "colour": harmonics,
    }
    for part, values in values_by_part.items():
        if not np.isfinite(values).all():
            index = int(np.flatnonzero(~np.isfinite(values.reshape(len(values), -1)).all(axis=1))[0])
            raise HyrfDataError(
                f"{name}: the {part} of Gaussian {index:,} of {len(values):,} is not a finite number, because the file "
                "is damaged or its training failed",
                fix="export it again",
            )
    return Splats(positions, scales, normalize_quats(quats), opacities, harmonics, antialiased)

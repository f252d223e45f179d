"""Unit quaternions as their three smallest components: what formats that pack rotations into few bits store."""

from __future__ import annotations

import numpy as np

_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])  # of the components 0 to 3 all but one


def without_largest(quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Leave out the component of largest magnitude, which follows from the others.

    Args:
        quats: (N, 4) unit quaternions, components in the order of the file.

    Returns:
        (N,) the number of the largest, and (N, 3) the others in their order, of q or -q: the one whose largest
        component is positive. They lie within sqrt(1/2) of 0.
    """
    largest = np.abs(quats).argmax(axis=1)
    negative = np.take_along_axis(quats, largest[:, None], axis=1) < 0
    others = np.take_along_axis(quats, _OTHERS[largest], axis=1)
    return largest, np.where(negative, -others, others)


def with_largest(largest: np.ndarray, others: np.ndarray) -> np.ndarray:
    """The inverse of `without_largest`: (N, 4), longer than 1 where the others already are."""
    quats = np.empty((len(others), 4), others.dtype)
    rest = np.sqrt(np.maximum(0, 1 - (others**2).sum(axis=1, keepdims=True)))
    np.put_along_axis(quats, _OTHERS[largest], others, axis=1)
    np.put_along_axis(quats, largest[:, None].astype(np.intp), rest, axis=1)
    return quats

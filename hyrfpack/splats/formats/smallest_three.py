"""The smallest-three encoding of unit quaternions, which formats use to pack rotations into few bits."""

from __future__ import annotations

import numpy as np

# Row i lists the components other than i.
_OTHER_COMPONENTS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])


def drop_largest(quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Remove the component of largest magnitude from each unit quaternion; it follows from the other three.

    q and -q are the same rotation. Of these two, the one whose largest component is positive is encoded.

    Args:
        quats: (N, 4) unit quaternions, with components in the file's order.

    Returns:
        largest: (N,) index of the removed component, 0 to 3.
        others: (N, 3) the other components in their order, each in [-sqrt(1/2), sqrt(1/2)].
    """
    largest = np.abs(quats).argmax(axis=1)
    negative = np.take_along_axis(quats, largest[:, None], axis=1) < 0
    others = np.take_along_axis(quats, _OTHER_COMPONENTS[largest], axis=1)
    return largest, np.where(negative, -others, others)


def restore_largest(largest: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Restore the removed component of quaternions, as the inverse of `drop_largest`.

    Args:
        largest: (N,) index of the removed component, 0 to 3.
        others: (N, 3) the other components.

    Returns:
        (N, 4) quaternions of unit length. Where the others alone are longer than 1, the restored component is 0.
    """
    quats = np.empty((len(others), 4), others.dtype)
    restored = np.sqrt(np.maximum(0, 1 - (others**2).sum(axis=1, keepdims=True)))
    np.put_along_axis(quats, _OTHER_COMPONENTS[largest], others, axis=1)
    np.put_along_axis(quats, largest[:, None].astype(np.intp), restored, axis=1)
    return quats

"""Bring blocks that were trained with per-image gains to one exposure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np


def align_log_gains(log_gains: Sequence[Mapping[str, np.ndarray]]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Align the gains of blocks by the photos that they share.

    The log gain g of a photo in a block is relative to the exposure of the block's model. With the offset c of the
    block and the gain e of the photo to one exposure of all blocks:

        minimise  sum over blocks k and their photos i of |g_ki - c_k - e_i|^2

    The mean of e over all photos is zero. Blocks that no shared photos connect keep their own exposures, up to that.

    Args:
        log_gains: for each block, the log gains (3,) of its photos by name; empty if it has learnt none.

    Returns:
        The offsets c (blocks, 3), by which the log odds of the colours of each block rise, and e (3,) of each photo.
    """
    names = sorted(set().union(*log_gains))
    if not names:
        return np.zeros((len(log_gains), 3)), {}
    row = {name: number for number, name in enumerate(names)}
    trains = np.zeros((len(names), len(log_gains)))
    gains = np.zeros((len(names), len(log_gains), 3))
    for block, photos in enumerate(log_gains):
        for name, gain in photos.items():
            trains[row[name], block], gains[row[name], block] = 1, gain
    counts = trains.sum(axis=1)
    means = gains.sum(axis=1) / counts[:, None]
    # For given offsets the best e of a photo is the mean of g - c over its blocks. That leaves the normal equations.
    system = np.diag(trains.sum(axis=0)) - trains.T @ (trains / counts[:, None])
    right = (gains - trains[..., None] * means[:, None]).sum(axis=0)
    offsets = np.linalg.lstsq(system, right, rcond=1e-9)[0]
    photo_gains = means - trains @ offsets / counts[:, None]
    mean = photo_gains.mean(axis=0)
    return offsets + mean, dict(zip(names, photo_gains - mean, strict=True))

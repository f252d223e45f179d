"""Encodes viewing directions on the CPU, in blocks of points that stay in the L1 cache.

A block has one row for each number of its points: the three coordinates of the direction, then the features. Numbers
are float64, because this costs little, and a point far from the viewpoint loses no digits.
"""

from __future__ import annotations

import math

import numba
import numpy as np
import torch
from torch import Tensor

from hyrfpack.ops.shade.directions import DIRECTION_FEATURES, FREQUENCY_OCTAVES
from hyrfpack.parallel.compiled import compiled
from hyrfpack.parallel.pool import run_ranges

_FAST_MATH = {"contract", "nsz"}
njit = compiled(fastmath=_FAST_MATH, error_model="numpy")
# Inlining is forced, so that cached kernels round like freshly compiled ones (see hyrfpack/ops/ssim/cpu.py).
inlined = numba.njit(fastmath=_FAST_MATH, error_model="numpy", forceinline=True)

POINTS_PER_BLOCK = 64
BLOCK_STRIDE = np.uint64(POINTS_PER_BLOCK)  # Constants are typed, so that indices stay uint64 in the kernels.
DIRECTION_ROW, FEATURE_ROW = 0, 3
BLOCK_ROWS = FEATURE_ROW + max(DIRECTION_FEATURES.values())
_MIN_LENGTH = 1e-12  # A point nearer to the viewpoint has a shorter direction than 1, as in the reference.
# Taylor coefficients of sin(pi d / 2) / d and cos(pi d / 2) in d^2, for |d| <= 1. The errors are below 1e-9 there.
_TAYLOR = [(-1) ** (n // 2) * (math.pi / 2) ** n / math.factorial(n) for n in range(15)]
_S0, _S1, _S2, _S3, _S4, _S5, _S6 = _TAYLOR[1::2]
_C0, _C1, _C2, _C3, _C4, _C5, _C6, _C7 = _TAYLOR[::2]


@inlined
def encode_frequencies(block, count):
    """Compute the features of `directions.frequency_encoding`: angles are doubled from one octave to the next."""
    for axis in range(3):
        source = np.uint64(DIRECTION_ROW + axis) * BLOCK_STRIDE
        sines = np.uint64(FEATURE_ROW + axis) * BLOCK_STRIDE
        cosines = sines + np.uint64(3 * FREQUENCY_OCTAVES) * BLOCK_STRIDE
        for k in range(count):
            k = np.uint64(k)
            along = block[source + k]
            q = along * along
            sine = along * (_S0 + q * (_S1 + q * (_S2 + q * (_S3 + q * (_S4 + q * (_S5 + q * _S6))))))
            cosine = _C0 + q * (_C1 + q * (_C2 + q * (_C3 + q * (_C4 + q * (_C5 + q * (_C6 + q * _C7))))))
            for octave in range(FREQUENCY_OCTAVES):
                sine, cosine = 2 * sine * cosine, 1 - 2 * sine * sine
                octave_row = np.uint64(3 * octave) * BLOCK_STRIDE
                block[sines + octave_row + k] = sine
                block[cosines + octave_row + k] = cosine


@inlined
def encode_harmonics(block, count):
    """Compute the features of `directions.spherical_harmonics`."""
    source, target = np.uint64(DIRECTION_ROW) * BLOCK_STRIDE, np.uint64(FEATURE_ROW) * BLOCK_STRIDE
    for k in range(count):
        at = source + np.uint64(k)
        x, y, z = block[at], block[at + BLOCK_STRIDE], block[at + np.uint64(2) * BLOCK_STRIDE]
        at = target + np.uint64(k)
        block[at] = 0.28209479177387814
        block[at + BLOCK_STRIDE] = 0.4886025119029199 * y
        block[at + np.uint64(2) * BLOCK_STRIDE] = 0.4886025119029199 * z
        block[at + np.uint64(3) * BLOCK_STRIDE] = 0.4886025119029199 * x
        block[at + np.uint64(4) * BLOCK_STRIDE] = 1.0925484305920792 * x * y
        block[at + np.uint64(5) * BLOCK_STRIDE] = 1.0925484305920792 * y * z
        block[at + np.uint64(6) * BLOCK_STRIDE] = 0.31539156525252005 * (3 * z * z - 1)
        block[at + np.uint64(7) * BLOCK_STRIDE] = 1.0925484305920792 * x * z
        block[at + np.uint64(8) * BLOCK_STRIDE] = 0.5462742152960396 * (x * x - y * y)


@inlined
def _find_directions(points, viewpoint, first, count, block):
    """Compute the directions from the viewpoint to `count` points."""
    for k in range(count):
        k = np.uint64(k)
        place = np.uint64(first) + k
        x = np.float64(points[place, 0]) - viewpoint[0]
        y = np.float64(points[place, 1]) - viewpoint[1]
        z = np.float64(points[place, 2]) - viewpoint[2]
        length = math.sqrt(x * x + y * y + z * z)
        shrink = 1 / (_MIN_LENGTH if length < _MIN_LENGTH else length)
        at = k + np.uint64(DIRECTION_ROW) * BLOCK_STRIDE
        block[at] = shrink * x
        block[at + BLOCK_STRIDE] = shrink * y
        block[at + np.uint64(2) * BLOCK_STRIDE] = shrink * z


@njit
def _encode_points(start, stop, points, viewpoint, is_frequency, encoded):
    """Encode the directions of points `start` to before `stop` into columns of `encoded` (E, N)."""
    block = np.empty(BLOCK_ROWS * POINTS_PER_BLOCK, np.float64)
    for first in range(start, stop, POINTS_PER_BLOCK):
        count = min(POINTS_PER_BLOCK, stop - first)
        _find_directions(points, viewpoint, first, count, block)
        if is_frequency:
            encode_frequencies(block, count)
        else:
            encode_harmonics(block, count)
        for i in range(encoded.shape[0]):
            source = np.uint64(FEATURE_ROW + i) * BLOCK_STRIDE
            for k in range(count):
                encoded[np.uint64(i), np.uint64(first) + np.uint64(k)] = block[source + np.uint64(k)]


def encode_views(points: Tensor, viewpoint: Tensor, encoding: str, *, threaded: bool = True) -> Tensor:
    """Compute `directions.encode_views` without gradients; the result (N, E) is stored by columns.

    Args:
        points, viewpoint, encoding: float32, as there, with one viewpoint.
        threaded: use all threads of the pool; False in a task that runs on one of them.
    """
    encoded = torch.empty(DIRECTION_FEATURES[encoding], len(points))
    place = tuple(viewpoint.tolist())
    arguments = points.detach().contiguous().numpy(), place, encoding == "frequency", encoded.numpy()
    if threaded:
        run_ranges(lambda start, stop: _encode_points(start, stop, *arguments), len(points))
    else:
        _encode_points(0, len(points), *arguments)
    return encoded.T

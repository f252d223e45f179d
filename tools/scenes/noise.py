"""Hashes and band-limited noise in compiled code.

Noise does not repeat, because each lattice point has the hash of its integer coordinates. Octaves that are finer than
the footprint of a sample fade out, so that textures do not alias.
"""

from __future__ import annotations

import math

from hyrfpack.parallel.compiled import compiled

_FAST_MATH = {"contract", "arcp", "nsz"}
kernel = compiled(fastmath=_FAST_MATH, error_model="numpy")
# Small functions are inlined, because a call copies the descriptions of all arrays of a scene.
inlined_kernel = compiled(fastmath=_FAST_MATH, error_model="numpy", forceinline=True)

_UINT32_MASK = 0xFFFFFFFF
_HASH_TO_UNIT_SCALE = 1.0 / 4294967296.0
_MAX_OCTAVE_COUNT = 12


@inlined_kernel
def hash_unit(x, y, z, seed):
    """Return a number in [0, 1) that depends on four integers."""
    h = (x * 374761393 + y * 668265263 + z * 2147483647 + seed * 1274126177) & _UINT32_MASK
    h = ((h ^ (h >> 15)) * 2246822519) & _UINT32_MASK
    h = ((h ^ (h >> 13)) * 3266489917) & _UINT32_MASK
    return (h ^ (h >> 16)) * _HASH_TO_UNIT_SCALE


@inlined_kernel
def clamp_unit(x):
    """Return `x` limited to [0, 1]."""
    return min(max(x, 0.0), 1.0)


@kernel
def noise2(x, y, seed):
    """Return smooth noise in [-1, 1] on a lattice of unit cells in the plane."""
    i, j = math.floor(x), math.floor(y)
    a, b = x - i, y - j
    a, b = a * a * (3 - 2 * a), b * b * (3 - 2 * b)
    i, j = int(i), int(j)
    low = hash_unit(i, j, 0, seed) * (1 - a) + hash_unit(i + 1, j, 0, seed) * a
    high = hash_unit(i, j + 1, 0, seed) * (1 - a) + hash_unit(i + 1, j + 1, 0, seed) * a
    return 2 * (low * (1 - b) + high * b) - 1


@kernel
def noise3(x, y, z, seed):
    """Return smooth noise in [-1, 1] on a lattice of unit cells in space."""
    k = math.floor(z)
    c = z - k
    c = c * c * (3 - 2 * c)
    k = int(k)
    return noise2(x, y, seed + 7919 * k) * (1 - c) + noise2(x, y, seed + 7919 * (k + 1)) * c


@inlined_kernel
def visible_share(wavelength, footprint):
    """Return the weight in [0, 1] of detail of a wavelength, for a sample that covers a footprint."""
    return clamp_unit(wavelength / footprint - 1.0)


@kernel
def fractal2(x, y, wavelength, gain, footprint, seed):
    """Sum octaves of plane noise from a wavelength down to the footprint, each `gain` times as strong as the last."""
    total, amplitude = 0.0, 1.0
    for octave in range(_MAX_OCTAVE_COUNT):
        if wavelength <= footprint:
            break
        scale = 1.0 / wavelength
        total += amplitude * visible_share(wavelength, footprint) * noise2(x * scale, y * scale, seed + 101 * octave)
        amplitude *= gain
        wavelength *= 0.47
    return total


@kernel
def fractal3(x, y, z, wavelength, gain, footprint, seed):
    """Sum octaves of space noise, as `fractal2` does in the plane."""
    total, amplitude = 0.0, 1.0
    for octave in range(_MAX_OCTAVE_COUNT):
        if wavelength <= footprint:
            break
        s = 1.0 / wavelength
        total += amplitude * visible_share(wavelength, footprint) * noise3(x * s, y * s, z * s, seed + 101 * octave)
        amplitude *= gain
        wavelength *= 0.47
    return total


@inlined_kernel
def line_coverage(distance, width, footprint):
    """Return the share of a footprint, centred at a distance from a line's axis, that the line of a width covers."""
    low = max(-0.5 * width, distance - 0.5 * footprint)
    high = min(0.5 * width, distance + 0.5 * footprint)
    return max(high - low, 0.0) / footprint

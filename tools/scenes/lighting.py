"""Indirect light of sky and surfaces, which is computed once and stored at texels of all faces.

Each texel gathers light over its hemisphere along rays whose density is that of the cosine. A second round sees the
surfaces in the light of the first, and so on, so that rooms are lit by several bounces.
"""

from __future__ import annotations

import math

import numpy as np

from hyrfpack.parallel.pool import run_tasks
from tools.scenes.geometry import SceneArrays, is_inside_any, locate_on_face
from tools.scenes.noise import hash_unit, kernel
from tools.scenes.shading import SURFACE_OFFSET_METRES, trace_matte

_TEXELS_PER_TASK = 256
_GATHER_FOOTPRINT_METRES = 0.15  # Finer texture does not change the light that surfaces exchange.
_GATHER_FOOTPRINT_PER_METRE = 0.1
_MAX_FILL_ROUNDS = 12


@kernel
def _gather(scene, texels, first, last, rays, light):
    """Write the mean light over the hemisphere to rows of `light`; NaN for texels inside a primitive.

    Row n of `texels` has primitive, face, column and row of texel n.
    """
    for n in range(first, last):
        i, face = texels[n, 0], texels[n, 1]
        s = (texels[n, 2] + 0.5) / scene.light_size[i, face, 0]
        t = (texels[n, 3] + 0.5) / scene.light_size[i, face, 1]
        x, y, z, nx, ny, nz = locate_on_face(scene, i, face, s, t)
        x, y, z = (
            x + 20 * SURFACE_OFFSET_METRES * nx,
            y + 20 * SURFACE_OFFSET_METRES * ny,
            z + 20 * SURFACE_OFFSET_METRES * nz,
        )
        if is_inside_any(scene, x, y, z):
            light[n] = np.nan
            continue
        if abs(nz) < 0.9:
            flat = 1.0 / math.sqrt(nx * nx + ny * ny)
            ax, ay, az = -ny * flat, nx * flat, 0.0
        else:
            flat = 1.0 / math.sqrt(ny * ny + nz * nz)
            ax, ay, az = 0.0, -nz * flat, ny * flat
        bx, by, bz = ny * az - nz * ay, nz * ax - nx * az, nx * ay - ny * ax
        shift_a, shift_b = hash_unit(n, 1, 0, 17), hash_unit(n, 2, 0, 17)
        red, green, blue = 0.0, 0.0, 0.0
        for ray in range(rays):
            # A sequence of low discrepancy, shifted for each texel (the plastic number's, in two dimensions).
            a = shift_a + 0.7548776662466927 * ray
            b = shift_b + 0.5698402909980532 * ray
            a, b = a - math.floor(a), b - math.floor(b)
            radius, angle = math.sqrt(a), 2 * math.pi * b
            p, q, h = radius * math.cos(angle), radius * math.sin(angle), math.sqrt(1 - a)
            r, g, c = trace_matte(
                scene,
                x,
                y,
                z,
                p * ax + q * bx + h * nx,
                p * ay + q * by + h * ny,
                p * az + q * bz + h * nz,
                _GATHER_FOOTPRINT_METRES,
                _GATHER_FOOTPRINT_PER_METRE,
                False,
            )
            red, green, blue = red + r, green + g, blue + c
        light[n, 0], light[n, 1], light[n, 2] = red / rays, green / rays, blue / rays


def add_indirect_light(scene: SceneArrays, rays: int, rounds: int) -> SceneArrays:
    """Return the scene with indirect light.

    Args:
        scene: with uniform light, which stands for the bounces after the last round.
        rays: number of rays of each texel.
        rounds: number of bounces.
    """
    texels = _list_texels(scene)
    for _ in range(rounds):
        light = np.empty_like(scene.light)

        def gather(task: int, scene: SceneArrays = scene, light: np.ndarray = light) -> None:
            first = task * _TEXELS_PER_TASK
            _gather(scene, texels, first, min(first + _TEXELS_PER_TASK, len(texels)), rays, light)

        run_tasks(gather, -(-len(texels) // _TEXELS_PER_TASK))
        scene = scene._replace(light=_smooth(scene, light))
    return scene


def _list_texels(scene: SceneArrays) -> np.ndarray:
    """Return primitive, face, column and row of each light texel, (T, 4), in the order of `SceneArrays.light`."""
    rows = []
    for i in range(len(scene.shape)):
        for face, (columns, lines) in enumerate(scene.light_size[i]):
            if face == 0 or scene.light_start[i, face] > 0:
                row, column = np.divmod(np.arange(columns * lines), columns)
                rows.append(np.stack([np.full_like(row, i), np.full_like(row, face), column, row], axis=1))
    return np.concatenate(rows).astype(np.int64)


def _smooth(scene: SceneArrays, light: np.ndarray) -> np.ndarray:
    """Average neighbouring texels of each face, which removes noise, and fill those that lie inside a primitive."""
    smooth = np.zeros_like(light)
    for i in range(len(scene.shape)):
        for face, (columns, rows) in enumerate(scene.light_size[i]):
            start = scene.light_start[i, face]
            if face and start == 0:
                continue
            part = slice(start, start + columns * rows)
            smooth[part] = _smooth_face(light[part].reshape(rows, columns, 3)).reshape(-1, 3)
    return smooth


def _smooth_face(values: np.ndarray) -> np.ndarray:
    """Return the blurred light (rows, columns, 3) of one face; unknown texels (NaN) grow in from known neighbours."""
    known = np.isfinite(values[..., :1]).astype(np.float32)
    values = np.where(known > 0, values, 0)
    for round_number in range(_MAX_FILL_ROUNDS):
        weight, total = _blur(known), _blur(values * known)
        average = total / np.maximum(weight, 1e-6)
        if round_number == 0:
            values = np.where(weight > 0, average, 0)  # smooths all
        else:
            values = np.where(known > 0, values, average)
        if known.all() or not known.any():
            break
        known = np.maximum(known, weight > 0).astype(np.float32)
    return values


def _blur(values: np.ndarray) -> np.ndarray:
    """Convolve the first two axes with (1, 2, 1) / 4; edges are repeated."""
    for axis in (0, 1):
        padded = np.concatenate([values.take([0], axis), values, values.take([-1], axis)], axis)
        length = values.shape[axis]
        before, here, after = (padded.take(range(k, k + length), axis) for k in range(3))
        values = 0.25 * before + 0.5 * here + 0.25 * after
    return values

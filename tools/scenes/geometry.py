"""Ray casting against boxes, ellipsoids and cylinders in compiled code.

Each primitive is a unit shape that is scaled by half-extents, rotated about z by a yaw and moved. Rays are unit vectors
in world metres. A hierarchy of bounding boxes is stored depth first, once for each octant of ray directions, so that a
traversal visits near boxes first and needs no stack: a node that is missed is skipped with all nodes below it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from tools.scenes.noise import inlined_kernel, kernel

BOX, ELLIPSOID, CYLINDER_Z, CYLINDER_Y = range(4)
MAX_FACES = 6
MIN_HIT_DISTANCE = 1e-5
_MIN_DIVISOR = 1e-12


class SceneArrays(NamedTuple):
    """A scene as compiled code takes it: N primitives, M nodes, K materials, T light texels.

    Attributes:
        shape: (N,) one of the shapes above.
        center, half, inverse_half: (N, 3) metres.
        yaw: (N, 2) cosine and sine.
        anchor: (N, 3) world origin in the axes of the primitive, which anchors textures in the world.
        material: (N,) rows of `materials`.
        node_bounds: (8, M, 6) lower and upper corner.
        node_skip: (8, M) the node that follows the subtree.
        node_primitive: (8, M) the primitive of a leaf, -1 for an inner node.
        materials: (K, columns) see `textures`.
        light_start, light_size: (N, MAX_FACES) first texel, and (N, MAX_FACES, 2) texels along the two axes.
        light: (T, 3) mean radiance over the hemisphere, weighted by the cosine.
        sky: see `sky`.
    """

    shape: np.ndarray
    center: np.ndarray
    half: np.ndarray
    inverse_half: np.ndarray
    yaw: np.ndarray
    anchor: np.ndarray
    material: np.ndarray
    node_bounds: np.ndarray
    node_skip: np.ndarray
    node_primitive: np.ndarray
    materials: np.ndarray
    light_start: np.ndarray
    light_size: np.ndarray
    light: np.ndarray
    sky: np.ndarray


@inlined_kernel
def to_unit_shape(scene, i, x, y, z):
    """Rotate and scale a world vector into the axes of primitive `i`; cylinders have their axis along z."""
    c, s = scene.yaw[i, 0], scene.yaw[i, 1]
    a = (c * x + s * y) * scene.inverse_half[i, 0]
    b = (c * y - s * x) * scene.inverse_half[i, 1]
    e = z * scene.inverse_half[i, 2]
    if scene.shape[i] == CYLINDER_Y:
        return a, -e, b
    return a, b, e


@inlined_kernel
def hit_primitive(scene, i, ox, oy, oz, dx, dy, dz):
    """Return the distance at which a ray from outside enters primitive `i`, infinity if it misses it."""
    x, y, z = to_unit_shape(scene, i, ox - scene.center[i, 0], oy - scene.center[i, 1], oz - scene.center[i, 2])
    u, v, w = to_unit_shape(scene, i, dx, dy, dz)
    shape = scene.shape[i]
    if shape == ELLIPSOID:
        a = u * u + v * v + w * w
        b = x * u + y * v + z * w
        root = b * b - a * (x * x + y * y + z * z - 1.0)
        if root <= 0.0:
            return np.inf
        t = (-b - math.sqrt(root)) / a
        return t if t > MIN_HIT_DISTANCE else np.inf
    if abs(w) < _MIN_DIVISOR:
        w = _MIN_DIVISOR
    first, second = (-1.0 - z) / w, (1.0 - z) / w
    enter, leave = min(first, second), max(first, second)
    if shape == BOX:
        if abs(u) < _MIN_DIVISOR:
            u = _MIN_DIVISOR
        if abs(v) < _MIN_DIVISOR:
            v = _MIN_DIVISOR
        first, second = (-1.0 - x) / u, (1.0 - x) / u
        enter, leave = max(enter, min(first, second)), min(leave, max(first, second))
        first, second = (-1.0 - y) / v, (1.0 - y) / v
        enter, leave = max(enter, min(first, second)), min(leave, max(first, second))
    else:
        a = max(u * u + v * v, _MIN_DIVISOR * _MIN_DIVISOR)
        b = x * u + y * v
        root = b * b - a * (x * x + y * y - 1.0)
        if root <= 0.0:
            return np.inf
        root = math.sqrt(root)
        enter, leave = max(enter, (-b - root) / a), min(leave, (-b + root) / a)
    return enter if enter < leave and enter > MIN_HIT_DISTANCE else np.inf


@inlined_kernel
def _octant(dx, dy, dz):
    return (1 if dx < 0 else 0) + (2 if dy < 0 else 0) + (4 if dz < 0 else 0)


@inlined_kernel
def _misses_bounds(bounds, ox, oy, oz, ix, iy, iz, farthest):
    first, second = (bounds[0] - ox) * ix, (bounds[3] - ox) * ix
    enter, leave = min(first, second), max(first, second)
    first, second = (bounds[1] - oy) * iy, (bounds[4] - oy) * iy
    enter, leave = max(enter, min(first, second)), min(leave, max(first, second))
    first, second = (bounds[2] - oz) * iz, (bounds[5] - oz) * iz
    enter, leave = max(enter, min(first, second)), min(leave, max(first, second))
    return enter > leave or leave < 0.0 or enter > farthest


@inlined_kernel
def _inverse(d):
    return 1.0 / d if abs(d) > _MIN_DIVISOR else 1.0 / _MIN_DIVISOR


@kernel
def find_nearest_hit(scene, ox, oy, oz, dx, dy, dz):
    """Return the distance to the nearest surface along a ray, and its primitive; infinity and -1 for the sky."""
    octant = _octant(dx, dy, dz)
    ix, iy, iz = _inverse(dx), _inverse(dy), _inverse(dz)
    nearest, hit, node = np.inf, -1, 0
    count = scene.node_skip.shape[1]
    while node < count:
        if _misses_bounds(scene.node_bounds[octant, node], ox, oy, oz, ix, iy, iz, nearest):
            node = scene.node_skip[octant, node]
            continue
        primitive = scene.node_primitive[octant, node]
        if primitive >= 0:
            t = hit_primitive(scene, primitive, ox, oy, oz, dx, dy, dz)
            if t < nearest:
                nearest, hit = t, primitive
        node += 1
    return nearest, hit


@kernel
def is_blocked(scene, ox, oy, oz, dx, dy, dz, farthest):
    """Return whether a surface lies on a ray, nearer than a distance."""
    octant = _octant(dx, dy, dz)
    ix, iy, iz = _inverse(dx), _inverse(dy), _inverse(dz)
    node, count = 0, scene.node_skip.shape[1]
    while node < count:
        if _misses_bounds(scene.node_bounds[octant, node], ox, oy, oz, ix, iy, iz, farthest):
            node = scene.node_skip[octant, node]
            continue
        primitive = scene.node_primitive[octant, node]
        if primitive >= 0 and hit_primitive(scene, primitive, ox, oy, oz, dx, dy, dz) < farthest:
            return True
        node += 1
    return False


@kernel
def is_inside_any(scene, x, y, z):
    """Return whether a point lies inside a primitive."""
    for i in range(len(scene.shape)):
        a, b, c = to_unit_shape(scene, i, x - scene.center[i, 0], y - scene.center[i, 1], z - scene.center[i, 2])
        shape = scene.shape[i]
        if shape == BOX:
            inside = max(abs(a), abs(b), abs(c)) < 1.0
        elif shape == ELLIPSOID:
            inside = a * a + b * b + c * c < 1.0
        else:
            inside = a * a + b * b < 1.0 and abs(c) < 1.0
        if inside:
            return True
    return False


@inlined_kernel
def _to_world(scene, i, a, b, c):
    """Rotate a vector from the axes of a primitive, without its scale, to the world; the inverse of `to_unit_shape`."""
    if scene.shape[i] == CYLINDER_Y:
        a, b, c = a, c, -b
    cosine, sine = scene.yaw[i, 0], scene.yaw[i, 1]
    return cosine * a - sine * b, sine * a + cosine * b, c


@inlined_kernel
def _unit_half(scene, i):
    """Return the half-extents in the axes of the unit shape."""
    if scene.shape[i] == CYLINDER_Y:
        return scene.half[i, 0], scene.half[i, 2], scene.half[i, 1]
    return scene.half[i, 0], scene.half[i, 1], scene.half[i, 2]


@inlined_kernel
def describe_surface(scene, i, px, py, pz):
    """Describe the surface of primitive `i` at a point on it.

    Returns:
        Outward unit normal (3), face, position on the face in [0, 1] (2), texture coordinates u, v (metres).
    """
    x, y, z = to_unit_shape(scene, i, px - scene.center[i, 0], py - scene.center[i, 1], pz - scene.center[i, 2])
    hx, hy, hz = _unit_half(scene, i)
    shape = scene.shape[i]
    if shape == BOX:
        ax, ay, az = scene.anchor[i, 0], scene.anchor[i, 1], scene.anchor[i, 2]
        if abs(x) >= abs(y) and abs(x) >= abs(z):
            face, a, b, u, v = (1 if x > 0 else 0), y, z, y * hy + ay, z * hz + az
            nx, ny, nz = (1.0 if x > 0 else -1.0), 0.0, 0.0
        elif abs(y) >= abs(z):
            face, a, b, u, v = (3 if y > 0 else 2), x, z, x * hx + ax, z * hz + az
            nx, ny, nz = 0.0, (1.0 if y > 0 else -1.0), 0.0
        else:
            face, a, b, u, v = (5 if z > 0 else 4), x, y, x * hx + ax, y * hy + ay
            nx, ny, nz = 0.0, 0.0, (1.0 if z > 0 else -1.0)
        s, t = 0.5 + 0.5 * a, 0.5 + 0.5 * b
    elif shape == ELLIPSOID:
        face = 0
        azimuth = math.atan2(y, x)
        s, t = 0.5 + azimuth / (2 * math.pi), 0.5 + 0.5 * z
        nx, ny, nz = x / hx, y / hy, z / hz
        norm = 1.0 / math.sqrt(nx * nx + ny * ny + nz * nz)
        nx, ny, nz = nx * norm, ny * norm, nz * norm
        u, v = azimuth * 0.5 * (hx + hy), math.asin(min(max(z, -1.0), 1.0)) * hz
    elif x * x + y * y < z * z:
        face = 1 if z > 0 else 2
        s, t, u, v = 0.5 + 0.5 * x, 0.5 + 0.5 * y, x * hx, y * hy
        nx, ny, nz = 0.0, 0.0, (1.0 if z > 0 else -1.0)
    else:
        face = 0
        azimuth = math.atan2(y, x)
        s, t = 0.5 + azimuth / (2 * math.pi), 0.5 + 0.5 * z
        u, v = azimuth * 0.5 * (hx + hy), z * hz
        nx, ny, nz = x / hx, y / hy, 0.0
        norm = 1.0 / math.sqrt(nx * nx + ny * ny)
        nx, ny = nx * norm, ny * norm
    nx, ny, nz = _to_world(scene, i, nx, ny, nz)
    return nx, ny, nz, face, s, t, u, v


@kernel
def locate_on_face(scene, i, face, s, t):
    """Return the world point and the outward unit normal at a position in [0, 1] x [0, 1] on a face."""
    hx, hy, hz = _unit_half(scene, i)
    shape = scene.shape[i]
    a, b = 2 * s - 1, 2 * t - 1
    if shape == BOX:
        sign = 1.0 if face % 2 else -1.0
        if face < 2:
            x, y, z, nx, ny, nz = sign, a, b, sign, 0.0, 0.0
        elif face < 4:
            x, y, z, nx, ny, nz = a, sign, b, 0.0, sign, 0.0
        else:
            x, y, z, nx, ny, nz = a, b, sign, 0.0, 0.0, sign
    elif shape == ELLIPSOID:
        ring = math.sqrt(max(1 - b * b, 0.0))
        x, y, z = ring * math.cos(math.pi * a), ring * math.sin(math.pi * a), b
        nx, ny, nz = x / hx, y / hy, z / hz
    elif face == 0:
        x, y, z = math.cos(math.pi * a), math.sin(math.pi * a), b
        nx, ny, nz = x / hx, y / hy, 0.0
    else:
        shrink = 1.0 / max(math.sqrt(a * a + b * b), 1.0)
        sign = 1.0 if face == 1 else -1.0
        x, y, z, nx, ny, nz = a * shrink, b * shrink, sign, 0.0, 0.0, sign
    norm = 1.0 / math.sqrt(nx * nx + ny * ny + nz * nz)
    nx, ny, nz = _to_world(scene, i, nx * norm, ny * norm, nz * norm)
    x, y, z = _to_world(scene, i, x * hx, y * hy, z * hz)
    return x + scene.center[i, 0], y + scene.center[i, 1], z + scene.center[i, 2], nx, ny, nz

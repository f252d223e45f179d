"""Light that leaves surfaces, in compiled code: sun with shadows, stored indirect light, mirror reflection."""

from __future__ import annotations

import math

from tools.scenes.geometry import BOX, describe_surface, find_nearest_hit, is_blocked
from tools.scenes.noise import inlined_kernel, kernel
from tools.scenes.sky import SUN_COLOR, SUN_DIRECTION, SUN_RADIUS, evaluate_sky
from tools.scenes.textures import COLOR_A, IS_METAL, REFLECTANCE, SHININESS, evaluate_albedo

SURFACE_OFFSET_METRES = 1e-4  # Secondary rays start this far above their surface, so that they do not hit it.
MAX_RAY_METRES = 1e9
_MIN_FOOTPRINT_COSINE = 0.05
MAX_FAINT_FRESNEL = 0.1  # weaker reflections need fewer samples


@inlined_kernel
def read_light(scene, i, face, s, t):
    """Interpolate the stored indirect light (red, green, blue) at a position on a face."""
    columns, rows = scene.light_size[i, face, 0], scene.light_size[i, face, 1]
    x, y = s * columns - 0.5, min(max(t * rows - 0.5, 0.0), rows - 1.0)
    wraps = scene.shape[i] != BOX and face == 0
    if not wraps:
        x = min(max(x, 0.0), columns - 1.0)
    x0, y0 = int(math.floor(x)), int(y)
    a, b = x - x0, y - y0
    x1, y1 = x0 + 1, min(y0 + 1, rows - 1)
    if wraps:
        x0, x1 = x0 % columns, x1 % columns
    else:
        x1 = min(x1, columns - 1)
    first = scene.light_start[i, face]
    p, q = first + y0 * columns, first + y1 * columns
    light = scene.light
    w00, w01, w10, w11 = (1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b
    return (
        light[p + x0, 0] * w00 + light[p + x1, 0] * w01 + light[q + x0, 0] * w10 + light[q + x1, 0] * w11,
        light[p + x0, 1] * w00 + light[p + x1, 1] * w01 + light[q + x0, 1] * w10 + light[q + x1, 1] * w11,
        light[p + x0, 2] * w00 + light[p + x1, 2] * w01 + light[q + x0, 2] * w10 + light[q + x1, 2] * w11,
    )


@kernel
def sees_sun(scene, x, y, z, nx, ny, nz, across, up):
    """Return whether a point sees the sun at a place on its disc, whose coordinates lie in [-1, 1]."""
    sky = scene.sky
    lx, ly, lz = sky[SUN_DIRECTION], sky[SUN_DIRECTION + 1], sky[SUN_DIRECTION + 2]
    if nx * lx + ny * ly + nz * lz <= 0.0:
        return False
    flat = 1.0 / math.sqrt(lx * lx + ly * ly + 1e-9)
    ax, ay = -ly * flat, lx * flat  # level, at a right angle to the direction of the sun
    bx, by, bz = -lz * ay, lz * ax, lx * ay - ly * ax
    r = sky[SUN_RADIUS]
    dx, dy, dz = lx + r * (across * ax + up * bx), ly + r * (across * ay + up * by), lz + r * up * bz
    norm = 1.0 / math.sqrt(dx * dx + dy * dy + dz * dz)
    ox, oy, oz = x + SURFACE_OFFSET_METRES * nx, y + SURFACE_OFFSET_METRES * ny, z + SURFACE_OFFSET_METRES * nz
    return not is_blocked(scene, ox, oy, oz, dx * norm, dy * norm, dz * norm, MAX_RAY_METRES)


@kernel
def trace_matte(scene, ox, oy, oz, dx, dy, dz, footprint, spread, has_disc):
    """Return the light (red, green, blue) along a ray, without reflections at the surface that it meets.

    The footprint at a distance t is `footprint + spread * t`.
    """
    t, i = find_nearest_hit(scene, ox, oy, oz, dx, dy, dz)
    if i < 0:
        return evaluate_sky(scene.sky, dx, dy, dz, has_disc)
    x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
    nx, ny, nz, face, s, v, tu, tv = describe_surface(scene, i, x, y, z)
    material = scene.material[i]
    red, green, blue = evaluate_albedo(scene.materials, material, i, face, tu, tv, x, y, z, footprint + spread * t)
    lr, lg, lb = read_light(scene, i, face, s, v)
    sky = scene.sky
    facing = nx * sky[SUN_DIRECTION] + ny * sky[SUN_DIRECTION + 1] + nz * sky[SUN_DIRECTION + 2]
    if facing > 0.0 and sees_sun(scene, x, y, z, nx, ny, nz, 0.0, 0.0):
        lr += facing * sky[SUN_COLOR]
        lg += facing * sky[SUN_COLOR + 1]
        lb += facing * sky[SUN_COLOR + 2]
    return red * lr, green * lg, blue * lb


@kernel
def shade(scene, i, ox, oy, oz, dx, dy, dz, t, sunlit, spread, faint_weight):
    """Return the light (red, green, blue) that leaves primitive `i` towards the start of a ray which hits it at `t`.

    Args:
        sunlit: share of the sun's disc that the point sees.
        spread: side of the square that the sample covers, for each metre of distance.
        faint_weight: weight of a faint reflection. One subsample of a pixel can stand for all, where 0 skips it.
    """
    x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
    nx, ny, nz, face, s, v, tu, tv = describe_surface(scene, i, x, y, z)
    m = scene.material[i]
    materials, sky = scene.materials, scene.sky
    cosine = max(-(dx * nx + dy * ny + dz * nz), 0.0)
    footprint = spread * t / math.sqrt(max(cosine, _MIN_FOOTPRINT_COSINE))
    ar, ag, ab = evaluate_albedo(materials, m, i, face, tu, tv, x, y, z, footprint)
    lx, ly, lz = sky[SUN_DIRECTION], sky[SUN_DIRECTION + 1], sky[SUN_DIRECTION + 2]
    lr, lg, lb = read_light(scene, i, face, s, v)
    facing = max(nx * lx + ny * ly + nz * lz, 0.0) * sunlit
    red = ar * (lr + facing * sky[SUN_COLOR])
    green = ag * (lg + facing * sky[SUN_COLOR + 1])
    blue = ab * (lb + facing * sky[SUN_COLOR + 2])
    reflectance = materials[m, REFLECTANCE]
    if reflectance <= 0.0:
        return red, green, blue
    # Schlick's approximation of the Fresnel reflectance.
    fresnel = reflectance + (0.9 - reflectance) * (1.0 - cosine) ** 5 if reflectance < 0.9 else reflectance
    rx, ry, rz = dx + 2 * cosine * nx, dy + 2 * cosine * ny, dz + 2 * cosine * nz
    weight = faint_weight if fresnel < MAX_FAINT_FRESNEL else 1.0
    mr, mg, mb = 0.0, 0.0, 0.0
    if weight > 0.0:
        px, py, pz = x + SURFACE_OFFSET_METRES * nx, y + SURFACE_OFFSET_METRES * ny, z + SURFACE_OFFSET_METRES * nz
        mr, mg, mb = trace_matte(scene, px, py, pz, rx, ry, rz, footprint, 2.0 * spread, False)
        mr, mg, mb = mr * weight, mg * weight, mb * weight
    shininess = materials[m, SHININESS]
    highlight = 0.0
    if sunlit > 0.0:
        toward = max(rx * lx + ry * ly + rz * lz, 0.0)
        highlight = sunlit * 0.04 * (shininess + 8.0) * toward**shininess
    mr, mg, mb = (
        mr + highlight * sky[SUN_COLOR],
        mg + highlight * sky[SUN_COLOR + 1],
        mb + highlight * sky[SUN_COLOR + 2],
    )
    if materials[m, IS_METAL] > 0.0:
        scale = fresnel / max(materials[m, COLOR_A], materials[m, COLOR_A + 1], materials[m, COLOR_A + 2])
        return mr * ar * scale + 0.1 * red, mg * ag * scale + 0.1 * green, mb * ab * scale + 0.1 * blue
    keep = 1.0 - fresnel
    return red * keep + mr * fresnel, green * keep + mg * fresnel, blue * keep + mb * fresnel

"""The light of sun, sky and clouds in compiled code."""

from __future__ import annotations

import math

from tools.scenes.noise import clamp_unit, fractal2, kernel

# Columns of a sky; directions and colours are three numbers each.
SUN_DIRECTION, SUN_COLOR, HORIZON_COLOR, ZENITH_COLOR, GROUND_COLOR = 0, 3, 6, 9, 12
SUN_RADIUS, CLOUD_SHARE, SKY_SEED = 15, 16, 17  # the radius is in radians
SKY_COLUMN_COUNT = 18
_CLOUD_FOOTPRINT_RATIO = 0.004


@kernel
def evaluate_sky(sky, dx, dy, dz, has_disc):
    """Return the linear light (red, green, blue) from a direction; `has_disc` adds the disc of the sun itself."""
    if dz < 0.0:
        share = clamp_unit(-dz * 12.0)
        return (
            sky[HORIZON_COLOR] + (sky[GROUND_COLOR] - sky[HORIZON_COLOR]) * share,
            sky[HORIZON_COLOR + 1] + (sky[GROUND_COLOR + 1] - sky[HORIZON_COLOR + 1]) * share,
            sky[HORIZON_COLOR + 2] + (sky[GROUND_COLOR + 2] - sky[HORIZON_COLOR + 2]) * share,
        )
    haze = math.exp(-4.0 * dz)
    red = sky[ZENITH_COLOR] + (sky[HORIZON_COLOR] - sky[ZENITH_COLOR]) * haze
    green = sky[ZENITH_COLOR + 1] + (sky[HORIZON_COLOR + 1] - sky[ZENITH_COLOR + 1]) * haze
    blue = sky[ZENITH_COLOR + 2] + (sky[HORIZON_COLOR + 2] - sky[ZENITH_COLOR + 2]) * haze
    seed = int(sky[SKY_SEED])
    x, y = dx / (dz + 0.18), dy / (dz + 0.18)  # clouds lie on a plane overhead
    thickness = fractal2(x, y, 1.3, 0.55, _CLOUD_FOOTPRINT_RATIO, seed)
    density = clamp_unit((thickness + sky[CLOUD_SHARE]) * 1.6) * clamp_unit(dz * 9.0)
    shade = 0.86 - 0.22 * clamp_unit(thickness) + 0.1 * fractal2(x, y, 0.5, 0.6, 0.02, seed + 50)
    red += (1.02 * shade - red) * density
    green += (1.01 * shade - green) * density
    blue += (1.03 * shade - blue) * density
    toward = max(dx * sky[SUN_DIRECTION] + dy * sky[SUN_DIRECTION + 1] + dz * sky[SUN_DIRECTION + 2], 0.0)
    glow = 0.10 * toward**12 + 0.30 * toward**160
    if has_disc and toward > 1.0 - 0.5 * sky[SUN_RADIUS] ** 2:
        glow += 20.0
    return red + glow * sky[SUN_COLOR], green + glow * sky[SUN_COLOR + 1], blue + glow * sky[SUN_COLOR + 2]

"""Procedural textures: the albedo of a material at a surface point, averaged over the footprint of a sample.

A material is a row of numbers, whose columns are named below. Lengths are in metres.
"""

from __future__ import annotations

import math

from tools.scenes.noise import (
    clamp_unit,
    fractal2,
    fractal3,
    hash_unit,
    kernel,
    line_coverage,
    noise2,
    noise3,
    visible_share,
)

# Textures.
PLAIN, MIX, WOOD, PLANKS, BRICKS, FABRIC, CARPET, TEXT, PICTURE, TERRAZZO, STONE, FOLIAGE, STRIPES = range(13)
# Columns of a material.
TEXTURE, COLOR_A, COLOR_B = 0, 1, 4  # each colour is three columns, linear RGB
SCALE_U, SCALE_V, CONTRAST = 7, 8, 9
REFLECTANCE, SHININESS, IS_METAL = 10, 11, 12
IS_VARIED, SEED, SWAPS_AXES = 13, 14, 15  # a varied material looks different on each primitive
JOINT_GRAY, JOINT_WIDTH, STAGGER = 16, 17, 18
COLUMN_COUNT = 19

_GLYPH_COLUMNS, _GLYPH_ROWS = 5, 8  # one column and two rows of these stay empty
_MEAN_INK = 0.27


@kernel
def _ink(u, v, width, height, seed):
    """Return 1 where a page of random glyphs is printed, 0 where it is blank."""
    glyph, line = math.floor(u / width), math.floor(v / height)
    column = int((u / width - glyph) * _GLYPH_COLUMNS)
    row = int((v / height - line) * _GLYPH_ROWS)
    if column >= _GLYPH_COLUMNS - 1 or row == 0 or row >= _GLYPH_ROWS - 1:
        return 0.0
    glyph, line = int(glyph), int(line)
    if hash_unit(glyph, line, 1, seed) < 0.17 or hash_unit(glyph // 24, line, 2, seed) < 0.12:
        return 0.0
    bit = hash_unit(glyph * _GLYPH_COLUMNS + column, line * _GLYPH_ROWS + row, 3, seed)
    return 1.0 if bit > 0.42 else 0.0


@kernel
def _filtered_ink(u, v, width, height, footprint, seed):
    """Return the mean ink over a footprint, from nine samples; it fades to the mean where glyphs are too small."""
    share = visible_share(2.0 * width / _GLYPH_COLUMNS, footprint)
    if share <= 0.0:
        return _MEAN_INK
    total = 0.0
    for i in range(3):
        for j in range(3):
            total += _ink(u + (i - 1) * footprint / 3, v + (j - 1) * footprint / 3, width, height, seed)
    return _MEAN_INK + (total / 9 - _MEAN_INK) * share


@kernel
def _joints(u, v, width, height, joint, footprint):
    """Return the share of a footprint that joints around the cells of a grid cover."""
    across = min(u, width - u)
    up = min(v, height - v)
    return 1.0 - (1.0 - line_coverage(across, joint, footprint)) * (1.0 - line_coverage(up, joint, footprint))


@kernel
def _wood_tone(u, v, footprint, seed):
    """Return the position in [0, 1] between the light and the dark colour of wood whose fibres run along u."""
    bend = noise2(u * 1.3, v * 5.0, seed)
    rings = 0.5 + 0.5 * math.sin(v * 130.0 + 9.0 * bend) * visible_share(0.048, footprint)
    fibres = fractal2(u * 0.06, v, 0.022, 0.9, footprint, seed + 1)
    pores = fractal2(u * 0.2, v, 0.004, 0.9, footprint, seed + 2)
    return clamp_unit(0.2 + 0.4 * rings + 0.3 * fibres + 0.3 * max(pores, 0.0))


@kernel
def evaluate_albedo(materials, index, primitive, face, u, v, x, y, z, footprint):
    """Return the albedo (red, green, blue) of a material.

    Args:
        materials: (K, COLUMN_COUNT) table, and `index` of a row.
        primitive, face: which surface it is, so that equal shapes look different.
        u, v: coordinates on the surface; x, y, z: coordinates in space.
        footprint: side of the square that the sample covers.
    """
    texture = int(materials[index, TEXTURE])
    seed = int(materials[index, SEED]) + 31 * (face // 2)
    if materials[index, IS_VARIED] > 0:
        seed += 7 * 4099 * (primitive + 1)
    if materials[index, SWAPS_AXES] > 0:
        u, v = v, u
    width, height, contrast = materials[index, SCALE_U], materials[index, SCALE_V], materials[index, CONTRAST]
    tone, gray, gray_share, gain = 0.0, 0.0, 0.0, 1.0
    if texture == PLAIN:
        gain = 1.0 + contrast * fractal2(u, v, width, height, footprint, seed)
    elif texture == MIX:
        tone = clamp_unit(0.5 + contrast * fractal2(u, v, width, height, footprint, seed))
        gain = 1.0 + 0.12 * fractal2(u, v, 0.02, 0.8, footprint, seed + 5)
    elif texture == WOOD:
        tone = _wood_tone(u, v, footprint, seed)
        gain = 1.0 + contrast * fractal2(u, v, 0.3, 0.6, footprint, seed + 9)
    elif texture == PLANKS:
        row = math.floor(v / height)
        shifted = u + width * hash_unit(int(row), 0, 5, seed)
        column = math.floor(shifted / width)
        plank = int(hash_unit(int(column), int(row), 6, seed) * 1000003)
        shade = hash_unit(plank, 1, 0, seed) - 0.5
        tone = clamp_unit(_wood_tone(u, v, footprint, seed + plank) + 0.5 * shade)
        gain = 1.0 + contrast * shade + 0.15 * fractal2(u, v, 0.4, 0.6, footprint, seed + 9)
        gray = materials[index, JOINT_GRAY]
        gray_share = _joints(
            shifted - column * width, v - row * height, width, height, materials[index, JOINT_WIDTH], footprint
        )
    elif texture == BRICKS:
        row = math.floor(v / height)
        shifted = u + materials[index, STAGGER] * width * (int(row) & 1)
        column = math.floor(shifted / width)
        seen = visible_share(height, footprint)
        tone = clamp_unit(0.5 + seen * (hash_unit(int(column), int(row), 4, seed) - 0.5) * 1.6)
        grain = fractal2(u, v, 0.11, 0.78, footprint, seed)
        gain = (1.0 + contrast * grain) * (1.0 + 0.35 * seen * (hash_unit(int(column), int(row), 9, seed) - 0.5))
        gain *= 1.0 + 0.22 * fractal2(u, v, 2.3, 0.55, max(footprint, 0.25), seed + 17)
        gray = materials[index, JOINT_GRAY] * (1.0 + 0.5 * contrast * grain)
        wobble = 0.15 * materials[index, JOINT_WIDTH] * noise2(u * 60.0, v * 60.0, seed + 3)
        gray_share = _joints(
            shifted - column * width, v - row * height, width, height, materials[index, JOINT_WIDTH] + wobble, footprint
        )
    elif texture == FABRIC:
        weave = math.sin(u * 6.2832 / width) * math.sin(v * 6.2832 / height) * visible_share(width, footprint)
        patch = fractal2(u, v, 0.09, 0.6, max(footprint, 0.008), seed)
        tone = clamp_unit(0.5 + 2.2 * contrast * patch)
        gain = 1.0 + 0.35 * weave + 0.2 * fractal2(u, v, 0.03, 0.85, footprint, seed + 4)
    elif texture == CARPET:
        period = width
        a, b = u / period + 0.07 * noise2(v * 3, u * 3, seed), v / period
        a, b = abs(a - math.floor(a + 0.5)) * period, abs(b - math.floor(b + 0.5)) * period
        i, j = int((a + b) / height), int(abs(a - b) / height)
        seen = visible_share(height, footprint)
        tone = clamp_unit(0.5 + seen * (1.6 * hash_unit(i, j, 8, seed) - 0.8) + 0.12 * noise2(u * 9, v * 9, seed))
        gain = 1.0 + contrast * fractal2(u, v, 0.18, 0.82, footprint, seed + 2)
        gain *= 1.0 + 0.5 * seen * (hash_unit(j, i, 12, seed) - 0.5)
    elif texture == TEXT:
        tone = _filtered_ink(u, v, width, height, footprint, seed)
        gain = 1.0 + contrast * fractal2(u, v, 0.2, 0.6, footprint, seed + 2)
    elif texture == PICTURE:
        warp = 0.9 * noise2(u / width * 1.7, v / width * 1.7, seed)
        a = fractal2(u + warp * width, v + 0.5 * warp * width, width, 0.62, footprint, seed + 1)
        b = fractal2(u, v, 1.4 * width, 0.55, footprint, seed + 2)
        c = 0.75 + 0.25 * math.cos(9.0 * a * visible_share(0.2 * width, footprint))
        phase = hash_unit(seed, 1, 1, 3)
        light = c * (0.36 + 0.3 * b)
        red = clamp_unit(light * (1.0 + contrast * math.cos(4.0 * a + 6.2832 * phase)))
        green = clamp_unit(light * (1.0 + contrast * math.cos(4.0 * a + 6.2832 * phase + 1.4)))
        blue = clamp_unit(light * (1.0 + contrast * math.cos(4.0 * a + 6.2832 * phase + 2.9)))
        return red + 0.02, green + 0.02, blue + 0.02
    elif texture == TERRAZZO:
        i0, j0 = int(math.floor(u / width)), int(math.floor(v / width))
        share, chip = 0.0, 0.0
        for i in range(i0 - 1, i0 + 2):
            for j in range(j0 - 1, j0 + 2):
                size = 0.18 + 0.36 * hash_unit(i, j, 3, seed)
                du = u / width - i - hash_unit(i, j, 1, seed)
                dv = v / width - j - hash_unit(i, j, 2, seed)
                angle = 6.2832 * hash_unit(i, j, 5, seed)
                du, dv = (
                    du * math.cos(angle) - dv * math.sin(angle),
                    1.7 * (du * math.sin(angle) + dv * math.cos(angle)),
                )
                inside = clamp_unit((size - max(abs(du) + 0.4 * abs(dv), abs(dv))) * width / footprint + 0.5)
                if inside > share:
                    share, chip = inside, hash_unit(i, j, 4, seed)
        share *= visible_share(width, footprint)
        base = 1.0 + contrast * fractal2(u, v, 0.05, 0.75, footprint, seed)
        warm = 0.75 + 0.5 * hash_unit(int(chip * 999983), 7, 7, seed)
        light = 0.10 + 1.1 * chip
        red, green, blue = (
            materials[index, COLOR_A] * base,
            materials[index, COLOR_A + 1] * base,
            materials[index, COLOR_A + 2] * base,
        )
        return (
            red + (materials[index, COLOR_B] * light * warm - red) * share,
            green + (materials[index, COLOR_B + 1] * light - green) * share,
            blue + (materials[index, COLOR_B + 2] * light * (2.0 - warm) - blue) * share,
        )
    elif texture == STONE:
        warp = noise3(x / width, y / width, z / width, seed)
        vein = abs(fractal3(x, y, z + 0.4 * warp * width, width, 0.6, footprint, seed + 1))
        tone = clamp_unit(1.0 - 2.2 * vein)
        gain = 1.0 + contrast * fractal3(x, y, z, 0.06, 0.8, footprint, seed + 6)
    elif texture == FOLIAGE:
        p, q, r = x / width, y / width, z / width
        p, q = p + 0.9 * noise3(1.3 * p, 1.3 * q, 1.3 * r, seed), q + 0.9 * noise3(1.3 * p, 1.3 * q, 1.3 * r, seed + 1)
        r += 0.9 * noise3(1.3 * p, 1.3 * q, 1.3 * r, seed + 2)
        i, j, k = math.floor(p), math.floor(q), math.floor(1.4 * r)
        leaf = hash_unit(int(i), int(j), int(k), seed)
        seen = visible_share(width, footprint)
        tone = clamp_unit(
            0.45 + seen * 1.1 * (leaf - 0.5) + 0.35 * fractal3(x, y, z, 6 * width, 0.7, footprint, seed + 3)
        )
        gain = 1.0 + contrast * fractal3(x, y, z, 2.5 * width, 0.85, footprint, seed + 8)
        gain = max(gain, 0.12)
    elif texture == STRIPES:
        position = u / width - math.floor(u / width)
        edge = min(abs(position - 0.25), abs(position - 0.75)) * width
        side = 1.0 if 0.25 < position < 0.75 else -1.0
        tone = 0.5 + 0.5 * side * min(1.0, 2.0 * edge / footprint) * visible_share(width, footprint)
        gain = 1.0 + contrast * fractal2(u, v, 0.12, 0.8, footprint, seed)
    gain = max(gain, 0.05)
    keep = 1.0 - gray_share
    red = (
        materials[index, COLOR_A] + (materials[index, COLOR_B] - materials[index, COLOR_A]) * tone
    ) * gain * keep + gray * gray_share
    green = (
        materials[index, COLOR_A + 1] + (materials[index, COLOR_B + 1] - materials[index, COLOR_A + 1]) * tone
    ) * gain * keep + gray * gray_share
    blue = (
        materials[index, COLOR_A + 2] + (materials[index, COLOR_B + 2] - materials[index, COLOR_A + 2]) * tone
    ) * gain * keep + gray * gray_share
    return min(red, 0.95), min(green, 0.95), min(blue, 0.95)

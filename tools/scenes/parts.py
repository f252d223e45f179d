"""Parts that several scenes have: trees, hedges, chairs, books."""

from __future__ import annotations

import math
from collections.abc import Sequence

from tools.scenes import textures
from tools.scenes.build import Frame, SceneBuilder


def add_tree(place: Frame, height: float, crown: float, bark: int, leaves: Sequence[int], clumps: int = 24) -> None:
    """Add a tree with a trunk and a crown of overlapping clumps of leaves."""
    rng = place.builder.rng
    place.post((0, 0, 0), 0.09 * crown, 0.6 * height, bark)
    place.ellipsoid((0, 0, 0.0), (0.16 * crown, 0.16 * crown, 0.3), bark)
    for n in range(clumps):
        angle, level = 2.4 * n + rng.uniform(-0.4, 0.4), (n + rng.uniform(0.0, 1.0)) / clumps
        reach = 0.42 * crown * math.sqrt(1 - (2 * level - 1) ** 2) * rng.uniform(0.5, 1.1)
        size = crown * rng.uniform(1.5, 2.4) / math.sqrt(clumps)
        center = reach * math.cos(angle), reach * math.sin(angle), height * (0.5 + 0.45 * level)
        place.ellipsoid(center, (size, size * rng.uniform(0.7, 1.1), 0.75 * size), leaves[n % len(leaves)], angle)


def add_bush(place: Frame, width: float, height: float, leaves: Sequence[int], clumps: int = 14) -> None:
    """Add a bush of overlapping clumps of leaves, which stands on the ground."""
    rng = place.builder.rng
    for n in range(clumps):
        angle, level = 2.4 * n + rng.uniform(-0.3, 0.3), (n + rng.uniform(0.2, 0.8)) / clumps
        reach = 0.36 * width * math.sqrt(1 - level * level) * rng.uniform(0.6, 1.1)
        size = rng.uniform(1.3, 1.9) / math.sqrt(clumps)
        center = reach * math.cos(angle), reach * math.sin(angle), height * (0.14 + 0.72 * level)
        size_xy = size * width * rng.uniform(0.85, 1.15)
        place.ellipsoid(center, (size_xy, size_xy, 0.8 * size * height), leaves[n % len(leaves)], angle)


def add_chair(place: Frame, wood: int, seat: int) -> None:
    """Add a chair, 0.44 m wide, whose back is towards +y."""
    for x in (-0.19, 0.19):
        place.box((x - 0.02, -0.21, 0), (x + 0.02, -0.17, 0.43), wood)
        place.box((x - 0.02, 0.17, 0), (x + 0.02, 0.21, 0.92), wood)
        place.box((x - 0.012, -0.17, 0.18), (x + 0.012, 0.17, 0.215), wood)
    place.box((-0.17, -0.2, 0.36), (0.17, -0.175, 0.42), wood)
    place.box((-0.17, 0.178, 0.36), (0.17, 0.203, 0.42), wood)
    place.box((-0.22, -0.22, 0.43), (0.22, 0.165, 0.475), seat)
    for z in (0.58, 0.7, 0.82):
        place.box((-0.17, 0.178, z), (0.17, 0.2, z + 0.07), wood)


def add_books(place: Frame, width: float, covers: Sequence[int], tallest: float = 0.27) -> None:
    """Add upright books along x, whose spines are towards -y; a few of the last ones lie flat."""
    rng = place.builder.rng
    x = 0.0
    while True:
        thickness, height = rng.uniform(0.018, 0.055), tallest * rng.uniform(0.68, 1.0)
        if x + thickness > 0.72 * width:
            break
        depth = rng.uniform(0.13, 0.2)
        cover = covers[int(rng.integers(len(covers)))]
        place.box((x, rng.uniform(-0.012, 0.012), 0), (x + thickness - 0.002, depth, height), cover)
        x += thickness
    z = 0.0
    for _ in range(int(rng.integers(2, 5))):
        thickness = rng.uniform(0.02, 0.045)
        size = min(0.24, width - x - 0.03), rng.uniform(0.15, 0.19), thickness - 0.001
        place.block(
            (x + 0.02 + size[0] / 2, 0.1, z), size, covers[int(rng.integers(len(covers)))], rng.uniform(-0.12, 0.12)
        )
        z += thickness


def add_cover_materials(builder: SceneBuilder) -> list[int]:
    """Add the materials of printed book covers and return their numbers."""
    colors = [
        ((0.36, 0.05, 0.04), (0.85, 0.76, 0.5)),
        ((0.04, 0.09, 0.25), (0.8, 0.8, 0.75)),
        ((0.70, 0.66, 0.55), (0.1, 0.08, 0.07)),
        ((0.05, 0.18, 0.12), (0.85, 0.75, 0.4)),
        ((0.62, 0.36, 0.06), (0.08, 0.05, 0.03)),
        ((0.10, 0.10, 0.11), (0.75, 0.2, 0.12)),
        ((0.72, 0.72, 0.70), (0.6, 0.08, 0.08)),
        ((0.22, 0.10, 0.20), (0.8, 0.7, 0.75)),
    ]
    covers = [
        builder.material(
            textures.TEXT, paper, ink, scale=(size, 1.7 * size), varied=True, reflectance=0.03, swap=bool(n % 2)
        )
        for n, (paper, ink) in enumerate(colors)
        for size in (0.009, 0.015)
    ]
    return covers + [builder.material(textures.PICTURE, (0, 0, 0), scale=(0.1, 1), contrast=0.5, varied=True)]


def add_foliage_materials(builder: SceneBuilder, leaf_metres: float) -> list[int]:
    """Add the materials of three greens, with leaves of a size, and return their numbers."""
    greens = [
        ((0.025, 0.055, 0.010), (0.16, 0.24, 0.04)),
        ((0.030, 0.070, 0.018), (0.12, 0.22, 0.06)),
        ((0.045, 0.065, 0.012), (0.24, 0.27, 0.06)),
    ]
    return [builder.material(textures.FOLIAGE, *pair, scale=(leaf_metres, 1), contrast=0.55) for pair in greens]

"""The scene `object`: a toy train and small things on a garden table, photographed from three rings around it."""

from __future__ import annotations

import math

import numpy as np

from hyrfpack.cameras.paths import look_at
from tools.scenes import textures
from tools.scenes.build import Frame, SceneBuilder, make_sky
from tools.scenes.parts import add_books, add_bush, add_chair, add_cover_materials, add_foliage_materials, add_tree

TABLE_HEIGHT_METRES = 0.74
TEXEL_METRES = 0.04
FILL_LIGHT = 0.0
EXPOSURE_FACTOR = 0.95
_WORLD_UP = np.array([0.0, 0.0, 1.0])


def describe_sky(seed: int) -> np.ndarray:
    """Return the sky of a sunny afternoon."""
    return make_sky(
        (0.55, -0.50, 0.62), (2.15, 1.92, 1.62), (0.62, 0.72, 0.86), (0.12, 0.26, 0.58), (0.2, 0.2, 0.16), 0.15, seed
    )


def add_primitives(builder: SceneBuilder) -> None:
    """Add all materials and primitives."""
    world = builder.root
    leaves = add_foliage_materials(builder, 0.035)
    _add_garden(world, leaves)
    table = world.frame(0, 0, 0, 0.2)
    _add_table(table)
    top = world.frame(0, 0, TABLE_HEIGHT_METRES, 0.2)
    _add_things(top)
    _add_train(top.frame(0.0, 0.0, 0.0, 0.25))


def place_cameras(count: int, rng: np.random.Generator) -> list[np.ndarray]:
    """Return (4, 4) camera_from_world of three rings around the table."""
    poses = []
    rings = [
        (0.80, 0.30, 0.06),
        (0.86, 0.52, 0.04),
        (0.70, 0.78, 0.02),
    ]  # radius, height above the table, height aimed at
    per_ring = [len(range(n, count, 3)) for n in range(3)]
    for (radius, height, aim), photos in zip(rings, per_ring, strict=True):
        start = rng.uniform(0, 2 * math.pi)
        for n in range(photos):
            angle = start + 2 * math.pi * (n + rng.uniform(-0.15, 0.15)) / photos
            r = radius * rng.uniform(0.94, 1.08)
            position = np.array(
                [r * math.cos(angle), r * math.sin(angle), TABLE_HEIGHT_METRES + height + rng.uniform(-0.03, 0.03)]
            )
            target = np.array([*rng.uniform(-0.05, 0.05, 2), TABLE_HEIGHT_METRES + aim + rng.uniform(-0.02, 0.03)])
            roll = rng.normal() * 0.02
            up = _WORLD_UP + roll * np.array([-math.sin(angle), math.cos(angle), 0.0])
            poses.append(look_at(position, target, up / np.linalg.norm(up)))
    return poses


def _add_garden(world: Frame, leaves: list[int]) -> None:
    b = world.builder
    slabs = b.material(
        textures.BRICKS, (0.36, 0.33, 0.29), (0.24, 0.22, 0.20), scale=(0.6, 0.4), contrast=0.32, joint=(0.07, 0.012),
        stagger=0.5,
    )  # fmt: skip
    bricks = b.material(
        textures.BRICKS, (0.42, 0.17, 0.10), (0.24, 0.09, 0.06), scale=(0.22, 0.075), contrast=0.28,
        joint=(0.33, 0.011), stagger=0.5,
    )  # fmt: skip
    lawn = b.material(textures.MIX, (0.05, 0.10, 0.02), (0.17, 0.22, 0.06), scale=(0.9, 0.85), contrast=0.3)
    stone = b.material(textures.PLAIN, (0.44, 0.42, 0.38), scale=(0.3, 0.75), contrast=0.25)
    clay = b.material(textures.PLAIN, (0.45, 0.19, 0.10), scale=(0.1, 0.8), contrast=0.2)
    bark = b.material(textures.STONE, (0.10, 0.07, 0.05), (0.22, 0.17, 0.12), scale=(0.1, 1), contrast=0.4)
    boards = b.material(
        textures.PLANKS, (0.20, 0.26, 0.28), (0.11, 0.16, 0.18), scale=(2.4, 0.12), contrast=0.3, joint=(0.02, 0.008)
    )
    paint = b.material(textures.PLAIN, (0.70, 0.69, 0.64), scale=(0.2, 0.7), contrast=0.1)
    glass = b.material(textures.PLAIN, (0.02, 0.025, 0.03), contrast=0.2, reflectance=0.12, shininess=500)
    roof = b.material(
        textures.BRICKS, (0.24, 0.10, 0.07), (0.13, 0.06, 0.05), scale=(0.2, 0.14), contrast=0.3, joint=(0.03, 0.02),
        stagger=0.5,
    )  # fmt: skip
    wood = b.material(textures.WOOD, (0.42, 0.25, 0.12), (0.24, 0.12, 0.05), contrast=0.15, reflectance=0.03)
    cushion = b.material(textures.FABRIC, (0.55, 0.16, 0.10), (0.72, 0.60, 0.42), scale=(0.004, 0.004), contrast=0.4)
    world.box((-3.6, -3.4, -0.1), (3.6, 3.4, 0.0), slabs)
    world.box((-30, -30, -0.3), (30, 30, -0.04), lawn)
    world.box((-3.9, 3.4, -0.1), (3.9, 3.65, 1.35), bricks)
    world.box((-4.0, 3.34, 1.35), (4.0, 3.71, 1.43), stone)
    world.box((-3.85, -3.4, -0.1), (-3.6, 3.4, 0.75), bricks)
    world.box((-3.91, -3.46, 0.75), (-3.54, 3.34, 0.82), stone)
    for n, x in enumerate((-3.0, -1.5, 0.1, 1.6, 2.9)):
        pot = world.frame(x, 2.95)
        pot.post((0, 0, 0), 0.42 + 0.05 * (n % 2), 0.38 + 0.04 * n, clay)
        pot.post((0, 0, 0.36 + 0.04 * n), 0.48 + 0.05 * (n % 2), 0.05, clay)
        add_bush(pot.frame(0, 0, 0.36 + 0.04 * n), 0.6 + 0.1 * (n % 3), 0.6 + 0.12 * n, leaves)
    for x, y, height in (
        (-6.5, 6.5, 5.5),
        (-2.0, 8.0, 6.5),
        (2.5, 6.6, 5.2),
        (6.5, 8.2, 6.8),
        (-8, 0.5, 5.8),
        (-7, -5, 5.4),
    ):
        add_tree(world.frame(x, y), height, 0.62 * height, bark, leaves)
    for n in range(9):
        add_bush(world.frame(-5.2, -4 + n * 1.0), 1.4, 1.3 + 0.2 * (n % 3), leaves, 9)
    house = world.frame(4.6, 0.0)
    house.box((0, -4.2, -0.1), (5, 3.0, 3.1), boards)
    house.box((-0.35, -4.6, 3.1), (5.4, 3.4, 3.25), paint)
    house.box((0.2, -4.3, 3.25), (4.8, 3.1, 3.6), roof)
    for y in (-3.2, 1.0):
        house.box((-0.03, y, 0.9), (0.0, y + 1.3, 2.3), paint)
        for p in (0.08, 0.69):
            house.box((-0.04, y + p, 0.98), (0.0, y + p + 0.53, 2.22), glass)
        house.box((-0.12, y - 0.08, 0.82), (0.0, y + 1.38, 0.9), stone)
    house.box((-0.04, -1.1, 0.0), (0.0, 0.1, 2.25), paint)
    house.box((-0.05, -1.0, 0.05), (0.0, 0.0, 2.15), wood)
    house.box((-0.06, -0.85, 1.2), (0.0, -0.15, 1.95), glass)
    house.ellipsoid((-0.08, -0.12, 1.05), (0.06, 0.06, 0.06), glass)
    world.box((4.2, -1.3, -0.1), (4.6, 0.3, 0.12), stone)
    for x in range(24):  # a fence towards the sun
        world.box((-3.5 + 0.31 * x, -4.1, -0.1), (-3.28 + 0.31 * x, -4.07, 0.92 + 0.03 * (x % 3)), boards)
    world.box((-3.6, -4.06, 0.2), (4.0, -4.02, 0.3), wood)
    world.box((-3.6, -4.06, 0.65), (4.0, -4.02, 0.75), wood)
    for n in range(6):
        add_bush(world.frame(-4 + 1.7 * n, -5.6), 1.6, 1.2 + 0.3 * (n % 2), leaves, 9)
    for x, y, yaw in ((1.9, 1.3, -2.2), (-1.75, 1.5, 2.3), (-1.5, -1.9, 0.9)):
        add_chair(world.frame(x, y, 0.0, yaw), wood, cushion)


def _add_table(table: Frame) -> None:
    b = table.builder
    top = b.material(
        textures.PLANKS, (0.56, 0.36, 0.18), (0.34, 0.18, 0.08), scale=(1.1, 0.115), contrast=0.35, joint=(0.03, 0.003),
        reflectance=0.025, shininess=50,
    )  # fmt: skip
    legs = b.material(textures.WOOD, (0.45, 0.27, 0.13), (0.26, 0.13, 0.06), contrast=0.2)
    table.box((-0.72, -0.52, TABLE_HEIGHT_METRES - 0.035), (0.72, 0.52, TABLE_HEIGHT_METRES), top)
    table.box((-0.62, -0.42, TABLE_HEIGHT_METRES - 0.12), (0.62, 0.42, TABLE_HEIGHT_METRES - 0.04), legs)
    for x in (-0.6, 0.6):
        for y in (-0.4, 0.4):
            table.box((x - 0.04, y - 0.04, 0), (x + 0.04, y + 0.04, TABLE_HEIGHT_METRES - 0.04), legs)


def _add_things(top: Frame) -> None:
    """Add what lies around the train: cloth, newspaper, books, cups, fruit."""
    b = top.builder
    cloth = b.material(textures.CARPET, (0.62, 0.55, 0.42), (0.16, 0.24, 0.34), scale=(0.19, 0.016), contrast=0.22)
    paper = b.material(textures.TEXT, (0.72, 0.70, 0.64), (0.07, 0.07, 0.08), scale=(0.0065, 0.011), contrast=0.08)
    headline = b.material(textures.TEXT, (0.74, 0.72, 0.66), (0.08, 0.08, 0.09), scale=(0.025, 0.04), contrast=0.08)
    photo = b.material(textures.PICTURE, (0, 0, 0), scale=(0.06, 1), contrast=0.45, varied=True)
    glaze = b.material(
        textures.STONE,
        (0.72, 0.72, 0.70),
        (0.10, 0.18, 0.42),
        scale=(0.05, 1),
        contrast=0.08,
        reflectance=0.05,
        shininess=200,
    )
    coffee = b.material(textures.PLAIN, (0.05, 0.025, 0.01), contrast=0.2, reflectance=0.03, shininess=300)
    orange = b.material(
        textures.STONE, (0.75, 0.27, 0.02), (0.80, 0.36, 0.04), scale=(0.02, 1), contrast=0.25, reflectance=0.03
    )
    apple = b.material(
        textures.STONE,
        (0.50, 0.04, 0.03),
        (0.60, 0.42, 0.10),
        scale=(0.04, 1),
        contrast=0.2,
        reflectance=0.05,
        shininess=120,
    )
    covers = add_cover_materials(b)
    stone = b.material(
        textures.TERRAZZO,
        (0.60, 0.58, 0.54),
        (0.5, 0.4, 0.32),
        scale=(0.012, 1),
        contrast=0.15,
        reflectance=0.04,
        shininess=120,
    )
    top.box((-0.46, -0.21, 0), (0.46, 0.21, 0.0015), cloth)
    news = top.frame(-0.42, -0.33, 0.0, 0.35)
    news.box((-0.15, -0.11, 0), (0.15, 0.11, 0.003), paper)
    news.box((-0.14, 0.06, 0.003), (0.14, 0.10, 0.0034), headline)
    news.box((-0.02, -0.06, 0.003), (0.13, 0.045, 0.0034), photo)
    top.block((0.5, 0.34, 0.0), (0.24, 0.17, 0.035), covers[4], 0.3)
    top.block((0.49, 0.35, 0.035), (0.2, 0.14, 0.03), covers[1], 0.1)
    top.block((0.5, 0.35, 0.065), (0.17, 0.12, 0.022), covers[-1], 0.6)
    stand = top.frame(-0.58, 0.33, 0.0, 0.5)
    add_books(stand, 0.3, covers, 0.2)
    for x, y in ((0.42, -0.36), (-0.2, 0.38)):
        cup = top.frame(x, y)
        cup.post((0, 0, 0), 0.15, 0.008, glaze)
        cup.post((0, 0, 0.008), 0.05, 0.012, glaze)
        cup.post((0, 0, 0.02), 0.082, 0.06, glaze)
        cup.post((0, 0, 0.0785), 0.07, 0.0025, coffee)
        cup.bar((0.05, 0, 0.05), 0.045, 0.012, glaze)
    bowl = top.frame(0.14, 0.36)
    bowl.post((0, 0, 0), 0.2, 0.012, stone)
    for n, (x, y, z) in enumerate(((0, 0.05, 0), (0.055, -0.02, 0), (-0.05, -0.03, 0), (0.0, 0.005, 0.055))):
        bowl.ellipsoid((x, y, 0.048 + z), (0.076, 0.076, 0.072), apple if n % 2 else orange)
    top.ellipsoid((0.28, -0.38, 0.036), (0.078, 0.078, 0.072), orange)
    for n in range(7):  # building blocks
        side = 0.034
        x, y, z = (0.02 + 0.05 * (n % 3), -0.34 + 0.045 * (n // 3 % 2), side * (n // 6))
        block = (covers[2 * n % len(covers)], photo)[n % 2]
        top.block((x, y, z), (side, side, side), block, 0.35 * n)


def _add_train(place: Frame) -> None:
    """Add an engine and a wagon along x on a piece of track, 0.7 m long."""
    b = place.builder
    red = b.material(
        textures.PLAIN, (0.50, 0.035, 0.03), scale=(0.05, 0.8), contrast=0.14, reflectance=0.045, shininess=250
    )
    green = b.material(
        textures.PLAIN, (0.03, 0.18, 0.09), scale=(0.05, 0.8), contrast=0.16, reflectance=0.045, shininess=250
    )
    black = b.material(
        textures.PLAIN, (0.035, 0.035, 0.038), scale=(0.03, 0.8), contrast=0.3, reflectance=0.04, shininess=80
    )
    brass = b.material(
        textures.PLAIN,
        (0.80, 0.55, 0.20),
        scale=(0.03, 0.7),
        contrast=0.12,
        reflectance=0.85,
        shininess=150,
        metal=True,
    )
    wood = b.material(textures.WOOD, (0.60, 0.40, 0.20), (0.38, 0.21, 0.09), contrast=0.25)
    label = b.material(
        textures.TEXT, (0.70, 0.62, 0.40), (0.25, 0.04, 0.03), scale=(0.014, 0.022), contrast=0.1, varied=True
    )
    coal = b.material(textures.STONE, (0.02, 0.02, 0.022), (0.10, 0.10, 0.10), scale=(0.02, 1), contrast=0.5)
    crate = b.material(
        textures.PLANKS,
        (0.55, 0.38, 0.20),
        (0.36, 0.22, 0.10),
        scale=(0.2, 0.014),
        contrast=0.3,
        joint=(0.02, 0.0015),
        varied=True,
    )
    marble = b.material(
        textures.TERRAZZO,
        (0.55, 0.53, 0.50),
        (0.45, 0.36, 0.3),
        scale=(0.008, 1),
        contrast=0.2,
        reflectance=0.04,
        shininess=200,
    )
    for y in (-0.035, 0.035):  # rails and sleepers
        place.box((-0.40, y - 0.004, 0.010), (0.40, y + 0.004, 0.020), brass)
    for n in range(16):
        x = -0.39 + 0.052 * n
        place.box((x - 0.012, -0.058, 0.0015), (x + 0.012, 0.058, 0.010), wood)
    engine = place.frame(0.13, 0.0, 0.020)
    engine.box((-0.16, -0.048, 0.028), (0.17, 0.048, 0.044), red)
    engine.bar((0.045, 0, 0.088), 0.084, 0.21, green, math.pi / 2)
    for x in (-0.05, 0.0, 0.06, 0.12):
        engine.bar((x, 0, 0.088), 0.088, 0.008, brass, math.pi / 2)
    engine.bar((0.155, 0, 0.088), 0.076, 0.02, black, math.pi / 2)
    engine.ellipsoid((0.167, 0, 0.088), (0.012, 0.05, 0.05), brass)
    engine.post((0.115, 0, 0.122), 0.034, 0.055, black)
    engine.post((0.115, 0, 0.173), 0.046, 0.014, brass)
    engine.ellipsoid((0.045, 0, 0.130), (0.046, 0.046, 0.046), brass)
    engine.post((0.0, 0, 0.126), 0.018, 0.03, brass)
    engine.ellipsoid((0.0, 0, 0.158), (0.024, 0.024, 0.02), brass)
    engine.box((-0.155, -0.052, 0.044), (-0.065, 0.052, 0.105), red)
    for x in (-0.152, -0.072):
        for y in (-0.047, 0.047):
            engine.box((x - 0.004, y - 0.004, 0.105), (x + 0.004, y + 0.004, 0.160), red)
    engine.box((-0.168, -0.062, 0.160), (-0.055, 0.062, 0.168), black)
    engine.box((-0.14, -0.0535, 0.055), (-0.08, 0.0535, 0.095), label)
    engine.box((0.168, -0.055, 0.022), (0.180, 0.055, 0.050), red)
    for y in (-0.036, 0.036):
        engine.bar((0.188, y, 0.038), 0.02, 0.018, brass, math.pi / 2)
    for x, d in ((-0.12, 0.058), (-0.055, 0.058), (0.02, 0.058), (0.09, 0.040), (0.14, 0.040)):
        for y in (-0.050, 0.050):
            engine.bar((x, y, d / 2), d, 0.010, black)
            engine.bar((x, y * 1.02, d / 2), 0.8 * d, 0.012, red)
            engine.bar((x, y * 1.06, d / 2), 0.25 * d, 0.014, brass)
    for y in (-0.0585, 0.0585):
        engine.box((-0.13, y - 0.002, 0.020), (0.03, y + 0.002, 0.027), brass)
    engine.ellipsoid((-0.11, 0.0, 0.118), (0.04, 0.04, 0.045), wood)  # the driver
    engine.ellipsoid((-0.11, 0.0, 0.146), (0.026, 0.026, 0.028), marble)
    wagon = place.frame(-0.22, 0.0, 0.020)
    wagon.box((-0.13, -0.05, 0.028), (0.13, 0.05, 0.040), black)
    for y in (-0.051, 0.051):
        wagon.box((-0.13, y - 0.004, 0.040), (0.13, y + 0.004, 0.085), crate)
        wagon.box((-0.05, y - 0.006, 0.048), (0.05, y + 0.006, 0.076), label)
    for x in (-0.128, 0.128):
        wagon.box((x - 0.004, -0.047, 0.040), (x + 0.004, 0.047, 0.085), crate)
    wagon.box((-0.124, -0.047, 0.040), (0.124, 0.047, 0.070), coal)
    for n in range(16):
        x, y = -0.1 + 0.028 * (n % 8), -0.022 + 0.044 * (n // 8)
        size = b.rng.uniform(0.022, 0.04, 3).tolist()
        wagon.ellipsoid((x, y, 0.074), size, coal, float(n))
    wagon.block((-0.075, 0.0, 0.085), (0.05, 0.06, 0.045), crate, 0.3)
    wagon.block((0.07, 0.0, 0.085), (0.06, 0.05, 0.05), label, -0.2)
    wagon.ellipsoid((0.0, 0.0, 0.108), (0.055, 0.055, 0.055), marble)
    for x in (-0.085, 0.085):
        for y in (-0.048, 0.048):
            wagon.bar((x, y, 0.020), 0.040, 0.010, black)
            wagon.bar((x, y * 1.03, 0.020), 0.030, 0.012, red)
    place.bar((-0.06, 0, 0.052), 0.008, 0.07, brass, math.pi / 2)

"""The scene `room`: a furnished living room by day, photographed by a person who walks through it and looks around."""

from __future__ import annotations

import math

import numpy as np

from hyrfpack.cameras.paths import look_at
from tools.scenes import textures
from tools.scenes.build import Frame, SceneBuilder, make_sky
from tools.scenes.parts import add_books, add_bush, add_chair, add_cover_materials, add_foliage_materials, add_tree

ROOM_WIDTH, ROOM_DEPTH, ROOM_HEIGHT = 5.2, 4.4, 2.6  # metres along x, y, z
TEXEL_METRES = 0.08
EXPOSURE_FACTOR = 8.5
FILL_LIGHT = 0.015  # light of lamps, and the lift of shadows that phones apply indoors
_WORLD_UP = np.array([0.0, 0.0, 1.0])
_INWARD_PHOTO_SHARE = 0.6  # These look across the room, the others at the nearest wall.


def describe_sky(seed: int) -> np.ndarray:
    """Return the sky of a sunny morning, with the sun in the windows."""
    return make_sky(
        (0.42, 0.62, 0.60),
        (1.0, 0.9, 0.78),
        (0.44, 0.49, 0.56),
        (0.27, 0.36, 0.50),
        (0.25, 0.25, 0.2),
        0.2,
        seed,
        0.012,
    )


def add_primitives(builder: SceneBuilder) -> None:
    """Add all materials and primitives."""
    world = builder.root
    wood = builder.material(textures.WOOD, (0.46, 0.28, 0.14), (0.27, 0.14, 0.06), contrast=0.2, reflectance=0.03)
    white = builder.material(textures.PLAIN, (0.74, 0.73, 0.69), scale=(0.4, 0.72), contrast=0.1)
    _add_walls(world, wood, white)
    _add_outside(world)
    _add_table(world.frame(2.75, 2.15, 0.0, 0.12), wood)
    _add_shelf(world.frame(0.03, 2.75, 0.0, -math.pi / 2), wood)
    _add_sofa(world.frame(2.5, 0.55))
    _add_sideboard(world.frame(4.93, 2.95, 0.0, -math.pi / 2), wood, white)
    _add_corners(world, wood, white)


def place_cameras(count: int, rng: np.random.Generator) -> list[np.ndarray]:
    """Return (4, 4) camera_from_world: a walk around the table that looks across it, then one that looks outwards."""
    poses = []
    across = round(_INWARD_PHOTO_SHARE * count)
    for n in range(count):
        looks_across = n < across
        step = n / across if looks_across else (n - across) / (count - across)
        angle = 2 * math.pi * (step + rng.uniform(-0.004, 0.004)) + 0.3
        reach = 1.0 if looks_across else 0.7
        position = np.array(
            [
                2.65 + reach * 1.6 * math.cos(angle),
                2.2 + reach * 1.15 * math.sin(angle),
                1.48 + 0.07 * math.sin(5 * angle) + rng.uniform(-0.02, 0.02),
            ]
        )
        sway = 0.22 * math.sin(7 * angle)
        heading = angle + sway + (math.pi if looks_across else 0.0)
        pitch = math.radians(-16 if looks_across else -9) + 0.1 * math.sin(3 * angle + 1.0)
        forward = np.array([math.cos(heading) * math.cos(pitch), math.sin(heading) * math.cos(pitch), math.sin(pitch)])
        side = np.array([-math.sin(heading), math.cos(heading), 0.0])
        up = _WORLD_UP + 0.02 * rng.normal() * side
        poses.append(look_at(position, position + forward, up / np.linalg.norm(up)))
    return poses


def _add_walls(world: Frame, wood: int, white: int) -> None:
    b = world.builder
    floor = b.material(
        textures.PLANKS, (0.47, 0.29, 0.15), (0.27, 0.15, 0.07), scale=(1.3, 0.14), contrast=0.45, joint=(0.02, 0.003),
        reflectance=0.03, shininess=90,
    )  # fmt: skip
    paper = b.material(textures.FABRIC, (0.50, 0.53, 0.44), (0.66, 0.64, 0.52), scale=(0.006, 0.006), contrast=0.25)
    plaster = b.material(textures.PLAIN, (0.68, 0.64, 0.56), scale=(0.5, 0.8), contrast=0.11)
    brick = b.material(
        textures.BRICKS, (0.55, 0.30, 0.20), (0.34, 0.17, 0.11), scale=(0.23, 0.075), contrast=0.3, joint=(0.42, 0.011),
        stagger=0.5,
    )  # fmt: skip
    glass = b.material(textures.PLAIN, (0.02, 0.02, 0.02), contrast=0.1, reflectance=0.05, shininess=500)
    w, d, h, t = ROOM_WIDTH, ROOM_DEPTH, ROOM_HEIGHT, 0.25
    world.box((-t, -t, -0.2), (w + t, d + t, 0.0), floor)
    world.box((-t, -t, h), (w + t, d + t, h + 0.25), white)
    world.box((-t, -t, 0), (0.0, d + t, h), plaster)
    world.box((0, -t, 0), (w, 0.0, h), brick)
    # The wall y = ROOM_DEPTH has a window, the wall x = ROOM_WIDTH a glass door.
    world.box((0, d, 0), (1.3, d + t, h), paper)
    world.box((3.7, d, 0), (w, d + t, h), paper)
    world.box((1.3, d, 0), (3.7, d + t, 0.85), paper)
    world.box((1.3, d, 2.25), (3.7, d + t, h), paper)
    world.box((w, 0, 0), (w + t, 0.5, h), paper)
    world.box((w, 1.75, 0), (w + t, d + t, h), paper)
    world.box((w, 0.5, 2.15), (w + t, 1.75, h), paper)
    for low, high in (
        ((1.3, d + 0.1, 0.85), (3.7, d + 0.16, 0.92)),
        ((1.3, d + 0.1, 2.18), (3.7, d + 0.16, 2.25)),
        ((1.3, d + 0.1, 0.92), (1.37, d + 0.16, 2.18)),
        ((3.63, d + 0.1, 0.92), (3.7, d + 0.16, 2.18)),
        ((2.46, d + 0.1, 0.92), (2.54, d + 0.16, 2.18)),
        ((1.37, d + 0.115, 1.78), (3.63, d + 0.145, 1.82)),
        ((1.22, d - 0.14, 0.81), (3.78, d + 0.1, 0.85)),
        ((w + 0.1, 0.5, 0.0), (w + 0.16, 0.58, 2.15)),
        ((w + 0.1, 1.67, 0.0), (w + 0.16, 1.75, 2.15)),
        ((w + 0.1, 0.58, 2.07), (w + 0.16, 1.67, 2.15)),
        ((w + 0.1, 0.58, 0.0), (w + 0.16, 1.67, 0.14)),
        ((w + 0.115, 0.58, 1.0), (w + 0.145, 1.67, 1.06)),
    ):
        world.box(low, high, white)
    for low, high in (
        ((0.0, 0.0, 0.0), (0.015, d, 0.09)),
        ((0.0, d - 0.015, 0.0), (w, d, 0.09)),
        ((0.0, 0.0, 0.0), (w, 0.015, 0.09)),
        ((w - 0.015, 1.75, 0.0), (w, d, 0.09)),
        ((0.0, 0.0, h - 0.06), (w, 0.05, h)),
        ((0.0, 0.0, h - 0.06), (0.05, d, h)),
        ((0.0, d - 0.05, h - 0.06), (w, d, h)),
        ((w - 0.05, 0.0, h - 0.06), (w, d, h)),
    ):
        world.box(low, high, white)
    curtain = b.material(textures.STRIPES, (0.52, 0.28, 0.16), (0.68, 0.58, 0.42), scale=(0.07, 1), contrast=0.2)
    world.bar((2.5, d - 0.1, 2.36), 0.03, 3.1, wood, math.pi / 2)
    for start in (0.98, 3.62):
        for n in range(7):
            x = start + 0.05 + 0.06 * n
            world.ellipsoid((x, d - 0.1, 1.22), (0.075, 0.1, 2.5), curtain)
    for n in range(11):  # radiator
        x = 1.75 + 0.14 * n
        world.box((x, d - 0.11, 0.14), (x + 0.11, d - 0.03, 0.70), white)
    _add_pictures(world, wood, glass)


def _add_pictures(world: Frame, wood: int, glass: int) -> None:
    b = world.builder
    art = b.material(
        textures.PICTURE, (0, 0, 0), scale=(0.28, 1), contrast=0.5, varied=True, reflectance=0.03, shininess=400
    )
    print_ = b.material(
        textures.TEXT, (0.70, 0.66, 0.56), (0.35, 0.06, 0.05), scale=(0.035, 0.055), contrast=0.1, varied=True
    )
    map_ = b.material(
        textures.MIX, (0.20, 0.38, 0.52), (0.60, 0.52, 0.32), scale=(0.3, 0.68), contrast=1.6, varied=True
    )
    mount = b.material(textures.PLAIN, (0.72, 0.70, 0.64), scale=(0.2, 0.7), contrast=0.06)
    walls = {
        "left": (
            world.frame(0.0, 0.0, 0.0, math.pi / 2),
            [(3.55, 1.5, 0.75, 0.55, art), (0.55, 1.45, 0.45, 0.6, print_)],
        ),
        "back": (
            world.frame(0.0, 0.0, 0.0, 0.0),
            [
                (1.5, 1.55, 0.5, 0.7, art),
                (2.45, 1.62, 0.9, 0.62, map_),
                (3.3, 1.78, 0.4, 0.32, art),
                (3.3, 1.38, 0.4, 0.3, print_),
                (4.25, 1.55, 0.62, 0.84, art),
                (0.62, 1.75, 0.42, 0.42, print_),
            ],
        ),
        "right": (
            world.frame(ROOM_WIDTH, 0.0, 0.0, math.pi / 2),
            [(2.4, 1.6, 0.6, 0.8, art), (3.75, 1.62, 0.7, 0.5, map_)],
        ),
        "front": (world.frame(0.0, ROOM_DEPTH, 0.0, 0.0), [(0.5, 1.6, 0.55, 0.75, art), (4.6, 1.6, 0.6, 0.6, print_)]),
    }
    for name, (wall, pictures) in walls.items():
        side = {"left": -1, "back": 1, "right": 1, "front": -1}[name]
        for x, z, width, height, motif in pictures:

            def panel(w: float, h: float, depth: float, material: int, wall=wall, x=x, z=z, side=side) -> None:
                ends = sorted((0.0, side * depth))
                wall.box((x - w / 2, ends[0], z - h / 2), (x + w / 2, ends[1], z + h / 2), material)

            panel(width, height, 0.022, mount)
            panel(width - 0.12, height - 0.12, 0.024, motif)
            for dx in (-1, 1):
                edge = x + dx * width / 2
                ends = sorted((0.0, side * 0.035))
                wall.box(
                    (edge - 0.02, ends[0], z - height / 2 - 0.02), (edge + 0.02, ends[1], z + height / 2 + 0.02), wood
                )
                edge = z + dx * height / 2
                wall.box(
                    (x - width / 2 + 0.02, ends[0], edge - 0.02), (x + width / 2 - 0.02, ends[1], edge + 0.02), wood
                )


def _add_outside(world: Frame) -> None:
    b = world.builder
    leaves = add_foliage_materials(b, 0.09)
    lawn = b.material(textures.MIX, (0.07, 0.13, 0.03), (0.2, 0.25, 0.08), scale=(1.2, 0.85), contrast=0.3)
    bark = b.material(textures.STONE, (0.10, 0.07, 0.05), (0.22, 0.17, 0.12), scale=(0.1, 1), contrast=0.4)
    house = b.material(
        textures.BRICKS, (0.55, 0.46, 0.34), (0.40, 0.32, 0.22), scale=(0.4, 0.2), contrast=0.3, joint=(0.3, 0.015),
        stagger=0.5,
    )  # fmt: skip
    dark = b.material(textures.PLAIN, (0.03, 0.035, 0.05), contrast=0.2, reflectance=0.1, shininess=500)
    world.box((-40, -40, -0.6), (60, 60, -0.35), lawn)
    for n in range(12):
        add_bush(world.frame(-3 + 1.1 * n, ROOM_DEPTH + 5.5, -0.35), 1.7, 1.1 + 0.25 * (n % 3), leaves, 9)
        if n < 8:
            add_bush(world.frame(ROOM_WIDTH + 5.5, -2.5 + 1.1 * n, -0.35), 1.7, 1.2 + 0.25 * (n % 2), leaves, 9)
    for x, y, height in ((0.5, 15.0, 7.0), (5.5, 19.0, 9.0), (13.0, 3.5, 7.0), (15, -3.0, 8.0)):
        add_tree(world.frame(x, y, -0.35), height, 0.6 * height, bark, leaves)
    world.box((-6, 26, -0.4), (8, 30, 3.8), house)
    for n in range(5):
        world.box((-5 + 2.6 * n, 25.9, 1.0), (-3.7 + 2.6 * n, 26.0, 2.6), dark)


def _add_table(table: Frame, wood: int) -> None:
    b = table.builder
    carpet = b.material(textures.CARPET, (0.46, 0.10, 0.07), (0.55, 0.45, 0.28), scale=(0.85, 0.062), contrast=0.3)
    fringe = b.material(textures.STRIPES, (0.62, 0.56, 0.42), (0.35, 0.28, 0.2), scale=(0.012, 1), contrast=0.3)
    top = b.material(
        textures.WOOD, (0.50, 0.30, 0.15), (0.30, 0.15, 0.07), contrast=0.25, reflectance=0.035, shininess=150
    )
    seat = b.material(textures.FABRIC, (0.16, 0.26, 0.36), (0.50, 0.47, 0.36), scale=(0.006, 0.006), contrast=0.5)
    table.box((-1.3, -0.95, 0.0), (1.3, 0.95, 0.012), carpet)
    for side in (-1, 1):
        ends = sorted((side * 1.3, side * 1.37))
        table.box((ends[0], -0.95, 0.0), (ends[1], 0.95, 0.006), fringe)
    table.box((-0.68, -0.42, 0.715), (0.68, 0.42, 0.75), top)
    table.box((-0.6, -0.34, 0.63), (0.6, 0.34, 0.715), wood)
    for x in (-0.6, 0.6):
        for y in (-0.34, 0.34):
            table.post((x, y, 0.012), 0.055, 0.703, wood)
            table.ellipsoid((x, y, 0.5), (0.085, 0.085, 0.12), wood)
    for x, y, yaw in (
        (-0.35, -0.55, 3.2),
        (0.38, -0.5, 3.0),
        (-0.3, 0.55, 0.1),
        (0.42, 0.58, -0.3),
        (0.98, 0.0, -1.45),
    ):
        add_chair(table.frame(x, y, 0.012, yaw), wood, seat)
    runner = b.material(textures.CARPET, (0.60, 0.55, 0.42), (0.15, 0.27, 0.22), scale=(0.2, 0.02), contrast=0.2)
    paper = b.material(
        textures.TEXT, (0.70, 0.69, 0.64), (0.07, 0.07, 0.08), scale=(0.012, 0.019), contrast=0.08, varied=True
    )
    glaze = b.material(
        textures.STONE,
        (0.70, 0.70, 0.68),
        (0.10, 0.20, 0.44),
        scale=(0.06, 1),
        contrast=0.1,
        reflectance=0.05,
        shininess=300,
    )
    fruit = b.material(
        textures.STONE, (0.65, 0.10, 0.04), (0.72, 0.50, 0.12), scale=(0.04, 1), contrast=0.2, reflectance=0.04
    )
    steel = b.material(textures.PLAIN, (0.70, 0.70, 0.72), contrast=0.1, reflectance=0.75, shininess=300, metal=True)
    things = table.frame(0, 0, 0.75)
    things.box((-0.2, -0.42, 0), (0.2, 0.42, 0.002), runner)
    things.block((-0.45, 0.12, 0.0), (0.3, 0.21, 0.006), paper, 0.4)
    things.block((-0.47, 0.14, 0.006), (0.28, 0.2, 0.008), paper, 0.9)
    for x, y in ((0.43, -0.2), (0.45, 0.22), (-0.42, -0.22)):
        things.post((x, y, 0), 0.16, 0.009, glaze)
        things.post((x, y, 0.009), 0.075, 0.075, glaze)
        things.post((x + 0.11, y + 0.08, 0), 0.055, 0.12, steel)
    things.post((0, 0, 0.002), 0.26, 0.03, glaze)
    for n in range(6):
        angle = 1.05 * n
        things.ellipsoid((0.075 * math.cos(angle), 0.075 * math.sin(angle), 0.062), (0.075, 0.075, 0.07), fruit)
    things.ellipsoid((0.0, 0.0, 0.085), (0.08, 0.08, 0.075), fruit)


def _add_shelf(shelf: Frame, wood: int) -> None:
    """Add a shelf with books; it stands with its back at y = 0 and is 1.9 m wide along x."""
    b = shelf.builder
    covers = add_cover_materials(b)
    jug = b.material(
        textures.STONE, (0.60, 0.50, 0.36), (0.18, 0.26, 0.30), scale=(0.08, 1), contrast=0.15, reflectance=0.04
    )
    width, height, depth = 1.9, 2.05, 0.3
    shelf.box((0, 0, 0), (width, 0.015, height), wood)
    for x in (0.0, width / 2 - 0.0125, width - 0.025):
        shelf.box((x, 0.015, 0), (x + 0.025, depth, height), wood)
    levels = [0.06, 0.45, 0.84, 1.2, 1.56, height - 0.025]
    for z in levels:
        for x in (0.025, width / 2 + 0.0125):
            shelf.box((x, 0.015, z), (x + width / 2 - 0.0375, depth - 0.004, z + 0.025), wood)
    for n, z in enumerate(levels[:-1]):
        for side in range(2):
            x = 0.03 + side * (width / 2 - 0.01)
            # Books face the room, which is towards +y of the shelf.
            row = shelf.frame(x + width / 2 - 0.06, 0.27, z + 0.025, math.pi)
            add_books(row, width / 2 - 0.06, covers, 0.31 if n < 2 else 0.27)
    for n in range(4):
        place = shelf.frame(0.25 + 0.45 * n, 0.15, height)
        place.post((0, 0, 0), 0.09, 0.03, jug)
        place.ellipsoid((0, 0, 0.12), (0.17, 0.17, 0.2), jug)
        place.post((0, 0, 0.2), 0.06, 0.06 + 0.02 * n, jug)


def _add_sofa(sofa: Frame) -> None:
    b = sofa.builder
    cloth = b.material(textures.FABRIC, (0.22, 0.27, 0.24), (0.40, 0.42, 0.34), scale=(0.007, 0.007), contrast=0.4)
    stripes = b.material(textures.STRIPES, (0.60, 0.22, 0.10), (0.66, 0.60, 0.46), scale=(0.05, 1), contrast=0.25)
    pattern = b.material(textures.CARPET, (0.12, 0.24, 0.36), (0.66, 0.56, 0.34), scale=(0.2, 0.022), contrast=0.2)
    sofa.box((-1.0, -0.5, 0.08), (1.0, 0.35, 0.36), cloth)
    sofa.box((-1.0, -0.5, 0.36), (1.0, -0.3, 0.82), cloth)
    for side in (-1, 1):
        ends = sorted((side * 1.0, side * 1.18))
        sofa.box((ends[0], -0.5, 0.08), (ends[1], 0.37, 0.6), cloth)
        sofa.bar((side * 1.09, -0.065, 0.6), 0.2, 0.87, cloth)
        sofa.box((side * 0.03 - 0.47 + side * 0.47, -0.3, 0.36), (side * 0.03 + 0.47 + side * 0.47, 0.36, 0.48), cloth)
    for x, material, size in (
        (-0.75, stripes, 0.42),
        (-0.35, pattern, 0.38),
        (0.8, pattern, 0.42),
        (0.45, stripes, 0.36),
    ):
        sofa.ellipsoid((x, -0.2, 0.48 + size / 2), (size, 0.2, size), material)
    blanket = b.material(textures.CARPET, (0.56, 0.50, 0.40), (0.42, 0.12, 0.08), scale=(0.3, 0.03), contrast=0.3)
    sofa.box((-0.15, -0.515, 0.4), (0.25, -0.28, 0.835), blanket)


def _add_sideboard(board: Frame, wood: int, white: int) -> None:
    """Add a sideboard with its back at y = +0.25, towards the wall, and things on it."""
    b = board.builder
    covers = add_cover_materials(b)
    front = b.material(textures.WOOD, (0.36, 0.20, 0.10), (0.20, 0.10, 0.05), contrast=0.3, reflectance=0.03, swap=True)
    brass = b.material(textures.PLAIN, (0.78, 0.56, 0.24), contrast=0.1, reflectance=0.8, shininess=150, metal=True)
    screen = b.material(textures.PLAIN, (0.01, 0.01, 0.012), contrast=0.1, reflectance=0.06, shininess=800)
    box = b.material(
        textures.TEXT, (0.55, 0.48, 0.36), (0.1, 0.25, 0.3), scale=(0.02, 0.03), contrast=0.15, varied=True
    )
    clay = b.material(textures.STONE, (0.42, 0.20, 0.12), (0.62, 0.42, 0.28), scale=(0.1, 1), contrast=0.2)
    leaves = add_foliage_materials(b, 0.04)
    board.box((-0.85, -0.22, 0.08), (0.85, 0.25, 0.72), wood)
    board.box((-0.88, -0.24, 0.72), (0.88, 0.25, 0.75), wood)
    for n in range(3):
        for level in range(2):
            x, z = -0.8 + 0.54 * n, 0.12 + 0.3 * level
            board.box((x, -0.235, z), (x + 0.52, -0.22, z + 0.28), front)
            board.ellipsoid((x + 0.26, -0.245, z + 0.15), (0.035, 0.035, 0.035), brass)
    top = board.frame(0, 0, 0.75)
    top.box((-0.42, 0.1, 0.06), (0.42, 0.13, 0.56), screen)
    top.box((-0.43, 0.105, 0.05), (0.43, 0.135, 0.57), white)
    top.block((0, 0.1, 0), (0.3, 0.16, 0.02), screen)
    top.post((0, 0.12, 0.02), 0.05, 0.05, screen)
    top.post((0.65, 0.0, 0), 0.2, 0.18, clay)
    add_bush(top.frame(0.65, 0.0, 0.18), 0.42, 0.5, leaves)
    top.block((-0.62, 0.0, 0), (0.3, 0.22, 0.14), box, 0.15)
    top.block((-0.62, 0.02, 0.14), (0.22, 0.16, 0.05), covers[3], -0.2)
    top.block((-0.63, 0.02, 0.19), (0.18, 0.13, 0.03), covers[6], 0.3)


def _add_corners(world: Frame, wood: int, white: int) -> None:
    """Add a floor lamp, plants, a lamp above the table, boxes and a chest."""
    b = world.builder
    leaves = add_foliage_materials(b, 0.05)
    shade = b.material(textures.STRIPES, (0.72, 0.62, 0.42), (0.60, 0.46, 0.28), scale=(0.03, 1), contrast=0.15)
    black = b.material(textures.PLAIN, (0.04, 0.04, 0.045), contrast=0.2, reflectance=0.04, shininess=100)
    basket = b.material(
        textures.BRICKS,
        (0.48, 0.34, 0.18),
        (0.30, 0.19, 0.09),
        scale=(0.05, 0.018),
        contrast=0.4,
        joint=(0.06, 0.004),
        stagger=0.5,
    )
    carton = b.material(
        textures.TEXT, (0.46, 0.34, 0.21), (0.08, 0.06, 0.05), scale=(0.03, 0.05), contrast=0.15, varied=True
    )
    lamp = world.frame(0.5, 0.45)
    lamp.post((0, 0, 0), 0.3, 0.03, black)
    lamp.post((0, 0, 0.03), 0.03, 1.45, black)
    lamp.post((0, 0, 1.4), 0.42, 0.32, shade)
    pendant = world.frame(2.75, 2.15)
    pendant.post((0, 0, 2.05), 0.015, 0.55, black)
    pendant.ellipsoid((0, 0, 1.98), (0.46, 0.46, 0.3), shade)
    pendant.post((0, 0, 2.1), 0.12, 0.06, black)
    for x, y, height in ((4.75, 4.0, 1.3), (0.55, 3.95, 1.05)):
        pot = world.frame(x, y)
        pot.post((0, 0, 0), 0.34, 0.34, basket)
        pot.post((0, 0, 0.3), 0.04, 0.45, wood)
        add_bush(pot.frame(0, 0, 0.35), 0.62, height, leaves, 16)
    chest = world.frame(4.6, 0.28)
    chest.block((0.2, 0.0, 0), (0.5, 0.4, 0.4), carton, 0.1)
    chest.block((0.22, 0.0, 0.4), (0.38, 0.3, 0.28), carton, -0.15)
    chest.block((0.18, 0.0, 0.68), (0.26, 0.2, 0.12), carton, 0.3)
    chest.block((-0.4, 0.05, 0), (0.4, 0.34, 0.26), basket, 0.0)
    sill = world.frame(0, ROOM_DEPTH - 0.03, 0.85)
    for n, x in enumerate((1.5, 2.05, 2.9, 3.4)):
        sill.post((x, 0, 0), 0.12, 0.12, basket if n % 2 else white)
        add_bush(sill.frame(x, 0, 0.1), 0.24, 0.26, leaves, 8)

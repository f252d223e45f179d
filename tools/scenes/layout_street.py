"""The scene `street`: a row of house fronts, photographed by a person who walks along the road."""

from __future__ import annotations

import math

import numpy as np

from hyrfpack.cameras.paths import look_at
from tools.scenes import textures
from tools.scenes.build import Frame, SceneBuilder, make_sky
from tools.scenes.parts import add_bush, add_foliage_materials, add_tree

TEXEL_METRES = 0.25
FILL_LIGHT = 0.0
EXPOSURE_FACTOR = 0.95
_WORLD_UP = np.array([0.0, 0.0, 1.0])
_HOUSE_WIDTHS_METRES = (6.2, 5.2, 7.4, 5.6, 6.6, 5.8, 7.0)
_ROW_START_X_METRES = -22.0
_WALK_METRES = 24.0  # length of the walk, whose middle is at x = 0
_KERB_Y_METRES, _FAR_KERB_Y_METRES = -2.6, -8.6  # the fronts are at y = 0


def describe_sky(seed: int) -> np.ndarray:
    """Return the sky of a summer day with clouds."""
    return make_sky(
        (-0.52, -0.58, 0.63), (2.2, 2.0, 1.7), (0.62, 0.73, 0.88), (0.10, 0.24, 0.58), (0.2, 0.19, 0.17), 0.0, seed
    )


def add_primitives(builder: SceneBuilder) -> None:
    """Add all materials and primitives."""
    world = builder.root
    leaves = add_foliage_materials(builder, 0.07)
    _add_ground(world)
    _add_row(world)
    _add_opposite_side(world, leaves)
    _add_street_things(world, leaves)
    _add_car(world.frame(-3.2, -3.75, 0.0, 0.0), (0.05, 0.12, 0.30))
    _add_car(world.frame(7.5, -3.8, 0.0, 0.0), (0.45, 0.05, 0.04))


def place_cameras(count: int, rng: np.random.Generator) -> list[np.ndarray]:
    """Return (4, 4) camera_from_world of two walks: along the far pavement, and back on the road."""
    poses = []
    first = count // 2
    for n in range(count):
        is_far = n < first
        step = n / max(first - 1, 1) if is_far else 1 - (n - first) / max(count - first - 1, 1)
        x = (step - 0.5) * _WALK_METRES + rng.uniform(-0.08, 0.08)
        y = (-9.6 if is_far else -6.4) + 0.25 * math.sin(2.1 * n) + rng.uniform(-0.05, 0.05)
        position = np.array([x, y, 1.58 + rng.uniform(-0.04, 0.04)])
        # Each three photos look obliquely back, at the fronts and obliquely ahead.
        turn = math.radians((-32, 0, 32)[n % 3] if is_far else (-42, -12, 38)[n % 3]) + rng.uniform(-0.06, 0.06)
        pitch = math.radians(7 if is_far else 10) + rng.uniform(-0.03, 0.03)
        forward = np.array([math.sin(turn) * math.cos(pitch), math.cos(turn) * math.cos(pitch), math.sin(pitch)])
        up = _WORLD_UP + 0.015 * rng.normal() * np.array([math.cos(turn), -math.sin(turn), 0.0])
        poses.append(look_at(position, position + forward, up / np.linalg.norm(up)))
    return poses


def _add_ground(world: Frame) -> None:
    b = world.builder
    asphalt = b.material(textures.MIX, (0.075, 0.075, 0.08), (0.16, 0.155, 0.15), scale=(1.4, 0.86), contrast=0.32)
    slabs = b.material(
        textures.BRICKS, (0.40, 0.38, 0.35), (0.27, 0.26, 0.25), scale=(0.5, 0.5), contrast=0.32, joint=(0.09, 0.012),
        stagger=0.5,
    )  # fmt: skip
    kerb = b.material(
        textures.BRICKS, (0.46, 0.45, 0.43), (0.34, 0.33, 0.32), scale=(0.9, 0.9), contrast=0.35, joint=(0.1, 0.01)
    )
    paint = b.material(textures.MIX, (0.60, 0.60, 0.57), (0.30, 0.30, 0.29), scale=(0.15, 0.85), contrast=0.55)
    iron = b.material(textures.CARPET, (0.08, 0.075, 0.07), (0.17, 0.15, 0.14), scale=(0.2, 0.022), contrast=0.3)
    patch = b.material(textures.MIX, (0.045, 0.045, 0.05), (0.10, 0.10, 0.10), scale=(0.5, 0.85), contrast=0.35)
    world.box((-70, -60, -0.4), (70, 60, -0.12), asphalt)
    world.box((-60, _KERB_Y_METRES, -0.4), (60, 0.5, 0.0), slabs)
    world.box((-60, _FAR_KERB_Y_METRES - 2.6, -0.4), (60, _FAR_KERB_Y_METRES, 0.0), slabs)
    world.box((-60, _KERB_Y_METRES - 0.14, -0.4), (60, _KERB_Y_METRES, 0.012), kerb)
    world.box((-60, _FAR_KERB_Y_METRES, -0.4), (60, _FAR_KERB_Y_METRES + 0.14, 0.012), kerb)
    for n in range(24):
        world.box((-36 + 3.0 * n, -5.66, -0.14), (-34.4 + 3.0 * n, -5.54, -0.117), paint)
    for x, y, size in ((-7.2, -4.6, 0.62), (2.6, -6.6, 0.62), (10.5, -4.9, 0.62)):
        world.post((x, y, -0.15), size, 0.036, iron)
        world.post((x, y, -0.15), 1.18 * size, 0.033, patch)
    for low, high in (((-11, -7.6), (-7.6, -6.2)), ((0.5, -5.2), (2.0, -3.0)), ((5.2, -8.3), (9.4, -7.1))):
        world.box((*low, -0.16), (*high, -0.118), patch)


def _add_row(world: Frame) -> None:
    b = world.builder

    def bricks(first: tuple, second: tuple, mortar: float) -> int:
        return b.material(
            textures.BRICKS, first, second, scale=(0.24, 0.078), contrast=0.28, joint=(mortar, 0.012), stagger=0.5
        )

    fronts = [
        bricks((0.42, 0.17, 0.10), (0.26, 0.10, 0.06), 0.34),
        b.material(textures.PLAIN, (0.60, 0.50, 0.32), scale=(1.1, 0.78), contrast=0.15),
        bricks((0.48, 0.38, 0.25), (0.34, 0.25, 0.15), 0.24),
        b.material(textures.PLAIN, (0.36, 0.45, 0.47), scale=(1.3, 0.78), contrast=0.15),
        bricks((0.30, 0.13, 0.10), (0.17, 0.08, 0.07), 0.30),
        b.material(
            textures.BRICKS, (0.52, 0.48, 0.41), (0.40, 0.36, 0.30), scale=(0.7, 0.34), contrast=0.3,
            joint=(0.22, 0.014), stagger=0.5,
        ),
        b.material(textures.PLAIN, (0.55, 0.34, 0.25), scale=(0.9, 0.78), contrast=0.16),
    ]  # fmt: skip
    x = _ROW_START_X_METRES
    for n, width in enumerate(_HOUSE_WIDTHS_METRES):
        _add_house(world.frame(x, 0.05 * (n % 3)), n, width, fronts[n])
        x += width
    for side in (_ROW_START_X_METRES - 9.0, x):  # plain houses continue the row at both ends
        world.box((side, 0.6, -0.2), (side + 9.0, 8, 7.0), fronts[4])


def _add_house(house: Frame, number: int, width: float, front: int) -> None:
    """Add a house whose front stands at y = 0, from x = 0 to `width`."""
    b = house.builder
    rng = b.rng
    trim_color = [(0.68, 0.66, 0.60), (0.62, 0.60, 0.50), (0.52, 0.50, 0.46), (0.72, 0.70, 0.66)][number % 4]
    door_color = [(0.06, 0.16, 0.12), (0.32, 0.05, 0.04), (0.08, 0.12, 0.26), (0.30, 0.18, 0.08)][number % 4]
    trim = b.material(textures.PLAIN, trim_color, scale=(0.3, 0.75), contrast=0.14)
    sill = b.material(textures.PLAIN, (0.45, 0.43, 0.40), scale=(0.3, 0.8), contrast=0.22)
    glass = b.material(
        textures.PLAIN, (0.025, 0.03, 0.035), scale=(0.4, 0.6), contrast=0.3, reflectance=0.14, shininess=700
    )
    curtain = b.material(
        textures.STRIPES,
        (0.52, 0.50, 0.46),
        (0.36, 0.34, 0.32),
        scale=(0.09, 1),
        contrast=0.2,
        reflectance=0.10,
        shininess=700,
    )
    door = b.material(
        textures.PLANKS,
        door_color,
        [0.6 * c for c in door_color],
        scale=(2.2, 0.16),
        contrast=0.25,
        joint=(0.02, 0.008),
        swap=True,
    )
    base = b.material(
        textures.BRICKS, (0.33, 0.31, 0.29), (0.24, 0.23, 0.22), scale=(0.6, 0.3), contrast=0.35, joint=(0.12, 0.012),
        stagger=0.5,
    )  # fmt: skip
    roof = b.material(
        textures.BRICKS, (0.28, 0.12, 0.08), (0.16, 0.07, 0.06), scale=(0.24, 0.2), contrast=0.35, joint=(0.03, 0.03),
        stagger=0.5,
    )  # fmt: skip
    brass = b.material(textures.PLAIN, (0.75, 0.55, 0.25), contrast=0.1, reflectance=0.8, shininess=150, metal=True)
    pipe = b.material(textures.PLAIN, (0.16, 0.16, 0.165), scale=(0.3, 0.75), contrast=0.25)
    floors = 2 + number % 2
    floor_height = 2.9 + 0.15 * (number % 3)
    height = 0.45 + floors * floor_height
    house.box((0, 0, -0.2), (width, 8, height), front)
    house.box((-0.0, -0.05, -0.2), (width, 0, 0.5), base)
    for n in range(5):  # the roof rises in steps of tiles
        house.box((0.0, 0.42 * n - 0.28, height + 0.16 + 0.30 * n), (width, 8, height + 0.46 + 0.30 * n), roof)
    house.box((-0.02, -0.30, height - 0.04), (width + 0.02, 0.1, height + 0.16), trim)
    house.box((0.0, -0.16, height - 0.22), (width, 0.0, height - 0.04), trim)
    house.box((0.0, -0.07, 0.45 + floor_height - 0.12), (width, 0.0, 0.45 + floor_height + 0.06), trim)
    house.bar((width / 2, -0.36, height + 0.14), 0.13, width, pipe, math.pi / 2)
    house.post((0.12, -0.09, 0.0), 0.1, height, pipe)
    for level in (1.0, 3.0, 5.0):
        house.post((0.12, -0.09, level), 0.13, 0.06, pipe)
    house.block((0.3 * width, 1.8, height + 1.0), (0.7, 0.6, 1.7), front)
    for x in (-0.16, 0.16):
        house.post((0.3 * width + x, 1.8, height + 2.7), 0.2, 0.4, roof)
    columns = 2 if width < 5.7 else 3
    door_column = number % columns
    pitch = width / columns
    for floor in range(floors):
        for column in range(columns):
            x, z = (column + 0.5) * pitch + (0.06 if column == 0 else 0.0), 0.45 + floor * floor_height
            if floor == 0 and column == door_column:
                _add_door(house.frame(x, 0.0), trim, door, glass, brass, sill, number)
                continue
            w, h = (1.25 if columns == 2 else 1.12), 1.55 if floor < 2 else 1.3
            _add_window(house.frame(x, 0.0, z + 0.75), w, h, trim, sill, glass, curtain, bool(rng.uniform() < 0.45))
            if rng.uniform() < 0.3 and floor:
                for side in (-1, 1):  # shutters
                    ends = sorted((side * (w / 2 + 0.06), side * (w / 2 + 0.46)))
                    house.box((x + ends[0], -0.045, z + 0.75), (x + ends[1], 0.0, z + 0.75 + h), door)
    if number in (1, 4):  # a shop sign and an awning
        letters = b.material(textures.TEXT, trim_color, door_color, scale=(0.26, 0.42), contrast=0.1, varied=True)
        cloth = b.material(textures.STRIPES, (0.62, 0.60, 0.54), (0.40, 0.06, 0.05), scale=(0.36, 1), contrast=0.12)
        house.box((0.5, -0.12, 2.85), (width - 0.4, 0.0, 3.27), letters)
        for n in range(6):
            house.box((0.5, -0.30 - 0.18 * n, 2.70 - 0.06 * n), (width - 0.4, -0.12 - 0.18 * n, 2.76 - 0.06 * n), cloth)


def _add_window(
    place: Frame, width: float, height: float, trim: int, sill: int, glass: int, curtain: int, has_curtain: bool
) -> None:
    """Add a window whose lower edge is at z = 0 and whose middle is at x = 0."""
    w, h = width / 2, height
    place.box((-w, -0.012, 0), (w, 0.0, h), glass)
    if has_curtain:
        for side in (-1, 1):
            ends = sorted((side * 0.35 * w, side * (w - 0.02)))
            place.box((ends[0], -0.014, 0.04), (ends[1], -0.012, h - 0.03), curtain)
    for x0, x1 in ((-w - 0.09, -w), (w, w + 0.09)):
        place.box((x0, -0.085, 0), (x1, 0.0, h), trim)
    place.box((-w - 0.13, -0.11, h), (w + 0.13, 0.0, h + 0.16), trim)
    place.box((-w - 0.16, -0.19, -0.08), (w + 0.16, 0.0, 0.0), sill)
    place.box((-0.03, -0.055, 0), (0.03, -0.012, h), trim)
    place.box((-w, -0.05, 0.62 * h - 0.025), (w, -0.012, 0.62 * h + 0.025), trim)
    for x in (-w + 0.025, w - 0.025):
        place.box((x - 0.025, -0.045, 0), (x + 0.025, -0.012, h), trim)
    place.box((-w, -0.045, 0.0), (w, -0.012, 0.05), trim)


def _add_door(place: Frame, trim: int, door: int, glass: int, brass: int, stone: int, number: int) -> None:
    """Add a door with two steps, a fan light and a house number."""
    b = place.builder
    plate = b.material(textures.TEXT, (0.05, 0.10, 0.30), (0.75, 0.75, 0.72), scale=(0.07, 0.13), varied=True)
    place.box((-0.9, -0.75, -0.1), (0.9, 0.0, 0.16), stone)
    place.box((-0.75, -0.42, 0.16), (0.75, 0.0, 0.33), stone)
    place.box((-0.5, -0.02, 0.33), (0.5, 0.0, 2.35), door)
    for x in (-0.42, 0.06):
        for z, h in ((0.5, 0.6), (1.25, 0.75)):
            place.box((x, -0.04, z), (x + 0.36, -0.02, z + h), door)
    place.box((-0.5, -0.03, 2.4), (0.5, 0.0, 2.75), glass)
    place.box((-0.5, -0.05, 2.33), (0.5, 0.0, 2.4), trim)
    for x0, x1 in ((-0.64, -0.5), (0.5, 0.64)):
        place.box((x0, -0.12, 0.33), (x1, 0.0, 2.75), trim)
    place.box((-0.75, -0.2, 2.75), (0.75, 0.0, 2.95), trim)
    place.ellipsoid((0.4, -0.06, 1.18), (0.08, 0.08, 0.08), brass)
    place.box((-0.16, -0.045, 1.15), (0.16, -0.035, 1.21), brass)
    place.box((0.72, -0.015, 1.75), (0.94, 0.0, 1.92), plate)


def _add_opposite_side(world: Frame, leaves: list[int]) -> None:
    """Add what windows and cars reflect: houses behind the cameras."""
    b = world.builder
    fronts = [
        b.material(textures.PLAIN, color, scale=(1.0, 0.75), contrast=0.15)
        for color in ((0.55, 0.46, 0.33), (0.42, 0.20, 0.14), (0.50, 0.50, 0.46))
    ]
    dark = b.material(textures.PLAIN, (0.05, 0.055, 0.06), contrast=0.3)
    for n in range(8):
        x, height = -32 + 8.2 * n, 4.2 + 0.9 * (n % 3)
        world.box((x, -22, -0.2), (x + 7.6, -14.5, height), fronts[n % 3])
        for k in range(4):
            world.box((x + 0.6 + 1.7 * k, -14.52, 1.2), (x + 1.6 + 1.7 * k, -14.4, 2.7), dark)
    for n in range(10):
        add_bush(world.frame(-26 + 5.6 * n, -13.0), 2.0, 1.2 + 0.3 * (n % 2), leaves)


def _add_street_things(world: Frame, leaves: list[int]) -> None:
    b = world.builder
    bark = b.material(textures.STONE, (0.10, 0.075, 0.055), (0.24, 0.19, 0.14), scale=(0.12, 1), contrast=0.45)
    soil = b.material(textures.MIX, (0.06, 0.045, 0.03), (0.16, 0.12, 0.08), scale=(0.2, 0.85), contrast=0.4)
    steel = b.material(textures.PLAIN, (0.14, 0.15, 0.15), scale=(0.2, 0.75), contrast=0.25, reflectance=0.04)
    green = b.material(textures.PLAIN, (0.06, 0.16, 0.09), scale=(0.2, 0.8), contrast=0.25, reflectance=0.04)
    wood = b.material(textures.WOOD, (0.42, 0.27, 0.14), (0.25, 0.14, 0.07), contrast=0.25)
    clay = b.material(textures.PLAIN, (0.44, 0.20, 0.11), scale=(0.12, 0.8), contrast=0.22)
    carton = b.material(
        textures.TEXT, (0.46, 0.34, 0.21), (0.08, 0.06, 0.05), scale=(0.04, 0.065), contrast=0.15, varied=True
    )
    poster = b.material(textures.PICTURE, (0, 0, 0), scale=(0.35, 1), contrast=0.5, varied=True)
    sign = b.material(textures.TEXT, (0.70, 0.70, 0.66), (0.55, 0.05, 0.04), scale=(0.11, 0.2), varied=True)
    for x in (-11.0, 1.8, 13.0):
        place = world.frame(x, _KERB_Y_METRES + 0.75)
        place.box((-0.5, -0.5, -0.1), (0.5, 0.5, 0.015), soil)
        add_tree(place, 4.6, 2.5, bark, leaves, 70)
    for x in (-7.0, 6.2):  # street lamps
        place = world.frame(x, _KERB_Y_METRES + 0.35)
        place.post((0, 0, 0), 0.2, 0.5, steel)
        place.post((0, 0, 0.5), 0.1, 3.7, steel)
        place.block((0, -0.3, 4.15), (0.16, 0.7, 0.08), steel)
        place.ellipsoid((0, -0.55, 4.12), (0.26, 0.4, 0.14), sign)
        place.block((0, -0.06, 2.2), (0.5, 0.02, 0.36), sign)
    column = world.frame(10.3, -2.0)  # an advertising column
    column.post((0, 0, 0), 1.1, 0.3, steel)
    column.post((0, 0, 0.3), 1.0, 2.1, poster)
    column.post((0, 0, 2.4), 1.2, 0.15, steel)
    column.ellipsoid((0, 0, 2.55), (1.0, 1.0, 0.6), green)
    bench = world.frame(-14.6, -1.7)
    for n in range(5):
        bench.box((-0.8, -0.24 + 0.1 * n, 0.43), (0.8, -0.16 + 0.1 * n, 0.46), wood)
    for z in (0.6, 0.72, 0.84):
        bench.box((-0.8, 0.26, z), (0.8, 0.29, z + 0.08), wood)
    for x in (-0.65, 0.65):
        bench.box((x - 0.03, -0.22, 0), (x + 0.03, 0.3, 0.43), steel)
        bench.box((x - 0.03, 0.29, 0.43), (x + 0.03, 0.32, 0.92), steel)
    for n, x in enumerate((-4.6, -3.9, 4.4)):  # bins
        place = world.frame(x, -0.45)
        place.block((0, 0, 0.06), (0.56, 0.6, 0.9), green if n % 2 else steel)
        place.block((0, -0.02, 0.96), (0.6, 0.66, 0.07), steel)
        place.block((0, -0.302, 0.45), (0.3, 0.006, 0.2), sign)
    heap = world.frame(-0.4, -0.75)
    for x, y, z, size, yaw in ((0, 0, 0, 0.55, 0.2), (0.6, 0.05, 0, 0.42, -0.3), (0.08, 0.0, 0.44, 0.4, 0.6)):
        heap.block((x, y, z), (size, 0.8 * size, 0.8 * size), carton, yaw)
    for n, x in enumerate((-17.2, -9.4, -6.1, 3.2, 8.3, 12.2, 15.6)):
        pot = world.frame(x, -0.5)
        pot.post((0, 0, 0), 0.46, 0.42, clay)
        pot.post((0, 0, 0.4), 0.52, 0.06, clay)
        add_bush(pot.frame(0, 0, 0.4), 0.7, 0.7 + 0.15 * (n % 3), leaves)
    for n in range(12):  # bollards
        place = world.frame(-16.5 + 3.0 * n, _KERB_Y_METRES + 0.22)
        place.post((0, 0, 0), 0.12, 0.8, steel)
        place.ellipsoid((0, 0, 0.8), (0.16, 0.16, 0.14), steel)


def _add_car(car: Frame, color: tuple[float, float, float]) -> None:
    """Add a parked car along x, 4 m long, on the road."""
    b = car.builder
    body = b.material(textures.PLAIN, color, scale=(0.5, 0.6), contrast=0.05, reflectance=0.07, shininess=500)
    glass = b.material(textures.PLAIN, (0.015, 0.02, 0.022), contrast=0.2, reflectance=0.10, shininess=800)
    rubber = b.material(textures.PLAIN, (0.03, 0.03, 0.032), scale=(0.1, 0.8), contrast=0.35)
    alloy = b.material(
        textures.PLAIN, (0.55, 0.55, 0.57), scale=(0.08, 0.7), contrast=0.15, reflectance=0.4, shininess=80, metal=True
    )
    lamp = b.material(
        textures.STRIPES, (0.70, 0.70, 0.66), (0.45, 0.45, 0.44), scale=(0.03, 1), reflectance=0.06, shininess=400
    )
    red = b.material(
        textures.STRIPES, (0.45, 0.02, 0.02), (0.25, 0.01, 0.01), scale=(0.03, 1), reflectance=0.05, shininess=400
    )
    plate = b.material(textures.TEXT, (0.68, 0.66, 0.55), (0.03, 0.03, 0.03), scale=(0.06, 0.11), varied=True)
    ground = car.frame(0, 0, -0.12)
    ground.box((-1.95, -0.80, 0.30), (1.95, 0.80, 0.72), body)
    ground.ellipsoid((1.35, 0, 0.66), (1.9, 1.58, 0.5), body)
    ground.ellipsoid((-1.45, 0, 0.68), (1.4, 1.58, 0.55), body)
    ground.ellipsoid((-0.2, 0, 0.80), (2.7, 1.52, 1.24), glass)
    ground.ellipsoid((-0.22, 0, 1.06), (1.95, 1.44, 0.82), body)
    for y in (-0.81, 0.81):
        ground.box((-1.9, y - 0.02, 0.40), (1.9, y + 0.02, 0.46), rubber)
        ground.box((-0.06, y - 0.012, 0.34), (-0.04, y + 0.012, 0.72), rubber)
        for x in (-0.5, 0.75):
            ground.box((x - 0.1, y - 0.025, 0.62), (x + 0.1, y + 0.025, 0.65), alloy)
        for x in (-1.22, 1.22):
            ground.bar((x, y * 0.93, 0.32), 0.64, 0.2, rubber)
            ground.bar((x, y * 0.95, 0.32), 0.42, 0.2, alloy)
            ground.bar((x, y * 0.955, 0.32), 0.12, 0.21, rubber)
        ground.ellipsoid((0.72, y * 1.08, 0.92), (0.16, 0.14, 0.14), body)
    for y in (-0.58, 0.58):
        ground.ellipsoid((1.93, y, 0.6), (0.14, 0.3, 0.16), lamp)
        ground.ellipsoid((-1.93, y, 0.62), (0.12, 0.24, 0.18), red)
    for x in (-1.97, 1.97):
        ground.box((x - 0.05, -0.82, 0.28), (x + 0.05, 0.82, 0.44), rubber)
        ground.box((x - 0.06, -0.25, 0.46), (x + 0.06, 0.25, 0.57), plate)

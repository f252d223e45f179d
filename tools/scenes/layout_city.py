"""The scene `city`: sixteen blocks of buildings, photographed by a drone and from the streets between them."""

from __future__ import annotations

import math

import numpy as np

from hyrfpack.cameras.paths import look_at
from tools.scenes import textures
from tools.scenes.build import Frame, SceneBuilder, make_sky
from tools.scenes.parts import add_foliage_materials, add_tree

TEXEL_METRES = 1.5
FILL_LIGHT = 0.0
EXPOSURE_FACTOR = 0.9
BLOCKS_PER_SIDE = 4
BLOCK_METRES, STREET_METRES = 40.0, 12.0
PITCH_METRES = BLOCK_METRES + STREET_METRES
_LOT_METRES = BLOCK_METRES / 3
_FLOOR_METRES = 3.1
_MIN_FLOORS, _MAX_FLOORS = 2, 8
_DRONE_PHOTO_SHARE = 0.6  # The other photos are taken in the streets.
_DRONE_HEIGHT_METRES = 70.0  # At this height, neighbouring photos of a hundred overlap by more than half.
_OBLIQUE_PITCH_DEGREES = 48.0
_HALF_CITY_METRES = BLOCKS_PER_SIDE * PITCH_METRES / 2
_WORLD_UP = np.array([0.0, 0.0, 1.0])


def describe_sky(seed: int) -> np.ndarray:
    """Return the sky of a clear morning with some clouds."""
    return make_sky(
        (0.55, -0.45, 0.70), (2.2, 2.05, 1.8), (0.62, 0.73, 0.88), (0.12, 0.27, 0.60), (0.2, 0.19, 0.17), -0.1, seed
    )


def add_primitives(builder: SceneBuilder) -> None:
    """Add all materials and primitives."""
    world, rng = builder.root, builder.rng
    parts = _CityMaterials(builder)
    _add_streets(world, parts)
    for column in range(BLOCKS_PER_SIDE):
        for row in range(BLOCKS_PER_SIDE):
            center = [(number - (BLOCKS_PER_SIDE - 1) / 2) * PITCH_METRES for number in (column, row)]
            _add_block(world.frame(*center), parts, rng)


def place_cameras(count: int, rng: np.random.Generator) -> list[np.ndarray]:
    """Return (4, 4) camera_from_world of a drone's flight in lanes, and of walks along all streets."""
    drone_count = math.ceil(_DRONE_PHOTO_SHARE * count)
    return [*_place_drone_cameras(drone_count, rng), *_place_street_cameras(count - drone_count, rng)]


def _place_drone_cameras(count: int, rng: np.random.Generator) -> list[np.ndarray]:
    """Return poses on lanes over the city: of each five photos, one looks down and four look obliquely around."""
    lanes = max(1, round(math.sqrt(count)))
    poses = []
    for n in range(count):
        lane, place = divmod(n * lanes / count, 1)
        along = (place if int(lane) % 2 == 0 else 1 - place) - 0.5
        across = (lane + 0.5) / lanes - 0.5
        position = np.array(
            [2 * _HALF_CITY_METRES * along, 2 * _HALF_CITY_METRES * across, _DRONE_HEIGHT_METRES]
        ) + rng.uniform(-2, 2, 3)
        turn, kind = math.pi / 2 * (n % 5) + rng.uniform(-0.1, 0.1), n % 5
        pitch = math.radians(88 if kind == 4 else _OBLIQUE_PITCH_DEGREES) + rng.uniform(-0.02, 0.02)
        poses.append(_make_pose(position, turn, -pitch))
    return poses


def _place_street_cameras(count: int, rng: np.random.Generator) -> list[np.ndarray]:
    """Return poses in the middle of the streets between blocks, which look ahead and to both sides."""
    streets = 2 * (BLOCKS_PER_SIDE - 1)
    poses = []
    for n in range(count):
        street, step = n % streets, (n // streets + 0.5) / math.ceil(count / streets)
        along = (2 * step - 1) * (_HALF_CITY_METRES - STREET_METRES / 2)
        across = (street // 2 + 1 - BLOCKS_PER_SIDE / 2) * PITCH_METRES + rng.uniform(-1.2, 1.2)
        is_northward = street % 2 == 0
        position = np.array([across, along, 0.0] if is_northward else [along, across, 0.0])
        position[2] = 1.7 + rng.uniform(-0.1, 0.1)
        turn = math.pi / 2 * is_northward + math.radians((0, 40, -40, 180, 140, -140)[n // streets % 6])
        poses.append(_make_pose(position, turn + rng.uniform(-0.1, 0.1), math.radians(12)))
    return poses


def _make_pose(position: np.ndarray, turn: float, pitch: float) -> np.ndarray:
    forward = np.array([math.cos(turn) * math.cos(pitch), math.sin(turn) * math.cos(pitch), math.sin(pitch)])
    return look_at(position, position + forward, _WORLD_UP)


class _CityMaterials:
    """The materials of the city, each of which is varied from primitive to primitive where that suits it."""

    def __init__(self, builder: SceneBuilder) -> None:
        add = builder.material
        self.asphalt = add(textures.MIX, (0.075, 0.075, 0.08), (0.16, 0.155, 0.15), scale=(3.0, 0.86), contrast=0.32)
        self.paint = add(textures.MIX, (0.60, 0.60, 0.57), (0.40, 0.40, 0.38), scale=(0.3, 0.8), contrast=0.4)
        self.slabs = add(
            textures.BRICKS, (0.42, 0.40, 0.36), (0.28, 0.27, 0.25), scale=(1.2, 1.2), contrast=0.3, joint=(0.1, 0.05),
            stagger=0.5,
        )  # fmt: skip
        self.grass = add(textures.MIX, (0.05, 0.10, 0.02), (0.16, 0.22, 0.05), scale=(1.5, 0.86), contrast=0.5)
        self.gravel = add(textures.MIX, (0.22, 0.21, 0.20), (0.38, 0.37, 0.35), scale=(1.0, 0.88), contrast=0.4)
        self.steel = add(textures.PLAIN, (0.30, 0.31, 0.32), scale=(0.8, 0.75), contrast=0.2, varied=True)
        self.shop = add(
            textures.TEXT, (0.55, 0.50, 0.40), (0.10, 0.05, 0.05), scale=(0.6, 0.9), contrast=0.2, varied=True
        )
        self.walls = [
            add(
                textures.BRICKS, first, second, scale=(0.5, 0.25), contrast=0.3, joint=(0.30, 0.03), stagger=0.5,
                varied=True,
            )
            for first, second in (
                ((0.42, 0.17, 0.10), (0.26, 0.10, 0.06)),
                ((0.55, 0.45, 0.30), (0.40, 0.30, 0.18)),
                ((0.50, 0.48, 0.44), (0.36, 0.34, 0.32)),
            )
        ] + [
            add(textures.PLAIN, color, scale=(2.5, 0.78), contrast=0.2, varied=True)
            for color in ((0.60, 0.52, 0.36), (0.36, 0.44, 0.47), (0.55, 0.34, 0.25), (0.62, 0.60, 0.56))
        ]  # fmt: skip
        self.windows = [
            add(
                textures.BRICKS, (0.04, 0.06, 0.08), lit, scale=(width, _FLOOR_METRES), contrast=0.2,
                joint=(gray, pillar), reflectance=0.06, shininess=400, varied=True,
            )
            for width, pillar, gray, lit in (
                (1.8, 0.8, 0.42, (0.20, 0.19, 0.16)),
                (1.3, 0.5, 0.25, (0.10, 0.14, 0.18)),
                (2.6, 0.5, 0.52, (0.14, 0.12, 0.10)),
            )
        ]  # fmt: skip
        self.paints = [
            add(textures.PLAIN, color, contrast=0.06, reflectance=0.05, shininess=300)
            for color in ((0.05, 0.12, 0.30), (0.45, 0.05, 0.04), (0.50, 0.50, 0.50), (0.03, 0.03, 0.03))
        ]
        self.bark = add(textures.MIX, (0.10, 0.07, 0.05), (0.20, 0.15, 0.11), scale=(0.15, 0.85), contrast=0.5)
        self.leaves = add_foliage_materials(builder, 0.25)


def _add_streets(world: Frame, parts: _CityMaterials) -> None:
    reach = _HALF_CITY_METRES + 80
    world.box((-reach, -reach, -0.6), (reach, reach, -0.15), parts.grass)
    world.box(
        (-_HALF_CITY_METRES, -_HALF_CITY_METRES, -0.6), (_HALF_CITY_METRES, _HALF_CITY_METRES, 0.0), parts.asphalt
    )
    for street in range(1, BLOCKS_PER_SIDE):
        across = (street - BLOCKS_PER_SIDE / 2) * PITCH_METRES
        for n in range(round(2 * _HALF_CITY_METRES / 8)):
            along = -_HALF_CITY_METRES + 8 * n
            world.box((across - 0.12, along, -0.02), (across + 0.12, along + 4, 0.006), parts.paint)
            world.box((along, across - 0.12, -0.02), (along + 4, across + 0.12, 0.005), parts.paint)


def _add_block(block: Frame, parts: _CityMaterials, rng: np.random.Generator) -> None:
    """Add a block: buildings on the lots around a courtyard, trees, and cars at the kerb."""
    half = BLOCK_METRES / 2
    block.box((-half, -half, -0.5), (half, half, 0.15), parts.slabs)
    for column in range(3):
        for row in range(3):
            lot = block.frame((column - 1) * _LOT_METRES, (row - 1) * _LOT_METRES, 0.15)
            if (column, row) == (1, 1) or rng.random() < 0.15:
                _add_garden(lot, parts, rng)
            else:
                _add_building(lot, parts, rng)
    for side in range(4):
        kerb = block.frame(0, 0, 0, math.pi / 2 * side)
        for n in range(int(rng.integers(1, 4))):
            _add_car(kerb.frame(-14 + 11 * n + rng.uniform(-2, 2), half + 1.3), parts, rng)


def _add_garden(lot: Frame, parts: _CityMaterials, rng: np.random.Generator) -> None:
    half = _LOT_METRES / 2 - 1
    lot.box((-half, -half, -0.1), (half, half, 0.05), parts.grass)
    for n in range(int(rng.integers(1, 4))):
        place = lot.frame(rng.uniform(-half, half) / 2, (n - 1) * 3.5, 0.0)
        add_tree(place, rng.uniform(5, 9), rng.uniform(3, 5), parts.bark, parts.leaves, 12)


def _add_building(lot: Frame, parts: _CityMaterials, rng: np.random.Generator) -> None:
    """Add a building with a band of windows around each floor, a shop front and things on its roof."""
    x, y = rng.uniform(0.38, 0.47, 2) * _LOT_METRES
    floors = int(rng.integers(_MIN_FLOORS, _MAX_FLOORS + 1))
    height = floors * _FLOOR_METRES
    wall, window = (choices[int(rng.integers(len(choices)))] for choices in (parts.walls, parts.windows))
    lot.box((-x, -y, -0.2), (x, y, height), wall)
    for floor in range(floors):
        low = floor * _FLOOR_METRES
        if floor == 0:
            lot.box((-x - 0.12, -y - 0.12, 2.5), (x + 0.12, y + 0.12, 3.0), parts.shop)
        lot.box((-x - 0.06, -y - 0.06, low + 0.8), (x + 0.06, y + 0.06, low + 2.3), window)
    lot.box((-x - 0.3, -y - 0.3, height), (x + 0.3, y + 0.3, height + 0.3), parts.walls[-1])
    lot.box((-x, -y, height), (x, y, height + 0.35), parts.gravel)
    for _ in range(int(rng.integers(1, 4))):
        center = rng.uniform(-0.6, 0.6, 2) * (x, y)
        lot.block((*center, height), (*rng.uniform(1.0, 2.5, 2), rng.uniform(0.8, 2.0)), parts.steel)


def _add_car(place: Frame, parts: _CityMaterials, rng: np.random.Generator) -> None:
    paint = parts.paints[int(rng.integers(len(parts.paints)))]
    place.block((0, 0, 0.25), (4.2, 1.7, 0.6), paint)
    place.block((-0.2, 0, 0.85), (2.2, 1.5, 0.5), parts.paints[-1])
    place.block((-0.2, 0, 1.35), (2.0, 1.4, 0.08), paint)
    for x in (-1.3, 1.3):
        place.bar((x, 0, 0.32), 0.64, 1.75, parts.paints[-1])

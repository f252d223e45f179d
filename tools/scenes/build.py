"""Collects the materials and primitives of a scene, and lays them out for compiled code."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from tools.scenes import sky, textures
from tools.scenes.geometry import BOX, CYLINDER_Y, CYLINDER_Z, ELLIPSOID, MAX_FACES, SceneArrays

_MAX_TEXELS_PER_SIDE = 32
_FACES_BY_SHAPE = {BOX: 6, ELLIPSOID: 1, CYLINDER_Z: 3, CYLINDER_Y: 3}

Color = Sequence[float]


@dataclass
class SceneBuilder:
    """Materials and primitives of a scene in the making."""

    rng: np.random.Generator
    materials: list[np.ndarray] = field(default_factory=list)
    primitives: list[tuple] = field(default_factory=list)

    def material(
        self,
        texture: int,
        color: Color,
        other: Color | None = None,
        *,
        scale: tuple[float, float] = (0.5, 0.65),
        contrast: float = 0.25,
        reflectance: float = 0.0,
        shininess: float = 60.0,
        metal: bool = False,
        varied: bool = False,
        swap: bool = False,
        joint: tuple[float, float] = (0.0, 0.0),
        stagger: float = 0.0,
    ) -> int:
        """Add a material and return its number.

        Args:
            texture: one of the textures in `textures`.
            color, other: the two linear colours that the texture mixes.
            scale: two sizes in metres; their meaning depends on the texture (for PLAIN and MIX, the longest
                wavelength of the noise and the gain of each octave).
            contrast: strength of the grain.
            reflectance: share of light that is mirrored at normal incidence.
            shininess: exponent of the highlight.
            metal: mirror light in the colour of the material, and scatter none.
            varied: look different on each primitive.
            swap: exchange the axes of the texture.
            joint: gray level and width of the joints of bricks and planks.
            stagger: shift of every other row of bricks, in bricks.
        """
        row = np.zeros(textures.COLUMN_COUNT)
        row[textures.TEXTURE] = texture
        row[textures.COLOR_A : textures.COLOR_A + 3] = color
        row[textures.COLOR_B : textures.COLOR_B + 3] = color if other is None else other
        row[textures.SCALE_U], row[textures.SCALE_V], row[textures.CONTRAST] = *scale, contrast
        row[textures.REFLECTANCE], row[textures.SHININESS], row[textures.IS_METAL] = reflectance, shininess, metal
        row[textures.IS_VARIED], row[textures.SWAPS_AXES] = varied, swap
        row[textures.SEED] = self.rng.integers(1, 1 << 20)
        row[textures.JOINT_GRAY], row[textures.JOINT_WIDTH], row[textures.STAGGER] = *joint, stagger
        self.materials.append(row)
        return len(self.materials) - 1

    @property
    def root(self) -> Frame:
        """The frame of the world."""
        return Frame(self, (0.0, 0.0, 0.0), 0.0)


@dataclass(frozen=True)
class Frame:
    """A place in the scene, rotated by a yaw about z, in which primitives are added."""

    builder: SceneBuilder
    origin: tuple[float, float, float]
    yaw: float

    def frame(self, x: float, y: float, z: float = 0.0, yaw: float = 0.0) -> Frame:
        """Return a frame inside this one."""
        return Frame(self.builder, self._to_world((x, y, z)), self.yaw + yaw)

    def _to_world(self, point: Sequence[float]) -> tuple[float, float, float]:
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        x, y, z = point
        return self.origin[0] + c * x - s * y, self.origin[1] + s * x + c * y, self.origin[2] + z

    def _add(self, shape: int, center: Sequence[float], size: Sequence[float], material: int, yaw: float) -> None:
        half = tuple(0.5 * float(length) for length in size)
        self.builder.primitives.append((shape, self._to_world(center), half, self.yaw + yaw, material))

    def box(self, low: Sequence[float], high: Sequence[float], material: int) -> None:
        """Add a box between two corners."""
        center = [(a + b) / 2 for a, b in zip(low, high, strict=True)]
        self._add(BOX, center, [b - a for a, b in zip(low, high, strict=True)], material, 0.0)

    def block(self, center: Sequence[float], size: Sequence[float], material: int, yaw: float = 0.0) -> None:
        """Add a box that stands on the point `center`."""
        self._add(BOX, (center[0], center[1], center[2] + size[2] / 2), size, material, yaw)

    def ellipsoid(self, center: Sequence[float], size: Sequence[float], material: int, yaw: float = 0.0) -> None:
        """Add an ellipsoid of three diameters."""
        self._add(ELLIPSOID, center, size, material, yaw)

    def post(self, foot: Sequence[float], diameter: float, height: float, material: int) -> None:
        """Add an upright cylinder that stands on the point `foot`."""
        center = foot[0], foot[1], foot[2] + height / 2
        self._add(CYLINDER_Z, center, (diameter, diameter, height), material, 0.0)

    def bar(self, center: Sequence[float], diameter: float, length: float, material: int, yaw: float = 0.0) -> None:
        """Add a level cylinder, along y unless it is rotated."""
        self._add(CYLINDER_Y, center, (diameter, length, diameter), material, yaw)


def make_sky(
    sun_direction: Color,
    sun_color: Color,
    horizon: Color,
    zenith: Color,
    ground: Color,
    cloud_share: float,
    seed: int,
    sun_radius: float = 0.008,
) -> np.ndarray:
    """Return a row of numbers that describes a sky, as `sky.evaluate_sky` reads it.

    Colours are linear. `cloud_share` is added to the noise of clouds; more of the sky is overcast at higher values. The
    radius of the sun is in radians.
    """
    row = np.zeros(sky.SKY_COLUMN_COUNT)
    row[sky.SUN_DIRECTION : sky.SUN_DIRECTION + 3] = np.asarray(sun_direction) / np.linalg.norm(sun_direction)
    row[sky.SUN_COLOR : sky.SUN_COLOR + 3] = sun_color
    row[sky.HORIZON_COLOR : sky.HORIZON_COLOR + 3] = horizon
    row[sky.ZENITH_COLOR : sky.ZENITH_COLOR + 3] = zenith
    row[sky.GROUND_COLOR : sky.GROUND_COLOR + 3] = ground
    row[sky.SUN_RADIUS], row[sky.CLOUD_SHARE], row[sky.SKY_SEED] = sun_radius, cloud_share, seed
    return row


def assemble(builder: SceneBuilder, sky_row: np.ndarray, texel: float, ambient: float) -> SceneArrays:
    """Lay out a scene for compiled code, with uniform indirect light.

    Args:
        builder: its materials and primitives.
        sky_row: see `make_sky`.
        texel: distance of the light texels in metres.
        ambient: indirect light before `lighting` computes it.
    """
    shapes, centers, halves, yaws, materials = zip(*builder.primitives, strict=True)
    shape, center, half = np.array(shapes, np.int64), np.array(centers, np.float64), np.array(halves, np.float64)
    yaw = np.stack([np.cos(yaws), np.sin(yaws)], axis=1)
    c, s = yaw.T
    anchor = np.stack([c * center[:, 0] + s * center[:, 1], c * center[:, 1] - s * center[:, 0], center[:, 2]], axis=1)
    light_start, light_size, texels = _place_texels(shape, half, texel)
    bounds, skip, leaf = _build_hierarchy(*_bounding_boxes(shape, center, half, yaw))
    return SceneArrays(
        shape,
        center,
        half,
        1.0 / half,
        yaw,
        anchor,
        np.array(materials, np.int64),
        bounds,
        skip,
        leaf,
        np.array(builder.materials),
        light_start,
        light_size,
        np.full((texels, 3), ambient, np.float32),
        sky_row,
    )


def _bounding_boxes(shape: np.ndarray, center: np.ndarray, half: np.ndarray, yaw: np.ndarray) -> tuple:
    c, s = np.abs(yaw[:, 0]), np.abs(yaw[:, 1])
    a, b = half[:, 0], half[:, 1]
    is_round = (shape == ELLIPSOID) | (shape == CYLINDER_Z)
    x = np.where(is_round, np.hypot(c * a, s * b), c * a + s * b)
    y = np.where(is_round, np.hypot(s * a, c * b), s * a + c * b)
    reach = np.stack([x, y, half[:, 2]], axis=1) + 1e-7
    return center - reach, center + reach


def _build_hierarchy(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Split primitives at medians into a binary tree, and store it depth first for each octant of directions."""
    middle = (low + high) / 2
    count = 2 * len(low) - 1
    bounds, skip, leaf = np.empty((8, count, 6)), np.empty((8, count), np.int64), np.full((8, count), -1, np.int64)

    def store(octant: int, node: int, rows: np.ndarray) -> int:
        """Store the subtree of some primitives at a node; return the node after it."""
        bounds[octant, node] = *low[rows].min(axis=0), *high[rows].max(axis=0)
        after = node + 1
        if len(rows) == 1:
            leaf[octant, node] = rows[0]
        else:
            extent = middle[rows].max(axis=0) - middle[rows].min(axis=0)
            axis = int(extent.argmax())
            ordered = rows[np.argsort(middle[rows, axis], kind="stable")]
            near, far = ordered[: len(rows) // 2], ordered[len(rows) // 2 :]
            if octant >> axis & 1:
                near, far = far, near
            after = store(octant, store(octant, after, near), far)
        skip[octant, node] = after
        return after

    for octant in range(8):
        store(octant, 0, np.arange(len(low)))
    return bounds, skip, leaf


def _place_texels(shape: np.ndarray, half: np.ndarray, texel: float) -> tuple[np.ndarray, np.ndarray, int]:
    """Return the first light texel of each face, the number along its two axes, and the number of all texels."""
    start = np.zeros((len(shape), MAX_FACES), np.int64)
    size = np.ones((len(shape), MAX_FACES, 2), np.int64)
    total = 0
    for i, kind in enumerate(shape):
        x, y, z = 2 * half[i]
        if kind == CYLINDER_Y:
            y, z = z, y
        around = math.pi * max(x, y)
        sides = {
            BOX: [(y, z)] * 2 + [(x, z)] * 2 + [(x, y)] * 2,
            ELLIPSOID: [(max(around, 4 * texel), max(z, 4 * texel))],
        }.get(kind, [(max(around, 4 * texel), z), (x, y), (x, y)])
        for face in range(_FACES_BY_SHAPE[int(kind)]):
            start[i, face] = total
            size[i, face] = [min(max(math.ceil(length / texel), 1), _MAX_TEXELS_PER_SIDE) for length in sides[face]]
            total += int(size[i, face].prod())
    return start, size, total

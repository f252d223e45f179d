"""The scenes by name: geometry, light and camera path."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import ModuleType

import numpy as np

from hyrfpack.scene import Camera
from tools.scenes import layout_city, layout_object, layout_room, layout_street
from tools.scenes.build import SceneBuilder, assemble
from tools.scenes.geometry import SceneArrays
from tools.scenes.lighting import add_indirect_light

# Each layout has `describe_sky`, `add_primitives` and `place_cameras`. TEXEL_METRES is the distance of light texels,
# its FILL_LIGHT is added to all indirect light, and its EXPOSURE_FACTOR is `SceneDescription.exposure`.
LAYOUTS: dict[str, ModuleType] = {
    "object": layout_object,
    "room": layout_room,
    "street": layout_street,
    "city": layout_city,
}
_FIELD_OF_VIEW_DEGREES = 65.0  # horizontal, as of the main camera of a phone
_INITIAL_AMBIENT_LIGHT = 0.12  # This stands for the bounces that are not computed.
_RAYS_PER_TEXEL = 64
_BOUNCE_COUNT = 2
# Small pictures need less detail in their indirect light, which takes most of their time.
_FULL_DETAIL_WIDTH_PIXELS = 1600
_MAX_TEXEL_SCALE = 10.0


@dataclass(frozen=True, eq=False)
class SceneDescription:
    """A scene with its cameras.

    Attributes:
        arrays: geometry, materials and light, for `render`.
        cameras: one for each photo.
        exposure: factor from linear light to the tone curve, the same for all photos.
    """

    arrays: SceneArrays
    cameras: list[Camera]
    exposure: float


def make_scene(name: str, photos: int, width: int, height: int, seed: int) -> SceneDescription:
    """Build a scene.

    Args:
        name: one of LAYOUTS.
        photos: number of cameras.
        width, height: picture size in pixels.
        seed: random seed of textures, shapes and cameras.
    """
    layout = LAYOUTS[name]
    streams = np.random.SeedSequence([seed, list(LAYOUTS).index(name)]).spawn(2)
    builder = SceneBuilder(np.random.default_rng(streams[0]))
    layout.add_primitives(builder)
    sky = layout.describe_sky(int(builder.rng.integers(1 << 20)))
    texel_scale = min(max(_FULL_DETAIL_WIDTH_PIXELS / width, 1.0), _MAX_TEXEL_SCALE)
    arrays = assemble(builder, sky, layout.TEXEL_METRES * texel_scale, _INITIAL_AMBIENT_LIGHT)
    poses = layout.place_cameras(photos, np.random.default_rng(streams[1]))
    focal = width / 2 / math.tan(math.radians(_FIELD_OF_VIEW_DEGREES) / 2)
    cameras = [Camera(width, height, focal, focal, width / 2, height / 2, pose) for pose in poses]
    arrays = add_indirect_light(arrays, _RAYS_PER_TEXEL, _BOUNCE_COUNT)
    arrays.light[...] += np.float32(layout.FILL_LIGHT)
    return SceneDescription(arrays, cameras, layout.EXPOSURE_FACTOR)

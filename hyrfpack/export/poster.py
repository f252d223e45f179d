"""A picture of a scene to be shown before the scene itself is there."""

from __future__ import annotations

import io

import numpy as np
from PIL import Image

from hyrfpack.cameras.paths import Viewpoint, orbit
from hyrfpack.cameras.view_sampling import shrink_camera
from hyrfpack.errors import HyrfDataError
from hyrfpack.model import Frame, HybridModel
from hyrfpack.render import render
from hyrfpack.render.files import to_image
from hyrfpack.scene import Camera
from hyrfpack.splats.draw import Drawable, draw
from hyrfpack.splats.splats import Splats

QUALITIES = (80, 65, 50, 35, 20, 10)  # of WebP and JPEG, of 100
MIDDLE = (1, 99)  # percentiles of splats' positions between which the scene is taken to lie


def model_poster(model: HybridModel, camera: Camera, longest: int) -> Image.Image:
    """What a camera sees of a model, in a picture of at most `longest` pixels a side."""
    return to_image(render(model, shrink_camera(camera, longest)).rgb)


def splats_poster(splats: Splats, longest: int) -> Image.Image | None:
    """What splats look like from a little above, over black; None where they lie at one place, or there are none.

    The scene is taken to be upright as most reconstructions are, with y downwards.
    """
    if not len(splats):
        return None
    try:
        frame = Frame.from_box(*np.percentile(splats.positions, MIDDLE, axis=0))
    except HyrfDataError:
        return None
    camera = orbit(Viewpoint.from_frame(frame.center, frame.scale), 1)[0]
    return to_image(draw(Drawable.from_splats(splats, frame), shrink_camera(camera, longest)).rgb)


def encode_poster(picture: Image.Image, form: str, most: int) -> bytes:
    """A picture as the bytes of a file, as good as `most` bytes allow.

    Args:
        picture: RGB.
        form: "WEBP" or "JPEG".
        most: bytes, as nearly as possible: where the lowest quality takes more, the picture is made smaller.
    """
    while True:
        for quality in QUALITIES:
            file = io.BytesIO()
            picture.save(file, form, quality=quality)
            if file.tell() <= most or max(picture.size) == 1:
                return file.getvalue()
        picture = picture.resize([max(1, side // 2) for side in picture.size], Image.Resampling.BOX)

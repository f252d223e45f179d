"""Posters: pictures of a scene that a page shows until the scene is loaded."""

from __future__ import annotations

import io

import numpy as np
from PIL import Image

from hyrfpack.cameras.view_sampling import shrink_camera
from hyrfpack.model import Frame, HybridModel
from hyrfpack.model.merged import MergedModel
from hyrfpack.render import render_view
from hyrfpack.render.files import to_image
from hyrfpack.scene import Camera
from hyrfpack.splats.draw import Drawable, draw
from hyrfpack.splats.splats import Splats

ENCODER_QUALITIES = (80, 65, 50, 35, 20, 10)
REACH_PERCENTILE = 90


def render_model_poster(model: HybridModel | MergedModel, camera: Camera, longest_side: int) -> Image.Image:
    """Render a model from a camera, in a picture of at most `longest_side` pixels a side."""
    return to_image(render_view(model, shrink_camera(camera, longest_side)).rgb)


def frame_splats(splats: Splats) -> Frame | None:
    """Return the frame of most splats, around their median position; None if there are none or all lie at one place."""
    if not len(splats):
        return None
    center = np.median(splats.positions, axis=0)
    reach = float(np.percentile(np.abs(splats.positions - center), REACH_PERCENTILE, axis=0).max())
    return Frame(tuple(center.tolist()), reach, (1.0, 1.0, 1.0)) if reach > 0 else None


def render_splats_poster(splats: Splats, frame: Frame, camera: Camera, longest_side: int) -> Image.Image:
    """Render splats over black, in a picture of at most `longest_side` pixels a side."""
    return to_image(draw(Drawable.from_splats(splats, frame), shrink_camera(camera, longest_side)).rgb)


def encode_poster(picture: Image.Image, image_format: str, max_bytes: int) -> bytes:
    """Encode a picture at the highest quality that `max_bytes` allow.

    Args:
        picture: an RGB picture.
        image_format: "WEBP" or "JPEG".
        max_bytes: maximum size. If the lowest quality takes more bytes, the picture is shrunk. Only a picture of one
            pixel can exceed it.
    """
    while True:
        for quality in ENCODER_QUALITIES:
            file = io.BytesIO()
            picture.save(file, image_format, quality=quality)
            if file.tell() <= max_bytes or max(picture.size) == 1:
                return file.getvalue()
        picture = picture.resize([max(1, side // 2) for side in picture.size], Image.Resampling.BOX)

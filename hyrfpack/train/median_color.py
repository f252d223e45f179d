"""Start the radiance field of an untrained model at the median colour of photos that are mostly dark or bright.

The field colours the background sphere and all Gaussians together. An untrained field has logits near 0, which is grey.
On photos that are mostly black or white, the first steps would move all colours alike, by far more than needed, to
logits at which the sigmoid has no gradient. At the median, as many pixels are brighter as are darker, so that a change
of all colours gains nothing in the mean absolute error.
"""

from __future__ import annotations

from contextlib import closing

import numpy as np
import torch

from hyrfpack.data import PictureCache
from hyrfpack.model import HybridModel
from hyrfpack.model.gaussians import logit
from hyrfpack.scene import Picture, Scene, evenly_spaced

MAX_PHOTOS = 24
MAX_PHOTO_PIXELS = 1 << 16  # Of a larger photo, rows and columns are left out.
# Where all channels have a median in this range, fields start at grey.
MIN_USUAL_MEDIAN, MAX_USUAL_MEDIAN = 0.15, 0.85
MIN_COVERED_ALPHA = 128  # Without a background sphere, the fields colour the pixels of at least this 8-bit alpha.


def first_color(scene: Scene, cache: PictureCache, solid: np.ndarray | None) -> np.ndarray:
    """Return the colour (3,) at which the field starts: the median, or grey if it is of usual brightness.

    Arguments and errors are those of `median_color`.
    """
    color = median_color(scene, cache, solid)
    is_usual = (color >= MIN_USUAL_MEDIAN).all() and (color <= MAX_USUAL_MEDIAN).all()
    return np.full(3, 0.5) if is_usual else color


def median_color(scene: Scene, cache: PictureCache, solid: np.ndarray | None) -> np.ndarray:
    """Return the median colour (3,) in (0, 1) of a scene's photos, of each channel alone.

    Args:
        scene: the scene; at most MAX_PHOTOS of its training photos are read.
        cache: cache of decoded photos.
        solid: (3,) the colour behind transparent pixels; None if these do not count.

    Returns:
        The colour; grey if there is no pixel, because all are masked.

    Raises:
        HyrfDataError: a photo cannot be read.
    """
    counts = np.zeros((3, 256), np.int64)
    with closing(cache.stream(evenly_spaced(scene.train, MAX_PHOTOS))) as pictures:
        for _, picture in pictures:
            for count, levels in zip(counts, _levels(picture, solid).T, strict=True):
                count += np.bincount(levels, minlength=len(count))
    totals = counts.cumsum(axis=1)
    if not totals[0, -1]:
        return np.full(3, 0.5)
    medians = (2 * totals >= totals[:, -1:]).argmax(axis=1)
    return np.clip(medians, 0.5, 254.5) / 255  # The logits of black and white would not be finite.


@torch.no_grad()
def start_fields_at(model: HybridModel, color: np.ndarray) -> None:
    """Let the radiance field of an untrained model start at a colour (3,) in (0, 1); Gaussians keep their colours."""
    offset = logit(torch.from_numpy(color)).float()
    model.radiance.biases[-1].add_(offset)
    model.gaussians.color_logits.sub_(offset)


def _levels(picture: Picture, solid: np.ndarray | None) -> np.ndarray:
    """Return the 8-bit levels (n, 3) of the pixels that the fields have to colour.

    Args:
        solid: (3,) the colour behind transparent pixels; None if the fields do not colour them.
    """
    height, width = picture.rgb.shape[:2]
    stride = int(np.ceil(np.sqrt(height * width / MAX_PHOTO_PIXELS)))
    rgb, alpha, mask = (
        None if part is None else part[::stride, ::stride] for part in (picture.rgb, picture.alpha, picture.mask)
    )
    assert rgb is not None
    is_used = np.ones(rgb.shape[:2], bool) if mask is None else mask
    if alpha is not None and solid is None:
        is_used = is_used & (alpha >= MIN_COVERED_ALPHA)
    elif alpha is not None:
        rgb = (Picture(rgb, alpha).composite(solid) * 255 + 0.5).astype(np.uint8)
    return rgb[is_used]

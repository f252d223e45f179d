"""Compare a scene with the original set: cameras, pictures and masks."""

from __future__ import annotations

import numpy as np
from PIL import Image

from hyrfpack.scene import Picture, Scene, View, evenly_spaced

COMPARED_PHOTO_COUNT = 4
# Re-encoded and shrunk photos are well above this PSNR to the original picture, and neighbouring photos far below.
MIN_PSNR_DB = 24.0
MIN_OPAQUE_ALPHA = 201  # Re-encoding may change the colours of pixels that are more transparent.
MAX_MASKED_SHARE_ERROR = 0.05


def find_difference(
    scene: Scene, original_scene: Scene, masked_share: float | None, *, may_lack_photos: bool = False
) -> str:
    """Return the first difference from the original set as text; "" if all cameras, pictures and masks are equal.

    Args:
        scene: the scene of the variant.
        original_scene: the scene of the original set.
        masked_share: share of each photo's rows that a mask of the variant removes; None if masks are not compared.
        may_lack_photos: whether photos may be missing.
    """
    by_pose = {_pose_key(view): view for view in original_scene.views}
    if len(scene.views) != len(original_scene.views) and not may_lack_photos:
        return f"{len(scene.views)} photos instead of {len(original_scene.views)}"
    for view in scene.views:
        original = by_pose.get(_pose_key(view))
        if original is None:
            return f"{view.name} has a pose that is not in the original set"
        ratio = view.camera.width / original.camera.width
        if not np.allclose(view.camera.intrinsics, np.multiply(original.camera.intrinsics, ratio), rtol=0.02):
            return f"{view.name} has different intrinsics"
    for view in evenly_spaced(scene.views, COMPARED_PHOTO_COUNT):
        original = by_pose[_pose_key(view)]
        difference = _find_picture_difference(view, original, masked_share)
        if difference:
            return difference
    return ""


def _pose_key(view: View) -> bytes:
    # Adding 0.0 turns -0.0 into 0.0, so that equal poses have equal bytes.
    return (view.camera.camera_from_world.round(6) + 0.0).tobytes()


def _find_picture_difference(view: View, original: View, masked_share: float | None) -> str:
    picture, original_picture = view.load(), original.load()
    size = picture.rgb.shape[1::-1]
    colors, original_colors = (
        np.asarray(Image.fromarray(rgb).resize(size), float) for rgb in (picture.rgb, original_picture.rgb)
    )
    weight = np.ones(colors.shape[:2])
    for compared in (picture, original_picture):
        if compared.mask is not None:
            weight *= np.asarray(Image.fromarray(compared.mask).resize(size), float)
        if compared.alpha is not None:
            weight *= np.asarray(Image.fromarray(compared.alpha).resize(size)) >= MIN_OPAQUE_ALPHA
    if not weight.any():
        return f"{view.name} has no pixel to compare; its mask or its alpha hides all of them"
    error = ((colors - original_colors) ** 2).mean(2)
    psnr = 10 * np.log10(255**2 / max((error * weight).sum() / weight.sum(), 1e-9))
    if psnr < MIN_PSNR_DB:
        return f"{view.name} is a different picture ({psnr:.1f} dB)"
    if masked_share is not None:
        share, expected_share = _masked_row_share(picture), max(masked_share, _masked_row_share(original_picture))
        if abs(share - expected_share) > MAX_MASKED_SHARE_ERROR:
            return f"{view.name}: {share:.0%} of its rows are masked instead of {expected_share:.0%}"
    return ""


def _masked_row_share(picture: Picture) -> float:
    """Return the share of a picture's rows in which all pixels are masked."""
    return 0.0 if picture.mask is None else float((~picture.mask.any(1)).mean())

"""How a scene that was read differs from the set itself, in cameras, pictures and masks."""

from __future__ import annotations

import numpy as np
from PIL import Image

from hyrfpack.scene import Scene, View, evenly_spaced

LOOKED_AT = 4  # photos whose pixels are compared
LEAST_PSNR = 24.0  # dB to the set's own picture: re-encoded and shrunk photos are well above, neighbours far below


def differs(scene: Scene, plain: Scene, masked: float | None, *, missing_allowed: bool = False) -> str:
    """What is other than in the set itself, in words; "" where all cameras and pictures are the same."""
    by_pose = {_pose_key(view): view for view in plain.views}
    if len(scene.views) != len(plain.views) and not missing_allowed:
        return f"{len(scene.views)} photos instead of {len(plain.views)}"
    for view in scene.views:
        same = by_pose.get(_pose_key(view))
        if same is None:
            return f"{view.name} has a pose that none has"
        ratio = view.camera.width / same.camera.width
        if not np.allclose(view.camera.intrinsics, np.multiply(same.camera.intrinsics, ratio), rtol=0.02):
            return f"{view.name} has other intrinsics"
    for view in evenly_spaced(scene.views, LOOKED_AT):
        same = by_pose[_pose_key(view)]
        wrong = _other_picture(view, same, masked)
        if wrong:
            return wrong
    return ""


def _pose_key(view: View) -> bytes:
    return (view.camera.camera_from_world.round(6) + 0.0).tobytes()  # one zero


def _other_picture(view: View, same: View, masked: float | None) -> str:
    made, own = view.load(), same.load()
    size = made.rgb.shape[1::-1]
    shown = [np.asarray(Image.fromarray(picture.rgb).resize(size), float) for picture in (made, own)]
    weight = np.ones(shown[0].shape[:2])
    for picture in (made, own):
        if picture.mask is not None:
            weight *= np.asarray(Image.fromarray(picture.mask).resize(size), float)
        if picture.alpha is not None:
            weight *= np.asarray(Image.fromarray(picture.alpha).resize(size)) > 200
    error = ((shown[0] - shown[1]) ** 2).mean(2)
    psnr = 10 * np.log10(255**2 / max((error * weight).sum() / max(weight.sum(), 1), 1e-9))
    if psnr < LEAST_PSNR:
        return f"{view.name} is another picture ({psnr:.1f} dB)"
    if masked is not None:
        rows = np.zeros(made.rgb.shape[0], bool) if made.mask is None else ~made.mask.any(1)
        own_rows = np.zeros(own.rgb.shape[0], bool) if own.mask is None else ~own.mask.any(1)
        if abs(rows.mean() - max(masked, own_rows.mean())) > 0.05:
            return f"{view.name}: {rows.mean():.0%} of its rows are masked instead of {masked:.0%}"
    return ""

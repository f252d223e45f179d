"""Lens distortion models, and the undistortion of photos.

Undistortion needs only the forward distortion: each undistorted pixel takes its colour from the point in the photo
where its ray was imaged. The undistorted camera keeps the photo's size, focal lengths and principal point, so that
nothing is rescaled. Pixels whose rays fell outside the photo are masked out, not cropped or painted black.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import numpy as np

from hyrfpack.scene import Picture


@dataclass(frozen=True)
class Lens:
    """Intrinsics of a photo, including its lens distortion.

    Attributes:
        width, height: picture size in pixels.
        fx, fy, cx, cy: pinhole part, in pixels (pixel centres at .5).
        model: "pinhole" (no coefficients), "brown" (k1 k2 p1 p2 k3 k4 k5 k6, COLMAP's FULL_OPENCV, and optionally k7),
            "fisheye" (k1 k2 k3 k4 of the equidistant OPENCV_FISHEYE, and optionally p1 p2), or "equirectangular" (the
            whole sphere, which is cut into faces and never undistorted).
        coefficients: the coefficients of the model, dimensionless.
        skew: shear of the picture to the right, in pixels for each unit of y'; undistorted pictures have none.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    model: Literal["pinhole", "brown", "fisheye", "equirectangular"] = "pinhole"
    coefficients: tuple[float, ...] = ()
    skew: float = 0.0

    @property
    def is_distorted(self) -> bool:
        """Return whether the photo differs from a pinhole picture, by distortion or by skew."""
        return self.model == "fisheye" or any(self.coefficients) or self.skew != 0

    def scaled(self, width: int, height: int) -> Lens:
        """Return the lens of a copy of the photo that is resized to (width, height).

        The coefficients stay, because they are dimensionless.
        """
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=self.cx * sx,
            cy=self.cy * sy,
            skew=self.skew * sx,
        )


def brown_coefficients(k1: float = 0, k2: float = 0, p1: float = 0, p2: float = 0, *higher: float) -> tuple[float, ...]:
    """Pad Brown coefficients in COLMAP's order (k1 k2 p1 p2 k3 k4 k5 k6) with zeros to eight; a ninth is k7."""
    return (k1, k2, p1, p2, *higher, *(0.0,) * (4 - len(higher)))


def distort(lens: Lens, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Apply the lens distortion to rays.

    With r^2 = x^2 + y^2, "brown" is the OpenCV rational model

        d = (1 + k1 r^2 + k2 r^4 + k3 r^6 + k7 r^8) / (1 + k4 r^2 + k5 r^4 + k6 r^6)
        x' = x d + 2 p1 x y + p2 (r^2 + 2 x^2),   y' = y d + 2 p2 x y + p1 (r^2 + 2 y^2)

    whose k7 is Metashape's and RealityScan's K4. "fisheye", with theta = atan r, is the same with (x, y) theta / r in
    place of (x, y), and d = 1 + k1 theta^2 + ... + k4 theta^8. Finally, skew adds skew / fx y' to x'.

    Args:
        lens: lens of any model except "equirectangular".
        x, y: ray direction at depth 1, X/Z and Y/Z, any common shape.

    Returns:
        (x', y') of the same shape; the photo's pixel is (fx x' + cx, fy y' + cy).
    """
    if lens.model == "pinhole":
        distorted_x, distorted_y = x, y
    elif lens.model == "fisheye":
        r = np.sqrt(x * x + y * y)
        theta = np.arctan(r)
        scale = np.divide(_fisheye_angle(lens, theta), r, out=np.ones_like(r), where=r > 1e-9)
        distorted_x, distorted_y = x * scale, y * scale
        if len(lens.coefficients) > 4:
            angle_ratio = np.divide(theta, r, out=np.ones_like(r), where=r > 1e-9)
            offset_x, offset_y = _tangential_offset(lens.coefficients[4:6], x * angle_ratio, y * angle_ratio)
            distorted_x, distorted_y = distorted_x + offset_x, distorted_y + offset_y
    else:
        d = _brown_factor(lens, x * x + y * y)
        offset_x, offset_y = _tangential_offset(lens.coefficients[2:4], x, y)
        distorted_x, distorted_y = x * d + offset_x, y * d + offset_y
    return (distorted_x + lens.skew / lens.fx * distorted_y if lens.skew else distorted_x), distorted_y


def _tangential_offset(tangential: tuple[float, ...], x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the tangential distortion, by p1 and p2, that is added to (x, y)."""
    p1, p2 = tangential
    r2 = x * x + y * y
    return 2 * p1 * x * y + p2 * (r2 + 2 * x * x), 2 * p2 * x * y + p1 * (r2 + 2 * y * y)


def _brown_factor(lens: Lens, r2: np.ndarray) -> np.ndarray:
    """Return the radial factor d of the Brown model for squared radii."""
    k1, k2, _, _, k3, k4, k5, k6, k7 = (*lens.coefficients, 0.0)[:9]
    with np.errstate(divide="ignore", invalid="ignore"):
        return (1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k7)))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))


def _fisheye_angle(lens: Lens, theta: np.ndarray) -> np.ndarray:
    """Return the distorted angle theta d of the fisheye model."""
    k1, k2, k3, k4 = lens.coefficients[:4]
    t2 = theta * theta
    return theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))


def fold_radius(lens: Lens, largest: float) -> float:
    """Return the radius |(x, y)| up to which the lens maps rays one to one, at most `largest`.

    Beyond it the polynomial decreases, so that the undistorted picture would show parts of the photo twice.
    """
    radii = np.linspace(0, largest, 4096)
    with np.errstate(over="ignore", invalid="ignore"):
        if lens.model == "fisheye":
            distorted = _fisheye_angle(lens, np.arctan(radii))
        else:
            distorted = radii * _brown_factor(lens, radii * radii)
        folded = np.flatnonzero(~(np.diff(distorted) > 0))
    return float(radii[folded[0]]) if folded.size else largest


@lru_cache(maxsize=4)  # usually all photos share one camera; a map takes 9 bytes per pixel
def _source_map(lens: Lens) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Return the position in the photo that each undistorted pixel takes its colour from.

    Returns:
        (H, W) float32 columns and (H, W) float32 rows, clipped to the photo, with pixel centres at integers; (H, W)
        bool of the pixels whose ray is in the photo, None if all are.
    """
    x = ((np.arange(lens.width) + 0.5 - lens.cx) / lens.fx)[None, :]
    y = ((np.arange(lens.height) + 0.5 - lens.cy) / lens.fy)[:, None]
    x, y = np.broadcast_arrays(x, y)
    radius = np.hypot(x, y)
    with np.errstate(over="ignore", invalid="ignore"):
        distorted_x, distorted_y = distort(lens, x, y)
        u, v = lens.fx * distorted_x + lens.cx, lens.fy * distorted_y + lens.cy
        seen = (u >= 0) & (u <= lens.width) & (v >= 0) & (v <= lens.height)  # comparisons with NaN are false
    seen &= radius <= fold_radius(lens, float(radius.max()))
    column = np.where(seen, np.clip(u - 0.5, 0, lens.width - 1), 0).astype(np.float32)
    row = np.where(seen, np.clip(v - 0.5, 0, lens.height - 1), 0).astype(np.float32)
    return column, row, None if seen.all() else seen


def undistort(picture: Picture, lens: Lens) -> Picture:
    """Resample a photo to the pinhole camera of the same size, focal lengths and principal point (bilinear).

    Args:
        picture: the photo, (lens.height, lens.width).
        lens: the lens of the photo.

    Returns:
        The undistorted picture. Its mask is False for pixels outside the photo and for those that a masked pixel
        contributes to.
    """
    column, row, seen = _source_map(lens)
    left, top = column.astype(np.int32), row.astype(np.int32)
    right, bottom = np.minimum(left + 1, lens.width - 1), np.minimum(top + 1, lens.height - 1)
    a, b = (column - left)[..., None], (row - top)[..., None]

    def sample(values: np.ndarray) -> np.ndarray:
        upper = values[top, left] * (1 - a) + values[top, right] * a
        lower = values[bottom, left] * (1 - a) + values[bottom, right] * a
        return upper * (1 - b) + lower * b

    alpha = mask = None
    if picture.alpha is None:
        rgb = sample(picture.rgb)
    else:
        # Colours of transparent pixels are undefined, so they are weighted by coverage before they are mixed.
        coverage = picture.alpha[..., None].astype(np.float32)
        blended = sample(coverage)
        rgb = sample(picture.rgb * coverage) / np.maximum(blended, 1e-6)
        alpha = _to_bytes(blended[..., 0])
    if picture.mask is not None:
        mask = sample(picture.mask[..., None])[..., 0] > 0.999
    if seen is not None:
        mask = seen if mask is None else mask & seen
    return Picture(_to_bytes(rgb), alpha, mask)


def _to_bytes(values: np.ndarray) -> np.ndarray:
    """Round values to uint8, clipped to 0 to 255."""
    return (np.clip(values, 0, 255) + 0.5).astype(np.uint8)

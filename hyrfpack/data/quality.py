"""Measure the sharpness and the exposure of photos, to compare the photos of one dataset."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hyrfpack.data.pictures import fit_size, read_header, read_pixels
from hyrfpack.outputs import StrPath

# Longer side at which photos are measured: half of that at which they are trained by default.
MEASURED_SIDE_PIXELS = 800
# Photos with less sharpness are blurred in any dataset: at the measured size, the blur is several pixels wide.
MIN_SHARPNESS = 0.4
MIN_SHARPNESS_SIDE_PIXELS = 8  # smaller pictures have too few differences at the distances that are compared

_FAR_DISTANCE_PIXELS = 4
_NEIGHBOURS_PER_SIDE = 4
# Nearly all sharp photos of real datasets have more than 0.75 of the median sharpness.
_MIN_SHARPNESS_RATIO_TO_NEIGHBOURS = 0.65
_MIN_SHARPNESS_RATIO_TO_SET = 0.6
_ROUNDING_SQUARED_DIFFERENCE = 1e-6  # rounding to 8 bits causes about this squared difference
_NORMAL_MEDIAN_ABSOLUTE_VALUE = 0.6745  # at a standard deviation of 1
_LUMA_WEIGHTS = np.array((0.299, 0.587, 0.114), np.float32)  # Rec. 601, as in JPEG
# Luma at or beyond these limits is clipped: differences there are lost.
_MAX_DARK_LUMA = 2 / 255
_MIN_BRIGHT_LUMA = 253 / 255


@dataclass(frozen=True)
class Exposure:
    """Brightness of a photo.

    Attributes:
        luminance: mean linear luminance in [0, 1]; log2 of the ratio of two values is their difference in stops.
        dark, bright: shares of the pixels that are clipped to black and to white.
    """

    luminance: float
    dark: float
    bright: float


def read_gray(path: StrPath) -> np.ndarray:
    """Decode a photo as luma, shrunk to at most MEASURED_SIDE_PIXELS on the longer side.

    Args:
        path: the photo.

    Returns:
        (H, W) float32 in [0, 1], display-referred; transparent pixels are composited over black.

    Raises:
        HyrfDataError: the file is missing, truncated, or no picture.

    Example:
        >>> from PIL import Image
        >>> Image.new("RGB", (1600, 900)).save("wide.png")
        >>> read_gray("wide.png").shape
        (450, 800)
    """
    return read_gray_and_transparency(path)[0]


def read_gray_and_transparency(path: StrPath) -> tuple[np.ndarray, bool]:
    """Return what `read_gray` does, and whether some of the photo's pixels are transparent, as those of a cut-out."""
    path = Path(path)
    stored = read_header(path).size
    wanted = fit_size(*stored, MEASURED_SIDE_PIXELS)
    rgb, alpha = read_pixels(path, None if wanted == stored else wanted)
    gray = rgb @ (_LUMA_WEIGHTS / 255)
    return (gray, False) if alpha is None else (gray * (alpha * np.float32(1 / 255)), bool((alpha < 255).any()))


def measure_sharpness(gray: np.ndarray) -> float:
    """Measure the sharpness of a picture, from 0 to about 1.

    It is about 1 if the picture is sharp to the pixel, and 0.25 if it is blurred over 4 pixels or more.

    With D(r) the mean squared difference of pixels r apart, in one of four directions (rows, columns, diagonals):

        4 (D(1) - 2 s^2) / (D(4) - 2 s^2), the minimum over the four directions

    D grows as r at a sharp edge and as r^2 at a blurred one, for any contrast. So pictures of different content are
    comparable. The minimum is taken because motion blurs one direction only. s is the standard deviation of white
    noise, from the median residual of predicting each pixel by its 8 neighbours (Immerkaer 1996).

    Args:
        gray: (H, W) luma in [0, 1].

    Returns:
        Sharpness, 0 or more; 0 for pictures without content and for those with a side of less than
            MIN_SHARPNESS_SIDE_PIXELS.

    Raises:
        ValueError: the shape is not (H, W), or a value is not finite.

    Example:
        >>> import numpy as np
        >>> edge = np.zeros((64, 64), np.float32)
        >>> edge[20:40, 20:40] = 1
        >>> round(measure_sharpness(edge), 1)
        1.0
        >>> measure_sharpness((edge + np.roll(edge, 1, 1) + np.roll(edge, 2, 1)) / 3) < 0.7
        True
    """
    gray = _validated(gray)
    if min(gray.shape) < MIN_SHARPNESS_SIDE_PIXELS:
        return 0.0
    noise = 2 * _noise(gray) ** 2
    values = []
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        near, far = (_squared_difference(gray, down * r, right * r) for r in (1, _FAR_DISTANCE_PIXELS))
        values.append(max(0.0, near - noise) / (max(0.0, far - noise) + _ROUNDING_SQUARED_DIFFERENCE))
    return _FAR_DISTANCE_PIXELS * min(values)


def mark_blurred(sharpness: Sequence[float] | np.ndarray) -> np.ndarray:
    """Mark the photos of a set that are blurred, relative to their neighbours and to the set.

    A photo is blurred if its sharpness is below 0.65 of its neighbours' median, below 0.6 of the set's median, or below
    0.4. Its neighbours are up to four photos on each side, in order of capture.

    Args:
        sharpness: (N,) results of `measure_sharpness`, in the order in which the photos were taken.

    Returns:
        (N,) bool, True for blurred photos.

    Raises:
        ValueError: a value is not finite.

    Example:
        >>> mark_blurred([1.0, 0.95, 0.5, 1.05, 0.9]).tolist()
        [False, False, True, False, False]
    """
    values = np.asarray(sharpness, np.float64)
    if not np.isfinite(values).all():
        raise ValueError("sharpness must be finite")
    if len(values) < 2:
        return values < MIN_SHARPNESS
    neighbours = np.full((len(values), 2 * _NEIGHBOURS_PER_SIDE), np.nan)
    steps = (step for step in range(-_NEIGHBOURS_PER_SIDE, _NEIGHBOURS_PER_SIDE + 1) if step)
    for column, step in enumerate(steps):
        indices = np.arange(len(values)) + step
        inside = (indices >= 0) & (indices < len(values))
        neighbours[inside, column] = values[indices[inside]]
    below_neighbours = values < _MIN_SHARPNESS_RATIO_TO_NEIGHBOURS * np.nanmedian(neighbours, axis=1)
    below_set = values < _MIN_SHARPNESS_RATIO_TO_SET * np.median(values)
    return below_neighbours | below_set | (values < MIN_SHARPNESS)


def measure_exposure(gray: np.ndarray) -> Exposure:
    """Measure the brightness of a picture and the shares of clipped pixels.

    Args:
        gray: (H, W) display-referred sRGB luma in [0, 1].

    Raises:
        ValueError: the shape is not (H, W), or a value is not finite.

    Example:
        >>> import numpy as np
        >>> round(measure_exposure(np.full((8, 8), 0.5)).luminance, 3)
        0.214
    """
    gray = _validated(gray)
    linear = np.where(gray <= 0.04045, gray / 12.92, ((np.maximum(gray, 0) + 0.055) / 1.055) ** 2.4)  # IEC 61966-2-1
    return Exposure(
        float(linear.mean()), float((gray <= _MAX_DARK_LUMA).mean()), float((gray >= _MIN_BRIGHT_LUMA).mean())
    )


def _validated(gray: np.ndarray) -> np.ndarray:
    """Convert a picture to float32 and check its shape and values."""
    gray = np.asarray(gray, np.float32)
    if gray.ndim != 2 or gray.size == 0:
        raise ValueError(f"a picture in grey has the shape (H, W), not {gray.shape}")
    if not np.isfinite(gray).all():
        raise ValueError("the picture is not finite")
    return gray


def _noise(gray: np.ndarray) -> float:
    """Estimate the standard deviation of white noise in a picture."""
    corners = gray[:-2, :-2] + gray[:-2, 2:] + gray[2:, :-2] + gray[2:, 2:]
    sides = gray[:-2, 1:-1] + gray[2:, 1:-1] + gray[1:-1, :-2] + gray[1:-1, 2:]
    residual = (corners - 2 * sides + 4 * gray[1:-1, 1:-1])[::2, ::2]
    return float(np.median(np.abs(residual))) / _NORMAL_MEDIAN_ABSOLUTE_VALUE / 6  # 6 is the L2 norm of the weights


def _squared_difference(gray: np.ndarray, down: int, right: int) -> float:
    """Return the mean squared difference of pixels that are apart by this offset."""
    height, width = gray.shape
    here = gray[: height - down, max(-right, 0) : width - max(right, 0)]
    there = gray[down:, max(right, 0) : width + min(right, 0)]
    return float(np.mean((here - there) ** 2))

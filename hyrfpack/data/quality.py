"""How sharp and how well exposed photos are, by numbers that compare the photos of one set."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hyrfpack.data.pictures import read_header, read_pixels, shrunk_size
from hyrfpack.outputs import StrPath

LOOKED_AT = 800  # pixels of the longer side that photos are measured at: half of what training takes them at
TOO_SOFT = 0.4  # sharpness: below this, blur is several pixels wide at that size, whatever the other photos are like

_FAR = 4  # pixels between the points whose difference says how much structure there is
_NEIGHBOURS = 4  # on each side
_OF_NEIGHBOURS, _OF_SET = 0.65, 0.6  # of the median sharpness; nearly all sharp photos of real sets stay above .75
_LEAST = 1e-6  # squared difference, about what rounding to 8 bits makes
_MEDIAN_OF_NORMAL = 0.6745  # |x|, standard deviation 1
_LUMA = np.array((0.299, 0.587, 0.114), np.float32)  # Rec. 601, of JPEG
_DARK, _BRIGHT = 2 / 255, 253 / 255  # at or beyond these nothing is told apart


@dataclass(frozen=True)
class Exposure:
    """How light a photo is.

    Attributes:
        luminance: mean linear luminance in [0, 1]; log2 of a ratio of two is a difference in stops.
        dark, bright: shares of the pixels that are clipped to black and to white.
    """

    luminance: float
    dark: float
    bright: float


def read_gray(path: StrPath, size: int = LOOKED_AT) -> np.ndarray:
    """Decode a photo as luma, shrunk to at most `size` pixels on the longer side.

    Args:
        path: of the photo.
        size: in pixels.

    Returns:
        (H, W) float32 in [0, 1], display-referred; transparent pixels over black.

    Raises:
        HyrfDataError: the file is missing, truncated, or no picture.

    Example:
        >>> read_gray("photos/bonsai/images/0000.png", 24).shape
        (24, 24)
    """
    path = Path(path)
    stored = read_header(path).size
    wanted = shrunk_size(*stored, size)
    rgb, alpha = read_pixels(path, None if wanted == stored else wanted)
    gray = rgb @ (_LUMA / 255)
    return gray if alpha is None else gray * (alpha * np.float32(1 / 255))


def sharpness(gray: np.ndarray) -> float:
    """How sharp a picture is, about 1 for one that is sharp to the pixel, 0.25 for one blurred over 4 pixels or more.

    With D(r) the mean squared difference of pixels r apart, in one of four directions (rows, columns, diagonals):

        4 (D(1) - 2 s^2) / (D(4) - 2 s^2), the least of the four

    A sharp edge makes D grow as r and a blurred one as r^2, whatever its contrast, so that pictures of different
    content compare; motion blurs one direction alone, hence the least; s is the standard deviation of white noise,
    from the median of what is left when each pixel is predicted by its 8 neighbours (Immerkaer 1996).

    Args:
        gray: (H, W) in [0, 1].

    Returns:
        0 or more; 0 for pictures with nothing in them and for those of less than 8 pixels on a side.

    Raises:
        ValueError: not (H, W), or not finite.

    Example:
        >>> import numpy as np
        >>> edge = np.zeros((64, 64), np.float32)
        >>> edge[20:40, 20:40] = 1
        >>> round(sharpness(edge), 1)
        1.0
        >>> sharpness((edge + np.roll(edge, 1, 1) + np.roll(edge, 2, 1)) / 3) < 0.7
        True
    """
    gray = _checked(gray)
    if min(gray.shape) < 8:
        return 0.0
    noise = 2 * _noise(gray) ** 2
    values = []
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        near, far = (_squared_difference(gray, down * r, right * r) for r in (1, _FAR))
        values.append(max(0.0, near - noise) / (max(0.0, far - noise) + _LEAST))
    return _FAR * min(values)


def is_blurred(sharpness: Sequence[float] | np.ndarray) -> np.ndarray:
    """Which photos of a set are blurred: not as sharp as those around them, or as the set.

    A photo counts as blurred if its sharpness is below 0.65 of the median of its neighbours (up to four on each side,
    as the photos were taken), below 0.6 of the median of the set, or below 0.4 in itself.

    Args:
        sharpness: (N,) of `sharpness`, in the order in which the photos were taken.

    Returns:
        (N,) bool.

    Raises:
        ValueError: a value is not finite.

    Example:
        >>> is_blurred([1.0, 0.95, 0.5, 1.05, 0.9]).tolist()
        [False, False, True, False, False]
    """
    values = np.asarray(sharpness, np.float64)
    if not np.isfinite(values).all():
        raise ValueError("sharpness must be finite")
    if len(values) < 2:
        return values < TOO_SOFT
    around = np.full((len(values), 2 * _NEIGHBOURS), np.nan)
    for column, step in enumerate(step for step in range(-_NEIGHBOURS, _NEIGHBOURS + 1) if step):
        places = np.arange(len(values)) + step
        inside = (places >= 0) & (places < len(values))
        around[inside, column] = values[places[inside]]
    beside = values < _OF_NEIGHBOURS * np.nanmedian(around, axis=1)
    return beside | (values < _OF_SET * np.median(values)) | (values < TOO_SOFT)


def exposure(gray: np.ndarray) -> Exposure:
    """How light a picture is.

    Args:
        gray: (H, W) display-referred sRGB luma in [0, 1].

    Raises:
        ValueError: not (H, W), or not finite.

    Example:
        >>> import numpy as np
        >>> round(exposure(np.full((8, 8), 0.5)).luminance, 3)
        0.214
    """
    gray = _checked(gray)
    linear = np.where(gray <= 0.04045, gray / 12.92, ((np.maximum(gray, 0) + 0.055) / 1.055) ** 2.4)  # IEC 61966-2-1
    return Exposure(float(linear.mean()), float((gray <= _DARK).mean()), float((gray >= _BRIGHT).mean()))


def _checked(gray: np.ndarray) -> np.ndarray:
    gray = np.asarray(gray, np.float32)
    if gray.ndim != 2 or gray.size == 0:
        raise ValueError(f"a picture in grey has the shape (H, W), not {gray.shape}")
    if not np.isfinite(gray).all():
        raise ValueError("the picture is not finite")
    return gray


def _noise(gray: np.ndarray) -> float:
    """Standard deviation of white noise in a picture."""
    corners = gray[:-2, :-2] + gray[:-2, 2:] + gray[2:, :-2] + gray[2:, 2:]
    sides = gray[:-2, 1:-1] + gray[2:, 1:-1] + gray[1:-1, :-2] + gray[1:-1, 2:]
    left = (corners - 2 * sides + 4 * gray[1:-1, 1:-1])[::2, ::2]
    return float(np.median(np.abs(left))) / _MEDIAN_OF_NORMAL / 6  # 6: root of the sum of the squared weights


def _squared_difference(gray: np.ndarray, down: int, right: int) -> float:
    height, width = gray.shape
    here = gray[: height - down, max(-right, 0) : width - max(right, 0)]
    there = gray[down:, max(right, 0) : width + min(right, 0)]
    return float(np.mean((here - there) ** 2))

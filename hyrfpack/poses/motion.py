"""How far the picture moves through a video: where each part of it has gone, added up from frame to frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy import fft

WIDE = 160  # pixels of the longer side of the frames that motion is measured on

_WINDOW, _STEP = 64, 16  # pixels: finds shifts up to about a tenth of the longer side, measured on real sets
_SURE = 0.12  # height of the correlation's peak, 1 for a copy; unrelated windows give .08
_SURE_WINDOW = 0.07
_NEW_REFERENCE = 6.0  # pixels of motion after which frames are compared with a later one
_ALIKE = 2.0  # levels of 255 between two frames without texture that still are of the same thing
_LOST = 24.0  # pixels that count for frames that cannot be compared: a cut, or very fast
_NEAR_QUANTILE = 0.75  # of the windows: what is near moves more, and it is what has to be seen from all sides


def track(frames: Sequence[np.ndarray], progress: Callable[[int], None] = lambda done: None) -> np.ndarray:
    """Follow the parts of the picture from the first frame on.

    Windows spread over the frame are compared with those of an earlier frame by phase correlation, not with the last
    one, so that slow motion is not lost and a shaking camera is not taken for a moving one.

    Args:
        frames: (H, W) uint8, WIDE pixels on the longer side.
        progress: called with the number of frames that were followed so far.

    Returns:
        (N, windows, 2) float32: where each window has gone since the first frame, in shares of the longer side.
    """
    windows = len(_places(frames[0].shape)[0])
    track = np.zeros((len(frames), windows, 2), np.float32)
    reference, spectra, last = 0, _spectra(frames[0]), _spectra(frames[0])
    for number in range(1, len(frames)):
        progress(number)
        here = _spectra(frames[number])
        moved = _shift(spectra, here)
        if moved is None and reference != number - 1:
            reference, spectra = number - 1, last
            moved = _shift(spectra, here)
        if moved is None:
            alike = np.abs(frames[number].astype(np.float32) - frames[reference]).mean() < _ALIKE
            moved = np.zeros((windows, 2)) if alike else np.full((windows, 2), _LOST / np.sqrt(2))
        track[number] = track[reference] + moved / WIDE
        if np.median(np.linalg.norm(moved, axis=1)) > _NEW_REFERENCE:
            reference, spectra = number, here
        last = here
    return track


def distances(track: np.ndarray, first: int, others: slice) -> np.ndarray:
    """How far the picture moved between a frame and others, in shares of the longer side: (others,)."""
    return np.quantile(np.linalg.norm(track[others] - track[first], axis=2), _NEAR_QUANTILE, axis=1)


def _places(shape: tuple[int, ...]) -> tuple[list[tuple[int, int]], tuple[int, int]]:
    """Corners of the windows, evenly spread, and their size."""
    height, width = (min(_WINDOW, side) for side in shape)
    down, right = (
        np.linspace(0, side - size, max(1, -(-(side - size) // _STEP) + 1)).round().astype(int)
        for side, size in zip(shape, (height, width), strict=True)
    )
    return [(top, left) for top in down for left in right], (height, width)


def _spectra(frame: np.ndarray) -> np.ndarray:
    """Fourier transforms of the windows of a frame."""
    corners, (height, width) = _places(frame.shape)
    parts = np.stack([frame[top : top + height, left : left + width] for top, left in corners]).astype(np.float32)
    parts -= parts.mean(axis=(1, 2), keepdims=True)
    fade = np.outer(np.hanning(height + 2)[1:-1], np.hanning(width + 2)[1:-1]).astype(np.float32)
    return fft.rfft2(parts * fade)


def _shift(before: np.ndarray, after: np.ndarray) -> np.ndarray | None:
    """(windows, 2) pixels that each window moved right and down; None where most have nothing in common."""
    height, width = before.shape[1], 2 * (before.shape[2] - 1)
    cross = after * before.conj()
    peaks = fft.irfft2(cross / (np.abs(cross) + 1e-6), s=(height, width))
    windows = np.arange(len(peaks))
    down, right = np.divmod(peaks.reshape(len(peaks), -1).argmax(axis=1), width)
    heights = peaks[windows, down, right]
    if np.median(heights) < _SURE:
        return None

    def between(low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """The top of a parabola through the peak and what is beside it."""
        bend = low - 2 * heights + high
        return 0.5 * (low - high) / np.where(np.abs(bend) > 1e-9, bend, np.inf)

    x = right + between(peaks[windows, down, right - 1], peaks[windows, down, (right + 1) % width])
    y = down + between(peaks[windows, down - 1, right], peaks[windows, (down + 1) % height, right])
    shift = np.stack((np.where(x > width / 2, x - width, x), np.where(y > height / 2, y - height, y)), axis=1)
    sure = heights >= _SURE_WINDOW
    shift[~sure] = np.median(shift[sure], axis=0)
    return shift

"""Track the motion of the picture in a video by phase correlation of windows, accumulated from frame to frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import fft

from hyrfpack.progress import Progress, TaskEvent, ignore_progress

TRACKING_SIDE_PIXELS = 160  # longer side of the frames on which motion is measured

# On real videos, windows of this size find shifts of up to about a tenth of the longer side.
_WINDOW_PIXELS = 64
_WINDOW_STRIDE_PIXELS = 16
# The correlation peak of two copies is 1; unrelated windows have a median peak of 0.08.
_MIN_MEDIAN_PEAK = 0.12
_MIN_WINDOW_PEAK = 0.07
_MAX_REFERENCE_MOTION_PIXELS = 6.0  # after more motion than this, a later frame becomes the reference
_MAX_UNTEXTURED_DIFFERENCE_LEVELS = 2.0  # levels of 255: frames without texture that differ less show the same view
_LOST_MOTION_PIXELS = 24.0  # motion assumed between frames that cannot be compared, such as at a cut
_MOTION_QUANTILE = 0.75  # near objects move more than most windows, and they must be seen from all sides


def track_windows(frames: Sequence[np.ndarray], progress: Progress = ignore_progress) -> np.ndarray:
    """Track windows of the picture from the first frame on.

    Each frame is compared by phase correlation with a reference frame, which is often older than the previous frame. So
    slow motion is not lost, and a shaking camera is not mistaken for a moving one.

    Args:
        frames: (H, W) uint8 frames with TRACKING_SIDE_PIXELS on the longer side.
        progress: called with a `TaskEvent` before each frame.

    Returns:
        (N, windows, 2) float32 displacement of each window since the first frame, right and down, as a ratio of the
        longer side.
    """
    windows = len(_window_grid(frames[0].shape)[0])
    trajectories = np.zeros((len(frames), windows, 2), np.float32)
    reference, reference_spectra, last = 0, _window_spectra(frames[0]), _window_spectra(frames[0])
    for number in range(1, len(frames)):
        progress(TaskEvent(f"measuring the camera motion, frame {number}/{len(frames)}", number / len(frames)))
        current = _window_spectra(frames[number])
        moved = _measure_shift(reference_spectra, current)
        if moved is None and reference != number - 1:
            reference, reference_spectra = number - 1, last
            moved = _measure_shift(reference_spectra, current)
        if moved is None:
            is_same_view = (
                np.abs(frames[number].astype(np.float32) - frames[reference]).mean() < _MAX_UNTEXTURED_DIFFERENCE_LEVELS
            )
            moved = np.zeros((windows, 2)) if is_same_view else np.full((windows, 2), _LOST_MOTION_PIXELS / np.sqrt(2))
        trajectories[number] = trajectories[reference] + moved / TRACKING_SIDE_PIXELS
        if np.median(np.linalg.norm(moved, axis=1)) > _MAX_REFERENCE_MOTION_PIXELS:
            reference, reference_spectra = number, current
        last = current
    return trajectories


def motion_distances(trajectories: np.ndarray, first: int, others: slice) -> np.ndarray:
    """Return how far the picture moved between a frame and others, as a ratio of the longer side: (others,)."""
    return np.quantile(np.linalg.norm(trajectories[others] - trajectories[first], axis=2), _MOTION_QUANTILE, axis=1)


def _window_grid(shape: tuple[int, ...]) -> tuple[list[tuple[int, int]], tuple[int, int]]:
    """Return the (top, left) corners of evenly spaced windows, and their (height, width)."""
    height, width = (min(_WINDOW_PIXELS, side) for side in shape)
    down, right = (
        np.linspace(0, side - size, max(1, -(-(side - size) // _WINDOW_STRIDE_PIXELS) + 1)).round().astype(int)
        for side, size in zip(shape, (height, width), strict=True)
    )
    return [(top, left) for top in down for left in right], (height, width)


def _window_spectra(frame: np.ndarray) -> np.ndarray:
    """Return the Fourier transforms of the windows of a frame, each tapered to its edges."""
    corners, (height, width) = _window_grid(frame.shape)
    windows_pixels = np.stack([frame[top : top + height, left : left + width] for top, left in corners]).astype(
        np.float32
    )
    windows_pixels -= windows_pixels.mean(axis=(1, 2), keepdims=True)
    taper = np.outer(np.hanning(height + 2)[1:-1], np.hanning(width + 2)[1:-1]).astype(np.float32)
    return fft.rfft2(windows_pixels * taper)


def _measure_shift(before: np.ndarray, after: np.ndarray) -> np.ndarray | None:
    """Return the shift of each window in pixels, right and down: (windows, 2); None if most do not correlate."""
    height, width = before.shape[1], 2 * (before.shape[2] - 1)
    cross = after * before.conj()
    peaks = fft.irfft2(cross / (np.abs(cross) + 1e-6), s=(height, width))
    windows = np.arange(len(peaks))
    down, right = np.divmod(peaks.reshape(len(peaks), -1).argmax(axis=1), width)
    heights = peaks[windows, down, right]
    if np.median(heights) < _MIN_MEDIAN_PEAK:
        return None

    def peak_offset(low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Return the sub-pixel offset of the vertex of the parabola through the peak and its two neighbours."""
        curvature = low - 2 * heights + high
        return 0.5 * (low - high) / np.where(np.abs(curvature) > 1e-9, curvature, np.inf)

    x = right + peak_offset(peaks[windows, down, right - 1], peaks[windows, down, (right + 1) % width])
    y = down + peak_offset(peaks[windows, down - 1, right], peaks[windows, (down + 1) % height, right])
    shift = np.stack((np.where(x > width / 2, x - width, x), np.where(y > height / 2, y - height, y)), axis=1)
    is_reliable = heights >= _MIN_WINDOW_PEAK
    shift[~is_reliable] = np.median(shift[is_reliable], axis=0)
    return shift

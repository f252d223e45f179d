"""The exposure map of a model: exposure and white balance as a smooth function of the viewpoint.

Photos of one capture differ in exposure. A model that is trained with per-image gains has one consistent exposure. The
map predicts the gains of any viewpoint, so that a render looks like the photos taken near it.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from torch import Tensor

MAX_CENTERS = 64
MAX_LOG_GAIN = 8.0
MAX_POSITION_CODE = 255
MAX_DIRECTION_CODE = 127
MAX_WEIGHT_CODE = 32767


def apply_exposure_gains(image: Tensor, gains: Tensor) -> Tensor:
    """Change the exposure of an image by gains with the shoulder of a camera's tone curve.

        y' = g y / (1 + (g - 1) y)        that is, logit y' = logit y + log g

    Black and white do not change, g is the gain in the shadows, and applying g and then h equals applying g h. The
    colours of a point in different photos follow this curve more closely than a linear gain
    (`docs/research/exposure.md`).

    Args:
        image: (..., 3) in [0, 1].
        gains: (3,) or (..., 3), positive.

    Returns:
        (..., 3) in [0, 1]. Differentiable in both.

    Example:
        >>> apply_exposure_gains(torch.tensor([0.0, 0.5, 1.0]), torch.tensor([3.0, 3.0, 3.0]))
        tensor([0.0000, 0.7500, 1.0000])
    """
    return gains * image / (1 + (gains - 1) * image)


def clamp_colors(image: Tensor) -> Tensor:
    """Return an image (..., 3) with colours clamped to [0, 1], for which exposure gains are defined.

    Colour residuals can make colours brighter than white. The gradient is that of the image itself, so that training
    can darken them.
    """
    values = image.detach()
    return image + (values.clamp(0, 1) - values)


def inverse_quadratic_kernel(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the inverse quadratic kernel 1 / (1 + |a - b|^2), (N, M), of features (N, D) and (M, D).

    Its slope is at most 3 sqrt(3) / 8 for each unit of distance.
    """
    return 1 / (1 + np.square(a[:, None] - b[None]).sum(-1))


@dataclass(frozen=True, eq=False)
class ExposureMap:
    """Kernel regression of log gains over the training cameras, which predicts the gains of any viewpoint.

        log g(x, f) = clip(mean + sum_m k((x', f), (x_m, f_m)) w_m, lowest, highest)
        k((x, f), (y, h)) = 1 / (1 + |x - y|^2 / l_x^2 + |f - h|^2 / l_f^2)

    x is the viewpoint's position in local units, f its unit viewing direction, and x' the point nearest to x in the box
    of the training cameras: a viewpoint outside the box has the exposure of the nearest one inside. The function is
    continuous, and Lipschitz with the constants `slope_bounds`. The attributes are the numbers that a file stores, so
    writing and reading a map changes nothing.

    Attributes:
        box: (2, 3) float32, lowest and highest coordinate of the training cameras per axis, local units.
        lengths: (2,) float32 > 0, l_x in local units and l_f in units of the sphere of directions.
        mean: (3,) float32 log gains far from all centres.
        limits: (2, 3) float32, lowest and highest log gain of each channel, in [-8, 8].
        steps: (3,) float32, quantisation step of the weights of each channel.
        positions: (M, 3) uint8, x_m = box[0] + code / 255 (box[1] - box[0]). M <= 64.
        directions: (M, 3) int8, f_m = code / 127.
        weights: (M, 3) int16, w_m = code * step.
    """

    box: np.ndarray
    lengths: np.ndarray
    mean: np.ndarray
    limits: np.ndarray
    steps: np.ndarray
    positions: np.ndarray
    directions: np.ndarray
    weights: np.ndarray

    def __post_init__(self) -> None:
        """Check the fields.

        Raises:
            ValueError: a number is not finite or out of range, or shapes do not fit.
        """
        count = len(self.positions)
        shapes = ((2, 3), (2,), (3,), (2, 3), (3,), (count, 3), (count, 3), (count, 3))
        types = ("f4",) * 5 + ("u1", "i1", "i2")
        for field, shape, kind in zip(fields(self), shapes, types, strict=True):
            values = getattr(self, field.name)
            if values.shape != shape or values.dtype != np.dtype(kind):
                raise ValueError(
                    f"an exposure map's {field.name} are {values.dtype} {values.shape}, not {kind} {shape}"
                )
            if not np.isfinite(values).all():
                raise ValueError(f"an exposure map's {field.name} must be finite")
        if count > MAX_CENTERS:
            raise ValueError(f"an exposure map has {count} centers; it may have {MAX_CENTERS}")
        if not (self.box[0] <= self.box[1]).all():
            raise ValueError("the box of an exposure map must have its least corner first")
        if not (self.lengths > 0).all():
            raise ValueError("the lengths of an exposure map must be positive")
        if not (self.limits[0] <= self.limits[1]).all() or np.abs(self.limits).max() > MAX_LOG_GAIN:
            raise ValueError(f"log gains of an exposure map must lie in order within {MAX_LOG_GAIN:g} of 0")

    def predict_log_gains(self, position: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Predict the log gains of viewpoints.

        Args:
            position: (..., 3) positions in local units.
            direction: (..., 3) unit viewing directions.

        Returns:
            (..., 3) float64 within `limits`.
        """
        positions, directions = (np.asarray(part, np.float64).reshape(-1, 3) for part in (position, direction))
        log_gains = self.mean + self.evaluate_kernel(positions, directions) @ self._weights
        return np.clip(log_gains, *self.limits.astype(np.float64)).reshape(np.shape(position))

    def evaluate_kernel(self, positions: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Return the kernel (N, M) between viewpoints, given by positions and directions (N, 3), and the centres."""
        return inverse_quadratic_kernel(
            self._features(np.clip(positions, *self.box.astype(np.float64)), directions), self._centers
        )

    def evaluate_center_kernel(self) -> np.ndarray:
        """Return the kernel (M, M) between all centres."""
        return inverse_quadratic_kernel(self._centers, self._centers)

    def predict_gains(self, camera_from_local: np.ndarray) -> np.ndarray:
        """Predict the gains (3,) float64 of a camera from its pose camera_from_local (4, 4)."""
        pose = np.asarray(camera_from_local, np.float64)
        return np.exp(self.predict_log_gains(-pose[:3, :3].T @ pose[:3, 3], pose[2, :3]))

    @property
    def slope_bounds(self) -> tuple[float, float]:
        """Return bounds of the change of a log gain per local unit of position and per radian of viewing angle.

        For f = sum_m w_m k(., v_m) with the norm |f|^2 = w^T K w of its Hilbert space,

            |f(a) - f(b)| <= |f| sqrt(2 - 2 k(a, b)) <= sqrt(2) |f| |a - b|

        where |a - b| is the distance between features: position over l_x, direction over l_f.
        """
        gram = self.evaluate_center_kernel()
        norm = float(np.sqrt(np.maximum(np.einsum("mc,mn,nc->c", self._weights, gram, self._weights), 0).max()))
        along_position, along_direction = np.sqrt(2) * norm / self.lengths.astype(np.float64)
        return float(along_position), float(along_direction)

    @cached_property
    def _centers(self) -> np.ndarray:
        low, high = self.box.astype(np.float64)
        positions = low + self.positions / MAX_POSITION_CODE * (high - low)
        return self._features(positions, self.directions / MAX_DIRECTION_CODE)

    @cached_property
    def _weights(self) -> np.ndarray:
        return self.weights * self.steps.astype(np.float64)

    def _features(self, positions: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Return the features (N, 6) that the kernel compares: scaled positions and directions."""
        position_length, direction_length = self.lengths.astype(np.float64)
        return np.concatenate((positions / position_length, directions / direction_length), 1)

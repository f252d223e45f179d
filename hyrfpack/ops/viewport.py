"""A camera as the operations take it: its pose, its intrinsics and the size of its image."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

Intrinsics = tuple[float, float, float, float]


@dataclass(frozen=True)
class Viewport:
    """A pinhole camera and the size of its image. Operations compute no gradients of it.

    Attributes:
        pose: (4, 4) rigid transform camera_from_world, OpenCV axes. The world is the space of the points that an
            operation takes, in their unit. Preferably float64, and on the CPU, where GPU implementations read it.
        intrinsics: (fx, fy, cx, cy) in pixels; the first pixel's centre is (0.5, 0.5).
        width, height: image size in pixels, at least 1.

    Raises:
        ValueError: the pose has another shape, or the image has no pixels.
    """

    pose: Tensor
    intrinsics: Intrinsics
    width: int
    height: int

    def __post_init__(self) -> None:
        if self.pose.shape != (4, 4):
            raise ValueError(f"the pose is {tuple(self.pose.shape)}, expected (4, 4)")
        if self.width < 1 or self.height < 1:
            raise ValueError(f"a picture of {self.width} x {self.height} has no pixels")

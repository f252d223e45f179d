"""A camera as the operations take it: its pose, its intrinsics and the size of its image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from torch import Tensor

Intrinsics = tuple[float, float, float, float]
VIEWPOINT_PLACES = slice(25, 28)  # where the record of a packed camera has the camera's centre


class PackedCamera(NamedTuple):
    """The numbers of a camera that GPU kernels read, on the GPU.

    Without it each operation uploads them itself. A CUDA graph needs it, because a replayed kernel reads the same
    addresses for all cameras.

    Attributes:
        record: the result of `hyrfpack.ops.rasterize.gpu_project.pack_camera`.
        rays: (12,) float32, the numbers of `hyrfpack.ops.background.reference.camera_rays` in order.
    """

    record: Tensor
    rays: Tensor

    @property
    def viewpoint(self) -> Tensor:
        """The camera's centre (3,) float64."""
        return self.record[VIEWPOINT_PLACES]


@dataclass(frozen=True)
class Viewport:
    """A pinhole camera and the size of its image. Operations compute no gradients of it.

    Attributes:
        pose: (4, 4) rigid transform camera_from_world, OpenCV axes. The world is the space of the points that an
            operation takes, in their unit. Preferably float64, and on the CPU, where GPU implementations read it.
        intrinsics: (fx, fy, cx, cy) in pixels; the first pixel's centre is (0.5, 0.5).
        width, height: image size in pixels, at least 1.
        packed: the numbers of this camera for GPU kernels, made for the settings of the operations that take it; None
            if operations are to upload them.

    Raises:
        ValueError: the pose has another shape, or the image has no pixels.
    """

    pose: Tensor
    intrinsics: Intrinsics
    width: int
    height: int
    packed: PackedCamera | None = None

    def __post_init__(self) -> None:
        if self.pose.shape != (4, 4):
            raise ValueError(f"the pose is {tuple(self.pose.shape)}, expected (4, 4)")
        if self.width < 1 or self.height < 1:
            raise ValueError(f"a picture of {self.width} x {self.height} has no pixels")

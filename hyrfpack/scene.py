"""Cameras, pictures, views and scenes as plain numpy data, without torch.

Cameras follow OpenCV: x right, y down, z forward, pixel centres at .5, poses are rigid `camera_from_world`.
The readers in `hyrfpack.data` convert every input to this form; later stages need not know about file layouts.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from numbers import Integral
from typing import Any, TypeVar

import numpy as np

Item = TypeVar("Item")
# Largest allowed entry of |R R^T - I|. Text files round poses, so that rotations read from them are not exact.
RIGID_TOLERANCE = 1e-3
DEFAULT_TEST_EVERY = 8  # every 8th photo is held out
# Photos whose longer side has more pixels are shrunk to this length, as in 3DGS.
DEFAULT_MAX_SIZE = 1600
MIN_MAX_SIZE = 16  # shrunk further, photos show too little to train on; SSIM alone compares windows of 11 pixels

# Poses and sizes are float32 in files and pictures. Its range is wider, as cameras may stand far outside of a scene.
MAX_WORLD_COORDINATE = 1e30


def is_max_size(value: int) -> bool:
    """Return whether photos can be shrunk to this many pixels on the longer side; 0 keeps their size."""
    return value == 0 or value >= MIN_MAX_SIZE


def rigid_pose(values: object) -> np.ndarray:
    """Convert a rigid transform to a new (4, 4) float64 array and check it.

    Args:
        values: (4, 4) or (3, 4) numbers, an array or nested lists.

    Raises:
        ValueError: the shape is wrong, a number is not finite in float32, or the transform is not a rotation and a
            translation to within RIGID_TOLERANCE.
    """
    try:
        pose = np.array(values, np.float64)
    except TypeError as error:
        raise ValueError(f"the pose is not made of numbers ({error})") from error
    if pose.shape == (3, 4):
        pose = np.vstack((pose, (0, 0, 0, 1)))
    if pose.shape != (4, 4):
        raise ValueError(f"the pose has the shape {pose.shape} instead of (4, 4)")
    with np.errstate(over="ignore"):
        if not np.isfinite(pose.astype(np.float32)).all():
            raise ValueError("the pose is not finite (NaN, Inf or beyond float32)")
    rotation = pose[:3, :3]
    is_scaled = np.abs(rotation).max() > 2 or np.abs(rotation @ rotation.T - np.eye(3)).max() > RIGID_TOLERANCE
    if is_scaled or np.abs(pose[3] - (0, 0, 0, 1)).max() > RIGID_TOLERANCE:
        raise ValueError("the pose is not rigid (its axes are scaled or skewed)")
    if np.linalg.det(rotation) < 0:
        raise ValueError("the pose mirrors the world")
    return pose


@dataclass(frozen=True, eq=False)
class Camera:
    """An undistorted pinhole camera. Two cameras are equal if all their numbers are equal.

    Attributes:
        width, height: picture size in pixels.
        fx, fy: focal lengths in pixels.
        cx, cy: principal point in pixels; the top-left corner of the picture is (0, 0), the centre of its first
            pixel (0.5, 0.5).
        camera_from_world: (4, 4) float64 rigid transform, row-major, last row (0, 0, 0, 1). Nested lists are accepted,
            and the last row may be left out; the camera stores a copy.

    Raises:
        ValueError: the picture has no pixels, a side is not an integer, a focal length is not positive, a number is not
            finite, or the pose is not rigid, see `rigid_pose`.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    camera_from_world: np.ndarray

    def __post_init__(self) -> None:
        if not isinstance(self.width, Integral) or not isinstance(self.height, Integral):
            raise ValueError(f"a camera of {self.width!r} x {self.height!r} pixels; both must be integers")
        if self.width < 1 or self.height < 1:
            raise ValueError(f"a camera of {self.width} x {self.height} pixels; each side needs at least one")
        if not (np.isfinite(self.intrinsics).all() and self.fx > 0 and self.fy > 0):
            raise ValueError(f"the intrinsics {self.intrinsics} must be finite, the focal lengths positive")
        # Numbers of NumPy are converted, because they cannot be written as JSON and small integers overflow.
        for name in ("width", "height"):
            object.__setattr__(self, name, int(getattr(self, name)))
        for name in ("fx", "fy", "cx", "cy"):
            object.__setattr__(self, name, float(getattr(self, name)))
        try:
            object.__setattr__(self, "camera_from_world", rigid_pose(self.camera_from_world))
        except ValueError as error:
            raise ValueError(f"camera_from_world: {error}") from error

    def __eq__(self, other: object) -> bool:
        return self._numbers() == other._numbers() if isinstance(other, Camera) else NotImplemented

    def __hash__(self) -> int:
        return hash(self._numbers())

    def _numbers(self) -> tuple[float, ...]:
        return self.width, self.height, *self.intrinsics, *self.camera_from_world.ravel().tolist()

    @property
    def rotation(self) -> np.ndarray:
        """Return the (3, 3) rotation from world to camera axes; its rows are the camera's axes in the world."""
        return self.camera_from_world[:3, :3]

    @property
    def position(self) -> np.ndarray:
        """Return the centre of projection (3,) in world coordinates: -R^T t."""
        return -self.rotation.T @ self.camera_from_world[:3, 3]

    @property
    def forward(self) -> np.ndarray:
        """Return the unit viewing direction (3,) in world coordinates."""
        return self.rotation[2]

    @property
    def intrinsics(self) -> tuple[float, float, float, float]:
        """Return (fx, fy, cx, cy) in pixels."""
        return self.fx, self.fy, self.cx, self.cy

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Project world points (N, 3) to the picture.

        Returns:
            x and y in pixels, (N,) each, and the camera z in world units, (N,). A point is in front of the camera if
            z > 0; for others x and y have no meaning and may not be finite.
        """
        x, y, z = (points @ self.rotation.T + self.camera_from_world[:3, 3]).T
        with np.errstate(divide="ignore", invalid="ignore"):
            return self.fx * x / z + self.cx, self.fy * y / z + self.cy, z

    def in_picture(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Return which of the points that `project` gave lie in front of the camera and in the picture, (N,) bool."""
        return np.asarray((z > 0) & (x >= 0) & (x < self.width) & (y >= 0) & (y < self.height))

    def unproject(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Return the world points (N, 3) at x and y in pixels and camera z in world units: the inverse of `project`."""
        seen = np.stack(((x - self.cx) / self.fx * z, (y - self.cy) / self.fy * z, z), axis=1)
        return (seen - self.camera_from_world[:3, 3]) @ self.rotation


@dataclass(frozen=True, eq=False)
class Picture:
    """A decoded photo with straight (not premultiplied) alpha, as stored.

    Two pictures are never equal unless they are the same object; compare their arrays instead.

    Attributes:
        rgb: (H, W, 3) uint8, display-referred sRGB.
        alpha: (H, W) uint8 coverage; None if the photo is opaque.
        mask: (H, W) bool, True where a pixel may be used for training and scoring, or None for all.
    """

    rgb: np.ndarray
    alpha: np.ndarray | None = None
    mask: np.ndarray | None = None

    @property
    def nbytes(self) -> int:
        """Return the number of bytes of memory that the arrays of this picture take."""
        return sum(part.nbytes for part in (self.rgb, self.alpha, self.mask) if part is not None)

    def composite(self, background: np.ndarray | None = None) -> np.ndarray:
        """Composite the picture over a solid colour.

        Args:
            background: (3,) RGB in [0, 1]; black when None. Ignored by opaque pictures.

        Returns:
            (H, W, 3) float32 in [0, 1]: alpha * rgb + (1 - alpha) * background.
        """
        rgb = self.rgb.astype(np.float32) * np.float32(1 / 255)
        if self.alpha is None:
            return rgb
        alpha = self.alpha.astype(np.float32)[..., None] * np.float32(1 / 255)
        rgb *= alpha
        if background is not None:
            rgb += (1 - alpha) * np.asarray(background, dtype=np.float32)
        return rgb


@dataclass(frozen=True)
class View:
    """One photo with its camera. The photo is read and decoded only when `load` is called.

    Two views are equal if all their attributes are.

    Attributes:
        name: the photo's path below the picture folder, with its extension ("DSCF5565.jpg", "left/0001.png").
        camera: the camera after undistortion; its size is the size of the loaded picture.
        load: returns the Picture, whose size has been checked against the camera.
        is_resampled: whether the camera does not fit the stored photo even after scaling, because the picture is
            undistorted, turned upright, or cut from a panorama.
    """

    name: str
    camera: Camera
    load: Callable[[], Picture]
    is_resampled: bool = False


@dataclass(frozen=True, eq=False)
class Scene:
    """Posed photos and the points of the reconstruction.

    Two scenes are never equal unless they are the same object; compare their views and points instead.

    Attributes:
        path: the folder that the scene was read from.
        layout: one of `hyrfpack.data.LAYOUTS`, "colmap" or "nerfstudio" for instance.
        train, test: training views and held-out views, each sorted by name; disjoint.
        points: (P, 3) float64 world positions; P may be 0.
        point_colors: (P, 3) float32 RGB in [0, 1].
        has_alpha: whether photos have transparent pixels (object-centred captures without a background).
        notes: sentences for the user about what the reader skipped or assumed.
        files: every file that the scene was or will be read from: tables of poses, points, photos, masks.
        max_size: photos whose longer side has more pixels are shrunk to this length; 0 if photos are loaded as stored,
            None if the scene was not read from files.
        tracks: maps a view's name to (M,) int64 rows of `points` that the reconstruction found in that photo, in
            ascending order; empty if the input has no tracks. A point may lie outside the picture, because undistortion
            crops pictures.
        reading: all arguments of `hyrfpack.load_scene` that read the scene, including defaults, with an absolute path;
            empty if the scene was not read from files.

    Raises:
        ValueError: a point or its colour is not finite, or a track refers to a point that does not exist.
    """

    path: str
    layout: str
    train: list[View]
    test: list[View]
    points: np.ndarray
    point_colors: np.ndarray
    has_alpha: bool = False
    notes: list[str] = field(default_factory=list)
    files: tuple[str, ...] = ()
    max_size: int | None = None
    tracks: Mapping[str, np.ndarray] = field(default_factory=dict)
    reading: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not (np.isfinite(self.points).all() and np.isfinite(self.point_colors).all()):
            raise ValueError("points and their colours must be finite; leave out those that are not")
        for name, rows in self.tracks.items():
            if rows.dtype != np.int64 or rows.ndim != 1:
                raise ValueError(f"tracks of {name}: rows are (M,) int64, not {rows.shape} {rows.dtype}")
            if len(rows) and not 0 <= rows.min() <= rows.max() < len(self.points):
                raise ValueError(f"tracks of {name}: rows {rows.min()} to {rows.max()} of {len(self.points)} points")

    def __repr__(self) -> str:
        return (
            f"Scene({self.path!r}, {self.layout!r}: {len(self.train)} views to train on, {len(self.test)} held out, "
            f"{len(self.points)} points)"
        )

    def with_held_out(self, names: Collection[str]) -> Scene:
        """Return the same scene with another set of held-out views.

        Args:
            names: names of the views to hold out.

        Raises:
            ValueError: no view has one of the names, or no view is left for training.
        """
        if unknown := sorted(set(names) - {view.name for view in self.views}):
            raise ValueError(f"no photo is named {unknown[0]}")
        train = [view for view in self.views if view.name not in names]
        if not train:
            raise ValueError("all photos are held out and none is left to train on")
        return replace(self, train=train, test=[view for view in self.views if view.name in names])

    @property
    def views(self) -> list[View]:
        """Return training and held-out views together, sorted by name."""
        return sorted(self.train + self.test, key=lambda view: view.name)

    def shown_points(self, view: View) -> np.ndarray:
        """Return the rows (M,) of the points that a photo shows.

        They are those of its tracks. Without any tracks they are all points in its picture, also occluded ones.
        """
        if self.tracks:
            return self.tracks.get(view.name, np.zeros(0, np.int64))
        return np.flatnonzero(view.camera.in_picture(*view.camera.project(self.points)))


def evenly_spaced(items: Sequence[Item], count: int) -> list[Item]:
    """Select at most `count` evenly spaced items (for instance views), including the first and the last."""
    indices = np.linspace(0, len(items) - 1, min(count, len(items))).round().astype(int)
    return [items[index] for index in indices]

"""Cut panoramas of the whole sphere (equirectangular) into square pinhole pictures, the faces of a cube.

A panorama's camera has the usual axes (x right, y down, z forward), and the picture's centre looks forward.
Pixel (u, v) of a W x H picture, H = W / 2, looks along

    longitude = 2 pi (u / W - 1/2) = atan2(x, z),   latitude = pi (v / H - 1/2) = atan2(y, sqrt(x^2 + z^2)),

with longitude to the right and latitude downwards. nerfstudio (EQUIRECTANGULAR, in OpenGL axes) and Metashape
(spherical) use the same convention.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hyrfpack.atomic import replace_file
from hyrfpack.data.archive import display_path
from hyrfpack.data.pictures import (
    PictureHeader,
    has_same_aspect,
    is_tagged_panorama,
    read_header,
    read_mask,
    read_pixels,
)
from hyrfpack.data.undistort import Lens
from hyrfpack.errors import HyrfDataError
from hyrfpack.scene import Picture, View

_JPEG_QUALITY = 95
_PREVIEW_SIZE_PIXELS = (256, 128)  # width and height at which `is_panorama` examines a picture
_MIN_EDGE_DETAIL_LEVELS = 1.0  # of 255; the detail at a panorama's edges exceeds the difference of the edges by this


@dataclass(frozen=True)
class Face:
    """One side of the cube around a panorama's camera, 90 degrees across.

    Attributes:
        name: front, right, back, left, up or down.
        axes: the face's right, down and forward axes in the panorama's camera. They are the rows of the rotation from
            the panorama's camera to the face's camera.
    """

    name: str
    axes: tuple[tuple[int, int, int], tuple[int, int, int], tuple[int, int, int]]

    def photo_name(self, panorama_name: str, ending: str) -> str:
        """Return the name of the face's photo: "street_front.jpg" of "street.jpg" with the ending ".jpg"."""
        return f"{panorama_name.removesuffix(ending)}_{self.name}{ending}"

    def panorama_name(self, photo_name: str, ending: str) -> str:
        """Return the name of the panorama of a face's photo, the inverse of `photo_name`."""
        return photo_name.removesuffix(f"_{self.name}{ending}") + ending

    @property
    def rotation(self) -> np.ndarray:
        """(3, 3) rotation from the panorama's camera to the face's camera."""
        return np.array(self.axes, np.float64)


CUBE_FACES = (
    Face("front", ((1, 0, 0), (0, 1, 0), (0, 0, 1))),
    Face("right", ((0, 0, -1), (0, 1, 0), (1, 0, 0))),
    Face("back", ((-1, 0, 0), (0, 1, 0), (0, 0, -1))),
    Face("left", ((0, 0, 1), (0, 1, 0), (-1, 0, 0))),
    # The camera is tilted up, so what is in front of the panorama's camera appears below the face's centre.
    Face("up", ((1, 0, 0), (0, 0, 1), (0, -1, 0))),
    Face("down", ((1, 0, 0), (0, 0, -1), (0, 1, 0))),
)


@dataclass(frozen=True)
class FaceFile:
    """A face of a panorama on disk; calling it loads the Picture.

    Transparent pixels of a panorama, such as a tripod that was cut out, are ignored like masked ones.

    Attributes:
        path: the panorama.
        stored: (width, height) of the panorama in pixels.
        face: the face to cut out.
        size: side of the face in pixels.
        mask: the file of the panorama's mask, if any.
    """

    path: Path
    stored: tuple[int, int]
    face: Face
    size: int
    mask: Path | None = None

    def __call__(self) -> Picture:
        rgb, alpha = read_pixels(self.path)
        if rgb.shape[1::-1] != self.stored:
            shown = display_path(self.path)
            raise HyrfDataError(
                f"{shown}: the picture changed its size since the scene was read",
                fix="read the scene again",
            )
        mask = None
        if self.mask is not None:
            mask = self._cut_mask(read_mask(self.mask, *rgb.shape[:2]))
        if alpha is not None and alpha.min() < 255:
            is_opaque = self._cut_mask(alpha == 255)
            mask = is_opaque if mask is None else mask & is_opaque
        return Picture(cut_face(rgb, self.face, self.size), None, mask)

    def _cut_mask(self, usable: np.ndarray) -> np.ndarray:
        """Return the mask of the face: pixels whose colours come from usable pixels (H, W) of the panorama alone."""
        return cut_face(np.uint8(255) * usable[..., None], self.face, self.size)[..., 0] == 255


def face_size(width: int) -> int:
    """Return the side of a face in pixels, width / pi, at which its centre has the resolution of the panorama.

    Args:
        width: width of the panorama in pixels.
    """
    return max(1, round(width / math.pi))


def face_lens(size: int) -> Lens:
    """Return the pinhole lens of a face of `size` x `size` pixels, with fields of view of 90 degrees."""
    return Lens(size, size, size / 2, size / 2, size / 2, size / 2)


def group_faces(views: Sequence[View]) -> list[list[View]]:
    """Group views by photo: faces of one panorama are one group, and each other view is one by itself."""
    groups: dict[str, list[View]] = {}
    for view in views:
        photo = f"panorama {view.load.path}" if isinstance(view.load, FaceFile) else f"view {view.name}"
        groups.setdefault(photo, []).append(view)
    return list(groups.values())


def cut_face(panorama: np.ndarray, face: Face, size: int) -> np.ndarray:
    """Cut one face out of a panorama as a pinhole picture.

    First, a panorama that is finer than the face is shrunk (Lanczos, wrapped at the left and right edges). Then its
    rows near the poles are averaged over as many columns as a pixel of the face covers. Finally it is sampled
    (bilinear).

    Args:
        panorama: (H, 2 H, C) uint8.
        face: one of CUBE_FACES.
        size: side of the face in pixels.

    Returns:
        (size, size, C) uint8.

    Raises:
        ValueError: the panorama is not twice as wide as high.

    Example:
        >>> from hyrfpack.data.equirectangular import CUBE_FACES, cut_face
        >>> sky = np.full((64, 128, 3), 200, np.uint8)
        >>> cut_face(sky, CUBE_FACES[4], 32).shape
        (32, 32, 3)
    """
    if not has_same_aspect(panorama.shape[1], panorama.shape[0], 2, 1):
        raise ValueError(f"a panorama is twice as wide as high, not {panorama.shape[1]} x {panorama.shape[0]}")
    panorama = _shrink(panorama, max(2, 2 * round(size * math.pi / 2)))
    if face.name in ("up", "down"):
        panorama = _smooth_pole(panorama, 0 if face.name == "up" else 1, size)
    height, width = panorama.shape[:2]
    row, column = _source_coordinates(face, size, height, width)
    top, left = np.floor(row).astype(np.intp), np.floor(column).astype(np.intp)
    a, b = (column - left)[..., None].astype(np.float32), (row - top)[..., None].astype(np.float32)

    def pixels(rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        beyond = (rows < 0) | (rows >= height)  # beyond a pole, the opposite meridian continues
        return panorama[np.clip(rows, 0, height - 1), (columns + beyond * (width // 2)) % width]

    above = pixels(top, left) * (1 - a) + pixels(top, left + 1) * a
    below = pixels(top + 1, left) * (1 - a) + pixels(top + 1, left + 1) * a
    return (above * (1 - b) + below * b + 0.5).astype(np.uint8)


def cut_panorama(path: str | os.PathLike[str], folder: str | os.PathLike[str]) -> list[Path]:
    """Write the six faces of a panorama as JPEG files, "pano_front.jpg" and so on, for structure-from-motion.

    All faces share the centre of projection and the lens `face_lens(size)` with the `face_size` of the panorama;
    CUBE_FACES has their rotations.

    Args:
        path: the panorama.
        folder: folder to write into; created if it is missing. Existing files of these names are replaced.

    Returns:
        Paths of the files, in the order of CUBE_FACES.

    Raises:
        HyrfDataError: the file cannot be read, or is not twice as wide as high.
        HyrfError: the files cannot be written.

    Example:
        >>> from hyrfpack.data.equirectangular import cut_panorama
        >>> from PIL import Image
        >>> Image.new("RGB", (128, 64)).save("street.png")
        >>> [file.name for file in cut_panorama("street.png", "faces")][:2]
        ['street_front.jpg', 'street_right.jpg']
    """
    from PIL import Image

    path = Path(path)
    size = face_size(panorama_lens(path, read_header(path)).width)
    rgb, _ = read_pixels(path)
    written = []
    for face in CUBE_FACES:
        file = Path(folder, f"{path.stem}_{face.name}.jpg")
        picture = Image.fromarray(cut_face(rgb, face, size))
        with replace_file(file) as temporary:
            picture.save(temporary, "JPEG", quality=_JPEG_QUALITY, subsampling=0)
        written.append(file)
    return written


def panorama_lens(path: Path, header: PictureHeader) -> Lens:
    """Return the lens of a panorama, which `assemble_scene` cuts into faces.

    Raises:
        HyrfDataError: the picture is not twice as wide as high.
    """
    width, height = header.size
    if not has_same_aspect(width, height, 2, 1):
        raise HyrfDataError(
            f"{path}: an equirectangular picture is twice as wide as high, but this one is {width} x {height}",
            fix="use the whole panorama",
        )
    focal = width / (2 * math.pi)
    return Lens(width, height, focal, focal, width / 2, height / 2, "equirectangular")


def is_panorama(path: str | os.PathLike[str]) -> bool:
    """Return whether a picture is a panorama of the whole sphere.

    It is one if it is twice as wide as high, and if its XMP data or its content say so. The content fits if the left
    edge continues the right edge, the first and the last row, which show one point each, are nearly uniform, and the
    edges differ from the rest of their rows and vary from row to row. The edges of an ordinary photo with a plain
    background continue each other too, but they do not differ and vary so.

    Raises:
        HyrfDataError: the file is no picture.

    Example:
        >>> from hyrfpack.data.equirectangular import is_panorama
        >>> is_panorama("photos/bonsai/images/0000.png")
        False
    """
    header = read_header(Path(path))
    if header.width != 2 * header.height or header.height < _PREVIEW_SIZE_PIXELS[1]:
        return False
    if is_tagged_panorama(Path(path)):
        return True
    rgb = read_pixels(Path(path), _PREVIEW_SIZE_PIXELS if header.size != _PREVIEW_SIZE_PIXELS else None)[0].astype(
        np.float32
    )
    steps = np.abs(np.diff(rgb, axis=1)).mean(axis=(0, 2))  # mean difference of neighbouring columns
    seam = np.abs(rgb[:, 0] - rgb[:, -1]).mean()
    spread = rgb.std(axis=1).mean(axis=1)  # standard deviation of the colours in each row
    edges = rgb[:, [0, -1]]
    row_difference = np.abs(edges - np.median(rgb, axis=1, keepdims=True)).mean()
    column_difference = np.abs(edges - np.median(edges, axis=0, keepdims=True)).mean()
    # A row at a pole shows only what lies within a degree of it, so its colours vary less than those of other rows.
    has_uniform_poles = max(spread[0], spread[-1]) <= max(0.5 * spread.max(), 2.0)
    has_detailed_edges = min(row_difference, column_difference) > seam + _MIN_EDGE_DETAIL_LEVELS
    return bool(seam <= 1.5 * steps.mean() and has_uniform_poles and has_detailed_edges)


def _source_coordinates(face: Face, size: int, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the (size, size) rows and (size, size) columns of the panorama that the pixels of a face show.

    Pixel centres are at integers. float32 is accurate to a thousandth of a pixel.
    """
    tangents = ((np.arange(size) + 0.5) * (2 / size) - 1).astype(np.float32)
    right, down = np.broadcast_arrays(tangents[None, :], tangents[:, None])
    x, y, z = np.moveaxis(
        np.stack((right, down, np.ones_like(right)), axis=-1) @ face.rotation.astype(np.float32), -1, 0
    )
    column = (np.arctan2(x, z) / (2 * np.pi) + 0.5) * width - 0.5
    row = (np.arctan2(y, np.hypot(x, z)) / np.pi + 0.5) * height - 0.5
    return row, column


def _shrink(panorama: np.ndarray, width: int) -> np.ndarray:
    """Shrink a panorama to at most `width` pixels in width, with a filter that wraps at the left and right edges."""
    from PIL import Image

    height, stored = panorama.shape[:2]
    if stored <= width:
        return panorama
    margin = min(stored, 4 * -(-stored // width))  # a Lanczos filter reaches three pixels of the result to each side
    padded = np.concatenate((panorama[:, -margin:], panorama, panorama[:, :margin]), axis=1)
    box = (margin, 0, margin + stored, height)
    parts = [Image.fromarray(padded[..., channel]) for channel in range(panorama.shape[2])]
    shrunk = [part.resize((width, width // 2), Image.Resampling.LANCZOS, box=box) for part in parts]
    return np.stack([np.asarray(part) for part in shrunk], axis=-1)


def _smooth_pole(panorama: np.ndarray, pole: int, size: int) -> np.ndarray:
    """Average rows near a pole (0 is above, 1 below) over the columns that a pixel of the face covers.

    At a given latitude these are W / (pi size cos(latitude)) columns.
    """
    panorama = panorama.copy()
    height, width = panorama.shape[:2]
    for distance in range(height // 3):
        half = int(0.5 * width / (math.pi * size * math.sin(math.pi * (distance + 0.5) / height)))
        half = min(half, (width - 1) // 2)
        if half == 0:
            break
        row = distance if pole == 0 else height - 1 - distance
        wrapped = np.concatenate((panorama[row, width - half - 1 :], panorama[row], panorama[row, :half]))
        sums = np.cumsum(wrapped, axis=0, dtype=np.int64)
        panorama[row] = (sums[2 * half + 1 :] - sums[: -2 * half - 1] + half) // (2 * half + 1)
    return panorama

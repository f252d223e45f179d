"""Photo files: headers at load time, pixels on demand, shrunk where that was asked for.

Pictures are taken as they are stored: an EXIF orientation is ignored, as structure-from-motion does, because the
camera was calibrated on the stored pixels.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hyrfpack.data.undistort import Lens, undistort
from hyrfpack.errors import HyrfDataError, needs_package
from hyrfpack.outputs import READABLE
from hyrfpack.scene import Picture

_SUFFIXES = (*READABLE, *map(str.upper, READABLE))
_SIXTEEN_BIT = ("I", "I;16", "I;16B", "I;16L", "I;16N")
_DRAFT = 2  # times the size asked for that a JPEG is decoded at, at least: 49 dB and more from decoding all of it


@dataclass(frozen=True)
class Header:
    """What a picture file says before its pixels are decoded."""

    width: int
    height: int
    has_alpha: bool

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self.width, self.height


@dataclass(frozen=True)
class PhotoFile:
    """Where a photo is and how to make it a pinhole picture; calling it loads the Picture.

    Attributes:
        path: the file.
        stored: (width, height) of the picture in it.
        lens: at the size to load, which is the stored one or less.
        mask: the file of its mask, if any.
    """

    path: Path
    stored: tuple[int, int]
    lens: Lens
    mask: Path | None = None

    def __call__(self) -> Picture:
        width, height = size = (self.lens.width, self.lens.height)
        shrunk = size != self.stored
        if shrunk and read_header(self.path).size != self.stored:
            raise self._changed()
        rgb, alpha = read_pixels(self.path, size if shrunk else None)
        if rgb.shape[:2] != (height, width):
            raise self._changed()
        mask = None if self.mask is None else read_mask(self.mask, height, width, whole=shrunk)
        picture = Picture(rgb, alpha, mask)
        return undistort(picture, self.lens) if self.lens.distorted else picture

    def _changed(self) -> HyrfDataError:
        return HyrfDataError(f"{self.path}: the picture changed its size since the scene was read; read it again")


def find_picture(path: Path) -> Path | None:
    """The file at `path`, or the same name with another or an added picture extension; None if there is none."""
    candidates = [path, *(Path(f"{path}{suffix}") for suffix in _SUFFIXES)]
    if path.suffix:
        candidates += [path.with_suffix(suffix) for suffix in _SUFFIXES]
    return next((candidate for candidate in candidates if os.path.isfile(candidate)), None)


def is_picture_name(name: str) -> bool:
    """Whether a file is called like a picture."""
    return name.lower().endswith(READABLE) and not name.startswith(".")


def mask_folder(root: Path, picture_folder: str) -> Path:
    """Where the masks of photos in a folder are: `masks/`, or "masks_2" for "images_2" if there is one."""
    suffix = picture_folder.removeprefix("images")
    return root / f"masks{suffix}" if suffix and (root / f"masks{suffix}").is_dir() else root / "masks"


def find_mask(folder: Path, name: str) -> Path | None:
    """The mask of photo `name` in a folder: under the same name, the name + ".png", or its stem + ".png"."""
    candidates = (folder / name, folder / f"{name}.png", (folder / name).with_suffix(".png"))
    return next((candidate for candidate in candidates if os.path.isfile(candidate)), None)


def same_aspect(width: int, height: int, of_width: int, of_height: int) -> bool:
    """Whether (width, height) is a uniform rescaling of the other size, each side rounded by less than a pixel."""
    return abs(width * of_height - height * of_width) <= of_width + of_height


def shrunk_size(width: int, height: int, max_size: int) -> tuple[int, int]:
    """(width, height) of a picture whose longer side may have `max_size` pixels; 0 allows any size."""
    longer = max(width, height)
    if not max_size or longer <= max_size:
        return width, height
    return max(1, round(width * max_size / longer)), max(1, round(height * max_size / longer))


def read_header(path: Path) -> Header:
    """Size and kind of a picture file.

    Raises:
        HyrfDataError: the file is missing, empty, or no picture.
    """
    with _opened(path) as image:
        return Header(image.width, image.height, _has_alpha(image))


def read_pixels(path: Path, size: tuple[int, int] | None = None) -> tuple[np.ndarray, np.ndarray | None]:
    """Decode a photo of any kind: grey, palette, 16 bit, with or without alpha.

    Args:
        path: the file.
        size: (width, height) to shrink it to, with a Lanczos filter, colours weighed by their alpha; None for the
            size that is stored. JPEG files are not decoded finer than that needs, which takes less time and memory.

    Returns:
        (H, W, 3) uint8 RGB (straight, grey repeated) and (H, W) uint8 alpha or None.

    Raises:
        HyrfDataError: the file is missing, truncated, or of a kind that has no display values.
    """
    with _opened(path) as image:
        from PIL import Image

        if image.mode == "F":
            raise HyrfDataError(f"{path}: floating-point pictures have no display values; save it as 8-bit PNG")
        try:
            # What a draft covers is its whole size, but for a fraction of a pixel at the right and at the bottom.
            draft = None if size is None else image.draft(None, (_DRAFT * size[0], _DRAFT * size[1]))
            if image.mode in _SIXTEEN_BIT:
                wide = np.asarray(image).astype(np.float64)
                picture = Image.fromarray((np.clip(wide, 0, 65535) / 257 + 0.5).astype(np.uint8))
            else:
                picture = image.convert("RGBA" if _has_alpha(image) else "RGB")
            if size is not None:
                picture = picture.resize(size, Image.Resampling.LANCZOS, box=None if draft is None else draft[1])
            pixels = np.array(picture)
        except Exception as error:  # Pillow's decoders raise whatever they meet.
            raise HyrfDataError(f"{path}: cannot decode the picture ({_reason(error)}); replace the file") from error
    if pixels.ndim == 2:
        return np.repeat(pixels[..., None], 3, axis=2), None
    if pixels.shape[2] == 4:
        return np.ascontiguousarray(pixels[..., :3]), np.ascontiguousarray(pixels[..., 3])
    return pixels, None


def read_mask(path: Path, height: int, width: int, *, whole: bool = False) -> np.ndarray:
    """Decode a mask: 0 is a pixel to ignore.

    Args:
        path: the file.
        height, width: to bring it to.
        whole: for photos that are shrunk: a pixel counts if everything that it covers does. Otherwise, and where the
            mask is smaller than asked for, the nearest pixel of the mask decides.

    Returns:
        (height, width) bool.
    """
    rgb, _ = read_pixels(path)
    usable = np.any(rgb, axis=2)
    if usable.shape == (height, width):
        return usable
    if whole and usable.shape[0] >= height and usable.shape[1] >= width:
        usable = np.logical_and.reduceat(usable, _covered(usable.shape[0], height), axis=0)[::2]
        usable = np.logical_and.reduceat(usable, _covered(usable.shape[1], width), axis=1)[:, ::2]
        return np.ascontiguousarray(usable)
    rows = (np.arange(height) * usable.shape[0]) // height
    columns = (np.arange(width) * usable.shape[1]) // width
    return usable[rows[:, None], columns]


def _covered(many: int, few: int) -> np.ndarray:
    """The first of `many` pixels that each of `few` covers, at least in part, and the one after the last, in turn."""
    starts = np.arange(few) * many // few
    ends = -(-np.arange(1, few + 1) * many // few)
    return np.stack((starts, ends), 1).ravel()[:-1]  # reduceat lets the last reach to the end by itself


def _has_alpha(image) -> bool:
    # A grey level that stands for "transparent" in 16-bit pictures is not honoured: it would not survive 8 bits.
    transparent = "transparency" in image.info and image.mode not in _SIXTEEN_BIT
    return transparent or image.mode in ("RGBA", "LA", "PA", "La", "RGBa")


def _opened(path: Path):
    """Open with Pillow; every way in which that fails is one sentence."""
    with needs_package("pillow", f"{path}: reading pictures"):
        from PIL import Image

    try:
        if os.path.getsize(path) == 0:
            raise HyrfDataError(f"{path}: the picture file is empty (0 bytes); copy it again")
        image = Image.open(path)
        if image.format == "EPS":  # a program, which Pillow would have Ghostscript run
            raise HyrfDataError(f"{path}: PostScript is not a photo; save it as PNG or JPEG")
    except HyrfDataError:
        raise
    except FileNotFoundError as error:
        raise HyrfDataError(f"{path}: the picture is missing; restore it or read the scene again") from error
    except Exception as error:  # Pillow's header parsers raise whatever they meet.
        raise HyrfDataError(f"{path}: not a picture that can be read ({_reason(error)}); replace the file") from error
    if min(image.size) < 1:
        raise HyrfDataError(f"{path}: the picture has no pixels ({image.size[0]} x {image.size[1]}); replace the file")
    return image


def _reason(error: Exception) -> str:
    return str(error).splitlines()[0][:120] if str(error) else type(error).__name__

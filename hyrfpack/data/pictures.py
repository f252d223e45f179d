"""Photo files: headers at load time, pixels on demand.

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
from hyrfpack.scene import Picture

_SUFFIXES = (".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG", ".webp", ".tif", ".tiff")
_SIXTEEN_BIT = ("I", "I;16", "I;16B", "I;16L", "I;16N")


@dataclass(frozen=True)
class Header:
    """What a picture file says before its pixels are decoded."""

    width: int
    height: int
    has_alpha: bool


@dataclass(frozen=True)
class PhotoFile:
    """Where a photo is and how to make it a pinhole picture; calling it loads the Picture."""

    path: Path
    lens: Lens
    mask: Path | None = None

    def __call__(self) -> Picture:
        rgb, alpha = read_pixels(self.path)
        size = (self.lens.height, self.lens.width)
        if rgb.shape[:2] != size:
            raise HyrfDataError(f"{self.path}: the picture changed its size since the scene was read; read it again")
        picture = Picture(rgb, alpha, None if self.mask is None else read_mask(self.mask, *size))
        return undistort(picture, self.lens) if self.lens.distorted else picture


def find_picture(path: Path) -> Path | None:
    """The file at `path`, or the same name with another or an added picture extension; None if there is none."""
    candidates = [path, *(Path(f"{path}{suffix}") for suffix in _SUFFIXES)]
    if path.suffix:
        candidates += [path.with_suffix(suffix) for suffix in _SUFFIXES]
    return next((candidate for candidate in candidates if os.path.isfile(candidate)), None)


def find_mask(root: Path, picture_folder: str, name: str) -> Path | None:
    """The mask of photo `name`: in `masks/` (or "masks_2" for "images_2", if there is one) below `root`, under
    the same name, the name + ".png", or its stem + ".png"."""
    suffix = picture_folder.removeprefix("images")
    folder = root / f"masks{suffix}" if suffix and (root / f"masks{suffix}").is_dir() else root / "masks"
    candidates = (folder / name, folder / f"{name}.png", (folder / name).with_suffix(".png"))
    return next((candidate for candidate in candidates if os.path.isfile(candidate)), None)


def same_aspect(width: int, height: int, of_width: int, of_height: int) -> bool:
    """Whether (width, height) is a uniform rescaling of the other size, each side rounded by less than a pixel."""
    return abs(width * of_height - height * of_width) <= of_width + of_height


def read_header(path: Path) -> Header:
    """Size and kind of a picture file.

    Raises:
        HyrfDataError: the file is missing, empty, or no picture.
    """
    with _opened(path) as image:
        has_alpha = _has_alpha(image)
        return Header(*image.size, has_alpha)


def read_pixels(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Decode a photo of any kind: grey, palette, 16 bit, with or without alpha.

    Returns:
        (H, W, 3) uint8 RGB (straight, grey repeated) and (H, W) uint8 alpha or None.

    Raises:
        HyrfDataError: the file is missing, truncated, or of a kind that has no display values.
    """
    with _opened(path) as image:
        if image.mode == "F":
            raise HyrfDataError(f"{path}: floating-point pictures have no display values; save it as 8-bit PNG")
        try:
            if image.mode in _SIXTEEN_BIT:
                wide = np.asarray(image).astype(np.float64)
                grey = (np.clip(wide, 0, 65535) / 257 + 0.5).astype(np.uint8)
                return np.repeat(grey[..., None], 3, axis=2), None
            if _has_alpha(image):
                pixels = np.array(image.convert("RGBA"))
                return np.ascontiguousarray(pixels[..., :3]), np.ascontiguousarray(pixels[..., 3])
            return np.array(image.convert("RGB")), None
        except Exception as error:  # Pillow's decoders raise whatever they meet.
            raise HyrfDataError(f"{path}: cannot decode the picture ({_reason(error)}); replace the file") from error


def read_mask(path: Path, height: int, width: int) -> np.ndarray:
    """Decode a mask: 0 is a pixel to ignore. Resized by nearest neighbour to (height, width), bool."""
    rgb, _ = read_pixels(path)
    usable = rgb.any(axis=2)
    if usable.shape == (height, width):
        return usable
    rows = (np.arange(height) * usable.shape[0]) // height
    columns = (np.arange(width) * usable.shape[1]) // width
    return usable[rows[:, None], columns]


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
            raise HyrfDataError(f"{path}: PostScript is no photo; save it as PNG or JPEG")
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

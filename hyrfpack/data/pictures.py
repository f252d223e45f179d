"""Photo files: headers at load time, pixels on demand, shrunk where that was asked for.

Pictures are taken as they are stored: an EXIF orientation is ignored, as structure-from-motion does, because the
camera was calibrated on the stored pixels. Only where sizes prove that it was not, the caller asks for another.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hyrfpack.data.archive import given_path
from hyrfpack.data.undistort import Lens, undistort
from hyrfpack.errors import HyrfDataError, HyrfError, needs_package, short_reason
from hyrfpack.outputs import RAW_PHOTO_SUFFIXES, READABLE_PICTURE_SUFFIXES
from hyrfpack.scene import Picture

if TYPE_CHECKING:
    from PIL.ImageFile import ImageFile

_SIXTEEN_BIT = ("I", "I;16", "I;16B", "I;16L", "I;16N")
_ORIENTATION = 0x0112  # EXIF's tag
_TURNS = {2: 0, 3: 3, 4: 1, 5: 5, 6: 4, 7: 6, 8: 2}  # its values -> Pillow's transpositions
_UNDONE = {6: 8, 8: 6}  # the others undo themselves
HEIC_NEEDS = "reading HEIC photos needs pillow-heif"
HEIC_REMEDY = "run 'pip install \"hyrfpack[heic]\"', or convert them to JPEG"
RAW_REMEDY = "export them as JPEG and name the folder that holds the exported photos"

_HEIC = (".heic", ".heif", ".hif")
_HEIC_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1")
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

    def turned(self, orientation: int) -> Header:
        """The same picture turned as an EXIF orientation says."""
        return replace(self, width=self.height, height=self.width) if orientation >= 5 else self


@dataclass(frozen=True)
class PhotoFile:
    """Where a photo is and how to make it a pinhole picture; calling it loads the Picture.

    Attributes:
        path: the file.
        stored: (width, height) of the picture in it, turned as `orientation` says.
        lens: at the size to load, which is that one or less.
        mask: the file of its mask, if any.
        orientation: of EXIF, that stored pixels are turned by.
    """

    path: Path
    stored: tuple[int, int]
    lens: Lens
    mask: Path | None = None
    orientation: int = 1

    def __call__(self) -> Picture:
        width, height = size = (self.lens.width, self.lens.height)
        shrunk = size != self.stored
        if shrunk and read_header(self.path).turned(self.orientation).size != self.stored:
            raise self._changed()
        rgb, alpha = read_pixels(self.path, size if shrunk else None, self.orientation)
        if rgb.shape[:2] != (height, width):
            raise self._changed()
        mask = None
        if self.mask is not None:
            upright = same_aspect(*read_header(self.mask).size, *self.stored)
            mask = read_mask(self.mask, height, width, whole=shrunk, orientation=1 if upright else self.orientation)
        picture = Picture(rgb, alpha, mask)
        return undistort(picture, self.lens) if self.lens.distorted else picture

    def _changed(self) -> HyrfDataError:
        return HyrfDataError(
            f"{given_path(self.path)}: the picture changed its size since the scene was read; read it again"
        )


def is_picture_name(name: str) -> bool:
    """Whether a file is called like a picture that can be read, and is not hidden."""
    return name.lower().endswith(READABLE_PICTURE_SUFFIXES) and not name.startswith(".")


def same_aspect(width: int, height: int, of_width: int, of_height: int) -> bool:
    """Whether (width, height) is a uniform rescaling of the other size, each side rounded by less than a pixel."""
    return abs(width * of_height - height * of_width) <= of_width + of_height


def shrunk_size(width: int, height: int, max_size: int) -> tuple[int, int]:
    """(width, height) of a picture whose longer side may have `max_size` pixels; 0 allows any size."""
    longer = max(width, height)
    if not max_size or longer <= max_size:
        return width, height
    return max(1, round(width * max_size / longer)), max(1, round(height * max_size / longer))


def opened(path: Path) -> ImageFile:
    """A picture file opened with Pillow, which has read its header alone; close it after use.

    Sizes and pixels are to be had by `read_header` and `read_pixels`: Pillow turns TIFF files without being asked.

    Raises:
        HyrfDataError: the file is missing, empty, raw, or no picture, or it is HEIC and pillow-heif is not installed.
    """
    shown = given_path(path)
    with needs_package("pillow", f"{shown}: reading pictures"):
        from PIL import Image, UnidentifiedImageError

    try:
        if path.suffix.lower() in RAW_PHOTO_SUFFIXES:  # many are TIFF files, and Pillow would read their previews
            raise HyrfDataError(f"{shown}: raw files are not supported; {RAW_REMEDY}")
        if os.path.getsize(path) == 0:
            raise HyrfDataError(f"{shown}: the picture file is empty (0 bytes); copy it again")
        _know_heic(path)
        image = Image.open(path)
        if image.format == "EPS":  # a program, which Pillow would have Ghostscript run
            raise HyrfDataError(f"{shown}: PostScript is not a photo; save it as PNG or JPEG")
    except HyrfError:
        raise
    except FileNotFoundError as error:
        raise HyrfDataError(f"{shown}: the picture is missing; restore it or read the scene again") from error
    except PermissionError as error:
        raise HyrfDataError(f"{shown}: the picture may not be read; check its permissions") from error
    except UnidentifiedImageError as error:  # whose text is the path
        raise HyrfDataError(
            f"{shown}: not a picture that can be read, its format is unknown; replace the file"
        ) from error
    except Exception as error:  # Pillow's header parsers raise whatever they meet.
        raise HyrfDataError(
            f"{shown}: not a picture that can be read ({short_reason(error)}); replace the file"
        ) from error
    if min(image.size) < 1:
        raise HyrfDataError(f"{shown}: the picture has no pixels ({image.size[0]} x {image.size[1]}); replace the file")
    return image


def read_header(path: Path) -> Header:
    """Size, as stored, and kind of a picture file.

    Raises:
        HyrfDataError: the file is missing, empty, or no picture.
    """
    with opened(path) as image:
        return Header(image.width, image.height, _has_alpha(image)).turned(_done_by_pillow(image))


def read_orientation(path: Path) -> int:
    """A picture file's EXIF orientation, 1 (as stored) to 8; 1 where it says none.

    Raises:
        HyrfDataError: the file is missing, empty, or no picture.
    """
    with opened(path) as image:
        try:
            orientation = _done_by_pillow(image) if image.format == "TIFF" else image.getexif().get(_ORIENTATION, 1)
        except Exception:  # damaged tags of a good picture
            return 1
    return orientation if orientation in _TURNS else 1


def says_panorama(path: Path) -> bool:
    """Whether a picture file's XMP calls it an equirectangular panorama (Google's GPano), as 360-degree cameras do.

    Raises:
        HyrfDataError: the file is missing, empty, or no picture.
    """
    with opened(path) as image:
        xmp = image.info.get("xmp") or b""
    xmp = xmp.encode() if isinstance(xmp, str) else bytes(xmp)
    return b"GPano:ProjectionType" in xmp and b"equirectangular" in xmp


def read_pixels(
    path: Path, size: tuple[int, int] | None = None, orientation: int = 1
) -> tuple[np.ndarray, np.ndarray | None]:
    """Decode a photo of any kind: grey, palette, 16 bit, with or without alpha.

    Args:
        path: the file.
        size: (width, height) to shrink it to, with a Lanczos filter, colours weighed by their alpha; None for the
            size that is stored. JPEG files are not decoded finer than that needs, which takes less time and memory.
        orientation: of EXIF, 1 to 8, to turn it by; `size` is that of the turned picture.

    Returns:
        (H, W, 3) uint8 RGB (straight, grey repeated) and (H, W) uint8 alpha or None.

    Raises:
        HyrfDataError: the file is missing, truncated, or of a kind that has no display values.
    """
    with opened(path) as image:
        from PIL import Image

        if image.mode == "F":
            raise HyrfDataError(
                f"{given_path(path)}: floating-point pictures have no display values; save it as 8-bit PNG"
            )
        try:
            # What a draft covers is its whole size, but for a fraction of a pixel at the right and at the bottom.
            stored = size[::-1] if size is not None and orientation >= 5 else size
            draft = None if stored is None else image.draft(None, (_DRAFT * stored[0], _DRAFT * stored[1]))
            done = _done_by_pillow(image)
            if done >= 5:
                image.filename = ""  # or it is mapped into memory, with the sides of the turned picture
            if image.mode in _SIXTEEN_BIT:
                wide = np.asarray(image).astype(np.float64)
                picture = Image.fromarray((np.clip(wide, 0, 65535) / 257 + 0.5).astype(np.uint8))
            else:
                picture = image.convert("RGBA" if _has_alpha(image) else "RGB")
            if done != 1:
                picture = picture.transpose(Image.Transpose(_TURNS[_UNDONE.get(done, done)]))
            if stored is not None:
                picture = picture.resize(stored, Image.Resampling.LANCZOS, box=None if draft is None else draft[1])
            if orientation != 1:
                picture = picture.transpose(Image.Transpose(_TURNS[orientation]))
            pixels = np.array(picture)
        except Exception as error:  # Pillow's decoders raise whatever they meet.
            shown = given_path(path)
            raise HyrfDataError(
                f"{shown}: cannot decode the picture ({short_reason(error)}); replace the file"
            ) from error
    if pixels.ndim == 2:
        return np.repeat(pixels[..., None], 3, axis=2), None
    if pixels.shape[2] == 4:
        return np.ascontiguousarray(pixels[..., :3]), np.ascontiguousarray(pixels[..., 3])
    return pixels, None


def read_mask(path: Path, height: int, width: int, *, whole: bool = False, orientation: int = 1) -> np.ndarray:
    """Decode a mask: 0 is a pixel to ignore.

    Args:
        path: the file.
        height, width: to bring it to.
        whole: for photos that are shrunk: a pixel counts if everything that it covers does. Otherwise, and where the
            mask is smaller than asked for, the nearest pixel of the mask decides.
        orientation: of EXIF, to turn it by.

    Returns:
        (height, width) bool.
    """
    rgb, _ = read_pixels(path, orientation=orientation)
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


def _done_by_pillow(image) -> int:
    """The orientation that Pillow turns a picture by without being asked, which it does to TIFF files alone."""
    orientation = image.tag_v2.get(_ORIENTATION, 1) if image.format == "TIFF" else 1
    return orientation if orientation in _TURNS else 1


def _has_alpha(image) -> bool:
    # A grey level that stands for "transparent" in 16-bit pictures is not honoured: it would not survive 8 bits.
    transparent = "transparency" in image.info and image.mode not in _SIXTEEN_BIT
    return transparent or image.mode in ("RGBA", "LA", "PA", "La", "RGBa")


def _know_heic(path: Path) -> None:
    """Have Pillow read HEIC, by a package that need not be there, before the first file of that kind."""
    with path.open("rb") as stream:
        start = stream.read(12)
    if path.suffix.lower() in _HEIC or (start[4:8] == b"ftyp" and start[8:] in _HEIC_BRANDS):
        try:
            import pillow_heif
        except ModuleNotFoundError as error:
            raise HyrfDataError(f"{given_path(path)}: {HEIC_NEEDS}; {HEIC_REMEDY}") from error
        pillow_heif.register_heif_opener()

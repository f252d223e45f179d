"""Read photo files: headers when a scene is loaded, pixels on demand, optionally shrunk.

The EXIF orientation is ignored by default, as in structure-from-motion, because cameras are calibrated on the stored
pixels. The caller passes an orientation only if the sizes prove that a camera was calibrated on the upright picture.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hyrfpack.data.archive import display_path
from hyrfpack.data.undistort import Lens, undistort
from hyrfpack.errors import HyrfDataError, HyrfError, needs_package, short_reason
from hyrfpack.outputs import RAW_PHOTO_SUFFIXES, READABLE_PICTURE_SUFFIXES
from hyrfpack.scene import Picture

if TYPE_CHECKING:
    from PIL.Image import Image as PilImage
    from PIL.ImageFile import ImageFile

_SIXTEEN_BIT_MODES = ("I", "I;16", "I;16B", "I;16L", "I;16N")
_ORIENTATION_TAG = 0x0112
_TRANSPOSITIONS = {2: 0, 3: 3, 4: 1, 5: 5, 6: 4, 7: 6, 8: 2}  # EXIF orientation -> Image.Transpose of Pillow
_INVERSE_ORIENTATIONS = {6: 8, 8: 6}  # every other orientation is its own inverse
HEIC_REQUIREMENT = "reading HEIC photos needs pillow-heif"
HEIC_REMEDY = "run 'pip install \"hyrfpack[heic]\"', or convert them to JPEG"
RAW_REMEDY = "export them as JPEG and name the folder that holds the exported photos"

_HEIC_EXTENSIONS = (".heic", ".heif", ".hif")
_HEIC_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1")
# A JPEG is decoded at this ratio of the requested size or more. The PSNR to a full decode is then at least 49 dB.
_MIN_DRAFT_SIZE_RATIO = 2
# Lossy compression raises black pixels near an edge: by up to 13 levels in JPEG masks of quality 90, and of quality 50
# by at least this many levels in less than 0.5 % of the black pixels. It lowers no white pixel below 96.
_MIN_USABLE_LEVEL_IN_LOSSY_MASKS = 64
# Phones take photos of 200 million pixels. A picture takes 3 bytes a pixel where it is not decoded at a reduced size.
MAX_PICTURE_PIXELS = 500_000_000


@dataclass(frozen=True)
class PictureHeader:
    """Size and kind of a picture file, read without decoding its pixels."""

    width: int
    height: int
    has_alpha: bool

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self.width, self.height

    def turned(self, orientation: int) -> PictureHeader:
        """Return the header of the picture after an EXIF orientation was applied."""
        return replace(self, width=self.height, height=self.width) if orientation >= 5 else self


@dataclass(frozen=True)
class PhotoFile:
    """A photo on disk and its lens; calling it loads the undistorted Picture.

    Attributes:
        path: the file.
        stored: (width, height) of the stored picture after `orientation` was applied.
        lens: lens at the size to load, which is at most the stored size.
        mask: the file of the mask, if any.
        orientation: EXIF orientation by which stored pixels are turned.
        mask_orientation: EXIF orientation by which the mask is turned; 1 if it is upright.
    """

    path: Path
    stored: tuple[int, int]
    lens: Lens
    mask: Path | None = None
    orientation: int = 1
    mask_orientation: int = 1

    def __call__(self) -> Picture:
        width, height = size = (self.lens.width, self.lens.height)
        shrunk = size != self.stored
        if shrunk and read_header(self.path).turned(self.orientation).size != self.stored:
            raise self._size_changed_error()
        rgb, alpha = read_pixels(self.path, size if shrunk else None, self.orientation)
        if rgb.shape[:2] != (height, width):
            raise self._size_changed_error()
        mask = None
        if self.mask is not None:
            mask = read_mask(self.mask, height, width, orientation=self.mask_orientation)
        picture = Picture(rgb, alpha, mask)
        return undistort(picture, self.lens) if self.lens.is_distorted else picture

    def _size_changed_error(self) -> HyrfDataError:
        """Return the exception for a file whose size differs from that of the scene."""
        return HyrfDataError(
            f"{display_path(self.path)}: the picture changed its size since the scene was read",
            fix="read the scene again",
        )


def is_picture_name(name: str) -> bool:
    """Return whether a file name has the extension of a readable picture and is not hidden."""
    return name.lower().endswith(READABLE_PICTURE_SUFFIXES) and not name.startswith(".")


def has_same_aspect(width: int, height: int, of_width: int, of_height: int) -> bool:
    """Return whether two sizes have the same aspect ratio, up to rounding of each side by less than a pixel."""
    return abs(width * of_height - height * of_width) <= of_width + of_height


def fit_size(width: int, height: int, max_size: int) -> tuple[int, int]:
    """Shrink (width, height) uniformly so that the longer side has at most `max_size` pixels; 0 allows any size."""
    longer = max(width, height)
    if not max_size or longer <= max_size:
        return width, height
    return max(1, round(width * max_size / longer)), max(1, round(height * max_size / longer))


def open_picture(path: Path) -> ImageFile:
    """Open a picture file with Pillow, which reads only its header. The caller closes it.

    Use `read_header` and `read_pixels` for sizes and pixels, because Pillow applies the orientation of TIFF files.

    Raises:
        HyrfDataError: the file is missing, empty, raw, no picture, or larger than MAX_PICTURE_PIXELS, or it is HEIC and
            pillow-heif is not installed.
    """
    shown = display_path(path)
    with needs_package(f"{shown}: reading pictures"):
        from PIL import Image, UnidentifiedImageError

    # Pillow by default warns of pictures of 89 million pixels and refuses those of twice as many.
    if Image.MAX_IMAGE_PIXELS is not None:
        Image.MAX_IMAGE_PIXELS = max(Image.MAX_IMAGE_PIXELS, MAX_PICTURE_PIXELS)
    try:
        if path.suffix.lower() in RAW_PHOTO_SUFFIXES:  # many are TIFF files, of which Pillow would read the preview
            raise HyrfDataError(f"{shown}: raw files are not supported", fix=RAW_REMEDY)
        if os.path.getsize(path) == 0:
            raise HyrfDataError(f"{shown}: the picture file is empty (0 bytes)", fix="copy it again")
        _register_heic(path)
        image = Image.open(path)
        if image.format == "TIFF":  # Pillow would map turned files into memory with width and height exchanged
            image.filename = ""
        if image.format == "EPS":  # PostScript is a program, and Pillow would run it with Ghostscript
            image.close()
            raise HyrfDataError(f"{shown}: PostScript is not a photo", fix="save it as PNG or JPEG")
    except HyrfError:
        raise
    except FileNotFoundError as error:
        raise HyrfDataError(f"{shown}: the picture is missing", fix="restore it or read the scene again") from error
    except PermissionError as error:
        raise HyrfDataError(
            f"{shown}: permission to read the picture is denied",
            fix="check its permissions",
        ) from error
    except Image.DecompressionBombError as error:
        raise _too_large_error(shown) from error
    except UnidentifiedImageError as error:  # the text of this exception is only the path
        raise HyrfDataError(
            f"{shown}: not a picture that can be read, its format is unknown",
            fix="replace the file",
        ) from error
    except Exception as error:  # Pillow's header parsers raise exceptions of many types
        raise HyrfDataError(
            f"{shown}: not a picture that can be read ({short_reason(error)})",
            fix="replace the file",
        ) from error
    if min(image.size) < 1:
        image.close()
        raise HyrfDataError(
            f"{shown}: the picture has no pixels ({image.size[0]} x {image.size[1]})",
            fix="replace the file",
        )
    if image.width * image.height > MAX_PICTURE_PIXELS:
        image.close()
        raise _too_large_error(shown)
    return image


def _too_large_error(shown: Path) -> HyrfDataError:
    """Return the exception for a picture with too many pixels."""
    return HyrfDataError(
        f"{shown}: the picture has more than {MAX_PICTURE_PIXELS:,} pixels",
        fix="reduce its size",
    )


def read_header(path: Path) -> PictureHeader:
    """Read the stored size and the kind of a picture file.

    Raises:
        HyrfDataError: the file is missing, empty, or no picture.
    """
    with open_picture(path) as image:
        return PictureHeader(image.width, image.height, _has_alpha(image)).turned(_orientation_applied_by_pillow(image))


def read_orientation(path: Path) -> int:
    """Read a picture file's EXIF orientation, 1 (upright as stored) to 8; 1 if it states none.

    Raises:
        HyrfDataError: the file is missing, empty, or no picture.
    """
    with open_picture(path) as image:
        try:
            if image.format == "TIFF":
                orientation = _orientation_applied_by_pillow(image)
            else:
                orientation = image.getexif().get(_ORIENTATION_TAG, 1)
        except Exception:  # the tags are damaged, but the picture may still be usable
            return 1
    return orientation if orientation in _TRANSPOSITIONS else 1


def turn_upright(image: PilImage, orientation: int) -> PilImage:
    """Return a picture turned from its EXIF orientation (1 to 8) to upright; other values leave it as it is."""
    from PIL import Image

    number = _TRANSPOSITIONS.get(orientation)
    return image if number is None else image.transpose(Image.Transpose(number))


def is_tagged_panorama(path: Path) -> bool:
    """Return whether the XMP data of a picture file declare an equirectangular panorama (Google's GPano).

    360-degree cameras write such data.

    Raises:
        HyrfDataError: the file is missing, empty, or no picture.
    """
    with open_picture(path) as image:
        xmp = image.info.get("xmp")
    xmp = xmp.encode(errors="replace") if isinstance(xmp, str) else xmp
    if not isinstance(xmp, bytes):  # a TIFF may state numbers
        return False
    return b"GPano:ProjectionType" in xmp and b"equirectangular" in xmp


def read_pixels(
    path: Path, size: tuple[int, int] | None = None, orientation: int = 1, *, as_mask: bool = False
) -> tuple[np.ndarray, np.ndarray | None]:
    """Decode a photo of any kind: grey, palette, 16 bit, with or without alpha.

    Args:
        path: the file.
        size: (width, height) to shrink the photo to, with a Lanczos filter and colours weighted by their alpha; None
            keeps the stored size. JPEG files are decoded at a reduced size if possible, which saves time and memory.
        orientation: EXIF orientation, 1 to 8, by which the picture is turned; `size` is that of the turned picture.
        as_mask: map all 16-bit values but 0 to 255, instead of scaling them, which rounds small values to 0.

    Returns:
        (H, W, 3) uint8 RGB (straight, grey repeated) and (H, W) uint8 alpha or None.

    Raises:
        HyrfDataError: the file is missing, truncated, or has no display values.
    """
    with open_picture(path) as image:
        from PIL import Image

        if image.mode == "F":
            raise HyrfDataError(
                f"{display_path(path)}: pictures of floating-point numbers are not supported",
                fix="save it as 8-bit PNG",
            )
        try:
            # `draft` returns the box of the picture within the draft, which may end inside the last row and column.
            stored = size[::-1] if size is not None and orientation >= 5 else size
            draft = (
                None
                if stored is None
                else image.draft(None, (_MIN_DRAFT_SIZE_RATIO * stored[0], _MIN_DRAFT_SIZE_RATIO * stored[1]))
            )
            applied = _orientation_applied_by_pillow(image)
            if image.mode in _SIXTEEN_BIT_MODES:
                values = np.asarray(image).astype(np.float64)
                if values.max() > 65535 and not as_mask:
                    raise ValueError("its numbers have 32 bits and no known range, save it with 8 or 16 bits")
                levels = np.where(values != 0, 255, 0) if as_mask else np.clip(values, 0, 65535) / 257 + 0.5
                picture = Image.fromarray(levels.astype(np.uint8))
            else:
                picture = image.convert("RGBA" if _has_alpha(image) else "RGB")
            if applied != 1:
                inverse = _INVERSE_ORIENTATIONS.get(applied, applied)
                picture = picture.transpose(Image.Transpose(_TRANSPOSITIONS[inverse]))
            if stored is not None:
                picture = picture.resize(stored, Image.Resampling.LANCZOS, box=None if draft is None else draft[1])
            pixels = np.array(turn_upright(picture, orientation))
        except Exception as error:  # Pillow's decoders raise exceptions of many types
            shown = display_path(path)
            raise HyrfDataError(
                f"{shown}: cannot decode the picture ({short_reason(error)})",
                fix="replace the file",
            ) from error
    if pixels.ndim == 2:
        return np.repeat(pixels[..., None], 3, axis=2), None
    if pixels.shape[2] == 4:
        return np.ascontiguousarray(pixels[..., :3]), np.ascontiguousarray(pixels[..., 3])
    return pixels, None


def read_mask(path: Path, height: int, width: int, *, orientation: int = 1) -> np.ndarray:
    """Decode a mask, in which black marks a pixel to ignore, and resize it.

    Black is level 0, and in JPEG and lossy WebP files every level below 64. If all pixels of the mask have one colour
    other than black, and their alpha differs, the alpha is the mask.

    Args:
        path: the file.
        height, width: size of the result.
        orientation: EXIF orientation by which the mask is turned.

    Returns:
        (height, width) bool, True for usable pixels. A pixel is usable if all mask pixels that it covers are. Where the
        mask is smaller than the result, the mask pixel nearest to its centre decides.
    """
    rgb, alpha = read_pixels(path, orientation=orientation, as_mask=True)
    min_usable_level = _MIN_USABLE_LEVEL_IN_LOSSY_MASKS if _is_lossy(path) else 1
    is_one_colour = rgb[0, 0].any() and bool((rgb == rgb[0, 0]).all())
    if alpha is not None and is_one_colour and alpha.min() < alpha.max():
        usable = alpha >= min_usable_level
    else:
        usable = np.any(rgb >= min_usable_level, axis=2)
    if usable.shape == (height, width):
        return usable
    if usable.shape[0] >= height and usable.shape[1] >= width:
        usable = np.logical_and.reduceat(usable, _covering_bounds(usable.shape[0], height), axis=0)[::2]
        usable = np.logical_and.reduceat(usable, _covering_bounds(usable.shape[1], width), axis=1)[:, ::2]
        return np.ascontiguousarray(usable)
    rows = (2 * np.arange(height) + 1) * usable.shape[0] // (2 * height)
    columns = (2 * np.arange(width) + 1) * usable.shape[1] // (2 * width)
    return usable[rows[:, None], columns]


def _is_lossy(path: Path) -> bool:
    """Return whether a picture file is a JPEG or a lossy WebP."""
    with open_picture(path) as image:
        file_format = image.format
    if file_format != "WEBP":
        return file_format in ("JPEG", "MPO")
    with path.open("rb") as stream:
        stream.seek(12)  # the chunks follow "RIFF", the length and "WEBP"
        while len(head := stream.read(8)) == 8:
            if head[:4] in (b"VP8 ", b"VP8L"):
                return head[:4] == b"VP8 "
            length = int.from_bytes(head[4:], "little")
            stream.seek(length + length % 2, os.SEEK_CUR)
    return False


def _covering_bounds(many: int, few: int) -> np.ndarray:
    """Return bounds for `reduceat` over the source pixels that each of `few` pixels covers at least in part.

    The bounds alternate between the first of these pixels and the one after the last; there are `many` source pixels.
    """
    starts = np.arange(few) * many // few
    ends = -(-np.arange(1, few + 1) * many // few)
    return np.stack((starts, ends), 1).ravel()[:-1]  # the last segment of reduceat extends to the end


def _orientation_applied_by_pillow(image) -> int:
    """Return the orientation that Pillow applies by itself, which it does only for TIFF files."""
    orientation = image.tag_v2.get(_ORIENTATION_TAG, 1) if image.format == "TIFF" else 1
    return orientation if orientation in _TRANSPOSITIONS else 1


def _has_alpha(image) -> bool:
    """Return whether a picture opened with Pillow has an alpha channel or a transparent colour."""
    # The grey level that means "transparent" in a 16-bit picture is ignored: conversion to 8 bits would lose it.
    transparent = "transparency" in image.info and image.mode not in _SIXTEEN_BIT_MODES
    return transparent or image.mode in ("RGBA", "LA", "PA", "La", "RGBa")


def _register_heic(path: Path) -> None:
    """Register the optional HEIC plugin with Pillow if the file is HEIC."""
    with path.open("rb") as stream:
        start = stream.read(12)
    if path.suffix.lower() in _HEIC_EXTENSIONS or (start[4:8] == b"ftyp" and start[8:] in _HEIC_BRANDS):
        try:
            import pillow_heif
        except ModuleNotFoundError as error:
            raise HyrfDataError(f"{display_path(path)}: {HEIC_REQUIREMENT}", fix=HEIC_REMEDY) from error
        pillow_heif.register_heif_opener()

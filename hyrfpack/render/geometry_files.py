"""Files of depth and of normals, for other programs.

A pixel without a surface has the depth 0 and the normal (0, 0, 0) in all formats.
"""

from __future__ import annotations

import io
import logging
from pathlib import Path

import numpy as np
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from hyrfpack.atomic import write_atomic
from hyrfpack.config.render import GeometryConfig
from hyrfpack.errors import needs_package
from hyrfpack.render.renderer import RenderedPicture

_LOG = logging.getLogger(__name__)

MAX_DEPTH_STEPS = 65535  # 16 bits
# Below this number of steps, rounding to a step is an error of more than 0.2 % of the largest depth.
MIN_USEFUL_DEPTH_STEPS = 256
_SUGGESTED_UNIT_DIGITS = 2


class GeometryWriter:
    """Writes the geometry of views, and remembers the largest depth.

    Attributes:
        config: what is written, and how.
        max_depth: largest depth so far, world units.
    """

    def __init__(self, config: GeometryConfig) -> None:
        """Prepare the writer.

        Raises:
            HyrfError: the package for OpenEXR files is missing.
        """
        if "exr" in (config.depth, config.normals):
            with needs_package("writing OpenEXR files"):
                import OpenEXR  # noqa: F401
        self.config = config
        self.max_depth = 0.0

    def write(self, path: Path, rendering: RenderedPicture, *, overwrite: bool = True) -> None:
        """Write the files of a view beside its picture.

        Args:
            path: path of the picture.
            rendering: the view, with depth and, if they are written, with normals.
            overwrite: replace existing files.

        Raises:
            HyrfError: a file cannot be written.
        """
        files = {}
        if self.config.depth is not None:
            assert rendering.depth is not None
            depth = rendering.depth.numpy(force=True)
            self.max_depth = max(self.max_depth, float(depth.max(initial=0)))
            files["depth", self.config.depth] = encode_depth(depth, self.config.depth, self.config.depth_unit)
        if self.config.normals is not None:
            assert rendering.normals is not None
            normals = rendering.normals.numpy(force=True)
            files["normals", self.config.normals] = encode_normals(normals, self.config.normals)
        for (kind, extension), data in files.items():
            write_atomic(path.with_suffix(f".{kind}.{extension}"), data, overwrite=overwrite, rename=False)

    def warn_of_losses(self, max_depth: float | None = None) -> None:
        """Log a warning if 16 bits cannot hold the depths that were written.

        Args:
            max_depth: largest depth of several writers; None for that of this one.
        """
        largest, unit = self.max_depth if max_depth is None else max_depth, self.config.depth_unit
        if self.config.depth != "png" or largest == 0:
            return
        limit, smallest_unit = MAX_DEPTH_STEPS * unit, _round_up(largest / MAX_DEPTH_STEPS)
        if largest >= (MAX_DEPTH_STEPS + 0.5) * unit:
            _LOG.warning(
                f"depths reach {largest:.4g} units, but 16-bit steps of {unit:g} units end at {limit:.4g}; pixels "
                f"beyond are 0. Use `depth_unit={smallest_unit:g}`, or `depth='exr'`"
            )
        elif largest < MIN_USEFUL_DEPTH_STEPS * unit:
            _LOG.warning(
                f"depths reach only {largest:.4g} units, which are {largest / unit:.0f} steps of {unit:g} units. Use "
                f"`depth_unit={smallest_unit:g}`, or `depth='exr'`"
            )


def encode_depth(depth: np.ndarray, extension: str, unit: float) -> bytes:
    """Encode a depth map (H, W) in world units. The same map gives the same bytes.

    - A .tiff or .exr holds float32; the channel of the .exr is Z.
    - A .png holds round(depth / unit) in 16 bits, at least 1 where there is a surface. Depths that 16 bits cannot hold
      become 0. The text "Description" in the file states the unit.

    Args:
        depth: (H, W), 0 where there is no surface.
        extension: one of DEPTH_FORMATS.
        unit: world units for each step of a .png.
    """
    if extension == "exr":
        return _encode_exr({"Z": depth.astype(np.float32)})
    if extension == "tiff":
        return _encode(Image.fromarray(depth.astype(np.float32)), "TIFF")
    steps = np.round(depth.astype(np.float64) / unit)
    steps = np.where(depth > 0, np.maximum(steps, 1), 0)
    steps = np.where(steps <= MAX_DEPTH_STEPS, steps, 0).astype(np.uint16)
    text = PngInfo()
    text.add_text("Description", f"depth along the view axis; 1 step = {unit!r} world units; 0 = no surface")
    return _encode(Image.fromarray(steps), "PNG", pnginfo=text)


def encode_normals(normals: np.ndarray, extension: str) -> bytes:
    """Encode unit normals (H, W, 3) in world axes. The same normals give the same bytes.

    - A .exr holds x, y and z as the float32 channels R, G and B.
    - A .png holds round(255 (0.5 n + 0.5)).

    Args:
        normals: (H, W, 3), (0, 0, 0) where there is no surface.
        extension: one of NORMAL_FORMATS.
    """
    if extension == "exr":
        return _encode_exr({"RGB": np.ascontiguousarray(normals, np.float32)})
    codes = np.round(255 * (0.5 * normals.astype(np.float64).clip(-1, 1) + 0.5)).astype(np.uint8)
    text = PngInfo()
    text.add_text("Description", "normals in world axes; RGB = 255 (0.5 n + 0.5); 128, 128, 128 = no surface")
    return _encode(Image.fromarray(codes), "PNG", pnginfo=text)


def _encode_exr(channels: dict[str, np.ndarray]) -> bytes:
    with needs_package("writing OpenEXR files"):
        import OpenEXR

    data = io.BytesIO()
    with OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, channels) as file:
        file.write(data)
    return data.getvalue()


def _encode(image: Image.Image, kind: str, **options: object) -> bytes:
    data = io.BytesIO()
    image.save(data, kind, **options)
    return data.getvalue()


def _round_up(value: float) -> float:
    """Round a positive number up to _SUGGESTED_UNIT_DIGITS significant digits."""
    digits = _SUGGESTED_UNIT_DIGITS - 1 - int(np.floor(np.log10(value)))
    return float(f"{np.ceil(value * 10.0**digits) * 10.0**-digits:.{_SUGGESTED_UNIT_DIGITS}g}")

"""The table of splat formats: for each file ending its encoder, its decoder and what it can hold."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from hyrfpack.ops.harmonics import MAX_DEGREE
from hyrfpack.splats.formats import gltf, ply, sog, splat, spz, usd
from hyrfpack.splats.formats.hints import Hints
from hyrfpack.splats.splats import Splats


@dataclass(frozen=True, kw_only=True)
class FileKind:
    """A kind of file that an export writes, and what it can hold.

    Attributes:
        ending: ending of the file names, in lower case.
        max_degree: highest degree of spherical harmonics that the file can hold.
        module: a module of another package that only this kind needs, or None.
        max_coordinate: largest absolute coordinate of a position, world units. Infinite means the range of float32 or
            more.
        min_scale, max_scale: smallest and largest scale, world units. Others are clamped.
        stores_antialiased: whether the file can mark splats as antialiased.
    """

    ending: str
    max_degree: int = MAX_DEGREE
    module: str | None = None
    max_coordinate: float = math.inf
    min_scale: float = 0.0
    max_scale: float = math.inf
    stores_antialiased: bool = False


@dataclass(frozen=True, kw_only=True)
class SplatFormat(FileKind):
    """A file format for splats, with its encoder and decoder.

    Attributes:
        encode: turns splats, in the input's axes and units, into the bytes of a file. Raises HyrfError.
        decode: turns the bytes of a file, and its name in error messages, into splats in the axes of the splats that
            `encode` took. Raises HyrfDataError if the bytes are damaged or of another format.
        is_readable: whether `read_splats` accepts the format. The others are decoded only to measure what was written.
        stores_origin: whether numbers are float32, and positions relative to an origin that the file stores, so that
            neither the range of a scene nor its distance from the world's origin costs precision.
    """

    encode: Callable[[Splats, Hints], bytes]
    decode: Callable[[bytes, str], Splats]
    is_readable: bool = False
    stores_origin: bool = False


def _make_usd_format(extension: usd.Extension) -> SplatFormat:
    encode, decode = partial(usd.encode, extension=extension), partial(usd.decode, extension=extension)
    return SplatFormat(
        ending=f".{extension}", encode=encode, decode=decode, module=usd.REQUIRED_MODULE, stores_origin=True
    )


_FORMAT_ROWS = (
    SplatFormat(ending=".ply", encode=ply.encode, decode=ply.decode, is_readable=True),
    SplatFormat(
        ending=".splat",
        encode=splat.encode,
        decode=splat.decode,
        is_readable=True,
        max_degree=splat.MAX_HARMONICS_DEGREE,
    ),
    SplatFormat(
        ending=".spz",
        encode=spz.encode,
        decode=spz.decode,
        is_readable=True,
        max_coordinate=spz.MAX_COORDINATE,
        min_scale=spz.MIN_SCALE,
        max_scale=spz.MAX_SCALE,
        stores_antialiased=True,
    ),
    SplatFormat(ending=".glb", encode=gltf.encode, decode=gltf.decode, stores_origin=True),
    *map(_make_usd_format, usd.EXTENSIONS),
    SplatFormat(ending=".sog", encode=sog.encode, decode=sog.decode, is_readable=True, stores_antialiased=True),
)
FORMATS = {row.ending: row for row in _FORMAT_ROWS}
ENDINGS_WITH_ORIGIN = tuple(row.ending for row in _FORMAT_ROWS if row.stores_origin)

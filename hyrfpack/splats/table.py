"""The one table of splat formats: for each ending who writes and reads it, and what it can hold."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from hyrfpack.splats.formats import gltf, ply, sog, splat, spz, usd
from hyrfpack.splats.formats.hints import Hints
from hyrfpack.splats.harmonics import MAX_DEGREE
from hyrfpack.splats.splats import Splats


@dataclass(frozen=True, kw_only=True)
class Kind:
    """A kind of file, and what it can hold.

    Attributes:
        ending: of its names, lower case.
        degree: highest of the spherical harmonics.
        package: what is imported for it alone: the module, and what pip calls it.
        farthest: coordinate of a position, units; infinite where that of float32 or more is.
        largest_scale: units.
        antialiased: whether it can say that splats are.
    """

    ending: str
    degree: int = MAX_DEGREE
    package: tuple[str, str] | None = None
    farthest: float = math.inf
    largest_scale: float = math.inf
    antialiased: bool = False


@dataclass(frozen=True, kw_only=True)
class Format(Kind):
    """A format of files that hold splats. All are written.

    Attributes:
        encode: splats, in the input's axes and units, to the bytes of a file. Raises HyrfError.
        decode: the bytes of a file, and what messages call it, to splats in the axes that `encode` was given. Raises
            HyrfDataError where they are no such file or damaged.
        read: whether `read_splats` takes it; the others are read to measure what was written.
    """

    encode: Callable[[Splats, Hints], bytes]
    decode: Callable[[bytes, str], Splats]
    read: bool = False


def _usd(extension: usd.Extension) -> Format:
    encode, decode = partial(usd.encode, extension=extension), partial(usd.decode, extension=extension)
    return Format(ending=f".{extension}", encode=encode, decode=decode, package=usd.REQUIRED_PACKAGE)


_ROWS = (
    Format(ending=".ply", encode=ply.encode, decode=ply.decode, read=True),
    Format(ending=".splat", encode=splat.encode, decode=splat.decode, read=True, degree=splat.MAX_HARMONICS_DEGREE),
    Format(
        ending=".spz",
        encode=spz.encode,
        decode=spz.decode,
        read=True,
        farthest=spz.MAX_COORDINATE,
        largest_scale=spz.MAX_SCALE,
        antialiased=True,
    ),
    Format(ending=".glb", encode=gltf.encode, decode=gltf.decode),
    *map(_usd, usd.EXTENSIONS),
    Format(ending=".sog", encode=sog.encode, decode=sog.decode, read=True, antialiased=True),
)
FORMATS = {row.ending: row for row in _ROWS}

"""Compressed PLY of PlayCanvas and SuperSplat: 16 bytes a Gaussian, plus its higher harmonics. Read, not written.

Element `chunk`: for each 256 Gaussians the floats min_ and max_ of x, y, z, of scale_x, scale_y, scale_z (logarithms),
and, in newer files, of r, g, b (else 0 and 1). Element `vertex`: for each Gaussian four uint32, of which the first and
the last two lie, as fractions, between the chunk's bounds:

    packed_position   x 11 bits, y 10, z 11, from the highest bit
    packed_rotation   2 bits: which of w, x, y, z is largest; then 10 bits each for the others, sqrt(2) (v / 1023 - 1/2)
    packed_scale      as the position
    packed_color      r, g, b, and the opacity, 8 bits each; r, g, b are 0.5 + Y00 k

Element `sh`, if any: uchar f_rest_0.., channel after channel; v is (v + 1/2) / 32 - 4, but 0 and 255 are -4 and 4.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hyrfpack.errors import HyrfDataError
from hyrfpack.ply import PlyHeader, columns, read_elements, read_header
from hyrfpack.splats.formats.checked import checked_splats
from hyrfpack.splats.formats.smallest_three import with_largest
from hyrfpack.splats.harmonics import BAND_0
from hyrfpack.splats.splats import Splats

_CHUNK = 256
_POSITION, _SCALE, _COLOR = ("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b")
_11_10_11 = (21, 11, 0), (11, 10, 11)  # shifts and widths of bit fields
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")

_REST_OF = np.float32((np.arange(256) + 0.5) / 32 - 4)
_REST_OF[[0, 255]] = -4, 4


def is_compressed(header: PlyHeader) -> bool:
    """Whether a PLY file is of this kind."""
    return "vertex" in header.elements and "packed_position" in header.elements["vertex"].properties


def decode(data: bytes, name: str) -> Splats:
    """Splats of a compressed PLY file.

    Args:
        data: the file.
        name: what messages call it.

    Raises:
        HyrfDataError: it is no such file, or damaged.
    """
    header = read_header(data, name)
    have = {label: element.properties for label, element in header.elements.items()}
    colored = "min_r" in have.get("chunk", {})
    _need(have, "vertex", _PACKED, "u4", name)
    for parts in (_POSITION, _SCALE) + ((_COLOR,) if colored else ()):
        _need(have, "chunk", [*_bounds("min", parts), *_bounds("max", parts)], "f4", name)
    rest = [f"f_rest_{index}" for index in range(len(have.get("sh", {})))]
    if len(rest) not in (0, 9, 24, 45):
        raise HyrfDataError(f"{name}: {len(rest)} properties of its element 'sh' fit no degree; 9, 24 or 45 do")
    _need(have, "sh", rest, "u1", name)
    if header.order == "=":
        raise HyrfDataError(f"{name}: a compressed PLY file in text cannot be read; export it as a binary one")
    rows = read_elements(data, header, {"vertex", "chunk"} | ({"sh"} if rest else set()), name)
    vertex, chunk = rows["vertex"], rows["chunk"]
    count = len(vertex)
    if len(chunk) != -(-count // _CHUNK) or (rest and len(rows["sh"]) != count):
        raise HyrfDataError(
            f"{name}: {len(chunk):,} chunks do not fit {count:,} Gaussians, {_CHUNK} each; the file is damaged"
        )
    shade = _fractions(vertex["packed_color"], (24, 16, 8, 0), (8, 8, 8, 8))
    harmonics = np.empty((count, len(rest) // 3 + 1, 3), np.float32)
    with np.errstate(over="ignore", invalid="ignore"):  # what becomes infinite is refused; NaN may signal
        colors = _between(chunk, _COLOR, shade[:, :3]) if colored else shade[:, :3]
        harmonics[:, 0] = (colors - 0.5) / BAND_0
        if rest:
            harmonics[:, 1:] = _REST_OF[columns(rows["sh"], rest)].reshape(count, 3, len(rest) // 3).transpose(0, 2, 1)
        return checked_splats(
            name,
            _between(chunk, _POSITION, _fractions(vertex["packed_position"], *_11_10_11)),
            np.exp(_between(chunk, _SCALE, _fractions(vertex["packed_scale"], *_11_10_11))),
            _rotations(vertex["packed_rotation"]),
            shade[:, 3],
            harmonics,
        )


def _bounds(end: str, parts: Sequence[str]) -> list[str]:
    return [f"{end}_{part}" for part in parts]


def _need(have: dict[str, dict[str, str]], element: str, labels: Sequence[str], kind: str, name: str) -> None:
    for label in labels:
        if have.get(element, {}).get(label) != kind:
            raise HyrfDataError(
                f"{name}: its element '{element}' has no property {label} of the right type, so this is not a "
                "compressed PLY file of Gaussians"
            )


def _fractions(words: np.ndarray, shifts: tuple[int, ...], bits: tuple[int, ...]) -> np.ndarray:
    """(N, fields) float64 in [0, 1] of words (N,) of bit fields."""
    most = (1 << np.array(bits)) - 1
    return ((words[:, None].astype(np.int64) >> shifts) & most) / most


def _between(chunk: np.ndarray, parts: Sequence[str], fractions: np.ndarray) -> np.ndarray:
    """Fractions (N, 3) of the way from the least to the most of each Gaussian's chunk."""
    of = np.arange(len(fractions)) // _CHUNK
    low, high = (columns(chunk, _bounds(end, parts)).astype(np.float64)[of] for end in ("min", "max"))
    return low * (1 - fractions) + high * fractions


def _rotations(words: np.ndarray) -> np.ndarray:
    """(N, 4) wxyz."""
    others = (_fractions(words, (20, 10, 0), (10, 10, 10)) - 0.5) * np.sqrt(2)
    return with_largest(words >> 30, others)

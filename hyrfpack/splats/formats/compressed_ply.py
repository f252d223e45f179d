"""Reader of compressed PLY files (PlayCanvas, SuperSplat): 16 bytes per Gaussian, plus the higher harmonics.

Files of this format are read, not written. They have up to three elements.

`chunk` holds one row for each 256 Gaussians: the floats min_ and max_ of x, y, z, and of scale_x, scale_y, scale_z
(natural logarithms). Newer files also bound r, g, b; in older files these bounds are 0 and 1.

`vertex` holds four uint32 for each Gaussian. Position, scale and colour are fractions between the chunk's bounds:

    packed_position   x in 11 bits, y in 10, z in 11, from the highest bit down
    packed_rotation   2 bits: index of the largest of w, x, y, z; then 10 bits for each other component,
                      sqrt(2) (v / 1023 - 1/2)
    packed_scale      like the position
    packed_color      r, g, b and the opacity, 8 bits each; r, g, b are 0.5 + Y00 k

`sh` is optional: uchar f_rest_0.., one channel after the other. A byte v means (v + 1/2) / 32 - 4, except that 0 and
255 mean -4 and 4.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from hyrfpack.errors import HyrfDataError
from hyrfpack.ply import PlyHeader, read_elements, read_header, stack_columns
from hyrfpack.splats.formats.smallest_three import restore_largest
from hyrfpack.splats.formats.validation import build_valid_splats
from hyrfpack.splats.harmonics import SH_C0
from hyrfpack.splats.splats import Splats

_GAUSSIANS_PER_CHUNK = 256
_POSITION_BOUNDS = ("x", "y", "z")
_SCALE_BOUNDS = ("scale_x", "scale_y", "scale_z")
_COLOR_BOUNDS = ("r", "g", "b")
_SHIFTS_AND_WIDTHS_11_10_11 = (21, 11, 0), (11, 10, 11)
_PACKED_PROPERTIES = ("packed_position", "packed_rotation", "packed_scale", "packed_color")

_HARMONIC_BY_BYTE = np.float32((np.arange(256) + 0.5) / 32 - 4)
_HARMONIC_BY_BYTE[[0, 255]] = -4, 4


def decode(data: bytes, name: str) -> Splats:
    """Decode a compressed PLY file.

    Args:
        data: the file's bytes.
        name: the file's name in error messages.

    Raises:
        HyrfDataError: the file is not a compressed PLY of Gaussians, or it is damaged.
    """
    header = read_header(data, name)
    has_color_bounds, harmonics_properties = _check_properties(header, name)
    elements = {"vertex", "chunk"} | ({"sh"} if harmonics_properties else set())
    rows = read_elements(data, header, elements, name)
    _check_row_counts(rows, name)
    vertex, chunk = rows["vertex"], rows["chunk"]
    color_fractions = _unpack_fractions(vertex["packed_color"], (24, 16, 8, 0), (8, 8, 8, 8))
    position_fractions = _unpack_fractions(vertex["packed_position"], *_SHIFTS_AND_WIDTHS_11_10_11)
    scale_fractions = _unpack_fractions(vertex["packed_scale"], *_SHIFTS_AND_WIDTHS_11_10_11)
    colors, opacities = color_fractions[:, :3], color_fractions[:, 3]
    terms = len(harmonics_properties) // 3
    harmonics = np.empty((len(vertex), terms + 1, 3), np.float32)
    with np.errstate(over="ignore", invalid="ignore"):  # infinite results are rejected below; a NaN may warn
        if has_color_bounds:
            colors = _interpolate_in_chunk(chunk, _COLOR_BOUNDS, colors)
        harmonics[:, 0] = (colors - 0.5) / SH_C0
        if terms:
            higher = _HARMONIC_BY_BYTE[stack_columns(rows["sh"], harmonics_properties)]
            harmonics[:, 1:] = higher.reshape(len(vertex), 3, terms).transpose(0, 2, 1)
        return build_valid_splats(
            name,
            _interpolate_in_chunk(chunk, _POSITION_BOUNDS, position_fractions),
            np.exp(_interpolate_in_chunk(chunk, _SCALE_BOUNDS, scale_fractions)),
            _unpack_rotations(vertex["packed_rotation"]),
            opacities,
            harmonics,
        )


def _check_properties(header: PlyHeader, name: str) -> tuple[bool, list[str]]:
    """Check that a header has the properties of a compressed PLY.

    Returns:
        Whether chunks bound the colours, and the names of the properties of higher harmonics, 0, 9, 24 or 45.
    """
    properties_by_element = {label: element.properties for label, element in header.elements.items()}
    has_color_bounds = "min_r" in properties_by_element.get("chunk", {})
    _require_properties(properties_by_element, "vertex", _PACKED_PROPERTIES, "u4", name)
    for parts in (_POSITION_BOUNDS, _SCALE_BOUNDS) + ((_COLOR_BOUNDS,) if has_color_bounds else ()):
        bounds = [*_list_bounds("min", parts), *_list_bounds("max", parts)]
        _require_properties(properties_by_element, "chunk", bounds, "f4", name)
    harmonics_properties = [f"f_rest_{index}" for index in range(len(properties_by_element.get("sh", {})))]
    if len(harmonics_properties) not in (0, 9, 24, 45):
        raise HyrfDataError(
            f"{name}: the element 'sh' has {len(harmonics_properties)} properties, but a degree of harmonics needs 9, "
            "24 or 45",
            fix="export it again",
        )
    _require_properties(properties_by_element, "sh", harmonics_properties, "u1", name)
    if header.order == "=":
        raise HyrfDataError(f"{name}: a compressed PLY file in text cannot be read", fix="export it as a binary one")
    return has_color_bounds, harmonics_properties


def _check_row_counts(rows: Mapping[str, np.ndarray], name: str) -> None:
    """Check that the chunks, and the higher harmonics if there are any, belong to as many Gaussians as there are."""
    count, chunk_count = len(rows["vertex"]), len(rows["chunk"])
    if "sh" in rows and len(rows["sh"]) != count:
        raise HyrfDataError(
            f"{name}: its element 'sh' has {len(rows['sh']):,} rows for {count:,} Gaussians",
            fix="the file is damaged, export it again",
        )
    if chunk_count != -(-count // _GAUSSIANS_PER_CHUNK):
        raise HyrfDataError(
            f"{name}: {chunk_count:,} chunks do not fit {count:,} Gaussians, {_GAUSSIANS_PER_CHUNK} each",
            fix="the file is damaged, export it again",
        )


def _list_bounds(end: str, parts: Sequence[str]) -> list[str]:
    return [f"{end}_{part}" for part in parts]


def _require_properties(
    properties_by_element: dict[str, dict[str, str]], element: str, labels: Sequence[str], kind: str, name: str
) -> None:
    for label in labels:
        if properties_by_element.get(element, {}).get(label) != kind:
            raise HyrfDataError(
                f"{name}: its element '{element}' has no property {label} of the right type, so this is not a "
                "compressed PLY file of Gaussians",
                fix="export it again",
            )


def _unpack_fractions(words: np.ndarray, shifts: tuple[int, ...], bits: tuple[int, ...]) -> np.ndarray:
    """Unpack words (N,) of bit fields into (N, fields) float64 in [0, 1]."""
    max_codes = (1 << np.array(bits)) - 1
    return ((words[:, None].astype(np.int64) >> shifts) & max_codes) / max_codes


def _interpolate_in_chunk(chunk: np.ndarray, parts: Sequence[str], fractions: np.ndarray) -> np.ndarray:
    """Interpolate linearly between the bounds of each Gaussian's chunk, by fractions (N, 3) in [0, 1]."""
    chunk_index = np.arange(len(fractions)) // _GAUSSIANS_PER_CHUNK
    low, high = (
        stack_columns(chunk, _list_bounds(end, parts)).astype(np.float64)[chunk_index] for end in ("min", "max")
    )
    return low * (1 - fractions) + high * fractions


def _unpack_rotations(words: np.ndarray) -> np.ndarray:
    """Unpack words (N,) into quaternions (N, 4) wxyz."""
    others = (_unpack_fractions(words, (20, 10, 0), (10, 10, 10)) - 0.5) * np.sqrt(2)
    return restore_largest(words >> 30, others)

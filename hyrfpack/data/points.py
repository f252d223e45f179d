"""Read points with colours from PLY files, which photogrammetry programs write beside poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hyrfpack.errors import HyrfDataError, short_reason
from hyrfpack.ply import read_elements, read_header, stack_columns

_POSITION_PROPERTIES = ("x", "y", "z")
_COLOR_PROPERTIES = ("red", "green", "blue")
_DEFAULT_COLOR = 0.5
_WIDE_TYPES = ("f4", "f8", "i4", "u4")  # some programs write colours of 0 to 255 in these types
_MAX_UNIT_RANGE_COLOR = 2.0  # floating-point colours in [0, 1] may exceed it a little


def read_ply_points(ply: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read the points of a PLY file.

    Colours of an integer type are divided by its largest value. Floating-point colours are in [0, 1]. Some programs
    write 0 to 255 as floating-point or 32-bit numbers, so these types are divided by 255 if the largest colour is above
    2 and at most 255.

    Returns:
        (P, 3) positions and (P, 3) RGB in [0, 1]; colours are grey if the file has none.

    Raises:
        HyrfDataError: the file cannot be read, or holds fewer points than it states.
    """
    name = str(ply)
    try:
        data = ply.read_bytes()
    except OSError as error:
        raise HyrfDataError(
            f"{name}: the points cannot be read ({short_reason(error)})",
            fix="export them again",
        ) from error
    header = read_header(data, name)
    vertex = header.elements.get("vertex")
    types = vertex.properties if vertex else {}
    if not all(types.get(label) for label in _POSITION_PROPERTIES):
        raise HyrfDataError(f"{name}: the file has no points, or they lack x, y or z", fix="export them again")
    rows = read_elements(data, header, {"vertex"}, name)["vertex"]
    points = stack_columns(rows, _POSITION_PROPERTIES).astype(np.float64)
    if not all(types.get(label) for label in _COLOR_PROPERTIES):
        return points, np.full_like(points, _DEFAULT_COLOR)
    # The header gives the type of the values, because rows of text files are float64 in any case.
    color_types = [types[label] for label in _COLOR_PROPERTIES]
    colors = stack_columns(rows, _COLOR_PROPERTIES).astype(np.float64)
    max_values = [1.0 if kind[0] == "f" else np.iinfo(kind).max for kind in color_types]
    largest = colors[np.isfinite(colors)].max(initial=0)
    if all(kind in _WIDE_TYPES for kind in color_types) and _MAX_UNIT_RANGE_COLOR < largest <= 255:
        max_values = [255.0] * 3
    return points, np.clip(np.nan_to_num(colors / max_values), 0, 1)

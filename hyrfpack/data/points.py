"""Points with colours out of PLY files, as photogrammetry writes them beside its poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hyrfpack.errors import HyrfDataError, short_reason
from hyrfpack.ply import read_elements, read_header, stack_columns

_POSITION, _COLOR = ("x", "y", "z"), ("red", "green", "blue")
_GREY = 0.5


def read_ply(ply: Path) -> tuple[np.ndarray, np.ndarray]:
    """(P, 3) positions and (P, 3) RGB in [0, 1], grey where the file has no colours.

    Raises:
        HyrfDataError: the file cannot be read, or holds fewer points than it says.
    """
    name = str(ply)
    try:
        data = ply.read_bytes()
    except OSError as error:
        raise HyrfDataError(f"{name}: the points cannot be read ({short_reason(error)}); export them again") from error
    header = read_header(data, name)
    vertex = header.elements.get("vertex")
    kinds = vertex.properties if vertex else {}
    if not all(kinds.get(label) for label in _POSITION):
        raise HyrfDataError(f"{name}: it has no points, or no x, y and z of them; export them again")
    rows = read_elements(data, header, {"vertex"}, name)["vertex"]
    points = stack_columns(rows, _POSITION).astype(np.float64)
    if not all(kinds.get(label) for label in _COLOR):
        return points, np.full_like(points, _GREY)
    # The header tells what is full: rows in text come as float64, whatever they hold.
    full = [1.0 if kinds[label][0] == "f" else np.iinfo(kinds[label]).max for label in _COLOR]
    colors = stack_columns(rows, _COLOR).astype(np.float64) / full
    return points, np.clip(np.nan_to_num(colors), 0, 1)

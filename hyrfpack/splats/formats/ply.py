"""PLY as 3D Gaussian Splatting writes it: the format that every program reads and that loses nothing.

One element `vertex` of floats: x y z, nx ny nz (0), f_dc_0..2 (harmonics of degree 0, RGB), f_rest_0.. (higher ones,
channel after channel: all of red, all of green, all of blue), opacity (its logit), scale_0..2 (natural logarithms),
rot_0..3 (quaternion wxyz).
"""

from __future__ import annotations

from itertools import product

import numpy as np
from scipy.special import expit

from hyrfpack.errors import HyrfDataError
from hyrfpack.ply import columns, read_elements, read_header
from hyrfpack.splats.formats import compressed_ply
from hyrfpack.splats.formats.checked import checked_splats
from hyrfpack.splats.formats.hints import NO_HINTS, Hints
from hyrfpack.splats.harmonics import MAX_DEGREE, terms_of
from hyrfpack.splats.splats import Splats

_POSITION, _COLOR, _SCALE = ("x", "y", "z"), ("f_dc_0", "f_dc_1", "f_dc_2"), ("scale_0", "scale_1", "scale_2")
_ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
_NEEDED = (*_POSITION, *_COLOR, "opacity", *_SCALE, *_ROTATION)

# Logarithms and logits of what has none. In float32 exp and the logistic function of the first are 0, the latter of the
# second is 1, so even these come back exactly.
_LEAST, _MOST = -104.0, 20.0


def encode(splats: Splats, hints: Hints = NO_HINTS) -> bytes:
    """Splats as a binary little-endian PLY file. Everything is stored as float32; `antialiased` is not stored.

    Raises:
        HyrfDataError: a position is too large for float32.
    """
    if np.abs(splats.positions).max(initial=0) > np.finfo(np.float32).max:
        raise HyrfDataError("a Gaussian lies farther from the origin than PLY's numbers reach; move the scene there")
    rest = 3 * (terms_of(splats.degree) - 1)
    names = (*_POSITION, "nx", "ny", "nz", *_COLOR, *_rest_names(rest), "opacity", *_SCALE, *_ROTATION)
    with np.errstate(divide="ignore"):
        opacities = splats.opacities.astype(np.float64)
        logits = np.log(opacities) - np.log1p(-opacities)
        scales = np.log(splats.scales.astype(np.float64))
    table = np.zeros((len(splats), len(names)), "<f4")
    table[:, :3] = splats.positions
    table[:, 6:9] = splats.harmonics[:, 0]
    for column, (channel, term) in enumerate(product(range(3), range(1, splats.harmonics.shape[1])), 9):
        table[:, column] = splats.harmonics[:, term, channel]
    table[:, -8] = np.clip(logits, _LEAST, _MOST)
    table[:, -7:-4] = np.maximum(scales, _LEAST)
    table[:, -4:] = splats.quats
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(splats)}"]
    header += [f"property float {name}" for name in names] + ["end_header\n"]
    return b"".join(("\n".join(header).encode(), table.data))


def decode(data: bytes, name: str) -> Splats:
    """Splats of a PLY file of either kind, this one or `compressed_ply`. Errors as `decode_plain` and its `decode`."""
    packed = compressed_ply.is_compressed(read_header(data, name))
    return compressed_ply.decode(data, name) if packed else decode_plain(data, name)


def decode_plain(data: bytes, name: str) -> Splats:
    """Splats of a PLY file, binary or in text, with its properties in any order, of any type.

    Other properties and elements are skipped; normals may be absent. Harmonics end at degree 3. Opacities may be
    infinite (0 and 1), and scales minus infinite (0): some programs write that.

    Args:
        data: the file.
        name: what messages call it.

    Raises:
        HyrfDataError: it is no PLY file, holds no Gaussians, or is damaged.
    """
    header = read_header(data, name)
    vertex = header.elements.get("vertex")
    have = vertex.properties if vertex else {}
    missing = [label for label in _NEEDED if not have.get(label)]
    if missing:
        shown = ", ".join(missing[:4]) + (f" and {len(missing) - 4} more" if len(missing) > 4 else "")
        raise HyrfDataError(
            f"{name}: this PLY file holds no Gaussians, for its vertices have no {shown}; give one that a program for "
            "3D Gaussian Splatting wrote"
        )
    rest = sum(label.startswith("f_rest_") for label in have)
    terms = rest // 3 + 1
    if terms not in (1, 4, 9, 16, 25) or rest % 3 or not all(have.get(label) for label in _rest_names(rest)):
        raise HyrfDataError(
            f"{name}: {rest} properties f_rest_ fit no degree of harmonics; 0, 9, 24, 45 or 72 of them do, "
            "counted from 0"
        )
    rows = read_elements(data, header, {"vertex"}, name)["vertex"]
    harmonics = np.empty((len(rows), min(terms, terms_of(MAX_DEGREE)), 3), np.float32)
    with np.errstate(over="ignore", invalid="ignore"):  # what becomes infinite is refused; NaN may signal
        harmonics[:, 0] = columns(rows, _COLOR)
        for channel, term in product(range(3), range(1, harmonics.shape[1])):
            harmonics[:, term, channel] = rows[f"f_rest_{channel * (terms - 1) + term - 1}"]
        return checked_splats(
            name,
            columns(rows, _POSITION),
            np.exp(columns(rows, _SCALE).astype(np.float64)),
            columns(rows, _ROTATION),
            expit(rows["opacity"].astype(np.float64)),
            harmonics,
        )


def _rest_names(count: int) -> list[str]:
    return [f"f_rest_{index}" for index in range(count)]

"""PLY files in the layout of the 3D Gaussian Splatting reference code: lossless, and read by every program.

The one element `vertex` holds floats:

    x y z          position
    nx ny nz       0
    f_dc_0..2      harmonics of degree 0, RGB
    f_rest_0..     higher harmonics, one channel after the other: all of red, all of green, all of blue
    opacity        logit of the opacity
    scale_0..2     natural logarithms of the scales
    rot_0..3       quaternion wxyz
"""

from __future__ import annotations

from itertools import product

import numpy as np
from scipy.special import expit

from hyrfpack.errors import HyrfDataError
from hyrfpack.ops.harmonics import MAX_DEGREE, num_sh_bases
from hyrfpack.ply import read_elements, read_header, stack_columns
from hyrfpack.splats.formats import compressed_ply
from hyrfpack.splats.formats.hints import NO_HINTS, Hints
from hyrfpack.splats.formats.ply_header import (
    COLOR_PROPERTIES,
    POSITION_PROPERTIES,
    ROTATION_PROPERTIES,
    SCALE_PROPERTIES,
    find_properties,
    is_compressed,
)
from hyrfpack.splats.formats.validation import build_valid_splats
from hyrfpack.splats.splats import Splats

# Written for scales and opacities of 0, whose logarithm and logit are infinite. In float32, exp(-104) and
# sigmoid(-104) are 0, so that these values are read back exactly.
_MIN_LOG_OR_LOGIT = -104.0
# Written for opacities of 1: in float32, sigmoid(20) is 1.
_MAX_LOGIT = 20.0


def encode(splats: Splats, hints: Hints = NO_HINTS) -> bytes:
    """Encode splats as a binary little-endian PLY file.

    Everything is stored as float32; `antialiased` is not stored.

    Raises:
        HyrfDataError: a position is too large for float32.
    """
    if np.abs(splats.positions).max(initial=0) > np.finfo(np.float32).max:
        raise HyrfDataError(
            "a Gaussian is farther from the origin than the numbers of PLY can express",
            fix="move the scene to the origin",
        )
    higher_count = 3 * (num_sh_bases(splats.degree) - 1)
    names = (
        *POSITION_PROPERTIES,
        "nx",
        "ny",
        "nz",
        *COLOR_PROPERTIES,
        *_list_higher_harmonics(higher_count),
        "opacity",
        *SCALE_PROPERTIES,
        *ROTATION_PROPERTIES,
    )
    with np.errstate(divide="ignore"):
        opacities = splats.opacities.astype(np.float64)
        logits = np.log(opacities) - np.log1p(-opacities)
        scales = np.log(splats.scales.astype(np.float64))
    table = np.zeros((len(splats), len(names)), "<f4")
    table[:, :3] = splats.positions
    table[:, 6:9] = splats.harmonics[:, 0]
    for column, (channel, term) in enumerate(product(range(3), range(1, splats.harmonics.shape[1])), 9):
        table[:, column] = splats.harmonics[:, term, channel]
    table[:, -8] = np.clip(logits, _MIN_LOG_OR_LOGIT, _MAX_LOGIT)
    table[:, -7:-4] = np.maximum(scales, _MIN_LOG_OR_LOGIT)
    table[:, -4:] = splats.quats
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(splats)}"]
    header += [f"property float {name}" for name in names] + ["end_header\n"]
    return b"".join(("\n".join(header).encode(), table.data))


def decode(data: bytes, name: str) -> Splats:
    """Decode a PLY file, plain or compressed. Raises the errors of `decode_plain` and `compressed_ply.decode`."""
    packed = is_compressed(read_header(data, name))
    return compressed_ply.decode(data, name) if packed else decode_plain(data, name)


def decode_plain(data: bytes, name: str) -> Splats:
    """Decode an uncompressed PLY file, binary or text, with properties of any type in any order.

    Other properties and elements are skipped; normals may be absent. Harmonics beyond degree 3 are dropped. Some
    programs write infinite opacity logits and scales of minus infinity; these become opacities of 0 or 1, and scales
    of 0.

    Args:
        data: the file's bytes.
        name: the file's name in error messages.

    Raises:
        HyrfDataError: the file is not a PLY file, holds no Gaussians, or is damaged.
    """
    header = read_header(data, name)
    properties = find_properties(header, name)
    higher_count = sum(label.startswith("f_rest_") for label in properties)
    terms = higher_count // 3 + 1
    if (
        terms not in (1, 4, 9, 16, 25)
        or higher_count % 3
        or not all(properties.get(label) for label in _list_higher_harmonics(higher_count))
    ):
        raise HyrfDataError(
            f"{name}: the file has {higher_count} properties f_rest_, but a degree of harmonics needs 0, 9, 24, 45 or "
            "72, numbered from 0",
            fix="export it again",
        )
    rows = read_elements(data, header, {"vertex"}, name)["vertex"]
    harmonics = np.empty((len(rows), min(terms, num_sh_bases(MAX_DEGREE)), 3), np.float32)
    with np.errstate(over="ignore", invalid="ignore"):  # infinite results are rejected below; a NaN may warn
        harmonics[:, 0] = stack_columns(rows, COLOR_PROPERTIES)
        for channel, term in product(range(3), range(1, harmonics.shape[1])):
            harmonics[:, term, channel] = rows[f"f_rest_{channel * (terms - 1) + term - 1}"]
        return build_valid_splats(
            name,
            stack_columns(rows, POSITION_PROPERTIES),
            np.exp(stack_columns(rows, SCALE_PROPERTIES).astype(np.float64)),
            stack_columns(rows, ROTATION_PROPERTIES),
            expit(rows["opacity"].astype(np.float64)),
            harmonics,
        )


def _list_higher_harmonics(count: int) -> list[str]:
    return [f"f_rest_{index}" for index in range(count)]

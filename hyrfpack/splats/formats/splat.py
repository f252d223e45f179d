"""The .splat format of antimatter15's viewer: records of 32 bytes, one for each Gaussian, without a header.

    position   3 float32
    scale      3 float32, linear
    colour     4 bytes: red, green, blue as 0.5 + Y00 k of the harmonics k of degree 0, and the opacity, all times 255
    rotation   4 bytes: quaternion wxyz, q * 128 + 128

Numbers are little-endian. Higher harmonics cannot be stored, so colours do not depend on the direction.
"""

from __future__ import annotations

import numpy as np

from hyrfpack.errors import HyrfDataError
from hyrfpack.splats.formats.hints import NO_HINTS, Hints
from hyrfpack.splats.formats.validation import build_valid_splats
from hyrfpack.splats.harmonics import SH_C0
from hyrfpack.splats.splats import Splats

MAX_HARMONICS_DEGREE = 0
_RECORD_DTYPE = np.dtype([("position", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("rotation", "u1", 4)])


def encode(splats: Splats, hints: Hints = NO_HINTS) -> bytes:
    """Encode splats as a .splat file, without their higher harmonics and `antialiased`.

    Gaussians are sorted by opacity times volume, largest first; equal ones keep their order. Viewers draw a file while
    it loads, so the first bytes should show as much as possible.

    Raises:
        HyrfDataError: a position is too large for float32.
    """
    if np.abs(splats.positions).max(initial=0) > np.finfo(np.float32).max:
        raise HyrfDataError(
            "a Gaussian is farther from the origin than the numbers of .splat can express",
            fix="move the scene to the origin",
        )
    order = np.argsort(-splats.opacities * np.prod(splats.scales, axis=1, dtype=np.float64), kind="stable")
    colors = splats.base_colors
    records = np.empty(len(splats), _RECORD_DTYPE)
    records["position"] = splats.positions[order]
    records["scale"] = splats.scales[order]
    records["color"] = _round_to_bytes(np.column_stack((colors, splats.opacities)) * 255)[order]
    records["rotation"] = _round_to_bytes(splats.quats * 128 + 128)[order]
    return records.tobytes()


def decode(data: bytes, name: str) -> Splats:
    """Decode a .splat file.

    Args:
        data: the file's bytes.
        name: the file's name in error messages.

    Raises:
        HyrfDataError: the length is not a multiple of 32, a number is not finite, or a scale is negative.
    """
    if len(data) % _RECORD_DTYPE.itemsize:
        raise HyrfDataError(
            f"{name}: {len(data):,} bytes are not a multiple of 32, the bytes of one Gaussian, so this is not a "
            ".splat file or it is truncated",
            fix="check the path, or export it again",
        )
    records = np.frombuffer(data, _RECORD_DTYPE)
    if (records["scale"] < 0).any():
        raise HyrfDataError(
            f"{name}: a scale is negative, so this is not a .splat file or it is damaged",
            fix="check the path, or export it again",
        )
    colors = records["color"] / np.float32(255)
    return build_valid_splats(
        name,
        records["position"],
        records["scale"],
        (records["rotation"] - np.float32(128)) / 128,
        colors[:, 3],
        (colors[:, None, :3] - 0.5) / SH_C0,
    )


def _round_to_bytes(values: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)

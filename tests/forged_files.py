"""Files with payloads made by hand: at the edges of what the codecs allow, and small ones that ask for much work."""

from __future__ import annotations

import json
import struct
import zlib

import numpy as np

from hyrfpack.format.arrays import MODEL_RULES, group_shapes, parse_config
from hyrfpack.quant.integers import encode_integers
from tools.safety.fuzz_mutate import RawSection, assemble

FREE = 3 << 24  # bytes that a file of any length may decode to
GAUSSIANS = 1 << 18  # that it may have
GRID = {"log2_table_size": 4, "levels": 1, "base": 2, "finest": 2}
CONFIG = {
    "frame": {"center": [0.0, 0.0, 0.0], "scale": 1.0, "half_extent": [1.0, 0.75, 0.5]},
    "geometry": GRID,
    "radiance": GRID,
    "hidden": 1,
    "background": True,
    "solid": [0.0, 0.0, 0.0],
    "scale_rule": "sum",
    "scale_grows": True,
    "direction_encoding": "sh",
    "position_gradients": False,
    "antialiased": False,
}
# Payloads in which every integer is the same take no bytes, however many there are.
ALIKE = b"\0\0\0"  # 0 in one context
POINTS = struct.pack("<BBII", 1, 1, 3, 4) + b"\1" + ALIKE + b"\0\0\0\0"  # in two contexts for the classes
CHANNEL = struct.pack("<fBIB", 0.5, 16, 3, 1) + b"\x40" + ALIKE
BASIS = struct.pack("<9f", 1, 0, 0, 0, 1, 0, 0, 0, 1)
GROUPS = struct.pack("<II", 3, 3) + b"\0\0\x08" + ALIKE + b"\0\0\2"
COMPACT = {"POSI": (6, POINTS), "COLO": (7, BASIS + 3 * CHANNEL), "SCAL": (7, CHANNEL), "OPAC": (7, CHANNEL)}
COMPACT |= {group: (8, GROUPS) for group in ("GTAB", "RTAB", "GMLP", "RMLP")}

Payloads = dict[str, tuple[int, bytes]]


def metadata(count: int, provenance: dict | None = None, **config: object) -> dict:
    """What META says."""
    texts = {"profile": "", "settings": {}, "provenance": provenance or {}, "writer": ""}
    return {"gaussians": count, "config": CONFIG | config, "rules": MODEL_RULES, **texts}


def with_text(text: bytes, payloads: Payloads, shapes: dict[str, tuple[int, int]], deflated: bytes = b"") -> bytes:
    """A file with this text as metadata, deflated if it is given so, and (codec, bytes) by section."""
    parts = [RawSection(b"META", 5 if deflated else 0, 1, deflated or text, len(text))]
    for group, (rows, columns) in shapes.items():
        codec, data = payloads[group]
        parts.append(RawSection(group.encode(), codec, 1, data, 4 * rows * columns))
    return assemble(parts)


def text_of(meta: dict) -> bytes:
    """Metadata as JSON."""
    return json.dumps(meta, separators=(",", ":")).encode()


def shapes_of(meta: dict) -> dict[str, tuple[int, int]]:
    """Rows and columns of each section."""
    return group_shapes(parse_config(meta["config"]), meta["gaussians"])


def file_of(meta: dict, payloads: Payloads) -> bytes:
    """A file with this metadata, deflated; other arguments as `with_text`."""
    text = text_of(meta)
    return with_text(text, payloads, shapes_of(meta), zlib.compress(text, 9))


def plain(meta: dict) -> Payloads:
    """Zeros as float32."""
    return {group: (1, bytes(4 * rows * columns)) for group, (rows, columns) in shapes_of(meta).items()}


def lattice(codes: np.ndarray, base: int, bits: list[int], classes: np.ndarray, tails: bytes = b"") -> bytes:
    """A payload of codec 6 of Morton codes (N,) of `base` bits an axis, in order."""
    gaps = np.diff(codes, prepend=0)
    gap_bytes = encode_integers(gaps)
    class_bytes = encode_integers(classes, (gaps == 0).view(np.uint8))
    head = struct.pack("<BBII", base, len(bits), len(gap_bytes), len(class_bytes)) + bytes(bits)
    return head + gap_bytes + class_bytes + tails


def channel(differences: np.ndarray, classes: np.ndarray, codes: bytes, mean: float, weight: int) -> bytes:
    """A channel of codec 7."""
    stream = encode_integers(differences, classes, signed=True)
    return struct.pack("<fBIB", mean, weight, len(stream), len(codes)) + codes + stream


def most_gaussians() -> bytes:
    """As many Gaussians as a file of a kilobyte may have, all alike; valid."""
    return file_of(metadata(GAUSSIANS - 100), COMPACT)


def largest_tables() -> bytes:
    """Tables as large as a file of a kilobyte may have, all numbers alike; valid."""
    grid = {"log2_table_size": 24, "levels": 1, "base": 146, "finest": 146}
    return file_of(metadata(1, geometry=grid, radiance=grid), COMPACT)


def longest_metadata() -> bytes:
    """A million bytes of JSON out of two thousand; valid."""
    meta = metadata(0, {"list": [0] * 520_000})
    return file_of(meta, plain(meta))


def deepest_metadata() -> bytes:
    """A million brackets."""
    meta = metadata(0)
    text = b"[" * (1 << 20)
    return with_text(text, plain(meta), shapes_of(meta), zlib.compress(text, 9))


def nothing_there(codec: int) -> bytes:
    """Millions of Gaussians in a codec, and no byte of them."""
    meta = metadata(GAUSSIANS - 100)
    empty = dict.fromkeys(("POSI", "COLO", "SCAL", "OPAC"), (codec, b""))
    return file_of(meta, plain(metadata(0)) | empty)


def ends_in_damage() -> bytes:
    """Millions of points, all alike, and one bit too many after them."""
    return file_of(metadata(GAUSSIANS - 100), COMPACT | {"POSI": (6, POINTS + b"\1")})


SMALL = {
    "longest_metadata": longest_metadata,
    "deepest_metadata": deepest_metadata,
    **{f"nothing_there_{codec}": lambda codec=codec: nothing_there(codec) for codec in (1, 2, 3, 4, 6, 7, 8)},
    "ends_in_damage": ends_in_damage,
}

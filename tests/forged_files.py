"""Build `.hyrf` files from hand-made payloads: at the limits of the codecs, and small files that demand much work."""

from __future__ import annotations

import json
import struct
import zlib

import numpy as np

from hyrfpack.format.arrays import MODEL_RULES, group_shapes, parse_config
from hyrfpack.quant.integers import encode_integers
from tools.safety.fuzz_mutate import RawSection, assemble

# docs/reference/format.md allows a file of any length this many decoded bytes and Gaussians; more need a longer file.
EXTRA_DECODED_BYTES = 3 << 24
EXTRA_GAUSSIANS = 1 << 18
GRID_CONFIG = {"log2_table_size": 4, "levels": 1, "base": 2, "finest": 2}
MODEL_CONFIG = {
    "frame": {"center": [0.0, 0.0, 0.0], "scale": 1.0, "half_extent": [1.0, 0.75, 0.5]},
    "geometry": GRID_CONFIG,
    "radiance": GRID_CONFIG,
    "hidden": 1,
    "background": True,
    "solid": [0.0, 0.0, 0.0],
    "scale_rule": "sum",
    "scale_grows": True,
    "direction_encoding": "sh",
    "position_gradients": False,
    "antialiased": False,
}
# A stream whose integers are all equal takes no bytes for them, however many there are. This one holds zeros in one
# context; the classes of points need the same in two contexts.
CONSTANT_STREAM = b"\0\0\0"
CONSTANT_POINTS = struct.pack("<BBII", 1, 1, 3, 4) + b"\1" + CONSTANT_STREAM + b"\0\0\0\0"
CONSTANT_CHANNEL = struct.pack("<fBIB", 0.5, 16, 3, 1) + b"\x40" + CONSTANT_STREAM
IDENTITY_BASIS = struct.pack("<9f", 1, 0, 0, 0, 1, 0, 0, 0, 1)
CONSTANT_GROUP = struct.pack("<II", 3, 3) + b"\0\0\x08" + CONSTANT_STREAM + b"\0\0\2"
CONSTANT_PAYLOADS = {
    "POSI": (6, CONSTANT_POINTS),
    "COLO": (7, IDENTITY_BASIS + 3 * CONSTANT_CHANNEL),
    "SCAL": (7, CONSTANT_CHANNEL),
    "OPAC": (7, CONSTANT_CHANNEL),
}
CONSTANT_PAYLOADS |= {group: (8, CONSTANT_GROUP) for group in ("GTAB", "RTAB", "GMLP", "RMLP")}

Payloads = dict[str, tuple[int, bytes]]


def make_meta(count: int, provenance: dict | None = None, **config: object) -> dict:
    """Return the content of the META section."""
    texts = {"profile": "", "settings": {}, "provenance": provenance or {}, "writer": ""}
    return {"gaussians": count, "config": MODEL_CONFIG | config, "rules": MODEL_RULES, **texts}


def assemble_file(text: bytes, payloads: Payloads, shapes: dict[str, tuple[int, int]], deflated: bytes = b"") -> bytes:
    """Build a file from the text of its metadata and (codec, bytes) by section.

    `deflated`, if given, is stored in place of the text.
    """
    parts = [RawSection(b"META", 5 if deflated else 0, 1, deflated or text, len(text))]
    for group, (rows, columns) in shapes.items():
        codec, data = payloads[group]
        parts.append(RawSection(group.encode(), codec, 1, data, 4 * rows * columns))
    return assemble(parts)


def metadata_json(meta: dict) -> bytes:
    """Serialise metadata as compact JSON."""
    return json.dumps(meta, separators=(",", ":")).encode()


def section_shapes(meta: dict) -> dict[str, tuple[int, int]]:
    """Return the rows and columns of each section."""
    return group_shapes(parse_config(meta["config"]), meta["gaussians"])


def build_file(meta: dict, payloads: Payloads) -> bytes:
    """Build a file from its metadata, which is deflated, and (codec, bytes) by section."""
    text = metadata_json(meta)
    return assemble_file(text, payloads, section_shapes(meta), zlib.compress(text, 9))


def zero_payloads(meta: dict) -> Payloads:
    """Return float32 zeros as the payload of every section."""
    return {group: (1, bytes(4 * rows * columns)) for group, (rows, columns) in section_shapes(meta).items()}


def points_payload(codes: np.ndarray, base: int, bits: list[int], classes: np.ndarray, tails: bytes = b"") -> bytes:
    """Return a payload of codec 6 from sorted Morton codes (N,) of `base` bits per axis."""
    gaps = np.diff(codes, prepend=0)
    gap_bytes = encode_integers(gaps)
    class_bytes = encode_integers(classes, (gaps == 0).view(np.uint8))
    head = struct.pack("<BBII", base, len(bits), len(gap_bytes), len(class_bytes)) + bytes(bits)
    return head + gap_bytes + class_bytes + tails


def channel_payload(differences: np.ndarray, classes: np.ndarray, codes: bytes, mean: float, weight: int) -> bytes:
    """Return one channel of a payload of codec 7."""
    stream = encode_integers(differences, classes, signed=True)
    return struct.pack("<fBIB", mean, weight, len(stream), len(codes)) + codes + stream


def file_with_most_gaussians() -> bytes:
    """Return a valid file of about a kilobyte with nearly the most Gaussians it may have, all equal."""
    return build_file(make_meta(EXTRA_GAUSSIANS - 100), CONSTANT_PAYLOADS)


def file_with_largest_tables() -> bytes:
    """Return a valid file of about a kilobyte with the largest tables it may have, all numbers equal."""
    grid = {"log2_table_size": 24, "levels": 1, "base": 146, "finest": 146}
    return build_file(make_meta(1, geometry=grid, radiance=grid), CONSTANT_PAYLOADS)


def file_with_longest_metadata() -> bytes:
    """Return a valid file whose metadata is deflated from a million bytes of JSON to two thousand."""
    meta = make_meta(0, {"list": [0] * 520_000})
    return build_file(meta, zero_payloads(meta))


def file_with_deepest_metadata() -> bytes:
    """Return a file whose metadata is a million opening brackets."""
    meta = make_meta(0)
    text = b"[" * (1 << 20)
    return assemble_file(text, zero_payloads(meta), section_shapes(meta), zlib.compress(text, 9))


def file_with_empty_deflate_blocks(text_bytes: int, added_bytes: int) -> bytes:
    """Return a file whose deflated metadata begins with empty blocks of fixed codes.

    Args:
        text_bytes: length of the metadata's text, which spaces at its end fill up.
        added_bytes: by how many bytes its zlib stream is longer than the text.
    """
    meta = make_meta(0)
    text = metadata_json(meta).ljust(text_bytes)
    four_blocks = sum(0b0000000_01_0 << 10 * k for k in range(4)).to_bytes(5, "little")
    for _ in range(5):  # four empty blocks fill five bytes
        deflated = zlib.compress(text, 9)
        count, rest = divmod(len(text) + added_bytes - len(deflated), len(four_blocks))
        if not rest:
            break
        text += b" "
    deflated = deflated[:2] + four_blocks * count + deflated[2:]
    assert len(deflated) == len(text) + added_bytes
    return assemble_file(text, zero_payloads(meta), section_shapes(meta), deflated)


def file_with_empty_payloads(codec: int) -> bytes:
    """Return a file that declares the most Gaussians in `codec`, with payloads of zero bytes."""
    meta = make_meta(EXTRA_GAUSSIANS - 100)
    empty = dict.fromkeys(("POSI", "COLO", "SCAL", "OPAC"), (codec, b""))
    return build_file(meta, zero_payloads(make_meta(0)) | empty)


def file_with_extra_bit_after_points() -> bytes:
    """Return a file with the most Gaussians, all equal, whose points are followed by one bit too many."""
    return build_file(make_meta(EXTRA_GAUSSIANS - 100), CONSTANT_PAYLOADS | {"POSI": (6, CONSTANT_POINTS + b"\1")})


SMALL_HOSTILE_FILES = {
    "long_metadata": file_with_longest_metadata,
    "deep_metadata": file_with_deepest_metadata,
    **{
        f"empty_payloads_of_codec_{codec}": lambda codec=codec: file_with_empty_payloads(codec)
        for codec in (1, 2, 3, 4, 6, 7, 8)
    },
    "extra_bit_after_points": file_with_extra_bit_after_points,
}

"""Read `.hyrf` files of versions 1.0 to 1.6, by code written only from docs/reference/format.md, with numpy alone.

This reader shares no code with hyrfpack. So it tests whether the page is complete and whether hyrfpack conforms to it.
It is simple, not fast: a file of 30,000 Gaussians takes some seconds. Section numbers are those of the page.

    metadata, groups, exposure = read(Path("scene.hyrf").read_bytes())
    groups["POSI"]      # float32 (N, 3), the Gaussians of all layers
    local_pose(metadata["config"]["frame"], camera_from_world)
    if exposure:        # the file has an exposure map
        log_gains(exposure, position, direction)
"""

from __future__ import annotations

import json
import math
import re
import struct
import zlib
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

MATRIX_CODECS = {
    "POSI": {1, 2, 3, 4, 6},
    "COLO": {1, 2, 3, 4, 7},
    "SCAL": {1, 2, 3, 4, 7},
    "OPAC": {1, 2, 3, 4, 7},
    "GTAB": {1, 2, 3, 4, 8, 11},
    "RTAB": {1, 2, 3, 4, 8, 11},
    "GMLP": {1, 2, 3, 4, 8},
    "RMLP": {1, 2, 3, 4, 8},
    "SHAP": {1, 2, 3, 4, 13},
    "HARM": {1, 2, 3, 4, 13},
}
LAYERED_GROUPS = ("POSI", "COLO", "SCAL", "OPAC")
RESIDUAL_GROUPS = ("SHAP", "HARM")
FIELD_GROUPS = ("GTAB", "RTAB", "GMLP", "RMLP")
REQUIRED_RULES = {
    "activations": "sigmoid",
    "background_radius": 100.0,
    "contraction": "l2",
    "decoders": "relu",
    "hash": "instant-ngp",
    "rotation": "identity-offset",
}
METADATA_KEYS = {"gaussians", "config", "rules", "profile", "settings", "provenance", "writer"}
CONFIG_KEYS = {
    *("frame", "geometry", "radiance", "hidden", "background", "solid"),
    *("scale_rule", "scale_grows", "direction_encoding", "antialiased", "position_gradients"),
}
FRAME_KEYS = {"center", "scale", "half_extent"}
GRID_KEYS = {"log2_table_size", "levels", "base", "finest"}
LARGEST_FLOAT = 2**1024 - 2**970


def read(
    data: bytes, part: bool = False, folder: dict[str, bytes] | None = None
) -> tuple[dict[str, Any], dict[str, np.ndarray], Exposure | None]:
    """Read a file.

    Args:
        data: the bytes of a file.
        part: whether `data` may be the start of a file; incomplete layers, and all layers after them, are left out.
        folder: the bytes of other files of its folder by name, which its sections may refer to (2.12).

    Returns:
        The metadata; the eight groups of section 2 and the residuals, if there are any, by the type of their first
        layer, as float32 matrices (rows, columns); and the exposure map, None without one.

    Raises:
        ValueError: the specification requires readers to reject the file.
        zlib.error: a deflate stream is damaged.
    """
    sections = read_container(data, part)
    require("META" in sections, "a section is missing")
    metadata = read_metadata(sections["META"])
    if shared := follow_references(sections, folder or {}):
        metadata["provenance"] = read_metadata(shared["META"])["provenance"] | metadata["provenance"]
    config, layers = metadata["config"], metadata.get("layers") or [metadata["gaussians"]]
    shapes = list_matrix_shapes(config, layers)
    for (group, layer), (rows, columns) in shapes.items():
        name = section_type(group, layer)
        require(name in sections, f"{name}: the section is missing")
        require(sections[name].raw_length == 4 * rows * columns, f"{name}: wrong raw length")
        require(sections[name].codec in MATRIX_CODECS[group], f"{name}: codec not allowed here")
    used_layers = 1
    while used_layers < len(layers) and all(
        sections[section_type(group, used_layers)].whole for group, layer in shapes if layer == used_layers
    ):
        used_layers += 1
    require(sum(layers[:used_layers]) <= 32 * len(data) + 2**18, "META: too many Gaussians for so few bytes")

    matrices: dict[str, list[np.ndarray]] = {group: [] for group, layer in shapes if layer == 0}
    points: dict[int, Points] = {}
    # POSI comes first in a layer, because other sections depend on it.
    for (group, layer), (rows, columns) in shapes.items():
        if layer >= used_layers:
            continue
        section = sections[section_type(group, layer)]
        codec, source = section.codec, Cursor(section.read())
        if codec in (1, 2):
            numbers = np.frombuffer(source.rest(), "<f4" if codec == 1 else "<f2")
        elif codec == 3:
            numbers = read_codebooks(source, rows, columns)
        elif codec == 4:
            numbers = read_min_max(source, rows * columns)
        elif codec == 6:
            points[layer] = read_points(source, rows)
            numbers = decode_positions(points[layer], config["frame"]["half_extent"])
        elif codec == 7:
            require(layer in points, f"{group}: codec 7 without lattice points in layer {layer}")
            numbers = read_channels(source, columns, points[layer].classes)
        elif codec == 13:
            require(layer in points, f"{group}: codec 13 without lattice points in layer {layer}")
            numbers = read_residuals(source, columns, points[layer].classes, group == "HARM")
        elif codec == 11:
            numbers = read_numbers(source, stated_groups(source, config["geometry" if group == "GTAB" else "radiance"]))
        elif group in ("GMLP", "RMLP"):
            numbers = read_numbers(source, decoder_groups(list_decoder_layers(config, group)))
        else:
            require(0 in points, f"{group}: codec 8 without lattice points")
            grid = config["geometry" if group == "GTAB" else "radiance"]
            numbers = read_numbers(source, (np.repeat(table_groups(grid, points[0].m), 2), 16 * grid["levels"]))
        source.end()
        require(numbers.size == rows * columns, f"{group}: {numbers.size} numbers")
        matrices[group].append(numbers.astype(np.float32).reshape(rows, columns))
        require(bool(np.isfinite(matrices[group][-1]).all()), f"{group}: NaN or infinite")
    exposure = read_exposure(sections["EXPO"]) if "EXPO" in sections and sections["EXPO"].whole else None
    return metadata, {group: np.concatenate(parts) for group, parts in matrices.items()}, exposure


def read_parts(data: bytes) -> list[tuple[str, Any]]:
    """Read a merged file (2.11): the name of each part, and what `read` returns for it.

    The arguments and the errors are those of `read`.
    """
    sections = read_container(data)
    require("PRTS" in sections, "this is no merged file")
    names = sections["PRTS"]
    require(names.codec == 0 and names.raw_length == names.stored_length <= 2**16, "PRTS: unknown codec or size")
    content = parse_json(names.read())
    require(isinstance(content, dict) and "names" in content, "PRTS: no object with names")
    listed = content["names"]
    require(isinstance(listed, list) and 1 <= len(listed) <= 64, "PRTS: not 1 to 64 names")
    require(all(isinstance(name, str) and 1 <= len(name) <= 64 for name in listed), "PRTS: a name")
    require(
        not any(is_control(ord(letter)) for name in listed for letter in name) and len(set(listed)) == len(listed),
        "PRTS: a name",
    )
    files, raw_total = [], 0
    for number in range(len(listed)):
        require(f"PT{number:02d}" in sections, f"part {number} is missing")
        section = sections[f"PT{number:02d}"]
        require(section.codec == 10 and section.raw_length == section.stored_length, "a part is not stored as a file")
        files.append(section.read())
        inner = read_container(files[-1])
        require("PRTS" not in inner, "a part is a merged file")
        raw_total += sum(part.raw_length for part in inner.values())
    require(raw_total <= min(1024 * len(data) + 3 * 2**24, 2**34), "the parts are too large")
    parts = [read(file) for file in files]
    require(sum(part[0]["gaussians"] for part in parts) <= 32 * len(data) + 2**18, "too many Gaussians")
    require(len({part[0]["config"]["antialiased"] for part in parts}) == 1, "antialiased differs between parts")
    return list(zip(listed, parts, strict=True))


def is_control(code: int) -> bool:
    return code < 0x20 or 0x7F <= code < 0xA0 or code in (0x2028, 0x2029) or 0xD800 <= code < 0xE000


# Bytes


def require(condition: bool, message: str) -> None:
    if not condition:
        raise ValueError(message)


class Cursor:
    """A position in bytes that advances as they are taken; it raises ValueError if bytes are missing or left over."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0

    def take(self, count: int) -> bytes:
        require(self.at + count <= len(self.data), "bytes end too early")
        self.at += count
        return self.data[self.at - count : self.at]

    def unpack(self, layout: str) -> tuple:
        return struct.unpack("<" + layout, self.take(struct.calcsize("<" + layout)))

    def numbers(self, dtype: str, count: int) -> list:
        return np.frombuffer(self.take(np.dtype(dtype).itemsize * count), dtype).tolist()

    def rest(self) -> bytes:
        return self.take(len(self.data) - self.at)

    def end(self) -> None:
        require(self.at == len(self.data), "bytes left over")


def read_bits(data: bytes, widths: np.ndarray) -> np.ndarray:
    """Read one number for each width in bits, lowest bit first, from the lowest bit of the first byte (3.1)."""
    total = int(widths.sum())
    require(len(data) == -(-total // 8), "wrong number of bits")
    bits = np.unpackbits(np.frombuffer(data, np.uint8), bitorder="little").astype(np.int64)
    require(not bits[total:].any(), "bits left in the last byte are not zero")
    starts = np.cumsum(widths) - widths
    numbers = np.zeros(len(widths), np.int64)
    for k in range(int(widths.max(initial=0))):
        wide = widths > k
        numbers[wide] |= bits[starts[wide] + k] << k
    return numbers


# 1. Container


@dataclass(frozen=True)
class Section:
    name: str
    codec: int
    raw_length: int
    stored_length: int
    crc: int
    padded: bytes  # stored bytes and padding; incomplete if the data ends before them
    whole: bool

    def read(self) -> bytes:
        """Return the stored bytes after the checks of step 7 of 1.3."""
        require(self.whole, f"{self.name}: the section is incomplete")
        stored, padding = self.padded[: self.stored_length], self.padded[self.stored_length :]
        require(zlib.crc32(stored) == self.crc and not any(padding), f"{self.name}: damaged")
        return stored


def section_type(group: str, layer: int) -> str:
    """Return the type of a group's section in a layer: POSI, then POS1, POS2, ... (2)."""
    return f"{group[:3]}{layer}" if layer else group


KNOWN_SECTION_TYPES = {
    "META",
    "EXPO",
    "PRTS",
    *(f"PT{number:02d}" for number in range(64)),
    *FIELD_GROUPS,
    *(section_type(group, layer) for group in LAYERED_GROUPS + RESIDUAL_GROUPS for layer in range(8)),
}


def read_container(data: bytes, part: bool = False) -> dict[str, Section]:
    """Return the sections by type after the checks of steps 1 to 6 of 1.3."""
    require(data[:8] == b"\x89HYRF\r\n\n", "not a .hyrf file")
    header = Cursor(data)
    _, major, _, flags, length, toc_at, toc_length, count, toc_crc, header_crc = header.unpack("8sHHIQQIIII")
    require(major == 1, f"major version {major}")
    require(zlib.crc32(data[:44]) == header_crc and flags == 0, "damaged header")
    require(length == len(data) or (part and length > len(data)), "wrong file length")
    require(length <= 2**34, "file too long")
    require(count <= 1024 and toc_at == 48 and toc_length == 40 * count, "table of contents in the wrong place")
    toc = Cursor(header.take(toc_length))
    require(zlib.crc32(toc.data) == toc_crc, "damaged table of contents")

    sections, expected, raw_total = {}, 48 + toc_length, 0
    for _ in range(count):
        kind, codec, flags, offset, stored_length, raw_length, crc, reserved = toc.unpack("4sHHQQQII")
        name = kind.decode("latin-1")
        require(name.isascii() and name.replace("_", "0").isalnum() and name not in sections, f"bad type {name!r}")
        require(flags <= 1 and reserved == 0, f"{name}: reserved bit")
        require(flags == 0 or name in KNOWN_SECTION_TYPES, f"{name}: required but unknown")
        end = offset + stored_length
        padded = -(-end // 8) * 8
        require(offset == expected and padded <= length, f"{name}: in the wrong place")
        sections[name] = Section(name, codec, raw_length, stored_length, crc, data[offset:padded], padded <= len(data))
        expected, raw_total = padded, raw_total + raw_length * sections[name].whole
    require(expected == length, "bytes after the last section")
    require(raw_total <= min(1024 * len(data) + 3 * 2**24, 2**34), "sections too large")
    return sections


# 2.12 Sections of other files


def follow_references(sections: dict[str, Section], folder: dict[str, bytes]) -> dict[str, Section]:
    """Replace sections of codec 12 by those that they refer to; return the sections of the other file, if any."""
    references = {
        name: section
        for name, section in sections.items()
        if section.codec == 12 and section.whole and name in {"EXPO", *FIELD_GROUPS}
    }
    names = set()
    for section in references.values():
        require(section.raw_length == section.stored_length > 4, f"{section.name}: wrong raw length")
        names.add(section.read()[4:])
    require(len(names) < 2, "references to several files")
    if not names:
        return {}
    name = names.pop()
    require(re.fullmatch(rb"[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}", name) is not None, "bad name of a file")
    require(name.endswith(b".hyrf") and len(name) <= 64 and name.decode() in folder, "a file is missing")
    shared = read_container(folder[name.decode()])
    require("META" in shared, "the other file has no metadata")
    for own in references.values():
        require(own.name in shared and shared[own.name].codec != 12, f"{own.name}: not in the other file")
        depends_on_points = own.name in ("GTAB", "RTAB") and shared[own.name].codec == 8
        require(not depends_on_points, f"{own.name}: codec 8 in the other file")
        require(shared[own.name].crc == struct.unpack("<I", own.read()[:4])[0], f"{own.name}: another section")
        sections[own.name] = shared[own.name]
    return shared


# 2.1 Metadata and the shapes that follow from it


def read_metadata(section: Section) -> dict[str, Any]:
    require(section.codec in (0, 5) and section.raw_length <= 2**20, "META: unknown codec or too long")
    text = section.read()
    if section.codec == 5:
        require(len(text) <= section.raw_length + 1024, "META: too many stored bytes")
        inflate = zlib.decompressobj()
        text = inflate.decompress(text, section.raw_length + 1)
        require(inflate.eof and not inflate.unused_data, "META: bad deflate stream")
    require(len(text) == section.raw_length, "META: wrong raw length")
    metadata = parse_json(text)
    require(isinstance(metadata, dict) and nesting_depth(metadata) <= 64, "META: not an object or too deep")
    require(all(map(math.isfinite, list_floats(metadata))), "META: NaN or infinity")
    require(METADATA_KEYS <= metadata.keys(), "META: a key is missing")
    require(metadata["rules"] == REQUIRED_RULES, "META: other rules")
    for key in ("settings", "provenance"):
        require(isinstance(metadata[key], dict), f"META: {key} is no object")
    for key in ("profile", "writer"):
        require(isinstance(metadata[key], str), f"META: {key} is no text")
    config = metadata["config"]
    check_keys(config, CONFIG_KEYS, "residual_degree")
    frame = config["frame"]
    check_keys(frame, FRAME_KEYS, "rotation")
    check_integer(metadata["gaussians"], 0, 2**40 - 1)
    layers = metadata.get("layers", [])
    require(isinstance(layers, list) and len(layers) <= 8, "META: layers")
    require(
        not layers or sum(check_integer(n, 0, 2**40) for n in layers) == metadata["gaussians"],
        "META: layers do not add up",
    )
    check_integer(config["hidden"], 1, 1024)
    if "residual_degree" in config:
        check_integer(config["residual_degree"], 0, 3)
    for grid in (config["geometry"], config["radiance"]):
        check_keys(grid, GRID_KEYS)
        check_integer(grid["log2_table_size"], 4, 24)
        check_integer(grid["levels"], 1, 32)
        check_integer(grid["finest"], check_integer(grid["base"], 2, 65536), 65536)
    require(config["direction_encoding"] in ("sh", "frequency"), "META: direction_encoding")
    require(config["scale_rule"] in ("sum", "product"), "META: scale_rule")
    for key in ("background", "scale_grows", "antialiased", "position_gradients"):
        require(isinstance(config[key], bool), f"META: {key} is no boolean")
    check_numbers(config["solid"], 3)
    check_numbers(frame["center"], 3)
    check_numbers([frame["scale"]], 1)
    check_numbers(frame["half_extent"], 3)
    require(frame["scale"] > 0 and min(frame["half_extent"]) > 0, "META: frame")
    if "rotation" in frame:
        check_numbers(frame["rotation"], 4)
        require(abs(math.hypot(*frame["rotation"]) - 1) <= 1e-6, "META: the rotation has no unit length")
    return metadata


def parse_json(text: bytes) -> Any:
    try:
        return json.loads(text.decode("utf-8"), parse_constant=refuse_constant)
    except RecursionError:  # Python's parser calls itself for each level of nesting
        raise ValueError("JSON: too deep") from None


def refuse_constant(name: str) -> None:
    raise ValueError(f"JSON: {name}")


def check_keys(value: Any, keys: set[str], *optional: str) -> None:
    require(isinstance(value, dict) and set(value) - {*optional} == keys, "META: unknown or missing keys in config")


def check_numbers(value: Any, count: int) -> None:
    require(isinstance(value, list) and len(value) == count, f"META: {value!r:.40} is no list of {count}")
    is_valid = all(type(number) in (int, float) and abs(number) <= LARGEST_FLOAT for number in value)
    require(is_valid, f"META: {value!r:.40} holds something else than numbers")


def nesting_depth(value: Any) -> int:
    """Return how deep lists and objects are nested; 0 for a number or a text."""
    depth, values = 0, [value]
    while containers := [item for item in values if isinstance(item, (dict, list))]:
        values = [item for outer in containers for item in (outer.values() if isinstance(outer, dict) else outer)]
        depth += 1
    return depth


def list_floats(value: Any) -> list[float]:
    inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return [value] if isinstance(value, float) else [number for item in inner for number in list_floats(item)]


def check_integer(value: Any, low: int, high: int) -> int:
    require(type(value) is int and low <= value <= high, f"META: {value!r} is not an integer from {low} to {high}")
    return value


def list_matrix_shapes(config: dict[str, Any], layers: list[int]) -> dict[tuple[str, int], tuple[int, int]]:
    """Return the rows and columns of each (group, layer); field groups have layer 0 only (2)."""
    shapes = {}
    columns_by_group = dict(zip(LAYERED_GROUPS, (3, 3, 1, 1), strict=True))
    if "residual_degree" in config:
        columns_by_group |= {"SHAP": 5, "HARM": 3 * (config["residual_degree"] + 1) ** 2}
    for layer, n in enumerate(layers):
        shapes |= {(group, layer): (n, columns) for group, columns in columns_by_group.items()}
    for name, grid in (("GTAB", config["geometry"]), ("RTAB", config["radiance"])):
        shapes[name, 0] = (sum(rows for _, rows in list_grid_levels(grid)), 2)
    for name in ("GMLP", "RMLP"):
        shapes[name, 0] = (sum(outputs * (inputs + 1) for inputs, outputs in list_decoder_layers(config, name)), 1)
    return shapes


def list_grid_levels(grid: dict[str, int]) -> list[tuple[int, int]]:
    """Return (vertices per axis, rows) of each level of a hash grid (2.3)."""
    growth = (grid["finest"] / grid["base"]) ** (1 / max(grid["levels"] - 1, 1))
    vertices = [math.ceil(grid["base"] * growth**level - 1e-6) for level in range(grid["levels"])]
    return [(r, min(r**3, 2 ** grid["log2_table_size"])) for r in vertices]


def list_decoder_layers(config: dict[str, Any], name: str) -> list[tuple[int, int]]:
    """Return (inputs, outputs) of the three layers of a decoder (2.4)."""
    if name == "GMLP":
        inputs, outputs = 2 * config["geometry"]["levels"], 8
    else:
        inputs, outputs = 2 * config["radiance"]["levels"] + {"sh": 9, "frequency": 24}[config["direction_encoding"]], 3
    return [(inputs, config["hidden"]), (config["hidden"], config["hidden"]), (config["hidden"], outputs)]


# 2.2 Codecs 3 and 4, 2.5 Huffman streams


def read_codebooks(source: Cursor, rows: int, columns: int) -> np.ndarray:
    stages, width, words = source.unpack("BBH")
    require(1 <= stages <= 16 and width == columns and words >= 1, "codec 3: bad sizes")
    codebooks = np.array(source.numbers("<f2", stages * words * width), np.float32).reshape(stages, words, width)
    require(bool(np.isfinite(codebooks).all()), "codec 3: NaN or infinite")
    total = np.zeros((rows, width), np.float32)
    for book in codebooks:
        stream = Cursor(source.take(source.unpack("Q")[0]))
        indices = read_huffman(stream, rows)
        stream.end()
        require(bool((indices < words).all()), "codec 3: index out of range")
        total += book[indices]
    return total


def read_min_max(source: Cursor, count: int) -> np.ndarray:
    low, high, bits = source.unpack("ffB")
    require(math.isfinite(low) and math.isfinite(high) and low <= high and 1 <= bits <= 16, "codec 4: bad range")
    top, q = 2**bits - 1, read_huffman(source, count)
    require(bool((q <= top).all()), "codec 4: code out of range")
    return ((top - q) * low + q * high) / top


def read_huffman(source: Cursor, count: int) -> np.ndarray:
    symbol_count, packed_bytes, leaves, end_mark, symbol_bytes, size_bytes = source.unpack("QQIIBB")
    require(symbol_count == count <= 8 * packed_bytes, "Huffman: wrong number of symbols")
    require(symbol_bytes in (1, 2) and size_bytes in (2, 4), "Huffman: bad header")
    require(end_mark < leaves or leaves == end_mark == count == 0, "Huffman: no end mark")
    lengths = list(source.take(leaves))
    symbols: list[Any] = source.numbers(f"<u{symbol_bytes}", max(leaves - 1, 0))
    chunk = max(1024, 2 * -(-count // 2048))
    sizes = source.numbers(f"<u{size_bytes}", -(-count // chunk))
    packed = source.take(packed_bytes)
    require(packed_bytes == -(-sum(sizes) // 8), "Huffman: sizes do not add up")
    require(all(1 <= length <= 57 for length in lengths), "Huffman: length out of range")
    require(len(set(symbols)) == len(symbols), "Huffman: a symbol occurs twice")
    symbols.insert(end_mark, None)

    codes, code = [], 0
    for length in lengths:
        require(code % 2 ** (64 - length) == 0, "Huffman: bad code")
        codes.append(code)
        code += 2 ** (64 - length)
    require(code == (2**64 if leaves else 0), "Huffman: code is not complete")

    packed += bytes(9)
    decoded, at = [], 0
    for first in range(0, count, chunk):
        stop = at + sizes[first // chunk]
        for _ in range(first, min(first + chunk, count)):
            next_bits = int.from_bytes(packed[at // 8 : at // 8 + 9], "big") >> (8 - at % 8) & (2**64 - 1)
            leaf = bisect_right(codes, next_bits) - 1
            require(leaf != end_mark, "Huffman: the end mark comes too early")
            decoded.append(symbols[leaf])
            at += lengths[leaf]
        require(at == stop, "Huffman: a chunk ends elsewhere than its size says")
    return np.array(decoded, np.int64)


# 3.1 Integer streams


def read_integers(data: bytes, contexts: np.ndarray, signed: bool = False) -> np.ndarray:
    """Read one integer for each context; the integers must fill `data`."""
    source = Cursor(data)
    tokens = np.array(read_tokens(source, contexts.tolist()), np.int64)
    n = np.where(tokens < 28, tokens // 4, (tokens - 14) // 2)  # floor(log2 v); only for tokens of 16 and more
    leading = np.where(tokens < 28, 4 + tokens % 4, 2 + tokens % 2)  # the 3 or 2 highest bits of v
    widths = np.where(tokens < 16, 0, np.where(tokens < 28, n - 2, n - 1))
    v = np.where(tokens < 16, tokens, leading << widths) + read_bits(source.rest(), widths)
    return (v >> 1) ^ -(v & 1) if signed else v


def read_tokens(source: Cursor, contexts: Sequence[int]) -> list[int]:
    """Read one token for each context from an interleaved rANS stream."""
    count = len(contexts)
    if count == 0:
        return []
    head, alphabet = source.unpack("BB")
    lanes, classes, static = 1 << (head & 15), (head >> 4 & 7) + 1, head >> 7
    require(alphabet <= 126, "tokens: alphabet too large")
    if alphabet == 0:
        only = source.take(max(contexts) + 1)
        require(head == 0 and max(only) < 126, "tokens: bad constant stream")
        return [only[context] for context in contexts]
    require(lanes <= 8192 and (lanes == 8192 or count <= 65536 * lanes), "tokens: too many for the lanes")
    thresholds = list(source.take(classes - 1))
    require(
        all(a < b for a, b in zip([0, *thresholds], [*thresholds, alphabet], strict=True)), "tokens: bad thresholds"
    )
    class_after = [bisect_right(thresholds, token) for token in range(alphabet)]
    models = (max(contexts) + 1) * classes
    require(models <= 1024, "tokens: too many models")
    if static:
        sums = cumulative_frequencies(read_weights(source, models, alphabet))

    per_lane = -(-count // lanes)
    per_lane += per_lane % 2 == 0
    used_lanes = -(-count // per_lane)
    states = list(source.unpack(f"{used_lanes}I"))
    words, taken = np.frombuffer(source.data[source.at :][: (len(source.data) - source.at) // 2 * 2], "<u2").tolist(), 0
    tokens, lane_class = [0] * count, [0] * used_lanes
    seen, change = [[0] * alphabet for _ in range(models)], 0
    for step in range(per_lane):
        if step == change and not static:
            sums, change = cumulative_frequencies(adaptive_weights(np.array(seen))), change + 1 + change // 8
        for lane in range(-(-(count - step) // per_lane)):
            index, x = lane * per_lane + step, states[lane]
            model = classes * contexts[index] + lane_class[lane]
            low = x % 4096
            token = bisect_right(sums[model], low) - 1
            x = (sums[model][token + 1] - sums[model][token]) * (x // 4096) + low - sums[model][token]
            if x < 65536:
                require(taken < len(words), "tokens: words run out")
                x, taken = 65536 * x + words[taken], taken + 1
            states[lane], tokens[index], lane_class[lane] = x, token, class_after[token]
            seen[model][token] += 1
    require(all(x == 65536 for x in states), "tokens: wrong last state")
    source.take(2 * taken)
    return tokens


def cumulative_frequencies(weights: np.ndarray) -> list[list[int]]:
    """Return 0, f_0, f_0 + f_1, ..., 4096 for each row of weights."""
    require(bool(weights.any(axis=1).all()), "tokens: a model without weights")
    f = np.where(weights > 0, np.maximum(1, 4096 * weights // weights.sum(axis=1, keepdims=True)), 0)
    f[np.arange(len(f)), weights.argmax(axis=1)] += 4096 - f.sum(axis=1)
    return np.pad(f.cumsum(axis=1), ((0, 0), (1, 0))).tolist()


def adaptive_weights(seen: np.ndarray) -> np.ndarray:
    a = 1 + 2 * seen.sum(axis=0)
    return 65536 * seen + 1048576 * a // a.sum() + 1


def read_weights(source: Cursor, models: int, alphabet: int) -> np.ndarray:
    """Read the weights of static models."""
    require(source.data[source.at : source.at + 1] < b"\x80", "tokens: levels with static models")
    folded = np.array(read_tokens(source, [0] * (models * alphabet)), np.int64).reshape(models, alphabet)
    levels = (folded >> 1) ^ -(folded & 1)
    levels[0] = levels[0].cumsum()
    levels = levels.cumsum(axis=0)
    require(0 <= levels.min() and levels.max() <= 49, "tokens: level out of range")
    return np.where(levels > 0, (4 + (levels - 1) % 4) << np.maximum(levels - 1, 0) // 4, 0)


def decode_step_sizes(codes: Sequence[int]) -> np.ndarray:
    """Return step sizes in units of 2^-24 from their codes (3.2)."""
    return np.array([(8 + e % 8) << e // 8 for e in codes], np.int64)


# 3.3 Codec 6


@dataclass(frozen=True)
class Points:
    m: np.ndarray  # int64 (N, 3), centres of cells in units of 2^-19 of the contracted cube
    classes: np.ndarray  # int64 (N,)


def read_points(source: Cursor, count: int) -> Points:
    g, class_count, gap_bytes, class_bytes = source.unpack("BBII")
    require(1 <= g <= 18 and 1 <= class_count <= 16, "codec 6: bad header")
    bits_of_class = np.array(list(source.take(class_count)))
    require(bool((g <= bits_of_class).all() and (bits_of_class <= 18).all()), "codec 6: bits out of range")
    gaps = read_integers(source.take(gap_bytes), np.zeros(count, np.int64))
    require(sum(gaps.tolist()) < 2 ** (3 * g), "codec 6: a point outside the cube")
    classes = read_integers(source.take(class_bytes), (gaps == 0).astype(np.int64))
    require(bool((classes < class_count).all()), "codec 6: class out of range")
    bits = bits_of_class[classes][:, None]
    lower = read_bits(source.rest(), 3 * (bits[:, 0] - g))
    q = (from_morton(np.cumsum(gaps), g) << (bits - g)) + from_morton(lower, 18 - g)
    return Points((2 * q + 1) << (18 - bits), classes)


def from_morton(codes: np.ndarray, bits: int) -> np.ndarray:
    axes = [sum((codes >> (3 * i + axis) & 1) << i for i in range(bits)) + 0 * codes for axis in range(3)]
    return np.stack(axes, axis=1)


def decode_positions(points: Points, half_extent: Sequence[float]) -> np.ndarray:
    y = (points.m - 2**18) / 2**17
    radius = np.maximum(np.sqrt((y * y).sum(axis=1, keepdims=True)), 1)
    return y / (radius * (2 - np.minimum(radius, 2 - 2**-20))) * np.array(half_extent, np.float64)


# 3.4 Codec 7


def read_channels(source: Cursor, columns: int, classes: np.ndarray) -> np.ndarray:
    if columns == 1:
        return read_channel(source, classes)
    basis = np.array(source.unpack("9f")).reshape(3, 3)
    require(bool((np.abs(basis) <= 1 + 2**-10).all()), "codec 7: basis out of range")
    n = [read_channel(source, classes) for _ in range(3)]
    return np.stack([(n[0] * row[0] + n[1] * row[1]) + n[2] * row[2] for row in basis], axis=1)


def read_channel(source: Cursor, classes: np.ndarray) -> np.ndarray:
    mean, weight, difference_bytes, class_count = source.unpack("fBIB")
    require(abs(mean) <= 4096 and weight <= 16, "codec 7: bad channel")
    require(class_count > classes.max(initial=0), "codec 7: classes without a step size")
    d = decode_step_sizes(source.take(class_count))[classes]
    s = read_integers(source.take(difference_bytes), classes, signed=True)
    require(bool((np.abs(s) <= np.minimum(2**39 // d, 2**30)).all()), "codec 7: difference out of range")
    v, count = d * s, len(s)
    for distance in (1 << k for k in reversed(range(count.bit_length()))):
        i = np.arange(distance, count, 2 * distance)
        right = np.where(i + distance < count, i + distance, i - distance)
        v[i] += weight * (v[i - distance] + v[right]) // 32
        require(bool((np.abs(v) < 2**45).all()), "codec 7: value out of range")
    return v / 2**24 + mean


# 3.5 Codec 8


def read_numbers(source: Cursor, groups: tuple[np.ndarray, int]) -> np.ndarray:
    """Read numbers; `groups` has the group of each number and the number of groups."""
    group, group_count = groups
    step_bytes, model_bytes = source.unpack("II")
    codes = read_integers(source.take(step_bytes), np.zeros(group_count, np.int64))
    require(bool((codes <= 255).all()), "codec 8: step size out of range")
    models = np.zeros(group_count, np.int64)
    models[codes > 0] = read_integers(source.take(model_bytes), np.zeros(int((codes > 0).sum()), np.int64))
    require(bool((models < 8).all()), "codec 8: model out of range")
    stored = codes[group] > 0
    s = read_integers(source.rest(), models[group[stored]], signed=True)
    require(bool((np.abs(s) <= 2**24).all()), "codec 8: symbol out of range")
    numbers = np.zeros(len(group))
    numbers[stored] = s * decode_step_sizes(codes.tolist())[group[stored]] / 2**24
    return numbers


def decoder_groups(layers: list[tuple[int, int]]) -> tuple[np.ndarray, int]:
    sizes = [size for inputs, outputs in layers for size in [inputs] * outputs + [outputs]]
    return np.repeat(np.arange(len(sizes)), sizes), len(sizes)


def stated_groups(source: Cursor, grid: dict[str, int]) -> tuple[np.ndarray, int]:
    """Read the groups of a table's numbers (3.6)."""
    rows = [rows for _, rows in list_grid_levels(grid)]
    levels = np.repeat(np.arange(len(rows)), rows)
    uses = read_integers(source.take(source.unpack("I")[0]), levels)
    require(bool((uses < 16).all()), "codec 11: usage class out of range")
    return np.repeat(16 * levels + uses, 2), 16 * len(rows)


def table_groups(grid: dict[str, int], m: np.ndarray) -> np.ndarray:
    """Return the group of each row of a hash table, which is 16 level + u (3.5)."""
    groups, m = [], m[:: max(1, -(-len(m) // 65536))]
    for level, (r, rows) in enumerate(list_grid_levels(grid)):
        cells, use = m * (r - 1) // 2**19, np.zeros(rows, np.int64)
        for corner in np.ndindex(2, 2, 2):
            x, y, z = (cells + corner).T
            if r**3 <= rows:
                row = x + r * (y + r * z)
            else:
                row = (x ^ (2654435761 * y & 0xFFFFFFFF) ^ (805459861 * z & 0xFFFFFFFF)) % rows
            use += np.bincount(row, minlength=rows)
        groups += [16 * level + (count.bit_length() + 1) // 2 for count in use.tolist()]
    return np.array(groups)


# 3.7 Codec 13


def read_residuals(source: Cursor, columns: int, classes: np.ndarray, is_color: bool) -> np.ndarray:
    class_count, flag_bytes = source.unpack("BI")
    require(classes.max(initial=0) < class_count <= 16, "codec 13: classes without a step size")
    flags = read_integers(source.take(flag_bytes), classes)
    require(bool((flags <= 1).all()), "codec 13: flag out of range")
    basis = np.array(source.unpack("9f")).reshape(3, 3) if is_color else np.eye(3)
    require(bool((np.abs(basis) <= 1 + 2**-10).all()), "codec 13: basis out of range")
    rows, bands = np.flatnonzero(flags), []
    for width in range(3, columns + 1, 6) if is_color else (2, 3):
        if sum(band.shape[1] for band in bands) == columns:
            break
        d = decode_step_sizes(source.take(class_count))[classes[rows]]
        components = np.arange(width) % (3 if is_color else width)
        contexts = (classes[rows][:, None] + class_count * components).ravel()
        s = read_integers(source.take(source.unpack("I")[0]), contexts, signed=True)
        require(bool((np.abs(s) <= 2**24).all()), "codec 13: symbol out of range")
        bands.append(s.reshape(len(rows), width) * d[:, None] / 2**24)
    n = np.concatenate(bands, axis=1)
    if is_color:
        n = n.reshape(len(rows), columns // 3, 3)
        n = np.stack([(n[..., 0] * row[0] + n[..., 1] * row[1]) + n[..., 2] * row[2] for row in basis], axis=2)
    numbers = np.zeros((len(classes), columns))
    numbers[rows] = n.reshape(len(rows), columns)
    return numbers


# 2.13 Residuals


def correct_shape(outputs: Sequence[float], residuals: Sequence[float]) -> list[float]:
    """Return the corrected outputs of the geometry field: opacity, scales, and the rotation without its offset of 1."""
    a, b, x, y, z = residuals
    opacity, s0, s1, s2, w, i, j, k = outputs
    w += 1
    turned = (
        w - i * x - j * y - k * z,
        w * x + i + j * z - k * y,
        w * y + j + k * x - i * z,
        w * z + k + i * y - j * x,
    )
    return [opacity, s0 + a, s1 + b, s2 - a - b, turned[0] - 1, *turned[1:]]


def correct_color(color: Sequence[float], residuals: np.ndarray, direction: Sequence[float]) -> list[float]:
    """Return a colour with its residuals (3 K) along a unit direction."""
    x, y, z = direction
    harmonics = [
        0.28209479177387814,
        *(-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x),
        *(1.0925484305920792 * x * y, -1.0925484305920792 * y * z, 0.31539156525252005 * (3 * z * z - 1)),
        *(-1.0925484305920792 * x * z, 0.5462742152960396 * (x * x - y * y)),
        *(-0.5900435899266435 * y * (3 * x * x - y * y), 2.890611442640554 * x * y * z),
        *(-0.4570457994644658 * y * (5 * z * z - 1), 0.3731763325901154 * z * (5 * z * z - 3)),
        *(-0.4570457994644658 * x * (5 * z * z - 1), 1.445305721320277 * z * (x * x - y * y)),
        -0.5900435899266435 * x * (x * x - 3 * y * y),
    ]
    h = np.reshape(residuals, (-1, 3))
    return [max(0.0, value + float(np.dot(harmonics[: len(h)], h[:, c]))) for c, value in enumerate(color)]


# 2.7 Local units


def local_pose(frame: dict[str, Any], camera_from_world: np.ndarray) -> np.ndarray:
    """Return the pose (4, 4) of a camera from local units, given that from the world."""
    quaternion = np.array(frame.get("rotation", (1, 0, 0, 0)), np.float64)
    w, x, y, z = quaternion / math.hypot(*quaternion)
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    pose = np.eye(4)
    pose[:3, :3] = camera_from_world[:3, :3] @ rotation
    pose[:3, 3] = (camera_from_world[:3, :3] @ frame["center"] + camera_from_world[:3, 3]) / frame["scale"]
    return pose


# 2.9 Exposure map


@dataclass(frozen=True)
class Center:
    position: list[float]
    direction: list[float]
    weight: list[float]


@dataclass(frozen=True)
class Exposure:
    position_length: float
    direction_length: float
    box_min: list[float]
    box_max: list[float]
    mean: list[float]
    min_log_gains: list[float]
    max_log_gains: list[float]
    centers: list[Center]


def read_exposure(section: Section) -> Exposure:
    require(section.codec == 9, "EXPO: unknown codec")
    require(section.raw_length == section.stored_length, "EXPO: wrong raw length")
    source = Cursor(section.read())
    count, *reserved = source.unpack("BBBB")
    require(count <= 64 and not any(reserved), "EXPO: too many centers or reserved bytes")
    position_length, direction_length, *rest = source.unpack("20f")
    require(all(map(math.isfinite, (position_length, direction_length, *rest))), "EXPO: NaN or infinite")
    box_min, box_max, mean, min_log_gains, max_log_gains, steps = (rest[at : at + 3] for at in range(0, 18, 3))
    require(position_length > 0 and direction_length > 0, "EXPO: lengths must be positive")
    require(all(low <= high for low, high in zip(box_min, box_max, strict=True)), "EXPO: the box is not in order")
    limits_in_order = all(-8 <= low <= high <= 8 for low, high in zip(min_log_gains, max_log_gains, strict=True))
    require(limits_in_order, "EXPO: limits out of range")
    centers = []
    for _ in range(count):
        x, f, w = source.unpack("3B"), source.unpack("3b"), source.unpack("3h")
        position = [low + code / 255 * (high - low) for code, low, high in zip(x, box_min, box_max, strict=True)]
        weight = [code * step for code, step in zip(w, steps, strict=True)]
        centers.append(Center(position, [code / 127 for code in f], weight))
    source.end()
    return Exposure(position_length, direction_length, box_min, box_max, mean, min_log_gains, max_log_gains, centers)


def log_gains(exposure: Exposure, position: Sequence[float], direction: Sequence[float]) -> list[float]:
    """Return the log gains (red, green, blue) at a position in local units with a unit viewing direction."""
    box = zip(position, exposure.box_min, exposure.box_max, strict=True)
    inside = [min(max(value, low), high) for value, low, high in box]
    gains = list(exposure.mean)
    for center in exposure.centers:
        distance = sum(((a - b) / exposure.position_length) ** 2 for a, b in zip(inside, center.position, strict=True))
        distance += sum(
            ((a - b) / exposure.direction_length) ** 2 for a, b in zip(direction, center.direction, strict=True)
        )
        gains = [gain + weight / (1 + distance) for gain, weight in zip(gains, center.weight, strict=True)]
    limits = zip(gains, exposure.min_log_gains, exposure.max_log_gains, strict=True)
    return [min(max(gain, low), high) for gain, low, high in limits]


def expose(rgb: np.ndarray, gains: np.ndarray) -> np.ndarray:
    """Return a picture (..., 3) in [0, 1] at the exposure of the gains (3,)."""
    return gains * rgb / (1 + (gains - 1) * rgb)

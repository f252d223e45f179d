"""Make hostile `.hyrf` files from small valid ones, by random damage and by forged fields.

`make_hostile_file(number, seed)` is a pure function, so the two numbers reproduce an input. About half of the inputs
are damaged without repair, and a checksum stops most of them. In the others all checksums and lengths are repaired, so
that the forged values reach their decoder.
"""

from __future__ import annotations

import contextlib
import copy
import json
import math
import struct
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from random import Random

import numpy as np
import torch

from hyrfpack.format import decode_model, encode_model
from hyrfpack.format.arrays import group_shapes, parse_config, to_arrays
from hyrfpack.format.codec import PROFILES
from hyrfpack.format.container import read_container
from hyrfpack.format.exposure import encode_exposure
from hyrfpack.model import ExposureMap, Frame, HashGridConfig, HybridModel, ModelConfig
from hyrfpack.model.gaussians import Gaussians
from hyrfpack.quant import HuffmanCode, MinMaxQuantizer, ResidualVectorQuantizer, huffman_encode
from hyrfpack.rotations import IDENTITY, Quaternion
from tools.safety.make_golden import add_golden_residuals
from tools.safety.synthetic_encoding import encode

GOLDEN_FOLDER = Path(__file__).parents[2] / "tests" / "golden"
MERGED_FILE = GOLDEN_FOLDER / "merged" / "v1.4_merged.hyrf"
MERGED_SHARE = 0.1  # of the files that are damaged
SECTION_GROUPS = ("POSI", "COLO", "SCAL", "OPAC", "GTAB", "GMLP", "RTAB", "RMLP", "SHAP", "HARM")
EXTREME_INTEGERS = (0, 1, 2, 3, 7, 8, 16, 57, 58, 127, 128, 255, 256, 257, 1023, 1024, 1025, 65535, 65536, 65537)
EXTREME_INTEGERS += tuple(2**power + step for power in (20, 28, 31, 32, 34, 40, 48, 60, 63, 64) for step in (-1, 0, 1))
HOSTILE_TEXT = ("", "\n", "\x1b[2J", "\ud800", "\0", "a" * 3000, "__class__", "../../x", "\u202e", "NaN", "sum", "sh")
HOSTILE_JSON = (None, True, False, 0, 1, -1, 0.5, -0.0, 5e-324, 1e-300, 1e308, -1e308, 10**18, 2**63, 10**400, [], {})
HOSTILE_JSON += (*HOSTILE_TEXT, [0, 0, 0], [1e308] * 3, [[[]]], {"a": 1})
# Bits of float32 values: signed zeros, denormals, the bounds of log gains and values beyond, the largest values,
# infinities and NaNs.
HOSTILE_FLOAT_BITS = (0, 1 << 31, 1, 0x007FFFFF, 0x40FFFFFF, 0x41000000, 0x41000001, 0xC1000000, 0xC1000001)
HOSTILE_FLOAT_BITS += (0x3F800000, 0x7F7FFFFF, 0xFF7FFFFF, 0x7F800000, 0xFF800000, 0x7FC00000, 0x7F800001)
CONFIG_RANGES = {"log2_table_size": (3, 25), "levels": (0, 33), "base": (1, 70), "finest": (1, 70), "hidden": (0, 70)}
CONFIG_RANGES |= {"residual_degree": (-1, 4)}


@dataclass
class RawSection:
    """A section to be written: its entry in the table of contents, and its bytes.

    Attributes:
        tag: the four bytes of the section's type.
        codec, flags, raw_length: fields of the entry.
        data: the stored bytes.
    """

    tag: bytes
    codec: int
    flags: int
    data: bytes
    raw_length: int


# --- The container of a file, with any content ---


def assemble(parts: list[RawSection]) -> bytes:
    """Return a file of these sections with correct offsets, lengths and checksums, for any content of the sections."""
    minor = 2 if any(part.codec == 9 for part in parts) else int(any(5 <= part.codec <= 8 for part in parts))
    minor = 3 if any(_has_rotation(part) for part in parts if part.tag == b"META") else minor
    minor = 4 if any(part.tag == b"PRTS" for part in parts) else minor
    minor = 6 if any(part.tag == b"SHAP" for part in parts) else minor
    offset = 48 + 40 * len(parts)
    toc, payloads = [], []
    for part in parts:
        stored, crc = len(part.data), zlib.crc32(part.data)
        fields = (part.tag, part.codec & 0xFFFF, part.flags & 0xFFFF, offset, stored, part.raw_length % 2**64, crc, 0)
        toc.append(struct.pack("<4sHHQQQII", *fields))
        payloads.append(part.data + bytes(-stored % 8))
        offset += stored + -stored % 8
    table = b"".join(toc)
    header = struct.pack(
        "<8sHHIQQIII", b"\x89HYRF\r\n\n", 1, minor, 0, offset, 48, len(table), len(parts), zlib.crc32(table)
    )
    return b"".join((header, struct.pack("<I", zlib.crc32(header)), table, *payloads))


def _has_rotation(part: RawSection) -> bool:
    """Return whether metadata has the key `rotation` of the frame; the one of the rules has no list."""
    text = part.data
    if part.codec == 5:
        with contextlib.suppress(zlib.error):
            text = zlib.decompressobj().decompress(text, 1 << 20)
    return b'"rotation":[' in text


def disassemble(data: bytes) -> list[RawSection]:
    """Return the sections of a valid file."""
    container = read_container(data)
    return [
        RawSection(section.type.encode(), section.codec, int(section.required), bytes(section.data), section.raw_length)
        for section in container.sections
    ]


def repair_checksums(data: bytearray) -> bytes:
    """Return the file with correct checksums of its header and its table of contents."""
    (length,) = struct.unpack_from("<I", data, 32)
    struct.pack_into("<I", data, 40, zlib.crc32(data[48 : 48 + length]))
    struct.pack_into("<I", data, 44, zlib.crc32(data[:44]))
    return bytes(data)


# --- Valid files as seeds ---


def _make_model(
    count: int,
    hidden: int = 3,
    background: bool = True,
    rotation: Quaternion = IDENTITY,
    residual_degree: int | None = None,
    **config: object,
) -> HybridModel:
    rng = np.random.default_rng(count)
    shape = ModelConfig(
        frame=Frame(center=(1.5, -0.1, 3.0), scale=12.5, half_extent=(1.0, 0.75, 0.25), rotation=rotation),
        geometry=HashGridConfig(log2_table_size=4, levels=2, base=2, finest=5),
        radiance=HashGridConfig(log2_table_size=5, levels=2, base=3, finest=7),
        hidden=hidden,
        background=background,
        **config,
    )
    values = torch.from_numpy(rng.normal(size=(count, 8)).astype(np.float32))
    model = HybridModel(shape, Gaussians(values[:, :3], values[:, 3:6], values[:, 6:7], values[:, 7:]))
    with torch.no_grad():
        for parameter in (*model.geometry.parameters(), *model.radiance.parameters()):
            parameter.copy_(torch.from_numpy(rng.laplace(scale=0.1, size=parameter.shape)))
    return model if residual_degree is None else add_golden_residuals(model, residual_degree)


def _encode_in_codec(values: np.ndarray, codec: int, rng: Random) -> bytes:
    """Encode a matrix in one of the codecs that need no other section (1 to 4)."""
    if codec in (1, 2):
        return values.astype(f"<f{4 // codec}").tobytes()
    if codec == 3:
        stages, size = rng.choice(((1, 1), (1, 4), (2, 8), (5, 3), (1, 300), (16, 2)))
        indices, codebooks = ResidualVectorQuantizer(stages, size, "float16", iterations=1).encode(values)
        head = struct.pack("<BBH", stages, values.shape[1], size) + codebooks.astype("<f2").tobytes()
        streams = [huffman_encode(np.ascontiguousarray(stage)).to_bytes() for stage in indices.T]
        return head + b"".join(struct.pack("<Q", len(stream)) + stream for stream in streams)
    codes, params = MinMaxQuantizer(rng.choice((1, 3, 8, 8, 11, 16))).encode(values)
    # This code is far deeper than the symbols need, because the decoder reads long codes in another way.
    symbols = np.unique(codes)
    deep = None
    if 2 <= len(symbols) <= 57 and rng.random() < 0.5:
        depths = np.minimum(np.arange(1, len(symbols) + 2), len(symbols)).astype(np.uint8)
        deep = HuffmanCode(np.append(symbols.astype(np.int32), -1), depths)
    return params.to_bytes() + huffman_encode(codes.ravel(), deep).to_bytes()


@lru_cache
def load_seed_files() -> tuple[tuple[bytes, ...], tuple[float, ...]]:
    """Return valid files and their weights; small files, which decode faster, have larger weights.

    The files are: each profile with 0, 1, 20 and 200 Gaussians, with and without background; the golden files;
    Gaussians in layers; groups in codecs that no profile uses for them; rotated models with exposure maps of up to
    64 centers in each profile; and models with residuals.
    """
    rng = Random(0)
    models = [
        _make_model(0),
        _make_model(1, background=False),
        _make_model(20, direction_encoding="sh"),
        _make_model(200, hidden=2),
    ]
    files = [(encode(model, profile), 1 if len(model) == 200 else 10) for profile in PROFILES for model in models]
    files += [(file.read_bytes(), 10) for file in sorted(GOLDEN_FOLDER.glob("*.hyrf"))]
    files.append((encode_model(models[2], "paper", color=(3, 8), scale=(2, 4), opacity=(1, 16)), 10))
    files.append((encode(models[3], "compact", distortion=1e-9, prune=False), 2))
    files.append((encode(_make_equal_gaussians(models[3]), "compact", prune=False), 10))
    files += [(encode(model, "compact", prune=False, layered=True), 10) for model in (models[2], _make_model(40))]
    with_residuals = [_make_model(30 + degree, residual_degree=degree) for degree in range(4)]
    files += [(encode(model, "compact", prune=False, layered=True), 3) for model in with_residuals]
    mixed = [models[1], _make_model(5), _make_model(6), models[2], models[3], _make_model(2500), with_residuals[1]]
    for model in mixed:
        weight = {200: 0.5, 2500: 0.1}.get(len(model), 10)
        for profile, exchanged in (("raw", 1.0), ("compact", 0.4)):
            data = encode(model, profile)
            arrays, parts = to_arrays(decode_model(data)), disassemble(data)
            for part in parts[1:]:
                # In profile compact other sections need the lattice of codec 6, so the positions keep it.
                if rng.random() < exchanged and (profile == "raw" or part.tag != b"POSI"):
                    part.codec = rng.choice((2, 3, 3, 4, 4))
                    part.data = _encode_in_codec(arrays[part.tag.decode()], part.codec, rng)
            files.append((assemble(parts), weight))
    for profile, centers in zip(PROFILES, (0, 3, 64), strict=True):
        exposed = _make_model(20, background=False, rotation=(0.8, 0.0, -0.6, 0.0))
        exposed.exposure = _make_exposure_map(centers)
        files.append((encode(exposed, profile), 10))
    return tuple(zip(*files, strict=True))


def _make_exposure_map(centers: int) -> ExposureMap:
    rng = np.random.default_rng(centers)
    return ExposureMap(
        box=np.sort(rng.normal(size=(2, 3)), 0).astype(np.float32),
        lengths=rng.uniform(0.1, 3, 2).astype(np.float32),
        mean=rng.normal(size=3).astype(np.float32),
        limits=np.sort(rng.uniform(-8, 8, (2, 3)), 0).astype(np.float32),
        steps=rng.uniform(1e-5, 1e-4, 3).astype(np.float32),
        positions=rng.integers(0, 256, (centers, 3)).astype(np.uint8),
        directions=rng.integers(-128, 128, (centers, 3)).astype(np.int8),
        weights=rng.integers(-32768, 32768, (centers, 3)).astype(np.int16),
    )


def _make_equal_gaussians(model: HybridModel) -> HybridModel:
    """Make all Gaussians equal, so that their streams have one symbol and take no bytes for any number of them."""
    with torch.no_grad():
        for parameter in model.gaussians.parameters():
            parameter.copy_(parameter[:1].expand_as(parameter))
    return model


@lru_cache
def load_merged_seed_files() -> tuple[bytes, ...]:
    """Return valid merged files: the golden one, one of a single part, and one of equal parts without Gaussians."""
    files, _ = load_seed_files()
    single = assemble(join_parts(["only"], [files[1]]))
    return (MERGED_FILE.read_bytes(), single, assemble(join_parts([f"part {k}" for k in range(9)], [files[0]] * 9)))


def join_parts(names: Sequence[object], files: Sequence[bytes]) -> list[RawSection]:
    """Return the sections of a merged file of these files and names, valid or not."""
    text = json.dumps({"names": list(names)}).encode()
    parts = [RawSection(b"PT%02d" % number, 10, 1, data, len(data)) for number, data in enumerate(files)]
    return [RawSection(b"PRTS", 0, 1, text, len(text)), *parts]


def _choose_seed_file(rng: Random) -> bytes:
    """Choose a file of one model."""
    return rng.choices(*load_seed_files())[0]


def _choose_any_file(rng: Random) -> bytes:
    """Choose a file of one model or a merged file."""
    return rng.choice(load_merged_seed_files()) if rng.random() < MERGED_SHARE else _choose_seed_file(rng)


@lru_cache
def _disassemble_cached(data: bytes) -> tuple[RawSection, ...]:
    return tuple(disassemble(data))


# --- Damage without repaired checksums ---


def edit_bytes(data: bytes, rng: Random, max_edits: int = 4) -> bytes:
    """Return the bytes after 1 to `max_edits` random edits: changes, deletions, insertions and copies."""
    edited = bytearray(data)
    for _ in range(rng.randint(1, max_edits)):
        at = rng.randrange(len(edited) + 1)
        kind = rng.randrange(7)
        if kind == 0 and at < len(edited):
            edited[at] ^= 1 << rng.randrange(8)
        elif kind == 1 and at < len(edited):
            edited[at] = rng.choice((0, 1, 0x7F, 0x80, 0xFE, 0xFF, rng.randrange(256)))
        elif kind == 2:
            width = rng.choice((1, 2, 4, 8))
            edited[at : at + width] = (rng.choice(EXTREME_INTEGERS) % 256**width).to_bytes(width, "little")
        elif kind == 3:
            del edited[at : at + rng.randint(1, 16)]
        elif kind == 4:
            edited[at:at] = rng.randbytes(rng.randint(1, 16))
        elif kind == 5:
            edited[at : at + 8] = bytes([rng.choice((0, 255))]) * 8
        else:
            other = rng.randrange(len(edited) + 1)
            edited[at:at] = edited[other : other + rng.randint(1, 64)]
    return bytes(edited)


def _flip_bits(rng: Random) -> bytes:
    data = bytearray(_choose_any_file(rng))
    for _ in range(rng.choice((1, 1, 2, 8))):
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    return bytes(data)


def _damage_bytes(rng: Random) -> bytes:
    return edit_bytes(_choose_any_file(rng), rng)


def _truncate(rng: Random) -> bytes:
    data = _choose_any_file(rng)
    return data[: rng.choice((rng.randrange(len(data)), rng.randrange(500), len(data) - rng.randint(1, 9)))]


def _extend(rng: Random) -> bytes:
    return _choose_any_file(rng) + rng.choice((bytes, rng.randbytes))(rng.randint(1, 100))


def _splice(rng: Random) -> bytes:
    first, second = _choose_any_file(rng), _choose_any_file(rng)
    return first[: rng.randrange(len(first))] + second[rng.randrange(len(second)) :]


# --- Forged values with repaired checksums ---


def _forge_header(rng: Random) -> bytes:
    """Set numbers of the header and of the table of contents to extreme values."""
    data = bytearray(_choose_any_file(rng))
    (count,) = struct.unpack_from("<I", data, 36)
    for _ in range(rng.randint(1, 2)):
        entry = 48 + 40 * rng.randrange(count)
        list_json_values = (8, 2), (10, 2), (12, 4), (16, 8), (24, 8), (32, 4), (36, 4)
        columns = (0, 4), (4, 2), (6, 2), (8, 8), (16, 8), (24, 8), (32, 4), (36, 4)
        at, width = rng.choice(list_json_values) if rng.random() < 0.4 else rng.choice(columns)
        at += entry if (at, width) in columns and (at, width) not in list_json_values else 0
        old = int.from_bytes(data[at : at + width], "little")
        new = rng.choice(
            (rng.choice(EXTREME_INTEGERS), old + rng.choice((-8, -1, 1, 8)), len(data), rng.getrandbits(64))
        )
        data[at : at + width] = (new % 256**width).to_bytes(width, "little")
    return repair_checksums(data)


def _forge_sections(rng: Random) -> bytes:
    """Drop, duplicate, move, swap and rename sections, and forge their data, codecs, lengths and flags."""
    parts = [replace(part) for part in _choose_sections(rng)]
    for _ in range(rng.randint(1, 2)):
        one, other = rng.randrange(len(parts)), rng.randrange(len(parts))
        kind = rng.randrange(9)
        if kind == 0 and len(parts) > 1:
            del parts[one]
        elif kind == 1:
            parts.insert(other, replace(parts[one]))
        elif kind == 2:
            parts[one], parts[other] = parts[other], parts[one]
        elif kind == 3:
            parts[one].data, parts[other].data = parts[other].data, parts[one].data
        elif kind == 4:
            borrowed = rng.choice(_choose_sections(rng))
            parts[one].data, parts[one].codec = borrowed.data, borrowed.codec
        elif kind == 5:
            parts[one].codec = rng.choice((*range(14), 65535))
        elif kind == 6:
            parts[one].raw_length = rng.choice((*EXTREME_INTEGERS, parts[one].raw_length + 4))
        elif kind == 7:
            parts[one].flags = rng.choice((0, 1, 2, 65535))
        else:
            parts[one].tag = rng.choice(
                (b"NEW_", b"posi", b"\0\0\0\0", b"\xff\n\x1b ", b"META", b"POSI", b"POS1", b"COL3", b"EXPO", b"HAR1")
            )
    return assemble(parts)


def _forge_payload(rng: Random) -> bytes:
    """Edit random bytes of a section."""
    parts = [replace(part) for part in _choose_sections(rng)]
    part = rng.choice(parts)
    part.data = edit_bytes(part.data, rng)
    if (part.tag == b"META" and part.codec == 0) or part.codec == 9:
        part.raw_length = len(part.data)
    return assemble(parts)


def _forge_metadata(rng: Random) -> bytes:
    """Forge the metadata's values, keys, nesting or text, often with raw lengths that match the forged metadata."""
    parts = [replace(part) for part in _choose_sections(rng)]
    values = json.loads(zlib.decompress(parts[0].data) if parts[0].codec == 5 else parts[0].data)
    for _ in range(rng.choice((1, 1, 2))):
        kind = rng.randrange(9)
        all_values = list_json_values(values)
        sizes = [(node, key) for node, key in all_values if key in CONFIG_RANGES]
        if kind < 3 and sizes:
            node, key = rng.choice(sizes)
            node[key] = rng.choice((rng.randint(*CONFIG_RANGES[key]), rng.choice(EXTREME_INTEGERS)))
        elif kind == 3:
            values["gaussians"] = rng.choice((rng.randrange(3000), rng.choice(EXTREME_INTEGERS), 8_000_000))
            if rng.random() < 0.3:
                first = rng.randint(0, min(values["gaussians"], 50))
                values["layers"] = rng.choice(([first, values["gaussians"] - first], [values["gaussians"]], [0] * 9))
        elif kind == 8 and isinstance(values.get("config"), dict) and isinstance(values["config"].get("frame"), dict):
            quat = [rng.gauss(0, 1) for _ in range(4)]
            length = math.hypot(*quat) * (1 + rng.choice((0, 0, 9e-7, 1.1e-6, -1.1e-6, 1)))
            values["config"]["frame"]["rotation"] = [number / length for number in quat]
        else:
            node, key = rng.choice(all_values)
            if kind == 4 and isinstance(node, dict):
                del node[key]
            elif kind == 5 and isinstance(node, dict):
                node[rng.choice(HOSTILE_TEXT)] = copy.deepcopy(rng.choice(HOSTILE_JSON))
            else:
                node[key] = copy.deepcopy(rng.choice(HOSTILE_JSON))
    text = json.dumps(values).encode()
    if rng.random() < 0.1:
        deep = rng.choice((60, 70, 300, 950, 100_000))
        text = text[:-1] + b',"provenance":{"a":' + b"[" * deep + b"]" * deep + b"}}"
    elif rng.random() < 0.1:
        text = edit_bytes(text, rng)
    parts[0].data, parts[0].raw_length = text, len(text)
    if rng.random() < 0.3:
        _deflate(parts[0], rng)
    else:
        parts[0].codec = 0
    if rng.random() < 0.6:
        try:
            shapes = group_shapes(parse_config(values["config"]), int(values["gaussians"]))
            for part in parts[1:]:
                if part.tag != b"EXPO":
                    rows, columns = shapes[part.tag.decode()]
                    part.raw_length = 4 * rows * columns
        except Exception:  # forged metadata may have no valid shapes
            pass
    return assemble(parts)


def _deflate(part: RawSection, rng: Random) -> None:
    """Compress the metadata with codec 5, in some cases with damage or a huge decompressed size."""
    part.codec, text = 5, part.data
    kind = rng.randrange(12)
    part.data = zlib.compress(text + b" " * (50_000_000 if kind == 0 and rng.random() < 0.1 else 0), rng.choice((0, 9)))
    if kind == 1:
        part.raw_length += rng.choice((-1, 1, 1 << 19, 1 << 20, 1 << 28))
    elif kind == 2:
        part.data = part.data[: -rng.randint(1, 8)]
    elif kind == 3:
        part.data += rng.randbytes(rng.randint(1, 8))
    elif kind == 4:
        part.data = edit_bytes(part.data, rng)


def list_json_values(node: dict | list) -> list[tuple[dict | list, str | int]]:
    """Return every value inside nested JSON as (its container, its key)."""
    keys = list(node) if isinstance(node, dict) else range(len(node))
    found = [(node, key) for key in keys]
    for key in keys:
        if isinstance(node[key], (dict, list)):
            found += list_json_values(node[key])
    return found


def _forge_fields(rng: Random) -> bytes:
    """Forge one or two fields of a section's codec, mostly with repaired lengths around them."""
    parts = [replace(part) for part in _choose_sections(rng)]
    coded = [part for part in parts[1:] if part.codec in (3, 4, 6, 7, 8, 13)] or parts[1:]
    part = rng.choice(coded)
    fields = _split_fields(part)
    for _ in range(rng.choice((1, 1, 2))):
        name = rng.choice(list(fields))
        value = fields[name]
        if isinstance(value, tuple):
            number, width = value
            new = rng.choice((number + rng.choice((-1, 1)), rng.choice(EXTREME_INTEGERS), rng.getrandbits(8)))
            fields[name] = (new % 256**width, width)
        elif name.startswith("chunks") and len(value) >= 4 and rng.random() < 0.5:
            # Bits move from one chunk to another, so that the sum of the sizes, and the length, stay correct.
            sizes = np.frombuffer(value[: len(value) // 2 * 2], "<u2").astype(np.int64)
            one, other, moved = rng.randrange(len(sizes)), rng.randrange(len(sizes)), rng.randint(1, 9)
            sizes[one] -= min(moved, sizes[one])
            sizes[other] += moved
            fields[name] = sizes.astype("<u2").tobytes()
        else:
            fields[name] = edit_bytes(value, rng, 2)
    if rng.random() < 0.8:
        _repair_lengths(fields)
    part.data = b"".join(
        value[0].to_bytes(value[1], "little") if isinstance(value, tuple) else value for value in fields.values()
    )
    return assemble(parts)


def _forge_exposure(rng: Random) -> bytes:
    """Forge an exposure map's numbers, centers or length; add a map if there is none."""
    parts = [replace(part) for part in _choose_sections(rng)]
    index = next((index for index, part in enumerate(parts) if part.tag == b"EXPO"), None)
    if index is None:
        section, index = encode_exposure(_make_exposure_map(rng.choice((0, 1, 5, 64)))), 1
        parts.insert(index, RawSection(section.type.encode(), section.codec, 0, section.data, section.raw_length))
    data = bytearray(parts[index].data)
    for _ in range(rng.choice((1, 1, 2))):
        kind = rng.randrange(4)
        if kind < 2:
            struct.pack_into("<I", data, 4 + 4 * rng.randrange(20), rng.choice(HOSTILE_FLOAT_BITS))
        elif kind == 2:
            data[84:] = edit_bytes(bytes(data[84:]), rng)
        else:
            data[rng.choice((0, 0, 1, 2, 3))] = rng.choice((0, 1, 2, 63, 64, 65, 255))
    if rng.random() < 0.7:
        del data[84 + (len(data) - 84) // 12 * 12 :]
        data[0] = (len(data) - 84) // 12 % 256
    parts[index].data = bytes(data)
    parts[index].raw_length = len(data) if rng.random() < 0.9 else rng.choice((*EXTREME_INTEGERS, len(data) + 4))
    return assemble(parts)


def _split_fields(part: RawSection) -> dict[str, bytes | tuple[int, int]]:
    """Split the payload of a valid section into fields in order; a field is (number, its width in bytes), or bytes.

    The field "size of NAME" states the number of bytes of all fields whose names start with NAME.
    """
    if part.codec == 6:
        return _split_points_fields(part.data)
    if part.codec == 7:
        return _split_channels_fields(part.data, 3 if part.tag[:3] == b"COL" else 1)
    if part.codec == 8:
        return _split_groups_fields(part.data)
    if part.codec == 13:
        return _split_residuals_fields(part.data, is_color=part.tag[:3] == b"HAR")
    if part.codec == 4:
        names = {"minimum": part.data[:4], "maximum": part.data[4:8], "bits": (part.data[8], 1)}
        return names | _split_stream_fields(part.data[9:], "")
    if part.codec != 3:
        return {"numbers": part.data}
    stages, columns, size = struct.unpack_from("<BBH", part.data)
    end = 4 + 2 * stages * columns * size
    fields = {"stages": (stages, 1), "columns": (columns, 1), "size": (size, 2), "codebooks": part.data[4:end]}
    for stage in range(stages):
        (length,) = struct.unpack_from("<Q", part.data, end)
        fields[f"length {stage}"] = (length, 8)
        fields |= _split_stream_fields(part.data[end + 8 : end + 8 + length], f" {stage}")
        end += 8 + length
    return fields


def _split_points_fields(data: bytes) -> dict[str, bytes | tuple[int, int]]:
    base, kinds, *sizes = struct.unpack_from("<BBII", data)
    fields = {"base": (base, 1), "size of bits": (kinds, 1), "size of gaps": (sizes[0], 4)}
    fields |= {"size of classes": (sizes[1], 4), "bits": data[10 : 10 + kinds]}
    start = 10 + kinds
    for name, size in zip(("gaps", "classes"), sizes, strict=True):
        fields |= _split_integers_fields(data[start : start + size], name)
        start += size
    return fields | {"tails": data[start:]}


def _split_channels_fields(data: bytes, columns: int) -> dict[str, bytes | tuple[int, int]]:
    fields = {"basis": data[:36]} if columns == 3 else {}
    start = len(fields) * 36
    for column in range(columns):
        _, weight, size, kinds = struct.unpack_from("<fBIB", data, start)
        fields |= {f"mean {column}": data[start : start + 4], f"weight {column}": (weight, 1)}
        fields |= {f"size of stream {column}": (size, 4), f"size of steps {column}": (kinds, 1)}
        start += 10 + kinds
        fields[f"steps {column}"] = data[start - kinds : start]
        fields |= _split_integers_fields(data[start : start + size], f"stream {column}")
        start += size
    return fields


def _split_groups_fields(data: bytes) -> dict[str, bytes | tuple[int, int]]:
    first, second = struct.unpack_from("<II", data)
    fields = {"size of steps": (first, 4), "size of models": (second, 4)}
    fields |= _split_integers_fields(data[8 : 8 + first], "steps")
    fields |= _split_integers_fields(data[8 + first : 8 + first + second], "models")
    return fields | _split_integers_fields(data[8 + first + second :], "symbols")


def _split_residuals_fields(data: bytes, is_color: bool) -> dict[str, bytes | tuple[int, int]]:
    class_count, size = struct.unpack_from("<BI", data)
    fields = {"class count": (class_count, 1), "size of flags": (size, 4)}
    fields |= _split_integers_fields(data[5 : 5 + size], "flags")
    start = 5 + size
    if is_color:
        fields["basis"] = data[start : start + 36]
        start += 36
    band = 0
    while start < len(data):
        fields[f"steps {band}"] = data[start : start + class_count]
        start += class_count
        (size,) = struct.unpack_from("<I", data, start)
        fields[f"size of band {band}"] = (size, 4)
        fields |= _split_integers_fields(data[start + 4 : start + 4 + size], f"band {band}")
        start, band = start + 4 + size, band + 1
    return fields


def _split_integers_fields(data: bytes, name: str) -> dict[str, bytes | tuple[int, int]]:
    """Split a stream of integers into its first two numbers and the rest."""
    if len(data) < 2:
        return {f"{name} rest": data}
    return {f"{name} lanes": (data[0], 1), f"{name} alphabet": (data[1], 1), f"{name} rest": data[2:]}


def _split_stream_fields(data: bytes, suffix: str) -> dict[str, bytes | tuple[int, int]]:
    names = {"count": 8, "packed": 8, "leaves": 4, "end": 4, "width": 1, "wide": 1}
    count, packed, leaves, _, width, wide = numbers = struct.unpack_from("<QQIIBB", data)
    sizes = {"lengths": leaves, "symbols": max(leaves - 1, 0) * width}
    sizes |= {"chunks": wide * -(-count // max(1024, 2 * -(-count // 2048))), "codes": packed}
    fields = {name + suffix: (number, names[name]) for name, number in zip(names, numbers, strict=True)}
    at = 26
    for name, size in sizes.items():
        fields[name + suffix] = data[at : at + size]
        at += size
    return fields


def _repair_lengths(fields: dict) -> None:
    """Set the length fields to the lengths of the forged bytes, in place."""
    for name, value in fields.items():
        if name.startswith("codes"):
            fields["packed" + name[5:]] = (len(value), 8)
        elif name.startswith("lengths"):
            fields["leaves" + name[7:]] = (len(value), 4)
    sizes = {name: value[1] if isinstance(value, tuple) else len(value) for name, value in fields.items()}
    for name, value in fields.items():
        if name.startswith("length "):
            stream = [other for other in fields if other.split(" ")[1:] == name.split(" ")[1:]]
            fields[name] = (sum(sizes[other] for other in stream) - 8, 8)
        elif name.startswith("size of "):
            total = sum(size for other, size in sizes.items() if f"{other} ".startswith(f"{name[8:]} "))
            fields[name] = (total % 256 ** value[1], value[1])


def _forge_parts(rng: Random) -> bytes:
    """Forge a merged file: names, order, number or codecs of its parts, or a part that is forged itself."""
    files = [_choose_any_file(rng) if rng.random() < 0.05 else _choose_seed_file(rng) for _ in range(rng.randint(1, 4))]
    names: list[object] = [f"part {number}" for number in range(len(files))]
    kind = rng.randrange(6)
    if kind == 0:
        files[rng.randrange(len(files))] = rng.choice(PART_FORGERS)(rng)
    elif kind == 1:
        names[rng.randrange(len(names))] = rng.choice((*HOSTILE_JSON, "x" * 64, "x" * 65, "part 0"))
    elif kind == 2:
        names = rng.choice((names[1:], [*names, "more"], names * 30))
    sections = join_parts(names, files)
    one = rng.randrange(len(sections))
    if kind == 3:
        sections[0].data = edit_bytes(sections[0].data, rng)
        sections[0].raw_length = len(sections[0].data)
    elif kind == 4:
        sections[one].codec = rng.choice((*range(14), 65535))
        sections[one].raw_length = rng.choice((*EXTREME_INTEGERS, len(sections[one].data)))
    elif kind == 5:
        rng.shuffle(sections)
        sections[one].tag = rng.choice((b"PRTS", b"PT00", b"PT63", b"PT64", b"META", b"POSI", sections[one].tag))
    return assemble(sections)


def _choose_sections(rng: Random) -> tuple[RawSection, ...]:
    return _disassemble_cached(_choose_seed_file(rng))


# Each forges a file of one model.
PART_FORGERS = (_forge_header, _forge_sections, _forge_payload, _forge_metadata, _forge_fields, _forge_exposure)

# Each kind of input has a weight and a function that makes such an input.
INPUT_KINDS: dict[str, tuple[int, Callable[[Random], bytes]]] = {
    "flipped bits": (10, _flip_bits),
    "damaged bytes": (10, _damage_bytes),
    "truncated": (8, _truncate),
    "extended": (4, _extend),
    "spliced": (8, _splice),
    "forged header": (10, _forge_header),
    "forged sections": (10, _forge_sections),
    "forged payload": (10, _forge_payload),
    "forged metadata": (15, _forge_metadata),
    "forged codec field": (15, _forge_fields),
    "forged exposure map": (8, _forge_exposure),
    "forged parts": (10, _forge_parts),
}


def make_hostile_file(number: int, seed: int = 0) -> tuple[str, bytes]:
    """Return the kind and the bytes of input `number` of the run with this seed; the result is deterministic."""
    rng = Random(f"{seed}:{number}")
    kind = rng.choices(list(INPUT_KINDS), [weight for weight, _ in INPUT_KINDS.values()])[0]
    return kind, INPUT_KINDS[kind][1](rng)

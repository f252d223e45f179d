"""Read a `.hyrf` file with nothing but docs/format.md, the standard library and patience.

For people who write a reader in another language: every step of the specification in order, one value at a time,
none of hyrfpack's code. The tests hold hyrfpack's own decoder against it.

    python tools/reference_reader.py model.hyrf
"""

from __future__ import annotations

import json
import struct
import sys
import zlib


def read(data: bytes) -> tuple[dict, dict[str, list[float]]]:
    """The metadata, and every parameter group as one flat list of numbers, in the order of docs/format.md."""
    sections = read_sections(data)
    meta = json.loads(sections["META"][1])
    count, config = meta["gaussians"], meta["config"]
    sizes = {"POSI": 3 * count, "COLO": 3 * count, "SCAL": count, "OPAC": count}
    directions = {"sh": 9, "frequency": 24}[config["direction_encoding"]]
    for letter, grid, extra, outputs in (("G", config["geometry"], 0, 8), ("R", config["radiance"], directions, 3)):
        sizes[letter + "TAB"] = 2 * sum(min(r**3, 1 << grid["log2_table_size"]) for r in resolutions(grid))
        hidden, inputs = config["hidden"], 2 * grid["levels"] + extra
        sizes[letter + "MLP"] = (inputs + 1) * hidden + (hidden + 1) * hidden + (hidden + 1) * outputs
    decoders = {1: read_float32, 2: read_float16, 3: read_residual_vq, 4: read_min_max}
    groups = {type: decoders[codec](data, sizes[type]) for type, (codec, data) in sections.items() if type in sizes}
    return meta, groups


def read_sections(data: bytes) -> dict[str, tuple[int, bytes]]:
    """Section 1 of the specification: codec and stored bytes of each section by type."""
    magic, major, _, flags, length, toc, _, count, toc_crc, crc = struct.unpack_from("<8sHHIQQIIII", data)
    assert magic == b"\x89HYRF\r\n\n" and major == 1 and flags == 0 and length == len(data)
    assert crc == zlib.crc32(data[:44]) and toc_crc == zlib.crc32(data[toc : toc + 40 * count])
    sections = {}
    for index in range(count):
        type, codec, _, offset, stored, _, crc, _ = struct.unpack_from("<4sHHQQQII", data, toc + 40 * index)
        payload = data[offset : offset + stored]
        assert zlib.crc32(payload) == crc
        sections[type.decode()] = codec, payload
    return sections


def resolutions(grid: dict) -> list[int]:
    """Section 2.3: vertices per axis of each level."""
    growth = (grid["finest"] / grid["base"]) ** (1 / max(grid["levels"] - 1, 1))
    exact = (grid["base"] * growth**level - 1e-6 for level in range(grid["levels"]))
    return [int(value) + (value > int(value)) for value in exact]


def read_float32(data: bytes, count: int) -> list[float]:
    """Codec 1."""
    return list(struct.unpack(f"<{count}f", data))


def read_float16(data: bytes, count: int) -> list[float]:
    """Codec 2."""
    return list(struct.unpack(f"<{count}e", data))


def read_residual_vq(data: bytes, count: int) -> list[float]:
    """Codec 3."""
    stages, columns, size = struct.unpack_from("<BBH", data)
    numbers = struct.unpack_from(f"<{stages * size * columns}e", data, 4)
    position = 4 + 2 * len(numbers)
    values = [0.0] * count
    for stage in range(stages):
        (length,) = struct.unpack_from("<Q", data, position)
        indices = read_huffman(data[position + 8 : position + 8 + length])
        position += 8 + length
        assert len(indices) * columns == count
        for row, index in enumerate(indices):
            for column in range(columns):
                word = numbers[(stage * size + index) * columns + column]
                values[row * columns + column] = float32(values[row * columns + column] + word)
    assert position == len(data)
    return values


def read_min_max(data: bytes, count: int) -> list[float]:
    """Codec 4."""
    low, high, bits = struct.unpack_from("<ffB", data)
    codes = read_huffman(data[9:])
    assert len(codes) == count
    last = 2**bits - 1
    return [float32(((last - code) * low + code * high) / last) for code in codes]


def read_huffman(data: bytes) -> list[int]:
    """Section 2.5: the symbols of one stream."""
    count, packed, leaves, end, width, wide = struct.unpack_from("<QQIIBB", data)
    if count == 0:
        return []
    lengths = data[26 : 26 + leaves]
    symbols = list(struct.unpack_from(f"<{leaves - 1}{'BH'[width - 1]}", data, 26 + leaves))
    symbols.insert(end, None)
    code, symbol_of = 0, {}
    for symbol, length in zip(symbols, lengths, strict=True):
        symbol_of[length, code >> (64 - length)] = symbol
        code += 1 << (64 - length)
    assert code == 1 << 64
    chunk = max(1024, 2 * -(-count // 2048))
    chunks = -(-count // chunk)
    place = 26 + leaves + (leaves - 1) * width
    bits_of_chunk = struct.unpack_from(f"<{chunks}{'H' if wide == 2 else 'I'}", data, place)
    payload = data[place + chunks * wide :]
    assert len(payload) == packed
    decoded, position = [], 0
    for bits in bits_of_chunk:
        stop = position + bits
        while position < stop:
            length, code = 0, 0
            while (length, code) not in symbol_of:
                code = code << 1 | payload[position >> 3] >> (7 - position % 8) & 1
                length, position = length + 1, position + 1
            decoded.append(symbol_of[length, code])
        assert position == stop
        assert len(decoded) % chunk == 0 or len(decoded) == count
    assert len(decoded) == count
    return decoded


def float32(value: float) -> float:
    """Round to single precision."""
    return struct.unpack("<f", struct.pack("<f", value))[0]


if __name__ == "__main__":
    with open(sys.argv[1], "rb") as file:
        metadata, parameters = read(file.read())
    print(json.dumps(metadata, indent=2))
    for name, numbers in parameters.items():
        print(name, len(numbers), "numbers, from", min(numbers, default=None), "to", max(numbers, default=None))

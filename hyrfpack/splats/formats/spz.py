"""Niantic's SPZ (https://github.com/nianticlabs/spz), versions 1 to 4: about a tenth of a PLY's bytes.

Every attribute is a section of its own, a few bytes for each Gaussian, in this order:

    positions   3 x 24 bit   fixed point with `fractional bits`, little-endian (version 1: 3 float16)
    opacities   1 byte       o * 255
    colours     3 bytes      (0.5 + 0.15 k) * 255 of the harmonics k of degree 0
    scales      3 bytes      (ln s + 10) * 16
    rotations   4 bytes      smallest three, see `_pack_quats` (before version 3: 3 bytes, (q + 1) * 127.5 of x, y, z)
    harmonics   3 (K - 1)    (k + 1) * 128 of the degrees from 1, one basis function after the other, RGB each

Before them stands a header of 16 bytes: "NGSP", version, count (all uint32), degree, fractional bits, flags, and 0.
Up to version 3 the whole is one gzip stream. Version 4 has a plain header of 32 bytes, whose last byte of the 16 counts
streams and which goes on with the place of the table of contents (uint32) and 12 zeros; perhaps extensions; the table,
of each stream's stored and raw length (uint64); and then each section that is not empty as a stream of zstd.

Axes are RUB: files turn our numbers 180 degrees about x, which other programs undo when they write a PLY.
"""

from __future__ import annotations

import struct
import zlib

import numpy as np
import zstandard

from hyrfpack.errors import HyrfDataError
from hyrfpack.parallel.pool import run_tasks
from hyrfpack.splats.formats.checked import checked_splats
from hyrfpack.splats.formats.hints import NO_HINTS, Hints
from hyrfpack.splats.formats.smallest_three import with_largest, without_largest
from hyrfpack.splats.harmonics import MAX_DEGREE, harmonics_rotation, terms_of
from hyrfpack.splats.splats import Splats

VERSIONS = (3, 4)  # that are written

_MAGIC = b"NGSP"
_GZIP = b"\x1f\x8b"
_HEADER = struct.Struct("<4sIIBBBB")
_TABLE_PLACE = struct.Struct("<I12x")
_STREAM = struct.Struct("<QQ")
_ANTIALIASED, _EXTENDED, _TREE = 0x01, 0x02, 0x80  # flags

_FRACTIONAL_BITS = range(1, 24)  # that every reader we know accepts
FARTHEST = (1 << 22) - 1  # units from the origin along an axis that a position may lie

# Kept of each byte of harmonics. Pictures of two models then lie 48 and 51 dB from those before. With all 8 bits it is
# 51 and 53 dB, in files larger by 33 and 16 %; with the usual choice, 5 for degree 1 and 4 above, 38 and 45 dB, in
# files smaller by 22 and 11 %.
_HARMONICS_BITS = 6
_HIGHEST_DEGREE = 4  # in files; ours end at MAX_DEGREE

_PIECE = 1 << 22  # bytes that a thread deflates

# Sections far smaller than what they unpack to are a trap; real scenes do not even reach 20.
_FREE_BYTES = 1 << 26
_HIGHEST_RATIO = 100

_FLIPS = np.array([1.0, -1.0, -1.0])  # half a turn about x: RDF <-> RUB, its own inverse
_SQRT_2 = np.sqrt(2.0)

# What each byte stands for.
_BYTES = np.arange(256, dtype=np.float64)
_OPACITY_OF = np.float32(_BYTES / 255)
_COLOR_OF = np.float32((_BYTES / 255 - 0.5) / 0.15)
_SCALE_OF = np.float32(np.exp(_BYTES / 16 - 10))
LARGEST_SCALE = float(_SCALE_OF[-1])  # of what is stored, units
_HARMONICS_OF = np.float32((_BYTES - 128) / 128)
_AXIS_OF = np.float32(_BYTES / 127.5 - 1)


def encode(splats: Splats, hints: Hints = NO_HINTS) -> bytes:
    """Splats as an SPZ file.

    What is lost: positions are rounded to multiples of 2^-b, b the most fractional bits up to 23 with which the
    farthest coordinate fits (so to 1/4,194,304 of it or finer, or else to 2^-23); scales to steps of 6 %, from 4.5e-5
    to 379 units, and what lies outside to these; opacities to 1/255; quaternions to 1/723; harmonics of degree 0 to
    1/38, from -3.3 to 3.3; higher ones to 1/32, from -1 to 1.

    Args:
        splats: what to store; `antialiased` too.
        hints: the version, one of VERSIONS.

    Raises:
        ValueError: another version.
        HyrfDataError: positions are too far from the origin (4,194,303 units).
    """
    version = hints.spz_version
    if version not in VERSIONS:
        raise ValueError(f"SPZ version {version} cannot be written; choose one of {VERSIONS}")
    bits = _fractional_bits(splats.positions)
    signs = _harmonics_signs(splats.degree).astype(np.float32)
    sections = (
        _pack_positions(splats.positions * _FLIPS, bits),
        _to_bytes(splats.opacities * 255),
        _to_bytes(splats.harmonics[:, 0] * (0.15 * 255) + 127.5),
        _to_bytes((np.log(np.maximum(splats.scales, np.float32(1e-30))) + 10) * 16),
        _pack_quats(splats.quats),
        _pack_harmonics(splats.harmonics[:, 1:] * signs[1:, None]),
    )
    contents = [section.tobytes() for section in sections]
    flags = _ANTIALIASED if splats.antialiased else 0
    if version == 3:
        header = _HEADER.pack(_MAGIC, version, len(splats), splats.degree, bits, flags, 0)
        return _gzip([header, *contents])
    contents = [content for content in contents if content]
    header = _HEADER.pack(_MAGIC, version, len(splats), splats.degree, bits, flags, len(contents))
    streams = [zstandard.ZstdCompressor(level=9).compress(content) for content in contents]
    table = [_STREAM.pack(len(stream), len(content)) for stream, content in zip(streams, contents, strict=True)]
    return b"".join((header, _TABLE_PLACE.pack(_HEADER.size + _TABLE_PLACE.size), *table, *streams))


def decode(data: bytes, name: str) -> Splats:
    """Splats of an SPZ file of version 1 to 4. Harmonics of degree 4 are left out, extensions skipped.

    Args:
        data: the file.
        name: what messages call it.

    Raises:
        HyrfDataError: it is no SPZ file, damaged, of a newer version, or holds coarse copies of its Gaussians (a tree
            for levels of detail).
    """
    if data[:2] == _GZIP:
        unpacked = _gunzip(data, name)
    elif data[:4] == _MAGIC:
        unpacked = _read_streams(data, name)
    else:
        raise HyrfDataError(f"{name}: this is not an SPZ file, for it starts with neither gzip's nor SPZ's own mark")
    version, degree, bits, flags, sections = unpacked
    positions, opacities, colors, scales, quats, harmonics = (np.frombuffer(part, np.uint8) for part in sections)
    count = len(opacities)
    rest = harmonics.reshape(count, terms_of(degree) - 1, 3)[:, : terms_of(MAX_DEGREE) - 1]
    degree = min(degree, MAX_DEGREE)
    signs = _harmonics_signs(degree).astype(np.float32)
    terms = np.empty((count, terms_of(degree), 3), np.float32)
    terms[:, 0] = _COLOR_OF[colors.reshape(count, 3)]
    np.multiply(_HARMONICS_OF[rest], signs[1:, None], out=terms[:, 1:])
    with np.errstate(invalid="ignore"):  # positions of version 1 may be NaN, which is refused
        return checked_splats(
            name,
            _unpack_positions(positions, bits, version) * _FLIPS,
            _SCALE_OF[scales.reshape(count, 3)],
            _unpack_quats(quats, version),
            _OPACITY_OF[opacities],
            terms,
            bool(flags & _ANTIALIASED),
        )


# --- containers -------------------------------------------------------------------------------------------------------

_Unpacked = tuple[int, int, int, int, list[bytes]]  # version, degree, fractional bits, flags, the six sections


def _section_lengths(version: int, count: int, degree: int) -> list[int]:
    """Raw bytes of each section."""
    each = (6 if version == 1 else 9, 1, 3, 3, 4 if version >= 3 else 3, 3 * (terms_of(degree) - 1))
    return [count * length for length in each]


def _read_header(header: bytes, versions: range, stored: int, name: str) -> tuple[int, int, int, int, int]:
    """Version, count, degree, fractional bits and flags of a header whose sections come from `stored` bytes."""
    magic, version, count, degree, bits, flags, _ = _HEADER.unpack(header)
    if magic != _MAGIC:
        raise HyrfDataError(f"{name}: this is not an SPZ file, for its contents do not start with 'NGSP'")
    if version not in versions:
        raise HyrfDataError(
            f"{name}: this is SPZ version {version}, and versions 1 to 3 (gzip) and 4 (plain header) can be read; "
            "export it as one of these"
        )
    if degree > _HIGHEST_DEGREE or bits > 31:
        raise HyrfDataError(
            f"{name}: its header says harmonics of degree {degree} and {bits} fractional bits, and 4 and 31 are the "
            "most; the file is damaged"
        )
    if flags & _TREE:
        raise HyrfDataError(
            f"{name}: this SPZ file holds a tree of coarse copies for levels of detail; export it without them"
        )
    length = sum(_section_lengths(version, count, degree))
    if length > _FREE_BYTES and length > _HIGHEST_RATIO * stored:
        raise HyrfDataError(
            f"{name}: its header says {count:,} Gaussians, far more than {stored:,} bytes can hold; the file is damaged"
        )
    return version, count, degree, bits, flags


def _gzip(contents: list[bytes]) -> bytes:
    """One gzip member without name and time: the same bytes at any hour, on any system.

    It is deflated in pieces, at once and each by itself. Codes then fit their section: at level 5 it is as small as the
    whole would be at level 6, in half the time.
    """
    pieces = [content[at : at + _PIECE] for content in contents for at in range(0, len(content), _PIECE)]
    deflated = [b""] * len(pieces)

    def deflate(index: int) -> None:
        stream = zlib.compressobj(5, zlib.DEFLATED, -zlib.MAX_WBITS, 9)
        last = index == len(pieces) - 1
        deflated[index] = stream.compress(pieces[index]) + stream.flush(zlib.Z_FINISH if last else zlib.Z_SYNC_FLUSH)

    run_tasks(deflate, len(pieces))
    checksum = 0
    for content in contents:
        checksum = zlib.crc32(content, checksum)
    ending = struct.pack("<II", checksum, sum(map(len, contents)) & 0xFFFFFFFF)
    return b"".join((_GZIP, b"\x08\0\0\0\0\0\0\xff", *deflated, ending))


def _gunzip(data: bytes, name: str) -> _Unpacked:
    """Sections of versions 1 to 3. Never unpacks more than the header's count needs."""
    stream = zlib.decompressobj(16 + zlib.MAX_WBITS)
    try:
        header = stream.decompress(data, _HEADER.size)
        if len(header) < _HEADER.size:
            raise HyrfDataError(f"{name}: the file ends within its header; it is truncated")
        version, count, degree, bits, flags = _read_header(header, range(1, 4), len(data), name)
        lengths = _section_lengths(version, count, degree)
        content = stream.decompress(stream.unconsumed_tail, sum(lengths) + 1)
    except zlib.error as error:
        raise HyrfDataError(f"{name}: its gzip stream is damaged ({error}); fetch or export it again") from error
    more = len(content) > sum(lengths)
    if len(content) < sum(lengths) or not (stream.eof or more):
        raise HyrfDataError(f"{name}: the file ends before its {count:,} Gaussians do; it is truncated")
    if more and not flags & _EXTENDED:
        raise HyrfDataError(f"{name}: the file goes on after its {count:,} Gaussians; it is damaged")
    ends = np.cumsum([0, *lengths])
    sections = [content[start:end] for start, end in zip(ends[:-1], ends[1:], strict=True)]
    return version, degree, bits, flags, sections


def _read_streams(data: bytes, name: str) -> _Unpacked:
    """Sections of version 4."""
    if len(data) < _HEADER.size + _TABLE_PLACE.size:
        raise HyrfDataError(f"{name}: the file ends within its header; it is truncated")
    version, count, degree, bits, flags = _read_header(data[: _HEADER.size], range(4, 5), len(data), name)
    streams = data[_HEADER.size - 1]
    (table,) = _TABLE_PLACE.unpack_from(data, _HEADER.size)
    lengths = _section_lengths(version, count, degree)
    if streams != sum(length > 0 for length in lengths):
        raise HyrfDataError(
            f"{name}: {streams} streams do not fit harmonics of degree {degree} and {count:,} Gaussians; "
            "the file is damaged"
        )
    place = table + streams * _STREAM.size
    if table < _HEADER.size + _TABLE_PLACE.size or place > len(data):
        raise HyrfDataError(f"{name}: its table of contents lies outside of the file; it is damaged or truncated")
    sections, entries = [], _STREAM.iter_unpack(data[table:place])
    for length in lengths:
        stored, raw = next(entries) if length else (0, 0)
        if raw != length:
            raise HyrfDataError(
                f"{name}: a stream of {raw:,} bytes stands where {count:,} Gaussians need {length:,}; the file is "
                "damaged"
            )
        if stored > len(data) - place:
            raise HyrfDataError(f"{name}: the file ends before its {count:,} Gaussians do; it is truncated")
        sections.append(_decompress(data[place : place + stored], length, name))
        place += stored
    return version, degree, bits, flags, sections


def _decompress(stream: bytes, length: int, name: str) -> bytes:
    """The `length` bytes of a stream of zstd. Never unpacks more."""
    if not length:
        return b""
    try:
        with zstandard.ZstdDecompressor(max_window_size=1 << 27).stream_reader(stream) as reader:
            content = reader.read(length + 1)
    except zstandard.ZstdError as error:
        raise HyrfDataError(f"{name}: one of its zstd streams is damaged ({error}); export it again") from error
    if len(content) != length:
        raise HyrfDataError(f"{name}: a zstd stream does not hold the {length:,} bytes it should; the file is damaged")
    return content


# --- attributes -------------------------------------------------------------------------------------------------------


def _to_bytes(values: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def _fractional_bits(positions: np.ndarray) -> int:
    """The most that leave the farthest coordinate in 24 bits."""
    farthest = np.abs(positions).max(initial=0)
    for bits in reversed(_FRACTIONAL_BITS):
        if np.rint(farthest * 2**bits) < 1 << 23:
            return bits
    raise HyrfDataError(
        f"a Gaussian lies {farthest:,.0f} units from the origin, and SPZ reaches {FARTHEST:,}; "
        "export another format (PLY)"
    )


def _pack_positions(positions: np.ndarray, bits: int) -> np.ndarray:
    fixed = np.rint(positions * 2**bits).astype("<i4")
    return fixed[..., None].view(np.uint8)[..., :3]


def _unpack_positions(packed: np.ndarray, bits: int, version: int) -> np.ndarray:
    """(N, 3) float64."""
    if version == 1:
        return packed.view("<f2").reshape(-1, 3).astype(np.float64)
    padded = np.zeros((len(packed) // 3, 4), np.uint8)
    padded[:, 1:] = packed.reshape(-1, 3)
    return (padded.view("<i4").reshape(-1, 3) >> 8) * 2.0**-bits  # the shift brings the sign along


def _pack_quats(quats: np.ndarray) -> np.ndarray:
    """Quaternions (N, 4) wxyz as (N,) uint32: in the 2 high bits which of x, y, z, w is largest, then the other three
    in this order: a sign and 9 bits of the magnitude, of which 511 is sqrt(1/2)."""
    largest, others = without_largest(quats[:, [1, 2, 3, 0]] * np.array([1, -1, -1, 1], np.float32))
    sizes = np.minimum(np.rint(np.abs(others) * (511 * _SQRT_2)), 511).astype(np.uint32)
    codes = sizes | (others < 0).astype(np.uint32) << 9
    return (largest.astype(np.uint32) << 30 | codes[:, 0] << 20 | codes[:, 1] << 10 | codes[:, 2]).astype("<u4")


def _unpack_quats(packed: np.ndarray, version: int) -> np.ndarray:
    """(N, 4) float32 wxyz."""
    if version >= 3:
        words = packed.view("<u4")
        codes = words[:, None] >> np.array([20, 10, 0], np.uint32)
        sizes = (codes & 511).astype(np.float32) * np.float32(1 / (511 * _SQRT_2))
        others = np.where(codes & 512, -sizes, sizes)
        quats = with_largest(words >> 30, others)
    else:
        others = _AXIS_OF[packed.reshape(-1, 3)]
        quats = with_largest(np.full(len(others), 3), others)
    return quats[:, [3, 0, 1, 2]] * np.array([1, 1, -1, -1], np.float32)  # of xyzw


def _pack_harmonics(harmonics: np.ndarray) -> np.ndarray:
    """(N, K - 1, 3) bytes with zeros in the low bits, so that gzip and zstd find fewer different ones."""
    values = harmonics * np.float32(2 ** (_HARMONICS_BITS - 1))
    np.rint(values, out=values)
    values *= 2 ** (8 - _HARMONICS_BITS)
    values += 128
    return np.clip(values, 0, 255, out=values).astype(np.uint8)


def _harmonics_signs(degree: int) -> np.ndarray:
    """(K,) what the half turn does to each of the harmonics: the sign changes, or not."""
    return np.rint(np.diagonal(harmonics_rotation(np.diag(_FLIPS), degree)))

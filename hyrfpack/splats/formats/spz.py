"""Niantic's SPZ (https://github.com/nianticlabs/spz), versions 1 to 4: files of about a tenth of a PLY's bytes.

Every attribute has its own section, with a few bytes for each Gaussian, in this order:

    positions   3 x 24 bits  fixed point with the header's number of fractional bits, little-endian (version 1:
                             3 float16)
    opacities   1 byte       o * 255
    colours     3 bytes      (0.5 + 0.15 k) * 255 of the harmonics k of degree 0
    scales      3 bytes      (ln s + 10) * 16
    rotations   4 bytes      smallest three, see `_pack_quats` (before version 3: 3 bytes, (q + 1) * 127.5 of x, y, z)
    harmonics   3 (K - 1)    (k + 1) * 128 of degrees 1 and up, one basis function after the other, RGB each

A header of 16 bytes comes first: "NGSP", version, count (all uint32), degree, fractional bits, flags and 0 (one byte
each). Up to version 3, header and sections are one gzip stream.

Version 4 is not compressed as a whole. Its header of 32 bytes starts with the same 16 bytes, but the last one is the
number of streams. It continues with the offset of the table of contents (uint32) and 12 zero bytes. Then come optional
extensions, and the table of contents with the stored and the raw length of each stream (uint64 each). Then each section
that is not empty follows as a zstd stream.

Axes are RUB (right, up, back): files hold our numbers rotated by 180 degrees about x. Other programs undo that rotation
when they write a PLY.
"""

from __future__ import annotations

import struct
import zlib
from typing import NamedTuple

import numpy as np

from hyrfpack.choices import SPZ_VERSIONS
from hyrfpack.errors import HyrfDataError, needs_package
from hyrfpack.ops.harmonics import MAX_DEGREE, num_sh_bases
from hyrfpack.parallel.pool import run_tasks
from hyrfpack.splats.formats.hints import NO_HINTS, Hints
from hyrfpack.splats.formats.smallest_three import drop_largest, restore_largest
from hyrfpack.splats.formats.validation import build_valid_splats
from hyrfpack.splats.harmonics import compute_harmonics_rotation
from hyrfpack.splats.splats import Splats

VERSION_IN_GLTF = 2  # of the draft extension KHR_gaussian_splatting_compression_spz_2
_MAGIC = b"NGSP"
_GZIP_MAGIC = b"\x1f\x8b"
_HEADER_STRUCT = struct.Struct("<4sIIBBBB")
_TABLE_OFFSET_STRUCT = struct.Struct("<I12x")
_STREAM_LENGTHS_STRUCT = struct.Struct("<QQ")
_ANTIALIASED_FLAG = 0x01
_EXTENSIONS_FLAG = 0x02
_LOD_TREE_FLAG = 0x80

_FRACTIONAL_BITS_RANGE = range(1, 24)  # because all known readers accept these
MAX_COORDINATE = (1 << 22) - 1  # world units

# With 6 of 8 bits, pictures of two models have 48 and 51 dB against those of the unencoded splats. All 8 bits give 51
# and 53 dB, in files larger by 33 and 16 %. The usual choice (5 bits for degree 1, 4 above) gives 38 and 45 dB, in
# files smaller by 22 and 11 %.
_KEPT_HARMONICS_BITS = 6
_MAX_READABLE_DEGREE = 4  # is higher than MAX_DEGREE, because decoding drops the harmonics of degree 4

_DEFLATE_PIECE_BYTES = 1 << 22

# A file whose sections unpack to far more than their size could exhaust memory. Real scenes stay below a ratio of 20.
_UNCHECKED_CONTENT_BYTES = 1 << 26
_MAX_COMPRESSION_RATIO = 100

_AXIS_SIGNS = np.array([1.0, -1.0, -1.0])  # half a turn about x, between RDF and RUB; it is its own inverse
_SQRT_2 = np.sqrt(2.0)

# The tables below map each byte to the number that it means.
_BYTE_VALUES = np.arange(256, dtype=np.float64)
_OPACITY_BY_BYTE = np.float32(_BYTE_VALUES / 255)
_COLOR_BY_BYTE = np.float32((_BYTE_VALUES / 255 - 0.5) / 0.15)
_SCALE_BY_BYTE = np.float32(np.exp(_BYTE_VALUES / 16 - 10))
MIN_SCALE, MAX_SCALE = float(_SCALE_BY_BYTE[0]), float(_SCALE_BY_BYTE[-1])  # world units
_HARMONIC_BY_BYTE = np.float32((_BYTE_VALUES - 128) / 128)
_QUAT_COMPONENT_BY_BYTE = np.float32(_BYTE_VALUES / 127.5 - 1)


def encode(splats: Splats, hints: Hints = NO_HINTS) -> bytes:
    """Encode splats as an SPZ file, including `antialiased`.

    The format rounds

    - positions to multiples of 2^-b, with b the largest number of fractional bits, at most 23, that the farthest
      coordinate allows: to 1/4,194,304 of that coordinate or finer, or else to 2^-23;
    - scales to steps of 6 %, clamped to 4.5e-5 to 379 units;
    - opacities to 1/255 and quaternions to 1/723 (1/128 in version 2);
    - harmonics of degree 0 to 1/38, clamped to -3.3 to 3.3, and higher ones to 1/32, clamped to -1 to 1.

    Args:
        splats: the splats.
        hints: `spz_version`, one of SPZ_VERSIONS or VERSION_IN_GLTF, is used.

    Raises:
        ValueError: the version is not one of SPZ_VERSIONS.
        HyrfDataError: a position is too far from the origin (more than 4,194,303 units).
    """
    version = hints.spz_version
    if version not in (VERSION_IN_GLTF, *SPZ_VERSIONS):
        raise ValueError(f"SPZ version {version} cannot be written; choose one of {SPZ_VERSIONS}")
    bits = _choose_fractional_bits(splats.positions)
    signs = _compute_harmonics_signs(splats.degree).astype(np.float32)
    sections = (
        _pack_positions(splats.positions * _AXIS_SIGNS, bits),
        _round_to_bytes(splats.opacities * 255),
        _round_to_bytes(splats.harmonics[:, 0] * (0.15 * 255) + 127.5),
        _round_to_bytes((np.log(np.maximum(splats.scales, np.float32(1e-30))) + 10) * 16),
        _pack_quats(splats.quats) if version >= 3 else _pack_quats_coarsely(splats.quats),
        _pack_harmonics(splats.harmonics[:, 1:] * signs[1:, None]),
    )
    contents = [section.tobytes() for section in sections]
    flags = _ANTIALIASED_FLAG if splats.antialiased else 0
    if version <= 3:
        header = _HEADER_STRUCT.pack(_MAGIC, version, len(splats), splats.degree, bits, flags, 0)
        return _compress_gzip([header, *contents])
    with needs_package(f"writing .spz files of version {version}"):
        import zstandard

    contents = [content for content in contents if content]
    header = _HEADER_STRUCT.pack(_MAGIC, version, len(splats), splats.degree, bits, flags, len(contents))
    streams = [zstandard.ZstdCompressor(level=9).compress(content) for content in contents]
    table = [
        _STREAM_LENGTHS_STRUCT.pack(len(stream), len(content))
        for stream, content in zip(streams, contents, strict=True)
    ]
    return b"".join(
        (header, _TABLE_OFFSET_STRUCT.pack(_HEADER_STRUCT.size + _TABLE_OFFSET_STRUCT.size), *table, *streams)
    )


def decode(data: bytes, name: str) -> Splats:
    """Decode an SPZ file of version 1 to 4. Harmonics of degree 4 and extensions are dropped.

    Args:
        data: the file's bytes.
        name: the file's name in error messages.

    Raises:
        HyrfDataError: the bytes are not an SPZ file, are damaged, have a newer version, or hold a tree of coarse
            copies of the Gaussians for levels of detail.
    """
    if data[:2] == _GZIP_MAGIC:
        header, sections = _read_gzip(data, name)
    elif data[:4] == _MAGIC:
        header, sections = _read_streams(data, name)
    else:
        raise HyrfDataError(
            f"{name}: this is not an SPZ file, because it starts with the signature of neither gzip nor SPZ",
            fix="check the path",
        )
    positions, opacities, colors, scales, quats, harmonics = (np.frombuffer(part, np.uint8) for part in sections)
    count = len(opacities)
    higher_codes = harmonics.reshape(count, num_sh_bases(header.degree) - 1, 3)[:, : num_sh_bases(MAX_DEGREE) - 1]
    degree = min(header.degree, MAX_DEGREE)
    signs = _compute_harmonics_signs(degree).astype(np.float32)
    terms = np.empty((count, num_sh_bases(degree), 3), np.float32)
    terms[:, 0] = _COLOR_BY_BYTE[colors.reshape(count, 3)]
    np.multiply(_HARMONIC_BY_BYTE[higher_codes], signs[1:, None], out=terms[:, 1:])
    with np.errstate(invalid="ignore"):  # positions of version 1 may be NaN, which is rejected below
        return build_valid_splats(
            name,
            _unpack_positions(positions, header.fractional_bits, header.version) * _AXIS_SIGNS,
            _SCALE_BY_BYTE[scales.reshape(count, 3)],
            _unpack_quats(quats, header.version),
            _OPACITY_BY_BYTE[opacities],
            terms,
            bool(header.flags & _ANTIALIASED_FLAG),
        )


# --- containers -------------------------------------------------------------------------------------------------------


class _Header(NamedTuple):
    """What the header of a file says about all of its sections."""

    version: int
    gaussians: int
    degree: int
    fractional_bits: int
    flags: int

    @property
    def section_lengths(self) -> list[int]:
        """The number of raw bytes of each section."""
        quat_bytes = 4 if self.version >= 3 else 3
        harmonics_bytes = 3 * (num_sh_bases(self.degree) - 1)
        bytes_per_gaussian = (6 if self.version == 1 else 9, 1, 3, 3, quat_bytes, harmonics_bytes)
        return [self.gaussians * length for length in bytes_per_gaussian]


def _read_header(data: bytes, versions: range, stored: int, name: str) -> _Header:
    """Read and check a header whose sections come from `stored` bytes.

    Raises:
        HyrfDataError: the header is none of SPZ, has another version, or promises more than its file can hold.
    """
    magic, version, count, degree, bits, flags, _ = _HEADER_STRUCT.unpack(data)
    if magic != _MAGIC:
        raise HyrfDataError(
            f"{name}: this is not an SPZ file, because its contents do not start with 'NGSP'", fix="check the path"
        )
    if version not in versions:
        raise HyrfDataError(
            f"{name}: this is SPZ version {version}, and versions 1 to 3 (gzip) and 4 (plain header) can be read",
            fix="export it as one of these",
        )
    if degree > _MAX_READABLE_DEGREE or bits > 31:
        raise HyrfDataError(
            f"{name}: the header says harmonics of degree {degree} and {bits} fractional bits, but the limits are 4 "
            "and 31",
            fix="the file is damaged, export it again",
        )
    if flags & _LOD_TREE_FLAG:
        raise HyrfDataError(
            f"{name}: this SPZ file holds a tree of coarse copies for levels of detail",
            fix="export it without them",
        )
    header = _Header(version, count, degree, bits, flags)
    length = sum(header.section_lengths)
    if length > _UNCHECKED_CONTENT_BYTES and length > _MAX_COMPRESSION_RATIO * stored:
        raise HyrfDataError(
            f"{name}: its header says {count:,} Gaussians, far more than {stored:,} bytes can hold",
            fix="the file is damaged, export it again",
        )
    return header


def _compress_gzip(contents: list[bytes]) -> bytes:
    """Compress contents as one gzip member without name and time, so that the bytes are the same on any system.

    Pieces are deflated independently and in parallel, so that the codes of each piece suit its section. At level 5 the
    result is as small as one stream at level 6, in half the time.
    """
    pieces = [
        content[at : at + _DEFLATE_PIECE_BYTES]
        for content in contents
        for at in range(0, len(content), _DEFLATE_PIECE_BYTES)
    ]
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
    return b"".join((_GZIP_MAGIC, b"\x08\0\0\0\0\0\0\xff", *deflated, ending))


def _read_gzip(data: bytes, name: str) -> tuple[_Header, list[bytes]]:
    """Read the sections of a file of version 1 to 3, without unpacking more bytes than the header's count needs."""
    stream = zlib.decompressobj(16 + zlib.MAX_WBITS)
    try:
        header_bytes = stream.decompress(data, _HEADER_STRUCT.size)
        if len(header_bytes) < _HEADER_STRUCT.size:
            raise HyrfDataError(
                f"{name}: the file ends within its header",
                fix="the file is truncated, export it again",
            )
        header = _read_header(header_bytes, range(1, 4), len(data), name)
        lengths = header.section_lengths
        content = stream.decompress(stream.unconsumed_tail, sum(lengths) + 1)
    except zlib.error as error:
        raise HyrfDataError(f"{name}: its gzip stream is damaged ({error})", fix="fetch or export it again") from error
    has_more = len(content) > sum(lengths)
    if len(content) < sum(lengths) or not (stream.eof or has_more):
        raise HyrfDataError(
            f"{name}: the file ends before its {header.gaussians:,} Gaussians do",
            fix="the file is truncated, export it again",
        )
    if has_more and not header.flags & _EXTENSIONS_FLAG:
        raise HyrfDataError(
            f"{name}: the file continues after its {header.gaussians:,} Gaussians",
            fix="the file is damaged, export it again",
        )
    ends = np.cumsum([0, *lengths])
    return header, [content[start:end] for start, end in zip(ends[:-1], ends[1:], strict=True)]


def _read_streams(data: bytes, name: str) -> tuple[_Header, list[bytes]]:
    """Read the sections of a file of version 4."""
    if len(data) < _HEADER_STRUCT.size + _TABLE_OFFSET_STRUCT.size:
        raise HyrfDataError(f"{name}: the file ends within its header", fix="the file is truncated, export it again")
    header = _read_header(data[: _HEADER_STRUCT.size], range(4, 5), len(data), name)
    stream_count = data[_HEADER_STRUCT.size - 1]
    (table_offset,) = _TABLE_OFFSET_STRUCT.unpack_from(data, _HEADER_STRUCT.size)
    lengths = header.section_lengths
    if stream_count != sum(length > 0 for length in lengths):
        raise HyrfDataError(
            f"{name}: {stream_count} streams do not fit harmonics of degree {header.degree} and {header.gaussians:,} "
            "Gaussians",
            fix="the file is damaged, export it again",
        )
    offset = table_offset + stream_count * _STREAM_LENGTHS_STRUCT.size
    if table_offset < _HEADER_STRUCT.size + _TABLE_OFFSET_STRUCT.size or offset > len(data):
        raise HyrfDataError(
            f"{name}: its table of contents lies outside of the file",
            fix="the file is damaged or truncated, export it again",
        )
    sections, entries = [], _STREAM_LENGTHS_STRUCT.iter_unpack(data[table_offset:offset])
    for length in lengths:
        stored, raw = next(entries) if length else (0, 0)
        if raw != length:
            raise HyrfDataError(
                f"{name}: a stream has {raw:,} bytes, but {header.gaussians:,} Gaussians need {length:,}",
                fix="the file is damaged, export it again",
            )
        if stored > len(data) - offset:
            raise HyrfDataError(
                f"{name}: the file ends before its {header.gaussians:,} Gaussians do",
                fix="the file is truncated, export it again",
            )
        sections.append(_decompress_zstd(data[offset : offset + stored], length, name))
        offset += stored
    return header, sections


def _decompress_zstd(stream: bytes, length: int, name: str) -> bytes:
    """Decompress a zstd stream of exactly `length` bytes, without unpacking more than one byte beyond these."""
    if not length:
        return b""
    with needs_package(f"{name}: reading .spz files of version 4"):
        import zstandard

    try:
        with zstandard.ZstdDecompressor(max_window_size=1 << 27).stream_reader(stream) as reader:
            content = reader.read(length + 1)
    except zstandard.ZstdError as error:
        raise HyrfDataError(f"{name}: one of its zstd streams is damaged ({error})", fix="export it again") from error
    if len(content) != length:
        raise HyrfDataError(
            f"{name}: a zstd stream does not hold the {length:,} bytes it should",
            fix="the file is damaged, export it again",
        )
    return content


# --- attributes -------------------------------------------------------------------------------------------------------


def _round_to_bytes(values: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def _choose_fractional_bits(positions: np.ndarray) -> int:
    """Return the largest number of fractional bits with which the farthest coordinate fits into 24 bits."""
    farthest = np.abs(positions).max(initial=0)
    for bits in reversed(_FRACTIONAL_BITS_RANGE):
        if np.rint(farthest * 2**bits) < 1 << 23:
            return bits
    raise HyrfDataError(
        f"a Gaussian lies {farthest:,.0f} units from the origin, and SPZ reaches {MAX_COORDINATE:,}",
        fix="export to another format, such as PLY",
    )


def _pack_positions(positions: np.ndarray, bits: int) -> np.ndarray:
    fixed = np.rint(positions * 2**bits).astype("<i4")
    return fixed[..., None].view(np.uint8)[..., :3]


def _unpack_positions(packed: np.ndarray, bits: int, version: int) -> np.ndarray:
    """Unpack positions into (N, 3) float64."""
    if version == 1:
        return packed.view("<f2").reshape(-1, 3).astype(np.float64)
    padded = np.zeros((len(packed) // 3, 4), np.uint8)
    padded[:, 1:] = packed.reshape(-1, 3)
    return (padded.view("<i4").reshape(-1, 3) >> 8) * 2.0**-bits  # the arithmetic shift extends the sign


def _pack_quats(quats: np.ndarray) -> np.ndarray:
    """Pack quaternions (N, 4) wxyz into (N,) uint32 by the smallest-three encoding.

    The 2 high bits hold the index of the largest of x, y, z, w. The other three follow in this order, each as a sign
    bit and 9 bits of magnitude, of which 511 means sqrt(1/2).
    """
    largest, others = drop_largest(quats[:, [1, 2, 3, 0]] * np.array([1, -1, -1, 1], np.float32))
    sizes = np.minimum(np.rint(np.abs(others) * (511 * _SQRT_2)), 511).astype(np.uint32)
    codes = sizes | (others < 0).astype(np.uint32) << 9
    return (largest.astype(np.uint32) << 30 | codes[:, 0] << 20 | codes[:, 1] << 10 | codes[:, 2]).astype("<u4")


def _pack_quats_coarsely(quats: np.ndarray) -> np.ndarray:
    """Pack quaternions (N, 4) wxyz, w >= 0, into x, y and z (N, 3) uint8, as versions 1 and 2 do."""
    upper = np.where(quats[:, :1] < 0, -quats, quats)
    return _round_to_bytes((upper[:, 1:] * np.array([1, -1, -1], np.float32) + 1) * 127.5)


def _unpack_quats(packed: np.ndarray, version: int) -> np.ndarray:
    """Unpack quaternions into (N, 4) float32 wxyz."""
    if version >= 3:
        words = packed.view("<u4")
        codes = words[:, None] >> np.array([20, 10, 0], np.uint32)
        sizes = (codes & 511).astype(np.float32) * np.float32(1 / (511 * _SQRT_2))
        others = np.where(codes & 512, -sizes, sizes)
        quats = restore_largest(words >> 30, others)
    else:
        others = _QUAT_COMPONENT_BY_BYTE[packed.reshape(-1, 3)]
        quats = restore_largest(np.full(len(others), 3), others)
    return quats[:, [3, 0, 1, 2]] * np.array([1, 1, -1, -1], np.float32)  # from xyzw


def _pack_harmonics(harmonics: np.ndarray) -> np.ndarray:
    """Pack harmonics into bytes (N, K - 1, 3) with zero low bits, which gzip and zstd compress better."""
    values = harmonics * np.float32(2 ** (_KEPT_HARMONICS_BITS - 1))
    np.rint(values, out=values)
    values *= 2 ** (8 - _KEPT_HARMONICS_BITS)
    values += 128
    return np.clip(values, 0, 255, out=values).astype(np.uint8)


def _compute_harmonics_signs(degree: int) -> np.ndarray:
    """Return the sign (K,), 1 or -1, by which the half turn about x multiplies each harmonic."""
    return np.rint(np.diagonal(compute_harmonics_rotation(np.diag(_AXIS_SIGNS), degree)))

"""Code points on a lattice with a resolution for each class: gaps in Morton order, and raw finer bits.

A point of class k has b_k bits per axis. The points are sorted by the Morton code of the first `base` bits of each
axis, and within one such cell by class. The original order of the points is not stored. The stream holds the gaps
between successive Morton codes, the classes, and the 3 (b_k - base) finer bits of each point. These are nearly random
and therefore stored raw.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

from hyrfpack.quant.bits import pack_bits, unpack_bits
from hyrfpack.quant.errors import DamagedDataError
from hyrfpack.quant.integers import decode_integers, encode_integers
from hyrfpack.quant.morton import MAX_BITS_PER_AXIS, morton_cells, morton_codes

MAX_POINT_CLASSES = 16
# The fields are the base, the number of classes, the bytes of the gaps, and the bytes of the classes.
_HEADER_STRUCT = struct.Struct("<BBII")


@dataclass(frozen=True)
class LatticePoints:
    """Points on a lattice whose resolution depends on the class of the point.

    Attributes:
        cells: (N, 3) int32 or int64; a coordinate of a point of class k lies in [0, 2^bits[k]).
        classes: (N,) uint8 class of each point.
        bits: (K,) int64 bits per axis of each class, 1 to MAX_BITS_PER_AXIS.
    """

    cells: np.ndarray
    classes: np.ndarray
    bits: np.ndarray

    def __getitem__(self, index: slice) -> LatticePoints:
        return LatticePoints(self.cells[index], self.classes[index], self.bits)

    def centers(self) -> np.ndarray:
        """Return the cells' centres (N, 3) int64, in units of 2^-(MAX_BITS_PER_AXIS + 1) of the lattice's side."""
        return (2 * self.cells + 1) << (MAX_BITS_PER_AXIS - self.bits)[self.classes][:, None]


def encode_points(points: LatticePoints, *, keep_bits: bool = False) -> tuple[bytes, np.ndarray, LatticePoints]:
    """Sort and encode points.

    Args:
        points: the points.
        keep_bits: keep each point in its cell, even if finer cells would take fewer bytes.

    Returns:
        The bytes; (N,) int64 index of the point at each place of the new order; and the points in the new order, as
        the decoder will return them. Classes with fewer bits than the base get as many bits as the base; with
        `keep_bits`, only classes without points.
    """
    order, ordered, base = sort_points(points, keep_bits=keep_bits)
    return encode_sorted_points(ordered, base), order, ordered


def sort_points(points: LatticePoints, *, keep_bits: bool = False) -> tuple[np.ndarray, LatticePoints, int]:
    """Sort points as `encode_points` does.

    Returns:
        The order and the points in it, as from `encode_points`; and the base, the bits of each axis to sort by.
    """
    cells, classes, bits = points.cells, points.classes, points.bits
    finest = int(bits.max(initial=1))
    codes = morton_codes(cells << (finest - bits[classes])[:, None])
    order = np.argsort(codes, kind="stable")
    largest = int(bits[classes].min(initial=finest)) if keep_bits else finest
    base = _choose_base_bits(codes[order], classes[order], bits, finest, largest)
    order = order[np.lexsort((classes[order], codes[order] >> 3 * (finest - base)))]
    refined = np.maximum(bits, base)
    classes = classes[order]
    cells = points.cells[order] << (refined - bits)[classes][:, None]
    return order, LatticePoints(cells, classes, refined), base


def encode_sorted_points(points: LatticePoints, base: int) -> bytes:
    """Encode points that `sort_points` has sorted by `base` bits of each axis."""
    classes, bits = points.classes, points.bits
    finer_bits = (3 * (bits - base)).astype(np.uint8)[classes]
    codes = morton_codes(points.cells)
    gaps = np.diff(codes >> finer_bits, prepend=0)
    gap_bytes = encode_integers(gaps)
    class_bytes = encode_integers(classes, (gaps == 0).view(np.uint8))
    header = _HEADER_STRUCT.pack(base, len(bits), len(gap_bytes), len(class_bytes)) + bits.astype(np.uint8).tobytes()
    tail_bytes = pack_bits(codes.view(np.uint64), finer_bits)
    return b"".join((header, gap_bytes, class_bytes, tail_bytes))


def decode_points(data: bytes | memoryview, count: int) -> LatticePoints:
    """Decode `count` points that `encode_points` encoded, in the order of the encoder.

    Raises:
        DamagedDataError: the bytes are truncated, damaged or inconsistent.
    """
    if len(data) < _HEADER_STRUCT.size:
        raise DamagedDataError(f"points: {len(data)} bytes are fewer than their header; the data is truncated")
    base, class_count, gap_size, class_size = _HEADER_STRUCT.unpack_from(data)
    start = _HEADER_STRUCT.size + class_count
    is_in_range = 1 <= class_count <= MAX_POINT_CLASSES and 1 <= base <= MAX_BITS_PER_AXIS
    if not is_in_range or start + gap_size + class_size > len(data):
        raise DamagedDataError("points: the header has impossible values; the data is damaged")
    bits = np.frombuffer(data[_HEADER_STRUCT.size : start], np.uint8).astype(np.int64)
    if bits.min() < base or bits.max() > MAX_BITS_PER_AXIS:
        raise DamagedDataError("points: a class has fewer bits than the base, or too many; the data is damaged")
    gaps = decode_integers(data[start : start + gap_size], count)
    repeated = (gaps == 0).view(np.uint8)
    heads = np.cumsum(gaps, dtype=np.int64)
    if count and (int(heads.max()) >> 3 * base or int(heads.min()) < 0):
        raise DamagedDataError("points: the gaps lead out of the lattice; the data is damaged")
    del gaps
    classes = decode_integers(data[start + gap_size : start + gap_size + class_size], count, repeated)
    if count and int(classes.max()) >= class_count:
        raise DamagedDataError(
            f"points: there is a class {classes.max()}, but only {class_count} are declared; the data is damaged"
        )
    classes = classes.astype(np.uint8)
    finer_bits = (3 * (bits - base)).astype(np.uint8)[classes]
    tails = unpack_bits(data[start + gap_size + class_size :], finer_bits)
    heads <<= finer_bits
    heads |= tails.view(np.int64)
    return LatticePoints(morton_cells(heads), classes, bits)


def _choose_base_bits(codes: np.ndarray, classes: np.ndarray, bits: np.ndarray, finest: int, largest: int) -> int:
    """Choose the number of bits per axis, up to `largest`, to sort by and to code as gaps, by an estimate of the size.

    Each further bit costs about 3 bits per point, as when it is stored raw, but less in dense places. But classes with
    a coarser lattice then get bits that they do not need. And fewer points share a cell, in which their order takes no
    bits.
    """
    if len(codes) == 0:
        return 1
    population = np.bincount(classes, minlength=len(bits))
    best_base, min_cost = 1, np.inf
    for base in range(max(1, min(int(np.log2(len(codes)) / 3) - 1, largest)), largest + 1):
        lengths = np.frexp(np.diff(codes >> 3 * (finest - base), prepend=0).astype(np.float64))[1]
        histogram = np.bincount(lengths)
        share = histogram[histogram > 0] / len(codes)
        # A gap of n bits costs its token, about the entropy of n, and the n - 1 bits below the highest.
        cost = len(codes) * -(share * np.log2(share)).sum() + np.maximum(lengths - 1, 0).sum()
        cost += 3 * (np.maximum(bits - base, 0) * population).sum()
        if cost < min_cost:
            best_base, min_cost = base, cost
    return best_base

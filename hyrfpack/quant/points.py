"""Points on a lattice, each as fine as it needs: Morton order, gaps between neighbours, finer bits as they are.

A point of class k has b_k bits an axis. The list is in the Morton order of the first `base` bits of each axis, and in
one cell of that order by class; there the order carries no information, so it costs none. Stored are the gaps between
successive Morton codes, the classes, and the 3 (b_k - base) finer bits of each point, which look like noise.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

from hyrfpack.quant.bits import pack_bits, unpack_bits
from hyrfpack.quant.errors import DamagedDataError
from hyrfpack.quant.integers import decode_integers, encode_integers
from hyrfpack.quant.morton import MAX_BITS, morton_cells, morton_codes

MAX_CLASSES = 16
_HEADER = struct.Struct("<BBII")  # base, classes, bytes of the gaps, bytes of the classes


@dataclass(frozen=True)
class Points:
    """Lattice points.

    Attributes:
        cells: (N, 3) int32 or int64; a coordinate of a point of class k lies in [0, 2^bits[k]).
        classes: (N,) uint8.
        bits: (K,) int64, each 1 to MAX_BITS.
    """

    cells: np.ndarray
    classes: np.ndarray
    bits: np.ndarray

    def __getitem__(self, index: slice) -> Points:
        return Points(self.cells[index], self.classes[index], self.bits)

    def centers(self) -> np.ndarray:
        """(N, 3) int64: centres of the cells, in units of 2^-(MAX_BITS + 1) of the lattice's side."""
        return (2 * self.cells + 1) << (MAX_BITS - self.bits)[self.classes][:, None]


def encode_points(points: Points) -> tuple[bytes, np.ndarray, Points]:
    """Code points; they are put in order on the way.

    Returns:
        The bytes; (N,) int64 which point comes at each place; and the points as the decoder will give them, in that
        order (classes coarser than the base are made as fine as it).
    """
    cells, classes, bits = points.cells, points.classes, points.bits
    finest = int(bits.max(initial=1))
    codes = morton_codes(cells << (finest - bits[classes])[:, None])
    order = np.argsort(codes, kind="stable")
    base = _best_base(codes[order], classes[order], bits, finest)
    order = order[np.lexsort((classes[order], codes[order] >> 3 * (finest - base)))]
    refined = np.maximum(bits, base)
    classes = classes[order]
    cells = points.cells[order] << (refined - bits)[classes][:, None]
    ordered = Points(cells, classes, refined)

    finer = (3 * (refined - base)).astype(np.uint8)[classes]
    codes = morton_codes(cells)
    gaps = np.diff(codes >> finer, prepend=0)
    gap_bytes = encode_integers(gaps)
    class_bytes = encode_integers(classes, (gaps == 0).view(np.uint8))
    header = _HEADER.pack(base, len(bits), len(gap_bytes), len(class_bytes)) + refined.astype(np.uint8).tobytes()
    tail_bytes = pack_bits(codes.view(np.uint64), finer)
    return b"".join((header, gap_bytes, class_bytes, tail_bytes)), order, ordered


def decode_points(data: bytes | memoryview, count: int) -> Points:
    """The points that `encode_points` wrote, in its order.

    Raises:
        DamagedDataError: the bytes are truncated, damaged or contradict themselves.
    """
    if len(data) < _HEADER.size:
        raise DamagedDataError(f"points: {len(data)} bytes are fewer than their header; the data is truncated")
    base, kinds, gap_size, class_size = _HEADER.unpack_from(data)
    start = _HEADER.size + kinds
    if not (1 <= kinds <= MAX_CLASSES and 1 <= base <= MAX_BITS) or start + gap_size + class_size > len(data):
        raise DamagedDataError("points: the header says what cannot be; the data is damaged")
    bits = np.frombuffer(data[_HEADER.size : start], np.uint8).astype(np.int64)
    if bits.min() < base or bits.max() > MAX_BITS:
        raise DamagedDataError("points: a class has fewer bits than all share, or too many; the data is damaged")
    gaps = decode_integers(data[start : start + gap_size], count)
    repeated = (gaps == 0).view(np.uint8)
    heads = np.cumsum(gaps, dtype=np.int64)
    if count and (int(heads.max()) >> 3 * base or int(heads.min()) < 0):
        raise DamagedDataError("points: the gaps lead out of the lattice; the data is damaged")
    del gaps
    classes = decode_integers(data[start + gap_size : start + gap_size + class_size], count, repeated)
    if count and int(classes.max()) >= kinds:
        raise DamagedDataError(f"points: class {classes.max()} of {kinds}; the data is damaged")
    classes = classes.astype(np.uint8)
    finer = (3 * (bits - base)).astype(np.uint8)[classes]
    tails = unpack_bits(data[start + gap_size + class_size :], finer)
    heads <<= finer
    heads |= tails.view(np.int64)
    return Points(morton_cells(heads), classes, bits)


def _best_base(codes: np.ndarray, classes: np.ndarray, bits: np.ndarray, finest: int) -> int:
    """How many bits of each axis to order and code by gaps: what an estimate of the bytes says.

    More of them cost about 3 bits a point each, as they do when stored raw, less what is saved in dense places;
    coarse classes pay for bits they have no use for, and where many points share a cell their order is free.
    """
    if len(codes) == 0:
        return 1
    population = np.bincount(classes, minlength=len(bits))
    best, least = 1, np.inf
    for base in range(max(1, min(int(np.log2(len(codes)) / 3) - 1, finest)), finest + 1):
        lengths = np.frexp(np.diff(codes >> 3 * (finest - base), prepend=0).astype(np.float64))[1]
        histogram = np.bincount(lengths)
        share = histogram[histogram > 0] / len(codes)
        # A gap of n bits: its token, about the entropy of n, and n - 1 bits below the highest.
        cost = len(codes) * -(share * np.log2(share)).sum() + np.maximum(lengths - 1, 0).sum()
        cost += 3 * (np.maximum(bits - base, 0) * population).sum()
        if cost < least:
            best, least = base, cost
    return best

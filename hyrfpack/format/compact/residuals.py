"""Coding of residuals (section codec 13): a flag for each Gaussian, and numbers for those that have residuals.

The bytes are: u8 number of classes K, u32 length of the flags in bytes, the stream of flags, for colours the basis
(9 float32), and for each band K step codes, u32 length of its stream in bytes, and the stream.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

from hyrfpack.format.compact.channels import BASIS_BYTES, read_basis
from hyrfpack.format.sections import HARMONICS
from hyrfpack.quant import DamagedDataError
from hyrfpack.quant.integers import decode_integers, encode_integers
from hyrfpack.quant.steps import FIXED_POINT_ONE, MAX_ABS_SYMBOL, decode_step

MAX_RESIDUAL_CLASSES = 16
_HEADER_STRUCT = struct.Struct("<BI")
_LENGTH_STRUCT = struct.Struct("<I")


@dataclass(frozen=True)
class Band:
    """Adjacent columns of residuals whose numbers share steps.

    Attributes:
        width: number of columns.
        components: number of columns that differ in their statistics; column j is of component j mod `components`.
    """

    width: int
    components: int

    def contexts(self, classes: np.ndarray, class_count: int) -> np.ndarray:
        """Return the entropy coding context (M, width) uint8 of each number, given the classes (M,)."""
        offsets = class_count * (np.arange(self.width) % self.components)
        return (classes.astype(np.int64)[:, None] + offsets).astype(np.uint8)


def residual_bands(group: str, columns: int) -> list[Band]:
    """Return the bands of a section: scales and rotations of shapes, or the bands of spherical harmonics."""
    if group != HARMONICS:
        return [Band(2, 2), Band(3, 3)]
    bands = round((columns / 3) ** 0.5)
    return [Band(3 * (2 * degree + 1), 3) for degree in range(bands)]


@dataclass(frozen=True)
class ResidualSymbols:
    """Quantised residuals of a layer.

    Attributes:
        flags: (N,) bool, the Gaussians that have residuals.
        codes: (K,) uint8 step code of each class, for each band.
        symbols: (M, width) int64 for each band, of the M Gaussians with residuals.
    """

    flags: np.ndarray
    codes: list[np.ndarray]
    symbols: list[np.ndarray]

    def coded_components(self, classes: np.ndarray) -> np.ndarray:
        """Return the numbers (M, columns) float64 of the Gaussians with residuals, colours in the basis of the section.

        `classes` (N,) are those of all Gaussians.
        """
        coded_classes = classes[self.flags]
        steps = [decode_step(codes) / FIXED_POINT_ONE for codes in self.codes]
        bands = zip(self.symbols, steps, strict=True)
        return np.concatenate([symbols * step[coded_classes][:, None] for symbols, step in bands], axis=1)

    def values(self, classes: np.ndarray, basis: np.ndarray | None = None) -> np.ndarray:
        """Return the residuals (N, columns) float32 as they will be decoded.

        Args:
            classes: (N,) class of each Gaussian.
            basis: (3, 3) float32 for colours, see `join_colors`.
        """
        components = self.coded_components(classes)
        result = np.zeros((len(classes), components.shape[1]), np.float32)
        result[self.flags] = components if basis is None else join_colors(components, basis)
        return result


def join_colors(numbers: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """Transform the three components (M, 3 K) of each harmonic to red, green and blue, (M, 3 K) float32.

    Products are added in a fixed order, so that every decoder gets the same numbers.
    """
    parts = numbers.reshape(len(numbers), numbers.shape[1] // 3, 3)
    joined = np.empty(parts.shape, np.float32)
    for color in range(3):
        first, second, third = (parts[:, :, j] * float(basis[color, j]) for j in range(3))
        joined[:, :, color] = first + second + third
    return joined.reshape(numbers.shape)


def encode_residuals(
    group: str, residuals: ResidualSymbols, classes: np.ndarray, basis: np.ndarray | None = None
) -> bytes:
    """Encode the residuals of a layer; `classes` (N,) are those of its Gaussians, `basis` is that of colours."""
    class_count = len(residuals.codes[0])
    flags = encode_integers(residuals.flags.astype(np.uint8), classes)
    parts = [_HEADER_STRUCT.pack(class_count, len(flags)), flags]
    if basis is not None:
        parts.append(basis.astype("<f4").tobytes())
    coded_classes = classes[residuals.flags]
    bands = residual_bands(group, sum(symbols.shape[1] for symbols in residuals.symbols))
    for band, codes, symbols in zip(bands, residuals.codes, residuals.symbols, strict=True):
        contexts = band.contexts(coded_classes, class_count).ravel()
        stream = encode_integers(symbols.ravel(), contexts, signed=True)
        parts += [codes.tobytes(), _LENGTH_STRUCT.pack(len(stream)), stream]
    return b"".join(parts)


def decode_residual_symbols(
    group: str, data: memoryview, classes: np.ndarray, columns: int
) -> tuple[ResidualSymbols, np.ndarray | None]:
    """Decode the symbols of a section's residuals, and the basis of colours (None for shapes).

    Args:
        group: section type in the first layer.
        data: stored bytes of the section.
        classes: (N,) class of each Gaussian of the layer.
        columns: number of columns.

    Raises:
        DamagedDataError: the bytes are truncated, damaged or inconsistent.
    """
    source = _ByteSource(data)
    class_count, size = _HEADER_STRUCT.unpack(source.take(_HEADER_STRUCT.size))
    if not int(classes.max(initial=0)) < class_count <= MAX_RESIDUAL_CLASSES:
        raise DamagedDataError(f"it has the steps of {class_count} classes; it is damaged")
    flags = decode_integers(source.take(size), len(classes), classes)
    if flags.max(initial=0) > 1:
        raise DamagedDataError("a flag is neither 0 nor 1; it is damaged")
    flags, basis = flags.astype(bool), None
    if group == HARMONICS:
        basis = read_basis(source.take(BASIS_BYTES))
    coded_classes, all_codes, all_symbols = classes[flags], [], []
    for band in residual_bands(group, columns):
        codes = np.frombuffer(source.take(class_count), np.uint8)
        (size,) = _LENGTH_STRUCT.unpack(source.take(_LENGTH_STRUCT.size))
        contexts = band.contexts(coded_classes, class_count).ravel()
        symbols = decode_integers(source.take(size), len(contexts), contexts, signed=True)
        if symbols.max(initial=0) > MAX_ABS_SYMBOL or symbols.min(initial=0) < -MAX_ABS_SYMBOL:
            raise DamagedDataError(f"a residual is more than {MAX_ABS_SYMBOL} steps; it is damaged")
        all_codes.append(codes)
        all_symbols.append(symbols.reshape(len(coded_classes), band.width))
    if source.remaining_bytes:
        raise DamagedDataError(f"{source.remaining_bytes} bytes follow its last band; it is damaged")
    return ResidualSymbols(flags, all_codes, all_symbols), basis


def decode_residuals(group: str, data: memoryview, classes: np.ndarray, columns: int) -> np.ndarray:
    """Decode residuals (N, columns) float32. Arguments and errors are those of `decode_residual_symbols`."""
    residuals, basis = decode_residual_symbols(group, data, classes, columns)
    return residuals.values(classes, basis)


class _ByteSource:
    """The bytes of a section, which are taken from its start."""

    def __init__(self, data: memoryview) -> None:
        self._data, self._position = data, 0

    def take(self, count: int) -> memoryview:
        """Return the next bytes; raise DamagedDataError if there are fewer."""
        if count > self.remaining_bytes:
            raise DamagedDataError(f"it ends {count - self.remaining_bytes} bytes too early; it is truncated")
        self._position += count
        return self._data[self._position - count : self._position]

    @property
    def remaining_bytes(self) -> int:
        """The number of bytes that have not been taken."""
        return len(self._data) - self._position

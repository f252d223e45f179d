"""Implements multiresolution hash encoding in plain torch for any device and dtype.

This reference defines the correct result.
"""

from __future__ import annotations

import torch
from torch import Tensor

# Instant-ngp's spatial hash is x ^ y * PRIME_Y ^ z * PRIME_Z, in 32-bit unsigned arithmetic.
PRIME_Y = 2654435761
PRIME_Z = 805459861


def level_resolutions(levels: int, base: int, finest: int) -> tuple[int, ...]:
    """Return the vertices per axis of each level, growing geometrically from `base` to `finest`.

        ceil(base * b^l),    b = (finest / base)^(1 / (levels - 1))

    Raises:
        ValueError: `levels` is below 1, `base` is below 2, or `finest` is below `base`.
    """
    if levels < 1 or not 2 <= base <= finest:
        raise ValueError(f"levels={levels}, base={base}, finest={finest}: need levels >= 1 and 2 <= base <= finest")
    growth = (finest / base) ** (1 / max(levels - 1, 1))
    # The subtraction keeps rounding errors of the power from pushing an exact integer up to the next one.
    return tuple(-int(-(base * growth**level - 1e-6) // 1) for level in range(levels))


def level_offsets(resolutions: tuple[int, ...], log2_table_size: int) -> tuple[int, ...]:
    """Return the first row of each level in the flat table, then the number of rows: (levels + 1,).

    A level has min(resolution^3, 2^log2_table_size) rows. It is dense if its vertices fit, and hashed otherwise.
    """
    offsets = [0]
    for resolution in resolutions:
        offsets.append(offsets[-1] + min(resolution**3, 1 << log2_table_size))
    return tuple(offsets)


def cells(coords: Tensor, resolutions: tuple[int, ...]) -> Tensor:
    """Return the cells (N, L, 3), int64 in [0, resolution - 2], of coords (N, 3) in [0, 1] on each level.

    One rounded product and a floor give the same cell on every machine for coordinates of the same dtype.
    """
    spans = torch.tensor([resolution - 1 for resolution in resolutions], device=coords.device)
    x = coords[:, None, :] * spans.to(coords.dtype)[None, :, None]
    return torch.minimum(x.floor().long().clamp(min=0), spans[None, :, None] - 1)


def corner_rows(cells: Tensor, resolutions: tuple[int, ...], log2_table_size: int) -> Tensor:
    """Return the rows of the flat table for the corners of these cells, in integer arithmetic only.

        dense level:   x + r (y + r z)                                       r^3 <= 2^log2_table_size
        hashed level:  (x ^ y * 2654435761 ^ z * 805459861) mod 2^log2_table_size

    Args:
        cells: (N, L, 3) integer, the lowest corner of a cell on each level, in [0, resolution - 2].
        resolutions: (L,) vertices per axis.
        log2_table_size: base-2 logarithm of the maximum number of rows per level.

    Returns:
        (N, L, 8) int64, level offsets included; corner c is at (x + c % 2, y + c // 2 % 2, z + c // 4).
    """
    offsets = level_offsets(resolutions, log2_table_size)
    bits = torch.arange(8, device=cells.device)
    steps = torch.stack([bits & 1, bits >> 1 & 1, bits >> 2], dim=-1)
    rows = torch.empty((*cells.shape[:2], 8), dtype=torch.int64, device=cells.device)
    for level, resolution in enumerate(resolutions):
        x, y, z = (cells[:, level, None, :].long() + steps).unbind(-1)
        if resolution**3 <= 1 << log2_table_size:
            row = x + resolution * (y + resolution * z)
        else:
            # int64 holds the full products. The mask keeps only low bits, which 32-bit overflow does not affect.
            row = (x ^ y * PRIME_Y ^ z * PRIME_Z) & ((1 << log2_table_size) - 1)
        rows[:, level] = row + offsets[level]
    return rows


def hash_encode(coords: Tensor, table: Tensor, resolutions: tuple[int, ...], log2_table_size: int) -> Tensor:
    """Compute `hyrfpack.ops.hash_encode.hash_encode` with torch operations that autograd differentiates."""
    cell = cells(coords.detach(), resolutions)
    rows = corner_rows(cell, resolutions, log2_table_size)
    spans = torch.tensor([resolution - 1 for resolution in resolutions], dtype=coords.dtype, device=coords.device)
    high = coords[:, None, :] * spans[None, :, None] - cell
    sides = torch.stack([1 - high, high])  # (2, N, L, 3)
    features = table.new_zeros(())
    for corner in range(8):
        x, y, z = corner & 1, corner >> 1 & 1, corner >> 2
        weight = sides[x, ..., 0] * sides[y, ..., 1] * sides[z, ..., 2]
        features = features + weight[..., None] * table[rows[..., corner]]
    return features.flatten(1)

"""Binning on the GPU: which Gaussians each tile blends, in depth order.

A pair is one Gaussian in one tile. Pairs are listed Gaussian by Gaussian, nearest first, and then sorted stably by
tile, so that each tile's pairs stay in depth order. A pair's place in the first list is its slot, where its gradient
goes.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import triton
import triton.language as tl
from torch import Tensor

from hyrfpack.ops.gpu_pairs import unpack_pair
from hyrfpack.ops.rasterize.gpu_ellipse import TILE, ellipse, tile_columns, tile_rows
from hyrfpack.ops.rasterize.gpu_project import (
    COVARIANCE,
    MEAN,
    NAMES,
    U_SLOPES,
    V_SLOPE_OPACITY,
    WORDS,
    Projection,
)

PAIRS_MAX = 2**31 - 64  # 32 bits number them, and a little past the end
# A program lists as long as its largest Gaussian takes: few Gaussians a program, in one warp, waste the least.
_BLOCK, _WARPS = 32, 1
_COLUMNS = 8  # tiles of a row listed at once: one Gaussian over thousands of tiles holds nobody up


@dataclass(frozen=True)
class Pairs:
    """The pairs of a picture, tile by tile and in depth order within each. P pairs, tiles row by row.

    Attributes:
        starts: (tiles + 2,) int32 where each tile's pairs begin. One tile more than the picture has holds pairs of no
            tile: what rounding took from a count between counting and listing.
        owners: (P,) int32 the Gaussian of each pair.
        slots: (P,) int64 where each pair stood in the list Gaussian by Gaussian.
        begins: (N,) int32 where each Gaussian's slots begin; not set for what is not drawn.
        nonfinite: names of inputs that are not finite somewhere.
    """

    starts: Tensor
    owners: Tensor
    slots: Tensor
    begins: Tensor
    nonfinite: tuple[str, ...]


@triton.jit(do_not_specialize=["total", "width", "height"])
def _list(
    order, ends, records, total, width, height, tiles, owners, begins, BLOCK: tl.constexpr, COLUMNS: tl.constexpr
):
    """List the pairs Gaussian by Gaussian, in depth order.

    order: (N,) int64 which Gaussian is at which place of the depth order; ends: (N,) int64 where its pairs end.
    tiles (P,), owners (P,) and begins (N,) are written.
    """
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = place < total
    end = tl.load(ends + place, mask=live, other=0)
    at = tl.load(ends + place - 1, mask=live & (place > 0), other=0)
    at = tl.where(live, at, end)
    drawn = at < end
    owner = tl.load(order + place, mask=drawn, other=0)
    tl.store(begins + owner, at.to(tl.int32), mask=drawn)
    record = records + owner * WORDS
    u_x, u_y = unpack_pair(tl.load(record + U_SLOPES, mask=drawn, other=0))
    _, log_opacity = unpack_pair(tl.load(record + V_SLOPE_OPACITY, mask=drawn, other=0))
    x, y = unpack_pair(tl.load(record + MEAN, mask=drawn, other=0))
    xx, yy = unpack_pair(tl.load(record + COVARIANCE, mask=drawn, other=0))
    # Any ellipse in place of none, so that none divides by zero.
    u_y, xx, yy = tl.where(drawn, u_y, 1.0), tl.where(drawn, xx, 1.0), tl.where(drawn, yy, 1.0)
    shape = ellipse(x, y, xx, yy, u_x, u_y, log_opacity)
    top, bottom = tile_rows(shape, height)
    owner = owner.to(tl.int32)
    tiles_x = tl.cdiv(width, TILE)

    row, last = top // TILE, tl.where(drawn, bottom // TILE, -1)
    column = tl.arange(0, COLUMNS)[None, :]
    going = tl.max(last - row, 0) >= 0
    while going:
        first, touched = tile_columns(shape, row, top, bottom, width)
        touched = tl.where(row <= last, touched, 0)
        widest = tl.max(touched, 0)
        start = 0
        while start < widest:
            slot = at[:, None] + (start + column)
            write = (start + column < touched[:, None]) & (slot < end[:, None])
            tile = (row * tiles_x + first)[:, None] + (start + column)
            tl.store(tiles + slot, tile.to(tiles.dtype.element_ty), mask=write)
            tl.store(owners + slot, tl.broadcast_to(owner[:, None], tile.shape), mask=write)
            start += COLUMNS
        at += touched
        row += 1
        going = tl.max(last - row, 0) >= 0

    # Two kernels may round differently. A tile too many was left out above; one too few is a pair of no tile.
    missing = tl.max(end - at, 0)
    while missing > 0:
        no_tile = tiles_x * tl.cdiv(height, TILE) + tl.zeros_like(row)
        tl.store(tiles + at, no_tile.to(tiles.dtype.element_ty), mask=at < end)
        tl.store(owners + at, owner, mask=at < end)
        at += 1
        missing -= 1


def bin_pairs(projection: Projection, width: int, height: int) -> Pairs:
    """Sort Gaussians by depth and list the pairs of each tile. Waits for the device once, to learn how many.

    Raises:
        MemoryError: more than PAIRS_MAX pairs.
    """
    total, device = len(projection.keys), projection.keys.device
    tile_total = -(-width // TILE.value) * -(-height // TILE.value)
    order = torch.sort(projection.keys, stable=True)[1]
    ends = projection.numbers[1:]
    torch.cumsum(projection.counts[order], 0, dtype=torch.int64, out=ends)
    bits, count = projection.numbers[::total].tolist() if total else (0, 0)
    if count > PAIRS_MAX:
        raise MemoryError(f"{count} pairs of a Gaussian and a tile; at most {PAIRS_MAX} can be drawn")

    begins = torch.empty(total, dtype=torch.int32, device=device)
    owners = torch.empty(count, dtype=torch.int32, device=device)
    # 16 bits where they do: a radix sort then takes half the passes.
    kind = torch.int16 if tile_total + 1 < 2**15 else torch.int32
    tiles = torch.empty(count, dtype=kind, device=device)
    if count:
        _list[(triton.cdiv(total, _BLOCK),)](
            order, ends, projection.records, total, width, height, tiles, owners, begins,
            BLOCK=_BLOCK, COLUMNS=_COLUMNS, num_warps=_WARPS, enable_fp_fusion=True,
        )  # fmt: skip
    tiles, slots = torch.sort(tiles, stable=True)
    edges = torch.arange(tile_total + 2, dtype=kind, device=device)
    starts = torch.searchsorted(tiles, edges, out_int32=True)
    nonfinite = tuple(name for bit, name in enumerate(NAMES) if bits >> bit & 1)
    return Pairs(starts, owners[slots], slots, begins, nonfinite)

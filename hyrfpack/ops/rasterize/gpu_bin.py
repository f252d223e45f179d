"""Bins Gaussians into tiles on the GPU: lists the Gaussians that each tile blends, in depth order.

A pair is one Gaussian in one tile. Pairs are first listed Gaussian by Gaussian, nearest first. They are then sorted
stably by tile, so that each tile's pairs stay in depth order. The index of a pair in the first list is its slot, to
which backward writes the pair's gradient.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import triton
import triton.language as tl
from torch import Tensor

from hyrfpack.ops.gpu_pairs import unpack_pair
from hyrfpack.ops.rasterize.gpu_ellipse import TILE_SIZE, make_ellipse, touched_pixel_rows, touched_tile_columns
from hyrfpack.ops.rasterize.gpu_project import (
    COVARIANCE_XX_YY,
    FLAGGED_INPUTS,
    MEAN_XY,
    RECORD_WORDS,
    U_SLOPES,
    V_SLOPE_OPACITY,
    Projection,
)

MAX_PAIRS = 2**31 - 64  # Indices of pairs are int32, and loops may count slightly past the end.
# A program takes as long as its largest Gaussian. Few Gaussians per program, in one warp, therefore waste least time.
_GAUSSIANS_PER_PROGRAM = 32
_WARPS_PER_PROGRAM = 1
# Tiles of a row are stored in groups of this size, so that one Gaussian over thousands of tiles does not delay others.
_TILES_PER_STORE = 8


@dataclass(frozen=True)
class Pairs:
    """The P pairs of an image, ordered by tile (row by row) and, within a tile, by depth.

    Attributes:
        tile_starts: (tiles + 2,) int32, the first pair of each tile. An extra tile after the last holds pairs without
            a tile. These were counted but not listed, because the two kernels rounded differently.
        owners: (P,) int32, the Gaussian of each pair.
        slots: (P,) int64, the slot of each pair.
        slot_starts: (N,) int32, the first slot of each Gaussian; undefined for Gaussians that are not drawn.
        nonfinite: names of the inputs that contain NaN or infinity; empty if pairs are reserved.
        demand: None, or if pairs are reserved, (2,) int64: the bits of inputs that contain NaN or infinity, in the
            order of FLAGGED_INPUTS, and the number of pairs, which may exceed the reserve.
    """

    tile_starts: Tensor
    owners: Tensor
    slots: Tensor
    slot_starts: Tensor
    nonfinite: tuple[str, ...]
    demand: Tensor | None


@triton.jit(do_not_specialize=["total", "width", "height", "capacity"])
def _list_pairs_kernel(
    order,
    ends,
    records,
    counts,
    total,
    width,
    height,
    capacity,
    tiles,
    owners,
    slot_starts,
    BLOCK: tl.constexpr,
    TILES_PER_STORE: tl.constexpr,
):
    """List the pairs Gaussian by Gaussian, in depth order.

    Args:
        order: (N,) int64, the Gaussian at each position of the depth order.
        ends: (N,) int64, the end of that Gaussian's slots.
        counts: (N,) int32, the number of tiles of each Gaussian; set to 0 for one whose slots would exceed `capacity`.
            It is not drawn.
        tiles, owners: (P,), written: the tile and the Gaussian of each slot.
        slot_starts: (N,), written: the first slot of each Gaussian.
    """
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = place < total
    end = tl.load(ends + place, mask=live, other=0)
    at = tl.load(ends + place - 1, mask=live & (place > 0), other=0)
    drawn = live & (at < end)
    owner = tl.load(order + place, mask=drawn, other=0)
    has_room = end <= capacity
    tl.store(counts + owner, tl.zeros([BLOCK], tl.int32), mask=drawn & (has_room == 0))
    drawn &= has_room
    at = tl.where(drawn, at, end)
    tl.store(slot_starts + owner, at.to(tl.int32), mask=drawn)
    record = records + owner * RECORD_WORDS
    u_x, u_y = unpack_pair(tl.load(record + U_SLOPES, mask=drawn, other=0))
    _, log_opacity = unpack_pair(tl.load(record + V_SLOPE_OPACITY, mask=drawn, other=0))
    x, y = unpack_pair(tl.load(record + MEAN_XY, mask=drawn, other=0))
    xx, yy = unpack_pair(tl.load(record + COVARIANCE_XX_YY, mask=drawn, other=0))
    # Gaussians that are not drawn get some valid ellipse, so that nothing divides by zero.
    u_y, xx, yy = tl.where(drawn, u_y, 1.0), tl.where(drawn, xx, 1.0), tl.where(drawn, yy, 1.0)
    shape = make_ellipse(x, y, xx, yy, u_x, u_y, log_opacity)
    top, bottom = touched_pixel_rows(shape, height)
    owner = owner.to(tl.int32)
    tiles_x = tl.cdiv(width, TILE_SIZE)

    row, last = top // TILE_SIZE, tl.where(drawn, bottom // TILE_SIZE, -1)
    column = tl.arange(0, TILES_PER_STORE)[None, :]
    unfinished = tl.max(last - row, 0) >= 0
    while unfinished:
        first, touched = touched_tile_columns(shape, row, top, bottom, width)
        touched = tl.where(row <= last, touched, 0)
        widest = tl.max(touched, 0)
        start = 0
        while start < widest:
            slot = at[:, None] + (start + column)
            write = (start + column < touched[:, None]) & (slot < end[:, None])
            tile = (row * tiles_x + first)[:, None] + (start + column)
            tl.store(tiles + slot, tile.to(tiles.dtype.element_ty), mask=write)
            tl.store(owners + slot, tl.broadcast_to(owner[:, None], tile.shape), mask=write)
            start += TILES_PER_STORE
        at += touched
        row += 1
        unfinished = tl.max(last - row, 0) >= 0

    # Counting and listing may round differently. A surplus tile was skipped above; a missing one becomes a pair without
    # a tile.
    missing = tl.max(end - at, 0)
    while missing > 0:
        no_tile = tiles_x * tl.cdiv(height, TILE_SIZE) + tl.zeros_like(row)
        tl.store(tiles + at, no_tile.to(tiles.dtype.element_ty), mask=at < end)
        tl.store(owners + at, owner, mask=at < end)
        at += 1
        missing -= 1


def bin_pairs(projection: Projection, width: int, height: int, reserve: int | None) -> Pairs:
    """Sort Gaussians by depth and list the pairs of each tile.

    Args:
        reserve: number of pairs that get memory; Gaussians without room in it are not drawn. None synchronises with
            the device once, to read the number of pairs.

    Raises:
        MemoryError: there are more than MAX_PAIRS pairs.
    """
    total, device = len(projection.keys), projection.keys.device
    tile_total = -(-width // TILE_SIZE.value) * -(-height // TILE_SIZE.value)
    order = torch.sort(projection.keys, stable=True)[1]
    ends = projection.flags_and_ends[1:]
    torch.cumsum(projection.counts[order], 0, dtype=torch.int64, out=ends)
    demand = projection.flags_and_ends[::total] if total else projection.flags_and_ends.new_zeros(2)
    bits, count = demand.tolist() if reserve is None else (0, reserve)
    if count > MAX_PAIRS:
        raise MemoryError(f"{count} pairs of a Gaussian and a tile; at most {MAX_PAIRS} can be drawn")

    slot_starts = torch.empty(total, dtype=torch.int32, device=device)
    owners = torch.empty(count, dtype=torch.int32, device=device)
    # Tiles are int16 if that is enough, so that the radix sort needs half the passes.
    kind = torch.int16 if tile_total + 1 < 2**15 else torch.int32
    tiles = torch.empty(count, dtype=kind, device=device)
    if reserve is not None:
        tiles.fill_(tile_total + 1)  # Surplus slots lie behind those of all tiles.
    if total:
        _list_pairs_kernel[(triton.cdiv(total, _GAUSSIANS_PER_PROGRAM),)](
            order, ends, projection.records, projection.counts, total, width, height, count,
            tiles, owners, slot_starts,
            BLOCK=_GAUSSIANS_PER_PROGRAM, TILES_PER_STORE=_TILES_PER_STORE,
            num_warps=_WARPS_PER_PROGRAM, enable_fp_fusion=True,
        )  # fmt: skip
    tiles, slots = torch.sort(tiles, stable=True)
    edges = torch.arange(tile_total + 2, dtype=kind, device=device)
    tile_starts = torch.searchsorted(tiles, edges, out_int32=True)
    nonfinite = tuple(name for bit, name in enumerate(FLAGGED_INPUTS) if bits >> bit & 1)
    return Pairs(tile_starts, owners[slots], slots, slot_starts, nonfinite, None if reserve is None else demand)

"""Sorts Gaussians by depth and bins them into tiles, in compiled code.

A pair is one Gaussian in one tile, packed into a uint64. It consists of the Gaussian's position in the depth order, the
pair's slot, and the first and last pixel row of the tile that the Gaussian touches. Slots number all pairs Gaussian by
Gaussian; backward writes a pair's gradient to its slot.
"""

from __future__ import annotations

import math

import numpy as np

from hyrfpack.ops.rasterize.cpu_project import (
    COV_XX,
    COV_YY,
    HIDDEN_KEY,
    MEAN_X,
    MEAN_Y,
    REACH,
    RECORD_FLOATS,
    U_X,
    U_Y,
)
from hyrfpack.ops.rasterize.reference import TILE_SIZE
from hyrfpack.parallel.compiled import compiled

# Layout of a pair from the lowest bit: 4 bits first row, 4 bits last row, 28 bits slot, 28 bits position.
MAX_PAIRS = 1 << 28
SLOT_SHIFT_BITS = np.uint64(8)
POSITION_SHIFT_BITS = np.uint64(36)
SLOT_MASK = np.uint64(MAX_PAIRS - 1)

_MAX_RADIX_BITS = 11
_POSITIONS_PER_BLOCK = 64
# Spans are widened by this margin against rounding errors. Too wide a span is harmless, because blending tests alpha.
_SPAN_MARGIN_PIXELS = 0.01
_kernel = compiled(fastmath={"contract", "nsz", "nnan"}, error_model="numpy")


@_kernel
def sort_by_depth(keys):
    """Return the positions of the keys other than HIDDEN_KEY, sorted by key and then by position (radix sort)."""
    low, high, count = HIDDEN_KEY, np.uint32(0), 0
    for key in keys:
        if key != HIDDEN_KEY:
            low, high, count = min(low, key), max(high, key), count + 1
    items, other = np.empty(count, np.uint64), np.empty(count, np.uint64)
    at = 0
    for i in range(len(keys)):
        if keys[i] != HIDDEN_KEY:
            items[at] = (np.uint64(keys[i] - low) << np.uint64(32)) | np.uint64(i)
            at += 1
    bits = 0
    while count > 0 and (np.uint64(high - low) >> np.uint64(bits)) > 0:
        bits += 1
    passes = (bits + _MAX_RADIX_BITS - 1) // _MAX_RADIX_BITS
    width = (bits + passes - 1) // max(passes, 1)
    mask = np.uint64((1 << width) - 1)
    for turn in range(passes):
        shift = np.uint64(32 + turn * width)
        offsets = np.zeros((1 << width) + 1, np.int64)
        for item in items:
            offsets[((item >> shift) & mask) + np.uint64(1)] += 1
        for digit in range(1 << width):
            offsets[digit + 1] += offsets[digit]
        for item in items:
            digit = (item >> shift) & mask
            other[np.uint64(offsets[digit])] = item
            offsets[digit] += 1
        items, other = other, items
    order = np.empty(count, np.uint32)
    for i in range(count):
        order[i] = np.uint32(items[i] & np.uint64(0xFFFFFFFF))
    return order


@_kernel
def _span(center, slope, rest, reach, inv_var, turn, low, high):
    """Compute the extent along one axis of an ellipse that is cut to a slab of the other axis.

    The points at offset t along the slab's axis span slope t +- sqrt(rest (reach - t^2 inv_var)). The extremes of the
    whole ellipse lie at t = +-turn.

    Returns:
        The lowest and highest coordinate, widened by a small margin.
    """
    t = min(max(turn, low), high)
    up = slope * t + math.sqrt(rest * max(reach - t * t * inv_var, 0.0))
    t = min(max(-turn, low), high)
    down = slope * t - math.sqrt(rest * max(reach - t * t * inv_var, 0.0))
    return center + down - _SPAN_MARGIN_PIXELS, center + up + _SPAN_MARGIN_PIXELS


@_kernel
def _pixel_range(low, high, last):
    """Return the first and last pixel in 0 to last whose centre, minus half a pixel, lies in [low, high].

    The first exceeds the last if there is none. Bounds are clamped as floats, because they may exceed every integer.
    """
    first = math.ceil(min(max(low, 0.0), last + 1.0))
    return np.int64(first), np.int64(math.floor(max(min(high, np.float64(last)), -1.0)))


@_kernel
def find_pairs(
    start, stop, order, tile_count_bounds, records, width, height, max_pairs, tile_counts, pair_counts, sorted_records
):  # fmt: skip
    """List the tiles that each Gaussian touches, for positions start to stop of the depth order.

    A pair is listed if the ellipse alpha >= 1/255 meets the rectangle spanned by the tile's pixel centres.

    Args:
        max_pairs: the search ends after so many pairs.
        tile_counts: (tiles,) number of pairs in each tile; incremented.
        pair_counts: (N,) number of pairs of each Gaussian; written for Gaussians in `order`.
        sorted_records: (V, 16) the records in depth order; written.

    Returns:
        (pairs,) tiles and (pairs,) rows, ordered by position. rows = first + 16 last are the pixel rows of the tile
        that the Gaussian touches.
    """
    capacity = 0
    for position in range(np.uint64(start), np.uint64(stop)):
        capacity += np.int64(tile_count_bounds[order[position]])
    capacity = min(capacity, max_pairs)
    tiles, rows = np.empty(capacity, np.uint32), np.empty(capacity, np.uint8)
    tiles_x = (width + TILE_SIZE - 1) // TILE_SIZE
    at = 0
    for block in range(start, stop, _POSITIONS_PER_BLOCK):
        # Records are copied in blocks, because loading several at once hides the latency of memory.
        block_stop = min(block + _POSITIONS_PER_BLOCK, stop)
        for position in range(np.uint64(block), np.uint64(block_stop)):
            source = np.uint64(order[position])
            for field in range(np.uint64(RECORD_FLOATS)):
                sorted_records[position, field] = records[source, field]
        for position in range(np.uint64(block), np.uint64(block_stop)):
            begin = at
            record = sorted_records[position]
            x, y, reach = np.float64(record[MEAN_X]) - 0.5, np.float64(record[MEAN_Y]) - 0.5, np.float64(record[REACH])
            xx, yy, u_x = np.float64(record[COV_XX]), np.float64(record[COV_YY]), np.float64(record[U_X])
            inv_xx, inv_yy = 1 / xx, 1 / yy
            extent_x, extent_y = math.sqrt(reach * xx), math.sqrt(reach * yy)
            top, bottom = _pixel_range(
                y - extent_y - _SPAN_MARGIN_PIXELS, y + extent_y + _SPAN_MARGIN_PIXELS, height - 1
            )
            # slope = xy / yy and rest = det / yy (likewise for y) are not computed from xx yy - xy^2, which cancels on
            # needles.
            slope_x, rest_x = -np.float64(record[U_Y]) / u_x, 0.0625 / (u_x * u_x)
            slope_y, rest_y = slope_x * yy * inv_xx, rest_x * yy * inv_xx
            # turn_x is dx at the largest dy; turn_y is dy at the largest dx.
            turn_x, turn_y = slope_x * extent_y, slope_y * extent_x
            for tile_y in range(top // TILE_SIZE, bottom // TILE_SIZE + 1):
                high_row, low_row = max(top, tile_y * TILE_SIZE), min(bottom, tile_y * TILE_SIZE + TILE_SIZE - 1)
                near, far = max(high_row - y, -extent_y), min(low_row - y, extent_y)
                low, high = _span(x, slope_x, rest_x, reach, inv_yy, turn_y, near, far)
                left, right = _pixel_range(low, high, width - 1)
                if left > right:
                    continue
                for tile_x in range(left // TILE_SIZE, right // TILE_SIZE + 1):
                    near = max(max(left, tile_x * TILE_SIZE) - x, -extent_x)
                    far = min(min(right, tile_x * TILE_SIZE + TILE_SIZE - 1) - x, extent_x)
                    low, high = _span(y, slope_y, rest_y, reach, inv_xx, turn_x, near, far)
                    first, last = _pixel_range(low, high, low_row)
                    first = max(first, high_row)
                    if first > last or at >= capacity:
                        continue
                    tile = np.uint64(tile_y * tiles_x + tile_x)
                    tiles[at] = tile
                    rows[at] = (first - tile_y * TILE_SIZE) + 16 * (last - tile_y * TILE_SIZE)
                    tile_counts[tile] += 1
                    at += 1
            pair_counts[order[position]] = at - begin
    return tiles[:at], rows[:at]


@_kernel
def assign_chunk_offsets(tile_counts, tile_starts):
    """Replace the pair counts (chunks, tiles) by the index of each chunk's first pair in each tile.

    Writes the first pair of each tile to tile_starts (tiles + 1,).
    """
    at = 0
    for tile in range(tile_counts.shape[1]):
        tile_starts[tile] = at
        for chunk in range(tile_counts.shape[0]):
            count = tile_counts[chunk, tile]
            tile_counts[chunk, tile] = at
            at += count
    tile_starts[tile_counts.shape[1]] = at


@_kernel
def fill_tiles(start, stop, order, slot_starts, tiles, rows, offsets, pairs):
    """Write one chunk's pairs to their tiles, keeping their order.

    Args:
        slot_starts: (N + 1,) the first slot of each Gaussian.
        offsets: (tiles,) the index in `pairs` of the chunk's next pair in each tile; incremented.
        pairs: (P,) uint64, written.
    """
    source = np.uint64(0)
    for position in range(np.uint64(start), np.uint64(stop)):
        i = np.uint64(order[position])
        head = position << POSITION_SHIFT_BITS
        for slot in range(np.uint64(slot_starts[i]), np.uint64(slot_starts[i + np.uint64(1)])):
            tile = np.uint64(tiles[source])
            at = np.uint64(offsets[tile])
            offsets[tile] += 1
            pairs[at] = head | (slot << SLOT_SHIFT_BITS) | np.uint64(rows[source])
            source += np.uint64(1)

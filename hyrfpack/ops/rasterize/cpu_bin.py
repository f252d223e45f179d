"""Compiled sorting and binning: which Gaussians each tile blends, in depth order.

A pair is one Gaussian in one tile, packed in a uint64: its position in the depth order, its slot in the list of all
pairs Gaussian by Gaussian (where its gradient goes), and the tile's first and last pixel row that it touches.
"""

from __future__ import annotations

import math

import numpy as np

from hyrfpack.ops.rasterize.cpu_project import COV_XX, COV_YY, HIDDEN, MEAN_X, MEAN_Y, REACH, RECORD, U_X, U_Y
from hyrfpack.ops.rasterize.reference import TILE
from hyrfpack.parallel.compiled import compiled

# From the low end: 4 bits first row, 4 bits last row, 28 bits slot, 28 bits position.
PAIRS_MAX = 1 << 28
SLOT_SHIFT, POSITION_SHIFT = np.uint64(8), np.uint64(36)
SLOT_MASK = np.uint64(PAIRS_MAX - 1)

_DIGIT_BITS = 11
_BLOCK = 64
_PAD = 0.01  # pixels by which spans are widened against rounding; blending decides pixel by pixel
_kernel = compiled(fastmath={"contract", "nsz", "nnan"}, error_model="numpy")


@_kernel
def sort_by_depth(keys):
    """Positions of the keys that are not HIDDEN, in ascending order of key and then of position (radix sort)."""
    low, high, count = HIDDEN, np.uint32(0), 0
    for key in keys:
        if key != HIDDEN:
            low, high, count = min(low, key), max(high, key), count + 1
    items, other = np.empty(count, np.uint64), np.empty(count, np.uint64)
    at = 0
    for i in range(len(keys)):
        if keys[i] != HIDDEN:
            items[at] = (np.uint64(keys[i] - low) << np.uint64(32)) | np.uint64(i)
            at += 1
    bits = 0
    while count > 0 and (np.uint64(high - low) >> np.uint64(bits)) > 0:
        bits += 1
    passes = (bits + _DIGIT_BITS - 1) // _DIGIT_BITS
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
    """The extent along one axis of an ellipse cut to a slab of the other axis.

    The points at offset t along the slab's axis span slope t +- sqrt(rest (reach - t^2 inv_var)); the ellipse is
    widest at t = +-turn.

    Returns:
        Lowest and highest coordinate, slightly padded.
    """
    t = min(max(turn, low), high)
    up = slope * t + math.sqrt(rest * max(reach - t * t * inv_var, 0.0))
    t = min(max(-turn, low), high)
    down = slope * t - math.sqrt(rest * max(reach - t * t * inv_var, 0.0))
    return center + down - _PAD, center + up + _PAD


@_kernel
def _pixels(low, high, last):
    """The pixels 0 to last, as integers, whose centres lie in [low, high] (given less half a pixel)."""
    return np.int64(math.ceil(max(low, 0.0))), np.int64(math.floor(min(high, np.float64(last))))


@_kernel
def find_pairs(start, stop, order, boxes, records, width, height, tile_counts, pair_counts, sorted_records):
    """List the tiles that each Gaussian touches, for positions start to stop of the depth order.

    A pair is kept where the ellipse alpha >= 1/255 meets the rectangle spanned by the tile's pixel centres.

    Args:
        tile_counts: (tiles,) pairs in each tile, added to.
        pair_counts: (N,) pairs of each Gaussian, written where it is in `order`.
        sorted_records: (V, 16) the records in depth order, written.

    Returns:
        (pairs,) tiles and (pairs,) rows, position by position; rows = first + 16 last, the tile's pixel rows touched.
    """
    capacity = 0
    for position in range(np.uint64(start), np.uint64(stop)):
        capacity += np.int64(boxes[order[position]])
    tiles, rows = np.empty(capacity, np.uint32), np.empty(capacity, np.uint8)
    tiles_x = (width + TILE - 1) // TILE
    at = 0
    for block in range(start, stop, _BLOCK):
        # In blocks, because fetching several records at once hides the latency of memory.
        block_stop = min(block + _BLOCK, stop)
        for position in range(np.uint64(block), np.uint64(block_stop)):
            source = np.uint64(order[position])
            for field in range(np.uint64(RECORD)):
                sorted_records[position, field] = records[source, field]
        for position in range(np.uint64(block), np.uint64(block_stop)):
            begin = at
            record = sorted_records[position]
            x, y, reach = np.float64(record[MEAN_X]) - 0.5, np.float64(record[MEAN_Y]) - 0.5, np.float64(record[REACH])
            xx, yy, u_x = np.float64(record[COV_XX]), np.float64(record[COV_YY]), np.float64(record[U_X])
            inv_xx, inv_yy = 1 / xx, 1 / yy
            extent_x, extent_y = math.sqrt(reach * xx), math.sqrt(reach * yy)
            top, bottom = _pixels(y - extent_y - _PAD, y + extent_y + _PAD, height - 1)
            # Not from xx yy - xy^2, which cancels on needles: slope = xy / yy, rest = det / yy; likewise for y.
            slope_x, rest_x = -np.float64(record[U_Y]) / u_x, 0.0625 / (u_x * u_x)
            slope_y, rest_y = slope_x * yy * inv_xx, rest_x * yy * inv_xx
            turn_x, turn_y = slope_x * extent_y, slope_y * extent_x  # dx at the largest dy, dy at the largest dx
            for tile_y in range(top // TILE, bottom // TILE + 1):
                high_row, low_row = max(top, tile_y * TILE), min(bottom, tile_y * TILE + TILE - 1)
                near, far = max(high_row - y, -extent_y), min(low_row - y, extent_y)
                low, high = _span(x, slope_x, rest_x, reach, inv_yy, turn_y, near, far)
                left, right = _pixels(low, high, width - 1)
                if left > right:
                    continue
                for tile_x in range(left // TILE, right // TILE + 1):
                    near = max(max(left, tile_x * TILE) - x, -extent_x)
                    far = min(min(right, tile_x * TILE + TILE - 1) - x, extent_x)
                    low, high = _span(y, slope_y, rest_y, reach, inv_xx, turn_x, near, far)
                    first, last = _pixels(low, high, low_row)
                    first = max(first, high_row)
                    if first > last or at >= capacity:
                        continue
                    tile = np.uint64(tile_y * tiles_x + tile_x)
                    tiles[at] = tile
                    rows[at] = (first - tile_y * TILE) + 16 * (last - tile_y * TILE)
                    tile_counts[tile] += 1
                    at += 1
            pair_counts[order[position]] = at - begin
    return tiles[:at], rows[:at]


@_kernel
def place_chunks(tile_counts, tile_starts):
    """Turn (chunks, tiles) counts into where each chunk's pairs of each tile go; fill tile_starts (tiles + 1,)."""
    at = 0
    for tile in range(tile_counts.shape[1]):
        tile_starts[tile] = at
        for chunk in range(tile_counts.shape[0]):
            count = tile_counts[chunk, tile]
            tile_counts[chunk, tile] = at
            at += count
    tile_starts[tile_counts.shape[1]] = at


@_kernel
def fill_tiles(start, stop, order, first, tiles, rows, offsets, pairs):
    """Put one chunk's pairs into their tiles, keeping their order.

    first: (N + 1,) where each Gaussian's slots begin; offsets: (tiles,) where the chunk's next pair of each tile goes,
    advanced; pairs: (P,) uint64, written.
    """
    source = np.uint64(0)
    for position in range(np.uint64(start), np.uint64(stop)):
        i = np.uint64(order[position])
        head = position << POSITION_SHIFT
        for slot in range(np.uint64(first[i]), np.uint64(first[i + np.uint64(1)])):
            tile = np.uint64(tiles[source])
            at = np.uint64(offsets[tile])
            offsets[tile] += 1
            pairs[at] = head | (slot << SLOT_SHIFT) | np.uint64(rows[source])
            source += np.uint64(1)

"""Blends on the GPU, forward and backward, with one program per tile.

A tile's 256 pixels are a block (ROWS, LANES). A thread owns one column of the block, whose pixels share one x. It
computes v, which depends on x alone, and all that depends on the Gaussian alone, once for all its pixels. Records are
loaded as scalars, the same for all threads, and for a chunk of Gaussians at once, so that latencies overlap.
"""

from __future__ import annotations

import math

import triton
import triton.language as tl

from hyrfpack.ops.gpu_pairs import pack_pair
from hyrfpack.ops.rasterize import reference
from hyrfpack.ops.rasterize.gpu_ellipse import LOG2_ALPHA_MIN, TILE_SIZE
from hyrfpack.ops.rasterize.gpu_project import (
    BLUE_DEPTH,
    CONSTANT_TERMS,
    GRADIENT_ROW_FLOATS,
    RECORD_WORDS,
    RED_GREEN,
    REFERENCE_MEAN,
    SUM_ABS_Y,
    SUM_BLUE,
    U_SLOPES,
    V_SLOPE_OPACITY,
)

_LANES_PER_BLOCK = tl.constexpr(32)
_ROWS_PER_BLOCK = tl.constexpr(reference.TILE_SIZE**2 // 32)
_ALPHA_MAX = tl.constexpr(reference.ALPHA_MAX)
_LOG2_ALPHA_MAX = tl.constexpr(math.log2(reference.ALPHA_MAX))
# A finite number replaces log2(0), the logarithm of opacity 0.
_LOG2_ZERO_OPACITY = tl.constexpr(-1e30)
_ROWS_CLEARED_PER_STORE = tl.constexpr(32)
# A tile has one warp with 8 pixels per thread. On sm_90 (Triton 3.7.1) forward then takes 141 instructions per pair;
# two warps would take 174, since both load everything. Backward takes 467; two warps would take 792 and 24 barriers,
# since each of its sums crosses the warps. At 80 to 100 registers per thread, 20 to 25 tiles share a multiprocessor,
# which is enough to hide the latency of a chunk's loads.
WARPS_PER_TILE = 1


@triton.jit
def _tile_pixels(tile, width, height):
    """Compute the pixels of a tile.

    Returns:
        x, y: (LANES,) centres of the pixels in the first row of the block.
        row: (ROWS, 1) the offsets in y of all rows of the block.
        place, inside: (256,) their indices in the image, and whether they lie inside it. These are flat, because with
            2-D loads and stores the compiler would choose another layout for the loop.
    """
    left, top = (tile % tl.cdiv(width, TILE_SIZE)) * TILE_SIZE, (tile // tl.cdiv(width, TILE_SIZE)) * TILE_SIZE
    pixel = tl.arange(0, TILE_SIZE * TILE_SIZE)
    x, y = left + pixel % TILE_SIZE, top + pixel // TILE_SIZE
    inside = (x < width) & (y < height)
    place = y.to(tl.int64) * width + x
    lane = tl.arange(0, _LANES_PER_BLOCK)
    first_x, first_y = (left + lane % TILE_SIZE).to(tl.float32) + 0.5, (top + lane // TILE_SIZE).to(tl.float32) + 0.5
    row = (tl.arange(0, _ROWS_PER_BLOCK) * (_LANES_PER_BLOCK // TILE_SIZE)).to(tl.float32)[:, None]
    return first_x, first_y, row, place, inside


@triton.jit
def _load_pixels(pointer, inside):
    """Load a block (ROWS, LANES) from flat pointers, 0 outside the image."""
    return tl.reshape(tl.load(pointer, mask=inside, other=0.0), [_ROWS_PER_BLOCK, _LANES_PER_BLOCK])


@triton.jit
def _store_pixels(pointer, values, inside):
    """Store a block (ROWS, LANES) to flat pointers where inside the image."""
    tl.store(pointer, tl.reshape(values, [_ROWS_PER_BLOCK * _LANES_PER_BLOCK]), mask=inside)


@triton.jit
def _load_record(records, owner, live):
    """Load the numbers of a record; the opacity is 0 unless `live`."""
    at = records + owner.to(tl.int64) * RECORD_WORDS
    # All words are loaded before the first is used, so that their latencies overlap. They are unpacked inline, since
    # calls of `unpack_pair` are slow in Triton's interpreter.
    ref, offset, slopes = tl.load(at + REFERENCE_MEAN), tl.load(at + CONSTANT_TERMS), tl.load(at + U_SLOPES)
    opacity, color, depth = tl.load(at + V_SLOPE_OPACITY), tl.load(at + RED_GREEN), tl.load(at + BLUE_DEPTH)
    log_opacity = (opacity >> 32).to(tl.int32).to(tl.float32, bitcast=True)
    return (
        ref.to(tl.int32).to(tl.float32, bitcast=True),
        (ref >> 32).to(tl.int32).to(tl.float32, bitcast=True),
        offset.to(tl.int32).to(tl.float32, bitcast=True),
        (offset >> 32).to(tl.int32).to(tl.float32, bitcast=True),
        slopes.to(tl.int32).to(tl.float32, bitcast=True),
        (slopes >> 32).to(tl.int32).to(tl.float32, bitcast=True),
        opacity.to(tl.int32).to(tl.float32, bitcast=True),
        tl.where(live, log_opacity, _LOG2_ZERO_OPACITY),
        color.to(tl.int32).to(tl.float32, bitcast=True),
        (color >> 32).to(tl.int32).to(tl.float32, bitcast=True),
        depth.to(tl.int32).to(tl.float32, bitcast=True),
        (depth >> 32).to(tl.int32).to(tl.float32, bitcast=True),
    )


@triton.jit
def _attenuate(record, x, y, row, transmittance_min, remaining):
    """Compute how one pair attenuates the light, for both passes.

    Both kernels round alike here, however the compiler fuses operations in each of them: a product that is added to
    something is an explicit fma, or a select stands in between. So the backward pass replays exactly the transmittance
    of the forward pass, and the same pixels are above the thresholds of alpha and transmittance.

    Returns:
        u: (ROWS, LANES); v: (LANES,); log2 of the unclamped alpha: (ROWS, LANES).
        is_blended: (ROWS, LANES), whether the pixel is above both thresholds.
        alpha: (ROWS, LANES), clamped.
        weight: (ROWS, LANES), the light that the pair takes; the rest, `remaining - weight`, lies behind it.
    """
    ref_x, ref_y, u_0, v_0, u_x, u_y, v_x, log_opacity, _, _, _, _ = record
    dx = x - ref_x
    v = tl.fma(v_x, dx, v_0)
    u_first = tl.fma(u_y, y - ref_y, tl.fma(u_x, dx, u_0))
    u = tl.fma(u_y, row, u_first[None, :])
    log2_alpha = tl.fma(-u, u, tl.fma(-v, v, log_opacity)[None, :])
    is_blended = (log2_alpha >= LOG2_ALPHA_MIN) & (remaining > transmittance_min)
    alpha = tl.minimum(tl.exp2(log2_alpha), _ALPHA_MAX)
    return u, v, log2_alpha, is_blended, alpha, tl.where(is_blended, alpha * remaining, 0.0)


@triton.jit
def _blend_pair(record, x, y, row, transmittance_min, remaining, red, green, blue, depth, DEPTH: tl.constexpr):
    """Blend one pair; returns the remaining transmittance and the accumulated values."""
    _, _, _, _, _, weight = _attenuate(record, x, y, row, transmittance_min, remaining)
    red += weight * record[8]
    green += weight * record[9]
    blue += weight * record[10]
    if DEPTH:
        depth += weight * record[11]
    return remaining - weight, red, green, blue, depth


@triton.jit(do_not_specialize=["width", "height"])
def blend(
    starts, owners, records, width, height, transmittance_min, rgb, transmittance, depths, blended, DEPTH: tl.constexpr
):
    """Blend one tile into rgb (H, W, 3), transmittance (H, W) and, if DEPTH, depths (H, W).

    Args:
        starts, owners: `tile_starts` and `owners` of `gpu_bin.Pairs`.
        blended: (tiles,) int32, written: the number of pairs after which each tile was finished.
    """
    tile = tl.program_id(0)
    x, y, row, place, inside = _tile_pixels(tile, width, height)
    # T < 0 marks a pixel outside the image; nothing is blended there, as in a finished pixel.
    remaining = tl.reshape(tl.where(inside, 1.0, -1.0), [_ROWS_PER_BLOCK, _LANES_PER_BLOCK])
    red, green, blue = tl.zeros_like(remaining), tl.zeros_like(remaining), tl.zeros_like(remaining)
    depth = tl.zeros_like(remaining)
    begin, end = tl.load(starts + tile), tl.load(starts + tile + 1)
    at = begin
    unfinished = at < end
    # The owners of the next chunk are loaded before this one is processed. Past the end the last owner is repeated,
    # because the records of Gaussians that are not drawn are undefined.
    owner_0 = tl.load(owners + at, mask=unfinished, other=0)
    owner_1 = tl.load(owners + tl.minimum(at + 1, end - 1), mask=unfinished, other=0)
    owner_2 = tl.load(owners + tl.minimum(at + 2, end - 1), mask=unfinished, other=0)
    owner_3 = tl.load(owners + tl.minimum(at + 3, end - 1), mask=unfinished, other=0)
    while unfinished:
        record_0, record_1 = _load_record(records, owner_0, True), _load_record(records, owner_1, at + 1 < end)
        record_2, record_3 = _load_record(records, owner_2, at + 2 < end), _load_record(records, owner_3, at + 3 < end)
        at += 4
        owner_0 = tl.load(owners + tl.minimum(at, end - 1))
        owner_1 = tl.load(owners + tl.minimum(at + 1, end - 1))
        owner_2 = tl.load(owners + tl.minimum(at + 2, end - 1))
        owner_3 = tl.load(owners + tl.minimum(at + 3, end - 1))
        remaining, red, green, blue, depth = _blend_pair(
            record_0, x, y, row, transmittance_min, remaining, red, green, blue, depth, DEPTH
        )
        remaining, red, green, blue, depth = _blend_pair(
            record_1, x, y, row, transmittance_min, remaining, red, green, blue, depth, DEPTH
        )
        remaining, red, green, blue, depth = _blend_pair(
            record_2, x, y, row, transmittance_min, remaining, red, green, blue, depth, DEPTH
        )
        remaining, red, green, blue, depth = _blend_pair(
            record_3, x, y, row, transmittance_min, remaining, red, green, blue, depth, DEPTH
        )
        unfinished = (at < end) & (tl.max(remaining) > transmittance_min)
    tl.store(blended + tile, tl.minimum(at, end) - begin)
    _store_pixels(transmittance + place, remaining, inside)
    to = rgb + place * 3
    _store_pixels(to, red, inside)
    _store_pixels(to + 1, green, inside)
    _store_pixels(to + 2, blue, inside)
    if DEPTH:
        # The depth is 0 where nothing is hit.
        _store_pixels(depths + place, depth / tl.where(remaining < 1, 1 - remaining, 1.0), inside)


@triton.jit
def _backpropagate_pair(
    record, x, y, row, transmittance_min, remaining, rest, g_red, g_green, g_blue, to, live, ABSGRAD: tl.constexpr
):
    """Write the gradient row of one pair to `to`; returns the transmittance and the rest R behind the pair.

    R is the contribution to g . rgb of everything behind the pair: dL/d(alpha) = T (color . g) - R / (1 - alpha).
    """
    u, v, log2_alpha, is_blended, alpha, weight = _attenuate(record, x, y, row, transmittance_min, remaining)
    alpha = tl.where(is_blended, alpha, 0.0)
    contribution = weight * (record[8] * g_red + record[9] * g_green + record[10] * g_blue)
    rest -= contribution
    p = contribution - rest * (alpha / (1 - alpha))
    p = tl.where(log2_alpha <= _LOG2_ALPHA_MAX, p, 0.0)  # A clamped alpha passes no gradient.
    pu = p * u
    # Each thread first sums over its own pixels, which share one v.
    by_p, by_u, by_uu = tl.sum(p, 0), tl.sum(pu, 0), tl.sum(pu * u, 0)
    sum_u, sum_v, sum_uu, sum_uv = tl.sum(by_u, 0), tl.sum(by_p * v, 0), tl.sum(by_uu, 0), tl.sum(by_u * v, 0)
    sum_vv, sum_p = tl.sum(by_p * v * v, 0), tl.sum(by_p, 0)
    sum_red = tl.sum(weight * g_red)
    sum_green = tl.sum(weight * g_green)
    sum_blue = tl.sum(weight * g_blue)
    # Sums are stored in pairs, in the order of gpu_project's SUM_U to SUM_ABS_Y.
    tl.store(to, pack_pair(sum_u, sum_v), mask=live)
    tl.store(to + 1, pack_pair(sum_uu, sum_uv), mask=live)
    tl.store(to + 2, pack_pair(sum_vv, sum_p), mask=live)
    tl.store(to + 3, pack_pair(sum_red, sum_green), mask=live)
    if ABSGRAD:
        abs_x = tl.sum(tl.abs(record[4] * pu + (record[6] * v)[None, :] * p))
        abs_y = tl.sum(tl.abs(pu))
        tl.store(to + 4, pack_pair(sum_blue, abs_x), mask=live)
        tl.store(to + 5, pack_pair(abs_y, 0.0 * abs_y), mask=live)
    else:
        tl.store(to + 4, pack_pair(sum_blue, 0.0 * sum_blue), mask=live)
    return remaining - weight, rest


@triton.jit(do_not_specialize=["width", "height"])
def blend_backward(
    starts, owners, slots, blended, records, width, height, transmittance_min,
    rgb, transmittance, grad_rgb, grad_transmittance, gradient_rows, replayed,
    ABSGRAD: tl.constexpr, REPLAYED: tl.constexpr,
):  # fmt: skip
    """Write the gradient row of each pair of one tile to its slot in gradient_rows (P, 6) int64.

    Pairs behind the one that finished the tile get zeros. Blending is replayed front to back, so that forward stores
    only the image. If REPLAYED, the replayed transmittance is written to `replayed` (H, W), to be compared.
    """
    tile = tl.program_id(0)
    x, y, row, place, inside = _tile_pixels(tile, width, height)
    remaining = tl.reshape(tl.where(inside, 1.0, -1.0), [_ROWS_PER_BLOCK, _LANES_PER_BLOCK])
    from_rgb = place * 3
    g_red = _load_pixels(grad_rgb + from_rgb, inside)
    g_green = _load_pixels(grad_rgb + from_rgb + 1, inside)
    g_blue = _load_pixels(grad_rgb + from_rgb + 2, inside)
    rest = _load_pixels(rgb + from_rgb, inside) * g_red
    rest += _load_pixels(rgb + from_rgb + 1, inside) * g_green
    rest += _load_pixels(rgb + from_rgb + 2, inside) * g_blue
    rest += _load_pixels(transmittance + place, inside) * _load_pixels(grad_transmittance + place, inside)

    at, end = tl.load(starts + tile), tl.load(starts + tile + 1)
    finish = at + tl.load(blended + tile)
    unfinished = at < finish
    owner_0 = tl.load(owners + at, mask=unfinished, other=0)
    owner_1 = tl.load(owners + tl.minimum(at + 1, finish - 1), mask=unfinished, other=0)
    while unfinished:
        more = at + 1 < finish
        record_0, record_1 = _load_record(records, owner_0, True), _load_record(records, owner_1, more)
        to_0 = gradient_rows + tl.load(slots + at) * (GRADIENT_ROW_FLOATS // 2)
        to_1 = gradient_rows + tl.load(slots + tl.minimum(at + 1, finish - 1)) * (GRADIENT_ROW_FLOATS // 2)
        at += 2
        unfinished = at < finish
        owner_0 = tl.load(owners + tl.minimum(at, finish - 1))
        owner_1 = tl.load(owners + tl.minimum(at + 1, finish - 1))
        remaining, rest = _backpropagate_pair(
            record_0, x, y, row, transmittance_min, remaining, rest, g_red, g_green, g_blue, to_0, True, ABSGRAD
        )
        remaining, rest = _backpropagate_pair(
            record_1, x, y, row, transmittance_min, remaining, rest, g_red, g_green, g_blue, to_1, more, ABSGRAD
        )
    if REPLAYED:
        _store_pixels(replayed + place, remaining, inside)

    word = tl.arange(0, 8)[None, :]
    pair = finish + tl.arange(0, _ROWS_CLEARED_PER_STORE)
    unfinished = finish < end
    while unfinished:
        to = (
            gradient_rows + tl.load(slots + pair, mask=pair < end, other=0)[:, None] * (GRADIENT_ROW_FLOATS // 2) + word
        )
        zero_rows = tl.zeros([_ROWS_CLEARED_PER_STORE, 8], tl.int64)
        tl.store(to, zero_rows, mask=(pair < end)[:, None] & (word < GRADIENT_ROW_FLOATS // 2))
        pair += _ROWS_CLEARED_PER_STORE
        unfinished = tl.min(pair, 0) < end


@triton.jit(do_not_specialize=["total"])
def sum_rows(
    gradient_rows, slot_starts, counts, total, ABSGRAD: tl.constexpr, BLOCK: tl.constexpr, SLOTS: tl.constexpr
):
    """Replace the first of each Gaussian's gradient rows (P, 12) by their sum.

    Many rows are loaded per iteration, because a Gaussian may lie in thousands of tiles.
    """
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    count = tl.load(counts + index, mask=index < total, other=0)
    begin = tl.load(slot_starts + index, mask=count > 0, other=0).to(tl.int64)
    max_count = tl.max(count, 0)
    if max_count > 1:
        column = tl.arange(0, 16)
        used = column <= (SUM_ABS_Y if ABSGRAD else SUM_BLUE)
        slot = tl.arange(0, SLOTS)
        sums = tl.zeros([BLOCK, 16], tl.float32)
        first = gradient_rows + begin[:, None] * GRADIENT_ROW_FLOATS + column[None, :]
        done = 0
        while done < max_count:
            at = first[:, None, :] + ((done + slot) * GRADIENT_ROW_FLOATS)[None, :, None]
            is_used = ((done + slot)[None, :] < count[:, None])[:, :, None] & used[None, None, :]
            sums += tl.sum(tl.load(at, mask=is_used, other=0.0), 1)
            done += SLOTS
        tl.store(first, sums, mask=(count > 1)[:, None] & used[None, :])

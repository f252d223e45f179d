"""Blending on the GPU, forward and backward: one program for each tile.

A tile's 256 pixels are a block (ROWS, LANES): a thread owns one column of it, pixels of the same x, so that v, which
depends on x alone, and all that is the same for a Gaussian are worked out once for the thread's pixels. Records are
loaded as scalars, the same for all threads, a chunk of Gaussians at once so that their latencies overlap.
"""

from __future__ import annotations

import math

import triton
import triton.language as tl

from hyrfpack.ops.gpu_pairs import pack_pair
from hyrfpack.ops.rasterize import reference
from hyrfpack.ops.rasterize.gpu_ellipse import EXPONENT_MIN, TILE
from hyrfpack.ops.rasterize.gpu_project import (
    BLUE_DEPTH,
    OFFSET,
    RED_GREEN,
    REFERENCE,
    ROW,
    SUM_ABS_Y,
    SUM_BLUE,
    U_SLOPES,
    V_SLOPE_OPACITY,
    WORDS,
)

_LANES = tl.constexpr(32)
_ROWS = tl.constexpr(reference.TILE**2 // 32)
_ALPHA_MAX = tl.constexpr(reference.ALPHA_MAX)
_EXPONENT_MAX = tl.constexpr(math.log2(reference.ALPHA_MAX))
_NOTHING = tl.constexpr(-1e30)  # the logarithm of the opacity of no Gaussian
_AT_ONCE = tl.constexpr(32)  # gradient rows cleared at once
# One warp for a tile, 8 pixels a thread. Forward takes 131 instructions for a pair on sm_90 (169 in two warps, which
# load everything twice), backward 417 (672 in two, and 18 barriers, for each of its 9 sums crosses the warps). At 80 to
# 100 registers 20 to 25 tiles share a multiprocessor, enough to hide the latency of a chunk's loads.
WARPS = 1


@triton.jit
def _pixels(tile, width, height):
    """The pixels of a tile.

    Returns:
        x, y: (LANES,) centres of the pixels in the first row of the block.
        row: (ROWS, 1) what the further rows add to y.
        place, inside: (256,) their places in the picture, and whether they lie in it. Flat: memory is read and written
            so, or the compiler would choose another layout for the loop.
    """
    left, top = (tile % tl.cdiv(width, TILE)) * TILE, (tile // tl.cdiv(width, TILE)) * TILE
    pixel = tl.arange(0, TILE * TILE)
    x, y = left + pixel % TILE, top + pixel // TILE
    inside = (x < width) & (y < height)
    place = y.to(tl.int64) * width + x
    lane = tl.arange(0, _LANES)
    first_x, first_y = (left + lane % TILE).to(tl.float32) + 0.5, (top + lane // TILE).to(tl.float32) + 0.5
    row = (tl.arange(0, _ROWS) * (_LANES // TILE)).to(tl.float32)[:, None]
    return first_x, first_y, row, place, inside


@triton.jit
def _load_pixels(pointer, inside):
    """(ROWS, LANES) from flat pointers, 0 outside of the picture."""
    return tl.reshape(tl.load(pointer, mask=inside, other=0.0), [_ROWS, _LANES])


@triton.jit
def _store_pixels(pointer, values, inside):
    tl.store(pointer, tl.reshape(values, [_ROWS * _LANES]), mask=inside)


@triton.jit
def _fetch(records, owner, live):
    """A record's numbers; the opacity is nothing where not live."""
    at = records + owner.to(tl.int64) * WORDS
    # All words are loaded before the first is used, so that their latencies overlap. They are unpacked inline, since
    # calls of `unpack_pair` are slow in Triton's interpreter.
    ref, offset, slopes = tl.load(at + REFERENCE), tl.load(at + OFFSET), tl.load(at + U_SLOPES)
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
        tl.where(live, log_opacity, _NOTHING),
        color.to(tl.int32).to(tl.float32, bitcast=True),
        (color >> 32).to(tl.int32).to(tl.float32, bitcast=True),
        depth.to(tl.int32).to(tl.float32, bitcast=True),
        (depth >> 32).to(tl.int32).to(tl.float32, bitcast=True),
    )


@triton.jit
def _exponent(record, x, y, row):
    """u (ROWS, LANES), v (LANES,) and log2 of alpha, before it is cut (ROWS, LANES)."""
    ref_x, ref_y, u_0, v_0, u_x, u_y, v_x, log_opacity, _, _, _, _ = record
    dx = x - ref_x
    v = v_x * dx + v_0
    u = (u_y * (y - ref_y) + (u_x * dx + u_0))[None, :] + u_y * row
    return u, v, (log_opacity - v * v)[None, :] - u * u


@triton.jit
def _blend_one(record, x, y, row, transmittance_min, light, red, green, blue, depth, DEPTH: tl.constexpr):
    _, _, exponent = _exponent(record, x, y, row)
    alpha = tl.minimum(tl.exp2(exponent), _ALPHA_MAX)
    weight = tl.where((exponent >= EXPONENT_MIN) & (light > transmittance_min), alpha * light, 0.0)
    red += weight * record[8]
    green += weight * record[9]
    blue += weight * record[10]
    if DEPTH:
        depth += weight * record[11]
    return light - weight, red, green, blue, depth


@triton.jit(do_not_specialize=["width", "height"])
def blend(
    starts, owners, records, width, height, transmittance_min, rgb, transmittance, depths, blended, DEPTH: tl.constexpr
):
    """Blend one tile into rgb (H, W, 3), transmittance (H, W) and, if DEPTH, depths (H, W).

    blended: (tiles,) int32 after how many pairs each tile was finished. Other arguments as in `gpu_bin.Pairs`.
    """
    tile = tl.program_id(0)
    x, y, row, place, inside = _pixels(tile, width, height)
    # T < 0 marks a pixel outside of the picture; it takes as little as one that is finished.
    light = tl.reshape(tl.where(inside, 1.0, -1.0), [_ROWS, _LANES])
    red, green, blue = tl.zeros_like(light), tl.zeros_like(light), tl.zeros_like(light)
    depth = tl.zeros_like(light)
    begin, end = tl.load(starts + tile), tl.load(starts + tile + 1)
    at = begin
    going = at < end
    # The owners of the next chunk are loaded before this one is worked on. Past the end they are the last one again,
    # for records of what is not drawn hold anything.
    owner_0 = tl.load(owners + at, mask=going, other=0)
    owner_1 = tl.load(owners + tl.minimum(at + 1, end - 1), mask=going, other=0)
    owner_2 = tl.load(owners + tl.minimum(at + 2, end - 1), mask=going, other=0)
    owner_3 = tl.load(owners + tl.minimum(at + 3, end - 1), mask=going, other=0)
    while going:
        record_0, record_1 = _fetch(records, owner_0, True), _fetch(records, owner_1, at + 1 < end)
        record_2, record_3 = _fetch(records, owner_2, at + 2 < end), _fetch(records, owner_3, at + 3 < end)
        at += 4
        owner_0 = tl.load(owners + tl.minimum(at, end - 1))
        owner_1 = tl.load(owners + tl.minimum(at + 1, end - 1))
        owner_2 = tl.load(owners + tl.minimum(at + 2, end - 1))
        owner_3 = tl.load(owners + tl.minimum(at + 3, end - 1))
        light, red, green, blue, depth = _blend_one(
            record_0, x, y, row, transmittance_min, light, red, green, blue, depth, DEPTH
        )
        light, red, green, blue, depth = _blend_one(
            record_1, x, y, row, transmittance_min, light, red, green, blue, depth, DEPTH
        )
        light, red, green, blue, depth = _blend_one(
            record_2, x, y, row, transmittance_min, light, red, green, blue, depth, DEPTH
        )
        light, red, green, blue, depth = _blend_one(
            record_3, x, y, row, transmittance_min, light, red, green, blue, depth, DEPTH
        )
        going = (at < end) & (tl.max(light) > transmittance_min)
    tl.store(blended + tile, tl.minimum(at, end) - begin)
    _store_pixels(transmittance + place, light, inside)
    to = rgb + place * 3
    _store_pixels(to, red, inside)
    _store_pixels(to + 1, green, inside)
    _store_pixels(to + 2, blue, inside)
    if DEPTH:
        _store_pixels(depths + place, depth / tl.where(light < 1, 1 - light, 1.0), inside)  # 0 where nothing is hit


@triton.jit
def _backward_one(
    record, x, y, row, transmittance_min, light, rest, g_red, g_green, g_blue, to, live, ABSGRAD: tl.constexpr
):
    """Write the gradient row of one pair to `to`; returns the transmittance and the rest behind it.

    With R the rest, what lies behind: dL/d(alpha) = T (color . g) - R / (1 - alpha).
    """
    u, v, exponent = _exponent(record, x, y, row)
    alpha = tl.minimum(tl.exp2(exponent), _ALPHA_MAX)
    alpha = tl.where((exponent >= EXPONENT_MIN) & (light > transmittance_min), alpha, 0.0)
    weight = alpha * light
    here = weight * (record[8] * g_red + record[9] * g_green + record[10] * g_blue)
    rest -= here
    p = here - rest * (alpha / (1 - alpha))
    p = tl.where(exponent <= _EXPONENT_MAX, p, 0.0)  # no gradient where alpha is cut
    pu = p * u
    # Over a thread's pixels first, for which v is one number.
    by_p, by_u, by_uu = tl.sum(p, 0), tl.sum(pu, 0), tl.sum(pu * u, 0)
    sum_u, sum_v, sum_uu, sum_uv = tl.sum(by_u, 0), tl.sum(by_p * v, 0), tl.sum(by_uu, 0), tl.sum(by_u * v, 0)
    sum_vv, sum_p = tl.sum(by_p * v * v, 0), tl.sum(by_p, 0)
    sum_red = tl.sum(weight * g_red)
    sum_green = tl.sum(weight * g_green)
    sum_blue = tl.sum(weight * g_blue)
    # Two at a time, in the order of gpu_project's SUM_U to SUM_ABS_Y.
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
    return light - weight, rest


@triton.jit(do_not_specialize=["width", "height"])
def blend_backward(
    starts, owners, slots, blended, records, width, height, transmittance_min,
    rgb, transmittance, grad_rgb, grad_transmittance, gradient_rows, ABSGRAD: tl.constexpr,
):  # fmt: skip
    """Write the gradient row of each pair of one tile to its slot in gradient_rows (P, 6) int64, zeros after the
    tile's finish. Replays the blending front to back, so that it needs nothing stored but the picture."""
    tile = tl.program_id(0)
    x, y, row, place, inside = _pixels(tile, width, height)
    light = tl.reshape(tl.where(inside, 1.0, -1.0), [_ROWS, _LANES])
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
    going = at < finish
    owner_0 = tl.load(owners + at, mask=going, other=0)
    owner_1 = tl.load(owners + tl.minimum(at + 1, finish - 1), mask=going, other=0)
    while going:
        more = at + 1 < finish
        record_0, record_1 = _fetch(records, owner_0, True), _fetch(records, owner_1, more)
        to_0 = gradient_rows + tl.load(slots + at) * (ROW // 2)
        to_1 = gradient_rows + tl.load(slots + tl.minimum(at + 1, finish - 1)) * (ROW // 2)
        at += 2
        going = at < finish
        owner_0 = tl.load(owners + tl.minimum(at, finish - 1))
        owner_1 = tl.load(owners + tl.minimum(at + 1, finish - 1))
        light, rest = _backward_one(
            record_0, x, y, row, transmittance_min, light, rest, g_red, g_green, g_blue, to_0, True, ABSGRAD
        )
        light, rest = _backward_one(
            record_1, x, y, row, transmittance_min, light, rest, g_red, g_green, g_blue, to_1, more, ABSGRAD
        )

    word = tl.arange(0, 8)[None, :]
    pair = finish + tl.arange(0, _AT_ONCE)
    going = finish < end
    while going:
        to = gradient_rows + tl.load(slots + pair, mask=pair < end, other=0)[:, None] * (ROW // 2) + word
        nothing = tl.zeros([_AT_ONCE, 8], tl.int64)
        tl.store(to, nothing, mask=(pair < end)[:, None] & (word < ROW // 2))
        pair += _AT_ONCE
        going = tl.min(pair, 0) < end


@triton.jit(do_not_specialize=["total"])
def sum_rows(gradient_rows, begins, counts, total, ABSGRAD: tl.constexpr, BLOCK: tl.constexpr, SLOTS: tl.constexpr):
    """Put the sum of each Gaussian's gradient rows (P, 12) in place of its first. Many rows a turn: a Gaussian may lie
    in thousands of tiles."""
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    count = tl.load(counts + index, mask=index < total, other=0)
    begin = tl.load(begins + index, mask=count > 0, other=0).to(tl.int64)
    most = tl.max(count, 0)
    if most > 1:
        column = tl.arange(0, 16)
        used = column <= (SUM_ABS_Y if ABSGRAD else SUM_BLUE)
        slot = tl.arange(0, SLOTS)
        sums = tl.zeros([BLOCK, 16], tl.float32)
        first = gradient_rows + begin[:, None] * ROW + column[None, :]
        done = 0
        while done < most:
            at = first[:, None, :] + ((done + slot) * ROW)[None, :, None]
            there = ((done + slot)[None, :] < count[:, None])[:, :, None] & used[None, None, :]
            sums += tl.sum(tl.load(at, mask=there, other=0.0), 1)
            done += SLOTS
        tl.store(first, sums, mask=(count > 1)[:, None] & used[None, :])

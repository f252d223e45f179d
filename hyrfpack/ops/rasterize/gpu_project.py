"""Projects 3D Gaussians on the GPU to the records that binning and blending read, and backpropagates.

All computation is in float64, once per Gaussian, which keeps far-away scenes, needles and huge Gaussians exact.
Consumer GPUs compute float64 at 1/64 of the rate of float32, so roots and reciprocals begin with a float32 guess that
one Newton step refines. The records are float32. A Gaussian whose numbers overflow is skipped, like one behind the
camera.
`project_block` and `store_records` are separate functions, so that another kernel can project Gaussians without
storing them first.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import triton
import triton.language as tl
from torch import Tensor

from hyrfpack.ops.gpu_pairs import pack_pair
from hyrfpack.ops.gpu_rows import count_used_rows
from hyrfpack.ops.poses import camera_center
from hyrfpack.ops.rasterize import reference
from hyrfpack.ops.rasterize.gpu_ellipse import (
    TILE_SIZE,
    UV_SCALE,
    make_ellipse,
    touched_pixel_rows,
    touched_tile_columns,
)
from hyrfpack.ops.rasterize.inputs import LOW_PASS_VARIANCE
from hyrfpack.ops.viewport import VIEWPOINT_PLACES, Viewport

# Words of a record, which holds one projected Gaussian in 16 float32, read and written in pairs (see gpu_pairs). With
# Sigma = its 2D covariance and d = pixel - mean,
#     u = U_X (x - REF_X) + U_Y (y - REF_Y) + U_0,  v = V_X (x - REF_X) + V_0,  d^T Sigma^-1 d = 2 ln 2 (u^2 + v^2)
# so that alpha = 2^(LOG_OPACITY - u^2 - v^2). Squares of a triangular form do not cancel on long needles, and are never
# negative. REF is the mean, clamped to the image, so that the form of a needle whose mean is far outside is exact where
# the needle is visible. The pairs are:
#     REF_X REF_Y | U_0 V_0 | U_X U_Y | V_X LOG_OPACITY | RED GREEN | BLUE DEPTH | MEAN_X MEAN_Y | COV_XX COV_YY
REFERENCE_MEAN, CONSTANT_TERMS, U_SLOPES, V_SLOPE_OPACITY, RED_GREEN, BLUE_DEPTH, MEAN_XY, COVARIANCE_XX_YY = map(
    tl.constexpr, range(8)
)
RECORD_WORDS = tl.constexpr(8)

# Columns of the gradient row of a (Gaussian, tile) pair: sums over pixels of p = dL/d(ln alpha) times u, v, uu, uv, vv
# and 1; dL/d(color); and, if absgrad is requested, sums of |p (U_X u + V_X v)| and |p u|.
SUM_U, SUM_V, SUM_UU, SUM_UV, SUM_VV, SUM_P, SUM_RED, SUM_GREEN, SUM_BLUE, SUM_ABS_X, SUM_ABS_Y = map(
    tl.constexpr, range(11)
)
GRADIENT_ROW_FLOATS = tl.constexpr(12)

# Index of the camera's centre in the result of `pack_camera`.
VIEWPOINT_OFFSET = tl.constexpr(VIEWPOINT_PLACES.start)
_LOW_PASS_OFFSET = tl.constexpr(28)
# Sort key of a Gaussian that is not drawn.
HIDDEN_KEY = tl.constexpr(2**31 - 1)
# Inputs in the order of their bits in the flags of non-finite inputs.
FLAGGED_INPUTS = "means", "quats", "scales", "opacities", "colors"
GAUSSIANS_PER_PROGRAM = 128  # float64 takes many registers; small programs then give the best occupancy.
WARPS_PER_PROGRAM = 4

_ALPHA_MIN = tl.constexpr(reference.ALPHA_MIN)
_DETERMINANT_RATIO_MIN = tl.constexpr(reference.DETERMINANT_RATIO_MIN)
_QUAT_NORM_MIN = tl.constexpr(reference.QUAT_NORM_MIN)
_LONG_QUAT, _LONG_QUAT_FACTOR = tl.constexpr(1e15), tl.constexpr(2.0**-70)
_INV_SQRT_UV_SCALE = tl.constexpr(math.sqrt(0.5 / math.log(2)))
# Gaussians with a larger depth, opacity, covariance or mean are not drawn.
_MAX_MAGNITUDE = tl.constexpr(1e30)
_FLOAT32_MAX = tl.constexpr(3.4028234663852886e38)


class Projection(NamedTuple):
    """The outputs of a projection kernel for N Gaussians.

    Attributes:
        records: (N, 8) int64, set for Gaussians that are drawn.
        keys: (N,) int32 sort keys by depth, HIDDEN_KEY for Gaussians that are not drawn.
        counts: (N,) int32, the number of tiles touched.
        visible: (N,) uint8, whether any tile is touched.
        flags_and_ends: (1 + N,) int64. The first element holds the flags of non-finite inputs and is zero before the
            launch. Binning writes the others.
    """

    records: Tensor
    keys: Tensor
    counts: Tensor
    visible: Tensor
    flags_and_ends: Tensor

    @classmethod
    def empty(cls, total: int, device: torch.device) -> Projection:
        """Allocate the outputs; only the flags are initialised."""

        def new(*shape: int, dtype: torch.dtype) -> Tensor:
            return torch.empty(shape, dtype=dtype, device=device)

        flags_and_ends = new(1 + total, dtype=torch.int64)
        flags_and_ends[:1].zero_()  # An assignment of 0 would copy it from the host and block.
        keys, counts = new(total, dtype=torch.int32), new(total, dtype=torch.int32)
        records, visible = new(total, RECORD_WORDS.value, dtype=torch.int64), new(total, dtype=torch.uint8)
        return cls(records, keys, counts, visible, flags_and_ends)


def pack_camera(
    viewport: Viewport,
    near: float,
    device: torch.device,
    tolerance: float = 0.0,
    low_pass_variance: float = LOW_PASS_VARIANCE,
) -> Tensor:
    """Pack the camera's parameters for the kernels into one small float64 tensor on the device, if it is not packed.

    Args:
        viewport: the camera; reading its pose from the device synchronises. If it is packed, the other arguments have
            no effect.
        near: distance of the near plane in world units.
        tolerance: width of the band of `in_frustum`, as a fraction of half the image's size.
        low_pass_variance: variance of the low-pass filter in px^2.

    Returns:
        (29,): the rows of the rotation and the translation (12); fx, fy, cx, cy; near; the limits of x/z (low, high)
        and of y/z in the Jacobian; the limits of fx x/z (low, high) and of fy y/z in the frustum; and, from
        VIEWPOINT_OFFSET on, the camera's centre; and the variance of the low-pass filter.
    """
    if viewport.packed is not None:
        return viewport.packed.record
    fx, fy, cx, cy = (float(number) for number in viewport.intrinsics)
    width, height = viewport.width, viewport.height
    pose = viewport.pose.detach().to("cpu", torch.float64)
    margin_x, margin_y = tolerance * width / 2, tolerance * height / 2
    numbers = [
        *pose[:3, :3].flatten().tolist(), *pose[:3, 3].tolist(), fx, fy, cx, cy, near,
        *reference.jacobian_limits(viewport),
        -margin_x - cx, width + margin_x - cx, -margin_y - cy, height + margin_y - cy,
        *camera_center(pose).tolist(), low_pass_variance,
    ]  # fmt: skip
    # A blocking copy would wait for the device. This one stages its source at once, so the source may be freed.
    return torch.tensor(numbers, dtype=torch.float64).to(device, non_blocking=True)


@triton.jit
def _load_3(pointer):
    return tl.load(pointer), tl.load(pointer + 1), tl.load(pointer + 2)


@triton.jit
def _load_4(pointer):
    return tl.load(pointer), tl.load(pointer + 1), tl.load(pointer + 2), tl.load(pointer + 3)


@triton.jit
def load_camera(camera):
    """Load the result of `pack_camera`.

    Returns:
        axes (three rows of the rotation), shift (the translation), lens (fx, fy, cx, cy), near, the limits in the
        Jacobian (4) and those of the frustum (4), and the variance of the low-pass filter.
    """
    axes = _load_3(camera), _load_3(camera + 3), _load_3(camera + 6)
    shift, lens, near = _load_3(camera + 9), _load_4(camera + 12), tl.load(camera + 16)
    low_pass = tl.load(camera + _LOW_PASS_OFFSET)
    return axes, shift, lens, near, _load_4(camera + 17), _load_4(camera + 21), low_pass


@triton.jit
def load_rows_3(pointer, index, live):
    """Load rows of an (N, 3) tensor as one block per column; 0 where not live."""
    at = pointer + index.to(tl.int64) * 3
    first, second = tl.load(at, mask=live, other=0.0), tl.load(at + 1, mask=live, other=0.0)
    return first, second, tl.load(at + 2, mask=live, other=0.0)


@triton.jit
def load_rows_4(pointer, index, live):
    """Load rows of an (N, 4) tensor as one block per column; 0 where not live."""
    at = pointer + index.to(tl.int64) * 4
    first, second = tl.load(at, mask=live, other=0.0), tl.load(at + 1, mask=live, other=0.0)
    return first, second, tl.load(at + 2, mask=live, other=0.0), tl.load(at + 3, mask=live, other=0.0)


@triton.jit
def load_gaussians(gaussians, index, live):
    """Load means, quats and scales (tuples of blocks) and opacities (a block) of `Gaussians3D`, 0 where not live."""
    mean, quat = load_rows_3(gaussians.means, index, live), load_rows_4(gaussians.quats, index, live)
    scale, opacity = (
        load_rows_3(gaussians.scales, index, live),
        tl.load(gaussians.opacities + index, mask=live, other=0.0),
    )
    return mean, quat, scale, opacity


@triton.jit
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@triton.jit
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@triton.jit
def _combine(s, a, t, b):
    """Return s a + t b."""
    return s * a[0] + t * b[0], s * a[1] + t * b[1], s * a[2] + t * b[2]


@triton.jit
def _multiply(a, b):
    return a[0] * b[0], a[1] * b[1], a[2] * b[2]


@triton.jit
def _clamp(value, low, high):
    return tl.minimum(tl.maximum(value, low), high)


@triton.jit
def _to_float64_3(a):
    return a[0].to(tl.float64), a[1].to(tl.float64), a[2].to(tl.float64)


@triton.jit
def _to_float64_4(a):
    return a[0].to(tl.float64), a[1].to(tl.float64), a[2].to(tl.float64), a[3].to(tl.float64)


@triton.jit
def _reciprocal(a):
    """Return 1 / a with a relative error below 2^-40, for float64 from 1e-37 to 1e37."""
    guess = (1 / a.to(tl.float32)).to(tl.float64)
    return guess + guess * (1 - a * guess)


@triton.jit
def _reciprocal_sqrt(a):
    """Return 1 / sqrt(a) with a relative error below 2^-40, for float64 from 1e-37 to 1e37."""
    guess = tl.rsqrt(a.to(tl.float32)).to(tl.float64)
    return guess + 0.5 * guess * (1 - a * guess * guess)


@triton.jit
def _rotation_columns(q):
    """Return the columns of the rotation matrix of a unit quaternion wxyz."""
    return (
        (1 - 2 * (q[2] * q[2] + q[3] * q[3]), 2 * (q[1] * q[2] + q[0] * q[3]), 2 * (q[1] * q[3] - q[0] * q[2])),
        (2 * (q[1] * q[2] - q[0] * q[3]), 1 - 2 * (q[1] * q[1] + q[3] * q[3]), 2 * (q[2] * q[3] + q[0] * q[1])),
        (2 * (q[1] * q[3] + q[0] * q[2]), 2 * (q[2] * q[3] - q[0] * q[1]), 1 - 2 * (q[1] * q[1] + q[2] * q[2])),
    )


@triton.jit
def _to_camera(mean, axes, shift):
    """Return the mean in the camera's frame."""
    mean = _to_float64_3(mean)
    return _dot(axes[0], mean) + shift[0], _dot(axes[1], mean) + shift[1], _dot(axes[2], mean) + shift[2]


@triton.jit
def in_frustum(mean, camera):
    """Return whether means lie in front of the near plane and project into the image or the band around it.

    The `tolerance` of `pack_camera` sets the width of the band.
    """
    axes, shift, lens, near, _, limits, _ = camera
    x, y, z = _to_camera(mean, axes, shift)
    u, v = lens[0] * x, lens[1] * y  # The limits are multiplied by z; a division by z would need a guard against 0.
    inside = (u > limits[0] * z) & (u < limits[1] * z) & (v > limits[2] * z) & (v < limits[3] * z)
    return inside & (z > near)


@triton.jit
def _covariance_factors(x_z, y_z, inv_z, quat, axes, lens, limits):
    """Compute the factors of the covariance.

    Returns:
        a, b: the rows of J R; e, f: the rows of J R Q; the columns of Q; q: the unit quaternion; inv_norm: 1 / its
        length before normalisation, at most 1 / _QUAT_NORM_MIN; is_unit: whether the length was greater than that
        minimum.
    """
    # An exact power of two keeps the squared length of a long quaternion within what `_reciprocal_sqrt` takes.
    largest = tl.maximum(tl.maximum(tl.abs(quat[0]), tl.abs(quat[1])), tl.maximum(tl.abs(quat[2]), tl.abs(quat[3])))
    shrink = tl.where(largest > _LONG_QUAT, _LONG_QUAT_FACTOR, 1.0).to(tl.float32)
    quat = _to_float64_4((quat[0] * shrink, quat[1] * shrink, quat[2] * shrink, quat[3] * shrink))
    square = quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3]
    scale = _reciprocal_sqrt(tl.maximum(square, _QUAT_NORM_MIN * _QUAT_NORM_MIN))
    q = quat[0] * scale, quat[1] * scale, quat[2] * scale, quat[3] * scale
    columns = _rotation_columns(q)
    j_x, j_y = lens[0] * inv_z, lens[1] * inv_z
    a = _combine(j_x, axes[0], -j_x * _clamp(x_z, limits[0], limits[1]), axes[2])
    b = _combine(j_y, axes[1], -j_y * _clamp(y_z, limits[2], limits[3]), axes[2])
    e = _dot(a, columns[0]), _dot(a, columns[1]), _dot(a, columns[2])
    f = _dot(b, columns[0]), _dot(b, columns[1]), _dot(b, columns[2])
    return a, b, e, f, columns, q, scale * shrink.to(tl.float64), square > _QUAT_NORM_MIN * _QUAT_NORM_MIN


@triton.jit
def _covariance(g, h, low_pass):
    """Compute the low-pass filtered covariance from its square root with rows g and h.

    Returns:
        xx, xy, yy of the filtered covariance; its determinant before and after the filter.
    """
    xx, xy, yy = _dot(g, g), _dot(g, h), _dot(h, h)
    # |g x h|^2 equals xx yy - xy^2, but does not cancel on needles.
    normal = _cross(g, h)
    raw = _dot(normal, normal)
    det = raw + (xx + yy) * low_pass + low_pass * low_pass
    return xx + low_pass, xy, yy + low_pass, raw, det


@triton.jit
def _triangular_form(xx, xy, det):
    """Return U_X, U_Y and V_X of a record."""
    v_x = _reciprocal_sqrt(xx)
    inv_xx = v_x * v_x
    u_y = _reciprocal_sqrt(det * inv_xx) * _INV_SQRT_UV_SCALE
    return -u_y * xy * inv_xx, u_y, v_x * _INV_SQRT_UV_SCALE


@triton.jit
def project_block(mean, quat, scale, opacity, camera, width, height, ANTIALIASED: tl.constexpr):
    """Project a block of Gaussians.

    Args:
        mean, quat, scale: tuples of 3, 4 and 3 blocks of float32.
        opacity: a block of float32; a Gaussian with opacity 0 is not drawn.
        camera: the result of `load_camera`.
        width, height: int32.

    Returns:
        The float32 pairs of a record, without the colours, for `store_records`; int32 sort keys by depth, HIDDEN_KEY
        for Gaussians that are not drawn; int32 counts of tiles that the ellipse alpha >= 1/255 touches.
    """
    axes, shift, lens, near, limits, _, low_pass = camera
    x, y, z = _to_camera(mean, axes, shift)
    opacity = opacity.to(tl.float64)
    # The comparisons are written so that they fail for NaN, which is then not drawn.
    drawn = (z > near) & (z < _MAX_MAGNITUDE) & (opacity >= _ALPHA_MIN) & (opacity < _MAX_MAGNITUDE)
    z = tl.where(drawn, z, 1.0)
    inv_z = _reciprocal(z)
    x_z, y_z = x * inv_z, y * inv_z
    _, _, e, f, _, _, _, _ = _covariance_factors(x_z, y_z, inv_z, quat, axes, lens, limits)
    scale = _to_float64_3(scale)
    xx, xy, yy, raw, det = _covariance(_multiply(e, scale), _multiply(f, scale), low_pass)
    if ANTIALIASED:
        # The record has the opacity's float32 logarithm, for which a root in float32 is exact enough.
        opacity *= tl.sqrt(tl.maximum(raw / det, _DETERMINANT_RATIO_MIN).to(tl.float32)).to(tl.float64)
    mean_x, mean_y = lens[0] * x_z + lens[2], lens[1] * y_z + lens[3]
    drawn &= (opacity >= _ALPHA_MIN) & (xx < _MAX_MAGNITUDE) & (yy < _MAX_MAGNITUDE)
    drawn &= (tl.abs(mean_x) < _MAX_MAGNITUDE) & (tl.abs(mean_y) < _MAX_MAGNITUDE)
    # Numbers that overflow are replaced by arbitrary finite ones.
    xx, xy, yy = tl.where(drawn, xx, 1.0), tl.where(drawn, xy, 0.0), tl.where(drawn, yy, 1.0)
    det = tl.where(drawn, det, 1.0)
    mean_x, mean_y = tl.where(drawn, mean_x, 0.0), tl.where(drawn, mean_y, 0.0)

    u_x, u_y, v_x = _triangular_form(xx, xy, det)
    ref_x = _clamp(mean_x, 0.0, width.to(tl.float64)).to(tl.float32)
    ref_y = _clamp(mean_y, 0.0, height.to(tl.float64)).to(tl.float32)
    from_x, from_y = ref_x.to(tl.float64) - mean_x, ref_y.to(tl.float64) - mean_y
    u_0, v_0 = (u_x * from_x + u_y * from_y).to(tl.float32), (v_x * from_x).to(tl.float32)
    u_x, u_y, v_x = u_x.to(tl.float32), u_y.to(tl.float32), v_x.to(tl.float32)
    log_opacity = tl.log2(tl.where(drawn, opacity, 1.0).to(tl.float32))
    mean_x, mean_y = mean_x.to(tl.float32), mean_y.to(tl.float32)
    xx, yy, depth = xx.to(tl.float32), yy.to(tl.float32), z.to(tl.float32)

    shape = make_ellipse(mean_x, mean_y, xx, yy, u_x, u_y, log_opacity)
    top, bottom = touched_pixel_rows(shape, height)
    bottom = tl.where(drawn, bottom, -1)
    row, last = top // TILE_SIZE, tl.where(top <= bottom, bottom // TILE_SIZE, -1)
    count = tl.zeros_like(row)
    unfinished = tl.max(last - row, 0) >= 0
    while unfinished:
        _column, touched = touched_tile_columns(shape, row, top, bottom, width)
        count += tl.where(row <= last, touched, 0)
        row += 1
        unfinished = tl.max(last - row, 0) >= 0
    key = tl.where(count > 0, depth.to(tl.int32, bitcast=True), HIDDEN_KEY)
    words = ((ref_x, ref_y), (u_0, v_0), (u_x, u_y), (v_x, log_opacity), depth, (mean_x, mean_y), (xx, yy))
    return words, key, count


@triton.jit
def store_records(records, index, drawn, words):
    """Write the records (N, 8) int64 of Gaussians `index` where drawn, without the words that `store_colors` writes.

    words: the result of `project_block`.
    """
    reference, offset, u_slopes, v_slope_opacity, depth, mean, covariance = words
    at = records + index.to(tl.int64) * RECORD_WORDS
    tl.store(at + REFERENCE_MEAN, pack_pair(reference[0], reference[1]), mask=drawn)
    tl.store(at + CONSTANT_TERMS, pack_pair(offset[0], offset[1]), mask=drawn)
    tl.store(at + U_SLOPES, pack_pair(u_slopes[0], u_slopes[1]), mask=drawn)
    tl.store(at + V_SLOPE_OPACITY, pack_pair(v_slope_opacity[0], v_slope_opacity[1]), mask=drawn)
    tl.store(at + MEAN_XY, pack_pair(mean[0], mean[1]), mask=drawn)
    tl.store(at + COVARIANCE_XX_YY, pack_pair(covariance[0], covariance[1]), mask=drawn)


@triton.jit
def store_colors(records, index, drawn, color, depth):
    """Write the colours, a tuple of 3 blocks, to records, and the depth that shares a word with blue."""
    at = records + index.to(tl.int64) * RECORD_WORDS
    tl.store(at + RED_GREEN, pack_pair(color[0], color[1]), mask=drawn)
    tl.store(at + BLUE_DEPTH, pack_pair(color[2], depth), mask=drawn)


@triton.jit
def store_counts(projection, index, live, key, count):
    """Write the sort keys, the tile counts and the visibility of Gaussians `index` where live."""
    tl.store(projection.keys + index, key, mask=live)
    tl.store(projection.counts + index, count, mask=live)
    tl.store(projection.visible + index, (count > 0).to(tl.uint8), mask=live)


@triton.jit
def is_finite(a):
    """Return whether numbers are neither NaN nor infinite."""
    return tl.abs(a) <= _FLOAT32_MAX


@triton.jit
def _set_flags(flags, bits):
    """Set the bits of all Gaussians of the block in `flags`."""
    if tl.max(bits, 0) > 0:
        tl.atomic_or(flags + tl.zeros_like(bits), bits.to(tl.int64), mask=bits > 0)


@triton.jit
def flag_geometry(flags, mean, quat, scale, opacity):
    """Set a bit of the int64 `flags` for each input with NaN or infinity, in the order of FLAGGED_INPUTS."""
    means = is_finite(mean[0]) & is_finite(mean[1]) & is_finite(mean[2])
    quats = is_finite(quat[0]) & is_finite(quat[1]) & is_finite(quat[2]) & is_finite(quat[3])
    scales = is_finite(scale[0]) & is_finite(scale[1]) & is_finite(scale[2])
    bits = tl.where(means, 0, 1) | tl.where(quats, 0, 2) | tl.where(scales, 0, 4)
    _set_flags(flags, bits | tl.where(is_finite(opacity), 0, 8))


@triton.jit
def flag_colors(flags, color):
    """Set the last bit of `flags` if a colour is not finite, see `flag_geometry`."""
    _set_flags(flags, tl.where(is_finite(color[0]) & is_finite(color[1]) & is_finite(color[2]), 0, 16))


@triton.jit(do_not_specialize=["total", "width", "height"])
def project(
    gaussians, colors, camera, total, used, width, height, projection, ANTIALIASED: tl.constexpr, BLOCK: tl.constexpr
):
    """Project a block of `Gaussians3D` to a `Projection`. A record is written only for a Gaussian that is drawn.

    Those that are not in use are not drawn.
    """
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    used_count = count_used_rows(used, total)
    if tl.program_id(0) * BLOCK >= used_count:
        no_tiles = tl.zeros([BLOCK], tl.int32)
        store_counts(projection, index, index < total, no_tiles + HIDDEN_KEY, no_tiles)
        return
    live = index < used_count
    mean, quat, scale, opacity = load_gaussians(gaussians, index, live)
    flag_geometry(projection.flags_and_ends, mean, quat, scale, opacity)
    words, key, count = project_block(mean, quat, scale, opacity, load_camera(camera), width, height, ANTIALIASED)
    key, count = tl.where(live, key, HIDDEN_KEY), tl.where(live, count, 0)
    # Colours are loaded last, so that they take no registers before.
    color = load_rows_3(colors, index, live)
    flag_colors(projection.flags_and_ends, color)
    store_records(projection.records, index, count > 0, words)
    store_colors(projection.records, index, count > 0, color, words[4])
    store_counts(projection, index, index < total, key, count)


@triton.jit
def _store_rows_3(pointer, index, live, a):
    """Store blocks, one per column, as rows of an (N, 3) float32 tensor where live."""
    at = pointer + index.to(tl.int64) * 3
    tl.store(at, a[0].to(tl.float32), mask=live)
    tl.store(at + 1, a[1].to(tl.float32), mask=live)
    tl.store(at + 2, a[2].to(tl.float32), mask=live)


@triton.jit(do_not_specialize=["total", "absgrad_row", "absgrad_column"])
def project_backward(
    rows, slot_starts, counts, gaussians, camera, total, used, grads, grad_colors, absgrad, absgrad_row, absgrad_column,
    ANTIALIASED: tl.constexpr, ABSGRAD: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Backpropagate the gradient row of each Gaussian, summed over tiles, through the projection.

    Args:
        rows: (P, 12) gradient rows; that of Gaussian i is rows[slot_starts[i]].
        slot_starts, counts: (N,) int32.
        grads, grad_colors: the gradients, written; `grads` are those of the `Gaussians3D`.
        absgrad: (N, 2) with the strides absgrad_row and absgrad_column, incremented.
    """
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    used_count = count_used_rows(used, total)
    if tl.program_id(0) * BLOCK >= used_count:
        return
    live = index < used_count
    drawn = live & (tl.load(counts + index, mask=live, other=0) > 0)
    at = rows + tl.load(slot_starts + index, mask=drawn, other=0).to(tl.int64) * GRADIENT_ROW_FLOATS
    sum_u, sum_v = tl.load(at + SUM_U, mask=drawn, other=0.0), tl.load(at + SUM_V, mask=drawn, other=0.0)
    sum_uu, sum_uv = tl.load(at + SUM_UU, mask=drawn, other=0.0), tl.load(at + SUM_UV, mask=drawn, other=0.0)
    sum_vv, sum_p = tl.load(at + SUM_VV, mask=drawn, other=0.0), tl.load(at + SUM_P, mask=drawn, other=0.0)
    red, green = tl.load(at + SUM_RED, mask=drawn, other=0.0), tl.load(at + SUM_GREEN, mask=drawn, other=0.0)
    blue = tl.load(at + SUM_BLUE, mask=drawn, other=0.0)
    _store_rows_3(grad_colors, index, live, (red, green, blue))
    opacity = tl.load(gaussians.opacities + index, mask=drawn, other=1.0)
    tl.store(grads.opacities + index, sum_p / opacity, mask=live)

    axes, shift, lens, _, limits, _, low_pass = load_camera(camera)
    # Gaussians that are not drawn may hold any numbers. They are replaced by zeros at z = 1 and get zero gradients.
    x, y, z = _to_camera(load_rows_3(gaussians.means, index, drawn), axes, shift)
    inv_z = _reciprocal(tl.where(drawn, z, 1.0))
    x_z, y_z = x * inv_z, y * inv_z
    quat = load_rows_4(gaussians.quats, index, drawn)
    a, b, e, f, columns, q, inv_norm, is_unit = _covariance_factors(x_z, y_z, inv_z, quat, axes, lens, limits)
    scale = _to_float64_3(load_rows_3(gaussians.scales, index, drawn))
    g, h = _multiply(e, scale), _multiply(f, scale)
    xx, xy, yy, raw, det = _covariance(g, h, low_pass)
    u_x, u_y, v_x = _triangular_form(xx, xy, det)
    if ABSGRAD:
        to = absgrad + index.to(tl.int64) * absgrad_row
        abs_x, abs_y = tl.load(at + SUM_ABS_X, mask=drawn, other=0.0), tl.load(at + SUM_ABS_Y, mask=drawn, other=0.0)
        before_x = tl.load(to, mask=drawn, other=0.0)
        before_y = tl.load(to + absgrad_column, mask=drawn, other=0.0)
        tl.store(to, before_x + abs_x * UV_SCALE, mask=drawn)
        tl.store(to + absgrad_column, before_y + (u_y * UV_SCALE).to(tl.float32) * abs_y, mask=drawn)

    # Sigma^-1 d = UV_SCALE (U_X u + V_X v, U_Y u), and dL/dSigma = 1/2 sum p (Sigma^-1 d)(Sigma^-1 d)^T.
    su, sv, sum_p = sum_u.to(tl.float64), sum_v.to(tl.float64), sum_p.to(tl.float64)
    suu, suv, svv = sum_uu.to(tl.float64), sum_uv.to(tl.float64), sum_vv.to(tl.float64)
    grad_x, grad_y = (u_x * su + v_x * sv) * UV_SCALE, u_y * su * UV_SCALE
    grad_xx = (u_x * u_x * suu + 2 * u_x * v_x * suv + v_x * v_x * svv) * (0.5 * UV_SCALE * UV_SCALE)
    grad_xy = u_y * (u_x * suu + v_x * suv) * (UV_SCALE * UV_SCALE)
    grad_yy = u_y * u_y * suu * (0.5 * UV_SCALE * UV_SCALE)
    if ANTIALIASED:
        # The compensated opacity adds 1/2 log(raw / det) to the exponent.
        compensated = raw >= det * _DETERMINANT_RATIO_MIN
        by_p = tl.where(compensated, sum_p, 0.0)
        inv_raw, inv_det = 1 / tl.where(compensated, raw, 1.0), 1 / det
        grad_xx += 0.5 * by_p * ((yy - low_pass) * inv_raw - yy * inv_det)
        grad_yy += 0.5 * by_p * ((xx - low_pass) * inv_raw - xx * inv_det)
        grad_xy -= by_p * xy * (inv_raw - inv_det)

    grad_g, grad_h = _combine(2 * grad_xx, g, grad_xy, h), _combine(2 * grad_yy, h, grad_xy, g)
    by_e, by_f = _multiply(grad_g, e), _multiply(grad_h, f)
    _store_rows_3(grads.scales, index, live, (by_e[0] + by_f[0], by_e[1] + by_f[1], by_e[2] + by_f[2]))
    grad_e, grad_f = _multiply(grad_g, scale), _multiply(grad_h, scale)

    # Backpropagate through e = a Q and f = b Q to the rotation matrix, the unit quaternion, and its length.
    d0 = _combine(a[0], grad_e, b[0], grad_f)
    d1 = _combine(a[1], grad_e, b[1], grad_f)
    d2 = _combine(a[2], grad_e, b[2], grad_f)
    x_turn, y_turn, z_turn = d2[1] - d1[2], d0[2] - d2[0], d1[0] - d0[1]
    w0 = 2 * (q[1] * x_turn + q[2] * y_turn + q[3] * z_turn)
    w1 = 2 * (q[0] * x_turn + q[2] * (d0[1] + d1[0]) + q[3] * (d0[2] + d2[0]) - 2 * q[1] * (d1[1] + d2[2]))
    w2 = 2 * (q[0] * y_turn + q[1] * (d0[1] + d1[0]) + q[3] * (d1[2] + d2[1]) - 2 * q[2] * (d0[0] + d2[2]))
    w3 = 2 * (q[0] * z_turn + q[1] * (d0[2] + d2[0]) + q[2] * (d1[2] + d2[1]) - 2 * q[3] * (d0[0] + d1[1]))
    along = tl.where(is_unit, q[0] * w0 + q[1] * w1 + q[2] * w2 + q[3] * w3, 0.0)
    to = grads.quats + index.to(tl.int64) * 4
    tl.store(to, ((w0 - along * q[0]) * inv_norm).to(tl.float32), mask=live)
    tl.store(to + 1, ((w1 - along * q[1]) * inv_norm).to(tl.float32), mask=live)
    tl.store(to + 2, ((w2 - along * q[2]) * inv_norm).to(tl.float32), mask=live)
    tl.store(to + 3, ((w3 - along * q[3]) * inv_norm).to(tl.float32), mask=live)

    # Backpropagate through a = j_x R_x - j_x clamp(x/z) R_z, and likewise b, to the Jacobian and then the mean.
    grad_a = _combine(1.0, _combine(grad_e[0], columns[0], grad_e[1], columns[1]), grad_e[2], columns[2])
    grad_b = _combine(1.0, _combine(grad_f[0], columns[0], grad_f[1], columns[1]), grad_f[2], columns[2])
    right, down, forward = axes
    j_x, j_y = lens[0] * inv_z, lens[1] * inv_z
    towards_x, towards_y = _dot(grad_a, forward), _dot(grad_b, forward)
    free_x, free_y = (x_z >= limits[0]) & (x_z <= limits[1]), (y_z >= limits[2]) & (y_z <= limits[3])
    grad_x_z = lens[0] * grad_x - tl.where(free_x, j_x * towards_x, 0.0)
    grad_y_z = lens[1] * grad_y - tl.where(free_y, j_y * towards_y, 0.0)
    by_j_x = _dot(grad_a, right) - _clamp(x_z, limits[0], limits[1]) * towards_x
    by_j_y = _dot(grad_b, down) - _clamp(y_z, limits[2], limits[3]) * towards_y
    grad_z = -(by_j_x * j_x + by_j_y * j_y + grad_x_z * x_z + grad_y_z * y_z) * inv_z
    in_plane = _combine(grad_x_z * inv_z, right, grad_y_z * inv_z, down)
    _store_rows_3(grads.means, index, live, _combine(1.0, in_plane, grad_z, forward))

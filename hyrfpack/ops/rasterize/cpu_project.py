"""Projects 3D Gaussians to the records that binning and blending read, and backpropagates, in compiled code.

All computation is in float64, which costs little here and keeps far-away scenes, needles and huge Gaussians exact. The
records are float32. A Gaussian whose numbers overflow is skipped, like one behind the camera.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hyrfpack.ops.rasterize.reference import (
    ALPHA_MIN,
    DETERMINANT_RATIO_MIN,
    QUAT_NORM_MIN,
    TILE_SIZE,
)
from hyrfpack.parallel.compiled import compiled

# Columns of a record, which holds one projected Gaussian in 16 float32, one cache line. With Sigma = its 2D covariance,
#     u = U_X dx + U_Y dy,  v = V_Y dy,  u^2 + v^2 = 1/16 d^T Sigma^-1 d   (so the exponent is -8 (u^2 + v^2)).
# Squares of a triangular form do not cancel on long needles, and are never negative.
MEAN_X, MEAN_Y, U_X, U_Y, V_Y, CUTOFF, OPACITY, RED, GREEN, BLUE, DEPTH, COV_XX, COV_YY, REACH = range(14)
RECORD_FLOATS = 16
# CUTOFF: the largest u^2 + v^2 with alpha >= 1/255. REACH: the largest d^T Sigma^-1 d to bin, slightly above 16 CUTOFF.

# Columns of the gradient row of a (Gaussian, tile) pair: sums over pixels of p = dL/d(exponent) times u, v, uu, uv, vv
# and 1; dL/d(color); sums of |p u| and |p (U_Y u + V_Y v)|. The row is padded to a cache line.
SUM_U, SUM_V, SUM_UU, SUM_UV, SUM_VV, SUM_P, SUM_RED, SUM_GREEN, SUM_BLUE, SUM_ABS_U, SUM_ABS_V = range(11)
GRADIENT_ROW_FLOATS = 16

# Sort key of a Gaussian that is not drawn.
HIDDEN_KEY = np.uint32(0xFFFFFFFF)
# Gaussians with a larger depth, opacity, covariance or mean are not drawn.
_MAX_MAGNITUDE = 1e30
# The bound of a Gaussian's tiles is widened by an absolute margin and by one relative to the size of the coordinates.
_SPAN_MARGIN_PIXELS, _SPAN_MARGIN_RATIO = 0.01, 1e-6
_COMPILE_OPTIONS = {"fastmath": {"contract", "nsz"}, "error_model": "numpy"}
_kernel = compiled(**_COMPILE_OPTIONS)
_inlined = compiled(**_COMPILE_OPTIONS, inline="always")  # LLVM does not inline functions of this size by itself.


class ProjectionSettings(NamedTuple):
    """The camera and the settings of a projection, in the types that kernels take.

    The camera is tuples of float, because the compiler would not move loads from arrays out of a loop.

    Attributes:
        axes: the rows of the camera's rotation.
        shift: the camera's translation.
        lens: fx, fy, cx, cy, then the limits of x/z (low, high) and of y/z in the Jacobian.
        width, height: as in `Viewport`.
        near, antialiased, low_pass_variance: as in `RasterSettings`.
    """

    axes: tuple[tuple[float, ...], ...]
    shift: tuple[float, ...]
    lens: tuple[float, ...]
    width: int
    height: int
    near: float
    antialiased: bool
    low_pass_variance: float


class Projection(NamedTuple):
    """N projected Gaussians.

    Attributes:
        records: (N, 16); a record is written only for a Gaussian that is drawn.
        keys: (N,) uint32 sort keys by depth.
        tile_count_bounds: (N,) uint32, the number of tiles that the bounding box meets.
    """

    records: np.ndarray
    keys: np.ndarray
    tile_count_bounds: np.ndarray


class GaussianArrays(NamedTuple):
    """The arrays of N Gaussians with colours (N, 3), or the gradients of these arrays; see `Gaussians3D`."""

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    colors: np.ndarray


@_kernel
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@_kernel
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@_kernel
def _combine(s, a, t, b):
    """Return s a + t b."""
    return s * a[0] + t * b[0], s * a[1] + t * b[1], s * a[2] + t * b[2]


@_kernel
def _multiply(a, b):
    return a[0] * b[0], a[1] * b[1], a[2] * b[2]


@_kernel
def _clamp(value, low, high):
    return min(max(value, low), high)


@_kernel
def _to_float64(x, y, z):
    return np.float64(x), np.float64(y), np.float64(z)


@_kernel
def _rotation_columns(q0, q1, q2, q3):
    """Return the columns of the rotation matrix of a unit quaternion wxyz."""
    return (
        (1 - 2 * (q2 * q2 + q3 * q3), 2 * (q1 * q2 + q0 * q3), 2 * (q1 * q3 - q0 * q2)),
        (2 * (q1 * q2 - q0 * q3), 1 - 2 * (q1 * q1 + q3 * q3), 2 * (q2 * q3 + q0 * q1)),
        (2 * (q1 * q3 + q0 * q2), 2 * (q2 * q3 - q0 * q1), 1 - 2 * (q1 * q1 + q2 * q2)),
    )


@_inlined
def _project_mean(mean, axes, shift):
    """Return x / z, y / z and z of a mean in the camera's frame; `axes` are the rows of the rotation."""
    z = _dot(axes[2], mean) + shift[2]
    inv_z = 1 / z
    return (_dot(axes[0], mean) + shift[0]) * inv_z, (_dot(axes[1], mean) + shift[1]) * inv_z, z


@_inlined
def _covariance_factors(x_z, y_z, z, quat, axes, lens):
    """Compute the factors of the covariance.

    Returns:
        a, b: the rows of J R; e, f: the rows of J R Q; q: the unit quaternion; norm: its length before normalisation.
    """
    q0, q1, q2, q3 = quat
    norm = math.sqrt(q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3)
    scale = 1 / max(norm, QUAT_NORM_MIN)
    q0, q1, q2, q3 = q0 * scale, q1 * scale, q2 * scale, q3 * scale
    axis_0, axis_1, axis_2 = _rotation_columns(q0, q1, q2, q3)
    inv_z = 1 / z
    j_x, j_y = lens[0] * inv_z, lens[1] * inv_z
    a = _combine(j_x, axes[0], -j_x * _clamp(x_z, lens[4], lens[5]), axes[2])
    b = _combine(j_y, axes[1], -j_y * _clamp(y_z, lens[6], lens[7]), axes[2])
    e = _dot(a, axis_0), _dot(a, axis_1), _dot(a, axis_2)
    f = _dot(b, axis_0), _dot(b, axis_1), _dot(b, axis_2)
    return a, b, e, f, (q0, q1, q2, q3), norm


@_inlined
def _covariance(g, h, low_pass):
    """Compute the low-pass filtered covariance from its square root with rows g and h.

    Returns:
        xx, xy, yy of the filtered covariance; its determinant before and after the filter.
    """
    xx, xy, yy = _dot(g, g), _dot(g, h), _dot(h, h)
    # |g x h|^2 equals xx yy - xy^2, but does not cancel on needles.
    normal = _cross(g, h)
    raw = _dot(normal, normal)
    det = raw + low_pass * (xx + yy) + low_pass * low_pass
    return xx + low_pass, xy, yy + low_pass, raw, det


@_kernel
def _triangular_form(xx, xy, yy, det):
    """Return U_X, U_Y and V_Y of a record."""
    inv_yy = 1 / yy
    u_x = 0.25 * math.sqrt(yy / det)
    return u_x, -u_x * xy * inv_yy, 0.25 * math.sqrt(inv_yy)


@_kernel
def project(start, stop, gaussians, settings, projection):
    """Project Gaussians start to stop, and write their projection.

    Args:
        gaussians, settings, projection: the fields of `GaussianArrays`, `ProjectionSettings` and `Projection`.
    """
    means, quats, scales, opacities, colors = gaussians
    axes, shift, lens, width, height, near, antialiased, low_pass = settings
    records, keys, tile_count_bounds = projection
    for i in range(np.uint64(start), np.uint64(stop)):
        keys[i] = HIDDEN_KEY
        tile_count_bounds[i] = 0
        x_z, y_z, z = _project_mean(_to_float64(means[i, 0], means[i, 1], means[i, 2]), axes, shift)
        opacity = np.float64(opacities[i])
        # The comparisons are written so that they fail for NaN, which is then not drawn.
        if not (z > near and z < _MAX_MAGNITUDE and opacity >= ALPHA_MIN and opacity < _MAX_MAGNITUDE):
            continue
        quat = np.float64(quats[i, 0]), np.float64(quats[i, 1]), np.float64(quats[i, 2]), np.float64(quats[i, 3])
        _, _, e, f, _, _ = _covariance_factors(x_z, y_z, z, quat, axes, lens)
        scale = _to_float64(scales[i, 0], scales[i, 1], scales[i, 2])
        xx, xy, yy, raw, det = _covariance(_multiply(e, scale), _multiply(f, scale), low_pass)
        if antialiased:
            opacity *= math.sqrt(max(raw / det, DETERMINANT_RATIO_MIN))
        mean_x, mean_y = lens[0] * x_z + lens[2], lens[1] * y_z + lens[3]
        if not (opacity >= ALPHA_MIN and xx < _MAX_MAGNITUDE and yy < _MAX_MAGNITUDE):
            continue
        if not (abs(mean_x) < _MAX_MAGNITUDE and abs(mean_y) < _MAX_MAGNITUDE):
            continue

        cut = 2 * math.log(255 * opacity)
        reach = cut + 1e-3
        extent_x, extent_y = math.sqrt(reach * xx), math.sqrt(reach * yy)
        # Pairs are found with records in float32, which may lie a little farther out.
        extent_x += _SPAN_MARGIN_PIXELS + _SPAN_MARGIN_RATIO * (abs(mean_x) + extent_x)
        extent_y += _SPAN_MARGIN_PIXELS + _SPAN_MARGIN_RATIO * (abs(mean_y) + extent_y)
        left, right = mean_x - extent_x - 0.5, mean_x + extent_x - 0.5
        top, bottom = mean_y - extent_y - 0.5, mean_y + extent_y - 0.5
        # Bounds beyond the picture are compared as floats, because they may exceed every integer.
        if not (left <= width - 1.0 and right >= 0.0 and top <= height - 1.0 and bottom >= 0.0):
            continue
        left, right = max(left, 0.0), min(right, width - 1.0)
        top, bottom = max(top, 0.0), min(bottom, height - 1.0)
        if not (math.ceil(left) <= math.floor(right) and math.ceil(top) <= math.floor(bottom)):
            continue
        columns = np.int64(right) // TILE_SIZE - np.int64(math.ceil(left)) // TILE_SIZE + 1
        rows = np.int64(bottom) // TILE_SIZE - np.int64(math.ceil(top)) // TILE_SIZE + 1

        keys[i] = np.float32(z).view(np.uint32)
        tile_count_bounds[i] = columns * rows
        records[i, MEAN_X], records[i, MEAN_Y] = mean_x, mean_y
        records[i, U_X], records[i, U_Y], records[i, V_Y] = _triangular_form(xx, xy, yy, det)
        records[i, CUTOFF], records[i, REACH] = cut / 16, reach
        records[i, OPACITY], records[i, DEPTH] = opacity, z
        records[i, RED], records[i, GREEN], records[i, BLUE] = colors[i, 0], colors[i, 1], colors[i, 2]
        records[i, COV_XX], records[i, COV_YY] = xx, yy


@_kernel
def project_backward(start, stop, slot_starts, rows, gaussians, settings, gradients, absgrad):
    """Sum the gradient rows of Gaussians start to stop and backpropagate them through the projection.

    Args:
        slot_starts: (N + 1,) the first slot of each Gaussian.
        rows: (P, 16) the gradient rows, by slot.
        gaussians, settings: as in `project`; colours are not used.
        gradients: the fields of a `GaussianArrays`, written.
        absgrad: (N, 2), incremented; None if not needed.
    """
    means, quats, scales, opacities, _ = gaussians
    axes, shift, lens, _, _, _, antialiased, low_pass = settings
    grad_means, grad_quats, grad_scales, grad_opacities, grad_colors = gradients
    sums = np.empty(GRADIENT_ROW_FLOATS, np.float32)
    for i in range(np.uint64(start), np.uint64(stop)):
        begin, end = np.uint64(slot_starts[i]), np.uint64(slot_starts[i + np.uint64(1)])
        if begin == end:
            grad_means[i] = 0
            grad_quats[i] = 0
            grad_scales[i] = 0
            grad_opacities[i] = 0
            grad_colors[i] = 0
            continue
        sums[:] = 0
        for row in range(begin, end):
            for k in range(np.uint64(GRADIENT_ROW_FLOATS)):
                sums[k] += rows[row, k]
        grad_colors[i, 0], grad_colors[i, 1], grad_colors[i, 2] = sums[SUM_RED], sums[SUM_GREEN], sums[SUM_BLUE]
        sum_p = np.float64(sums[SUM_P])
        grad_opacities[i] = sum_p / opacities[i]

        x_z, y_z, z = _project_mean(_to_float64(means[i, 0], means[i, 1], means[i, 2]), axes, shift)
        inv_z = 1 / z
        quat = np.float64(quats[i, 0]), np.float64(quats[i, 1]), np.float64(quats[i, 2]), np.float64(quats[i, 3])
        a, b, e, f, q, norm = _covariance_factors(x_z, y_z, z, quat, axes, lens)
        scale = _to_float64(scales[i, 0], scales[i, 1], scales[i, 2])
        g, h = _multiply(e, scale), _multiply(f, scale)
        xx, xy, yy, raw, det = _covariance(g, h, low_pass)
        u_x, u_y, v_y = _triangular_form(xx, xy, yy, det)

        # Sigma^-1 d = 16 (U_X u, U_Y u + V_Y v), and dL/dSigma = 1/2 sum p (Sigma^-1 d)(Sigma^-1 d)^T.
        su, sv = np.float64(sums[SUM_U]), np.float64(sums[SUM_V])
        suu, suv, svv = np.float64(sums[SUM_UU]), np.float64(sums[SUM_UV]), np.float64(sums[SUM_VV])
        grad_x, grad_y = -16 * u_x * su, -16 * (u_y * su + v_y * sv)
        grad_xx = 128 * u_x * u_x * suu
        grad_xy = 256 * u_x * (u_y * suu + v_y * suv)
        grad_yy = 128 * (u_y * u_y * suu + 2 * u_y * v_y * suv + v_y * v_y * svv)
        if absgrad is not None:
            absgrad[i, 0] += np.float32(16 * u_x * sums[SUM_ABS_U])
            absgrad[i, 1] += np.float32(16 * sums[SUM_ABS_V])
        if antialiased and raw / det >= DETERMINANT_RATIO_MIN:
            # The compensated opacity adds 1/2 log(raw / det) to the exponent.
            grad_xx += 0.5 * sum_p * ((yy - low_pass) / raw - yy / det)
            grad_yy += 0.5 * sum_p * ((xx - low_pass) / raw - xx / det)
            grad_xy -= sum_p * xy * (1 / raw - 1 / det)

        grad_g, grad_h = _combine(2 * grad_xx, g, grad_xy, h), _combine(2 * grad_yy, h, grad_xy, g)
        by_e, by_f = _multiply(grad_g, e), _multiply(grad_h, f)
        for k in range(3):
            grad_scales[i, k] = by_e[k] + by_f[k]
        grad_e, grad_f = _multiply(grad_g, scale), _multiply(grad_h, scale)

        # Backpropagate through e = a Q and f = b Q to the rotation matrix, the unit quaternion, and its length.
        d0 = _combine(a[0], grad_e, b[0], grad_f)
        d1 = _combine(a[1], grad_e, b[1], grad_f)
        d2 = _combine(a[2], grad_e, b[2], grad_f)
        q0, q1, q2, q3 = q
        w0 = 2 * (q1 * (d2[1] - d1[2]) + q2 * (d0[2] - d2[0]) + q3 * (d1[0] - d0[1]))
        w1 = 2 * (q0 * (d2[1] - d1[2]) + q2 * (d0[1] + d1[0]) + q3 * (d0[2] + d2[0]) - 2 * q1 * (d1[1] + d2[2]))
        w2 = 2 * (q0 * (d0[2] - d2[0]) + q1 * (d0[1] + d1[0]) + q3 * (d1[2] + d2[1]) - 2 * q2 * (d0[0] + d2[2]))
        w3 = 2 * (q0 * (d1[0] - d0[1]) + q1 * (d0[2] + d2[0]) + q2 * (d1[2] + d2[1]) - 2 * q3 * (d0[0] + d1[1]))
        along = q0 * w0 + q1 * w1 + q2 * w2 + q3 * w3 if norm > QUAT_NORM_MIN else 0.0
        inv_norm = 1 / max(norm, QUAT_NORM_MIN)
        grad_quats[i, 0], grad_quats[i, 1] = (w0 - along * q0) * inv_norm, (w1 - along * q1) * inv_norm
        grad_quats[i, 2], grad_quats[i, 3] = (w2 - along * q2) * inv_norm, (w3 - along * q3) * inv_norm

        # Backpropagate through a = j_x R_x - j_x clamp(x/z) R_z, and likewise b, to the Jacobian and then the mean.
        axis_0, axis_1, axis_2 = _rotation_columns(q0, q1, q2, q3)
        grad_a = _combine(1.0, _combine(grad_e[0], axis_0, grad_e[1], axis_1), grad_e[2], axis_2)
        grad_b = _combine(1.0, _combine(grad_f[0], axis_0, grad_f[1], axis_1), grad_f[2], axis_2)
        right, down, forward = axes
        j_x, j_y = lens[0] * inv_z, lens[1] * inv_z
        towards_x, towards_y = _dot(grad_a, forward), _dot(grad_b, forward)
        grad_x_z, grad_y_z = lens[0] * grad_x, lens[1] * grad_y
        if lens[4] <= x_z <= lens[5]:
            grad_x_z -= j_x * towards_x
        if lens[6] <= y_z <= lens[7]:
            grad_y_z -= j_y * towards_y
        by_j_x = _dot(grad_a, right) - _clamp(x_z, lens[4], lens[5]) * towards_x
        by_j_y = _dot(grad_b, down) - _clamp(y_z, lens[6], lens[7]) * towards_y
        grad_z = -(by_j_x * j_x + by_j_y * j_y + grad_x_z * x_z + grad_y_z * y_z) * inv_z
        for k in range(3):
            grad_means[i, k] = (grad_x_z * right[k] + grad_y_z * down[k]) * inv_z + grad_z * forward[k]

"""Computes L1, SSIM and their gradient in two passes over the image, in Triton.

A program processes a strip of rows in a block of columns, from top to bottom. It blurs each row horizontally by 11
shifted loads, of which the L1 cache serves 10. It keeps the last 11 blurred rows in registers and blurs them
vertically there. The first pass blurs the local moments and writes the derivatives of SSIM with respect to E[x], E[xx]
and E[xy]. The second pass, in backward, blurs these derivatives in the same way into the gradient: the window is
symmetric, so the blur is its own transpose. Pixels stay interleaved, so a horizontal neighbour is 3 floats away.
Nothing is copied to the host, and the order of all sums is fixed.

Memory: the first pass reads 2 planes of 3 floats per pixel and writes 3; the second reads 5 and writes 1. This is 132
bytes per pixel. Strips share 10 of every 34 rows they read, which usually come from the L2 cache.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from hyrfpack.ops.ssim.reference import C1, C2, WINDOW_RADIUS, window_weights

_RADIUS, _C1, _C2 = tl.constexpr(WINDOW_RADIUS), tl.constexpr(C1), tl.constexpr(C2)
_W5, _W4, _W3, _W2, _W1, _W0 = (tl.constexpr(weight) for weight in window_weights()[: WINDOW_RADIUS + 1])

# Each thread handles one column, since the 44 floats of its window leave no registers for two. A strip of 24 rows reads
# 34. Taller strips would read fewer rows twice, but an image of 800 x 800 pixels would then have too few programs to
# hide the latency of their loads.
_COLUMNS_PER_PROGRAM = 128
_ROWS_PER_STRIP = 24
_WARPS_PER_PROGRAM = _COLUMNS_PER_PROGRAM // (64 if torch.version.hip else 32)
_PARTIAL_SUMS_PER_LOAD = 1024
_LAUNCH_OPTIONS = {"num_warps": _WARPS_PER_PROGRAM, "enable_fp_fusion": True}


@triton.jit
def _blur(a):
    """Return the windowed mean of 11 values."""
    near = _W0 * a[5] + _W1 * (a[4] + a[6]) + _W2 * (a[3] + a[7])
    return near + _W3 * (a[2] + a[8]) + _W4 * (a[1] + a[9]) + _W5 * (a[0] + a[10])


@triton.jit
def _load_window(first, column, floats, STRIDE: tl.constexpr):
    """Load the 11 values of a row around each column, STRIDE apart, centred at `first`; 0 outside the image."""
    taps = ()
    for tap in tl.static_range(-_RADIUS, _RADIUS + 1):
        at = column + 3 * tap
        taps += (tl.load(first + STRIDE * tap, mask=(at >= 0) & (at < floats), other=0),)  # type: ignore[assignment]
    return taps


@triton.jit
def _multiply_windows(a, b):
    """Return the elementwise products of two windows."""
    products = ()
    for tap in tl.static_range(2 * _RADIUS + 1):
        products += (a[tap] * b[tap],)
    return products


@triton.jit
def _moments_across(image, target, mask, row, floats, column):
    """Return x, y, xx + yy and xy of a row, blurred horizontally at each column."""
    start = row.to(tl.int64) * floats
    xs = _load_window(image + start + column, column, floats, 3)
    ys = _load_window(target + start + column, column, floats, 3)
    if mask is not None:
        included = _load_window(mask + start // 3 + column // 3, column, floats, 1)
        taps = ()
        for tap in tl.static_range(2 * _RADIUS + 1):
            taps += (tl.where(included[tap] != 0, xs[tap], ys[tap]),)
        xs = taps
    squares = _blur(_multiply_windows(xs, xs)) + _blur(_multiply_windows(ys, ys))
    return _blur(xs), _blur(ys), squares, _blur(_multiply_windows(xs, ys))


@triton.jit
def _loss_kernel(
    image,
    target,
    mask,
    derivatives,
    partials,
    height,
    floats,
    plane,
    COLUMNS: tl.constexpr,
    STRIP: tl.constexpr,
):
    """Compute partial sums of the loss and the derivatives of SSIM over one strip of a column block.

    Args:
        image, target: (H, 3W).
        mask: (H, W) or None.
        derivatives: (3, H, 3W), written: derivatives of SSIM with respect to E[x], E[xx] and E[xy].
        partials: (3, programs), written: sums of |x - y| and of 1 - SSIM, and the number of included values.
        plane: 3 H W.
    """
    column = tl.program_id(0) * COLUMNS + tl.arange(0, COLUMNS)
    inside = column < floats
    top = tl.program_id(1) * STRIP
    zero = tl.zeros([COLUMNS], tl.float32)
    empty = (zero,) * 11
    xs, ys, squares, products = empty, empty, empty, empty
    l1, dissimilarity, count = zero, zero, zero
    for step in range(STRIP + 2 * _RADIUS):
        row = top + step - _RADIUS
        moments = (zero,) * 4
        if (row >= 0) & (row < height):
            moments = _moments_across(image, target, mask, row, floats, column)
        xs, ys = xs[1:] + (moments[0],), ys[1:] + (moments[1],)
        squares, products = squares[1:] + (moments[2],), products[1:] + (moments[3],)
        row -= _RADIUS
        if (row >= top) & (row < height):
            x, y = _blur(xs), _blur(ys)
            square, product = _blur(squares), _blur(products)
            means, energy = x * y, x * x + y * y
            a1, a2 = 2 * means + _C1, 2 * (product - means) + _C2
            b1, b2 = energy + _C1, square - energy + _C2
            scale = 1 / (b1 * b2)
            ssim = a1 * a2 * scale
            by_square, by_product = -ssim * b1 * scale, 2 * a1 * scale
            by_x = y * (2 * a2 * scale - by_product) - 2 * x * (ssim * b2 * scale + by_square)

            start = row.to(tl.int64) * floats
            included = inside
            if mask is not None:
                included = tl.load(mask + start // 3 + column // 3, mask=inside, other=0) != 0
            at = derivatives + start + column
            tl.store(at, tl.where(included, by_x, 0.0), mask=inside)
            tl.store(at + plane, tl.where(included, by_square, 0.0), mask=inside)
            tl.store(at + plane + plane, tl.where(included, by_product, 0.0), mask=inside)
            difference = tl.load(image + start + column, mask=included, other=0.0)
            difference -= tl.load(target + start + column, mask=included, other=0.0)
            l1 += tl.abs(difference)
            dissimilarity += tl.where(included, 1 - ssim, 0.0)
            count += tl.where(included, 1.0, 0.0)

    programs = tl.num_programs(0) * tl.num_programs(1)
    at = partials + tl.program_id(1) * tl.num_programs(0) + tl.program_id(0)
    tl.store(at, tl.sum(l1, 0))
    tl.store(at + programs, tl.sum(dissimilarity, 0))
    tl.store(at + 2 * programs, tl.sum(count, 0))


@triton.jit
def _reduce_kernel(partials, programs, l1_weight, ssim_weight, loss, inverse_count, BLOCK: tl.constexpr):
    """Compute the loss and 1 / count, the weight of one value in a mean, from all partial sums, in one program.

    The partial sums are float32. Adding them as a tree, in float32 too, rounds a sum of n by at most
    (n / BLOCK + log2(BLOCK)) 2^-24 of itself.
    """
    lane = tl.arange(0, BLOCK)
    l1 = tl.zeros([BLOCK], tl.float32)
    dissimilarity, count = l1, l1
    start = 0
    while start < programs:
        at = start + lane
        inside = at < programs
        l1 += tl.load(partials + at, mask=inside, other=0.0)
        dissimilarity += tl.load(partials + programs + at, mask=inside, other=0.0)
        count += tl.load(partials + 2 * programs + at, mask=inside, other=0.0)
        start += BLOCK
    inverse = 1 / tl.maximum(tl.sum(count, 0), 1.0)
    total = inverse * (l1_weight * tl.sum(l1, 0) + ssim_weight * tl.sum(dissimilarity, 0))
    tl.store(loss, total)
    tl.store(inverse_count, inverse)


@triton.jit
def _gradient_kernel(
    image,
    target,
    mask,
    derivatives,
    inverse_count,
    upstream,
    gradient,
    height,
    floats,
    plane,
    l1_weight,
    ssim_weight,
    COLUMNS: tl.constexpr,
    STRIP: tl.constexpr,
):
    """Write the gradient of `image`, (H, 3W), over one strip of a column block."""
    column = tl.program_id(0) * COLUMNS + tl.arange(0, COLUMNS)
    inside = column < floats
    top = tl.program_id(1) * STRIP
    scale = tl.load(inverse_count) * tl.load(upstream)
    zero = tl.zeros([COLUMNS], tl.float32)
    empty = (zero,) * 11
    by_xs, by_squares, by_products = empty, empty, empty
    for step in range(STRIP + 2 * _RADIUS):
        row = top + step - _RADIUS
        blurred = (zero,) * 3
        if (row >= 0) & (row < height):
            at = derivatives + row.to(tl.int64) * floats + column
            by_x, by_square = (
                _blur(_load_window(at, column, floats, 3)),
                _blur(_load_window(at + plane, column, floats, 3)),
            )
            blurred = by_x, by_square, _blur(_load_window(at + plane + plane, column, floats, 3))
        by_xs, by_squares = by_xs[1:] + (blurred[0],), by_squares[1:] + (blurred[1],)
        by_products = by_products[1:] + (blurred[2],)
        row -= _RADIUS
        if (row >= top) & (row < height):
            start = row.to(tl.int64) * floats
            included = inside
            if mask is not None:
                included = tl.load(mask + start // 3 + column // 3, mask=inside, other=0) != 0
            x = tl.load(image + start + column, mask=included, other=0.0)
            y = tl.load(target + start + column, mask=included, other=0.0)
            ssim = _blur(by_xs) + 2 * x * _blur(by_squares) + y * _blur(by_products)
            sign = tl.where(x > y, 1.0, tl.where(x < y, -1.0, 0.0))
            slope = scale * (l1_weight * sign - ssim_weight * ssim)
            tl.store(gradient + start + column, tl.where(included, slope, 0.0), mask=inside)


def _grid(image: Tensor) -> tuple[int, int]:
    """Return the launch grid: column blocks and strips of an image."""
    return triton.cdiv(3 * image.shape[1], _COLUMNS_PER_PROGRAM), triton.cdiv(image.shape[0], _ROWS_PER_STRIP)


def loss_and_derivatives(
    image: Tensor, target: Tensor, mask: Tensor | None, l1_weight: float, ssim_weight: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the weighted sum of the means of |image - target| and of 1 - SSIM, and the inputs of `gradient`.

    Args:
        image, target: (H, W, 3) float32, contiguous.
        mask: (H, W) bool, contiguous, True for pixels to include; elsewhere `image` is replaced by `target`. None
            includes all.
        l1_weight, ssim_weight: factors of the two means.

    Returns:
        The scalar loss; (3, H, W, 3) derivatives of each pixel's SSIM with respect to its local means of x, xx and xy;
        and the scalar 1 / count, with count the number of included values. All on the device.
    """
    height, floats = image.shape[0], 3 * image.shape[1]
    grid = _grid(image)
    programs = grid[0] * grid[1]
    derivatives = image.new_empty(3, *image.shape)
    partials = image.new_empty(3, programs)
    loss, inverse_count = image.new_empty(()), image.new_empty(())
    _loss_kernel[grid](
        image,
        target,
        mask,
        derivatives,
        partials,
        height,
        floats,
        height * floats,
        COLUMNS=_COLUMNS_PER_PROGRAM,
        STRIP=_ROWS_PER_STRIP,
        **_LAUNCH_OPTIONS,
    )
    _reduce_kernel[(1,)](
        partials, programs, l1_weight, ssim_weight, loss, inverse_count, BLOCK=_PARTIAL_SUMS_PER_LOAD, **_LAUNCH_OPTIONS
    )
    return loss, derivatives, inverse_count


def gradient(
    image: Tensor,
    target: Tensor,
    mask: Tensor | None,
    derivatives: Tensor,
    inverse_count: Tensor,
    l1_weight: float,
    ssim_weight: float,
    upstream: Tensor,
) -> Tensor:
    """Compute the gradient (H, W, 3) of `image`, times the scalar `upstream`.

    The other arguments are the arguments and the results of `loss_and_derivatives`.
    """
    height, floats = image.shape[0], 3 * image.shape[1]
    gradient = torch.empty_like(image)
    _gradient_kernel[_grid(image)](
        image,
        target,
        mask,
        derivatives,
        inverse_count,
        upstream,
        gradient,
        height,
        floats,
        height * floats,
        l1_weight,
        ssim_weight,
        COLUMNS=_COLUMNS_PER_PROGRAM,
        STRIP=_ROWS_PER_STRIP,
        **_LAUNCH_OPTIONS,
    )
    return gradient

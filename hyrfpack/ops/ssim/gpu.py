"""L1 and SSIM with their gradient in two passes over the picture, in Triton.

A program owns a block of columns and walks down a strip of rows. At each row it blurs across by 11 shifted loads (which
the first cache serves but for one) and keeps the last 11 rows so blurred in registers, which blurs them down. The first
pass blurs the local moments so and writes the derivatives of SSIM by E[x], E[xx] and E[xy]; the second, in the backward
pass, blurs those in the same way into the gradient (the window is symmetric, so its transpose is itself). Pixels stay
interleaved: a neighbour is 3 floats away. Nothing comes back to the host, and sums are made in a fixed order.

Memory: the first pass reads 2 planes of 3 floats a pixel and writes 3, the second reads 5 and writes 1: 132 bytes a
pixel. The rows that strips share, 10 of every 34 read, come from the second cache as a rule.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from hyrfpack.ops.ssim.reference import C1, C2, RADIUS, window

_RADIUS, _C1, _C2 = tl.constexpr(RADIUS), tl.constexpr(C1), tl.constexpr(C2)
_W5, _W4, _W3, _W2, _W1, _W0 = (tl.constexpr(weight) for weight in window()[: RADIUS + 1])

# A value a thread: 44 floats of window leave no registers for two. A strip of 24 rows reads 34; a higher one would read
# fewer twice, but 800 x 800 pixels then make too few programs to hide their loads.
_COLUMNS, _STRIP = 128, 24
_WARPS = _COLUMNS // (64 if torch.version.hip else 32)
_SUMMED = 1024  # partial sums read at once
_OPTIONS = {"num_warps": _WARPS, "enable_fp_fusion": True}


@triton.jit
def _blur(a):
    """Weighted sum of 11 values."""
    near = _W0 * a[5] + _W1 * (a[4] + a[6]) + _W2 * (a[3] + a[7])
    return near + _W3 * (a[2] + a[8]) + _W4 * (a[1] + a[9]) + _W5 * (a[0] + a[10])


@triton.jit
def _taps(first, column, floats, STRIDE: tl.constexpr):
    """The 11 values of a row around each column, STRIDE apart from `first` on; 0 outside the picture."""
    taps = ()
    for tap in tl.static_range(-_RADIUS, _RADIUS + 1):
        at = column + 3 * tap
        taps += (tl.load(first + STRIDE * tap, mask=(at >= 0) & (at < floats), other=0),)  # type: ignore[assignment]
    return taps


@triton.jit
def _multiply(a, b):
    """Products of two sets of taps."""
    products = ()
    for tap in tl.static_range(2 * _RADIUS + 1):
        products += (a[tap] * b[tap],)
    return products


@triton.jit
def _moments_across(image, target, mask, row, floats, column):
    """x, y, xx + yy and xy of a row, blurred across at each column."""
    start = row.to(tl.int64) * floats
    xs = _taps(image + start + column, column, floats, 3)
    ys = _taps(target + start + column, column, floats, 3)
    if mask is not None:
        counts = _taps(mask + start // 3 + column // 3, column, floats, 1)
        taps = ()
        for tap in tl.static_range(2 * _RADIUS + 1):
            taps += (tl.where(counts[tap] != 0, xs[tap], ys[tap]),)
        xs = taps
    squares = _blur(_multiply(xs, xs)) + _blur(_multiply(ys, ys))
    return _blur(xs), _blur(ys), squares, _blur(_multiply(xs, ys))


@triton.jit
def _measure(
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
    """Sums of |x - y|, of 1 - SSIM and of what counts, and the derivatives of SSIM, over one strip of a column block.

    image, target (H, 3W), mask (H, W) or None, derivatives (3, H, 3W), partials (3, programs); plane is 3 H W.
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
            counts = inside
            if mask is not None:
                counts = tl.load(mask + start // 3 + column // 3, mask=inside, other=0) != 0
            at = derivatives + start + column
            tl.store(at, tl.where(counts, by_x, 0.0), mask=inside)
            tl.store(at + plane, tl.where(counts, by_square, 0.0), mask=inside)
            tl.store(at + plane + plane, tl.where(counts, by_product, 0.0), mask=inside)
            difference = tl.load(image + start + column, mask=counts, other=0.0)
            difference -= tl.load(target + start + column, mask=counts, other=0.0)
            l1 += tl.abs(difference)
            dissimilarity += tl.where(counts, 1 - ssim, 0.0)
            count += tl.where(counts, 1.0, 0.0)

    programs = tl.num_programs(0) * tl.num_programs(1)
    at = partials + tl.program_id(1) * tl.num_programs(0) + tl.program_id(0)
    tl.store(at, tl.sum(l1, 0))
    tl.store(at + programs, tl.sum(dissimilarity, 0))
    tl.store(at + 2 * programs, tl.sum(count, 0))


@triton.jit
def _add_up(partials, programs, l1_weight, ssim_weight, loss, share, SUMMED: tl.constexpr):
    """The loss from the sums of all programs, and the share 1 / count that a value has in a mean; one program."""
    lane = tl.arange(0, SUMMED)
    l1 = tl.zeros([SUMMED], tl.float64)
    dissimilarity, count = l1, l1
    start = 0
    while start < programs:
        at = start + lane
        inside = at < programs
        l1 += tl.load(partials + at, mask=inside, other=0.0)
        dissimilarity += tl.load(partials + programs + at, mask=inside, other=0.0)
        count += tl.load(partials + 2 * programs + at, mask=inside, other=0.0)
        start += SUMMED
    one = 1 / tl.maximum(tl.sum(count, 0), 1.0)
    total = one * (l1_weight * tl.sum(l1, 0) + ssim_weight * tl.sum(dissimilarity, 0))
    tl.store(loss, total.to(tl.float32))
    tl.store(share, one.to(tl.float32))


@triton.jit
def _slope(
    image,
    target,
    mask,
    derivatives,
    share,
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
    """The loss's gradient by `image`, (H, 3W), over one strip of a column block."""
    column = tl.program_id(0) * COLUMNS + tl.arange(0, COLUMNS)
    inside = column < floats
    top = tl.program_id(1) * STRIP
    scale = tl.load(share) * tl.load(upstream)
    zero = tl.zeros([COLUMNS], tl.float32)
    empty = (zero,) * 11
    by_xs, by_squares, by_products = empty, empty, empty
    for step in range(STRIP + 2 * _RADIUS):
        row = top + step - _RADIUS
        blurred = (zero,) * 3
        if (row >= 0) & (row < height):
            at = derivatives + row.to(tl.int64) * floats + column
            by_x, by_square = _blur(_taps(at, column, floats, 3)), _blur(_taps(at + plane, column, floats, 3))
            blurred = by_x, by_square, _blur(_taps(at + plane + plane, column, floats, 3))
        by_xs, by_squares = by_xs[1:] + (blurred[0],), by_squares[1:] + (blurred[1],)
        by_products = by_products[1:] + (blurred[2],)
        row -= _RADIUS
        if (row >= top) & (row < height):
            start = row.to(tl.int64) * floats
            counts = inside
            if mask is not None:
                counts = tl.load(mask + start // 3 + column // 3, mask=inside, other=0) != 0
            x = tl.load(image + start + column, mask=counts, other=0.0)
            y = tl.load(target + start + column, mask=counts, other=0.0)
            ssim = _blur(by_xs) + 2 * x * _blur(by_squares) + y * _blur(by_products)
            sign = tl.where(x > y, 1.0, tl.where(x < y, -1.0, 0.0))
            slope = scale * (l1_weight * sign - ssim_weight * ssim)
            tl.store(gradient + start + column, tl.where(counts, slope, 0.0), mask=inside)


def _grid(image: Tensor) -> tuple[int, int]:
    return triton.cdiv(3 * image.shape[1], _COLUMNS), triton.cdiv(image.shape[0], _STRIP)


def loss_and_derivatives(
    image: Tensor, target: Tensor, mask: Tensor | None, l1_weight: float, ssim_weight: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Weighted sum of the means of |image - target| and of 1 - SSIM, and what its gradient needs.

    Args:
        image, target: (H, W, 3) float32, contiguous.
        mask: (H, W) bool, contiguous, True where a pixel counts; elsewhere `image` is taken to be `target`. None
            counts all.
        l1_weight, ssim_weight: factors of the two means.

    Returns:
        The loss, a scalar; (3, H, W, 3) derivatives of each pixel's SSIM by its local means of x, xx and xy; and the
        scalar 1 / count of a mean. All on the device.
    """
    height, floats = image.shape[0], 3 * image.shape[1]
    grid = _grid(image)
    programs = grid[0] * grid[1]
    derivatives = image.new_empty(3, *image.shape)
    partials = image.new_empty(3, programs)
    loss, share = image.new_empty(()), image.new_empty(())
    _measure[grid](
        image,
        target,
        mask,
        derivatives,
        partials,
        height,
        floats,
        height * floats,
        COLUMNS=_COLUMNS,
        STRIP=_STRIP,
        **_OPTIONS,
    )
    _add_up[(1,)](partials, programs, l1_weight, ssim_weight, loss, share, SUMMED=_SUMMED, **_OPTIONS)
    return loss, derivatives, share


def gradient(
    image: Tensor,
    target: Tensor,
    mask: Tensor | None,
    derivatives: Tensor,
    share: Tensor,
    l1_weight: float,
    ssim_weight: float,
    upstream: Tensor,
) -> Tensor:
    """The gradient by `image`, (H, W, 3), times the scalar `upstream`; the rest is as for `loss_and_derivatives`."""
    height, floats = image.shape[0], 3 * image.shape[1]
    gradient = torch.empty_like(image)
    _slope[_grid(image)](
        image,
        target,
        mask,
        derivatives,
        share,
        upstream,
        gradient,
        height,
        floats,
        height * floats,
        l1_weight,
        ssim_weight,
        COLUMNS=_COLUMNS,
        STRIP=_STRIP,
        **_OPTIONS,
    )
    return gradient

"""Implements compositing in Triton: one launch forward, two backward.

Each node gathers its gradient from the pixels around it, so that equal runs give equal bits.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

_ELEMENTS_PER_PROGRAM = 256  # An element is a pixel or a grid node.


@triton.jit
def _interpolate_background(grid, strides, channel: tl.constexpr, y, x, stride, live):
    """Return one channel of the background, interpolated at pixels (y, x)."""
    row, column = y // stride, x // stride
    down, right = (y % stride).to(tl.float32) / stride, (x % stride).to(tl.float32) / stride
    at = grid + row * strides[0] + column * strides[1] + channel * strides[2]
    # Offsets are 0 at nodes, so that nothing past the last node is read.
    below, beside = tl.where(down > 0, strides[0], 0), tl.where(right > 0, strides[1], 0)
    first, second = tl.load(at, mask=live, other=0.0), tl.load(at + beside, mask=live, other=0.0)
    third, fourth = tl.load(at + below, mask=live, other=0.0), tl.load(at + below + beside, mask=live, other=0.0)
    upper, lower = first + right * (second - first), third + right * (fourth - third)
    return upper + down * (lower - upper)


@triton.jit
def _pixel_block(width, total, BLOCK: tl.constexpr):
    """Return the index, row and column of this program's pixels, and a mask of those inside the image."""
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    return pixel.to(tl.int64), pixel // width, pixel % width, pixel < total


@triton.jit(do_not_specialize=["width", "total", "row", "column", "channel", "stride"])
def composite_kernel(
    rgb, transmittance, grid, row, column, channel, stride, width, total, out, BLOCK: tl.constexpr
):  # fmt: skip
    """Write the composited image (H, W, 3). row, column, channel: strides of the grid."""
    pixel, y, x, live = _pixel_block(width, total, BLOCK)
    transmitted = tl.load(transmittance + pixel, mask=live, other=0.0)
    for part in tl.static_range(3):
        front = tl.load(rgb + pixel * 3 + part, mask=live, other=0.0)
        background = _interpolate_background(grid, (row, column, channel), part, y, x, stride, live)
        tl.store(out + pixel * 3 + part, front + transmitted * background, mask=live)


@triton.jit(do_not_specialize=["width", "total", "row", "column", "channel", "stride"])
def grad_transmittance_kernel(
    grad, grid, row, column, channel, stride, width, total, grad_transmittance, BLOCK: tl.constexpr
):
    """Write the gradient of the transmittance (H, W)."""
    pixel, y, x, live = _pixel_block(width, total, BLOCK)
    gradient = tl.zeros([BLOCK], tl.float32)
    for part in tl.static_range(3):
        background = _interpolate_background(grid, (row, column, channel), part, y, x, stride, live)
        gradient += tl.load(grad + pixel * 3 + part, mask=live, other=0.0) * background
    tl.store(grad_transmittance + pixel, gradient, mask=live)


@triton.jit(do_not_specialize=["height", "width", "columns", "total", "stride"])
def grad_grid_kernel(grad, transmittance, stride, height, width, columns, total, grad_grid, BLOCK: tl.constexpr):
    """Write the gradient of the grid, planar (3, R, S)."""
    node = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = node < total
    row, column = node // columns * stride, node % columns * stride
    red, green, blue = tl.zeros([BLOCK], tl.float32), tl.zeros([BLOCK], tl.float32), tl.zeros([BLOCK], tl.float32)
    down = 1 - stride
    while down < stride:
        right = 1 - stride
        while right < stride:
            y, x = row + down, column + right
            inside = live & (y >= 0) & (y < height) & (x >= 0) & (x < width)
            pixel = y.to(tl.int64) * width + x
            share = (1 - tl.abs(down).to(tl.float32) / stride) * (1 - tl.abs(right).to(tl.float32) / stride)
            transmitted = share * tl.load(transmittance + pixel, mask=inside, other=0.0)
            red += transmitted * tl.load(grad + pixel * 3, mask=inside, other=0.0)
            green += transmitted * tl.load(grad + pixel * 3 + 1, mask=inside, other=0.0)
            blue += transmitted * tl.load(grad + pixel * 3 + 2, mask=inside, other=0.0)
            right += 1
        down += 1
    at = grad_grid + node.to(tl.int64)
    tl.store(at, red, mask=live)
    tl.store(at + total, green, mask=live)
    tl.store(at + 2 * total.to(tl.int64), blue, mask=live)


class _Composite(torch.autograd.Function):
    """Autograd function of `composite`."""

    @staticmethod
    def forward(ctx, rgb: Tensor, transmittance: Tensor, grid: Tensor, stride: int) -> Tensor:
        rgb, transmittance = rgb.detach().contiguous(), transmittance.detach().contiguous()
        picture = torch.empty_like(rgb)
        composite_kernel[(triton.cdiv(transmittance.numel(), _ELEMENTS_PER_PROGRAM),)](
            rgb, transmittance, grid.detach(), *grid.stride(), stride, transmittance.shape[1], transmittance.numel(),
            picture, BLOCK=_ELEMENTS_PER_PROGRAM, num_warps=4, enable_fp_fusion=True,
        )  # fmt: skip
        ctx.save_for_backward(transmittance, grid)
        ctx.stride = stride
        return picture

    @staticmethod
    @once_differentiable
    def backward(ctx, grad: Tensor) -> tuple[Tensor | None, ...]:
        transmittance, grid = ctx.saved_tensors
        (height, width), (rows, columns, _), pixels = transmittance.shape, grid.shape, transmittance.numel()
        contiguous, grad_transmittance, grad_grid = grad.contiguous(), None, None
        if ctx.needs_input_grad[1]:
            grad_transmittance = torch.empty_like(transmittance)
            grad_transmittance_kernel[(triton.cdiv(pixels, _ELEMENTS_PER_PROGRAM),)](
                contiguous, grid, *grid.stride(), ctx.stride, width, pixels, grad_transmittance,
                BLOCK=_ELEMENTS_PER_PROGRAM, num_warps=4, enable_fp_fusion=True,
            )  # fmt: skip
        if ctx.needs_input_grad[2]:
            grad_grid = grid.new_empty(3, rows, columns)
            grad_grid_kernel[(triton.cdiv(rows * columns, _ELEMENTS_PER_PROGRAM),)](
                contiguous, transmittance, ctx.stride, height, width, columns, rows * columns, grad_grid,
                BLOCK=_ELEMENTS_PER_PROGRAM, num_warps=4, enable_fp_fusion=True,
            )  # fmt: skip
            grad_grid = grad_grid.permute(1, 2, 0)
        return grad, grad_transmittance, grad_grid, None


def composite(rgb: Tensor, transmittance: Tensor, grid: Tensor, stride: int) -> Tensor:
    """Compute `hyrfpack.ops.composite.composite`."""
    return _Composite.apply(rgb, transmittance, grid, stride)

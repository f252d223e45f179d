"""Composites on the CPU in Numba: one pass over the image forward, and one backward.

A task owns a range of the grid's rows. It interpolates each row of nodes along x once, into a line as wide as the
image, and blends two such lines for each row of pixels. The backward pass transposes this: rows of pixels add up in two
lines, and each node gathers from the finished line around it. Pixels between two tasks are read by both, so that every
sum has one owner and a fixed order, for any number of threads.

A pixel at a node takes nothing from other nodes, not even NaN, which torch's interpolation multiplies by 0.

Pixels stay interleaved. All lines of a task lie in one buffer, so that the loops vectorise with few alias checks.
"""

from __future__ import annotations

from collections.abc import Callable

import numba
import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from hyrfpack.parallel.compiled import compiled
from hyrfpack.parallel.pool import run_ranges

# NaN and infinite values must come through, so only products and sums are contracted.
_FAST_MATH = {"contract", "nsz"}
njit = compiled(fastmath=_FAST_MATH, error_model="numpy")
# Inlining is forced, so that cached kernels round like freshly compiled ones (see hyrfpack/ops/ssim/cpu.py).
inlined = numba.njit(fastmath=_FAST_MATH, error_model="numpy", forceinline=True)

_MIN_PIXELS_PER_TASK = 16384  # Fewer pixels are finished before another thread has started.

# Constants are typed, so that indices stay uint64 and values float32 in the kernels.
_U1, _U2, _U3 = np.uint64(1), np.uint64(2), np.uint64(3)
_FLOAT32_0, _FLOAT32_1 = np.float32(0), np.float32(1)


@inlined
def _interpolate_across(grid, row, stride, lines, line):
    """Interpolate one row of nodes (R, 3 S) along x, from its first to its last node."""
    columns = grid.shape[1] // 3
    for j in range(columns):
        node = np.uint64(3 * j)
        pixel = line + np.uint64(3 * j * stride)
        first, second, third = grid[row, node], grid[row, node + _U1], grid[row, node + _U2]
        lines[pixel], lines[pixel + _U1], lines[pixel + _U2] = first, second, third
    for phase in range(1, stride):
        right = np.float32(phase) / np.float32(stride)
        left = _FLOAT32_1 - right
        for j in range(columns - 1):
            node = np.uint64(3 * j)
            pixel = line + np.uint64(3 * (j * stride + phase))
            for c in range(3):
                c = np.uint64(c)
                lines[pixel + c] = left * grid[row, node + c] + right * grid[row, node + _U3 + c]


@inlined
def _repeat_transmittance(transmittance, y, lines, line):
    """Write each pixel's transmittance three times, once for each channel."""
    for x in range(transmittance.shape[1]):
        x = np.uint64(x)
        transmitted = transmittance[y, x]
        pixel = line + _U3 * x
        lines[pixel], lines[pixel + _U1], lines[pixel + _U2] = transmitted, transmitted, transmitted


@njit
def _composite_rows(start, stop, rgb, transmittance, grid, stride, out):
    """Composite the pixels from row `start` of the grid to before row `stop`."""
    height, floats = rgb.shape
    line_floats = (grid.shape[1] - 3) * stride + 3
    lines = np.empty(3 * line_floats, np.float32)
    upper, lower, light = np.uint64(0), np.uint64(line_floats), np.uint64(2 * line_floats)
    _interpolate_across(grid, np.uint64(start), stride, lines, upper)
    for row in range(start, stop):
        if row + 1 < grid.shape[0]:
            _interpolate_across(grid, np.uint64(row + 1), stride, lines, lower)
        for phase in range(min(stride, height - row * stride)):
            y = np.uint64(row * stride + phase)
            _repeat_transmittance(transmittance, y, lines, light)
            if phase == 0:
                for k in range(floats):
                    k = np.uint64(k)
                    out[y, k] = rgb[y, k] + lines[light + k] * lines[upper + k]
            else:
                down = np.float32(phase) / np.float32(stride)
                up = _FLOAT32_1 - down
                for k in range(floats):
                    k = np.uint64(k)
                    out[y, k] = rgb[y, k] + lines[light + k] * (up * lines[upper + k] + down * lines[lower + k])
        upper, lower = lower, upper


@inlined
def _sum_channels(lines, line, out, y):
    """Write the sum of each pixel's three channels to row y."""
    for x in range(out.shape[1]):
        x = np.uint64(x)
        pixel = line + _U3 * x
        out[y, x] = lines[pixel] + lines[pixel + _U1] + lines[pixel + _U2]


@njit
def _grad_transmittance_rows(start, stop, grad, grid, stride, grad_transmittance):
    """Write the gradient of the transmittance from row `start` of the grid to before row `stop`."""
    height, floats = grad.shape
    line_floats = (grid.shape[1] - 3) * stride + 3
    lines = np.empty(3 * line_floats, np.float32)
    upper, lower, product = np.uint64(0), np.uint64(line_floats), np.uint64(2 * line_floats)
    _interpolate_across(grid, np.uint64(start), stride, lines, upper)
    for row in range(start, stop):
        if row + 1 < grid.shape[0]:
            _interpolate_across(grid, np.uint64(row + 1), stride, lines, lower)
        for phase in range(min(stride, height - row * stride)):
            y = np.uint64(row * stride + phase)
            if phase == 0:
                for k in range(floats):
                    k = np.uint64(k)
                    lines[product + k] = grad[y, k] * lines[upper + k]
            else:
                down = np.float32(phase) / np.float32(stride)
                up = _FLOAT32_1 - down
                for k in range(floats):
                    k = np.uint64(k)
                    lines[product + k] = grad[y, k] * (up * lines[upper + k] + down * lines[lower + k])
            _sum_channels(lines, product, grad_transmittance, y)
        upper, lower = lower, upper


@inlined
def _gather_across(lines, line, stride, grad_grid, row):
    """Write the gradient of one row of nodes, the first of which is at `line`.

    The line has stride - 1 pixels more on both sides. They are zero, as are pixels past the image's edge.
    """
    for j in range(grad_grid.shape[1] // 3):
        node = np.uint64(3 * j)
        first, second, third = _FLOAT32_0, _FLOAT32_0, _FLOAT32_0
        pixel = line + np.uint64(3 * j * stride) - np.uint64(3 * (stride - 1))
        for phase in range(1 - stride, stride):
            share = np.float32(stride - abs(phase)) / np.float32(stride)
            first += share * lines[pixel]
            second += share * lines[pixel + _U1]
            third += share * lines[pixel + _U2]
            pixel += _U3
        grad_grid[row, node], grad_grid[row, node + _U1], grad_grid[row, node + _U2] = first, second, third


@njit
def _grad_grid_rows(start, stop, grad, transmittance, stride, grad_grid):
    """Write the gradient of rows `start` to before `stop` of the grid."""
    height, floats = grad.shape
    margin = 3 * (stride - 1)
    line_floats = grad_grid.shape[1] * stride + margin
    lines = np.zeros(3 * line_floats, np.float32)
    upper, lower, light = np.uint64(margin), np.uint64(line_floats + margin), np.uint64(2 * line_floats)
    for row in range(max(0, start - 1), stop):
        # The row of pixels at the nodes before the first row of this task belongs to those nodes alone.
        for phase in range(1 if row < start else 0, min(stride, height - row * stride)):
            y = np.uint64(row * stride + phase)
            _repeat_transmittance(transmittance, y, lines, light)
            if phase == 0:
                for k in range(floats):
                    k = np.uint64(k)
                    lines[upper + k] += lines[light + k] * grad[y, k]
            else:
                down = np.float32(phase) / np.float32(stride)
                up = _FLOAT32_1 - down
                for k in range(floats):
                    k = np.uint64(k)
                    transmitted = lines[light + k] * grad[y, k]
                    lines[upper + k] += up * transmitted
                    lines[lower + k] += down * transmitted
        if row >= start:
            _gather_across(lines, upper, stride, grad_grid, np.uint64(row))
        for k in range(floats):
            lines[upper + np.uint64(k)] = _FLOAT32_0
        upper, lower = lower, upper


def _flat(tensor: Tensor) -> np.ndarray:
    """Return a tensor (H, W, 3) as an array (H, 3 W), and (H, W) as such; it is copied unless it is contiguous."""
    return tensor.detach().contiguous().flatten(1).numpy()


class _Composite(torch.autograd.Function):
    """Autograd function of `composite`."""

    @staticmethod
    def forward(ctx, rgb: Tensor, transmittance: Tensor, grid: Tensor, stride: int) -> Tensor:
        ctx.save_for_backward(transmittance, grid)
        ctx.stride = stride
        picture = rgb.new_empty(rgb.shape)
        arguments = _flat(rgb), _flat(transmittance), _flat(grid), stride, _flat(picture)
        _run_rows(lambda start, stop: _composite_rows(start, stop, *arguments), transmittance, grid, stride)
        return picture

    @staticmethod
    @once_differentiable
    def backward(ctx, grad: Tensor) -> tuple[Tensor | None, ...]:
        transmittance, grid = ctx.saved_tensors
        stride, upstream, grad_transmittance, grad_grid = ctx.stride, _flat(grad), None, None
        if ctx.needs_input_grad[1]:
            grad_transmittance = transmittance.new_empty(transmittance.shape)
            light = upstream, _flat(grid), stride, _flat(grad_transmittance)
            _run_rows(lambda start, stop: _grad_transmittance_rows(start, stop, *light), transmittance, grid, stride)
        if ctx.needs_input_grad[2]:
            grad_grid = grid.new_empty(grid.shape)
            nodes = upstream, _flat(transmittance), stride, _flat(grad_grid)
            _run_rows(lambda start, stop: _grad_grid_rows(start, stop, *nodes), transmittance, grid, stride)
        return grad, grad_transmittance, grad_grid, None


def _run_rows(task: Callable[[int, int], None], transmittance: Tensor, grid: Tensor, stride: int) -> None:
    """Call task(start, stop) on contiguous ranges of the grid's rows that together are all rows."""
    run_ranges(task, len(grid), -(-_MIN_PIXELS_PER_TASK // max(1, stride * transmittance.shape[1])))


def composite(rgb: Tensor, transmittance: Tensor, grid: Tensor, stride: int) -> Tensor:
    """Compute `hyrfpack.ops.composite.composite`."""
    return _Composite.apply(rgb, transmittance, grid, stride)

"""Selects rows of arrays and puts them back, also where only the device knows how many rows are in use.

An array on a GPU may have more rows than are in use. `used`, (1,) int64 on the device, then holds the number of first
rows in use, which the host need not know. The other rows are undefined, and no operation lets them touch a result.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable


def take_rows(values: Tensor, index: Tensor, used: Tensor | None = None) -> Tensor:
    """Return the rows values[index], differentiable.

    As no row is taken twice, the backward pass copies gradients instead of summing them, for which torch would sort the
    indices.

    Args:
        values: (N, C); float32 on a GPU if `used` is given.
        index: (n,) int64 without repeated indices.
        used: (1,) int64, the number of first indices in use; None if all are.

    Returns:
        (n, C), undefined from row `used` on.
    """
    return _TakeRows.apply(values, index, used)


def place_rows(rows: Tensor, index: Tensor, used: Tensor, total: int) -> Tensor:
    """Return zeros (total, C) with the rows in use at their indices, differentiable; the opposite of `take_rows`.

    Args:
        rows: (n, C) float32 on a GPU.
        index: (n,) int64 without repeated indices.
        used: (1,) int64, the number of first rows in use.
        total: number of rows of the result, which is stored column by column.
    """
    return _PlaceRows.apply(rows, index, used, total)


def clear_unused_rows(values: Tensor, used: Tensor) -> Tensor:
    """Return values (n, ...) with zeros in the rows that are not in use, and so in their gradient.

    Implementations that take all rows for used ones get such inputs, so that undefined rows do not touch their sums.
    """
    is_used = torch.arange(len(values), device=values.device) < used
    return torch.where(is_used.view(-1, *[1] * (values.ndim - 1)), values, 0)


class _TakeRows(torch.autograd.Function):
    @staticmethod
    def forward(ctx, values: Tensor, index: Tensor, used: Tensor | None) -> Tensor:
        ctx.save_for_backward(index, used)
        ctx.shape = values.shape
        if used is None:
            return values.index_select(0, index)
        from hyrfpack.ops import gpu_rows

        return gpu_rows.gather_rows(values, index, used)

    @staticmethod
    @once_differentiable
    def backward(ctx, grad: Tensor) -> tuple[Tensor, None, None]:
        index, used = ctx.saved_tensors
        if used is None:
            return grad.new_zeros(ctx.shape).index_copy_(0, index, grad), None, None
        from hyrfpack.ops import gpu_rows

        gradient = grad.new_zeros(ctx.shape)
        gpu_rows.scatter_rows(grad, index, used, gradient)
        return gradient, None, None


class _PlaceRows(torch.autograd.Function):
    @staticmethod
    def forward(ctx, rows: Tensor, index: Tensor, used: Tensor, total: int) -> Tensor:
        from hyrfpack.ops import gpu_rows

        ctx.save_for_backward(index, used)
        values = rows.new_zeros(rows.shape[1], total).T
        gpu_rows.scatter_rows(rows, index, used, values)
        return values

    @staticmethod
    @once_differentiable
    def backward(ctx, grad: Tensor) -> tuple[Tensor, None, None, None]:
        from hyrfpack.ops import gpu_rows

        return gpu_rows.gather_rows(grad, *ctx.saved_tensors), None, None, None

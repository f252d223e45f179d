"""Multiresolution hash encoding (instant-ngp): maps points of the unit cube to features from tables of all levels."""

from __future__ import annotations

from types import ModuleType

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from hyrfpack.ops.dispatch import choose_implementation
from hyrfpack.ops.hash_encode import reference
from hyrfpack.ops.hash_encode.reference import cells, corner_rows, level_offsets, level_resolutions
from hyrfpack.ops.rows import clear_unused_rows

__all__ = ["cells", "corner_rows", "hash_encode", "level_offsets", "level_resolutions"]


def hash_encode(
    coords: Tensor,
    table: Tensor,
    resolutions: tuple[int, ...],
    log2_table_size: int,
    *,
    used: Tensor | None = None,
    implementation: str = "auto",
) -> Tensor:
    """Interpolate features trilinearly between the 8 vertices around each point, on every level.

    A level with r vertices per axis scales a point to x = coords * (r - 1); its cell is floor(x), clamped to
    [0, r - 2]. If all r^3 vertices fit into the level's table, each vertex has its own row (dense level). Otherwise
    instant-ngp's spatial hash assigns the rows, and vertices may share one (see `corner_rows`).

    Args:
        coords: (N, 3) points in [0, 1], finite; outside, the nearest cell is extrapolated.
        table: (rows, F) features of all levels, concatenated as `level_offsets` defines.
        resolutions: (L,) vertices per axis, each at least 2; see `level_resolutions`.
        log2_table_size: base-2 logarithm of the maximum number of rows per level; 1 to 28.
        used: the number of points in use, see `hyrfpack.ops.rows`; None if all are.
        implementation: "auto", "reference", "cpu" or "gpu" (the last two take float32 and two features per level).

    Returns:
        (N, L * F) features, ordered by level. "cpu" and "gpu" store them planar, as the transpose of a contiguous
        (L * F, N). Callers that keep this layout, as `mlp` does, avoid a copy or slow reads in backward.
        Differentiable once in `table` and, within the cell of each point, in `coords`. On "gpu" the order of additions
        to the gradient of `table` varies, so its last bits differ from run to run.

    Raises:
        ValueError: shapes, sizes, dtypes or devices do not match.

    Example:
        >>> table = torch.ones(8 + 64, 2)  # rows for 2 x 2 x 2 and 4 x 4 x 4 vertices
        >>> hash_encode(torch.rand(5, 3), table, (2, 4), log2_table_size=6).shape
        torch.Size([5, 4])
    """
    if coords.ndim != 2 or coords.shape[1] != 3 or table.ndim != 2:
        raise ValueError(f"coords {tuple(coords.shape)} must be (N, 3) and table {tuple(table.shape)} (rows, F)")
    if not resolutions or min(resolutions) < 2 or not 1 <= log2_table_size <= 28:
        raise ValueError(
            f"resolutions {resolutions} need 2 vertices or more, log2_table_size {log2_table_size} 1 to 28"
        )
    rows = level_offsets(resolutions, log2_table_size)[-1]
    if table.shape[0] != rows:
        raise ValueError(f"table has {table.shape[0]} rows; these levels need {rows}")
    available = ("reference", "cpu", "gpu") if table.shape[1] == 2 else ("reference",)
    chosen = choose_implementation("hash_encode", implementation, available, coords, table)
    if chosen == "gpu":
        return _HashEncode.apply(coords, table, tuple(resolutions), log2_table_size, _kernels(chosen), used)
    if used is not None:
        coords = clear_unused_rows(coords, used)
    if chosen == "reference":
        features = reference.hash_encode(coords, table, resolutions, log2_table_size)
    else:
        features = _HashEncode.apply(coords, table, tuple(resolutions), log2_table_size, _kernels(chosen))
    return features if used is None else clear_unused_rows(features, used)


def _kernels(implementation: str) -> ModuleType:
    """Import and return the module of an implementation. It is imported late, since its dependencies are optional."""
    if implementation == "gpu":
        from hyrfpack.ops.hash_encode import gpu

        return gpu
    from hyrfpack.ops.hash_encode import cpu

    return cpu


class _HashEncode(torch.autograd.Function):
    """Autograd function of `hash_encode` for the kernels of one module."""

    @staticmethod
    def forward(
        ctx,
        coords: Tensor,
        table: Tensor,
        resolutions: tuple[int, ...],
        log2_table_size: int,
        kernels: ModuleType,
        *used: Tensor | None,
    ) -> Tensor:
        ctx.save_for_backward(coords, table, *used)
        ctx.settings = resolutions, log2_table_size
        ctx.kernels = kernels
        return kernels.encode(coords, table, resolutions, log2_table_size, *used)

    @staticmethod
    @once_differentiable
    def backward(ctx, grad: Tensor) -> tuple[Tensor | None, ...]:
        coords, table, *used = ctx.saved_tensors
        arguments = (coords, table, *ctx.settings, grad, *used)
        needs_coords, needs_table = ctx.needs_input_grad[:2]
        return (
            ctx.kernels.grad_coords(*arguments) if needs_coords else None,
            ctx.kernels.grad_table(*arguments) if needs_table else None,
            *[None] * (3 + len(used)),
        )

"""Measure speed and error of a field's two parts, hash encoding and MLP, against their torch references."""

from __future__ import annotations

import torch
from torch import Tensor

from hyrfpack.bench.operation_calls import OperationCall, make_hash_encode_call, make_mlp_call
from hyrfpack.measure.error import measure_relative_error
from hyrfpack.measure.timing import time_alternately
from hyrfpack.ops.hash_encode import level_offsets, level_resolutions

TIMING_REPEATS = 5
# Number of points and log2_table_size.
HASH_SIZES = ((50_000, 12), (50_000, 14), (50_000, 17), (200_000, 18))
# Number of rows and the share of rows whose gradient is zero, which the CPU kernel skips.
MLP_SIZES = ((50_000, 0.0), (50_000, 0.3), (10_000, 0.3))


def prepare_hash_encode(points: int, log2_table_size: int) -> tuple[OperationCall, Tensor]:
    """Return a call with 16 levels of resolutions 64 to 1024, and the gradient of its features.

    The gradient is stored by columns, as `mlp` returns it.
    """
    random = torch.Generator().manual_seed(0)
    resolutions = level_resolutions(16, 64, 1024)
    coords = torch.rand(points, 3, generator=random)
    table = 2 * torch.rand(level_offsets(resolutions, log2_table_size)[-1], 2, generator=random) - 1
    upstream = torch.randn(32, points, generator=random).T
    return make_hash_encode_call(coords, table, resolutions, log2_table_size), upstream


def prepare_mlp(rows: int, zero_gradient_share: float) -> tuple[OperationCall, Tensor]:
    """Return a call with layers 32-64-64-8, and the gradient of its outputs."""
    random = torch.Generator().manual_seed(0)
    widths = (32, 64, 64, 8)
    x = torch.randn(32, rows, generator=random).T
    weights = [torch.randn(o, i, generator=random) / i**0.5 for i, o in zip(widths, widths[1:], strict=False)]
    upstream = torch.randn(rows, 8, generator=random)
    upstream[torch.rand(rows, generator=random) < zero_gradient_share] = 0
    return make_mlp_call(x, weights, list(map(torch.zeros, widths[1:]))), upstream


def compare(call: OperationCall, upstream: Tensor, items: int) -> list[dict]:
    """Return one row for the forward pass and one for the backward pass.

    `max_error` is the largest difference from the float64 reference over the reference's largest value. The time is
    divided by `items` and given in ns per item.
    """
    ours, reference = (
        call.separate_tasks(implementation, upstream=upstream) for implementation in ("cpu", "reference")
    )
    exact = call.separate_tasks("reference", torch.float64, upstream=upstream)
    rows = []
    passes = zip(("forward", "backward"), ours, reference, exact, strict=True)
    for pass_name, task, reference_task, exact_task in passes:
        times, _ = time_alternately({"cpu": task, "reference": reference_task}, TIMING_REPEATS)
        # The backward pass is compared by its first gradient: that of the table, or that of x.
        measured, expected = (part if pass_name == "forward" else part[0] for part in (task(), exact_task()))
        rows.append(
            {
                "pass": pass_name,
                "ms": times["cpu"].ms,
                "ns_an_item": 1e6 * times["cpu"].ms / items,
                "reference_ms": times["reference"].ms,
                "times_faster": times["reference"].ratio_to(times["cpu"]).wall,
                "max_error": measure_relative_error(measured, expected, pass_name).max,
            }
        )
    return rows


def bench() -> list[dict]:
    """Time both operations and their references in alternation; times are medians.

    An item is one point on one level (hash_encode) or one row (mlp).
    """
    rows = []
    for points, log2_table_size in HASH_SIZES:
        size = {"operation": "hash_encode", "size": f"{points:,} log2 {log2_table_size}"}
        rows += [size | row for row in compare(*prepare_hash_encode(points, log2_table_size), 16 * points)]
    for count, zero_gradient_share in MLP_SIZES:
        size = {"operation": "mlp", "size": f"{count:,}, {zero_gradient_share:.0%} without gradient"}
        rows += [size | row for row in compare(*prepare_mlp(count, zero_gradient_share), count)]
    return rows

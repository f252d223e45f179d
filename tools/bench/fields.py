"""Speed and error of what a field is made of, hash encoding and MLP, beside their torch references in the same run."""

from __future__ import annotations

import torch
from torch import Tensor

from hyrfpack.measure.error import measure_relative_error
from hyrfpack.measure.timing import time_alternately
from hyrfpack.model.operation_calls import OperationCall, hash_encode_call, mlp_call
from hyrfpack.ops.hash_encode import level_offsets, level_resolutions

REPEATS = 5
HASH_SIZES = ((50_000, 12), (50_000, 14), (50_000, 17), (200_000, 18))  # points, log2 of the table size
MLP_SIZES = ((50_000, 0.0), (50_000, 0.3), (10_000, 0.3))  # rows, share of them without a gradient


def hash_of(points: int, log2_table_size: int) -> tuple[OperationCall, Tensor]:
    """16 levels from 64 to 1024, and the gradient of their features, by columns as `mlp` hands it on."""
    random = torch.Generator().manual_seed(0)
    resolutions = level_resolutions(16, 64, 1024)
    coords = torch.rand(points, 3, generator=random)
    table = 2 * torch.rand(level_offsets(resolutions, log2_table_size)[-1], 2, generator=random) - 1
    return hash_encode_call(coords, table, resolutions, log2_table_size), torch.randn(32, points, generator=random).T


def mlp_of(rows: int, idle: float) -> tuple[OperationCall, Tensor]:
    """Layers 32-64-64-8, and the gradient of their outputs."""
    random = torch.Generator().manual_seed(0)
    widths = (32, 64, 64, 8)
    x = torch.randn(32, rows, generator=random).T
    weights = [torch.randn(o, i, generator=random) / i**0.5 for i, o in zip(widths, widths[1:], strict=False)]
    upstream = torch.randn(rows, 8, generator=random)
    upstream[torch.rand(rows, generator=random) < idle] = 0
    return mlp_call(x, weights, list(map(torch.zeros, widths[1:]))), upstream


def compare(call: OperationCall, upstream: Tensor, items: int) -> list[dict]:
    """One row for the forward pass and one for the backward; the error is against float64, over its largest value."""
    ours, reference = (call.separate_tasks(who, upstream=upstream) for who in ("cpu", "reference"))
    exact = call.separate_tasks("reference", torch.float64, upstream=upstream)
    rows = []
    for way, task, slow, right in zip(("forward", "backward"), ours, reference, exact, strict=True):
        times, _ = time_alternately({"cpu": task, "reference": slow}, REPEATS)
        # Of the backward pass the first gradient: the table's, and that of x.
        found, expected = (part if way == "forward" else part[0] for part in (task(), right()))
        rows.append(
            {
                "pass": way,
                "ms": times["cpu"].ms,
                "ns_an_item": 1e6 * times["cpu"].ms / items,
                "reference_ms": times["reference"].ms,
                "times_faster": times["reference"].ratio_to(times["cpu"]).wall,
                "max_error": measure_relative_error(found, expected, way).max,
            }
        )
    return rows


def bench() -> list[dict]:
    """Time both operations and their references, interleaved; medians. An item is a point on a level, or a row."""
    rows = []
    for points, log2_table_size in HASH_SIZES:
        size = {"operation": "hash_encode", "size": f"{points:,} log2 {log2_table_size}"}
        rows += [size | row for row in compare(*hash_of(points, log2_table_size), 16 * points)]
    for count, idle in MLP_SIZES:
        size = {"operation": "mlp", "size": f"{count:,} idle {idle:.0%}"}
        rows += [size | row for row in compare(*mlp_of(count, idle), count)]
    return rows


def main() -> None:
    for row in bench():
        print(row)


if __name__ == "__main__":
    main()

"""Speed and error of what a field is made of, hash encoding and MLP, beside their torch references in the same run."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from hyrfpack.measure.timing import take_turns
from hyrfpack.ops.hash_encode import hash_encode, level_offsets, level_resolutions
from hyrfpack.ops.mlp import mlp

REPEATS = 5
HASH_SIZES = ((50_000, 12), (50_000, 14), (50_000, 17), (200_000, 18))  # points, log2 of the table size
MLP_SIZES = ((50_000, 0.0), (50_000, 0.3), (10_000, 0.3))  # rows, share of them without a gradient

Passes = tuple[Callable[[], Tensor], Callable[[], Tensor]]


def hash_passes(points: int, log2_table_size: int, implementation: str, dtype: torch.dtype) -> Passes:
    """Forward pass, and backward pass into the table, of 16 levels from 64 to 1024."""
    random = torch.Generator().manual_seed(0)
    resolutions = level_resolutions(16, 64, 1024)
    coords = torch.rand(points, 3, generator=random).to(dtype)
    rows = level_offsets(resolutions, log2_table_size)[-1]
    table = (2 * torch.rand(rows, 2, generator=random) - 1).to(dtype).requires_grad_()
    upstream = torch.randn(32, points, generator=random).to(dtype).T

    def forward() -> Tensor:
        return hash_encode(coords, table, resolutions, log2_table_size, implementation=implementation)

    features = forward()
    return forward, lambda: torch.autograd.grad(features, table, upstream, retain_graph=True)[0]


def mlp_passes(rows: int, idle: float, implementation: str, dtype: torch.dtype) -> Passes:
    """Forward pass, and backward pass into everything (gradient of x returned), of layers 32-64-64-8."""
    random = torch.Generator().manual_seed(0)
    widths = (32, 64, 64, 8)
    x = torch.randn(32, rows, generator=random).to(dtype).T.requires_grad_()
    weights = [torch.randn(o, i, generator=random) / i**0.5 for i, o in zip(widths, widths[1:], strict=False)]
    parameters = [tensor.to(dtype).requires_grad_() for tensor in (*weights, *map(torch.zeros, widths[1:]))]
    upstream = torch.randn(rows, 8, generator=random).to(dtype)
    upstream[torch.rand(rows, generator=random) < idle] = 0

    def forward() -> Tensor:
        return mlp(x, parameters[:3], parameters[3:], implementation=implementation)

    result = forward()
    return forward, lambda: torch.autograd.grad(result, [x, *parameters], upstream, retain_graph=True)[0]


def compare(passes: Callable[[str, torch.dtype], Passes], items: int) -> list[dict]:
    """One row for the forward pass and one for the backward; the error is against float64, over its largest value."""
    ours, reference = passes("cpu", torch.float32), passes("reference", torch.float32)
    exact = passes("reference", torch.float64)
    rows = []
    for index, way in enumerate(("forward", "backward")):
        times, _ = take_turns({"cpu": ours[index], "reference": reference[index]}, REPEATS)
        expected = exact[index]()
        rows.append(
            {
                "pass": way,
                "ms": times["cpu"].ms,
                "ns_an_item": 1e6 * times["cpu"].ms / items,
                "reference_ms": times["reference"].ms,
                "times_faster": times["reference"].ms / times["cpu"].ms,
                "max_error": ((ours[index]() - expected).abs().max() / expected.abs().max()).item(),
            }
        )
    return rows


def bench() -> list[dict]:
    """Time both operations and their references, interleaved; medians. An item is a point on a level, or a row."""
    rows = []
    for points, log2_table_size in HASH_SIZES:
        measured = compare(lambda *how, size=(points, log2_table_size): hash_passes(*size, *how), 16 * points)
        rows += [{"operation": "hash_encode", "size": f"{points:,} log2 {log2_table_size}", **row} for row in measured]
    for count, idle in MLP_SIZES:
        measured = compare(lambda *how, size=(count, idle): mlp_passes(*size, *how), count)
        rows += [{"operation": "mlp", "size": f"{count:,} idle {idle:.0%}", **row} for row in measured]
    return rows


def main() -> None:
    for row in bench():
        print(row)


if __name__ == "__main__":
    main()

"""Check that the kernels are correct on this device: random calls against float64, and the tests marked `gpu`."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import torch
from torch import Tensor

from hyrfpack.bench.operation_calls import (
    OperationCall,
    make_hash_encode_call,
    make_loss_call,
    make_mlp_call,
    make_rasterize_call,
)
from hyrfpack.ops.hash_encode import level_offsets, level_resolutions
from hyrfpack.ops.rasterize import RasterSettings
from hyrfpack.ops.viewport import Viewport
from tools.gpu.compare import check_call
from tools.gpu.rows import Row
from tools.gpu.setup import Setup
from tools.gpu.suite import run_suite

TABLE_NAME = "Right on this device"
PYTEST_ITEM = "pytest"
SELF_TIMED_ITEMS = (PYTEST_ITEM,)


def items(setup: Setup) -> list[str]:
    """Return one item for all of pytest, then the names of the random calls.

    pytest keeps a time limit of its own, and so reports what it ran. This holds only if nothing runs before it.
    """
    return [PYTEST_ITEM, *CALL_FACTORIES]


def run(item: str, setup: Setup) -> Iterator[Row]:
    """Yield the row of one random call, or for pytest one row for each test file."""
    if item == PYTEST_ITEM:
        yield from (
            {"table": TABLE_NAME, **row} for row in run_suite(setup.test_paths, log=setup.log_path(PYTEST_ITEM))
        )
    else:
        yield {
            "table": TABLE_NAME,
            "case": item,
            **check_call(CALL_FACTORIES[item](setup.torch_device), setup.implementation),
        }


def _random_normal(seed: int, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def _rasterize(
    count: int, width: int, height: int, size: float, antialiased: bool = False
) -> Callable[[torch.device], OperationCall]:
    def make(device: torch.device) -> OperationCall:
        inputs = {
            "means": _random_normal(0, count, 3) * 0.8 + torch.tensor([0.0, 0.0, 4.0]),
            "quats": _random_normal(1, count, 4),
            "scales": size * torch.exp(0.5 * _random_normal(2, count, 3)),
            "opacities": torch.sigmoid(1.5 * _random_normal(3, count)),
            "colors": torch.sigmoid(_random_normal(4, count, 3)),
        }
        pose = torch.eye(4, dtype=torch.float64)
        viewport = Viewport(pose, (width, width, width / 2, height / 2), width, height)
        placed = {name: tensor.to(device) for name, tensor in inputs.items()}
        return make_rasterize_call(placed, viewport, RasterSettings(antialiased=antialiased))

    return make


def _hash_encode(points: int, log2: int, gradient_inputs: tuple[str, ...]) -> Callable[[torch.device], OperationCall]:
    def make(device: torch.device) -> OperationCall:
        resolutions = level_resolutions(16, 8, 512)
        # Coordinates have 16 bits, so that a point has the same cell and offset in every precision.
        coords = torch.randint(0, 1 << 16, (points, 3), generator=torch.Generator().manual_seed(0)) / (1 << 16)
        table = _random_normal(1, level_offsets(resolutions, log2)[-1], 2)
        return make_hash_encode_call(coords.to(device), table.to(device), resolutions, log2, gradient_inputs)

    return make


def _mlp(rows: int, widths: tuple[int, ...], mixed: bool) -> Callable[[torch.device], OperationCall]:
    def make(device: torch.device) -> OperationCall:
        x = _random_normal(0, rows, widths[0]).to(device)
        shapes = enumerate(zip(widths[1:], widths, strict=False))
        weights = [(_random_normal(layer + 1, o, i) / i**0.5).to(device) for layer, (o, i) in shapes]
        biases = [(0.1 * _random_normal(layer + 9, width)).to(device) for layer, width in enumerate(widths[1:])]
        return make_mlp_call(x, weights, biases, mixed)

    return make


def _loss(height: int, width: int, share: float | None) -> Callable[[torch.device], OperationCall]:
    def make(device: torch.device) -> OperationCall:
        target = torch.sigmoid(_random_normal(0, height, width, 3))
        image = (target + 0.1 * _random_normal(1, height, width, 3)).clamp(0, 1)
        mask = None if share is None else (_random_normal(2, height, width).sigmoid() < share).to(device)
        return make_loss_call(image.to(device), target.to(device), mask)

    return make


CALL_FACTORIES: dict[str, Callable[[torch.device], OperationCall]] = {
    "rasterize, 400 Gaussians, 45 x 37": _rasterize(400, 45, 37, 0.1),
    "rasterize, 3,000 small Gaussians, 64 x 48": _rasterize(3000, 64, 48, 0.02),
    "rasterize, antialiased": _rasterize(300, 48, 32, 0.03, antialiased=True),
    "rasterize, one large Gaussian": _rasterize(1, 33, 20, 2.0),
    "hash encode, 3,000 points, hashed": _hash_encode(3000, 12, ("table",)),
    "hash encode, gradient of coordinates": _hash_encode(500, 14, ("coords", "table")),
    "mlp 32-64-64-8, float32": _mlp(3001, (32, 64, 64, 8), False),
    "mlp 56-64-64-3, float32": _mlp(1000, (56, 64, 64, 3), False),
    "mlp 32-64-64-8, mixed": _mlp(3001, (32, 64, 64, 8), True),
    "mlp 56-64-64-3, mixed": _mlp(1000, (56, 64, 64, 3), True),
    "loss, 61 x 83": _loss(61, 83, None),
    "loss, half masked": _loss(40, 50, 0.5),
}

"""Rows in use: what a GPU leaves undefined in the other rows touches no result and no gradient."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import pytest
import torch
from ops.device import gpu, needs_triton
from torch import Tensor

from hyrfpack.ops.activate import activate_geometry
from hyrfpack.ops.contraction import contract
from hyrfpack.ops.hash_encode import hash_encode, level_offsets
from hyrfpack.ops.mlp import mlp
from hyrfpack.ops.rasterize import Gaussians3D, Rasterization, RasterSettings, rasterize
from hyrfpack.ops.rasterize.cull import frustum_cull, frustum_cull_into
from hyrfpack.ops.rows import clear_unused_rows, place_rows, take_rows
from hyrfpack.ops.shade import encode_views
from hyrfpack.ops.viewport import Viewport

pytestmark = needs_triton

TOTAL_ROWS, USED_ROWS = 300, 100  # Kernels have blocks of at most 256 rows, so that one program has no row in use.
RESOLUTIONS, LOG2_TABLE_SIZE = (3, 9), 6


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def count_of(rows: int) -> Tensor:
    """Return a number of rows in use on the device of the kernels."""
    return gpu(torch.tensor([rows]))


@dataclass(frozen=True)
class Operation:
    """An operation on rows: its inputs by name, of which `rows` have a row for each point, and how it is called."""

    inputs: Mapping[str, Tensor]
    rows: tuple[str, ...]
    run: Callable[..., Tensor]
    learns: tuple[str, ...]
    implementations: tuple[str, ...]


def make_layers() -> dict[str, Tensor]:
    return {
        **{f"w{i}": normal(o, n, seed=i) / n**0.5 for i, (n, o) in enumerate(((9, 16), (16, 16), (16, 3)))},
        **{f"b{i}": normal(o, seed=9 + i) for i, o in enumerate((16, 16, 3))},
    }


def run_mlp(x: Mapping[str, Tensor], **options) -> Tensor:
    return mlp(x["x"], [x[f"w{i}"] for i in range(3)], [x[f"b{i}"] for i in range(3)], **options)


def run_activate(x: Mapping[str, Tensor], **options) -> Tensor:
    scales, quats, opacities = activate_geometry(x["raw"], x["positions"], x["scale"], x["opacity"], **options)
    return torch.cat((scales, quats, opacities[:, None]), 1)


OPERATIONS = {
    "mlp": Operation(
        {"x": normal(TOTAL_ROWS, 9), **make_layers()},
        ("x",),
        run_mlp,
        ("x", *make_layers()),
        ("reference", "cpu", "gpu"),
    ),
    "hash_encode": Operation(
        {
            "coords": torch.rand(TOTAL_ROWS, 3, generator=torch.Generator().manual_seed(1)),
            "table": normal(level_offsets(RESOLUTIONS, LOG2_TABLE_SIZE)[-1], 2),
        },
        ("coords",),
        lambda x, **options: hash_encode(x["coords"], x["table"], RESOLUTIONS, LOG2_TABLE_SIZE, **options),
        ("coords", "table"),
        ("reference", "cpu", "gpu"),
    ),
    "contract": Operation(
        {"points": normal(TOTAL_ROWS, 3)},
        ("points",),
        lambda x, **options: contract(x["points"], **options),
        (),
        ("gpu",),
    ),
    "encode_views": Operation(
        {"points": normal(TOTAL_ROWS, 3), "viewpoint": torch.tensor([0.1, -3.0, 0.2])},
        ("points",),
        lambda x, **options: encode_views(x["points"], x["viewpoint"], "frequency", **options),
        (),
        ("gpu",),
    ),
    "activate_geometry": Operation(
        {
            "raw": normal(TOTAL_ROWS, 8),
            "positions": normal(TOTAL_ROWS, 3),
            "scale": normal(TOTAL_ROWS, 1),
            "opacity": normal(TOTAL_ROWS, 1),
        },
        ("raw", "positions", "scale", "opacity"),
        run_activate,
        ("raw", "scale", "opacity"),
        ("gpu",),
    ),
}
OPERATION_CASES = [
    (name, implementation) for name, case in OPERATIONS.items() for implementation in case.implementations
]


def learn(case: Operation, inputs: Mapping[str, Tensor], upstream: Tensor, **options) -> tuple[Tensor, list[Tensor]]:
    """Return the result and the gradients of the inputs to be learnt."""
    x = {name: value.clone().requires_grad_(name in case.learns) for name, value in inputs.items()}
    result = case.run(x, **options)
    if case.learns:
        result.backward(upstream)
    return result.detach(), [x[name].grad for name in case.learns]


@pytest.mark.parametrize(("name", "implementation"), OPERATION_CASES)
def test_results_and_gradients_are_those_of_the_rows_in_use(name: str, implementation: str) -> None:
    case = OPERATIONS[name]
    first = {
        key: value[:USED_ROWS].double() if key in case.rows else value.double() for key, value in case.inputs.items()
    }
    width = case.run(first, implementation="reference").shape[1]
    upstream = normal(TOTAL_ROWS, width, seed=5)
    expected, expected_gradients = learn(case, first, upstream[:USED_ROWS].double(), implementation="reference")
    inputs = {key: value.clone() for key, value in case.inputs.items()}
    for key in case.rows:
        inputs[key][USED_ROWS:] = torch.nan
    upstream[USED_ROWS:] = torch.nan
    move = gpu if implementation == "gpu" else torch.clone

    found, gradients = learn(
        case,
        {key: move(value) for key, value in inputs.items()},
        move(upstream),
        implementation=implementation,
        used=move(torch.tensor([USED_ROWS])),
    )

    assert found.shape == (TOTAL_ROWS, width)
    torch.testing.assert_close(found[:USED_ROWS].cpu().double(), expected, rtol=1e-4, atol=1e-5)
    for key, gradient, wanted in zip(case.learns, gradients, expected_gradients, strict=True):
        mine = gradient[:USED_ROWS] if key in case.rows else gradient
        torch.testing.assert_close(mine.cpu().double(), wanted, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("used", [0, 1, USED_ROWS, TOTAL_ROWS])
@pytest.mark.parametrize("columns", [1, 3])
def test_rows_are_taken_and_their_gradients_put_back(used: int, columns: int) -> None:
    values, index = gpu(normal(1000, columns)).requires_grad_(), gpu(torch.randperm(1000)[:TOTAL_ROWS])
    upstream = gpu(normal(TOTAL_ROWS, columns, seed=1))
    upstream[used:] = torch.nan

    rows = take_rows(values, index, count_of(used))
    rows.backward(upstream)

    assert torch.equal(rows[:used], values[index[:used]])
    expected = torch.zeros_like(values).index_put((index[:used],), upstream[:used])
    assert torch.equal(values.grad, expected)


@pytest.mark.parametrize("used", [0, 1, USED_ROWS, TOTAL_ROWS])
def test_rows_are_placed_and_their_gradients_taken(used: int) -> None:
    rows, index = gpu(normal(TOTAL_ROWS, 3)), gpu(torch.randperm(1000)[:TOTAL_ROWS])
    rows[used:] = torch.nan
    rows.requires_grad_()
    upstream = gpu(normal(3, 1000, seed=1)).T

    placed = place_rows(rows, index, count_of(used), 1000)
    placed.backward(upstream)

    assert torch.equal(placed, torch.zeros_like(placed).index_put((index[:used],), rows[:used]))
    assert torch.equal(rows.grad[:used], upstream[index[:used]])


def test_unused_rows_are_cleared_in_values_and_gradients() -> None:
    values = torch.tensor([[1.0, 2.0], [torch.nan, 3.0]], requires_grad=True)
    cleared = clear_unused_rows(values, torch.tensor([1]))
    cleared.backward(torch.tensor([[4.0, 5.0], [torch.nan, torch.nan]]))
    assert cleared.tolist() == [[1, 2], [0, 0]] and values.grad.tolist() == [[4, 5], [0, 0]]


# -- reserves --------------------------------------------------------------------------------------------------------

SMALL_VIEWPORT = Viewport(torch.eye(4, dtype=torch.float64), (20.0, 20.0, 10.0, 10.0), 20, 20)
GAUSSIAN_COUNT, PADDING_ROWS = 30, 110  # together more than a block of every kernel


def make_gaussians(count: int) -> tuple[Gaussians3D, Tensor]:
    means = normal(count, 3) * 0.5 + torch.tensor([0.0, 0.0, 3.0])
    parts = means, normal(count, 4, seed=1), 0.1 * normal(count, 3, seed=2).abs(), torch.sigmoid(normal(count, seed=3))
    return Gaussians3D(*map(gpu, parts)), gpu(torch.sigmoid(normal(count, 3, seed=4)))


@pytest.mark.parametrize("reserve", [1, 100, 5000])
def test_culling_into_a_reserve_lists_what_culling_does(reserve: int) -> None:
    positions = gpu(normal(1000, 3))
    inside = frustum_cull(positions, SMALL_VIEWPORT, 0.01, 0.3, implementation="gpu").tolist()
    assert 100 < len(inside) < 290

    index, used, demand = frustum_cull_into(positions, SMALL_VIEWPORT, 0.01, 0.3, reserve, implementation="gpu")

    assert demand.tolist() == [0, len(inside)]
    assert len(index) == len(set(index.tolist())) == min(reserve, 1000)
    assert used.tolist() == [min(reserve, len(inside))]
    assert index[: used.item()].tolist() == inside[:reserve]
    assert set(index.tolist()) <= set(range(1000))


def test_culling_into_a_reserve_flags_positions_that_are_not_finite() -> None:
    positions = gpu(normal(500, 3))
    positions[317, 1] = torch.inf
    *_, demand = frustum_cull_into(positions, SMALL_VIEWPORT, 0.01, 0.3, 500, implementation="gpu")
    assert demand[0].item() != 0


def test_the_reference_cannot_cull_into_a_reserve() -> None:
    with pytest.raises(ValueError, match="cannot cull into a reserve"):
        frustum_cull_into(normal(5, 3).double(), SMALL_VIEWPORT, 0.01, 0.3, 5)


def learn_rasterization(
    gaussians: Gaussians3D, colors: Tensor, **options
) -> tuple[Rasterization, list[Tensor], Tensor]:
    """Return the image, the gradients of all inputs and the absolute gradients of the centres."""
    inputs = [value.clone().requires_grad_() for value in (*gaussians, colors)]
    absgrad = torch.zeros_like(inputs[0][:, :2])
    image = rasterize(
        Gaussians3D(*inputs[:4]), inputs[4], SMALL_VIEWPORT, RasterSettings(), absgrad=absgrad, implementation="gpu",
        **options,
    )  # fmt: skip
    (image.rgb * torch.linspace(0, 1, image.rgb.numel(), device=image.rgb.device).view_as(image.rgb)).sum().backward()
    return image, [value.grad for value in inputs], absgrad


@pytest.mark.parametrize("surplus", [0, 700])
def test_rasterising_into_a_reserve_gives_the_same_bits(surplus: int) -> None:
    gaussians, colors = make_gaussians(GAUSSIAN_COUNT)
    expected, expected_gradients, expected_absgrad = learn_rasterization(gaussians, colors)
    padded = [
        torch.cat((value, torch.full_like(value[:1].expand(PADDING_ROWS, *value.shape[1:]), torch.nan)))
        for value in (*gaussians, colors)
    ]

    image, gradients, absgrad = learn_rasterization(
        Gaussians3D(*padded[:4]), padded[4], used=count_of(GAUSSIAN_COUNT), reserve=expected.pairs + surplus
    )

    assert image.demand.tolist() == [0, expected.pairs] and image.nonfinite == ()
    assert torch.equal(image.rgb, expected.rgb) and torch.equal(image.transmittance, expected.transmittance)
    assert torch.equal(image.visible[:GAUSSIAN_COUNT], expected.visible) and not image.visible[GAUSSIAN_COUNT:].any()
    for gradient, wanted in zip(gradients, expected_gradients, strict=True):
        assert torch.equal(gradient[:GAUSSIAN_COUNT], wanted)
    assert torch.equal(absgrad[:GAUSSIAN_COUNT], expected_absgrad) and not absgrad[GAUSSIAN_COUNT:].any()


@pytest.mark.parametrize("room", [0, 20])
def test_too_small_a_reserve_is_told_and_leaves_finite_numbers(room: int) -> None:
    gaussians, colors = make_gaussians(GAUSSIAN_COUNT)
    expected = rasterize(gaussians, colors, SMALL_VIEWPORT, implementation="gpu")
    assert expected.pairs > 20

    image, gradients, absgrad = learn_rasterization(gaussians, colors, reserve=room)

    assert image.demand.tolist() == [0, expected.pairs]
    assert all(value.isfinite().all() for value in (image.rgb, image.transmittance, absgrad, *gradients))
    assert (image.transmittance < 1).any() == (room == 20)


def test_a_reserve_flags_inputs_that_are_not_finite() -> None:
    gaussians, colors = make_gaussians(GAUSSIAN_COUNT)
    gaussians.opacities[20] = torch.nan
    image = rasterize(gaussians, colors, SMALL_VIEWPORT, reserve=5000, implementation="gpu")
    assert image.demand[0].item() != 0


def test_the_reference_reserves_no_pairs() -> None:
    gaussians, colors = make_gaussians(5)
    with pytest.raises(ValueError, match="reserves no pairs"):
        rasterize(gaussians, colors, SMALL_VIEWPORT, reserve=5, implementation="reference")

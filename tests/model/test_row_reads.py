"""What compression needs of the hash grid: which rows of a table are read, and the inverse of the contraction."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from hyrfpack.model import HashGridConfig, contract, expand
from hyrfpack.ops.hash_encode.reference import cells, corner_rows

GRID_CONFIGS = {
    "dense": HashGridConfig(log2_table_size=14, levels=3, base=3, finest=20),
    "hashed": HashGridConfig(log2_table_size=4, levels=4, base=3, finest=300),
    "both": HashGridConfig(log2_table_size=9, levels=6, base=2, finest=100),
    "exactly dense": HashGridConfig(log2_table_size=9, levels=1, base=8, finest=8),
    "finest there is": HashGridConfig(log2_table_size=10, levels=2, base=65536, finest=65536),
}


def usage_by_reference(grid: HashGridConfig, points: np.ndarray, bits: int) -> np.ndarray:
    coords = torch.from_numpy(points / 2.0**bits)
    rows = corner_rows(cells(coords, grid.resolutions), grid.resolutions, grid.log2_table_size)
    counts = np.zeros(grid.rows, np.int64)
    np.add.at(counts, rows.flatten().numpy(), 1)
    return counts


@pytest.mark.parametrize("bits", [1, 3, 19, 30])
@pytest.mark.parametrize("name", GRID_CONFIGS)
def test_usage_counts_the_rows_that_the_lookup_reads(name: str, bits: int) -> None:
    grid = GRID_CONFIGS[name]
    points = np.random.default_rng(bits).integers(0, 2**bits, (400, 3))
    points[0], points[1], points[2] = 0, 2**bits - 1, 2 ** (bits - 1)  # corners and the middle

    usage = grid.count_row_reads(points, bits)

    assert usage.shape == (grid.rows,) and usage.dtype == np.int64
    np.testing.assert_array_equal(usage, usage_by_reference(grid, points, bits))


def test_every_point_reads_eight_corners_of_each_level() -> None:
    grid = GRID_CONFIGS["both"]
    points = np.random.default_rng(0).integers(0, 2**19, (1000, 3))

    usage = grid.count_row_reads(points, 19)

    per_level = [usage[first:last].sum() for first, last in zip(grid.offsets, grid.offsets[1:], strict=False)]
    assert per_level == [8000] * grid.levels


def test_no_point_reads_nothing() -> None:
    assert not GRID_CONFIGS["both"].count_row_reads(np.zeros((0, 3), np.int64), 19).any()


def test_coincident_points_are_all_counted() -> None:
    usage = GRID_CONFIGS["dense"].count_row_reads(np.full((70_000, 3), 12345), 19)

    assert set(usage.tolist()) == {0, 70_000}
    assert np.count_nonzero(usage) == 8 * GRID_CONFIGS["dense"].levels


def test_rows_with_usage_are_those_that_pass_gradients() -> None:
    from hyrfpack.model.hash_grid import HashGrid

    grid = GRID_CONFIGS["both"]
    points = np.random.default_rng(1).integers(0, 2**18, (50, 3)) * 2 + 1  # inside cells of the lattice
    module = HashGrid(grid)

    module(torch.from_numpy(points / 2.0**19).float()).sum().backward()

    read = module.table.grad.abs().sum(dim=1).numpy() > 0
    usage = grid.count_row_reads(points, 19)
    assert (usage[read] > 0).all()
    assert np.count_nonzero(read) > 0.98 * np.count_nonzero(usage)  # a corner may have weight 0


# -- `expand`, the inverse of the contraction ------------------------------------------------------------------------


def unit_directions(count: int) -> torch.Tensor:
    vectors = torch.randn(count, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return torch.cat([torch.eye(3).double(), -torch.eye(3).double(), torch.nn.functional.normalize(vectors, dim=1)])


@pytest.mark.parametrize("radius", [0.0, 1e-9, 0.3, 1 - 1e-12, 1.0, 1 + 1e-12, 2.0, 50.0, 1e3, 1e6])
def test_expand_undoes_contract(radius: float) -> None:
    u = radius * unit_directions(200)

    # Near the outer shell the cube stores 1 / |u|, so rounding there counts |u| times.
    torch.testing.assert_close(expand(contract(u)), u, rtol=1e-14 + 2e-15 * radius, atol=1e-15)


def test_contract_undoes_expand_inside_the_ball() -> None:
    cube = torch.rand(5000, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    cube = cube[torch.linalg.vector_norm(cube - 0.5, dim=1) < 0.4999]

    torch.testing.assert_close(contract(expand(cube)), cube, rtol=0, atol=1e-14)


def test_float32_is_expanded_as_exactly_as_it_can_be() -> None:
    u = 3 * unit_directions(200)

    torch.testing.assert_close(expand(contract(u).float()).double(), u, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("length", [2 - 2**-21, 2.0, 2.0 + 1e-9, 2.5, 3.4])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_points_outside_the_image_of_the_contraction_are_moved_just_inside(length: float, dtype: torch.dtype) -> None:
    """These are points with |y| >= 2, y = 4 (c - 0.5): the corners of the cube and the sphere itself."""
    towards = unit_directions(200)
    cube = (0.5 + length / 4 * towards).to(dtype)

    u = expand(cube).double()

    radius = torch.linalg.vector_norm(u, dim=1)
    assert torch.isfinite(u).all()
    assert (radius <= 2**20 * (1 + 1e-6)).all() and (radius > 2**18).all()
    torch.testing.assert_close(u / radius[:, None], towards, rtol=0, atol=1e-6)


def test_expand_keeps_radii_in_order_up_to_the_corner() -> None:
    corner = torch.ones(3, dtype=torch.float64) / 3**0.5
    cube = 0.5 + torch.linspace(0, 3.4641 / 4, 3000, dtype=torch.float64)[:, None] * corner

    radii = torch.linalg.vector_norm(expand(cube), dim=1)

    assert (radii.diff() >= -1e-3).all()


def test_expand_has_a_gradient_wherever_gaussians_are() -> None:
    cube = contract(torch.cat([radius * unit_directions(4) for radius in (0.5, 1.5, 20.0)])).requires_grad_()

    assert torch.autograd.gradcheck(expand, (cube,), eps=1e-7, atol=1e-3, rtol=1e-4)

"""hash_encode: every implementation against the reference in float64, the reference against plain loops."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from layers import only_in_acceptance
from ops.device import IS_INTERPRETED, gpu, needs_triton, pair_with_implementations

from hyrfpack.ops.hash_encode import cells, corner_rows, hash_encode, level_offsets, level_resolutions
from hyrfpack.parallel import has_numba

TESTED_IMPLEMENTATIONS = [
    "reference",
    pytest.param("cpu", marks=pytest.mark.skipif(not has_numba(), reason="no numba")),
    pytest.param("gpu", marks=needs_triton),
]
KERNEL_IMPLEMENTATIONS = TESTED_IMPLEMENTATIONS[1:]


def place(tensor: torch.Tensor, implementation: str) -> torch.Tensor:
    return gpu(tensor) if implementation == "gpu" else tensor


def uniform(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def table_for(resolutions: tuple[int, ...], log2_table_size: int, features: int = 2) -> torch.Tensor:
    return 2 * uniform(level_offsets(resolutions, log2_table_size)[-1], features, seed=1) - 1


def coords_on_cell_boundaries(resolution: int, count: int) -> torch.Tensor:
    vertices = torch.randint(0, resolution, (count, 3), generator=torch.Generator().manual_seed(2))
    return vertices / (resolution - 1)


# Name -> (coords, resolutions, log2_table_size, whether all points lie well inside their cells).
ENCODING_CASES = {
    "hashed and dense levels": (uniform(3000, 3), level_resolutions(8, 5, 60), 12, True),
    "every level hashed, tiny table": (uniform(500, 3), level_resolutions(4, 9, 40), 4, True),
    "every level dense": (uniform(700, 3), level_resolutions(4, 2, 16), 12, True),
    "the paper's levels": (uniform(400, 3), level_resolutions(16, 64, 1024), 14, False),
    "one level of one cell": (uniform(100, 3), (2,), 3, True),
    "no point": (uniform(0, 3), level_resolutions(4, 8, 32), 8, True),
    "one point": (uniform(1, 3), level_resolutions(4, 8, 32), 8, True),
    "all points coincident": (uniform(1, 3).expand(2000, 3), level_resolutions(4, 8, 32), 8, True),
    "corners of the cube": (torch.cartesian_prod(*[torch.tensor([0.0, 1.0])] * 3), (5, 9, 17), 10, False),
    "on cell boundaries": (coords_on_cell_boundaries(23, 300), (23, 45), 10, False),
    "many blocks and ranges": (uniform(40_000, 3), (6, 30), 10, True),
    "outside the cube": (3 * uniform(300, 3) - 1, (5, 9, 40), 10, False),
}


def move_inside_cells(coords: torch.Tensor, resolutions: tuple[int, ...]) -> torch.Tensor:
    """Move coordinates to where rounding cannot put a point into another cell on any level."""
    coords = coords.clone()
    for _ in range(50):
        x = coords[:, None, :] * (torch.tensor(resolutions) - 1)[None, :, None]
        near = ((x - x.round()).abs() < 1e-3).any(dim=1)
        coords[near] = (coords[near] + 0.0137) % 1.0
    assert not near.any()
    return coords


@pytest.mark.parametrize(
    ("implementation", "case"),
    pair_with_implementations(ENCODING_CASES, {"the paper's levels"}, TESTED_IMPLEMENTATIONS),
)
def test_values_and_gradients_match_the_float64_reference(implementation: str, case: str) -> None:
    coords, resolutions, log2_table_size, inside = ENCODING_CASES[case]
    if implementation == "gpu" and IS_INTERPRETED:
        coords = coords[:600]
    coords = move_inside_cells(coords, resolutions) if inside else coords.clone()
    table = table_for(resolutions, log2_table_size)
    upstream = torch.randn(coords.shape[0], 2 * len(resolutions), generator=torch.Generator().manual_seed(3))
    upstream[::3] = 0

    def run(dtype: torch.dtype, implementation: str) -> list[torch.Tensor]:
        inputs = [place(tensor.to(dtype), implementation).requires_grad_() for tensor in (coords, table)]
        features = hash_encode(*inputs, resolutions, log2_table_size, implementation=implementation)
        grads = torch.autograd.grad(features, inputs, upstream.to(features))
        return [tensor.cpu() for tensor in (features, *grads)]

    features, grad_coords, grad_table = run(torch.float32, implementation)
    expected, expected_coords, expected_table = run(torch.float64, "reference")
    # float32 places a point to 2^-24 of a level's extent, and features in [-1, 1] change by up to 2 along an axis.
    # Extrapolating r spans, weights reach r^3.
    bound = (1e-6 + 6 * 2**-24 * max(resolutions)) * (1 if case != "outside the cube" else max(resolutions) ** 3)
    torch.testing.assert_close(features.double(), expected, rtol=0, atol=bound)
    scale = expected_table.abs().max().item() if expected_table.numel() and coords.shape[0] else 1.0
    torch.testing.assert_close(grad_table.double(), expected_table, rtol=0, atol=1e-3 * scale)
    if inside and coords.shape[0]:
        scale = expected_coords.abs().max().item()
        torch.testing.assert_close(grad_coords.double(), expected_coords, rtol=0, atol=1e-3 * scale)


def test_reference_passes_gradcheck() -> None:
    resolutions, log2_table_size = (3, 6, 11), 6
    coords = move_inside_cells(uniform(12, 3), resolutions).double().requires_grad_()
    table = table_for(resolutions, log2_table_size).double().requires_grad_()
    assert torch.autograd.gradcheck(lambda c, t: hash_encode(c, t, resolutions, log2_table_size), (coords, table))


def encode_by_loops(coords: np.ndarray, table: np.ndarray, resolutions: tuple[int, ...], size: int) -> np.ndarray:
    """Compute Instant-ngp's encoding point by point, level by level, corner by corner, with 32-bit wrap-around."""
    result = np.zeros((len(coords), len(resolutions), table.shape[1]))
    for n, point in enumerate(coords):
        first = 0
        for level, resolution in enumerate(resolutions):
            x = [float(c) * (resolution - 1) for c in point]
            cell = [min(int(v), resolution - 2) for v in x]
            rows = min(resolution**3, size)
            for dx in (0, 1):
                for dy in (0, 1):
                    for dz in (0, 1):
                        cx, cy, cz = cell[0] + dx, cell[1] + dy, cell[2] + dz
                        if resolution**3 <= size:
                            row = cx + resolution * cy + resolution * resolution * cz
                        else:
                            hashed = cx ^ (cy * 2654435761) % 2**32 ^ (cz * 805459861) % 2**32
                            row = hashed % size
                        weight = 1.0
                        for v, c, d in zip(x, cell, (dx, dy, dz), strict=True):
                            weight *= (v - c) if d else (1 - (v - c))
                        result[n, level] += weight * table[first + row]
            first += rows
    return result.reshape(len(coords), -1)


@pytest.mark.parametrize("features", [1, 2, 4])
def test_reference_matches_plain_loops(features: int) -> None:
    resolutions, log2_table_size = (4, 9, 64, 1024), 10
    coords = torch.cat([uniform(40, 3), torch.tensor([[0.0, 1.0, 0.5], [1.0, 1.0, 1.0]])]).double()
    table = table_for(resolutions, log2_table_size, features).double()
    expected = encode_by_loops(coords.numpy(), table.numpy(), resolutions, 2**log2_table_size)
    encoded = hash_encode(coords, table, resolutions, log2_table_size)
    np.testing.assert_allclose(encoded.numpy(), expected, rtol=0, atol=1e-12)


def test_levels_are_those_of_the_paper() -> None:
    expected = (64, 77, 93, 112, 135, 162, 195, 234, 281, 338, 407, 489, 589, 708, 852, 1024)
    assert level_resolutions(16, 64, 1024) == expected
    assert level_resolutions(1, 16, 16) == (16,)
    assert level_resolutions(5, 16, 256) == (16, 32, 64, 128, 256)


def test_level_offsets_are_dense_where_the_vertices_fit() -> None:
    assert level_offsets((4, 8, 16), 9) == (0, 64, 64 + 512, 64 + 512 + 512)


def test_corner_rows_of_a_dense_level_cover_each_vertex_once() -> None:
    resolution = 5
    lowest = torch.cartesian_prod(*[torch.arange(resolution - 1)] * 3)[:, None, :]
    rows = corner_rows(lowest, (resolution,), 7)[:, 0]
    assert set(rows.flatten().tolist()) == set(range(resolution**3))
    corner = torch.arange(8)
    steps = torch.stack([corner % 2, corner // 2 % 2, corner // 4], dim=-1)
    x, y, z = (lowest + steps).unbind(-1)
    assert torch.equal(rows, x + resolution * y + resolution**2 * z)


def test_corner_rows_are_exactly_the_rows_with_a_gradient() -> None:
    resolutions, log2_table_size = level_resolutions(6, 4, 50), 9
    coords = move_inside_cells(uniform(40, 3), resolutions)
    table = table_for(resolutions, log2_table_size).requires_grad_()
    features = hash_encode(coords, table, resolutions, log2_table_size)
    (grad,) = torch.autograd.grad(features.sum(), table)
    touched = set(grad.any(dim=1).nonzero().flatten().tolist())
    rows = corner_rows(cells(coords, resolutions), resolutions, log2_table_size)
    assert touched == set(rows.flatten().tolist())


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_a_constant_table_gives_its_constant_everywhere(implementation: str) -> None:
    resolutions = level_resolutions(6, 4, 200)
    table = place(torch.full((level_offsets(resolutions, 10)[-1], 2), 0.75), implementation)
    features = hash_encode(
        place(uniform(200, 3), implementation), table, resolutions, 10, implementation=implementation
    )
    torch.testing.assert_close(features, torch.full_like(features, 0.75))


@pytest.mark.parametrize("implementation", KERNEL_IMPLEMENTATIONS)
def test_coordinates_that_are_not_finite_stay_inside_the_table(implementation: str) -> None:
    coords = torch.tensor([[float("nan")] * 3, [float("inf")] * 3, [-float("inf")] * 3, [1e30, -1e30, 0.5]])
    inputs = [place(tensor, implementation).requires_grad_() for tensor in (coords, table_for((5, 300), 9))]
    features = hash_encode(*inputs, (5, 300), 9, implementation=implementation)
    features.sum().backward()
    assert features.shape == (4, 4)


@pytest.mark.parametrize("implementation", ["reference", TESTED_IMPLEMENTATIONS[2]])
def test_points_close_to_a_boundary_are_in_the_cells_that_the_file_format_defines(implementation) -> None:
    resolutions, log2_table_size = (8, 24, 600), 10
    on = torch.cat([coords_on_cell_boundaries(resolution, 100) for resolution in resolutions])
    coords = torch.cat([on, on.nextafter(torch.tensor(0.0)), on.nextafter(torch.tensor(1.0))])
    inputs = place(coords, implementation), place(table_for(resolutions, log2_table_size), implementation)
    features = hash_encode(
        inputs[0], inputs[1].requires_grad_(), resolutions, log2_table_size, implementation=implementation
    )
    for first in range(0, 900, 225):
        rows = corner_rows(cells(coords[first : first + 225], resolutions), resolutions, log2_table_size)
        upstream = torch.zeros_like(features)
        upstream[first : first + 225] = torch.nan  # NaN appears in every row that is read, also where its weight is 0
        (grad,) = torch.autograd.grad(features, inputs[1], upstream, retain_graph=True)
        assert torch.equal(grad.cpu().isnan().all(dim=1).nonzero()[:, 0], rows.unique())


@pytest.mark.parametrize("implementation", KERNEL_IMPLEMENTATIONS)
def test_memory_layout_of_coords_and_gradients_has_no_effect(implementation: str) -> None:
    resolutions, log2_table_size = (5, 9, 33), 9
    coords, table = (place(t, implementation) for t in (uniform(300, 3), table_for(resolutions, log2_table_size)))
    upstream = place(torch.randn(300, 6, generator=torch.Generator().manual_seed(5)), implementation)
    planar = torch.cat((upstream.T, upstream.T)).T[:, 6:]

    def run(coords: torch.Tensor, upstream: torch.Tensor) -> list[torch.Tensor]:
        inputs = coords.requires_grad_(), table.requires_grad_()
        features = hash_encode(*inputs, resolutions, log2_table_size, implementation=implementation)
        return [features, *torch.autograd.grad(features, inputs, upstream)]

    expected = run(coords, upstream)
    for other in (run(coords.detach().T.contiguous().T, planar), run(coords.detach().repeat(1, 2)[:, 3:], planar)):
        torch.testing.assert_close(other, expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("implementation", KERNEL_IMPLEMENTATIONS)
def test_a_table_may_be_part_of_a_larger_tensor(implementation: str) -> None:
    resolutions, log2_table_size = (5, 9, 33), 9
    coords, table = (place(t, implementation) for t in (uniform(300, 3), table_for(resolutions, log2_table_size)))
    inside = torch.cat((table.new_zeros(1), table.reshape(-1)))[1:].view(table.shape)

    features = hash_encode(coords, inside, resolutions, log2_table_size, implementation=implementation)

    assert torch.equal(
        features, hash_encode(coords, table, resolutions, log2_table_size, implementation=implementation)
    )


@pytest.mark.skipif(not has_numba(), reason="no numba")
def test_bytes_do_not_depend_on_threads_or_on_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    resolutions, log2_table_size = level_resolutions(8, 8, 128), 10
    upstream = torch.randn(40_000, 16, generator=torch.Generator().manual_seed(4))

    def run() -> list[bytes]:
        coords = uniform(40_000, 3).requires_grad_()
        table = table_for(resolutions, log2_table_size).requires_grad_()
        features = hash_encode(coords, table, resolutions, log2_table_size, implementation="cpu")
        features.backward(upstream)
        return [tensor.detach().numpy().tobytes() for tensor in (features, coords.grad, table.grad)]

    monkeypatch.setenv("HYRFPACK_THREADS", "1")
    alone = run()
    monkeypatch.setenv("HYRFPACK_THREADS", "2")
    assert run() == alone
    assert run() == alone


@pytest.mark.parametrize(
    ("coords", "rows", "features", "implementation"),
    [((5, 2), 64, 2, "auto"), ((5, 3), 63, 2, "auto"), ((5, 3), 64, 4, "cpu"), ((5, 3), 64, 2, "cuda")],
    ids=["coords of two columns", "too few rows", "four features on cpu", "unknown implementation"],
)
def test_inputs_that_do_not_fit_are_rejected(coords: tuple, rows: int, features: int, implementation: str) -> None:
    with pytest.raises(ValueError):
        hash_encode(torch.rand(coords), torch.rand(rows, features), (4,), 10, implementation=implementation)


def test_level_resolutions_rejects_a_finest_level_below_the_base() -> None:
    with pytest.raises(ValueError, match="finest=8"):
        level_resolutions(4, 16, 8)


@needs_triton
def test_copies_of_coarse_levels_have_no_more_rows_than_there_are_points() -> None:
    from hyrfpack.ops.hash_encode.gpu import plan_gradient_copies

    resolutions, device = (8, 16, 32, 64), torch.device("cpu")
    offsets = level_offsets(resolutions, 15)

    copies = {points: plan_gradient_copies(points, resolutions, 15, device) for points in (1, 600, 5000, 70_000, 10**6)}

    counts = {points: messages.layout[:, 1].tolist() for points, messages in copies.items()}
    assert counts == {
        1: [1, 1, 1, 1],
        600: [1, 1, 1, 1],
        5000: [8, 1, 1, 1],
        70_000: [32, 16, 2, 1],  # a level with 64^3 vertices has more rows
        10**6: [32, 32, 16, 16],
    }
    for points, messages in copies.items():
        rows, count, first = messages.layout.T
        assert rows.tolist() == [512, 4096, 32768, 32768]
        assert (rows * count <= max(points, 1))[count > 1].all()
        assert (messages.copied_levels, messages.max_copied_rows) == (
            int((count > 1).sum()),
            max(rows[count > 1].tolist(), default=0),
        )
        # The copies lie one after the other behind the table.
        assert first.tolist() == (offsets[-1] + torch.cumsum(rows * (count - 1), 0) - rows * (count - 1)).tolist()
        assert messages.total_rows == offsets[-1] + int((rows * (count - 1)).sum())


@needs_triton
@pytest.mark.parametrize("resolutions", only_in_acceptance([(3, 5, 9), (9, 5, 3), (40, 3)], [(3, 5, 9), (40, 3)]))
def test_sums_of_copies_are_the_gradient_in_any_order_of_levels(resolutions: tuple[int, ...]) -> None:
    """Many points lie in one cell, over more than five blocks, and each block adds to another copy."""
    from hyrfpack.ops.hash_encode.gpu import plan_gradient_copies

    coords = 0.02 * uniform(5200, 3) + 0.3
    assert plan_gradient_copies(len(coords), resolutions, 10, coords.device).layout[:, 1].max() > 4
    table = table_for(resolutions, 10)
    upstream = 1 + uniform(len(coords), 2 * len(resolutions), seed=3)

    def gradient(dtype: torch.dtype, implementation: str) -> torch.Tensor:
        inputs = [place(tensor.to(dtype), implementation) for tensor in (coords, table)]
        inputs[1].requires_grad_()
        features = hash_encode(*inputs, resolutions, 10, implementation=implementation)
        return torch.autograd.grad(features, inputs[1], upstream.to(features))[0].cpu()

    expected = gradient(torch.float64, "reference")
    found = gradient(torch.float32, "gpu")
    assert found.shape == table.shape and found.is_contiguous()
    torch.testing.assert_close(found.double(), expected, rtol=1e-5, atol=1e-4)


def points_in_cells(cells_of_points: torch.Tensor, resolution: int) -> torch.Tensor:
    """Return points well inside the cells (N, 3) of a level."""
    inner = 0.1 + 0.8 * uniform(*cells_of_points.shape, seed=6)
    return (cells_of_points + inner) / (resolution - 1)


def cells_in_order(count: int, resolution: int) -> torch.Tensor:
    """Return the first cells (count, 3) of a level, all of them different, neighbours first."""
    index = torch.arange(count)
    side = resolution - 1
    return torch.stack((index % side, index // side % side, index // side**2), dim=1)


def repeat_randomly(count: int, longest: int, seed: int) -> torch.Tensor:
    """Return `count` ascending numbers, each repeated 1 to `longest` times."""
    lengths = torch.randint(1, longest + 1, (count,), generator=torch.Generator().manual_seed(seed))
    return torch.repeat_interleave(torch.arange(count), lengths)[:count]


RUN_RESOLUTION = 21
# Name -> the cells (N, 3) of consecutive points. A thread takes 8 of them, and a program 1,024.
RUNS_OF_CELLS = {
    "all points in one cell": torch.zeros(2100, 3, dtype=torch.long),
    "each point in another cell": cells_in_order(2100, RUN_RESOLUTION),
    "runs of up to 20 points": cells_in_order(2100, RUN_RESOLUTION)[repeat_randomly(2100, 20, seed=7)],
    "runs of up to 3 points": cells_in_order(2100, RUN_RESOLUTION)[repeat_randomly(2100, 3, seed=8)],
    "two cells by turns": cells_in_order(2, RUN_RESOLUTION).repeat(1050, 1),
    "fewer points than a thread takes": torch.zeros(5, 3, dtype=torch.long),
    "one point more than a program takes": torch.zeros(1025, 3, dtype=torch.long),
}


@needs_triton
@pytest.mark.parametrize(
    ("case", "zeros", "log2_table_size"),
    [
        *((case, "a third", 14) for case in RUNS_OF_CELLS),
        *((case, "none", 4) for case in ("all points in one cell", "runs of up to 20 points")),
        ("each point in another cell", "all but the last", 4),
    ],
)
def test_table_gradients_of_runs_match_the_float64_reference(case: str, zeros: str, log2_table_size: int) -> None:
    resolutions = (RUN_RESOLUTION,)
    coords = points_in_cells(RUNS_OF_CELLS[case], RUN_RESOLUTION)
    in_use = len(coords) - 3
    upstream = torch.randn(len(coords), 2, generator=torch.Generator().manual_seed(9))
    if zeros == "a third":
        upstream[torch.rand(len(coords), generator=torch.Generator().manual_seed(10)) < 1 / 3] = 0
    elif zeros == "all but the last":
        upstream[: in_use - 1] = 0
    table = table_for(resolutions, log2_table_size)

    def gradient(dtype: torch.dtype, implementation: str) -> torch.Tensor:
        used = place(torch.tensor([in_use]), implementation)
        inputs = [place(tensor.to(dtype), implementation) for tensor in (coords, table)]
        inputs[1].requires_grad_()
        features = hash_encode(*inputs, resolutions, log2_table_size, used=used, implementation=implementation)
        return torch.autograd.grad(features, inputs[1], upstream.to(features))[0].cpu()

    expected = gradient(torch.float64, "reference")
    found = gradient(torch.float32, "gpu").double()
    # A weight is rounded to 2^-24 of the level's extent, and a row's sum has terms of both signs.
    live = upstream[:in_use].any(dim=1).nonzero()[:, 0]
    terms = np.bincount(
        corner_rows(cells(coords[live], resolutions), resolutions, log2_table_size).flatten().numpy(),
        minlength=len(table),
    )
    bound = RUN_RESOLUTION * 2**-22 * torch.from_numpy(terms)[:, None]
    assert ((found - expected).abs() <= bound).all()
    assert (expected.abs() > 100 * bound).any()


@needs_triton
@pytest.mark.skipif(not IS_INTERPRETED, reason="additions are counted in the interpreter")
def test_points_of_a_thread_in_the_same_cell_are_added_once(monkeypatch: pytest.MonkeyPatch) -> None:
    from triton.runtime.interpreter import InterpreterBuilder

    added = []
    add = InterpreterBuilder.create_atomic_rmw

    def count_and_add(builder, operation, address, value, mask, *rest):
        added.append(int(mask.data.sum()))
        return add(builder, operation, address, value, mask, *rest)

    monkeypatch.setattr(InterpreterBuilder, "create_atomic_rmw", count_and_add)
    lengths = torch.tensor([8, 8, 3, 5, 1, 1, 1, 5, 12, 4])  # six threads take 8 points each
    sums = 1 + 1 + 2 + 4 + 1 + 2  # The run of 12 points belongs to two threads.
    cells_of_points = torch.repeat_interleave(cells_in_order(len(lengths), RUN_RESOLUTION), lengths, dim=0)
    coords = points_in_cells(cells_of_points, RUN_RESOLUTION)
    table = table_for((RUN_RESOLUTION,), 14).requires_grad_()
    hash_encode(coords, table, (RUN_RESOLUTION,), 14, implementation="gpu").sum().backward()
    assert sum(added) == sums * 8 * 2  # corners, features

"""background_grid: every implementation against the reference in float64, the reference against other arithmetic."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
import torch
from fake_gpu import use_fake_gpu
from ops.device import IS_INTERPRETED, gpu, needs_triton
from scenes import look_at

from hyrfpack.ops.background import (
    BACKGROUND_RADIUS,
    BackgroundField,
    background_colors,
    background_grid,
    grid_size,
    pixel_directions,
    sphere_points,
)
from hyrfpack.ops.hash_encode import level_offsets, level_resolutions
from hyrfpack.ops.shade.directions import DIRECTION_FEATURES
from hyrfpack.ops.viewport import Viewport
from hyrfpack.parallel import has_numba

needs_numba = pytest.mark.skipif(not has_numba(), reason="no numba")
TESTED_IMPLEMENTATIONS = [
    "reference",
    pytest.param("cpu", marks=needs_numba),
    pytest.param("gpu", marks=needs_triton),
]


def uniform(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


@dataclasses.dataclass(frozen=True)
class Case:
    """A camera, the transmittance of its picture, and the shape of a field."""

    height: int = 13
    width: int = 21
    stride: int = 2
    threshold: float = 0.5
    light: str = "patches"
    position: tuple[float, float, float] = (0.3, -2.0, 0.6)
    target: tuple[float, float, float] = (0.1, 0.2, 0.0)
    focal: float = 15.0
    encoding: str = "frequency"
    levels: int = 4
    finest: int = 40
    hidden: tuple[int, int] = (16, 16)

    def transmittance(self) -> torch.Tensor:
        if self.light == "patches":  # smooth, so that some blocks are completely dark and others partly
            rows = torch.arange(self.height)[:, None] / 11
            columns = torch.arange(self.width)[None, :] / 9
            return 0.5 + 0.4999 * torch.sin(rows + 1) * torch.cos(columns)
        if self.light == "one pixel":
            light = torch.zeros(self.height, self.width)
            light[self.height // 2, self.width // 2] = 1
            return light
        return torch.full((self.height, self.width), float(self.light))

    def arguments(self) -> dict[str, Any]:
        """Return the arguments of `run_grid` after the transmittance, in float32."""
        resolutions = level_resolutions(self.levels, 4, self.finest)
        widths = [2 * self.levels + DIRECTION_FEATURES[self.encoding], *self.hidden, 3]
        generator = torch.Generator().manual_seed(1)
        shapes = list(zip(widths[1:], widths, strict=False))
        return {
            "threshold": self.threshold,
            "stride": self.stride,
            "pose": torch.from_numpy(look_at(self.position, self.target)).float(),
            "intrinsics": (self.focal, 1.1 * self.focal, 0.4 * self.width, 0.6 * self.height),
            "half_extent": (1.0, 0.5, 0.25),
            "table": 2 * torch.rand(level_offsets(resolutions, 9)[-1], 2, generator=generator) - 1,
            "resolutions": resolutions,
            "log2_table_size": 9,
            "weights": [torch.randn(o, i, generator=generator) / math.sqrt(i) for o, i in shapes],
            "biases": [0.1 * torch.randn(o, generator=generator) for o, _ in shapes],
            "encoding": self.encoding,
        }

    def placed(self, dtype: torch.dtype, implementation: str) -> tuple[torch.Tensor, dict[str, Any]]:
        """Return the transmittance and the other arguments on the device of this implementation."""

        def placed(value: Any) -> Any:
            if isinstance(value, list):
                return [placed(one) for one in value]
            if not isinstance(value, torch.Tensor):
                return value
            value = value.to(dtype)
            return gpu(value) if implementation == "gpu" else value

        arguments = {name: value if name == "pose" else placed(value) for name, value in self.arguments().items()}
        return placed(self.transmittance()), arguments

    def run(self, dtype: torch.dtype, implementation: str, mixed: bool = False) -> torch.Tensor:
        """Return the grid on the CPU, without gradients."""
        light, arguments = self.placed(dtype, implementation)
        with torch.no_grad():
            return run_grid(light, **arguments, mixed=mixed, implementation=implementation).cpu()

    def learn(
        self, dtype: torch.dtype, implementation: str, mixed: bool = False
    ) -> tuple[torch.Tensor, list[torch.Tensor]]:
        """Return the grid and the gradients of the table, the weights and the biases, on the CPU."""
        light, arguments = self.placed(dtype, implementation)
        return grid_and_gradients(light, arguments | {"mixed": mixed}, implementation)


def split_arguments(
    light: torch.Tensor, pose: torch.Tensor, intrinsics: tuple[float, float, float, float], **field: Any
) -> tuple[Viewport, BackgroundField]:
    height, width = light.shape
    return Viewport(pose, intrinsics, width, height), BackgroundField(**field)


def run_grid(
    light: torch.Tensor, *, threshold: float, stride: int, implementation: str = "auto", **arguments: Any
) -> torch.Tensor:
    """Return the result of `background_grid` for a flat list of arguments."""
    options = {"threshold": threshold, "stride": stride, "implementation": implementation}
    return background_grid(light, *split_arguments(light, **arguments), **options)


def grid_and_gradients(
    light: torch.Tensor, arguments: dict[str, Any], implementation: str
) -> tuple[torch.Tensor, list[torch.Tensor]]:
    """Do what `Case.learn` does, for tensors that are on the right device."""
    field = [leaf.requires_grad_() for leaf in field_tensors(arguments)]
    grid = run_grid(light, **arguments, implementation=implementation)
    upstream = torch.randn(grid.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    gradients = torch.autograd.grad(grid, field, upstream.to(grid.device, grid.dtype))
    return grid.detach().cpu(), [gradient.cpu() for gradient in gradients]


def field_tensors(arguments: dict[str, Any]) -> list[torch.Tensor]:
    return [arguments["table"], *arguments["weights"], *arguments["biases"]]


BACKGROUND_CASES = {
    "stride 1, no multiple of a block": Case(stride=1),
    "stride 2": Case(),
    "stride 3, the last nodes past the edge": Case(height=12, width=30, stride=3),
    "stride 7 is wider than the picture": Case(height=3, width=5, stride=7, light="0.75"),
    "one pixel, one node": Case(height=1, width=1, stride=1, light="1"),
    "spherical harmonics": Case(encoding="sh", stride=1),
    "sixteen levels, wide layers": Case(levels=16, finest=60, hidden=(64, 128)),
    "widths that are no powers of two": Case(levels=5, hidden=(20, 36), encoding="sh"),
    "threshold 0 draws wherever any light passes": Case(threshold=0.0, light="1e-30"),
    "one bright pixel": Case(threshold=0.0, light="one pixel", height=40, width=40, stride=3),
    "all light": Case(threshold=0.9, light="1"),
    "outside the sphere": Case(position=(0.0, -2.5 * BACKGROUND_RADIUS, 30.0), focal=20.0),
    "outside, looking past it": Case(
        position=(0.0, -3 * BACKGROUND_RADIUS, 0.0), target=(BACKGROUND_RADIUS, -3 * BACKGROUND_RADIUS, 9.0)
    ),
}


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
@pytest.mark.parametrize("case", BACKGROUND_CASES)
def test_colors_match_the_float64_reference(implementation: str, case: str) -> None:
    found, expected = (
        BACKGROUND_CASES[case].run(torch.float32, implementation),
        BACKGROUND_CASES[case].run(torch.float64, "reference"),
    )
    torch.testing.assert_close(found.double(), expected, rtol=0, atol=1e-4)
    assert torch.equal(found == 0, expected == 0)
    assert 0 < (expected != 0).sum() and expected.max() < 1


@needs_triton
@pytest.mark.parametrize("encoding", ["frequency", "sh"])
def test_mixed_precision_rounds_only_factors(encoding: str) -> None:
    case = dataclasses.replace(BACKGROUND_CASES["stride 2"], encoding=encoding, hidden=(64, 64), levels=8)
    found = case.run(torch.float32, "gpu", mixed=True)
    expected, exact = case.run(torch.float64, "reference", mixed=True), case.run(torch.float64, "reference")
    # Values halfway between two bfloat16 numbers may round either way.
    torch.testing.assert_close(found.double(), expected, rtol=0, atol=3e-3)
    assert (found - expected).abs().mean() < 0.2 * (exact - expected).abs().mean()


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
@pytest.mark.parametrize("distance", [1e3, 1e5])
@pytest.mark.parametrize("past", [0.0, 0.5, 1.5])
def test_far_cameras_lose_no_more_precision_than_float32_requires(
    implementation: str, distance: float, past: float
) -> None:
    """Rounding a ray's direction by 2^-24 a coordinate moves its point on the sphere by that times the distance."""
    position = np.array([0.6, -0.8, 0.3]) * distance
    aside = np.array([0.8, 0.6, 0.0]) * past * BACKGROUND_RADIUS
    case = Case(position=tuple(position), target=tuple(aside), focal=0.1 * distance, stride=3, finest=8, light="1")
    found, expected = case.run(torch.float32, implementation), case.run(torch.float64, "reference")
    off = (
        4 * 2**-24 * distance / BACKGROUND_RADIUS
    )  # in the cube; features change by up to 2 a vertex, and 7 vertices span it
    torch.testing.assert_close(found.double(), expected, rtol=0, atol=1e-4 + 14 * off)


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
@pytest.mark.parametrize(("threshold", "light"), [(1.0, "1"), (0.5, "0.5"), (0.0, "0")])
def test_nothing_is_drawn_where_the_transmittance_is_below_the_threshold(implementation, threshold, light) -> None:
    found = Case(threshold=threshold, light=light).run(torch.float32, implementation)
    assert found.shape == (7, 11, 3) and not found.any()


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
@pytest.mark.parametrize("stride", [1, 2, 3])
def test_a_node_is_drawn_if_any_of_its_pixels_needs_it(implementation: str, stride: int) -> None:
    case = Case(height=20, width=17, stride=stride, threshold=0.0, light="one pixel")
    found = case.run(torch.float32, implementation)
    rows, columns = grid_size(20, 17, stride)
    near = [(i, j) for i in range(rows) for j in range(columns)
            if abs(i * stride - 10) < stride and abs(j * stride - 8) < stride]  # fmt: skip
    assert [tuple(node) for node in found.any(-1).nonzero().tolist()] == near


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
@pytest.mark.parametrize("part", ["table", "weights", "biases"])
def test_nan_inputs_give_nan_outputs(implementation: str, part: str, monkeypatch: pytest.MonkeyPatch) -> None:
    case = Case(light="1")
    arguments = case.arguments()
    (arguments[part] if part == "table" else arguments[part][0]).fill_(math.nan)
    monkeypatch.setattr(Case, "arguments", lambda self: arguments)
    assert case.run(torch.float32, implementation).isnan().all()
    grid, gradients = case.learn(torch.float32, implementation)
    assert grid.isnan().all() and any(gradient.isnan().any() for gradient in gradients)


@needs_numba
@pytest.mark.parametrize("stride", [1, 2, 3])
def test_the_cpu_finds_the_nodes_of_the_reference_around_nan_and_infinity(stride: int) -> None:
    """A node with NaN at a pixel near it is not needed, whatever the other pixels are."""
    case = Case(height=23, width=31, stride=stride, threshold=0.9)
    light = uniform(23, 31, seed=5)
    light[uniform(23, 31, seed=6) < 0.02], light[uniform(23, 31, seed=7) < 0.02] = math.nan, math.inf
    found, expected = (run_grid(light, **case.arguments(), implementation=name) for name in ("cpu", "reference"))
    assert torch.equal(found == 0, expected == 0) and 0 < found.any(-1).sum() < found[..., 0].numel()


@needs_numba
@pytest.mark.parametrize("encoding", ["frequency", "sh"])
def test_bytes_of_the_cpu_do_not_depend_on_threads_or_on_the_run(
    encoding: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    case = Case(height=201, width=303, encoding=encoding)  # several tasks

    def run(threads: int) -> list[torch.Tensor]:
        monkeypatch.setenv("HYRFPACK_THREADS", str(threads))
        grid, gradients = case.learn(torch.float32, "cpu")
        return [grid, *gradients]

    first = run(1)
    for threads in (1, 2, 5):
        assert all(map(torch.equal, first, run(threads)))


@needs_numba
@pytest.mark.parametrize("light", ["patches", "1", "one pixel"])
def test_the_cpu_computes_many_nodes_in_parts(light: str, monkeypatch: pytest.MonkeyPatch) -> None:
    from hyrfpack.ops.background import cpu

    case, sizes = Case(height=201, width=303, stride=1, threshold=0.0, light=light), []
    whole = case.run(torch.float32, "cpu")
    usual = cpu.field_colors
    monkeypatch.setattr(cpu, "field_colors", lambda points, *rest: sizes.append(len(points)) or usual(points, *rest))
    monkeypatch.setattr(cpu, "_MAX_PART_NODES", 1000)
    torch.testing.assert_close(case.run(torch.float32, "cpu"), whole, rtol=0, atol=1e-6)
    assert max(sizes) <= 1000 and sum(sizes) == whole.any(-1).sum()
    sizes.clear()
    case.learn(torch.float32, "cpu")
    assert len(sizes) == 1


def test_nodes_have_the_colours_at_their_pixel_centres() -> None:
    case = Case(light="1", stride=3)
    arguments = case.arguments()
    threshold, stride = arguments.pop("threshold"), arguments.pop("stride")
    light = case.transmittance()
    grid = run_grid(light, threshold=threshold, stride=stride, **arguments)
    points = [(3 * j + 0.5, 3 * i + 0.5) for i in range(grid.shape[0]) for j in range(grid.shape[1])]
    expected = background_colors(torch.tensor(points), *split_arguments(light, **arguments))
    torch.testing.assert_close(grid.reshape(-1, 3), expected)


def test_the_reference_passes_gradcheck_for_the_field() -> None:
    case = Case(height=3, width=4, hidden=(4, 3), levels=1, finest=4)
    arguments = case.arguments()
    parts = [arguments.pop("table"), *arguments.pop("weights"), *arguments.pop("biases")]
    inputs = [part.double().requires_grad_() for part in parts]

    def run(table, *rest):
        light = case.transmittance().double()
        return run_grid(light, table=table, weights=rest[:3], biases=rest[3:], **arguments)

    assert torch.autograd.gradcheck(run, inputs)


# -- gradients of the field ------------------------------------------------------------------------------------------


def assert_learns_alike(
    found: tuple[torch.Tensor, list[torch.Tensor]], expected: tuple[torch.Tensor, list[torch.Tensor]]
) -> None:
    """Check the colours against a run without gradients, and gradients to 0.001 of the largest of each tensor."""
    (grid, gradients), (wanted, wanted_gradients) = found, expected
    torch.testing.assert_close(grid.double(), wanted.double(), rtol=0, atol=1e-4)
    assert torch.equal(grid == 0, wanted == 0) and wanted.any()
    for gradient, other in zip(gradients, wanted_gradients, strict=True):
        scale = other.abs().max().item()
        assert scale > 0
        torch.testing.assert_close(gradient.double(), other.double(), rtol=0, atol=1e-3 * scale)


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
@pytest.mark.parametrize("name", BACKGROUND_CASES)
def test_gradients_match_the_float64_reference(implementation: str, name: str) -> None:
    case = BACKGROUND_CASES[name]
    found = case.learn(torch.float32, implementation)
    assert_learns_alike(found, case.learn(torch.float64, "reference"))
    if implementation == "gpu":
        assert found[0].permute(2, 0, 1).is_contiguous()


@needs_triton
@pytest.mark.parametrize(("encoding", "mixed"), [("frequency", False), ("sh", False), ("frequency", True)])
def test_gradients_of_the_field_use_only_kernels(encoding: str, mixed: bool) -> None:
    """For tensors that claim to be on CUDA, hash features and decoder use GPU kernels too."""
    case = Case(height=7, width=9, levels=2, encoding=encoding)
    if IS_INTERPRETED:
        with use_fake_gpu() as device:
            arguments = case.arguments() | {"mixed": mixed}
            for name in ("weights", "biases"):
                arguments[name] = [tensor.to(device) for tensor in arguments[name]]
            arguments["table"] = arguments["table"].to(device)
            found = grid_and_gradients(case.transmittance().to(device), arguments, "auto")
    else:
        found = case.learn(torch.float32, "gpu", mixed)

    exact = case.learn(torch.float64, "reference")
    if not mixed:
        assert_learns_alike(found, exact)
        return
    expected = case.learn(torch.float64, "reference", mixed)
    torch.testing.assert_close(found[0].double(), expected[0], rtol=0, atol=3e-3)
    assert (found[0] - expected[0]).abs().mean() < 0.2 * (exact[0] - expected[0]).abs().mean()
    for gradient, wanted in zip(found[1], expected[1], strict=True):
        assert (gradient - wanted).norm() < 0.02 * wanted.norm()


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
@pytest.mark.parametrize("learnt", ["table", "weights", "biases"])
def test_gradients_of_a_part_of_the_field_can_be_requested(learnt: str, implementation: str) -> None:
    case = BACKGROUND_CASES["stride 2"]
    wanted, gradients = case.learn(torch.float32, implementation)
    light, arguments = case.placed(torch.float32, implementation)
    part = arguments[learnt] if learnt == "table" else arguments[learnt][1]
    part.requires_grad_()
    grid = run_grid(light, **arguments, implementation=implementation)
    upstream = torch.randn(grid.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    grid.backward(upstream.to(grid.device, grid.dtype))
    torch.testing.assert_close(grid.detach().cpu(), wanted)
    expected = gradients[{"table": 0, "weights": 2, "biases": 5}[learnt]]
    torch.testing.assert_close(part.grad.cpu(), expected, rtol=1e-4, atol=1e-5 * expected.abs().max().item())
    assert [leaf.grad is not None for leaf in field_tensors(arguments)] == [
        leaf is part for leaf in field_tensors(arguments)
    ]


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_pixels_without_transmittance_give_no_gradient(implementation: str) -> None:
    light, arguments = Case(light="0", threshold=0.0).placed(torch.float32, implementation)
    field = [leaf.requires_grad_() for leaf in field_tensors(arguments)]
    grid = run_grid(light, **arguments, implementation=implementation)
    assert grid.shape == (7, 11, 3) and not grid.any()
    (grid.sum() + sum(0 * leaf.sum() for leaf in field)).backward()
    assert not any(leaf.grad.any() for leaf in field)


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_the_transmittance_gets_no_gradient(implementation: str) -> None:
    light, arguments = Case().placed(torch.float32, implementation)
    arguments["table"].requires_grad_()
    run_grid(light.requires_grad_(), **arguments, implementation=implementation).sum().backward()
    assert light.grad is None and arguments["table"].grad.any()


@needs_triton
@pytest.mark.parametrize("learnt", [False, True])
@pytest.mark.parametrize(
    "case",
    [Case(levels=17, finest=60), Case(hidden=(129, 16)), Case(hidden=(16, 129))],
    ids=["17 levels", "a wide first layer", "a wide second layer"],
)
def test_the_kernels_are_not_used_for_unsupported_fields(case: Case, learnt: bool) -> None:
    light, arguments = case.placed(torch.float32, "gpu")
    arguments["table"].requires_grad_(learnt)
    with pytest.raises(ValueError, match="no implementation 'gpu'"):
        run_grid(light, **arguments, implementation="gpu")
    assert run_grid(light, **arguments).requires_grad == learnt


@pytest.mark.parametrize(
    "change",
    [
        {"stride": 0},
        {"pose": torch.eye(3)},
        {"encoding": "sh"},
        {"encoding": "none"},
        {"weights": [torch.rand(16, 32), torch.rand(16, 16), torch.rand(4, 16)]},
    ],
    ids=["no stride", "pose", "another encoding's width", "unknown encoding", "four outputs"],
)
def test_inputs_that_do_not_fit_are_rejected(change: dict) -> None:
    with pytest.raises(ValueError):
        run_grid(Case().transmittance(), **(Case().arguments() | change))


def test_a_transmittance_of_another_size_than_the_viewport_is_rejected() -> None:
    light, arguments = Case().transmittance(), Case().arguments()
    options = {"threshold": arguments.pop("threshold"), "stride": arguments.pop("stride")}
    viewport, field = split_arguments(light, **arguments)
    with pytest.raises(ValueError, match="make no grid"):
        background_grid(light[1:], viewport, field, **options)


# -- rays ------------------------------------------------------------------------------------------------------------


def random_directions(count: int) -> torch.Tensor:
    vectors = torch.randn(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    return torch.nn.functional.normalize(vectors, dim=1)


@pytest.mark.parametrize("origin", [(0, 0, 0), (3, -1, 2), (60, 60, 40), (0, 0, -99.999)])
def test_sphere_points_lie_on_the_sphere_ahead_of_the_camera(origin):
    origin, directions = torch.tensor(origin, dtype=torch.float64), random_directions(500)

    points = sphere_points(origin, directions)

    torch.testing.assert_close(torch.linalg.vector_norm(points, dim=1), torch.full((500,), BACKGROUND_RADIUS).double())
    steps = points - origin
    lengths = torch.linalg.vector_norm(steps, dim=1, keepdim=True)
    torch.testing.assert_close(steps, lengths * directions, rtol=1e-9, atol=1e-9)


def test_sphere_points_of_float32_cameras_are_on_the_sphere():
    points = sphere_points(torch.tensor([1.0, 2.0, -0.5]), random_directions(500).float())
    torch.testing.assert_close(
        torch.linalg.vector_norm(points, dim=1), torch.full((500,), BACKGROUND_RADIUS), rtol=1e-6, atol=0
    )


def test_sphere_points_from_outside_are_where_the_ray_leaves():
    points = sphere_points(torch.tensor([0.0, 0.0, -250.0]), torch.tensor([[0.0, 0.0, 1.0]]))
    torch.testing.assert_close(points, torch.tensor([[0.0, 0.0, BACKGROUND_RADIUS]]))


def test_sphere_points_of_a_ray_that_misses_are_nearest_to_the_centre():
    origin = torch.tensor([0.0, 150.0, -300.0], dtype=torch.float64)
    points = sphere_points(origin, torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64))
    torch.testing.assert_close(points, torch.tensor([[0.0, 150.0, 0.0]], dtype=torch.float64))


@pytest.mark.parametrize("distance", [1e3, 1e6, 1e12])
def test_sphere_points_are_finite_however_far_outside(distance):
    points = sphere_points(torch.tensor([distance, -distance, 0.0]), random_directions(500).float())
    assert torch.isfinite(points).all()


def test_pixel_directions_project_back_to_their_points():
    width, height, intrinsics = 7, 5, (11.0, 9.0, 3.2, 2.9)
    pose = torch.from_numpy(look_at((1.0, 2.0, 0.5), (0.3, -1.0, 0.2)))
    fx, fy, cx, cy = intrinsics

    generator = torch.Generator().manual_seed(0)
    points = torch.rand(50, 2, dtype=torch.float64, generator=generator) * torch.tensor([width, height])

    directions = pixel_directions(points, Viewport(pose, intrinsics, width, height))

    x, y, z = (directions @ pose[:3, :3].T).unbind(1)
    np.testing.assert_allclose((fx * x / z + cx).numpy(), points[:, 0].numpy(), atol=1e-12)
    np.testing.assert_allclose((fy * y / z + cy).numpy(), points[:, 1].numpy(), atol=1e-12)
    assert (z > 0).all()
    np.testing.assert_allclose(torch.linalg.vector_norm(directions, dim=1).numpy(), 1, atol=1e-12)

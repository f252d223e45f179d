"""Rasterisation: every implementation against the float64 reference, and the reference against closed forms."""

from __future__ import annotations

import math
import platform
import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from layers import only_in_acceptance
from ops.device import IS_INTERPRETED, KERNEL_DEVICE, gpu, needs_triton, pair_with_implementations
from torch import Tensor

from hyrfpack.ops.dispatch import has_triton
from hyrfpack.ops.rasterize import Gaussians3D, Rasterization, RasterSettings, cpu_bin, rasterize
from hyrfpack.ops.rasterize.reference import blend, project
from hyrfpack.ops.viewport import Viewport

if has_triton():
    import triton
    import triton.language as tl

    from hyrfpack.ops.rasterize.gpu_project import in_frustum, load_camera, load_rows_3

    @triton.jit
    def _frustum_kernel(means, camera, total, inside):
        index = tl.program_id(0) * 128 + tl.arange(0, 128)
        mean = load_rows_3(means, index, index < total)
        found = in_frustum(mean, load_camera(camera)) & (index < total)
        tl.store(inside + index, found.to(tl.int32))


PARAMETER_NAMES = ("means", "quats", "scales", "opacities", "colors")
GPU_IMPLEMENTATION = pytest.param("gpu", marks=needs_triton)
TESTED_IMPLEMENTATIONS = ["cpu", GPU_IMPLEMENTATION, "reference"]


@dataclass(frozen=True)
class Case:
    """The arguments of one call. Gaussians are float32 numbers, so that every precision gets the same input."""

    gaussians: dict[str, Tensor]
    width: int = 48
    height: int = 40
    intrinsics: tuple[float, float, float, float] = (50.0, 50.0, 24.0, 20.0)
    camera: Tensor = field(default_factory=lambda: _camera(4.0))
    options: dict = field(default_factory=dict)

    @property
    def viewport(self) -> Viewport:
        return Viewport(self.camera, self.intrinsics, self.width, self.height)


def _camera(distance: float) -> Tensor:
    """Return the pose of a camera that looks at the origin along a tilted axis."""
    angle, tilt = 0.4, -0.3
    turn = torch.tensor([[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]])
    nod = torch.tensor([[1, 0, 0], [0, math.cos(tilt), -math.sin(tilt)], [0, math.sin(tilt), math.cos(tilt)]])
    camera = torch.eye(4, dtype=torch.float64)
    camera[:3, :3] = nod.double() @ turn.double()
    camera[2, 3] = distance
    return camera


def _gaussians(count: int, seed: int = 0, size: float = 0.1, spread: float = 0.8) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    return {
        "means": normal(count, 3) * spread,
        "quats": normal(count, 4),
        "scales": size * torch.exp(0.5 * normal(count, 3)),
        "opacities": torch.sigmoid(1.5 * normal(count)),
        "colors": torch.sigmoid(normal(count, 3)),
    }


def _replace(gaussians: dict[str, Tensor], **changes: Tensor) -> dict[str, Tensor]:
    return {**gaussians, **changes}


def _across_near_plane() -> Case:
    gaussians = _gaussians(60, spread=0.3)
    depths = torch.linspace(-1, 1, 60)
    depths[10:14] = torch.tensor([0.25, 0.25 + 1e-6, 0.25 - 1e-6, 0.2500001])
    gaussians["means"][:, 2] = depths
    return Case(gaussians, camera=torch.eye(4, dtype=torch.float64), options={"near": 0.25})


def _needles_and_pancakes() -> Case:
    gaussians = _gaussians(40)
    scales = torch.full((40, 3), 1e-4)
    scales[:20, 0] = torch.logspace(-1, 2, 20)
    scales[20:, 1:] = torch.logspace(-1, 1, 20)[:, None]
    return Case(_replace(gaussians, scales=scales))


def _all_sizes() -> Case:
    gaussians = _gaussians(90)
    return Case(_replace(gaussians, scales=torch.logspace(-6, 5, 90)[:, None] * gaussians["scales"] / 0.1))


def _opacity_zero_and_one() -> Case:
    gaussians = _gaussians(40)
    return Case(_replace(gaussians, opacities=torch.tensor([0.0, 1.0, 1.0, 0.995] * 10)))


def _ten_thousand_layers() -> Case:
    gaussians = _gaussians(10_000, size=0.3, spread=0.3)
    return Case(gaussians, width=20, height=12, intrinsics=(20.0, 20.0, 10.0, 6.0))


def _thick_fog(transmittance_min: float) -> Case:
    options = {"transmittance_min": transmittance_min}
    return Case(_gaussians(600, size=0.3, spread=0.4), width=33, height=20, options=options)


def _far_from_the_origin() -> Case:
    gaussians = _gaussians(80, size=2.0, spread=16.0)
    offset = torch.tensor([1e6, -2e6, 1.5e6])
    camera = _camera(80.0)
    camera[:3, 3] -= camera[:3, :3] @ offset.double()
    return Case(_replace(gaussians, means=gaussians["means"] + offset), camera=camera)


def _all_coincident() -> Case:
    gaussians = _gaussians(50)
    return Case(_replace(gaussians, means=torch.full((50, 3), 0.125)))


def _equal_depths() -> Case:
    gaussians = _gaussians(60, size=0.3)
    gaussians["means"][:, 2] = 3.0
    return Case(gaussians, camera=torch.eye(4, dtype=torch.float64))


def _covers_everything() -> Case:
    gaussians = _gaussians(5, size=30.0)
    return Case(_replace(gaussians, opacities=torch.tensor([0.3, 0.9, 0.01, 0.5, 0.2])), width=35, height=20)


def _smaller_than_a_pixel() -> Case:
    return Case(_gaussians(60, size=1e-6))


def _inside_a_gaussian() -> Case:
    gaussians = _gaussians(30, spread=0.5)
    gaussians["means"][0] = torch.tensor([0.0, 0.0, 0.05])
    gaussians["scales"][0] = torch.tensor([2.0, 1.0, 3.0])
    return Case(gaussians, camera=torch.eye(4, dtype=torch.float64))


def _short_quaternions() -> Case:
    gaussians = _gaussians(40)
    lengths = torch.logspace(-9, 18, 40)[:, None] / gaussians["quats"].norm(dim=1, keepdim=True)
    return Case(_replace(gaussians, quats=gaussians["quats"] * lengths))


def _wide_angle() -> Case:
    gaussians = _gaussians(200, size=0.3, spread=3.0)
    return Case(gaussians, camera=_camera(1.0), intrinsics=(12.0, 15.0, 20.0, 24.0))


CASE_MAKERS: dict[str, Callable[[], Case]] = {
    "random scene": lambda: Case(_gaussians(500)),
    "random scene, antialiased": lambda: Case(_gaussians(500, size=0.03), options={"antialiased": True}),
    "narrow low-pass filter": lambda: Case(_gaussians(500, size=0.02), options={"low_pass_variance": 0.1}),
    "wide low-pass filter, antialiased": lambda: Case(
        _gaussians(500, size=0.03), options={"low_pass_variance": 2.0, "antialiased": True}
    ),
    "off-centre principal point, fx != fy": lambda: Case(_gaussians(200), intrinsics=(45.0, 70.0, 5.5, 33.25)),
    "Jacobian clamped at a wide angle": _wide_angle,
    "behind, at and across the near plane": _across_near_plane,
    "needles and pancakes": _needles_and_pancakes,
    "scales from 1e-6 to 1e5": _all_sizes,
    "opacities 0 and 1": _opacity_zero_and_one,
    "10,000 layers": _ten_thousand_layers,
    "thick fog, all of it": lambda: _thick_fog(0.0),
    "thick fog, until a twentieth of the light is left": lambda: _thick_fog(0.05),
    "1e6 from the origin": _far_from_the_origin,
    "all coincident": _all_coincident,
    "equal depths": _equal_depths,
    "one Gaussian": lambda: Case(_gaussians(1)),
    "no Gaussian": lambda: Case(_gaussians(0)),
    "all behind the camera": lambda: Case(_gaussians(20), camera=_camera(-9.0)),
    "covers the whole picture": _covers_everything,
    "smaller than 1/1000 pixel": _smaller_than_a_pixel,
    "camera inside a Gaussian": _inside_a_gaussian,
    "quaternions 1e-9 to 1e18 long": _short_quaternions,
    "1 x 1 picture": lambda: Case(_gaussians(50), width=1, height=1, intrinsics=(2.0, 2.0, 0.5, 0.5)),
    "17 x 3 picture": lambda: Case(_gaussians(50), width=17, height=3, intrinsics=(17.0, 17.0, 8.5, 1.5)),
    "256 x 16 picture": lambda: Case(_gaussians(80), width=256, height=16, intrinsics=(90.0, 90.0, 128.0, 8.0)),
}


# Triton's interpreter takes 20 ms for each tile-Gaussian pair, so it gets only this many Gaussians of a case.
INTERPRETED_GAUSSIANS = 8
# Some cases need fewer or more of them.
INTERPRETED_GAUSSIANS_BY_CASE = {"10,000 layers": 50, "scales from 1e-6 to 1e5": 15, "thick fog, all of it": 15}


def _reduce_for_interpreter(case: Case, implementation: str, few: int = INTERPRETED_GAUSSIANS) -> Case:
    """Return the case, or for the interpreter an evenly spaced selection of its Gaussians."""
    step = -(-len(case.gaussians["means"]) // few) if implementation == "gpu" and IS_INTERPRETED else 1
    return replace(case, gaussians={key: value[:: max(step, 1)].clone() for key, value in case.gaussians.items()})


def _run(case: Case, implementation: str, dtype: torch.dtype) -> tuple[Rasterization, dict[str, Tensor], Tensor]:
    """Return the picture, the gradients for random cotangents and the absolute gradient, on the CPU."""
    inputs, absgrad = _inputs(case, implementation, dtype)
    for tensor in inputs:
        tensor.requires_grad_()
    picture = _draw(case, implementation, inputs, absgrad)
    torch.autograd.backward([picture.rgb, picture.transmittance], _cotangents(case.height, case.width, dtype))
    return (
        picture,
        {name: tensor.grad.cpu() for name, tensor in zip(PARAMETER_NAMES, inputs, strict=True)},
        absgrad.cpu(),
    )


def _picture(case: Case, implementation: str, dtype: torch.dtype = torch.float32) -> Rasterization:
    """Return the picture alone, on the CPU."""
    return _draw(case, implementation, *_inputs(case, implementation, dtype))


def _inputs(case: Case, implementation: str, dtype: torch.dtype) -> tuple[list[Tensor], Tensor]:
    """Return copies of the Gaussians and a zero buffer for absgrad, on the device of the implementation."""
    device = KERNEL_DEVICE if implementation == "gpu" else "cpu"
    inputs = [case.gaussians[name].to(device, dtype, copy=True) for name in PARAMETER_NAMES]
    return inputs, torch.zeros(len(inputs[0]), 2, dtype=dtype, device=device)


def _draw(case: Case, implementation: str, inputs: list[Tensor], absgrad: Tensor) -> Rasterization:
    *gaussians, colors = inputs
    settings = RasterSettings(depth=True, **case.options)
    picture = rasterize(
        Gaussians3D(*gaussians), colors, case.viewport, settings, absgrad=absgrad, implementation=implementation
    )
    return replace(picture, **{name: value.cpu() for name, value in vars(picture).items() if torch.is_tensor(value)})


def _cotangents(height: int, width: int, dtype: torch.dtype) -> list[Tensor]:
    generator = torch.Generator().manual_seed(7)
    rgb = torch.randn(height, width, 3, generator=generator)
    return [rgb.to(dtype), torch.randn(height, width, generator=generator).to(dtype)]


def _case(name: str, implementation: str) -> Case:
    return _reduce_for_interpreter(
        CASE_MAKERS[name](), implementation, INTERPRETED_GAUSSIANS_BY_CASE.get(name, INTERPRETED_GAUSSIANS)
    )


@cache
def _expected(name: str, implementation: str) -> tuple[Rasterization, dict[str, Tensor], Tensor]:
    if implementation == "gpu" and not IS_INTERPRETED:
        return _expected(name, "cpu")
    return _run(_case(name, implementation), "reference", torch.float64)


def _assert_picture_close(actual: Tensor, expected: Tensor, tolerance: float = 1e-4) -> None:
    """Check that all pixels but one in 500 are within the tolerance.

    At the others rounding changes the side of a threshold (alpha and 1/255, T and transmittance_min). They may differ
    by what that Gaussian adds, below 0.02.
    """
    error = (actual.double() - expected).abs()
    assert error.max() < 0.02
    assert (error > tolerance).double().mean() <= 0.002


def _assert_gradient_close(actual: Tensor, expected: Tensor, tolerance: float = 1e-4) -> None:
    """Check the difference as a whole, relative to the length: single numbers can be differences of large ones."""
    assert torch.isfinite(actual).all()
    assert (actual.double() - expected).norm() <= tolerance * expected.norm() + 1e-12


# Other cases run the same branches of the GPU kernels.
SIMILAR_GPU_CASES = {
    "random scene, antialiased",
    "narrow low-pass filter",
    "off-centre principal point, fx != fy",
    "thick fog, until a twentieth of the light is left",
    "1e6 from the origin",
    "all coincident",
    "equal depths",
    "one Gaussian",
    "smaller than 1/1000 pixel",
    "17 x 3 picture",
}


@pytest.mark.parametrize(
    ("implementation", "name"), pair_with_implementations(CASE_MAKERS, SIMILAR_GPU_CASES, TESTED_IMPLEMENTATIONS)
)
def test_matches_the_float64_reference(implementation: str, name: str) -> None:
    case = _case(name, implementation)
    expected, expected_grads, expected_absgrad = _expected(name, "gpu" if implementation == "gpu" else "cpu")

    picture, grads, absgrad = _run(case, implementation, torch.float32)

    _assert_picture_close(picture.rgb, expected.rgb)
    _assert_picture_close(picture.transmittance, expected.transmittance)
    farthest = float(expected.depth.max()) or 1.0
    _assert_picture_close(picture.depth / farthest, expected.depth / farthest, 1e-3)
    lengths = case.gaussians["quats"].norm(dim=1, keepdim=True)  # short quaternions have long gradients
    for key in PARAMETER_NAMES:
        scale = lengths if key == "quats" else 1
        _assert_gradient_close(grads[key] * scale, expected_grads[key] * scale)
    _assert_gradient_close(absgrad, expected_absgrad)
    # The kernels may keep a tile whose pixel centres an ellipse just misses, but never drop one that it hits.
    assert not (expected.visible & ~picture.visible).any()
    assert expected.pairs <= picture.pairs <= 1.05 * expected.pairs + 2


@pytest.mark.parametrize("name", ["random scene", "needles and pancakes", "256 x 16 picture"])
@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_tiles_and_bounds_do_not_change_the_picture(implementation: str, name: str) -> None:
    case = _case(name, implementation)
    gaussians = {key: value.double() for key, value in case.gaussians.items()}
    shapes = Gaussians3D(*(gaussians[key] for key in PARAMETER_NAMES[:4]))
    splats = project(shapes, case.viewport, RasterSettings())
    splats = splats.select(torch.argsort(splats.depths, stable=True))
    ys, xs = torch.meshgrid(torch.arange(case.height) + 0.5, torch.arange(case.width) + 0.5, indexing="ij")
    pixels = torch.stack([xs, ys], -1).view(-1, 2).double()
    colors = gaussians["colors"][splats.index]
    rgb, transmittance, _ = blend(splats.means2d, splats.conics, splats.opacities, colors, pixels)

    picture = _picture(case, implementation, torch.float64 if implementation == "reference" else torch.float32)

    _assert_picture_close(picture.rgb, rgb.view(case.height, case.width, 3))
    _assert_picture_close(picture.transmittance, transmittance.view(case.height, case.width))


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_one_isotropic_gaussian_has_the_closed_form(implementation: str) -> None:
    focal, sigma, distance, opacity = 60.0, 0.2, 3.0, 0.7
    gaussian = {
        "means": torch.tensor([[0.0, 0.0, distance]]),
        "quats": torch.tensor([[0.3, -0.2, 0.9, 0.1]]),
        "scales": torch.full((1, 3), sigma),
        "opacities": torch.tensor([opacity]),
        "colors": torch.tensor([[0.2, 0.5, 1.0]]),
    }
    camera = torch.eye(4, dtype=torch.float64)

    picture = _picture(Case(gaussian, 33, 25, (focal, focal, 16.5, 12.5), camera), implementation)

    ys, xs = torch.meshgrid(torch.arange(25.0) - 12, torch.arange(33.0) - 16, indexing="ij")
    variance = (focal * sigma / distance) ** 2 + 0.3
    alpha = opacity * torch.exp(-(xs**2 + ys**2) / (2 * variance))
    alpha = torch.where(alpha >= 1 / 255, alpha, 0)
    torch.testing.assert_close(picture.transmittance, 1 - alpha, atol=2e-6, rtol=0)
    torch.testing.assert_close(picture.rgb, alpha[..., None] * gaussian["colors"], atol=2e-6, rtol=0)
    torch.testing.assert_close(picture.depth, torch.where(alpha > 0, distance, 0.0), atol=1e-3, rtol=0)


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_antialiasing_keeps_the_light_of_a_small_gaussian(implementation: str) -> None:
    # The integral over the picture is opacity 2 pi sqrt(det Sigma), with or without the low-pass filter.
    focal, sigma, distance, opacity = 60.0, 0.02, 3.0, 0.9
    gaussian = {
        "means": torch.tensor([[0.0, 0.0, distance]]),
        "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        "scales": torch.full((1, 3), sigma),
        "opacities": torch.tensor([opacity]),
        "colors": torch.ones(1, 3),
    }

    camera = torch.eye(4, dtype=torch.float64)
    case = Case(gaussian, 16, 16, (focal, focal, 8.0, 8.0), camera, {"antialiased": True})
    picture = _picture(case, implementation)

    light = opacity * 2 * math.pi * (focal * sigma / distance) ** 2
    assert picture.rgb[..., 0].sum() == pytest.approx(light, rel=0.02)


@cache
def _draw_fog(implementation: str, transmittance_min: float) -> Rasterization:
    case = _reduce_for_interpreter(_thick_fog(transmittance_min), implementation, few=80)
    return _picture(replace(case, width=6, height=5, intrinsics=(50.0, 50.0, 3.0, 2.5)), implementation)


@pytest.mark.parametrize("transmittance_min", [1e-4, 1 / 512, 0.05])
@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_early_termination_loses_at_most_the_remaining_light(implementation: str, transmittance_min: float) -> None:
    whole = _draw_fog(implementation, 0.0)

    picture = _draw_fog(implementation, transmittance_min)

    for name in ("rgb", "transmittance"):
        missed = (getattr(picture, name) - getattr(whole, name)).abs().max()
        assert 0.1 * transmittance_min < missed <= transmittance_min + 1e-6


@pytest.mark.parametrize("antialiased", [False, True])
def test_reference_passes_gradcheck(antialiased: bool) -> None:
    gaussians = _gaussians(2, seed=3, size=0.6, spread=0.4)
    inputs = [gaussians[name].double().requires_grad_() for name in PARAMETER_NAMES]

    def run(*tensors: Tensor) -> tuple[Tensor, Tensor]:
        viewport, settings = Viewport(_camera(4.0), (4.0, 5.0, 2.0, 1.5), 4, 3), RasterSettings(antialiased=antialiased)
        picture = rasterize(Gaussians3D(*tensors[:4]), tensors[4], viewport, settings, implementation="reference")
        return picture.rgb, picture.transmittance

    assert torch.autograd.gradcheck(run, inputs)


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_absgrad_is_the_sum_of_absolute_gradients_of_single_pixels(implementation: str) -> None:
    case = _reduce_for_interpreter(
        Case(_gaussians(12), width=18, height=17, intrinsics=(18.0, 18.0, 9.0, 8.5)), implementation
    )
    gaussians = [case.gaussians[name].double() for name in PARAMETER_NAMES]
    splats = project(Gaussians3D(*gaussians[:4]), case.viewport, RasterSettings())
    splats = splats.select(torch.argsort(splats.depths, stable=True))
    colors = gaussians[4][splats.index]
    grad_rgb, grad_transmittance = _cotangents(17, 18, torch.float64)
    expected = torch.zeros(len(gaussians[0]), 2, dtype=torch.float64)
    for y in range(17):
        for x in range(18):
            means2d = splats.means2d.clone().requires_grad_()
            pixel = torch.tensor([[x + 0.5, y + 0.5]], dtype=torch.float64)
            rgb, left, _ = blend(means2d, splats.conics, splats.opacities, colors, pixel)
            loss = (rgb[0] * grad_rgb[y, x]).sum() + left[0] * grad_transmittance[y, x]
            (grad,) = torch.autograd.grad(loss, means2d)
            expected[splats.index] += grad.abs()

    _, _, absgrad = _run(case, implementation, torch.float32)

    torch.testing.assert_close(absgrad.double(), expected, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("step", only_in_acceptance([1, 2], [2]))  # 2: a buffer with gaps, for which kernels compile
@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_absgrad_is_added_to_what_the_buffer_holds(implementation: str, step: int) -> None:
    case = Case(_gaussians(5), width=18, height=17, intrinsics=(18.0, 18.0, 9.0, 8.5))
    _, _, once = _run(case, implementation, torch.float32)
    place = gpu if implementation == "gpu" else Tensor.clone
    inputs = [place(case.gaussians[name]).requires_grad_() for name in PARAMETER_NAMES]
    buffer = place(torch.full((5, 2 * step), 3.0))[:, ::step]

    *gaussians, colors = inputs
    picture = rasterize(Gaussians3D(*gaussians), colors, case.viewport, absgrad=buffer, implementation=implementation)
    cotangents = [place(tensor) for tensor in _cotangents(17, 18, torch.float32)]
    torch.autograd.backward([picture.rgb, picture.transmittance], cotangents)

    torch.testing.assert_close(buffer.cpu(), once + 3)


def test_bytes_do_not_depend_on_threads_or_repetition(monkeypatch: pytest.MonkeyPatch) -> None:
    case = Case(_gaussians(3000), width=150, height=90, intrinsics=(150.0, 150.0, 75.0, 45.0))
    results = []
    for threads in (1, 2, 2, 5):
        monkeypatch.setenv("HYRFPACK_THREADS", str(threads))
        picture, grads, absgrad = _run(case, "cpu", torch.float32)
        results.append([picture.rgb, picture.transmittance, picture.depth, *grads.values(), absgrad])

    for result in results[1:]:
        for tensor, first in zip(result, results[0], strict=True):
            assert torch.equal(tensor, first)


@needs_triton
def test_bytes_on_the_gpu_do_not_depend_on_repetition() -> None:
    # No sum depends on the order in which blocks happen to run.
    case = _reduce_for_interpreter(Case(_gaussians(3000, size=0.2), 40, 20, (50.0, 50.0, 20.0, 10.0)), "gpu")
    (first, first_grads, first_absgrad), (again, grads, absgrad) = (_run(case, "gpu", torch.float32) for _ in range(2))

    for name in ("rgb", "transmittance", "depth"):
        assert torch.equal(getattr(again, name), getattr(first, name))
    assert all(torch.equal(grads[name], first_grads[name]) for name in PARAMETER_NAMES)
    assert torch.equal(absgrad, first_absgrad)


@needs_triton
@pytest.mark.parametrize("more", [-1, 1])
def test_tile_counts_that_disagree_with_the_list_change_nothing_else(
    monkeypatch: pytest.MonkeyPatch, more: int
) -> None:
    # Two kernels of one compiler may round differently even where their source is alike.
    from hyrfpack.ops.rasterize import gpu as module

    case = Case(_gaussians(3, size=0.3), width=20, height=16, intrinsics=(20.0, 20.0, 10.0, 8.0))
    expected, expected_grads, _ = _run(case, "gpu", torch.float32)
    unwrapped = module._project

    def project_miscounted(*arguments):
        projection = unwrapped(*arguments)
        projection.counts[projection.counts > 1] += more
        return projection

    monkeypatch.setattr(module, "_project", project_miscounted)
    picture, grads, _ = _run(case, "gpu", torch.float32)

    assert (picture.pairs - expected.pairs) * more > 0
    if more > 0:
        assert torch.equal(picture.rgb, expected.rgb)
        assert all(torch.equal(grads[name], expected_grads[name]) for name in PARAMETER_NAMES)
    assert all(torch.isfinite(grads[name]).all() for name in PARAMETER_NAMES)


def test_a_cpu_stops_looking_for_pairs_when_there_are_too_many(monkeypatch: pytest.MonkeyPatch) -> None:
    searched = []

    def find_pairs(start: int, stop: int, *arguments: Any) -> tuple[np.ndarray, np.ndarray]:
        searched.append(stop - start)
        return original(start, stop, *arguments)

    original = cpu_bin.find_pairs
    monkeypatch.setattr(cpu_bin, "find_pairs", find_pairs)
    monkeypatch.setattr(cpu_bin, "MAX_PAIRS", 3)
    monkeypatch.setenv("HYRFPACK_THREADS", "1")
    with pytest.raises(MemoryError, match="pairs"):
        _picture(Case(_gaussians(2048)), "cpu")
    assert sum(searched) < 2048


@needs_triton
def test_more_pairs_than_can_be_numbered_are_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    from hyrfpack.ops.rasterize import gpu_bin

    monkeypatch.setattr(gpu_bin, "MAX_PAIRS", 3)
    with pytest.raises(MemoryError, match="pairs"):
        _picture(Case(_gaussians(8)), "gpu")


@pytest.mark.parametrize("name", PARAMETER_NAMES)
@pytest.mark.parametrize("poison", [math.nan, math.inf, -math.inf, 3e38])
@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_values_that_are_not_finite_are_named_and_write_no_other_memory(
    implementation: str, poison: float, name: str
) -> None:
    case = Case(_gaussians(4 if implementation == "gpu" and IS_INTERPRETED else 64), 17, 16, (20.0, 20.0, 8.0, 8.0))
    case.gaussians[name][1::3] = poison

    picture, grads, _ = _run(case, implementation, torch.float32)

    assert picture.nonfinite == (() if poison == 3e38 else (name,))
    assert picture.rgb.shape == (16, 17, 3)
    assert all(grads[key].shape == case.gaussians[key].shape for key in PARAMETER_NAMES)


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_every_input_that_is_not_finite_is_named(implementation: str) -> None:
    case = Case(_gaussians(3), 8, 8, (20.0, 20.0, 4.0, 4.0))
    case.gaussians["opacities"][2], case.gaussians["means"][0, 1] = math.nan, math.inf

    picture = _picture(case, implementation)

    assert picture.nonfinite == ("means", "opacities")


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_a_picture_can_be_drawn_without_gradients(implementation: str) -> None:
    case = _reduce_for_interpreter(Case(_gaussians(30)), implementation, few=4)
    inputs, _ = _inputs(case, implementation, torch.float32)
    with torch.no_grad():
        *gaussians, colors = (tensor.requires_grad_() for tensor in inputs)
        picture = rasterize(Gaussians3D(*gaussians), colors, case.viewport, implementation=implementation)

    assert picture.depth is None
    assert not picture.rgb.requires_grad


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_depth_and_visible_are_not_differentiable(implementation: str) -> None:
    picture, _, _ = _run(
        _reduce_for_interpreter(Case(_gaussians(30)), implementation, few=4), implementation, torch.float32
    )

    assert picture.rgb.requires_grad
    assert picture.transmittance.requires_grad
    assert not picture.depth.requires_grad
    assert not picture.visible.requires_grad
    assert set(picture.seconds) == (set() if implementation == "gpu" else {"project", "sort", "bin", "blend"})


@needs_triton
@pytest.mark.parametrize("tolerance", [0.0, 0.3])
def test_the_gpu_frustum_is_the_picture_and_a_band_around_it(tolerance: float) -> None:
    from hyrfpack.ops.rasterize.gpu_project import pack_camera

    positions = _gaussians(400, spread=3.0)["means"]
    camera, intrinsics = _camera(2.0), (30.0, 50.0, 20.0, 24.0)
    x, y, z = (positions.double() @ camera[:3, :3].T + camera[:3, 3]).unbind(-1)
    across, down = (30 * x / z + 20) / 24 - 1, (50 * y / z + 24) / 20 - 1  # -1 to 1 inside the picture
    expected = (z > 0.5) & (across.abs() < 1 + tolerance) & (down.abs() < 1 + tolerance)

    numbers = pack_camera(Viewport(camera, intrinsics, 48, 40), 0.5, torch.device(KERNEL_DEVICE), tolerance)
    inside = gpu(torch.zeros(512, dtype=torch.int32))
    _frustum_kernel[(4,)](gpu(positions), numbers, 400, inside, num_warps=4, enable_fp_fusion=True)

    assert 20 < expected.sum() < 300
    assert torch.equal(inside[:400].cpu() > 0, expected)


def test_unfit_arguments_are_rejected() -> None:
    *shapes, colors = _gaussians(3).values()
    gaussians, camera, intrinsics = Gaussians3D(*shapes), torch.eye(4), (10.0, 10.0, 5.0, 5.0)
    viewport = Viewport(camera, intrinsics, 10, 10)
    with pytest.raises(ValueError, match="quats is"):
        rasterize(gaussians._replace(quats=gaussians.quats[:, :3]), colors, viewport)
    with pytest.raises(ValueError, match="the pose is"):
        Viewport(camera[:3], intrinsics, 10, 10)
    for transmittance_min in (-1e-3, 1.0, math.nan):
        with pytest.raises(ValueError, match="transmittance_min is"):
            RasterSettings(transmittance_min=transmittance_min)
    for near in (-1e-3, math.nan):
        with pytest.raises(ValueError, match="near is"):
            RasterSettings(near=near)
    for cull_tolerance in (-1e-3, math.nan):
        with pytest.raises(ValueError, match="cull_tolerance is"):
            RasterSettings(cull_tolerance=cull_tolerance)
    for low_pass_variance in (0.0, -0.3, math.nan):
        with pytest.raises(ValueError, match="low_pass_variance is"):
            RasterSettings(low_pass_variance=low_pass_variance)
    with pytest.raises(ValueError, match="no pixels"):
        Viewport(camera, intrinsics, 0, 10)
    with pytest.raises(ValueError, match="absgrad is"):
        rasterize(gaussians, colors, viewport, absgrad=torch.zeros(3, 3))
    with pytest.raises(ValueError, match="float32"):
        rasterize(Gaussians3D(*(tensor.double() for tensor in shapes)), colors.double(), viewport, implementation="cpu")


@pytest.mark.acceptance
@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="reads x86 assembly")
def test_blending_loops_are_vectorised() -> None:
    # Losing vectorisation costs a factor of ten and changes no result, so no other test would notice.
    from numba import njit

    from hyrfpack.ops.rasterize import cpu_blend

    _run(Case(_gaussians(3)), "cpu", torch.float32)  # leaves the signature of each kernel
    for kernel, packed in ((cpu_blend.blend_tiles, "mulps"), (cpu_blend.blend_tiles_backward, "divps")):
        options = {key: kernel.targetoptions[key] for key in ("fastmath", "error_model")}
        fresh = njit(**options)(kernel.py_func)
        fresh.compile(kernel.signatures[0])
        (assembly,) = fresh.inspect_asm().values()
        assert re.search(rf"v?{packed}\s+.*%[xyz]mm", assembly)


@needs_triton
@pytest.mark.parametrize("transmittance_min", [0.0, 1e-4, 0.3])
def test_the_backward_pass_replays_the_bits_of_the_transmittance(transmittance_min: float) -> None:
    from hyrfpack.ops.rasterize.gpu import replay_transmittance

    case = _reduce_for_interpreter(Case(_gaussians(3000, size=0.2), 40, 20, (50.0, 50.0, 20.0, 10.0)), "gpu")
    (*gaussians, colors), _ = _inputs(case, "gpu", torch.float32)
    viewport = Viewport(case.camera, case.intrinsics, case.width, case.height)
    settings = RasterSettings(transmittance_min=transmittance_min)
    stored, replayed = replay_transmittance(Gaussians3D(*gaussians), colors, viewport, settings)
    assert torch.equal(stored, replayed)
    assert stored.min() < 0.5  # Otherwise no pixel is near a threshold.

"""rasterize with a Shading: the combined kernel against culling, shading and rasterising in sequence, in float64."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from ops.device import gpu, needs_triton

from hyrfpack.ops.rasterize import Gaussians3D, Rasterization, RasterSettings, rasterize
from hyrfpack.ops.shade import DIRECTION_FEATURES, Shading
from hyrfpack.ops.viewport import Viewport

pytestmark = needs_triton
CAMERA_INTRINSICS = (30.0, 32.0, 11.0, 9.5)


def normal(*shape: int, seed: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def gaussians(count: int, size: float = 0.15) -> list[torch.Tensor]:
    scales = size * torch.exp(0.5 * normal(count, 3, seed=2))
    return [normal(count, 3, seed=0), normal(count, 4, seed=1), scales, torch.sigmoid(normal(count, seed=3))]


def shading(
    count: int, encoding: str = "frequency", mixed: bool = False, widths: tuple[int, int] = (16, 16)
) -> Shading:
    first, second = widths
    return Shading(
        normal(count, first, seed=4).to(torch.bfloat16 if mixed else torch.float32),
        normal(first, DIRECTION_FEATURES[encoding], seed=5) / 3,
        (normal(second, first, seed=6) / 3, normal(3, second, seed=7) / 3),
        (normal(second, seed=8) / 3, normal(3, seed=9) / 3),
        normal(count, 3, seed=10),
        encoding,
        mixed,
    )


def convert_tensors(value, to):
    if isinstance(value, Shading):
        return Shading(*(convert_tensors(getattr(value, field.name), to) for field in dataclasses.fields(value)))
    if isinstance(value, tuple):
        return tuple(convert_tensors(part, to) for part in value)
    return to(value) if isinstance(value, torch.Tensor) else value


def camera(distance: float = 4.0) -> torch.Tensor:
    pose = torch.eye(4, dtype=torch.float64)
    pose[2, 3] = distance
    return pose


def draw(
    splats: list, colors: Shading, pose: torch.Tensor, implementation: str, cull_tolerance: float = 0.0, **options
) -> Rasterization:
    viewport = Viewport(pose, CAMERA_INTRINSICS, 24, 20)
    settings = RasterSettings(depth=True, cull_tolerance=cull_tolerance, **options)
    return rasterize(Gaussians3D(*splats), colors, viewport, settings, implementation=implementation)


def draw_on_gpu(splats: list, colors: Shading, pose: torch.Tensor, **options) -> Rasterization:
    return draw([gpu(tensor) for tensor in splats], convert_tensors(colors, gpu), pose, "gpu", **options)


def draw_reference(splats: list, colors: Shading, pose: torch.Tensor, **options) -> Rasterization:
    splats = [tensor.double() for tensor in splats]
    colors = convert_tensors(colors, lambda tensor: tensor if tensor.dtype == torch.bfloat16 else tensor.double())
    return draw(splats, colors, pose, "reference", **options)


# Name -> (number of Gaussians, distance of the camera, options of the shading, options).
SHADED_CASES = {
    "random": (60, 4.0, {}, {}),
    "a wide band around the picture": (60, 4.0, {}, {"cull_tolerance": 2.0}),
    "in the middle of it, antialiased": (60, 0.5, {}, {"antialiased": True, "near": 0.2}),
    "spherical harmonics, odd widths": (40, 3.0, {"encoding": "sh", "widths": (9, 33)}, {}),
    "all behind": (10, -9.0, {}, {}),
    "none": (0, 4.0, {}, {}),
}


@pytest.mark.parametrize("case", SHADED_CASES)
def test_the_combined_kernel_matches_its_parts_in_float64(case: str) -> None:
    count, distance, made, options = SHADED_CASES[case]
    splats, colors = gaussians(count), shading(count, **made)
    wanted = draw_reference(splats, colors, camera(distance), **options)

    found = draw_on_gpu(splats, colors, camera(distance), **options)

    for name in ("rgb", "transmittance"):
        torch.testing.assert_close(getattr(found, name).cpu().double(), getattr(wanted, name), rtol=0, atol=1e-4)
    torch.testing.assert_close(found.depth.cpu().double(), wanted.depth, rtol=1e-3, atol=1e-4)
    assert not (wanted.visible & ~found.visible.cpu()).any() and found.visible.shape == (count,)
    assert wanted.pairs <= found.pairs <= 1.05 * wanted.pairs + 2
    assert found.nonfinite == ()
    if case == "random":  # only this case requires that culling removes something
        assert (
            0
            < wanted.visible.sum()
            < draw_reference(splats, colors, camera(distance), cull_tolerance=9.0).visible.sum()
        )


def test_mixed_precision_stays_close_to_float64() -> None:
    splats, colors = gaussians(60), shading(60, mixed=True)
    wanted = draw_reference(splats, dataclasses.replace(colors, mixed=False), camera())
    found = draw_on_gpu(splats, colors, camera())
    assert (found.rgb.cpu().double() - wanted.rgb).abs().max() < 2e-2
    torch.testing.assert_close(found.transmittance.cpu().double(), wanted.transmittance, rtol=0, atol=1e-5)


@pytest.mark.parametrize("index", range(4))
def test_shapes_that_disagree_are_rejected_before_a_kernel_reads_past_an_end(index: int) -> None:
    splats, colors = gaussians(20), shading(20)
    with pytest.raises(ValueError):
        draw_on_gpu(splats, shading(19), camera())
    splats[index] = splats[index][:19]
    with pytest.raises(ValueError):
        draw_on_gpu(splats, colors, camera())


@pytest.mark.parametrize("index", range(4))
def test_inputs_that_are_not_finite_are_named(index: int) -> None:
    splats, colors = gaussians(20), shading(20)
    splats[index].view(-1)[7] = float("nan")
    assert draw_on_gpu(splats, colors, camera()).nonfinite == (("means", "quats", "scales", "opacities")[index],)


def test_colors_that_are_not_finite_are_named_where_they_are_drawn() -> None:
    splats, colors = gaussians(20), shading(20)
    colors.first_layer[3] = float("nan")
    assert draw_on_gpu(splats, colors, camera()).nonfinite == ("colors",)


@pytest.mark.parametrize(
    "argument",
    [{"absgrad": torch.zeros(8, 2)}, {"used": torch.tensor(8)}, {"reserve": 5}],
    ids=lambda value: next(iter(value)),
)
def test_arguments_of_training_are_rejected(argument: dict) -> None:
    viewport = Viewport(camera(), CAMERA_INTRINSICS, 24, 20)
    with pytest.raises(ValueError, match="not a Shading"):
        rasterize(Gaussians3D(*gaussians(8)), shading(8), viewport, **argument)

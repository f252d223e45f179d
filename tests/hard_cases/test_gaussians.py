"""Hard cases of projection and blending.

They are checked by central differences in float64, by closed forms, by a search, and by comparing the float32
implementations with the float64 reference. `docs/explanation/numerics.md` states the bounds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st
from layers import only_in_acceptance
from property_tests import examples
from torch import Tensor

from hyrfpack.ops.rasterize import Gaussians3D, Rasterization, RasterSettings, rasterize
from hyrfpack.ops.rasterize.reference import project
from hyrfpack.ops.viewport import Viewport

PARAMETER_NAMES = ("means", "quats", "scales", "opacities", "colors")
CAMERA_INTRINSICS = (10.0, 11.0, 5.2, 3.9)
PICTURE_WIDTH = 10
PICTURE_HEIGHT = 8
IDENTITY_POSE = torch.eye(4, dtype=torch.float64)
IDENTITY_QUATERNION = (1.0, 0.0, 0.0, 0.0)
VIEWPORT = Viewport(IDENTITY_POSE, CAMERA_INTRINSICS, PICTURE_WIDTH, PICTURE_HEIGHT)


@dataclass(frozen=True)
class Case:
    """Gaussians before a camera at the origin, as float32 numbers, so that every precision gets the same input.

    `jumps` are the columns of means in which the picture is discontinuous, so that there is no slope to compare with.
    """

    gaussians: dict[str, Tensor]
    options: dict = field(default_factory=dict)
    jumps: tuple[int, ...] = ()


def _make_gaussians(*rows: tuple) -> dict[str, Tensor]:
    """Return Gaussians from rows of mean, scales, quaternion and opacity, with different colours."""
    means, scales, quats, opacities = (torch.tensor(column, dtype=torch.float32) for column in zip(*rows, strict=True))
    colors = torch.rand(len(rows), 3, generator=torch.Generator().manual_seed(3))
    return {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "colors": colors}


def _make_between_ordinary(*rows: tuple) -> dict[str, Tensor]:
    """Return hard Gaussians between two ordinary ones, which they must not affect."""
    front = ((0.3, 0.1, 2.0), (0.4, 0.3, 0.5), (0.9, 0.2, -0.3, 0.1), 0.45)
    back = ((-0.2, 0.1, 5.0), (0.9, 1.1, 0.7), (0.5, -0.4, 0.3, 0.6), 0.8)
    return _make_gaussians(back, *rows, front)


def _make_balls(count: int, step: float, size: float, opacity: float) -> list[tuple]:
    """Return balls side by side, each `step` behind the previous one."""
    return [((0.1 * i, 0.0, 3.0 + step * i), (size, size, size), IDENTITY_QUATERNION, opacity) for i in range(count)]


def _make_rotated(length: float) -> tuple:
    """Return a rotated Gaussian whose quaternion has this length."""
    return ((0.1, 0.0, 3.0), (0.6, 0.3, 0.2), (length / 2, -length / 2, length / 2, length / 2), 0.9)


def _along_view(angle: float) -> tuple:
    """Return the quaternion that turns the first axis to within an angle of the viewing direction."""
    half = (math.pi / 2 - angle) / 2
    return (math.cos(half), 0.0, -math.sin(half), 0.0)


def _make_dot(size: float) -> tuple:
    return ((0.09, 0.16, 3.0), (size, size, size), IDENTITY_QUATERNION, 0.9)  # close to a pixel centre


HARD_CASES = {
    "just beyond the near plane": Case(
        _make_between_ordinary(((0.002, -0.001, 0.0101), (2e-3, 1e-3, 2e-3), (0.9, 0.1, 0.2, 0.3), 0.7))
    ),
    "across the near plane": Case(
        _make_between_ordinary(((0.01, 0.0, 0.0101), (1.0, 0.5, 2.0), (0.8, 0.1, -0.5, 0.2), 0.7))
    ),
    "needle seen end on": Case(_make_between_ordinary(((0.1, 0.0, 3.0), (2.0, 1e-5, 1e-5), _along_view(1e-3), 0.9))),
    "needle grazing the camera": Case(
        _make_between_ordinary(((0.3, -0.2, 0.5), (20.0, 1e-5, 1e-5), _along_view(0.02), 0.9))
    ),
    "diagonal needle": Case(
        _make_between_ordinary(((0.1, 0.2, 3.0), (100.0, 1e-4, 1e-4), (0.92388, 0.0, 0.0, 0.38268), 0.9))
    ),
    "pancake seen edge on": Case(
        _make_between_ordinary(((0.1, 0.0, 3.0), (2.0, 2.0, 1e-6), (0.7071, 0.7071, 0.0, 0.0), 0.9))
    ),
    "alpha at its cap": Case(_make_between_ordinary(*_make_balls(2, 1.0, 2.0, 1.0))),
    "T near zero": Case(_make_between_ordinary(*_make_balls(6, 0.1, 1.0, 0.93)), {"transmittance_min": 0.0}),
    "quaternion of zero": Case(_make_between_ordinary(_make_rotated(0.0))),
    "quaternion 1e-13 long": Case(_make_between_ordinary(_make_rotated(1e-13))),
    "quaternion 1e-9 long": Case(_make_between_ordinary(_make_rotated(1e-9))),
    "quaternion 1e10 long": Case(_make_between_ordinary(_make_rotated(1e10))),
    "equal depths": Case(_make_between_ordinary(*_make_balls(4, 0.0, 0.5, 0.6)), jumps=(2,)),
    "all coincident": Case(
        _make_gaussians(*[((0.1, 0.0, 3.0), (0.5, 0.4, 0.3), IDENTITY_QUATERNION, 0.4)] * 5), jumps=(2,)
    ),
    "covers the whole picture": Case(
        _make_between_ordinary(((1.0, 0.0, 3.0), (1e4, 1e4, 1e4), IDENTITY_QUATERNION, 0.7))
    ),
    "a thousandth of a pixel": Case(_make_between_ordinary(_make_dot(3e-4))),
    "a thousandth of a pixel, antialiased": Case(_make_between_ordinary(_make_dot(3e-4)), {"antialiased": True}),
    "a twentieth of a pixel, antialiased": Case(_make_between_ordinary(_make_dot(0.015)), {"antialiased": True}),
    "scale of 1e-6": Case(_make_between_ordinary(_make_dot(1e-6))),
    "far to the side": Case(_make_between_ordinary(((9.0, 4.0, 0.5), (6.0, 5.0, 4.0), (0.9, 0.3, 0.2, 0.1), 0.9))),
    "opacity just above 1/255": Case(
        _make_between_ordinary(((0.1, 0.0, 3.0), (2.0, 2.0, 2.0), IDENTITY_QUATERNION, 0.00395))
    ),
}


# The cases that differ most in the branches that the reference takes.
DIFFERENT_CASES = {
    "across the near plane",
    "needle grazing the camera",
    "alpha at its cap",
    "quaternion 1e-13 long",
    "all coincident",
    "covers the whole picture",
    "a twentieth of a pixel, antialiased",
    "far to the side",
    "opacity just above 1/255",
}


def _to_natural_units(gaussians: dict[str, Tensor], gradients: dict[str, Tensor]) -> dict[str, Tensor]:
    """Scale gradients to comparable units: per pixel, per factor e of a scale, per radian, per opacity and colour."""
    units = {
        "means": gaussians["means"][:, 2:].abs() / CAMERA_INTRINSICS[0],
        "quats": gaussians["quats"].norm(dim=1, keepdim=True).clamp_min(1e-12),
        "scales": gaussians["scales"],
    }
    return {
        name: gradients[name].double() * units[name].double() if name in units else gradients[name].double()
        for name in PARAMETER_NAMES
    }


def _draw(case: Case, inputs: dict[str, Tensor], implementation: str) -> Rasterization:
    *gaussians, colors = inputs.values()
    settings = RasterSettings(**case.options)
    return rasterize(Gaussians3D(*gaussians), colors, VIEWPORT, settings, implementation=implementation)


def _draw_square_pixels(
    inputs: dict[str, Tensor], width: int, height: int, implementation: str, **options: float
) -> Rasterization:
    *gaussians, colors = inputs.values()
    viewport = Viewport(IDENTITY_POSE, SQUARE_PIXEL_INTRINSICS, width, height)
    settings = RasterSettings(**options)
    return rasterize(Gaussians3D(*gaussians), colors, viewport, settings, implementation=implementation)


def _loss(picture: Rasterization) -> Tensor:
    """Return a random linear function of the picture."""
    weights = torch.randn(PICTURE_HEIGHT, PICTURE_WIDTH, 4, generator=torch.Generator().manual_seed(7)).to(
        picture.rgb.dtype
    )
    return (weights[..., :3] * picture.rgb).sum() + (weights[..., 3] * picture.transmittance).sum()


def _run(case: Case, implementation: str, dtype: torch.dtype) -> tuple[Rasterization, dict[str, Tensor]]:
    """Return the picture, and the gradients of `_loss` in natural units."""
    inputs = {name: values.to(dtype, copy=True).requires_grad_() for name, values in case.gaussians.items()}
    picture = _draw(case, inputs, implementation)
    _loss(picture).backward()
    return picture, _to_natural_units(case.gaussians, {name: values.grad for name, values in inputs.items()})


def _picture_error(found: Rasterization, expected: Rasterization) -> float:
    pairs = ((found.rgb, expected.rgb), (found.transmittance, expected.transmittance))
    return max(float((a.detach().double() - b.detach().double()).abs().max()) for a, b in pairs)


def _largest_by_gaussian(gradients: dict[str, Tensor]) -> Tensor:
    """Return (N,) the largest magnitude of each Gaussian's 14 numbers."""
    return (
        torch.cat([gradients[name].reshape(len(gradients["means"]), -1) for name in PARAMETER_NAMES], 1).abs().amax(1)
    )


def _central_differences(case: Case, step: float = 1e-5) -> dict[str, Tensor]:
    """Return the gradients of `_loss` in natural units by central differences of the float64 reference."""
    gaussians = {name: values.double() for name, values in case.gaussians.items()}
    units = _to_natural_units(gaussians, {name: torch.ones_like(values) for name, values in gaussians.items()})
    slopes = {name: torch.zeros_like(values) for name, values in gaussians.items()}
    for name, values in gaussians.items():
        for place in np.ndindex(*values.shape):
            sides = []
            for sign in (1, -1):
                moved = values.clone()
                moved[place] += sign * step * units[name][place]
                sides.append(float(_loss(_draw(case, {**gaussians, name: moved}, "reference"))))
            slopes[name][place] = (sides[0] - sides[1]) / (2 * step)
    return slopes


# -- slopes, float64 ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", only_in_acceptance(HARD_CASES, [name for name in HARD_CASES if name not in DIFFERENT_CASES])
)
def test_reference_gradients_are_the_slopes(name: str) -> None:
    case = HARD_CASES[name]
    _, gradients = _run(case, "reference", torch.float64)
    assert (
        _largest_by_gaussian(gradients) > 1e-3
    ).all()  # every Gaussian contributes, so there is something to compare

    slopes = _central_differences(case)

    for group in PARAMETER_NAMES:
        columns = [c for c in range(3) if c not in case.jumps] if group == "means" else slice(None)
        difference = (gradients[group] - slopes[group])[..., columns]
        assert difference.abs().max() < 5e-6 + 1e-7 * gradients[group].abs().max(), group


# -- float32 against float64 ----------------------------------------------------------------------------------------

# Bounds for colours and transmittances in [0, 1].
MAX_PICTURE_ERROR = {"cpu": 2e-6, "reference": 2e-5}
# Bounds relative to the largest of a Gaussian's own 14 gradients, in natural units.
MAX_GRADIENT_ERROR_RATIO = {"cpu": 2e-5, "reference": 5e-5}


@pytest.mark.parametrize("name", HARD_CASES)
@pytest.mark.parametrize("implementation", ["cpu", "reference"])
def test_float32_agrees_with_float64(implementation: str, name: str) -> None:
    expected, expected_gradients = _run(HARD_CASES[name], "reference", torch.float64)

    picture, gradients = _run(HARD_CASES[name], implementation, torch.float32)

    assert _picture_error(picture, expected) < MAX_PICTURE_ERROR[implementation]
    error = _largest_by_gaussian({group: gradients[group] - expected_gradients[group] for group in PARAMETER_NAMES})
    assert (error <= MAX_GRADIENT_ERROR_RATIO[implementation] * _largest_by_gaussian(expected_gradients)).all()


@pytest.mark.parametrize("opacity", only_in_acceptance([0.01, 0.3, 1.0], [0.3]))
@pytest.mark.parametrize("transmittance_min", only_in_acceptance([0.0, 1 / 512], [0.0]))
def test_ten_thousand_layers_keep_their_gradients(opacity: float, transmittance_min: float) -> None:
    """The faint gradients at the back are lost in rounding, so errors are relative to the largest gradient."""
    generator = torch.Generator().manual_seed(0)
    depths = 2 + 3 * torch.rand(10_000, 1, generator=generator)
    spread = 0.3 * torch.randn(10_000, 2, generator=generator)
    rows = [
        ((x * z, y * z, z), (0.5, 0.4, 0.6), (0.9, 0.2, 0.1, 0.3), opacity)
        for (x, y), (z,) in zip(spread.tolist(), depths.tolist(), strict=True)
    ]
    case = Case(_make_gaussians(*rows), {"transmittance_min": transmittance_min})
    expected, expected_gradients = _run(case, "reference", torch.float64)

    picture, gradients = _run(case, "cpu", torch.float32)

    assert _picture_error(picture, expected) < 5e-6
    largest = _largest_by_gaussian(expected_gradients).max()
    error = _largest_by_gaussian({group: gradients[group] - expected_gradients[group] for group in PARAMETER_NAMES})
    assert largest > 0.5 and error.max() < 1e-5 * largest


# -- closed forms ---------------------------------------------------------------------------------------------------

SQUARE_PIXEL_INTRINSICS = (10.0, 10.0, 5.0, 4.0)


def _make_sheets(opacities: Tensor, depths: Tensor | None = None) -> dict[str, Tensor]:
    """Return Gaussians so large that their alpha equals their opacity in the whole picture."""
    count = len(opacities)
    means = torch.tensor([0.0, 0.0, 3.0]).repeat(count, 1)
    if depths is not None:
        means[:, 2] = depths
    colors = torch.rand(count, 3, generator=torch.Generator().manual_seed(3))
    quats, scales = torch.tensor(IDENTITY_QUATERNION).repeat(count, 1), torch.full((count, 3), 1e5)
    return {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "colors": colors}


def _blend_sheets(opacities: np.ndarray, colors: np.ndarray, order: np.ndarray) -> tuple[np.ndarray, float]:
    """Blend sheets in an order, in float64; return the colour and the remaining light."""
    color, left = np.zeros(3), 1.0
    for i in order:
        color, left = color + left * opacities[i] * colors[i], left * (1 - opacities[i])
    return color, left


@pytest.mark.parametrize("implementation", ["cpu", "reference"])
@pytest.mark.parametrize("angle", [0.0, 0.3, math.pi / 4, 1.2])
def test_a_needle_is_drawn_as_a_line_of_the_low_pass_width(implementation: str, angle: float) -> None:
    """It is 3,300 px long and 3e-5 px wide: xx yy - xy^2 cancels completely in float32, and sometimes in float64."""
    needle = {
        "means": torch.tensor([[0.0, 0.0, 3.0]]),
        "quats": torch.tensor([[math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2)]]),
        "scales": torch.tensor([[1e3, 1e-5, 1e-5]]),
        "opacities": torch.tensor([0.9]),
        "colors": torch.ones(1, 3),
    }
    found = _draw_square_pixels(needle, PICTURE_WIDTH, PICTURE_HEIGHT, implementation)

    x, y = np.meshgrid(np.arange(PICTURE_WIDTH) + 0.5 - 5, np.arange(PICTURE_HEIGHT) + 0.5 - 4)
    along, across = x * math.cos(angle) + y * math.sin(angle), -x * math.sin(angle) + y * math.cos(angle)
    alpha = 0.9 * np.exp(-0.5 * (along**2 / ((1e4 / 3) ** 2 + 0.3) + across**2 / 0.3))
    alpha = np.where(alpha >= 1 / 255, alpha, 0)
    np.testing.assert_allclose(1 - found.transmittance.numpy(), alpha, atol=2e-6 if implementation == "cpu" else 1e-4)


@pytest.mark.parametrize("implementation", ["cpu", "reference"])
@pytest.mark.parametrize("transmittance_min", [1 / 512, 1e-4])
def test_equal_layers_leave_a_power_of_the_light_and_blending_ends_early(
    implementation: str, transmittance_min: float
) -> None:
    opacity = float(np.float32(0.01))
    sheets = _make_sheets(
        torch.full((10_000,), opacity), 1 + torch.rand(10_000, generator=torch.Generator().manual_seed(1))
    )
    blended = math.ceil(math.log(transmittance_min) / math.log1p(-opacity))
    order = np.argsort(sheets["means"][:, 2].numpy(), kind="stable")[:blended]
    color, left = _blend_sheets(np.full(10_000, opacity), sheets["colors"].double().numpy(), order)

    found = _draw_square_pixels(sheets, 2, 2, implementation, transmittance_min=transmittance_min)

    np.testing.assert_allclose(found.transmittance.numpy(), left, rtol=2e-5)
    np.testing.assert_allclose(found.rgb.numpy(), np.broadcast_to(color, (2, 2, 3)), atol=5e-6)


@pytest.mark.parametrize("implementation", ["cpu", "reference"])
def test_light_that_underflows_is_zero(implementation: str) -> None:
    sheets = _make_sheets(torch.full((300,), 1.0), torch.linspace(1, 4, 300))
    inputs = {name: values.requires_grad_() for name, values in sheets.items()}

    found = _draw_square_pixels(inputs, 2, 2, implementation, transmittance_min=0.0)
    (found.rgb.sum() + found.transmittance.sum()).backward()

    assert (found.transmittance >= 0).all() and found.transmittance.max() < 1e-37  # 0.01^300
    expected, _ = _blend_sheets(np.full(300, 0.99), sheets["colors"].detach().double().numpy(), np.arange(300))
    np.testing.assert_allclose(found.rgb.detach().numpy(), np.broadcast_to(expected, (2, 2, 3)), atol=1e-6)
    assert all(torch.isfinite(values.grad).all() for values in inputs.values())


@pytest.mark.parametrize("implementation", ["cpu", "reference"])
@pytest.mark.parametrize("backwards", [False, True])
def test_equal_depths_are_blended_in_the_order_of_the_input(implementation: str, backwards: bool) -> None:
    opacities = 0.02 + 0.3 * torch.rand(40, generator=torch.Generator().manual_seed(2))
    depths = torch.tensor([3.0, 2.0]).repeat(20)
    sheets = _make_sheets(opacities, depths)
    if backwards:
        sheets = {name: values.flip(0) for name, values in sheets.items()}
    order = np.argsort(sheets["means"][:, 2].numpy(), kind="stable")
    expected, left = _blend_sheets(sheets["opacities"].double().numpy(), sheets["colors"].double().numpy(), order)

    found = _draw_square_pixels(sheets, 3, 2, implementation, transmittance_min=0.0)

    np.testing.assert_allclose(found.rgb.numpy(), np.broadcast_to(expected, (2, 3, 3)), atol=2e-6)
    np.testing.assert_allclose(found.transmittance.numpy(), left, atol=1e-6)


@pytest.mark.parametrize("implementation", ["cpu", "reference"])
def test_an_alpha_at_its_cap_passes_a_hundredth_of_the_light_and_no_gradient(implementation: str) -> None:
    inputs = {name: values.requires_grad_() for name, values in _make_sheets(torch.ones(1)).items()}

    found = _draw_square_pixels(inputs, 4, 3, implementation)
    found.rgb.sum().backward()

    np.testing.assert_allclose(found.transmittance.detach().numpy(), 0.01, atol=1e-7)
    np.testing.assert_allclose(inputs["colors"].grad.numpy(), 12 * 0.99, rtol=1e-6)
    for name in ("means", "quats", "scales", "opacities"):
        assert not inputs[name].grad.any(), name


@pytest.mark.parametrize("implementation", ["cpu", "reference"])
def test_antialiasing_leaves_no_less_than_half_a_percent_of_an_opacity(implementation: str) -> None:
    """sqrt(det ratio) goes to 0 with infinite slope; below its lower limit it is constant with slope 0."""
    dot = {
        "means": torch.tensor([[0.15, 0.15, 3.0]]),
        "quats": torch.tensor([IDENTITY_QUATERNION]),
        "scales": torch.full((1, 3), 1e-6, requires_grad=True),
        "opacities": torch.ones(1),
        "colors": torch.ones(1, 3),
    }
    found = _draw_square_pixels(dot, PICTURE_WIDTH, PICTURE_HEIGHT, implementation, antialiased=True)
    found.rgb.sum().backward()

    expected = torch.zeros(PICTURE_HEIGHT, PICTURE_WIDTH)
    expected[4, 5] = 0.005  # its neighbours get 0.005 exp(-1 / 0.6) < 1/255
    torch.testing.assert_close(1 - found.transmittance, expected, atol=1e-6, rtol=0)
    assert dot["scales"].grad.abs().max() < 1e-3


# -- what is left out -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("implementation", ["cpu", "reference"])
@pytest.mark.parametrize(
    "depth", [0.25, float(np.nextafter(np.float32(0.25), np.float32(0))), 1e-30, 0.0, -1e-30, -3.0, -1e30]
)
def test_a_centre_at_or_behind_the_near_plane_is_not_drawn(implementation: str, depth: float) -> None:
    alone, mixed = (
        _make_between_ordinary(),
        _make_between_ordinary(((0.0, 0.0, depth), (5.0, 5.0, 5.0), IDENTITY_QUATERNION, 0.9)),
    )
    mixed["colors"][[0, 2]] = alone["colors"]
    options = {"near": 0.25}

    expected, expected_gradients = _run(Case(alone, options), implementation, torch.float32)
    found, gradients = _run(Case(mixed, options), implementation, torch.float32)

    assert found.visible.tolist() == [True, False, True]
    assert torch.equal(found.rgb, expected.rgb) and torch.equal(found.transmittance, expected.transmittance)
    for name in PARAMETER_NAMES:
        assert not gradients[name][1].any()
        assert torch.equal(gradients[name][[0, 2]], expected_gradients[name])


@pytest.mark.parametrize("implementation", ["cpu", "reference"])
@pytest.mark.parametrize("distance", [1e18, -1e18, 1e25, -1e25])
@pytest.mark.parametrize("axis", [0, 1])
def test_a_centre_farther_off_axis_than_an_integer_of_pixels_is_not_drawn(
    implementation: str, distance: float, axis: int
) -> None:
    mean = tuple(distance if i == axis else 1.0 for i in range(3))
    alone = _make_between_ordinary()
    mixed = _make_between_ordinary((mean, (0.5, 0.5, 0.5), IDENTITY_QUATERNION, 0.9))
    mixed["colors"][[0, 2]] = alone["colors"]

    expected, expected_gradients = _run(Case(alone), implementation, torch.float32)
    found, gradients = _run(Case(mixed), implementation, torch.float32)

    assert found.visible.tolist() == [True, False, True]
    assert torch.equal(found.rgb, expected.rgb) and torch.equal(found.transmittance, expected.transmittance)
    for name in PARAMETER_NAMES:
        assert not gradients[name][1].any()
        assert torch.equal(gradients[name][[0, 2]], expected_gradients[name])


@pytest.mark.parametrize("implementation", ["cpu", "reference"])
def test_a_disc_whose_border_only_float32_puts_into_the_picture_hides_no_other(implementation: str) -> None:
    """Its pairs of tiles may not take the place of those of another Gaussian of the same chunk."""
    far = ((-8792.4365, 0.0, 0.02), (2666.4785, 2666.4785, 1e-6), IDENTITY_QUATERNION, 0.9)
    small = ((0.35, 0.35, 1.0), (0.003, 0.003, 0.003), IDENTITY_QUATERNION, 0.9)
    gaussians = _make_gaussians(far, small)
    viewport = Viewport(IDENTITY_POSE, (100.0, 100.0, 50.0, 50.0), 100, 100)
    options = {name: gaussians[name] for name in PARAMETER_NAMES[:-1]}

    pictures = [
        rasterize(Gaussians3D(**values), colors, viewport, implementation=kind)
        for values, colors, kind in (
            (options, gaussians["colors"], implementation),
            ({name: part.double() for name, part in options.items()}, gaussians["colors"].double(), "reference"),
        )
    ]

    assert pictures[0].visible[1] and pictures[1].rgb.max() > 0.1
    np.testing.assert_allclose(pictures[0].rgb, pictures[1].rgb, atol=1e-5)


@pytest.mark.parametrize("implementation", ["cpu", "reference"])
def test_a_centre_one_step_beyond_the_near_plane_is_drawn(implementation: str) -> None:
    depth = float(np.nextafter(np.float32(0.25), np.float32(1)))
    case = Case(_make_between_ordinary(((0.0, 0.0, depth), (5.0, 5.0, 5.0), IDENTITY_QUATERNION, 0.9)), {"near": 0.25})

    found, gradients = _run(case, implementation, torch.float32)

    assert found.visible.all() and found.transmittance.max() < 0.1 + 1e-6
    assert torch.isfinite(_largest_by_gaussian(gradients)).all()


@pytest.mark.parametrize("poison", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities"])
def test_a_gaussian_that_is_not_finite_affects_no_other(name: str, poison: float) -> None:
    """The kernels omit it. The renderer rejects such numbers earlier (test_renderer.py)."""
    alone, mixed = (
        _make_between_ordinary(),
        _make_between_ordinary(((0.1, 0.0, 3.0), (0.5, 0.5, 0.5), IDENTITY_QUATERNION, 0.9)),
    )
    mixed["colors"][[0, 2]] = alone["colors"]
    mixed[name][1] = poison

    expected, expected_gradients = _run(Case(alone), "cpu", torch.float32)
    found, gradients = _run(Case(mixed), "cpu", torch.float32)

    assert found.visible.tolist() == [True, False, True]
    assert torch.equal(found.rgb, expected.rgb) and torch.equal(found.transmittance, expected.transmittance)
    assert all(torch.equal(gradients[group][[0, 2]], expected_gradients[group]) for group in PARAMETER_NAMES)


# -- search ---------------------------------------------------------------------------------------------------------

FLOAT32_ROUNDING = 2.0**-24


def _picture_and_allowance(gaussians: dict[str, Tensor]) -> tuple[np.ndarray, np.ndarray]:
    """Return (H, W, 4) the picture (colour, T) in float64, and (H, W) how far float32 rounding may change it.

    The kernels round centres and the rows of the triangular form u, v of a conic to float32. This changes the exponent
    8 (u^2 + v^2) and so alpha, which is undecided where 1/255 is within reach. An alpha changes the picture by at most
    the light that reaches it.
    """
    doubles = [gaussians[name].double() for name in PARAMETER_NAMES]
    splats = project(Gaussians3D(*doubles[:4]), VIEWPORT, RasterSettings())
    order = np.argsort(splats.depths.float().numpy(), kind="stable")
    mean, cov = splats.means2d.numpy()[order], splats.covs2d.numpy()[order]
    a, b, c = splats.conics.numpy()[order].T
    opacity, colors = splats.opacities.numpy()[order], doubles[4].numpy()[splats.index.numpy()][order]
    u_x, v_y = 0.25 * np.sqrt(a), 0.25 / np.sqrt(cov[:, 2])
    u_y = -u_x * cov[:, 1] / cov[:, 2]
    x, y = np.meshgrid(np.arange(PICTURE_WIDTH) + 0.5, np.arange(PICTURE_HEIGHT) + 0.5)
    dx, dy = mean[:, 0] - x[..., None], mean[:, 1] - y[..., None]
    u, v = u_x * dx + u_y * dy, v_y * dy

    far_x, far_y = np.abs(mean[:, 0]) + np.abs(dx) + 16, np.abs(mean[:, 1]) + np.abs(dy) + 16
    off_u, off_v = 2 * FLOAT32_ROUNDING * (u_x * far_x + np.abs(u_y) * far_y), 2 * FLOAT32_ROUNDING * v_y * far_y
    power = 8 * (u * u + v * v)
    off = 16 * (np.abs(u) * off_u + np.abs(v) * off_v) + 8 * (off_u**2 + off_v**2) + 5e-6

    alpha = np.minimum(opacity * np.exp(-power), 0.99)
    low = np.minimum(opacity * np.exp(-power - off), 0.99)
    high = np.minimum(opacity * np.exp(np.minimum(off - power, 0)) * (1 + 5e-6), 0.99)
    alpha, low, high = (np.where(end >= 1 / 255, value, 0) for value, end in ((alpha, alpha), (low, low), (high, high)))
    reach = np.maximum(high - alpha, alpha - low)
    before = np.cumprod(np.concatenate([np.ones((PICTURE_HEIGHT, PICTURE_WIDTH, 1)), 1 - low], -1), -1)[..., :-1]
    light = np.cumprod(np.concatenate([np.ones((PICTURE_HEIGHT, PICTURE_WIDTH, 1)), 1 - alpha], -1), -1)
    picture = np.concatenate([(light[..., :-1] * alpha) @ colors, light[..., -1:]], -1)
    return picture, 2e-6 + (before * reach).sum(-1)


def _log_uniform(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(math.log10(low), math.log10(high)).map(lambda exponent: 10**exponent)


# x/z and y/z; the picture reaches from -0.5 to 0.5.
VIEWING_SLOPES = st.floats(-1.5, 1.5)
DEPTH_STRATEGY = st.one_of(
    st.sampled_from([0.01, 0.0100001, 0.011, 1.0, 1.0]),
    st.floats(-0.02, 0.05),
    _log_uniform(0.01, 1e6),
    st.floats(1, 1.001),
)


def _gaussian(opacity: st.SearchStrategy[float]) -> st.SearchStrategy[tuple]:
    return st.tuples(
        st.tuples(VIEWING_SLOPES, VIEWING_SLOPES, DEPTH_STRATEGY),
        st.tuples(*[_log_uniform(1e-6, 1e2)] * 3),
        st.tuples(*[st.floats(-1, 1)] * 4, _log_uniform(1e-20, 1e10)),
        opacity,
    )


def _make_searched(rows: list[tuple]) -> dict[str, Tensor]:
    return _make_gaussians(
        *[
            ((x * z, y * z, z), scales, [length * q for q in quat], opacity)
            for (x, y, z), scales, (*quat, length), opacity in rows
        ]
    )


ANY_OPACITY = st.one_of(st.sampled_from([0.0, 1.0, 1 / 255, 0.99]), st.floats(0, 1))


@examples(150)
@given(st.lists(_gaussian(ANY_OPACITY), min_size=1, max_size=8))
def test_a_search_finds_no_gaussians_with_wrong_float32_pictures(rows: list[tuple]) -> None:
    case = Case(_make_searched(rows), {"transmittance_min": 0.0})
    expected, allowance = _picture_and_allowance(case.gaussians)

    found, gradients = _run(case, "cpu", torch.float32)

    picture = torch.cat([found.rgb, found.transmittance[..., None]], -1).detach().double().numpy()
    assert (np.abs(picture - expected).max(-1) <= allowance).all()
    assert torch.isfinite(_largest_by_gaussian(gradients)).all()


@examples(60)
@given(st.lists(_gaussian(st.floats(0, 0.98)), min_size=1, max_size=8))  # at 0.99 the gradient is discontinuous
def test_a_search_finds_no_gaussians_with_wrong_float32_gradients(rows: list[tuple]) -> None:
    case = Case(_make_searched(rows), {"transmittance_min": 0.0})
    _, allowance = _picture_and_allowance(case.gaussians)
    assume(allowance.max() < 1e-5)  # no alpha is within rounding of 1/255, where gradients are discontinuous
    _, expected = _run(case, "reference", torch.float64)

    _, gradients = _run(case, "cpu", torch.float32)

    error = _largest_by_gaussian({group: gradients[group] - expected[group] for group in PARAMETER_NAMES})
    assert error.max() <= 2e-4 * _largest_by_gaussian(expected).max()


def test_the_allowance_of_the_search_is_small_for_nearly_all_pixels() -> None:
    """Otherwise the search would prove nothing."""
    generator = np.random.default_rng(0)
    shares = []
    for _ in range(50):
        places = [*generator.uniform(-0.6, 0.6, (2, 8)), 10 ** generator.uniform(-2, 2, 8)]
        scales, quats = 10 ** generator.uniform(-6, 2, (8, 3)), np.c_[generator.normal(size=(8, 4)), np.ones(8)]
        columns = [np.stack(places, 1).tolist(), scales.tolist(), quats.tolist(), generator.uniform(size=8).tolist()]
        _, allowance = _picture_and_allowance(_make_searched(list(zip(*columns, strict=True))))
        shares.append((allowance < 1e-4).mean())
    assert np.mean(shares) > 0.95

"""Sensitivities agree with finite differences of renders and with a closed form."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from fake_gpu import listen_to_transfers, use_fake_gpu
from ops.device import IS_INTERPRETED, needs_triton
from scenes import ball_points, ring, small_model

from hyrfpack.cameras.view_sampling import interpolate_views
from hyrfpack.compress.sensitivity import (
    Sensitivity,
    choose_windows,
    combine_with_prior,
    measure_sensitivity,
    prior_cells,
)
from hyrfpack.errors import HyrfError
from hyrfpack.format import decode_model, encode_model
from hyrfpack.format.arrays import SECTION_PARAMETERS
from hyrfpack.model import HybridModel
from hyrfpack.ops.contraction import contract, expand
from hyrfpack.progress import TaskEvent
from hyrfpack.render import render_view
from hyrfpack.scene import Camera

MAX_CAMERA_ELEMENTS = 64  # of cameras and bounds, fewer than the numbers of any picture or parameter
RING_CAMERAS = ring(48, elevation=1.2, width=16, height=16)


def ball_model() -> HybridModel:
    """Return twenty half-transparent Gaussians of a few pixels each, with random fields."""
    generator = torch.Generator().manual_seed(2)
    colors = torch.randn(20, 3, generator=generator)
    return small_model(ball_points(20)[0], fields=0.3, color_logits=colors, scale_logits=-1.5, opacity_logits=0.0)


@pytest.fixture(scope="module")
def measured() -> Sensitivity:
    return measure_sensitivity(ball_model(), RING_CAMERAS)


def test_large_models_are_measured_in_windows_of_many_views():
    cameras = ring(85, width=400, height=266)

    small, large = choose_windows(cameras, 30_000), choose_windows(cameras, 1_000_000)

    assert (len(small.views), small.pictures) == (96, 96)
    assert (len(large.views), large.pictures) == (48, 3)
    assert all(view.width <= 140 for view in large.views)


def test_sensitivities_in_windows_agree_with_those_in_whole_pictures(measured):
    model = ball_model()

    windows = measure_sensitivity(model, RING_CAMERAS, drawn=8 * len(model))

    for name in ("colors", "scales", "opacities"):
        ratios = getattr(windows, name) / getattr(measured, name)
        assert 1 / 2 < np.median(ratios) < 2 and (ratios > 1 / 8).all() and (ratios < 8).all()


@pytest.mark.parametrize("drawn", [None, 160])
def test_gradients_from_before_are_not_measured(drawn):
    model, settings = ball_model(), {} if drawn is None else {"drawn": drawn}
    expected = measure_sensitivity(model, RING_CAMERAS[:8], **settings)
    model.requires_grad_(True)
    for parameter in model.parameters():
        parameter.grad = torch.full_like(parameter, 1e3)

    measured = measure_sensitivity(model, RING_CAMERAS[:8], **settings)

    np.testing.assert_allclose(measured.colors, expected.colors, rtol=1e-3)
    np.testing.assert_allclose(measured.fields["RTAB"], expected.fields["RTAB"], rtol=1e-3)


def add_interpolated_views(cameras: list[Camera]) -> list[Camera]:
    return [*cameras, *interpolate_views(cameras)]


@torch.no_grad()
def render_all_pixels(model: HybridModel, views: list[Camera]) -> np.ndarray:
    decoded = model.decode()
    return np.concatenate([render_view(model, view, decoded=decoded).rgb.double().numpy().ravel() for view in views])


def mean_squared_derivative(
    model: HybridModel, views: list[Camera], parameter: torch.Tensor, place: int, step: float
) -> float:
    """Return the mean squared derivative of all pixels by one number, from central differences."""
    flat = parameter.data.view(-1)
    before, sides = flat[place].item(), []
    for sign in (1, -1):
        flat[place] = before + sign * step
        sides.append(render_all_pixels(model, views))
    flat[place] = before
    return float(np.mean(((sides[0] - sides[1]) / (2 * step)) ** 2))


# Sensitivities are estimated with random signs; with 96 views their means are off by about 5 to 15 %. The mean over
# every third of these views, which finite differences take, is close to that over all views.


def test_sensitivities_of_attributes_equal_finite_differences(measured):
    model, views = ball_model(), add_interpolated_views(RING_CAMERAS)[::3]
    gaussians = model.gaussians

    for name, values, columns, step in (
        ("color_logits", measured.colors, 3, 0.05),
        ("scale_logits", measured.scales, 1, 0.02),
        ("opacity_logits", measured.opacities, 1, 0.05),
    ):
        chosen = [0, 7, 13]
        expected = [
            np.mean(
                [
                    mean_squared_derivative(model, views, getattr(gaussians, name), columns * i + c, step)
                    for c in range(columns)
                ]
            )
            for i in chosen
        ]
        np.testing.assert_allclose(values[chosen].sum(), np.sum(expected), rtol=0.25, err_msg=name)
        np.testing.assert_allclose(values[chosen], expected, rtol=0.5, err_msg=name)


def test_sensitivities_of_positions_are_per_unit_of_the_contracted_cube(measured):
    model, views = ball_model(), add_interpolated_views(RING_CAMERAS)[::3]
    with torch.no_grad():
        # One Gaussian lies outside the frame, where a unit of the cube is long.
        model.gaussians.positions[3] = torch.tensor([0.9, 0.9, 0.6])
    outside = measure_sensitivity(model, RING_CAMERAS).positions[3]
    place, step = model.gaussians.positions.data[3].double(), 2e-3

    axes = []
    for axis in range(3):
        sides = []
        for sign in (1, -1):
            moved = contract(place) + sign * step * torch.eye(3, dtype=torch.float64)[axis]
            model.gaussians.positions.data[3] = expand(moved).float()
            sides.append(render_all_pixels(model, views))
        axes.append(np.mean(((sides[0] - sides[1]) / (2 * step)) ** 2))

    assert outside == pytest.approx(np.mean(axes), rel=0.4)
    assert (measured.positions > 0).all()


def test_sensitivities_of_fields_equal_finite_differences(measured):
    model = ball_model()
    every = add_interpolated_views(RING_CAMERAS)[::3]

    outputs = {"GMLP": model.geometry.biases[-1], "RMLP": model.radiance.biases[-1]}
    for group, biases in outputs.items():
        values = measured.fields[group][-len(biases) :]
        expected = [mean_squared_derivative(model, every, biases, place, 0.02) for place in range(len(biases))]
        assert values.sum() == pytest.approx(sum(expected), rel=0.5), group
    for group, field in (("GTAB", model.geometry), ("RTAB", model.radiance)):
        values = measured.fields[group]
        rows = values.reshape(-1, 2)
        assert (rows[:, 0] == rows[:, 1]).all()
        largest = 2 * int(rows[:, 0].argmax())
        expected = [mean_squared_derivative(model, every, field.grid.table, largest + c, 0.02) for c in range(2)]
        assert values[largest] == pytest.approx(np.mean(expected), rel=0.8), group


def test_unused_table_rows_have_zero_sensitivity_and_decoders_have_not(measured):
    model = ball_model()
    coords = model.cube_coords(model.gaussians.positions).detach()

    for group, field in (("GTAB", model.geometry), ("RTAB", model.radiance)):
        field.grid.table.grad = None
        field.grid(coords).sum().backward()
        read = (field.grid.table.grad != 0).any(dim=1).numpy()
        assert 0 < read.sum() < len(read)
        assert (measured.fields[group].reshape(-1, 2)[~read] == 0).all()
    assert all((values > 0).all() for group, values in measured.fields.items() if group in ("GMLP", "RMLP"))


def test_unseen_gaussians_have_sensitivities_by_size_opacity_and_distance():
    """By the closed form, pi f^2 a b / z^2 pixels depend on the colour by at most the opacity o.

    The axes of the Gaussian have the standard deviations a and b.
    """
    # All cameras look down and away from these positions.
    behind = np.array([[0.01, 0.01, 9.0], [0.02, 0.0, 9.0], [0.0, 0.02, 9.01]])
    sizes, opacities = torch.tensor([[-1.5], [-2.5], [-1.5]]), torch.tensor([[0.5], [0.5], [-1.0]])
    drawn = torch.full((20, 1), -1.5)
    model = small_model(
        np.vstack([ball_points(20)[0], behind]),
        scale_logits=torch.cat([drawn, sizes]),
        opacity_logits=torch.cat([drawn + 1.5, opacities]),
    )
    cameras = ring(8, width=16, height=16)
    views = add_interpolated_views(cameras)
    color = model.gaussians.color_logits

    found = measure_sensitivity(model, cameras)

    assert (
        mean_squared_derivative(model, views, color, 3 * 20, 0.1)
        == mean_squared_derivative(model, views, color, 3 * 21, 0.1)
        == 0
    )
    with torch.no_grad():
        geometry = model.decode_geometry()
    sides, opacities = geometry.scales[20:].double().numpy(), geometry.opacities[20:].double().numpy()
    expected = np.sort(sides, axis=1)[:, 1:].prod(axis=1) * opacities**2
    np.testing.assert_allclose(found.colors[20:] / found.colors[20], expected / expected[0], rtol=0.02)
    np.testing.assert_allclose(found.scales[20:] / found.scales[20], expected / expected[0], rtol=0.02)
    by_opacity = expected * (1 - opacities) ** 2
    np.testing.assert_allclose(found.opacities[20:] / found.opacities[20], by_opacity / by_opacity[0], rtol=0.02)
    for values in (found.positions, found.colors, found.scales, found.opacities):
        assert (values > 0).all() and values[20:].max() < values[:20].max()


@pytest.mark.parametrize("background", [False, True])
def test_sensitivities_do_not_depend_on_the_number_of_threads(background, monkeypatch):
    found = []
    for threads in ("1", "2", "2"):
        monkeypatch.setenv("HYRFPACK_THREADS", threads)
        found.append(
            measure_sensitivity(small_model(ball_points(200)[0], fields=0.3, background=background), RING_CAMERAS[::4])
        )

    for other in found[1:]:
        for name in ("positions", "colors", "scales", "opacities"):
            np.testing.assert_array_equal(getattr(other, name), getattr(found[0], name), err_msg=name)
        for group, values in found[0].fields.items():
            np.testing.assert_array_equal(other.fields[group], values, err_msg=group)


def test_measuring_changes_neither_the_model_nor_the_random_state():
    model = ball_model()
    before = {name: value.clone() for name, value in model.state_dict().items()}
    state = torch.get_rng_state()

    measure_sensitivity(model, RING_CAMERAS[:4])

    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())
    assert all(parameter.requires_grad and parameter.grad is None for parameter in model.parameters())
    assert torch.equal(torch.get_rng_state(), state)


def test_torch_measures_on_one_thread_and_keeps_its_number_of_threads_afterwards():
    before, during = torch.get_num_threads(), set()
    torch.set_num_threads(2)
    try:
        measure_sensitivity(ball_model(), RING_CAMERAS[:2], progress=lambda event: during.add(torch.get_num_threads()))
        after = torch.get_num_threads()
    finally:
        torch.set_num_threads(before)

    assert (during, after) == ({1}, 2)


def test_sensitivities_have_the_shapes_of_the_stored_arrays():
    model = ball_model()

    found = measure_sensitivity(model, RING_CAMERAS[:2])

    parameters = dict(model.named_parameters())
    for group, values in found.fields.items():
        assert len(values) == sum(parameters[name].numel() for name in SECTION_PARAMETERS[group]), group
        assert values.dtype == np.float64 and np.isfinite(values).all()
    for name in ("positions", "colors", "scales", "opacities"):
        assert getattr(found, name).shape == (20,) and getattr(found, name).dtype == np.float64


def test_nonfinite_parameters_are_refused():
    model = ball_model()
    with torch.no_grad():
        model.geometry.biases[-1][0] = torch.nan

    with pytest.raises(HyrfError):
        measure_sensitivity(model, RING_CAMERAS[:2])


@pytest.mark.parametrize("wanted", [True, False])
def test_requires_grad_is_unchanged(wanted):
    model = decode_model(encode_model(ball_model())).requires_grad_(wanted)
    sensitivity = measure_sensitivity(model, RING_CAMERAS[:2])
    assert sensitivity.colors.max() > 1e-12
    assert all(parameter.requires_grad == wanted for parameter in model.parameters())


@pytest.mark.parametrize("wanted", [True, False])
def test_requires_grad_is_unchanged_after_an_interrupt(wanted):
    model = decode_model(encode_model(ball_model())).requires_grad_(wanted)

    def interrupt(event: TaskEvent) -> None:
        if "view 2/" in event.task:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        measure_sensitivity(model, RING_CAMERAS[:2], progress=interrupt)
    assert all(parameter.requires_grad == wanted for parameter in model.parameters())


@pytest.mark.parametrize("guess", [0.0, 1e-320])
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_an_estimate_of_zero_gives_the_mean_of_the_measurements(guess):
    model = small_model(np.random.default_rng(0).uniform(-0.8, 0.8, (20, 3)))
    measured = np.arange(20.0)

    combined = combine_with_prior(prior_cells(model), measured, np.full(20, guess), views=8)

    assert (combined >= measured / 2).all() and (combined <= 19).all()
    assert combined.mean() == pytest.approx(measured.mean(), rel=0.1)


@pytest.mark.filterwarnings("error")
def test_estimates_of_no_gaussian_are_empty():
    none = np.zeros(0)
    assert combine_with_prior(none.astype(np.int64), none, none, 4).shape == (0,)


@pytest.mark.acceptance
@needs_triton
@pytest.mark.skipif(not IS_INTERPRETED, reason="the transfers of a fake GPU are counted")
def test_a_gpu_draws_signs_itself_and_accumulates_squares(monkeypatch):
    for name in ("MIN_SENSITIVITY_VIEWS", "MAX_SENSITIVITY_VIEWS"):
        monkeypatch.setattr(f"hyrfpack.compress.sensitivity.{name}", 4)
    monkeypatch.setattr("hyrfpack.ops.hash_encode.gpu._POINTS_PER_THREAD", 1)  # the interpreter is slow
    model, cameras = ball_model(), ring(4, elevation=1.2, width=12, height=12)
    model.precision = "float32"
    expected = measure_sensitivity(model, cameras)
    views, elements = [], []
    with use_fake_gpu() as device:
        model = model.to(device)
        # The arrays that the last view needs are copied after it, together with the results.
        with listen_to_transfers(lambda direction, count: elements.append((len(views), count))):
            found = measure_sensitivity(model, cameras, progress=views.append)
    assert len(views) == 4
    assert max(count for view, count in elements if 0 < view < 4) <= MAX_CAMERA_ELEMENTS
    # The fake GPU draws the signs of the CPU.
    for name in ("positions", "colors", "scales", "opacities", "removals"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-3, err_msg=name)
    for group, values in expected.fields.items():
        np.testing.assert_allclose(found.fields[group], values, rtol=1e-3, atol=1e-3 * values.max(), err_msg=group)

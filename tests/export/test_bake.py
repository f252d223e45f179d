from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st
from property_tests import examples
from scenes import camera_at, ring, small_model

from hyrfpack.errors import HyrfError
from hyrfpack.export.bake import bake
from hyrfpack.model import Frame
from hyrfpack.ops.harmonics import harmonics_basis
from hyrfpack.render import RenderSettings, render_view
from hyrfpack.splats.draw import Drawable, draw
from hyrfpack.splats.harmonics import SH_C0
from tools.safety.make_golden import add_golden_residuals

GAUSSIAN_POSITIONS = np.random.default_rng(0).uniform(-0.6, 0.6, (60, 3))
NO_CULLING = RenderSettings(cull_tolerance=1e9)


def shiny_model(positions=GAUSSIAN_POSITIONS, **options):
    """Return a model whose colours depend strongly on the direction."""
    return small_model(positions, fields=4.0, direction_encoding="sh", **options)


def rms_difference(model, splats, cameras, how=NO_CULLING, truth=None) -> float:
    """Return the root mean square difference between the pictures of model and splats."""
    drawable = Drawable.from_splats(splats, model.config.frame)
    with torch.no_grad():
        pairs = [(draw(drawable, c, how).rgb, render_view(truth or model, c).rgb) for c in cameras]
    return float(torch.stack([(a - b).square().mean() for a, b in pairs]).mean().sqrt())


@examples(12)
@given(st.floats(1e-3, 1e3), st.tuples(*[st.floats(-1e3, 1e3)] * 3), st.floats(-4, 4), st.integers(0, 4))
@example(1.0, (0.0, 0.0, 0.0), -3.939453125, 1)  # the error is 1.3e-6
def test_direction_independent_colors_are_exact_at_degree_0(scale, center, logit, views):
    frame = Frame(center, scale, (1.0, 0.5, 0.25))
    model = small_model(GAUSSIAN_POSITIONS, frame=frame, color_logits=logit)
    baked = bake(model, [camera_at(scale * c.position + center, center) for c in ring(views)], (0, 3))
    color = 1 / (1 + np.exp(-logit))
    # The fit sums over views and directions in float32; the largest error in 1,200 trials was 1.4e-6.
    assert np.allclose(0.5 + SH_C0 * baked[0].harmonics[:, 0], color, atol=3e-6)
    assert np.allclose(0.5 + SH_C0 * baked[3].harmonics[:, 0], color, atol=1e-3)
    assert np.abs(baked[3].harmonics[:, 1:]).max() < 1e-3


def test_baked_geometry_equals_the_model_in_world_units():
    frame = Frame((100.0, -50.0, 3.0), 20.0, (1.0, 1.0, 0.5))
    model = shiny_model(frame=frame, antialiased=True)
    splats = bake(model, [])[3]
    with torch.no_grad():
        geometry = model.decode_geometry()
    assert np.allclose(splats.positions, GAUSSIAN_POSITIONS * 20 + frame.center, atol=1e-5)
    assert np.allclose(splats.scales, 20 * geometry.scales, rtol=1e-6)
    assert np.array_equal(splats.opacities, geometry.opacities)
    lengths = torch.linalg.vector_norm(geometry.quats, dim=1, keepdim=True)
    agreement = (splats.quats * (geometry.quats / lengths).numpy()).sum(1)
    assert np.allclose(np.abs(agreement), 1, atol=1e-6) and (splats.quats[:, 0] >= 0).all()
    assert splats.antialiased


def test_residuals_are_baked():
    """A harmonic of degree 2 is baked as it is where the colour stays above 0."""
    model = add_golden_residuals(small_model(GAUSSIAN_POSITIONS, color_logits=2.0), 2)
    model.gaussians.color_residuals.mul_(0.2)
    splats = bake(model, ring(4), (2,))[2]
    with torch.no_grad():
        geometry = model.decode_geometry()
    assert np.allclose(splats.scales, geometry.scales, rtol=1e-6)
    expected = model.gaussians.color_residuals.reshape(-1, 9, 3).numpy().copy()
    expected[:, 0] += (1 / (1 + np.exp(-2.0)) - 0.5) / SH_C0
    assert np.allclose(splats.harmonics, expected, atol=2e-2)
    assert rms_difference(model, splats, ring(4)) < 1e-3


def test_higher_degrees_have_lower_errors():
    model, cameras = shiny_model(), ring(12)
    baked = bake(model, cameras, range(4))
    errors = [rms_difference(model, baked[degree], cameras) for degree in range(4)]
    assert errors == sorted(errors, reverse=True) and errors[3] < 0.3 * errors[0]


def test_degrees_baked_together_equal_degrees_baked_alone():
    model, cameras = shiny_model(), ring(3)
    together, alone = bake(model, cameras, (0, 3)), bake(model, cameras, (0,))[0]
    assert np.allclose(together[0].harmonics, alone.harmonics, atol=1e-6)
    assert not np.allclose(together[3].harmonics[:, :1], alone.harmonics, atol=1e-3)


def test_the_fit_favors_camera_views_and_includes_the_rest_of_the_sphere():
    model = shiny_model()
    seen_cameras, other_cameras = ring(6), ring(6, elevation=-2.5, radius=2.0)
    fitted, even = bake(model, seen_cameras)[3], bake(model, [])[3]
    assert rms_difference(model, fitted, seen_cameras) < 0.5 * rms_difference(model, even, seen_cameras)
    flat = bake(model, seen_cameras, (0,))[0]
    assert rms_difference(model, fitted, other_cameras) < rms_difference(model, flat, other_cameras)


def test_unseen_gaussians_are_fitted_uniformly_over_the_sphere():
    positions = np.concatenate((GAUSSIAN_POSITIONS, GAUSSIAN_POSITIONS + (0, 0, 40)))
    model = shiny_model(positions)
    seen, even = (bake(model, cameras)[3].harmonics for cameras in (ring(4), []))
    assert np.allclose(seen[60:], even[60:], atol=2e-2) and not np.allclose(seen[:60], even[:60], atol=2e-2)


def test_a_gaussian_that_only_covers_pictures_that_cull_it_is_dropped():
    # The large Gaussian lies beside the line of sight and covers only pictures that cull it.
    camera = camera_at((0, -2, 0), (0, 0, 0))
    positions = np.concatenate((GAUSSIAN_POSITIONS, [[1.6, -1.0, 0.0]]))
    scales = np.full((61, 1), -3.0)
    scales[-1] = 1.0
    model = small_model(positions, scale_logits=torch.from_numpy(scales).float())
    assert rms_difference(model, bake(model, [], (0,))[0], [camera]) > 0.05
    baked = bake(model, [camera], (0,))[0]
    assert len(baked) == 60
    assert rms_difference(model, baked, [camera]) < 1e-5


def test_visible_gaussians_keep_their_opacity():
    model = shiny_model()
    with torch.no_grad():
        assert np.array_equal(bake(model, ring(4))[3].opacities, model.decode_geometry().opacities)


def test_a_model_without_gaussians_bakes_to_no_splats():
    baked = bake(small_model(np.zeros((0, 3))), ring(2), (0, 3))
    assert [len(baked[degree]) for degree in (0, 3)] == [0, 0] and baked[3].degree == 3


@pytest.mark.parametrize("parameter", ["positions", "opacity_logits", "color_logits"])
def test_nonfinite_parameters_are_refused(parameter):
    model = small_model(GAUSSIAN_POSITIONS)
    with torch.no_grad():
        getattr(model.gaussians, parameter)[3, 0] = torch.nan
    with pytest.raises(HyrfError, match="NaN"):
        bake(model, ring(2))


def test_poses_beyond_float32_are_refused():
    camera = ring(1)[0]
    pose = camera.camera_from_world.copy()
    pose[0, 3] = 3e38  # exceeds float32 in local units
    model = small_model(GAUSSIAN_POSITIONS)
    model.config = replace(model.config, frame=replace(model.config.frame, scale=0.01))
    with pytest.raises(HyrfError, match="camera"):
        bake(model, [replace(camera, camera_from_world=pose)])


def test_degree_3_harmonics_are_nearly_the_least_squares_optimum():
    model = shiny_model(GAUSSIAN_POSITIONS[:5])
    splats = bake(model, [])[3]
    d = torch.nn.functional.normalize(torch.randn(200, 3, generator=torch.Generator().manual_seed(1)), dim=1)
    basis = harmonics_basis(d)
    with torch.no_grad():
        truth = torch.stack([model.decode_colors(model.gaussians.positions - one) for one in d], 1)
    fitted = 0.5 + torch.einsum("vk,nkc->nvc", basis, torch.from_numpy(splats.harmonics))
    # The optimum is the least-squares solution on the directions of this test.
    best = torch.linalg.lstsq(basis.expand(5, -1, -1), truth - 0.5).solution
    least = (0.5 + basis @ best - truth).square().mean()
    assert (fitted - truth).square().mean() < 2 * least + 1e-6

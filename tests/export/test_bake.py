from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scenes import camera_at, ring, small_model

from hyrfpack.errors import HyrfError
from hyrfpack.export.bake import bake
from hyrfpack.model import Frame
from hyrfpack.render import RenderSettings, render_view
from hyrfpack.splats.draw import Drawable, draw
from hyrfpack.splats.harmonics import SH_C0, harmonics_basis

POSITIONS = np.random.default_rng(0).uniform(-0.6, 0.6, (60, 3))
ALL = RenderSettings(cull_tolerance=1e9)


def shiny_model(positions=POSITIONS, **options):
    """Colours change with the direction a lot."""
    return small_model(positions, fields=4.0, direction_encoding="sh", **options)


def error(model, splats, cameras, how=ALL, truth=None) -> float:
    """Root mean square of what the pictures differ by."""
    drawable = Drawable.from_splats(splats, model.config.frame)
    with torch.no_grad():
        pairs = [(draw(drawable, c, how).rgb, render_view(truth or model, c).rgb) for c in cameras]
    return float(torch.stack([(a - b).square().mean() for a, b in pairs]).mean().sqrt())


@settings(max_examples=12, deadline=None)
@given(st.floats(1e-3, 1e3), st.tuples(*[st.floats(-1e3, 1e3)] * 3), st.floats(-4, 4), st.integers(0, 4))
@example(1.0, (0.0, 0.0, 0.0), -3.939453125, 1)  # off by 1.3e-6
def test_colours_that_do_not_depend_on_direction_are_exact_at_degree_0(scale, center, logit, views):
    frame = Frame(center, scale, (1.0, 0.5, 0.25))
    model = small_model(POSITIONS, frame=frame, color_logits=logit)
    baked = bake(model, [camera_at(scale * c.position + center, center) for c in ring(views)], (0, 3))
    color = 1 / (1 + np.exp(-logit))
    # The fit's equations are sums in float32 over views and directions: 1.4e-6 at most in 1,200 tries.
    assert np.allclose(0.5 + SH_C0 * baked[0].harmonics[:, 0], color, atol=3e-6)
    assert np.allclose(0.5 + SH_C0 * baked[3].harmonics[:, 0], color, atol=1e-3)
    assert np.abs(baked[3].harmonics[:, 1:]).max() < 1e-3


def test_geometry_is_the_models_own_in_world_units():
    frame = Frame((100.0, -50.0, 3.0), 20.0, (1.0, 1.0, 0.5))
    model = shiny_model(frame=frame, antialiased=True)
    splats = bake(model, [])[3]
    with torch.no_grad():
        geometry = model.decode_geometry()
    assert np.allclose(splats.positions, POSITIONS * 20 + frame.center, atol=1e-5)
    assert np.allclose(splats.scales, 20 * geometry.scales, rtol=1e-6)
    assert np.array_equal(splats.opacities, geometry.opacities)
    lengths = torch.linalg.vector_norm(geometry.quats, dim=1, keepdim=True)
    agreement = (splats.quats * (geometry.quats / lengths).numpy()).sum(1)
    assert np.allclose(np.abs(agreement), 1, atol=1e-6) and (splats.quats[:, 0] >= 0).all()
    assert splats.antialiased


def test_each_degree_comes_nearer_to_the_model():
    model, cameras = shiny_model(), ring(12)
    baked = bake(model, cameras, range(4))
    errors = [error(model, baked[degree], cameras) for degree in range(4)]
    assert errors == sorted(errors, reverse=True) and errors[3] < 0.3 * errors[0]


def test_degrees_asked_for_together_are_those_asked_for_alone():
    model, cameras = shiny_model(), ring(3)
    together, alone = bake(model, cameras, (0, 3)), bake(model, cameras, (0,))[0]
    assert np.allclose(together[0].harmonics, alone.harmonics, atol=1e-6)
    assert not np.allclose(together[3].harmonics[:, :1], alone.harmonics, atol=1e-3)


def test_cameras_views_come_first_and_the_rest_of_the_sphere_is_not_forgotten():
    model = shiny_model()
    there, elsewhere = ring(6), ring(6, elevation=-2.5, radius=2.0)
    fitted, even = bake(model, there)[3], bake(model, [])[3]
    assert error(model, fitted, there) < 0.5 * error(model, even, there)
    flat = bake(model, there, (0,))[0]
    assert error(model, fitted, elsewhere) < error(model, flat, elsewhere)


def test_gaussians_that_no_camera_sees_follow_the_model_on_the_sphere():
    positions = np.concatenate((POSITIONS, POSITIONS + (0, 0, 40)))
    model = shiny_model(positions)
    seen, even = (bake(model, cameras)[3].harmonics for cameras in (ring(4), []))
    assert np.allclose(seen[60:], even[60:], atol=2e-2) and not np.allclose(seen[:60], even[:60], atol=2e-2)


def test_a_gaussian_that_hides_pictures_it_is_left_out_of_is_dropped():
    # Large, beside the cameras' line of sight, and only in pictures from which it is culled.
    camera = camera_at((0, -2, 0), (0, 0, 0))
    positions = np.concatenate((POSITIONS, [[1.6, -1.0, 0.0]]))
    scales = np.full((61, 1), -3.0)
    scales[-1] = 1.0
    model = small_model(positions, scale_logits=torch.from_numpy(scales).float())
    assert error(model, bake(model, [], (0,))[0], [camera]) > 0.05
    mended = bake(model, [camera], (0,))[0]
    assert len(mended) == 60
    assert error(model, mended, [camera]) < 1e-5


def test_gaussians_that_cameras_draw_keep_their_opacity():
    model = shiny_model()
    with torch.no_grad():
        assert np.array_equal(bake(model, ring(4))[3].opacities, model.decode_geometry().opacities)


def test_a_model_without_gaussians_bakes_to_nothing():
    baked = bake(small_model(np.zeros((0, 3))), ring(2), (0, 3))
    assert [len(baked[degree]) for degree in (0, 3)] == [0, 0] and baked[3].degree == 3


@pytest.mark.parametrize("broken", ["positions", "opacity_logits", "color_logits"])
def test_numbers_that_are_not_finite_are_rejected(broken):
    model = small_model(POSITIONS)
    with torch.no_grad():
        getattr(model.gaussians, broken)[3, 0] = torch.nan
    with pytest.raises(HyrfError, match="NaN"):
        bake(model, ring(2))


def test_poses_beyond_float32_are_refused():
    camera = ring(1)[0]
    pose = camera.camera_from_world.copy()
    pose[0, 3] = 3e38  # in local units it is more than float32 holds
    model = small_model(POSITIONS)
    model.config = replace(model.config, frame=replace(model.config.frame, scale=0.01))
    with pytest.raises(HyrfError, match="camera"):
        bake(model, [replace(camera, camera_from_world=pose)])


def test_sixteen_colours_on_the_sphere_are_met_by_harmonics_of_the_same_degree():
    model = shiny_model(POSITIONS[:5])
    splats = bake(model, [])[3]
    d = torch.nn.functional.normalize(torch.randn(200, 3, generator=torch.Generator().manual_seed(1)), dim=1)
    basis = harmonics_basis(d)
    with torch.no_grad():
        truth = torch.stack([model.decode_colors(model.gaussians.positions - one) for one in d], 1)
    fitted = 0.5 + torch.einsum("vk,nkc->nvc", basis, torch.from_numpy(splats.harmonics))
    # The best that harmonics can do, by plain least squares on the test's own directions.
    best = torch.linalg.lstsq(basis.expand(5, -1, -1), truth - 0.5).solution
    least = (0.5 + basis @ best - truth).square().mean()
    assert (fitted - truth).square().mean() < 2 * least + 1e-6

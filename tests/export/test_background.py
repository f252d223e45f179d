import math

import numpy as np
import pytest
import torch
from scenes import camera_at, ring, small_model

from hyrfpack.errors import HyrfError
from hyrfpack.export.background import (
    _accumulate_colors,
    compute_cell_centers,
    find_cells,
    make_background_splats,
    render_background_picture,
)
from hyrfpack.export.bake import bake, compute_visibility
from hyrfpack.model import BACKGROUND_RADIUS, Frame
from hyrfpack.render import RenderSettings, render_view
from hyrfpack.scene import Camera
from hyrfpack.splats.draw import Drawable, draw
from hyrfpack.splats.splats import concatenate

GAUSSIAN_POSITIONS = np.random.default_rng(0).uniform(-0.5, 0.5, (40, 3))


def sky_model(fields: float = 1.0, **options):
    return small_model(GAUSSIAN_POSITIONS, fields=fields, background=True, **options)


@pytest.mark.parametrize("level", [1, 2, 4])
def test_cell_centers_and_find_cells_agree_and_cover_the_sphere(level):
    cells = np.arange(6 * 4**level)
    directions, sides = compute_cell_centers(cells, level)
    assert np.array_equal(find_cells(directions, level), cells)
    assert np.allclose(np.linalg.norm(directions, axis=1), 1)
    if level == 4:
        assert np.sum(sides**2) == pytest.approx(4 * np.pi, rel=1e-3)
        assert np.array_equal(find_cells(directions, 3), cells // 4)


def test_a_uniform_background_becomes_a_uniform_nearly_opaque_layer():
    splats = make_background_splats(sky_model(0.0), ring(4))
    drawable = Drawable.from_splats(splats, Frame((0.0, 0.0, 0.0), 1.0, (1.0, 1.0, 1.0)))
    for camera in ring(3, elevation=-2.0, width=64, height=64):
        drawn = draw(drawable, camera)
        assert drawn.transmittance.max() < 0.15 and drawn.transmittance.mean() < 0.02
        assert torch.allclose(drawn.rgb, 0.5 * (1 - drawn.transmittance[..., None]).expand(-1, -1, 3), atol=1e-5)


def test_baked_splats_and_background_look_like_the_model():
    frame = Frame((30.0, 10.0, -5.0), 4.0, (1.0, 1.0, 0.5))
    model = sky_model(frame=frame, direction_encoding="sh")
    cameras = [camera_at(4 * c.position + frame.center, frame.center, width=48, height=48) for c in ring(6)]
    whole = Drawable.from_splats(concatenate((bake(model, cameras)[3], make_background_splats(model, cameras))), frame)
    with torch.no_grad():
        errors = [(draw(whole, camera).rgb - render_view(model, camera).rgb).square().mean() for camera in cameras]
    assert math.sqrt(sum(errors) / len(errors)) < 0.02


def test_background_splats_are_denser_where_cameras_look():
    model = sky_model(2.0)
    camera = camera_at((0, -3, 0), width=64, height=64, focal=64)
    splats = make_background_splats(model, [camera])
    assert 384 < len(splats) <= 1000
    ahead = splats.positions[:, 1] / np.linalg.norm(splats.positions, axis=1) > math.cos(0.6)
    assert ahead.mean() > 3 * (1 - math.cos(0.6)) / 2  # three times the share of a uniform sphere
    assert splats.scales[ahead].mean() < splats.scales[~ahead].mean()
    assert len(make_background_splats(model, [])) <= 1000


@pytest.mark.acceptance
@torch.no_grad()
def test_cells_add_up_the_light_that_all_cameras_see():
    model, camera = sky_model(), camera_at((0, -3, 0))
    (seen,) = compute_visibility(model, [camera])

    grid, once, twice = (_accumulate_colors(model, [camera] * n, [seen] * n)[0] for n in range(3))

    assert (once[:, 0] > 10 * grid[:, 0]).any()
    np.testing.assert_allclose(twice - grid, 2 * (once - grid), atol=1e-9)


def test_background_splats_lie_on_the_sphere_around_the_frame():
    frame = Frame((30.0, 10.0, -5.0), 4.0, (1.0, 1.0, 0.5))
    splats = make_background_splats(sky_model(frame=frame), ring(3))
    radii = np.linalg.norm(splats.positions - frame.center, axis=1) / frame.scale
    assert radii.min() == pytest.approx(BACKGROUND_RADIUS) and radii.max() < 2 * BACKGROUND_RADIUS
    assert splats.degree == 0 and np.array_equal(splats.quats, np.eye(1, 4).repeat(len(splats), 0))


def test_a_narrow_view_of_the_background_has_no_holes():
    camera = camera_at((0, -3, 0), (0, 0, 4), width=32, height=32, focal=200)  # the field of view is 9 degrees
    splats = make_background_splats(sky_model(0.0), [camera])
    drawn = draw(Drawable.from_splats(splats, Frame((0.0, 0.0, 0.0), 1.0, (1.0, 1.0, 1.0))), camera)
    assert drawn.transmittance.max() < 0.25 and drawn.transmittance.mean() < 0.05


def test_models_without_a_background_have_no_background_splats_and_no_picture():
    model = small_model(GAUSSIAN_POSITIONS, solid=(1.0, 1.0, 1.0))
    assert len(make_background_splats(model, ring(2))) == 0
    with pytest.raises(ValueError):
        render_background_picture(model)


def test_the_picture_has_z_in_the_middle_up_at_the_top_and_x_to_the_right():
    model = sky_model(frame=Frame((5.0, 6.0, 7.0), 2.0, (1.0, 0.5, 0.25)))
    picture = render_background_picture(model, 256)
    assert picture.shape == (256, 512, 3) and picture.dtype == np.float32
    # A camera without rotation has x right, y down and z ahead; transparent Gaussians leave the sphere visible.
    pose = np.eye(4)
    pose[:3, 3] = -np.array(model.config.frame.center)
    camera = Camera(3, 3, 1.0, 1.0, 1.5, 1.5, pose)  # its outer pixels have rays at 45 degrees
    with torch.no_grad():
        model.gaussians.opacity_logits.fill_(-30)
        seen = render_view(model, camera, RenderSettings(background_stride=1)).rgb.numpy()
    assert np.allclose(picture[127:129, 255:257].mean((0, 1)), seen[1, 1], atol=5e-3)
    assert np.allclose(picture[127:129, 319:321].mean((0, 1)), seen[1, 2], atol=5e-3)
    assert np.allclose(picture[63:65, 255:257].mean((0, 1)), seen[0, 1], atol=5e-3)
    assert not np.allclose(seen[1, 2], seen[1, 0], atol=2e-2)


def test_the_default_size_of_the_picture_follows_the_finest_grid():
    # The height is pi / 2 times the 12 cells of the finest grid.
    assert render_background_picture(sky_model()).shape == (
        19,
        38,
        3,
    )


def test_a_background_that_is_not_finite_is_refused():
    model = sky_model()
    with torch.no_grad():
        model.radiance.biases[-1][0] = torch.nan
    for use in (lambda: make_background_splats(model, ring(1)), lambda: render_background_picture(model, 8)):
        with pytest.raises(HyrfError, match="NaN"):
            use()

import math

import numpy as np
import pytest
import torch
from scenes import camera_at, small_model

from hyrfpack.errors import HyrfDataError
from hyrfpack.export.bake import bake
from hyrfpack.model import Frame
from hyrfpack.render import RenderSettings, render_view
from hyrfpack.splats.draw import Drawable, draw
from hyrfpack.splats.harmonics import SH_C0
from hyrfpack.splats.splats import Splats

UNIT_FRAME = Frame((0.0, 0.0, 0.0), 1.0, (1.0, 1.0, 1.0))


def one_splat(harmonics, *, opacity=0.5, position=(0, 0, 0), size=0.2) -> Splats:
    harmonics = np.asarray(harmonics, np.float64).reshape(1, -1, 3)
    return Splats(np.array([position], np.float64), np.full((1, 3), size), np.eye(1, 4), np.array([opacity]), harmonics)


def test_the_center_of_a_splat_shows_its_color_times_its_opacity():
    splats = one_splat([[0.1 / SH_C0, 0, -0.3 / SH_C0]])
    camera = camera_at((0, -3, 0), width=33, height=33)
    drawn = draw(Drawable.from_splats(splats, UNIT_FRAME), camera)
    assert drawn.rgb[16, 16].tolist() == pytest.approx([0.3, 0.25, 0.1], abs=1e-6)
    assert float(drawn.transmittance[16, 16]) == pytest.approx(0.5, abs=1e-6)


def test_a_splat_that_is_too_far_for_float32_is_refused():
    splats = one_splat([[0, 0, 0]], position=(0, 1e29, 0))
    with pytest.raises(
        HyrfDataError, match=r"the Gaussian at \(0, 1e\+29, 0\) is more than 3e38 times as far.*remove it"
    ):
        Drawable.from_splats(splats, Frame((0.0, 0.0, 0.0), 1e-20, (1.0, 1.0, 1.0)))


def test_negative_colors_are_clipped_to_zero():
    drawn = draw(Drawable.from_splats(one_splat([[-9.0, -9, -9]]), UNIT_FRAME), camera_at((0, -3, 0)))
    assert drawn.rgb.max() == 0 and drawn.transmittance.min() < 0.6


def test_black_splats_have_the_same_transmittance():
    drawable, camera = Drawable.from_splats(one_splat([[0.4, 0, 0]]), UNIT_FRAME), camera_at((0, -3, 0))
    black = draw(drawable, camera, black=True)
    assert black.rgb.max() == 0 and torch.equal(black.transmittance, draw(drawable, camera).transmittance)


def test_colors_depend_on_the_direction_from_camera_to_center():
    harmonics = np.zeros((4, 3))
    harmonics[2] = 0.2  # the coefficient of z
    above = draw(
        Drawable.from_splats(one_splat(harmonics), UNIT_FRAME), camera_at((0, 0, 3), up=(0, 1, 0), width=33, height=33)
    )
    below = draw(
        Drawable.from_splats(one_splat(harmonics), UNIT_FRAME), camera_at((0, 0, -3), up=(0, 1, 0), width=33, height=33)
    )
    step = 0.2 * math.sqrt(3 / (4 * math.pi))
    assert float(above.rgb[16, 16, 0]) == pytest.approx(0.5 * (0.5 - step), abs=1e-6)
    assert float(below.rgb[16, 16, 0]) == pytest.approx(0.5 * (0.5 + step), abs=1e-6)


@pytest.mark.parametrize("antialiased", [False, True])
def test_baked_splats_far_from_the_origin_look_like_their_model(antialiased):
    frame = Frame((1e5, -2e5, 50.0), 30.0, (1.0, 1.0, 1.0))
    positions = np.random.default_rng(0).uniform(-0.5, 0.5, (40, 3))
    colors = torch.randn(40, 3, generator=torch.Generator().manual_seed(0))
    model = small_model(positions, frame=frame, color_logits=colors, antialiased=antialiased)
    camera = camera_at(np.add(frame.center, (0, -90, 20)), frame.center)
    drawn = draw(Drawable.from_splats(bake(model, [], (0,))[0], frame), camera)
    with torch.no_grad():
        assert (drawn.rgb - render_view(model, camera).rgb).abs().max() < 2e-4


def test_splats_with_centers_outside_the_picture_are_culled():
    beside = Drawable.from_splats(one_splat([[1.0, 1, 1]], position=(1.5, 0, 0), size=0.5), UNIT_FRAME)
    camera = camera_at((0, -2, 0))
    assert draw(beside, camera).rgb.max() == 0
    assert draw(beside, camera, RenderSettings(cull_tolerance=2.0)).rgb.max() > 0.1

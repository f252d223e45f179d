import math

import numpy as np
import pytest
import torch
from scenes import camera_at, small_model

from hyrfpack.export.bake import bake
from hyrfpack.model import Frame
from hyrfpack.render import RenderSettings, render_view
from hyrfpack.splats.draw import Drawable, draw
from hyrfpack.splats.harmonics import SH_C0
from hyrfpack.splats.splats import Splats

UNIT = Frame((0.0, 0.0, 0.0), 1.0, (1.0, 1.0, 1.0))


def one_ball(harmonics, *, opacity=0.5, position=(0, 0, 0), size=0.2) -> Splats:
    harmonics = np.asarray(harmonics, np.float64).reshape(1, -1, 3)
    return Splats(np.array([position], np.float64), np.full((1, 3), size), np.eye(1, 4), np.array([opacity]), harmonics)


def test_a_ball_shows_its_colour_times_its_opacity_in_the_middle():
    splats = one_ball([[0.1 / SH_C0, 0, -0.3 / SH_C0]])
    camera = camera_at((0, -3, 0), width=33, height=33)
    drawn = draw(Drawable.from_splats(splats, UNIT), camera)
    assert drawn.rgb[16, 16].tolist() == pytest.approx([0.3, 0.25, 0.1], abs=1e-6)
    assert float(drawn.transmittance[16, 16]) == pytest.approx(0.5, abs=1e-6)


def test_colours_below_nothing_are_nothing():
    drawn = draw(Drawable.from_splats(one_ball([[-9.0, -9, -9]]), UNIT), camera_at((0, -3, 0)))
    assert drawn.rgb.max() == 0 and drawn.transmittance.min() < 0.6


def test_in_black_what_is_covered_is_the_same():
    drawable, camera = Drawable.from_splats(one_ball([[0.4, 0, 0]]), UNIT), camera_at((0, -3, 0))
    black = draw(drawable, camera, black=True)
    assert black.rgb.max() == 0 and torch.equal(black.transmittance, draw(drawable, camera).transmittance)


def test_the_colour_is_the_one_of_the_direction_from_camera_to_centre():
    harmonics = np.zeros((4, 3))
    harmonics[2] = 0.2  # of z
    above = draw(
        Drawable.from_splats(one_ball(harmonics), UNIT), camera_at((0, 0, 3), up=(0, 1, 0), width=33, height=33)
    )
    below = draw(
        Drawable.from_splats(one_ball(harmonics), UNIT), camera_at((0, 0, -3), up=(0, 1, 0), width=33, height=33)
    )
    step = 0.2 * math.sqrt(3 / (4 * math.pi))
    assert float(above.rgb[16, 16, 0]) == pytest.approx(0.5 * (0.5 - step), abs=1e-6)
    assert float(below.rgb[16, 16, 0]) == pytest.approx(0.5 * (0.5 + step), abs=1e-6)


@pytest.mark.parametrize("antialiased", [False, True])
def test_splats_far_from_the_origin_look_like_the_model_they_are(antialiased):
    frame = Frame((1e5, -2e5, 50.0), 30.0, (1.0, 1.0, 1.0))
    positions = np.random.default_rng(0).uniform(-0.5, 0.5, (40, 3))
    colors = torch.randn(40, 3, generator=torch.Generator().manual_seed(0))
    model = small_model(positions, frame=frame, color_logits=colors, antialiased=antialiased)
    camera = camera_at(np.add(frame.center, (0, -90, 20)), frame.center)
    drawn = draw(Drawable.from_splats(bake(model, [], (0,))[0], frame), camera)
    with torch.no_grad():
        assert (drawn.rgb - render_view(model, camera).rgb).abs().max() < 2e-4


def test_culling_leaves_out_centres_outside_the_picture():
    beside = Drawable.from_splats(one_ball([[1.0, 1, 1]], position=(1.5, 0, 0), size=0.5), UNIT)
    camera = camera_at((0, -2, 0))
    assert draw(beside, camera).rgb.max() == 0
    assert draw(beside, camera, RenderSettings(cull_tolerance=2.0)).rgb.max() > 0.1

"""Half precision: what `paper` stores as float16, near the frame's centre, far from it, and past its range.

float16 has 11 significant bits: numbers from 2^-14 to 65504 are kept within 2^-11 of themselves, smaller ones within
2^-25. Positions are stored local to the frame, (p - centre) / scale, so this is relative to the distance from the
centre of the scene, whatever its unit and wherever its origin.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import ball_scene, camera_at, small_model

from hyrfpack.errors import HyrfError
from hyrfpack.format import decode_model, encode_model
from hyrfpack.model import Frame, HybridModel
from hyrfpack.ops.contraction import contract
from hyrfpack.render import render_view
from hyrfpack.train import TrainConfig, Trainer

FLOAT16_MAX = 65504.0
RELATIVE, ABSOLUTE = 2.0**-11, 2.0**-25  # half a step of normal and of subnormal float16
HERE = Frame((0.0, 0.0, 0.0), 1.0, (1.0, 1.0, 1.0))

frames = st.builds(
    lambda center, log_scale, half: Frame(center, 10.0**log_scale, half),
    st.tuples(*[st.floats(-1e7, 1e7)] * 3),
    st.floats(-6, 6),
    st.tuples(*[st.floats(0.25, 1)] * 3),
)
local_points = st.lists(
    st.tuples(*[st.floats(-1.5, 1.5) | st.floats(-FLOAT16_MAX, FLOAT16_MAX) | st.floats(-1e-4, 1e-4)] * 3),
    min_size=1,
    max_size=8,
).map(np.array)


def through_paper(model: HybridModel) -> HybridModel:
    return decode_model(encode_model(model, "paper"))


def stored(local: np.ndarray, frame: Frame = HERE) -> np.ndarray:
    """Local positions as `paper` gives them back, float64."""
    return through_paper(small_model(local, frame=frame)).gaussians.positions.detach().double().numpy()


def bound(local: np.ndarray) -> np.ndarray:
    """Of the error of each coordinate: float32 rounds once before float16 does."""
    return (RELATIVE + 2.0**-23) * np.abs(local) + ABSOLUTE


# -- positions -------------------------------------------------------------------------------------------------------


@given(frames, local_points)
@settings(max_examples=40, deadline=None)
def test_positions_in_any_frame_keep_11_bits_of_their_distance_from_its_centre(frame, local):
    world = frame.to_world(local)

    back = frame.to_world(stored(frame.to_local(world), frame))

    inherent = 2.0**-51 * (np.abs(frame.center) + np.abs(world))  # float64 on the way to the frame and back
    assert (np.abs(back - world) <= bound(local) * frame.scale + inherent).all()


@given(local_points)
@settings(max_examples=40, deadline=None)
def test_stored_positions_are_the_nearest_halves(local):
    singles = local.astype(np.float32)

    assert np.array_equal(stored(singles), singles.astype(np.float16).astype(np.float64))


@given(frames, st.floats(FLOAT16_MAX * (1 + 1e-6), 3e38), st.booleans(), st.integers(0, 2))
@settings(max_examples=40, deadline=None)
def test_positions_past_half_precision_are_rejected_with_a_clear_error_in_any_frame(frame, distance, negative, axis):
    local = np.zeros((3, 3))
    local[1, axis] = -distance if negative else distance

    with pytest.raises(HyrfError) as caught:
        encode_model(small_model(local, frame=frame), "paper")

    message = str(caught.value)
    assert "model's positions reach" in message and "half precision ends at 65504" in message
    assert "profile raw" in message and "\n" not in message


def test_positions_of_subnormal_halves_are_within_half_a_step_of_theirs():
    """Within 6e-5 of the centre steps are even, 6e-8 of the frame: far below what a pixel shows."""
    local = np.random.default_rng(0).uniform(-(2.0**-14), 2.0**-14, (2000, 3))
    local[:4, 0] = 2.0**-24, 2.0**-26, -1e-45, -0.0

    error = np.abs(stored(local) - local)

    assert error.max() <= ABSOLUTE * (1 + 2.0**-12)
    assert stored(local)[:4, 0].tolist() == [2.0**-24, 0, 0, 0]


@given(st.floats(0, np.log10(FLOAT16_MAX / 2)), st.integers(0, 2**31), st.tuples(*[st.floats(0.25, 1)] * 3))
@settings(max_examples=40, deadline=None)
def test_far_points_move_less_than_2_to_the_minus_12_in_the_contracted_cube(log_radius, seed, half):
    """The contraction turns the growing steps of far halves into an angle: an eighth of a cell of 512 at most.

    Along a ray c' = 0.25 / r^2 and across it 0.25 (2 - 1/r) / r, both at most 0.5 / r; the error is 2^-11 r.
    """
    frame = Frame((0.0, 0.0, 0.0), 1.0, half)
    directions = np.random.default_rng(seed).normal(size=(50, 3))
    local = 10.0**log_radius * directions / np.linalg.norm(directions, axis=1, keepdims=True) * half

    cubes = [contract(frame.normalize(torch.from_numpy(points))) for points in (local, stored(local, frame))]

    assert torch.linalg.vector_norm(cubes[1] - cubes[0], dim=-1).max() <= 2.0**-12 * (1 + 2.0**-10)


@pytest.mark.parametrize("radius", [1.0, 30.0, 1000.0, 60_000.0])
def test_seen_from_the_centre_points_turn_by_2_to_the_minus_11_radians_at_most(radius):
    """In pixels: the focal length over 2,048, at any distance; half a pixel for a photo of 1,000 pixels."""
    directions = np.random.default_rng(1).normal(size=(5000, 3))
    local = radius * directions / np.linalg.norm(directions, axis=1, keepdims=True)

    after = stored(local)

    sines = np.linalg.norm(np.cross(local, after), axis=1) / (radius * np.linalg.norm(after, axis=1))
    assert sines.max() <= RELATIVE * (1 + 1e-3)
    assert sines.max() > RELATIVE / 8  # else a finer bound would hold


# -- pictures --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("radius", [1.0, 30.0, 1000.0, 60_000.0])
def test_far_backgrounds_look_the_same_after_half_precision_however_far(radius):
    """A wall of Gaussians of the same size in pixels at any distance: PSNR of what half precision changes."""
    generator = np.random.default_rng(2)
    directions = np.stack((generator.uniform(-0.5, 0.5, 400), np.ones(400), generator.uniform(-0.5, 0.5, 400)), axis=-1)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    positions = directions * generator.uniform(radius / 2, radius, (400, 1))  # else rounding would reorder equal depths
    model = small_model(positions, color_logits=torch.randn(400, 3, generator=torch.Generator().manual_seed(0)))
    halves = small_model(stored(positions))
    halves.load_state_dict({**model.state_dict(), "gaussians.positions": halves.gaussians.positions})
    camera = camera_at((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), width=96, height=96)

    with torch.no_grad():
        before, after = (render_view(m, camera).rgb for m in (model, halves))

    assert before.std() > 0.05  # else there is nothing to lose
    assert -10 * torch.log10(((after - before) ** 2).mean()) > 56


@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), (1e6, -1e6, 5e5)], ids=["origin", "a million units away"])
def test_a_trained_scene_loses_as_little_far_from_the_origin(offset):
    """Halves of world coordinates would be infinite there."""
    trainer = Trainer(ball_scene(6, 60, side=24, offset=offset), TrainConfig(steps=60, max_gaussians=200))
    trainer.run()
    decoded = through_paper(trainer.model)

    with torch.no_grad():
        errors = [
            (render_view(decoded, v.camera).rgb - render_view(trainer.model, v.camera).rgb).square()
            for v in trainer.scene.train
        ]
    assert -10 * torch.log10(torch.stack(errors).mean()) > 58


# -- logits and decoders ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["color_logits", "scale_logits", "opacity_logits"])
@pytest.mark.parametrize("largest", [12.0, 80.0, 65504.0])
def test_logits_up_to_the_end_of_half_precision_stay_finite_and_near(name, largest):
    """As many codewords as rows: what is left is rounding, 11 bits of the largest of a column (opacities are cut)."""
    model = small_model(np.random.default_rng(3).normal(size=(16, 3)))
    logits = getattr(model.gaussians, name)
    with torch.no_grad():
        logits.copy_(torch.linspace(-1, 1, logits.numel()).reshape(logits.shape) * largest)

    decoded = getattr(through_paper(model).gaussians, name)

    expected = logits.clamp(-12, 12) if name == "opacity_logits" else logits
    # Opacities are cut where they do not change: within 7e-6 of 0 and 1, that is from logit 11.9 on.
    assert torch.isfinite(decoded).all()
    assert (torch.sigmoid(decoded) - torch.sigmoid(expected)).abs().max() <= 1e-3
    assert (decoded - expected).abs().max() <= 2 * RELATIVE * expected.abs().max()


@pytest.mark.parametrize("name", ["color_logits", "scale_logits", "opacity_logits"])
def test_logits_past_half_precision_are_rejected_by_name(name):
    model = small_model(np.zeros((4, 3)))
    with torch.no_grad():
        getattr(model.gaussians, name)[2] = 65540.0
        if name == "opacity_logits":  # only the sum with the field's part counts, and that is cut to 12
            model.geometry.biases[-1][0] = -65504.0

    with pytest.raises(HyrfError, match=f"model's {name.replace('color', 'colour').replace('_', ' ')} reach 655"):
        encode_model(model, "paper")


@given(st.floats(-45, 4.8), st.integers(0, 2**31))
@settings(max_examples=40, deadline=None)
def test_decoder_weights_are_the_nearest_halves_down_to_zero(log_size, seed):
    """From 1e-45 to 6e4: below 2^-14 steps are even, below 2^-25 a weight is zero."""
    model = small_model(np.zeros((1, 3)))
    weights = model.radiance.weights[0]
    with torch.no_grad():
        values = torch.rand(weights.shape, generator=torch.Generator().manual_seed(seed)) * 2 - 1
        weights.copy_(values * 10.0**log_size)

    decoded = through_paper(model).radiance.weights[0].detach().double()

    exact = weights.detach().double()
    assert ((decoded - exact).abs() <= exact.abs() * RELATIVE + ABSOLUTE).all()


@pytest.mark.parametrize("part", ["geometry", "radiance"])
def test_decoder_weights_past_half_precision_are_rejected_by_name(part):
    model = small_model(np.zeros((1, 3)))
    with torch.no_grad():
        getattr(model, part).weights[1][3, 3] = -65505.0

    with pytest.raises(HyrfError, match=f"model's {part} decoder reach 65505 and half precision ends"):
        encode_model(model, "paper")


def test_a_geometry_field_that_overflows_is_rejected_with_a_clear_error():
    """Tables and weights are finite each, their products are not: opacities are inf - inf."""
    model = small_model(np.random.default_rng(4).normal(size=(5, 3)))
    with torch.no_grad():
        model.geometry.grid.table.mul_(3e38)
        for weights in model.geometry.weights:
            weights.fill_(6e4)
            weights[:, ::2] *= -1

    with pytest.raises(HyrfError, match="geometry field gives opacities that are NaN or infinite; train it again"):
        encode_model(model, "paper")

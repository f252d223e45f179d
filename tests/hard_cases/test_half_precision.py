"""Half precision: what `paper` stores as float16 near the frame's centre, far from it, and out of range.

float16 has 11 significant bits: numbers from 2^-14 to 65504 keep a relative error of 2^-11, smaller ones an absolute
error of 2^-25. Positions are stored in the frame's local units, (p - centre) / scale, so the error is relative to the
distance from the scene's centre, for any unit and origin.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples
from scenes import ball_scene, camera_at, small_model

from hyrfpack.errors import HyrfError
from hyrfpack.format import decode_model, encode_model
from hyrfpack.model import Frame, HybridModel
from hyrfpack.ops.contraction import contract
from hyrfpack.render import RenderSettings, render_view
from hyrfpack.train import TrainConfig, Trainer

FLOAT16_MAX = 65504.0
# Half a step of normal and of subnormal float16 numbers.
MAX_RELATIVE_ERROR = 2.0**-11
MAX_ABSOLUTE_ERROR = 2.0**-25
UNIT_FRAME = Frame((0.0, 0.0, 0.0), 1.0, (1.0, 1.0, 1.0))

random_frames = st.builds(
    lambda center, log_scale, half: Frame(center, 10.0**log_scale, half),
    st.tuples(*[st.floats(-1e7, 1e7)] * 3),
    st.floats(-6, 6),
    st.tuples(*[st.floats(0.25, 1)] * 3),
)
random_local_points = st.lists(
    st.tuples(*[st.floats(-1.5, 1.5) | st.floats(-FLOAT16_MAX, FLOAT16_MAX) | st.floats(-1e-4, 1e-4)] * 3),
    min_size=1,
    max_size=8,
).map(np.array)


def through_paper(model: HybridModel) -> HybridModel:
    return decode_model(encode_model(model, "paper"))


def decode_positions(local: np.ndarray, frame: Frame = UNIT_FRAME) -> np.ndarray:
    """Return local positions as `paper` decodes them, in float64."""
    return through_paper(small_model(local, frame=frame)).gaussians.positions.detach().double().numpy()


def position_error_bound(local: np.ndarray) -> np.ndarray:
    """Return the largest possible error of each coordinate: float32 rounds once before float16 does."""
    return (MAX_RELATIVE_ERROR + 2.0**-23) * np.abs(local) + MAX_ABSOLUTE_ERROR


# -- positions -------------------------------------------------------------------------------------------------------


@given(random_frames, random_local_points)
@examples(40)
def test_positions_in_any_frame_keep_11_bits_of_their_distance_from_its_centre(frame, local):
    world = frame.to_world(local)

    back = frame.to_world(decode_positions(frame.to_local(world), frame))

    inherent = 2.0**-51 * (np.abs(frame.center) + np.abs(world))  # float64 in the conversion to the frame and back
    assert (np.abs(back - world) <= position_error_bound(local) * frame.scale + inherent).all()


@given(random_local_points)
@examples(40)
def test_stored_positions_are_the_nearest_halves(local):
    singles = local.astype(np.float32)

    assert np.array_equal(decode_positions(singles), singles.astype(np.float16).astype(np.float64))


@given(random_frames, st.floats(FLOAT16_MAX * (1 + 1e-6), 3e38), st.booleans(), st.integers(0, 2))
@examples(40)
def test_positions_past_half_precision_are_rejected_with_a_clear_error_in_any_frame(frame, distance, negative, axis):
    local = np.zeros((3, 3))
    local[1, axis] = -distance if negative else distance

    with pytest.raises(HyrfError) as caught:
        encode_model(small_model(local, frame=frame), "paper")

    message = str(caught.value)
    assert "model's positions reach" in message and "half precision ends at 65504" in message
    assert "profile raw" in message and "\n" not in message


def test_positions_stored_as_subnormal_halves_are_within_half_a_step():
    """Within 6e-5 of the centre steps have a constant size of 6e-8 of the frame, far below what a pixel shows."""
    local = np.random.default_rng(0).uniform(-(2.0**-14), 2.0**-14, (2000, 3))
    local[:4, 0] = 2.0**-24, 2.0**-26, -1e-45, -0.0

    error = np.abs(decode_positions(local) - local)

    assert error.max() <= MAX_ABSOLUTE_ERROR * (1 + 2.0**-12)
    assert decode_positions(local)[:4, 0].tolist() == [2.0**-24, 0, 0, 0]


@given(st.floats(0, np.log10(FLOAT16_MAX / 2)), st.integers(0, 2**31), st.tuples(*[st.floats(0.25, 1)] * 3))
@examples(40)
def test_far_points_move_less_than_2_to_the_minus_12_in_the_contracted_cube(log_radius, seed, half):
    """The contraction turns the growing steps of far positions into an angle, at most an eighth of a cell of 512.

    Along a ray c' = 0.25 / r^2, and across it 0.25 (2 - 1/r) / r; both are at most 0.5 / r, and the error is 2^-11 r.
    """
    frame = Frame((0.0, 0.0, 0.0), 1.0, half)
    directions = np.random.default_rng(seed).normal(size=(50, 3))
    local = 10.0**log_radius * directions / np.linalg.norm(directions, axis=1, keepdims=True) * half

    cubes = [
        contract(torch.from_numpy(points), frame.half_extent) for points in (local, decode_positions(local, frame))
    ]

    assert torch.linalg.vector_norm(cubes[1] - cubes[0], dim=-1).max() <= 2.0**-12 * (1 + 2.0**-10)


@pytest.mark.parametrize("radius", [1.0, 30.0, 1000.0, 60_000.0])
def test_directions_from_the_centre_change_by_at_most_2_to_the_minus_11_radians(radius):
    """In pixels this is the focal length over 2,048 at any distance: half a pixel for a photo of 1,000 pixels."""
    directions = np.random.default_rng(1).normal(size=(5000, 3))
    local = radius * directions / np.linalg.norm(directions, axis=1, keepdims=True)

    after = decode_positions(local)

    sines = np.linalg.norm(np.cross(local, after), axis=1) / (radius * np.linalg.norm(after, axis=1))
    assert sines.max() <= MAX_RELATIVE_ERROR * (1 + 1e-3)
    assert sines.max() > MAX_RELATIVE_ERROR / 8  # otherwise a tighter bound would hold


# -- pictures --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("radius", [1.0, 30.0, 1000.0, 60_000.0])
def test_half_precision_preserves_backgrounds_at_any_distance(radius):
    """A wall of Gaussians has the same size in pixels at any distance; the PSNR is that of the change."""
    generator = np.random.default_rng(2)
    directions = np.stack((generator.uniform(-0.5, 0.5, 400), np.ones(400), generator.uniform(-0.5, 0.5, 400)), axis=-1)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    positions = directions * generator.uniform(
        radius / 2, radius, (400, 1)
    )  # otherwise rounding would reorder equal depths
    model = small_model(positions, color_logits=torch.randn(400, 3, generator=torch.Generator().manual_seed(0)))
    halves = small_model(decode_positions(positions))
    halves.load_state_dict({**model.state_dict(), "gaussians.positions": halves.gaussians.positions})
    camera = camera_at((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), width=96, height=96)

    with torch.no_grad():
        before, after = (render_view(m, camera).rgb for m in (model, halves))

    assert before.std() > 0.05  # otherwise there is nothing to lose
    assert -10 * torch.log10(((after - before) ** 2).mean()) > 56


@pytest.mark.parametrize(
    "offset",
    [
        pytest.param((0.0, 0.0, 0.0), id="origin", marks=pytest.mark.acceptance),
        pytest.param((1e6, -1e6, 5e5), id="a million units away"),
    ],
)
def test_half_precision_preserves_a_trained_scene_far_from_the_origin(offset):
    """In half precision, world coordinates would be infinite there."""
    trainer = Trainer(ball_scene(6, 60, side=24, offset=offset), TrainConfig(steps=60, max_gaussians=200))
    trainer.run()
    decoded = through_paper(trainer.model)
    settings = RenderSettings(background_stride=1)  # only the model in training knows the cameras of its photos

    with torch.no_grad():
        errors = [
            (render_view(decoded, v.camera, settings).rgb - render_view(trainer.model, v.camera, settings).rgb).square()
            for v in trainer.scene.train
        ]
    assert -10 * torch.log10(torch.stack(errors).mean()) > 58


# -- logits and decoders ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["color_logits", "scale_logits", "opacity_logits"])
@pytest.mark.parametrize("largest", [12.0, 80.0, 65504.0])
def test_logits_up_to_the_limit_of_half_precision_stay_finite_and_close(name, largest):
    """With as many codewords as rows only rounding remains: 11 bits of a column's largest number."""
    model = small_model(np.random.default_rng(3).normal(size=(16, 3)))
    logits = getattr(model.gaussians, name)
    with torch.no_grad():
        logits.copy_(torch.linspace(-1, 1, logits.numel()).reshape(logits.shape) * largest)

    decoded = getattr(through_paper(model).gaussians, name)

    expected = logits.clamp(-12, 12) if name == "opacity_logits" else logits
    # Opacities are clipped where that changes them by less than 7e-6, that is from a logit of 11.9 on.
    assert torch.isfinite(decoded).all()
    assert (torch.sigmoid(decoded) - torch.sigmoid(expected)).abs().max() <= 1e-3
    assert (decoded - expected).abs().max() <= 2 * MAX_RELATIVE_ERROR * expected.abs().max()


@pytest.mark.parametrize("name", ["color_logits", "scale_logits", "opacity_logits"])
def test_logits_past_half_precision_are_rejected_by_name(name):
    model = small_model(np.zeros((4, 3)))
    with torch.no_grad():
        getattr(model.gaussians, name)[2] = 65540.0
        if name == "opacity_logits":  # only its sum with the field's output matters, and that is clipped to 12
            model.geometry.biases[-1][0] = -65504.0

    with pytest.raises(HyrfError, match=f"model's {name.replace('color', 'colour').replace('_', ' ')} reach 655"):
        encode_model(model, "paper")


@given(st.floats(-45, 4.8), st.integers(0, 2**31))
@examples(40)
def test_decoder_weights_are_the_nearest_halves_down_to_zero(log_size, seed):
    """From 1e-45 to 6e4: below 2^-14 steps are constant, below 2^-25 a weight is zero."""
    model = small_model(np.zeros((1, 3)))
    weights = model.radiance.weights[0]
    with torch.no_grad():
        values = torch.rand(weights.shape, generator=torch.Generator().manual_seed(seed)) * 2 - 1
        weights.copy_(values * 10.0**log_size)

    decoded = through_paper(model).radiance.weights[0].detach().double()

    exact = weights.detach().double()
    assert ((decoded - exact).abs() <= exact.abs() * MAX_RELATIVE_ERROR + MAX_ABSOLUTE_ERROR).all()


@pytest.mark.parametrize("part", ["geometry", "radiance"])
def test_decoder_weights_past_half_precision_are_rejected_by_name(part):
    model = small_model(np.zeros((1, 3)))
    with torch.no_grad():
        getattr(model, part).weights[1][3, 3] = -65505.0

    with pytest.raises(HyrfError, match=f"model's {part} decoder reach 65505 and half precision ends"):
        encode_model(model, "paper")


def test_a_geometry_field_that_overflows_is_rejected_with_a_clear_error():
    """Tables and weights are finite and their products are not: opacities become inf - inf."""
    model = small_model(np.random.default_rng(4).normal(size=(5, 3)))
    with torch.no_grad():
        model.geometry.grid.table.mul_(3e38)
        for weights in model.geometry.weights:
            weights.fill_(6e4)
            weights[:, ::2] *= -1

    with pytest.raises(HyrfError, match="geometry field gives opacities that are NaN or infinite; train it again"):
        encode_model(model, "paper")

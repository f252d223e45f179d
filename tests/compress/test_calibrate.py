"""Calibrated sensitivities predict the error that pictures show."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
import torch
from scenes import ball_points, ring, small_model

from hyrfpack.compress.calibrate import MAX_CORRECTION_ROUNDS, calibrate
from hyrfpack.compress.correction import PREDICTION_TOLERANCE_RATIO, CorrectionFactor, SensitivityCorrection
from hyrfpack.compress.part_errors import (
    COLOR_SECTIONS,
    QUANTIZED_PARTS,
    ErrorMeasurement,
    decode_changed,
    predict_errors,
)
from hyrfpack.compress.plan import make_plan
from hyrfpack.compress.planner import Planner
from hyrfpack.compress.quantize import field_opacity_logits, plan_and_quantize
from hyrfpack.compress.reference_renders import ReferenceRenders
from hyrfpack.compress.sensitivity import PRUNED_KEY, Sensitivity, measure_sensitivity
from hyrfpack.format import decode_model, encode_model
from hyrfpack.format.arrays import iter_parameters, to_arrays
from hyrfpack.format.sections import COLORS, OPACITIES, POSITIONS, RESIDUAL_SECTIONS, SCALES
from hyrfpack.model import HybridModel
from hyrfpack.render.in_view import colors_in_view
from tools.safety.make_golden import add_golden_residuals

CALIBRATION_CAMERAS = ring(8, width=48, height=48)
HELD_OUT_CAMERAS = ring(7, width=40, height=40)


def overlapping_model(count: int = 1500) -> HybridModel:
    """Return overlapping half-transparent Gaussians of all colours, whose pictures depend on their depth order."""
    rng = np.random.default_rng(5)
    return small_model(
        ball_points(count)[0],
        fields=0.2,
        color_logits=rng.normal(0, 3, size=(count, 3)),
        scale_logits=-2.0,
        opacity_logits=rng.normal(0, 1, size=(count, 1)),
    )


def predict_and_measure_error(model: HybridModel, sensitivity: Sensitivity, distortion: float) -> tuple[float, float]:
    """Return the predicted error of a packed file, and the error measured at held-out viewpoints."""
    quantized = plan_and_quantize(model, sensitivity, distortion)
    decoded = decode_model(encode_model(model, "compact", quantized=quantized))
    planned = quantized.plan.apply(model)
    predicted = predict_errors(planned, quantized, sensitivity, field_opacity_logits(planned))
    return sum(predicted.values()), ReferenceRenders.from_model(model, HELD_OUT_CAMERAS).measure_error(decoded)


@pytest.fixture(scope="module")
def model() -> HybridModel:
    return overlapping_model()


@pytest.fixture(scope="module")
def first_order(model) -> Sensitivity:
    return measure_sensitivity(model, CALIBRATION_CAMERAS)


@pytest.mark.parametrize("distortion", [1e-3, pytest.param(1e-5, marks=pytest.mark.acceptance)])
def test_calibrated_predictions_are_within_50_percent_where_gaussians_swap_order(distortion, model, first_order):
    sensitivity = calibrate(model, first_order, ReferenceRenders.from_model(model, CALIBRATION_CAMERAS), distortion)

    predicted, measured = predict_and_measure_error(model, sensitivity, distortion)

    assert 2 / 3 < predicted / measured < 3 / 2 and 2 / 3 < measured / distortion < 3 / 2


def test_predictions_without_calibration_are_too_low_by_a_factor_of_2(model, first_order):
    predicted, measured = predict_and_measure_error(model, first_order, 1e-5)

    assert measured > 2 * predicted


def test_calibrating_twice_changes_little(model, first_order):
    references = ReferenceRenders.from_model(model, CALIBRATION_CAMERAS)
    once = calibrate(model, first_order, references, 1e-4)

    again = calibrate(model, once, references, 1e-4)

    for part in ("colors", "scales", "opacities"):
        np.testing.assert_allclose(getattr(again, part), getattr(once, part), rtol=0.3)


def test_scaled_by_multiplies_each_part_by_its_factor():
    sensitivity = Sensitivity(*np.ones((5, 3)), {"RTAB": np.ones(4)})

    scaled = sensitivity.scaled_by({POSITIONS: 2.0, OPACITIES: 4.0, "RTAB": 3.0, PRUNED_KEY: 5.0})

    assert [values.tolist() for values in (scaled.positions, scaled.colors, scaled.opacities)] == [
        [2.0] * 3,
        [1.0] * 3,
        [4.0] * 3,
    ]
    assert scaled.fields["RTAB"].tolist() == [3.0] * 4 and scaled.removals.tolist() == [5.0] * 3


def test_calibration_prunes_fewer_gaussians_where_their_errors_add_up():
    """Each of the many faint Gaussians alone is invisible, but together they make up the picture."""
    rng = np.random.default_rng(2)
    model = small_model(
        rng.normal(0, 0.2, size=(3000, 3)),
        color_logits=3.0,
        scale_logits=-2.0,
        opacity_logits=rng.normal(-5, 1, (3000, 1)),
    )
    sensitivity = measure_sensitivity(model, CALIBRATION_CAMERAS)
    distortion = 1e-4

    calibrated = calibrate(model, sensitivity, ReferenceRenders.from_model(model, CALIBRATION_CAMERAS), distortion)

    assert len(make_plan(model, calibrated, distortion).kept) > 2 * len(make_plan(model, sensitivity, distortion).kept)
    predicted, measured = predict_and_measure_error(model, calibrated, distortion)
    assert measured < 2 * distortion and predicted < 2 * distortion


def test_a_single_outlier_view_does_not_affect_the_measured_error(model):
    references = ReferenceRenders.from_model(model, CALIBRATION_CAMERAS)
    broken = [torch.ones_like(picture) if n == 0 else picture for n, picture in enumerate(references.pictures)]

    assert replace(references, pictures=broken).measure_error(model) == 0.0


# Both errors of the first two views, 0.04 and 0.49, must be far from the prediction, on the same side.
@pytest.mark.parametrize(
    ("predicted", "expected"),
    [(0.04 / 6.5, 0.04), (0.04 / 5.5, None), (0.2, None), (0.49 * 5.5, None), (0.49 * 6.5, 0.49)],
)
def test_errors_far_from_their_prediction_are_measured_in_two_views(predicted, expected, model):
    references = ReferenceRenders.from_model(model, CALIBRATION_CAMERAS)
    broken = [picture + 0.1 * number for number, picture in enumerate(references.pictures)]
    errors = 0.01 * np.arange(len(broken)) ** 2
    assert errors[[2, 7]] == pytest.approx([0.04, 0.49])  # of the two views

    measured = replace(references, pictures=broken).measure_error(model, predicted=predicted)

    assert measured == pytest.approx(np.median(errors) if expected is None else expected, rel=1e-3)


def test_sensitivities_of_invisible_gaussians_stay_negligible():
    """No camera sees the model, so that the measured error is zero and must not be divided by."""
    model = small_model(ball_points(40)[0] * 0.1 + np.array([0.0, 0.0, 500.0]))
    sensitivity = measure_sensitivity(model, CALIBRATION_CAMERAS)

    calibrated = calibrate(model, sensitivity, ReferenceRenders.from_model(model, CALIBRATION_CAMERAS), 1e-4)

    for name in ("positions", "colors", "scales", "opacities"):
        assert (0 < getattr(calibrated, name)).all() and (getattr(calibrated, name) < 1e-29).all()


@pytest.mark.parametrize("count", [1, 2])
def test_calibration_works_with_one_and_two_cameras(count, model, first_order):
    references = ReferenceRenders.from_model(model, CALIBRATION_CAMERAS[:count])

    calibrated = calibrate(model, first_order, references, 1e-4)

    assert all(np.isfinite(values).all() for values in (calibrated.positions, calibrated.colors))
    assert COLORS not in calibrated.fields


# -- correction -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("first_ratio", [7.0, 3.0, 0.2])
@pytest.mark.parametrize("power", [0.6, 1.0, 1.4, 2.0])
@pytest.mark.parametrize("exponent", [0.7, 1.0, 1.5])
def test_the_correction_converges_in_three_rounds_for_any_power_law(exponent, power, first_ratio):
    factor, tries = CorrectionFactor(exponent), 0
    while not factor.converged:
        factor.update(first_ratio * factor.value**-power)
        tries += 1
    assert tries <= 3 and first_ratio * factor.value**-power < PREDICTION_TOLERANCE_RATIO


def test_the_correction_brackets_a_jump_of_the_error():
    factor = CorrectionFactor(0.7)
    for _ in range(20):
        if factor.converged:
            break
        factor.update(3.0 if factor.value < 5 else 0.1)
    assert factor.converged and 5 <= factor.value < 5 * PREDICTION_TOLERANCE_RATIO


@pytest.mark.parametrize("ratio", [0.0, 1.0])
def test_the_correction_stays_finite_for_constant_errors(ratio):
    factor = CorrectionFactor(1.0)
    for _ in range(MAX_CORRECTION_ROUNDS):
        factor.update(ratio)
        assert np.isfinite(factor.value) and factor.value >= 0


@pytest.mark.parametrize(
    ("ratio", "part", "change"), [(0.6, POSITIONS, 1.0), (0.6, COLORS, 0.6), (0.8, COLORS, 1.0), (1.8, COLORS, 1.8)]
)
def test_small_corrections_are_not_measured_again(ratio, part, change):
    """Positions may have half of their predicted error: a smaller factor may give several times the error, because
    their steps are powers of two."""
    correction = SensitivityCorrection(Sensitivity(*np.ones((5, 3)), {}), [(part,)])
    before = correction.candidate()
    correction.update({(part,): ErrorMeasurement(ratio, 1.0)}, min_error=0.0)

    name = "positions" if part == POSITIONS else "colors"
    assert not correction.remaining
    assert getattr(correction.result(), name) == pytest.approx(change * getattr(before, name))


@pytest.mark.parametrize(("ratio", "part"), [(0.4, POSITIONS), (0.4, COLORS), (2.5, COLORS)])
def test_large_corrections_are_measured_again(ratio, part):
    correction = SensitivityCorrection(Sensitivity(*np.ones((5, 3)), {}), [(part,)])
    correction.update({(part,): ErrorMeasurement(ratio, 1.0)}, min_error=0.0)

    assert correction.remaining == [(part,)]


@pytest.mark.parametrize("part", QUANTIZED_PARTS[1:], ids="".join)
@pytest.mark.parametrize("decoder_scale", [0.2, 0.0])
def test_updating_changed_parts_equals_decoding_the_whole_model(part, decoder_scale):
    before = overlapping_model(200)
    if part[0] in RESIDUAL_SECTIONS:
        before = add_golden_residuals(before, 1)
    if not decoder_scale:  # with zero weights the colour decoder has no influence
        before.radiance.weights[-1].data.zero_(), before.radiance.biases[-1].data.zero_()
    changed = deepcopy(before)
    arrays = to_arrays(before)
    generator = np.random.default_rng(0)
    other = {name: arrays[name] * generator.uniform(0.5, 1.5, arrays[name].shape).astype(np.float32) for name in part}
    changed.load_state_dict(dict(iter_parameters(other, changed)), strict=False)

    references, outputs = ReferenceRenders.from_model(before, CALIBRATION_CAMERAS), before.geometry_outputs()
    decoded = decode_changed(changed, part, before.decode_geometry(), outputs)
    colors = None if COLOR_SECTIONS.intersection(part) else references.colors
    measured = references.measure_error(changed, decoded, colors)

    expected = references.measure_error(changed)
    assert measured == pytest.approx(expected, rel=1e-3) and (expected > 1e-7 or not decoder_scale)


def test_colours_after_a_change_of_logits_equal_those_of_the_changed_model(model):
    references, changed = ReferenceRenders.from_model(model, CALIBRATION_CAMERAS), deepcopy(model)
    change = torch.from_numpy(np.random.default_rng(1).normal(0, 2, size=(len(model), 3)).astype(np.float32))
    changed.gaussians.color_logits.data += change

    shifted = references.shift_color_logits(change)

    for ours, view in zip(shifted, references.views, strict=True):
        torch.testing.assert_close(ours, colors_in_view(changed, view, changed.decode()), rtol=0, atol=1e-5)


def test_colors_after_a_huge_change_of_their_logits_are_finite(model):
    references = ReferenceRenders.from_model(model, CALIBRATION_CAMERAS)
    for change in (-1e6, 1e6):
        for colors in references.shift_color_logits(torch.full((len(model), 3), change)):
            assert torch.isfinite(colors).all() and 0 <= colors.min() and colors.max() <= 1


def test_a_plan_is_made_again_only_if_it_would_differ(model, first_order):
    planner = Planner(model)
    planned = planner.plan(first_order, 1e-4)

    assert planner.plan(first_order.scaled_by({COLORS: 3.0, OPACITIES: 0.2}), 1e-4) is planned
    for factors, distortion in (({POSITIONS: 4.0}, 1e-4), ({PRUNED_KEY: 0.1}, 1e-4), ({}, 1e-3)):
        other = first_order.scaled_by(factors)
        again, expected = planner.plan(other, distortion), make_plan(model, other, distortion)
        np.testing.assert_array_equal(again.plan.kept, expected.kept)
        np.testing.assert_array_equal(again.plan.layers[0].points.bits, expected.layers[0].points.bits)
        assert again.plan.distortion_per_number == expected.distortion_per_number
        torch.testing.assert_close(again.geometry_outputs, expected.apply(model).geometry_outputs())


def test_a_plan_does_not_depend_on_factors_of_colours_scales_and_opacities(model, first_order):
    other = first_order.scaled_by({COLORS: 3.0, OPACITIES: 0.2, SCALES: 50.0})

    plan, expected = make_plan(model, other, 1e-4), make_plan(model, first_order, 1e-4)

    np.testing.assert_array_equal(plan.kept, expected.kept)
    np.testing.assert_array_equal(plan.layers[0].points.cells, expected.layers[0].points.cells)


def test_renders_of_some_gaussians_use_the_colours_of_all(model):
    references, kept = ReferenceRenders.from_model(model, CALIBRATION_CAMERAS), np.arange(0, len(model), 3)
    some, decoded = model.subset(torch.as_tensor(kept)), model.decode()[torch.as_tensor(kept)]

    reused = ReferenceRenders.from_views(references.views, some, decoded, references.colors_of(kept))

    fresh = ReferenceRenders.from_views(references.views, some)
    for ours, expected in zip(reused.pictures, fresh.pictures, strict=True):
        torch.testing.assert_close(ours, expected, rtol=0, atol=1e-6)
    expected_error = references.measure_error(some)
    assert expected_error > 1e-5
    assert references.measure_error(some, decoded, references.colors_of(kept)) == pytest.approx(expected_error)
    black = [torch.zeros_like(colors) for colors in references.colors_of(kept)]
    assert references.measure_error(some, decoded, black) > 2 * expected_error

"""A plan decides which Gaussians are stored and how finely, and quantisation follows it."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples
from scenes import small_model

from hyrfpack.compress.plan import (
    CLASS_WIDTH_LOG2,
    CLASSES_ABOVE_MEAN,
    IMPORTANCE_CLASS_COUNT,
    PRUNED_GAUSSIAN_BITS,
    color_basis,
    importance_classes,
    make_plan,
    position_bits,
    replan_moved,
)
from hyrfpack.compress.quantize import plan_and_quantize, quantize
from hyrfpack.compress.sensitivity import Sensitivity, removal_error
from hyrfpack.format import decode_model, encode_model
from hyrfpack.format.arrays import group_shapes, to_arrays, to_model
from hyrfpack.format.compact import encode
from hyrfpack.format.compact.plan import Plan, lattice_to_local
from hyrfpack.format.compact.quantized import QuantizedModel
from hyrfpack.model import Frame, HybridModel, contract
from hyrfpack.quant.steps import ALL_ZERO_CODE, FIXED_POINT_ONE, decode_step

ATTRIBUTE_SECTIONS = ("COLO", "SCAL", "OPAC")
FIELD_SECTIONS = ("GTAB", "GMLP", "RTAB", "RMLP")
TEST_DISTORTION = 1e-5


def random_model(count: int = 300, seed: int = 0) -> HybridModel:
    rng = np.random.default_rng(seed)
    return small_model(
        rng.normal(size=(count, 3)) * 0.7,
        frame=Frame((1.0, 2.0, 3.0), 5.0, (1.0, 0.5, 0.8)),
        fields=0.3,
        color_logits=rng.normal(size=(count, 3)) @ np.array([[1, 0.8, 0.6], [0, 0.3, -0.2], [0, 0, 0.1]]),
        scale_logits=rng.normal(size=(count, 1)) - 4,
        opacity_logits=4 * rng.normal(size=(count, 1)),
        seed=seed,
    )


def random_sensitivity(model: HybridModel, spread: float = 2.0, seed: int = 0) -> Sensitivity:
    """Return log-normal sensitivities; those of one Gaussian are correlated, as measured ones are."""
    rng = np.random.default_rng(seed)

    def draw(count: int) -> np.ndarray:
        return 1e-4 * np.exp(spread * rng.normal(size=count))

    sizes = {group: math.prod(shape) for group, shape in group_shapes(model.config, len(model)).items()}
    together = draw(len(model))
    explicit = [together * np.exp(rng.normal(size=len(model)) / 4) for _ in range(4)]
    return Sensitivity(
        *explicit,
        removals=removal_error(model.decode_geometry().opacities.detach().double().numpy(), explicit[-1]),
        fields={group: draw(sizes[group]) for group in ("GTAB", "RTAB", "GMLP", "RMLP")},
    )


def plan_model(model: HybridModel, distortion: float = TEST_DISTORTION, **settings) -> Plan:
    return make_plan(model, random_sensitivity(model), distortion, **settings)


def quantize_model(model: HybridModel, distortion: float = TEST_DISTORTION, **settings) -> QuantizedModel:
    return plan_and_quantize(model, random_sensitivity(model), distortion, **settings)


def cube_positions(model: HybridModel) -> np.ndarray:
    with torch.no_grad():
        positions = model.gaussians.positions.double()
        return contract(positions / positions.new_tensor(model.config.frame.half_extent)).numpy()


# Planning.


def test_without_pruning_every_gaussian_is_stored_once() -> None:
    assert sorted(plan_model(random_model(), prune=False).kept.tolist()) == list(range(300))


def test_sensitivities_and_classes_are_in_the_order_of_stored_gaussians() -> None:
    model = random_model()
    sensitivity = random_sensitivity(model)

    plan = make_plan(model, sensitivity, 1e-4)

    assert 0 < len(plan.kept) < 300 and len(set(plan.kept.tolist())) == len(plan.kept)
    of_stored = sensitivity.subset(plan.kept)
    for name in ("positions", "colors", "scales", "opacities"):
        np.testing.assert_array_equal(getattr(of_stored, name), getattr(sensitivity, name)[plan.kept])
    np.testing.assert_array_equal(plan.layers[0].points.classes, importance_classes(of_stored))


def test_the_planned_model_has_the_kept_gaussians_on_the_lattice() -> None:
    model = random_model()
    plan = plan_model(model)
    original, frame = to_arrays(model), model.config.frame

    planned = plan.apply(model)

    arrays = to_arrays(planned)
    for group in original:
        expected = original[group][plan.kept] if group in ATTRIBUTE_SECTIONS else original[group]
        if group != "POSI":
            np.testing.assert_array_equal(arrays[group], expected)
    np.testing.assert_array_equal(arrays["POSI"], lattice_to_local(plan.layers[0].points, frame))
    # In the contracted cube each is at the centre of its cell, up to the float32 rounding of its local position.
    centers = plan.layers[0].points.centers() / 2**19
    assert np.abs(cube_positions(planned) - centers).max() < 1e-6


def position_errors(distortion: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the displacement of Gaussians in the cube (N, 3) and their lattice steps (N, 1)."""
    model = random_model(2000)
    sensitivity = random_sensitivity(model, spread=4.0)
    plan = make_plan(model, sensitivity, distortion, prune=False)
    classes = importance_classes(sensitivity)
    steps = 2.0 ** -position_bits(sensitivity.positions, classes, plan.distortion_per_number)[classes][:, None]
    return np.abs(plan.layers[0].points.centers() / 2**19 - cube_positions(model)[plan.kept]), steps[plan.kept]


def test_positions_move_by_at_most_half_a_lattice_step() -> None:
    moved, steps = position_errors(1e-6)

    assert (moved <= steps / 2 + 1e-12).all()


def test_positions_coarser_than_the_base_move_by_at_most_half_a_lattice_step() -> None:
    moved, steps = position_errors(0.1)

    assert (moved <= steps / 2 + 1e-12).all()


def test_a_lower_distortion_takes_more_bits_in_every_section() -> None:
    model = random_model()

    def size(distortion: float) -> int:
        made, _ = encode(model, quantize_model(model, distortion, prune=False))
        return sum(len(section.data) for section in made)

    sizes = [size(distortion) for distortion in (1e-8, 1e-6, 1e-4, 1e-2)]

    assert sizes == sorted(sizes, reverse=True) and sizes[0] > 2 * sizes[-1]


def test_exactly_the_gaussians_that_cost_more_than_their_removal_are_pruned() -> None:
    model = random_model()
    sensitivity = random_sensitivity(model)

    plan = make_plan(model, sensitivity, 1e-4)

    parameters = sum(array.size for array in to_arrays(model).values())
    assert plan.distortion_per_number == pytest.approx(1e-4 / parameters)
    with torch.no_grad():
        opacities = model.decode_geometry().opacities.double().tolist()
    for n, (s, o) in enumerate(zip(sensitivity.opacities.tolist(), opacities, strict=True)):
        slope = max(o * (1 - o), 1e-4)  # the derivative of the opacity by its logit
        error_of_removal = s / slope**2 * o**2
        assert (n in plan.kept) == (error_of_removal >= 2 * math.log(2) * 1e-4 / parameters * PRUNED_GAUSSIAN_BITS)
    assert 0 < len(plan.kept) < len(model)


def test_a_higher_distortion_prunes_more() -> None:
    model = random_model()

    counts = [len(plan_model(model, distortion).kept) for distortion in (1e-30, 1e-6, 1e-4, 1e-2, 1e9)]

    assert counts == sorted(counts, reverse=True)
    assert counts[0] == 300 and counts[-1] == 1


@given(st.lists(st.tuples(*[st.floats(1e-12, 1e3)] * 4), min_size=1, max_size=40))
@examples(80)
def test_classes_are_ordered_by_the_mean_sensitivity(rows: list[tuple[float, ...]]) -> None:
    positions, colors, scales, opacities = np.array(rows).T
    sensitivity = Sensitivity(positions, colors, scales, opacities, opacities, {})

    classes = importance_classes(sensitivity)

    assert classes.dtype == np.uint8 and classes.max() < IMPORTANCE_CLASS_COUNT
    weights = np.array([3, 3, 1, 1]) / 8
    logs = (np.log2(rows) - np.log2(np.mean(rows, axis=0))) @ weights
    order = np.argsort(-logs)
    assert (np.diff(classes[order].astype(int))[np.diff(logs[order]) < -1e-9] >= 0).all()
    # Classes have equal widths in octaves; the mean is in the middle of one, and the outer ones are unbounded.
    exact = CLASSES_ABOVE_MEAN - logs / CLASS_WIDTH_LOG2
    expected = np.clip(np.round(exact), 0, IMPORTANCE_CLASS_COUNT - 1)
    unclear = np.abs(exact - np.floor(exact) - 0.5) < 1e-9
    np.testing.assert_array_equal(classes[~unclear], expected[~unclear])


def test_unseen_gaussians_are_in_the_last_class() -> None:
    seen = np.where(np.arange(50) < 25, 0.0, 1e-3)

    with np.errstate(divide="ignore"):
        classes = importance_classes(Sensitivity(*[seen] * 5, {}))

    assert (classes[:25] == IMPORTANCE_CLASS_COUNT - 1).all() and (classes[25:] < IMPORTANCE_CLASS_COUNT - 1).all()


@given(st.lists(st.tuples(st.integers(0, 5), st.floats(1e-12, 1e6)), max_size=30), st.floats(1e-16, 1.0))
@examples(80)
def test_lattice_bits_follow_the_sensitivity_of_positions(pairs: list[tuple[int, float]], distortion: float) -> None:
    classes = np.array([kind for kind, _ in pairs], np.uint8)
    sensitivity = np.array([value for _, value in pairs])

    bits = position_bits(sensitivity, classes, distortion)

    for kind in range(IMPORTANCE_CLASS_COUNT):
        members = [value for of, value in pairs if of == kind]
        if not members:
            assert bits[kind] == 1
            continue
        exact = 0.5 * math.log2(sum(members) / len(members) / (12 * distortion))
        assert abs(bits[kind] - min(max(exact, 1), 18)) <= 0.5 + 1e-9


def test_the_color_basis_is_orthonormal_and_removes_correlation() -> None:
    colors = to_arrays(random_model(2000))["COLO"].astype(np.float64)

    basis = color_basis(colors)

    assert basis.dtype == np.float32
    np.testing.assert_allclose(basis.T @ basis, np.eye(3), atol=1e-6)
    covariance = np.cov((colors @ basis).T)
    assert np.abs(covariance - np.diag(np.diag(covariance))).max() < 1e-5 * covariance.max()
    assert (np.diff(np.diag(covariance)) < 0).all()


@pytest.mark.parametrize("colors", [np.zeros((0, 3)), np.ones((1, 3)), np.ones((9, 3)), np.diag([1e-30] * 3)])
def test_few_and_equal_colors_have_an_orthonormal_basis(colors: np.ndarray) -> None:
    basis = color_basis(colors.astype(np.float32))

    np.testing.assert_allclose(basis.T @ basis, np.eye(3), atol=1e-6)


# Planning and quantisation together.


@pytest.mark.parametrize("reach", [0, 1])
@pytest.mark.parametrize("distortion", [1e-9, TEST_DISTORTION, 1e-2])
@pytest.mark.parametrize("count", [0, 1, 2, 300])
def test_decoded_arrays_equal_those_that_the_encoder_announced(count: int, distortion: float, reach: int) -> None:
    model = random_model(count)
    plan = plan_model(model, distortion)
    planned = plan.apply(model)
    quantized = quantize(planned, plan, random_sensitivity(model), reach=reach)

    arrays = to_arrays(decode_model(encode_model(model, "compact", quantized=quantized)))

    np.testing.assert_array_equal(arrays["POSI"], to_arrays(planned)["POSI"])
    said = quantized.arrays()
    assert arrays.keys() == group_shapes(model.config, 0).keys() and said.keys() == arrays.keys() - {"POSI"}
    for group, expected in said.items():
        assert arrays[group].dtype == np.float32
        np.testing.assert_array_equal(arrays[group], expected.reshape(arrays[group].shape), err_msg=group)
    assert len(to_model(model.config, arrays)) == len(plan.kept)


@pytest.mark.parametrize("sections", [("COLO",), ("SCAL", "OPAC"), ("GTAB", "GMLP"), ()])
def test_quantizing_some_sections_equals_quantizing_all(sections: tuple[str, ...]) -> None:
    model = random_model()
    plan = plan_model(model)
    planned = plan.apply(model)

    some = quantize(planned, plan, random_sensitivity(model), sections=sections).arrays()

    every = quantize(planned, plan, random_sensitivity(model)).arrays()
    assert some.keys() == set(sections)
    for group, values in some.items():
        np.testing.assert_array_equal(values, every[group])


def test_with_reach_0_the_error_is_at_most_half_a_step() -> None:
    model = random_model()
    plan = plan_model(model)
    planned = to_arrays(plan.apply(model))

    quantized = quantize(plan.apply(model), plan, random_sensitivity(model), reach=0)

    for group, chosen in quantized.groups.items():
        steps = decode_step(chosen.codes)[plan.groups[group].index] / FIXED_POINT_ONE
        values = planned[group].ravel()
        off = np.abs(chosen.values - values)
        coded = chosen.codes[plan.groups[group].index] != ALL_ZERO_CODE
        assert (off <= steps / 2 + np.abs(values) * 2**-22)[coded].all() and coded.any()
    turned = planned["COLO"] @ plan.basis.astype(np.float64)
    for channel, values in zip(
        [*quantized.channels[0]["COLO"], *quantized.channels[0]["SCAL"]],
        [*turned.T, planned["SCAL"][:, 0]],
        strict=True,
    ):
        steps = decode_step(channel.codes)[plan.layers[0].points.classes] / FIXED_POINT_ONE
        assert (np.abs(channel.values - values) <= steps / 2 + 1e-6).all()


def test_finer_plans_have_lower_errors() -> None:
    model = random_model()

    def errors(distortion: float) -> dict[str, float]:
        quantized = quantize_model(model, distortion, prune=False)
        planned, decoded = to_arrays(quantized.plan.apply(model)), quantized.arrays()
        return {group: np.abs(decoded[group].ravel() - planned[group].ravel()).mean() for group in decoded}

    coarse, fine = errors(1e-3), errors(1e-7)

    for group in ("COLO", "SCAL", *FIELD_SECTIONS):
        assert fine[group] < coarse[group] / 10


def test_opacities_are_preserved_while_saturated_logits_are_not() -> None:
    model = random_model()
    with torch.no_grad():
        model.gaussians.opacity_logits[::3] = 300.0
        model.gaussians.opacity_logits[1::3] = -300.0
        before = model.decode_geometry().opacities.detach().double().numpy()
    quantized = quantize_model(model, 1e-9, prune=False)
    plan, planned = quantized.plan, quantized.plan.apply(model)

    arrays = {**to_arrays(planned), **{"OPAC": quantized.arrays()["OPAC"]}}

    assert np.abs(arrays["OPAC"]).max() < 30
    with torch.no_grad():
        after = to_model(model.config, arrays).decode_geometry().opacities.detach().double().numpy()
        exact = planned.decode_geometry().opacities.detach().double().numpy()
    assert np.abs(after - exact).max() < 0.01
    assert (after[before[plan.kept] > 0.999] > 0.99).all() and (after[before[plan.kept] < 0.001] < 0.01).all()


def test_encoding_is_deterministic() -> None:
    written = []
    for _ in range(2):
        model = random_model()
        made, settings = encode(model, quantize_model(model))
        written.append([(section.type, section.codec, bytes(section.data)) for section in made] + [settings])

    assert written[0] == written[1]


def test_encoding_changes_neither_the_model_nor_the_plan() -> None:
    model = random_model()
    plan, sensitivity = plan_model(model), random_sensitivity(model)
    before = {group: values.copy() for group, values in to_arrays(model).items()}
    cells = plan.layers[0].points.cells.copy()

    encode(model, quantize(plan.apply(model), plan, sensitivity))

    for group, values in to_arrays(model).items():
        np.testing.assert_array_equal(values, before[group])
    np.testing.assert_array_equal(plan.layers[0].points.cells, cells)


def test_sections_declare_their_decoded_size() -> None:
    model = random_model()
    quantized = quantize_model(model, 1e-4)

    made, settings = encode(model, quantized)

    shapes = group_shapes(model.config, len(quantized.plan.kept))
    assert {section.type: section.raw_length for section in made} == {
        group: 4 * math.prod(shape) for group, shape in shapes.items()
    }
    assert settings["gaussians_before"] == 300


def test_settings_state_the_number_of_gaussians_before_pruning() -> None:
    model = random_model()
    plan, sensitivity = plan_model(model, 1e-4), random_sensitivity(model)
    planned = plan.apply(model)
    moved_plan, moved = replan_moved(plan, planned)

    for stored_model, stored_plan in ((planned, plan), (moved, moved_plan)):
        _, settings = encode(stored_model, quantize(stored_model, stored_plan, sensitivity))

        assert len(stored_model) < settings["gaussians_before"] == 300

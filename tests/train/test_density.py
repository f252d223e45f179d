from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scenes import ball_points, small_model

from hyrfpack.config.train import DensityConfig, LearningRates
from hyrfpack.model.gaussians import Gaussians
from hyrfpack.train.density import DensityControl, rotate, spatial_order
from hyrfpack.train.optimizer import Optimizer

# Rounds after steps 10, 20, ... 50 of 100. The target count only rises.
GROWTH_CONFIG = DensityConfig(start=0.1, stop=0.5, peak=0.5, excess=1.0, rounds=4, gradient=1e-3, split_scale=0.05)
RUN_STEPS = 100
# Scale logits that decode to scales of 0.01 and 0.12.
SMALL_SCALE_LOGIT = -4.6
LARGE_SCALE_LOGIT = -2.0


def set_up(
    count: int = 20, *, budget: int = 1000, config=GROWTH_CONFIG, seed: int = 0, gradients=1.0, **model_settings
):
    """Return a model, its optimiser after one step, and density control that has observed these gradients.

    The fields output 0 unless `model_settings` say otherwise.
    """
    model = small_model(ball_points(count)[0], **{"scale_logits": SMALL_SCALE_LOGIT, **model_settings})
    optimizer = Optimizer(model, LearningRates())
    for p in model.parameters():
        p.grad = torch.zeros_like(p)
    optimizer.step(0, RUN_STEPS)
    density = DensityControl(config, RUN_STEPS, budget, count, seed)
    density.gradients = torch.as_tensor(gradients, dtype=torch.float32).expand(count).clone()
    density.views = torch.ones(count)
    return model, optimizer, density


@pytest.fixture(autouse=True)
def unsorted(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    """Rounds keep the order of the Gaussians that stay and append new ones, except in tests of the order."""
    if "sorted_rounds" not in request.fixturenames:
        monkeypatch.setattr("hyrfpack.train.density.spatial_order", lambda model: torch.arange(len(model)))


@pytest.fixture
def sorted_rounds() -> None:
    """Rounds sort Gaussians by place, as they do outside tests."""


def copy_parameters(model) -> dict[str, torch.Tensor]:
    return {name: getattr(model.gaussians, name).detach().clone() for name in Gaussians.PARAMETER_NAMES}


def split_opacity_logits(logits: torch.Tensor | float) -> torch.Tensor:
    """Return the opacity logits of two Gaussians that together transmit as much light as one; valid above 0.36."""
    through = torch.sigmoid(-torch.as_tensor(logits, dtype=torch.float64)).sqrt()
    return ((1 - through) / through).log().float()


def gradients_at(rows, count: int = 20) -> torch.Tensor:
    gradients = torch.zeros(count)
    gradients[rows] = 1.0
    return gradients


# -- clone and split -------------------------------------------------------------------------------------------------


def test_small_gaussians_with_large_gradients_are_cloned():
    model, optimizer, density = set_up(gradients=gradients_at([2, 5, 11]))
    before = copy_parameters(model)

    density.act(50, model, optimizer)

    assert len(model) == 23
    before["opacity_logits"][[2, 5, 11]] = split_opacity_logits(before["opacity_logits"][[2, 5, 11]])
    for name, values in before.items():
        tolerances = {} if name == "opacity_logits" else {"rtol": 0, "atol": 0}
        torch.testing.assert_close(getattr(model.gaussians, name)[:20], values, **tolerances)
        torch.testing.assert_close(getattr(model.gaussians, name)[20:], values[[2, 5, 11]], **tolerances)


def test_large_gaussians_with_large_gradients_are_replaced_by_two_children():
    model, optimizer, density = set_up(gradients=gradients_at([2, 5, 11]), scale_logits=LARGE_SCALE_LOGIT)
    before = copy_parameters(model)
    kept = [i for i in range(20) if i not in (2, 5, 11)]

    density.act(50, model, optimizer)

    assert len(model) == 17 + 6
    assert torch.equal(model.gaussians.positions[:17], before["positions"][kept])
    parents = torch.tensor([2, 5, 11, 2, 5, 11])
    assert torch.equal(model.gaussians.color_logits[17:], before["color_logits"][parents])
    torch.testing.assert_close(
        model.gaussians.opacity_logits[17:], split_opacity_logits(before["opacity_logits"][parents])
    )


def test_clone_or_split_depends_on_the_size_of_each_gaussian():
    sizes = torch.where(torch.arange(20) % 2 == 0, SMALL_SCALE_LOGIT, LARGE_SCALE_LOGIT)[:, None]
    model, optimizer, density = set_up(gradients=gradients_at([0, 1, 2, 3]), scale_logits=sizes)
    density.act(50, model, optimizer)
    assert len(model) == 20 + 2 + 2  # each clone and each split adds one


@pytest.mark.parametrize("scale_logit", [-3.0, -1.0, 0.3])
def test_children_are_decoded_as_their_parent_over_1_6(scale_logit):
    config = dataclasses.replace(GROWTH_CONFIG, split_scale=0.01, prune_scale=1.0)
    model, optimizer, density = set_up(config=config, scale_logits=scale_logit, scale_grows=False)
    with torch.no_grad():
        parents = model.decode_geometry().scales

        density.act(50, model, optimizer)

        children = model.decode_geometry().scales
    assert len(model) == 40
    torch.testing.assert_close(children, parents.repeat(2, 1) / 1.6, rtol=1e-4, atol=0)


def test_children_shrink_by_1_6_where_the_field_stretches_the_parent():
    """The explicit logit is one number for three axes, so small children shrink alike, up to sigmoid curvature."""
    model, optimizer, density = set_up(scale_logits=-2.5, scale_grows=False)
    with torch.no_grad():
        model.geometry.biases[-1][1:4] = torch.tensor([-1.0, 0.0, 0.5])
        parents = model.decode_geometry().scales
        assert parents[0].max() > 3 * parents[0].min()
        density.act(50, model, optimizer)
        children = model.decode_geometry().scales
    torch.testing.assert_close(children, parents.repeat(2, 1) / 1.6, rtol=0.06, atol=0)


def test_children_are_drawn_from_their_parent():
    """In units of the parent's axes, the offsets are standard normal."""
    count = 2000
    model, optimizer, density = set_up(count, budget=10_000, scale_logits=LARGE_SCALE_LOGIT)
    with torch.no_grad():
        model.geometry.biases[-1][1:] = torch.tensor([-0.5, 0.0, 0.5, -0.2, 0.7, -0.3, 0.1])  # anisotropic and rotated
        parents = model.decode_geometry()
    positions = model.gaussians.positions.detach().clone()
    w, *axis = torch.nn.functional.normalize(parents.quats[0], dim=0).tolist()
    x, y, z = axis
    # The rotation follows Rodrigues' formula: angle and axis.
    angle, axis = 2 * np.arctan2(np.linalg.norm(axis), w), np.array(axis) / np.linalg.norm(axis)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    rotation = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross

    density.act(50, model, optimizer)

    offsets = (model.gaussians.positions.detach() - positions.repeat(2, 1)).double().numpy()
    standard = offsets @ rotation / parents.scales[0].double().numpy()
    assert len(standard) == 2 * count
    np.testing.assert_allclose(np.cov(standard.T), np.eye(3), atol=0.1)
    np.testing.assert_allclose(standard.mean(0), 0, atol=0.06)
    assert not np.allclose(offsets[:count], offsets[count:])  # siblings differ


def test_rotate_matches_rotation_matrices():
    generator = np.random.default_rng(0)
    quats, vectors = generator.normal(size=(50, 4)), generator.normal(size=(50, 3))
    from scipy.spatial.transform import Rotation

    expected = Rotation.from_quat(quats[:, [1, 2, 3, 0]]).apply(vectors)
    np.testing.assert_allclose(rotate(torch.from_numpy(quats), torch.from_numpy(vectors)).numpy(), expected, atol=1e-12)


def test_gradients_below_the_threshold_change_nothing():
    model, optimizer, density = set_up(gradients=0.9e-3)
    before = copy_parameters(model)
    density.act(50, model, optimizer)
    assert all(torch.equal(getattr(model.gaussians, name), values) for name, values in before.items())


def test_the_gradient_is_the_mean_over_views_not_the_sum():
    model, optimizer, density = set_up(gradients=5e-3)
    density.views = torch.where(
        torch.arange(20) < 4, 1.0, 10.0
    )  # the mean is 5e-3 for four of them and 5e-4 for the others
    density.act(50, model, optimizer)
    assert len(model) == 24


# -- pruning ---------------------------------------------------------------------------------------------------------


def test_faint_and_huge_gaussians_are_removed():
    opacities, sizes = torch.full((20, 1), 2.0), torch.full((20, 1), SMALL_SCALE_LOGIT)
    opacities[[1, 4]] = -6.0  # 0.0025, below 0.005
    opacities[5] = -5.0  # 0.0067, stays
    sizes[9] = 0.5  # 0.62 of S(p), above the limit of 0.5
    sizes[10] = -0.5  # 0.38, stays
    model, optimizer, density = set_up(gradients=0.0, opacity_logits=opacities, scale_logits=sizes)
    before = copy_parameters(model)

    density.act(50, model, optimizer)

    kept = [i for i in range(20) if i not in (1, 4, 9)]
    assert torch.equal(model.gaussians.positions, before["positions"][kept])


def test_pruned_gaussians_are_not_cloned():
    opacities = torch.full((20, 1), 2.0)
    opacities[3] = -8.0
    model, optimizer, density = set_up(gradients=gradients_at([3, 4]), opacity_logits=opacities)
    density.act(50, model, optimizer)
    assert len(model) == 19 + 1
    opacities[[3, 4]] = split_opacity_logits(2.0)  # the last one is where the pruned one was
    torch.testing.assert_close(model.gaussians.opacity_logits.sort(0).values, opacities.sort(0).values)


def test_the_scale_limit_of_far_gaussians_grows_with_distance():
    """Outside the box S(p) = |u|, so a scale of 0.3 |u| local units is not huge there."""
    model, optimizer, density = set_up(gradients=0.0, scale_logits=float(np.log(0.3 / 0.7)))
    with torch.no_grad():
        model.gaussians.positions.mul_(100)
    assert model.decode_geometry().scales.max() > 10
    density.act(50, model, optimizer)
    assert len(model) == 20


@pytest.mark.parametrize(("huge", "left"), [(1, 19), (2, 18), (3, 20), (20, 20)])
def test_huge_gaussians_are_removed_only_where_they_are_few(huge, left):
    """Where most Gaussians are huge they make up the scene, and removing them would leave nothing."""
    sizes = torch.full((20, 1), SMALL_SCALE_LOGIT)
    sizes[:huge] = 5.0
    model, optimizer, density = set_up(gradients=0.0, scale_logits=sizes)
    for step in (10, 20, 30, 40, 50):
        density.act(step, model, optimizer)
    assert len(model) == left


def test_the_scene_is_never_emptied():
    opacities = torch.full((20, 1), -9.0)
    opacities[7] += 0.5  # the most opaque
    model, optimizer, density = set_up(gradients=0.0, opacity_logits=opacities)
    before = copy_parameters(model)

    for step in (10, 20, 30, 40, 50):
        density.act(step, model, optimizer)

    assert len(model) == 1 and torch.equal(model.gaussians.positions, before["positions"][[7]])


# -- the budget ------------------------------------------------------------------------------------------------------


def test_the_count_grows_linearly_to_the_budget():
    model, optimizer, density = set_up(20, budget=100)
    for step, most in [(10, 20), (20, 40), (30, 60), (40, 80), (50, 100)]:
        density.gradients, density.views = torch.ones(len(model)), torch.ones(len(model))
        density.act(step, model, optimizer)
        assert len(model) <= most
    # 20 can at most double in a round: 20, 40, 60, 80, 100.
    assert len(model) == 100


@pytest.mark.parametrize("scale_logits", [SMALL_SCALE_LOGIT, LARGE_SCALE_LOGIT])
def test_the_budget_is_kept_whatever_the_gradients(scale_logits):
    generator = torch.Generator().manual_seed(0)
    model, optimizer, density = set_up(20, budget=33, scale_logits=scale_logits)
    for step in range(1, RUN_STEPS + 1):
        density.gradients = torch.rand(len(model), generator=generator)
        density.views = torch.ones(len(model))
        density.act(step, model, optimizer)
        assert len(model) <= 33
    assert len(model) == 33


def test_the_largest_gradients_are_densified_first():
    gradients = torch.linspace(0.01, 1.0, 20)[torch.randperm(20, generator=torch.Generator().manual_seed(0))]
    model, optimizer, density = set_up(budget=24, gradients=gradients)
    before = copy_parameters(model)
    density.act(50, model, optimizer)
    best = gradients.argsort(descending=True)[:4].sort().values
    assert torch.equal(model.gaussians.positions[20:], before["positions"][best])


def test_a_full_budget_still_replaces_what_is_pruned():
    opacities = torch.full((20, 1), 2.0)
    opacities[:5] = -8.0
    model, optimizer, density = set_up(budget=20, opacity_logits=opacities)
    density.act(30, model, optimizer)
    assert len(model) == 20 and (model.gaussians.opacity_logits >= split_opacity_logits(2.0) - 1e-5).all()


# -- above the budget and back to it ---------------------------------------------------------------------------------

# Of 100 steps: the largest count after step 30, the budget after step 50.
EXCESS_CONFIG = dataclasses.replace(GROWTH_CONFIG, peak=0.3, excess=3.0)


def test_the_count_rises_linearly_above_the_budget_and_falls_linearly_to_it():
    model, optimizer, density = set_up(20, budget=40, config=EXCESS_CONFIG)
    counts = {}
    for step in range(1, RUN_STEPS + 1):
        density.gradients, density.views = torch.ones(len(model)), torch.ones(len(model))
        density.act(step, model, optimizer)
        counts[step] = len(model)
    assert [counts[step] for step in (9, 10, 20, 30, 40, 49, 50, 100)] == [20, 20, 40, 80, 80, 80, 40, 40]
    assert [density.target(step) for step in (10, 20, 30, 40, 50)] == [20, 70, 120, 80, 40]


@pytest.mark.parametrize(("start", "stop", "rounds"), [(0.1, 0.5, 3), (0.02, 0.72, 30), (0.0, 1.0, 7)])
def test_the_final_count_is_the_budget_also_where_rounds_do_not_divide_the_run(start, stop, rounds):
    config = dataclasses.replace(EXCESS_CONFIG, start=start, stop=stop, rounds=rounds)
    model, optimizer, density = set_up(20, budget=21, config=config)
    for step in range(1, RUN_STEPS + 1):
        density.gradients, density.views = torch.ones(len(model)), torch.ones(len(model))
        density.act(step, model, optimizer)
    assert len(model) == 21


def test_gaussians_with_the_lowest_importance_score_are_pruned():
    """The score is o dL/do = dL/dx / (1 - o): of two with the same slope by their logits, the more opaque one wins."""
    opacities = torch.where(torch.arange(20) < 10, 0.0, 2.0)[:, None]  # opacities 0.5 and 0.88
    model, optimizer, density = set_up(config=EXCESS_CONFIG, budget=12, opacity_logits=opacities)
    density.squares = torch.linspace(1, 2, 20)[torch.randperm(20, generator=torch.Generator().manual_seed(0))]
    slopes = density.squares.clone()
    before = copy_parameters(model)
    density.act(50, model, optimizer)

    worth = slopes / (1 - opacities[:, 0].sigmoid()) ** 2
    kept = worth.argsort(descending=True)[:12].sort().values
    assert set(range(10, 20)) < set(kept.tolist())
    assert torch.equal(model.gaussians.positions, before["positions"][kept])
    torch.testing.assert_close(density.squares, 0.8 * slopes[kept])


def test_squared_gradients_are_summed_over_views_and_copied_to_clones_and_children():
    sizes = torch.where(torch.arange(20) % 2 == 0, SMALL_SCALE_LOGIT, LARGE_SCALE_LOGIT)[:, None]
    model, optimizer, density = set_up(gradients=gradients_at([2, 5]), scale_logits=sizes)
    view = SimpleNamespace(width=8, height=8)
    for slope in (1.0, 2.0):
        model.gaussians.opacity_logits.grad = torch.full((20, 1), slope)
        density.observe(make_rendering([3], [True], [[0.0, 0.0]]), view, model)
    assert (density.squares == 5).all()
    density.act(50, model, optimizer)

    expected = torch.full((22,), 4.0)
    expected[[2, 19, 20, 21]] = 2.0  # the cloned one; its clone, and the two children of the split one
    torch.testing.assert_close(density.squares, expected)


@pytest.mark.parametrize("scale_logits", [SMALL_SCALE_LOGIT, LARGE_SCALE_LOGIT])
def test_a_clone_and_its_original_transmit_as_much_light_as_before(scale_logits):
    opacities = torch.linspace(-0.5, 12, 20)[:, None]
    model, optimizer, density = set_up(opacity_logits=opacities, scale_logits=scale_logits, fields=0.0)
    with torch.no_grad():
        before = 1 - model.decode_geometry().opacities.double()
        density.act(50, model, optimizer)
        after = 1 - model.decode_geometry().opacities.double()
    assert len(after) == 40
    pairs = after[:20] * after[20:]
    torch.testing.assert_close(pairs, before, rtol=1e-2, atol=1e-6)


def test_faint_gaussians_keep_their_opacity_when_cloned():
    """If every round halved them, they would be gone before any step could make them brighter."""
    opacities = torch.linspace(-4, -1.4, 20)[:, None]  # up to 0.198
    model, optimizer, density = set_up(opacity_logits=opacities)
    density.act(50, model, optimizer)
    torch.testing.assert_close(model.gaussians.opacity_logits, opacities.repeat(2, 1))


# -- opacity reset ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fields", [0.0, 1.0])
def test_a_reset_caps_decoded_opacities(fields):
    """The cap holds whatever the field adds, and however large the logit is."""
    logits = torch.cat([torch.linspace(-8, 8, 17), torch.tensor([12.0, 15.0, 30.0])])[:, None]
    config = dataclasses.replace(GROWTH_CONFIG, resets=3, prune_opacity=0.0)
    model, optimizer, density = set_up(gradients=0.0, opacity_logits=logits, fields=fields, config=config)
    with torch.no_grad():
        before = model.decode_geometry().opacities

        density.act(20, model, optimizer)

        after = model.decode_geometry().opacities
    np.testing.assert_allclose(after, before.clamp_max(0.01), rtol=1e-3)
    assert (optimizer.state_dict()["opacity_logits.0.exp_avg"] == 0).all()


def test_opacity_resets_follow_the_schedule_and_never_come_at_the_end():
    config = dataclasses.replace(GROWTH_CONFIG, resets=3, prune_opacity=0.0)
    model, optimizer, density = set_up(gradients=0.0, config=config)
    due = []
    for step in range(1, RUN_STEPS + 1):
        with torch.no_grad():
            model.gaussians.opacity_logits.fill_(2.0)
        density.act(step, model, optimizer)
        if model.decode_geometry().opacities.max() < 0.02:
            due.append(step)
    assert due == [20, 30]  # step 40 lies within a round of the end, where the opacity could not recover


# -- schedule and collected gradients --------------------------------------------------------------------------------


def steps_of_rounds(density, model, optimizer, steps):
    """Return the steps after which density control acts, which clears the collected gradients."""
    acted = []
    for step in range(1, steps + 1):
        density.views = torch.ones(len(model))
        density.act(step, model, optimizer)
        if density.views.sum() == 0:
            acted.append(step)
    return acted


def test_density_acts_at_its_rounds_only():
    model, optimizer, density = set_up(gradients=0.0)
    acted = steps_of_rounds(density, model, optimizer, RUN_STEPS)
    assert acted == [10, 20, 30, 40, 50]


@pytest.mark.parametrize("steps", [1, 2, 3, 10, 37])
def test_short_runs_have_a_density_schedule(steps):
    model, optimizer, _ = set_up()
    density = DensityControl(DensityConfig(resets=2), steps, 30, len(model), 0)
    for step in range(1, steps + 1):
        density.gradients, density.views = torch.ones(len(model)), torch.ones(len(model))
        density.act(step, model, optimizer)
    assert 1 <= len(model) <= 30


def make_rendering(indices, visible, absgrad, valid: torch.Tensor | None = None) -> SimpleNamespace:
    lists = {"indices": indices, "visible": visible, "absgrad": absgrad}
    return SimpleNamespace(valid=valid, **{name: torch.tensor(values) for name, values in lists.items()})


def test_views_add_ndc_gradients_of_visible_gaussians():
    model, _, density = set_up()
    density.clear(20)
    wide = SimpleNamespace(width=200, height=100)
    density.observe(make_rendering([3, 7, 9], [True, False, True], [[0.3, 0.0], [9.0, 9.0], [0.03, 0.04]]), wide, model)
    density.observe(make_rendering([3], [True], [[0.0, 0.2]]), wide, model)

    assert density.views.tolist() == [0, 0, 0, 2, 0, 0, 0, 0, 0, 1, *[0] * 10]
    expected = torch.zeros(20)
    expected[3] = 0.3 * 100 + 0.2 * 50
    expected[9] = ((0.03 * 100) ** 2 + (0.04 * 50) ** 2) ** 0.5
    torch.testing.assert_close(density.gradients, expected)


def test_views_without_gradients_change_nothing():
    model, _, density = set_up(gradients=0.25)
    nothing = SimpleNamespace(indices=torch.tensor([3]), visible=torch.tensor([True]), absgrad=None)
    density.observe(nothing, SimpleNamespace(width=10, height=10), model)
    assert (density.gradients == 0.25).all() and (density.views == 1).all()


@pytest.mark.parametrize("valid", [True, False])
def test_nothing_is_collected_from_a_rendering_that_is_not_valid(valid):
    model, _, density = set_up()
    density.clear(20)
    model.gaussians.opacity_logits.grad = torch.full((20, 1), torch.nan if not valid else 2.0)
    rendering = make_rendering([3], [True], [[0.5, torch.nan if not valid else 0.5]], torch.tensor(valid))
    density.observe(rendering, SimpleNamespace(width=10, height=10), model)
    assert density.views.sum() == density.gradients.count_nonzero() == valid
    assert density.squares.tolist() == [4.0 * valid] * 20


def test_gradients_are_collected_until_the_last_round():
    """They are needed before the first round too, because it acts on them."""
    _, _, density = set_up()
    assert [step for step in range(1, RUN_STEPS + 1) if density.watching(step)] == list(range(1, 51))


@pytest.mark.parametrize("steps", [1, 2, 3, 10, 37, 100, 1000, 3001])
def test_gradients_are_collected_before_every_round(steps):
    """This also holds where rounds do not divide their part of the run evenly."""
    model, optimizer, _ = set_up()
    density = DensityControl(DensityConfig(prune_opacity=0.0), steps, 20, len(model), 0)
    acted = steps_of_rounds(density, model, optimizer, steps)
    assert acted and all(density.watching(step) for step in range(1, acted[-1] + 1))
    assert not density.watching(round(0.65 * steps) + 1)


def test_the_same_seed_gives_the_same_children():
    results = []
    for seed in (1, 1, 2):
        model, optimizer, density = set_up(seed=seed, scale_logits=LARGE_SCALE_LOGIT)
        torch.manual_seed(len(results))  # the global generator must have no effect
        density.act(50, model, optimizer)
        results.append(model.gaussians.positions.detach())
    assert torch.equal(results[0], results[1]) and not torch.equal(results[0], results[2])


def test_children_of_two_rounds_differ():
    drawn = []
    for step in (20, 30):
        model, optimizer, density = set_up(1, scale_logits=LARGE_SCALE_LOGIT, budget=100)
        density.act(step, model, optimizer)
        drawn.append(model.gaussians.positions.detach())
    assert not torch.equal(*drawn)


def test_new_gaussians_start_without_momentum():
    model, optimizer, density = set_up(gradients=gradients_at([2, 3]))
    for p in model.parameters():
        p.grad = torch.ones_like(p)
    optimizer.step(10, RUN_STEPS)
    density.act(50, model, optimizer)
    moments = optimizer.state_dict()["positions.0.exp_avg"]
    assert (moments[:20] != 0).all() and (moments[20:] == 0).all()


# -- order -----------------------------------------------------------------------------------------------------------


def interleave_bits(cell: list[int]) -> int:
    """Return the Morton code of a cell, bit by bit."""
    return sum((coordinate >> bit & 1) << 3 * bit + axis for axis, coordinate in enumerate(cell) for bit in range(18))


def test_gaussians_are_sorted_by_the_morton_codes_of_their_cells(sorted_rounds):
    model, *_ = set_up(200)
    with torch.no_grad():
        model.gaussians.positions[:20] *= 1e6  # far outside the box
        model.gaussians.positions[100:] = model.gaussians.positions[:100]
    cells = (model.cube_coords(model.gaussians.positions.detach()).double() * 2**18).floor().clamp(0, 2**18 - 1)
    codes = [interleave_bits(cell) for cell in cells.long().tolist()]

    order = spatial_order(model).tolist()

    assert order == sorted(range(200), key=lambda row: (codes[row], row))
    assert order != list(range(200))


def test_a_round_sorts_parameters_moments_and_sums_alike(sorted_rounds, monkeypatch):
    """The round adds and removes the same Gaussians as without sorting."""

    def run_round():
        # The first 30 are large and split, the others are cloned.
        sizes = torch.where(torch.arange(60) < 30, LARGE_SCALE_LOGIT, SMALL_SCALE_LOGIT)[:, None]
        model, optimizer, density = set_up(60, scale_logits=sizes, gradients=torch.linspace(0, 1, 60))
        for number, p in enumerate(model.parameters()):
            p.grad = torch.randn(p.shape, generator=torch.Generator().manual_seed(number))
        optimizer.step(10, RUN_STEPS)
        density.squares = torch.rand(60, generator=torch.Generator().manual_seed(9))
        density.act(50, model, optimizer)
        moments = {name: value for name, value in optimizer.state_dict().items() if "exp_avg" in name}
        rows = {name: value for name, value in moments.items() if not name.startswith("fields")}
        return model, {**copy_parameters(model), **rows, "squares": density.squares}

    _, found = run_round()
    monkeypatch.setattr("hyrfpack.train.density.spatial_order", lambda model: torch.arange(len(model)))
    model, unsorted = run_round()

    order = spatial_order(model)
    assert len(order) > 60 and not torch.equal(order, torch.arange(len(order)))
    assert found.keys() == unsorted.keys() and len(found) == 4 + 8 + 1
    assert [name for name, rows in found.items() if not torch.equal(rows, unsorted[name][order])] == []

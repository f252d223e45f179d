from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scenes import ball_points, small_model

from hyrfpack.model.gaussians import Gaussians
from hyrfpack.train.config import DensityConfig, LearningRates
from hyrfpack.train.density import DensityControl, rotate
from hyrfpack.train.optimizer import Optimizer

# Of 100 steps: 10, 20, ... 50. The count only rises.
CONFIG = DensityConfig(start=0.1, stop=0.5, peak=0.5, excess=1.0, rounds=4, gradient=1e-3, split_scale=0.05)
STEPS = 100
SMALL, LARGE = -4.6, -2.0  # scale logits that decode to 0.01 and 0.12


def set_up(count: int = 20, *, budget: int = 1000, config=CONFIG, seed: int = 0, gradients=1.0, **model_settings):
    """A model with silent fields (unless asked), its optimiser one step old, and density control that has seen
    these gradients."""
    model = small_model(ball_points(count)[0], **{"scale_logits": SMALL, **model_settings})
    optimizer = Optimizer(model, LearningRates())
    for p in model.parameters():
        p.grad = torch.zeros_like(p)
    optimizer.step(0, STEPS)
    density = DensityControl(config, STEPS, budget, count, seed)
    density.gradients = torch.as_tensor(gradients, dtype=torch.float32).expand(count).clone()
    density.views = torch.ones(count)
    return model, optimizer, density


def copied(model) -> dict[str, torch.Tensor]:
    return {name: getattr(model.gaussians, name).detach().clone() for name in Gaussians.PARAMETER_NAMES}


def halved(logits: torch.Tensor | float) -> torch.Tensor:
    """Opacity logits of two that together let through what one of these lets through; these are above 0.36."""
    through = torch.sigmoid(-torch.as_tensor(logits, dtype=torch.float64)).sqrt()
    return ((1 - through) / through).log().float()


def high_for(rows, count: int = 20) -> torch.Tensor:
    gradients = torch.zeros(count)
    gradients[rows] = 1.0
    return gradients


# -- clone and split -------------------------------------------------------------------------------------------------


def test_small_gaussians_with_large_gradients_are_cloned():
    model, optimizer, density = set_up(gradients=high_for([2, 5, 11]))
    before = copied(model)

    density.act(50, model, optimizer)

    assert len(model) == 23
    before["opacity_logits"][[2, 5, 11]] = halved(before["opacity_logits"][[2, 5, 11]])
    for name, values in before.items():
        tolerances = {} if name == "opacity_logits" else {"rtol": 0, "atol": 0}
        torch.testing.assert_close(getattr(model.gaussians, name)[:20], values, **tolerances)
        torch.testing.assert_close(getattr(model.gaussians, name)[20:], values[[2, 5, 11]], **tolerances)


def test_large_gaussians_with_large_gradients_are_replaced_by_two_children():
    model, optimizer, density = set_up(gradients=high_for([2, 5, 11]), scale_logits=LARGE)
    before = copied(model)
    kept = [i for i in range(20) if i not in (2, 5, 11)]

    density.act(50, model, optimizer)

    assert len(model) == 17 + 6
    assert torch.equal(model.gaussians.positions[:17], before["positions"][kept])
    parents = torch.tensor([2, 5, 11, 2, 5, 11])
    assert torch.equal(model.gaussians.color_logits[17:], before["color_logits"][parents])
    torch.testing.assert_close(model.gaussians.opacity_logits[17:], halved(before["opacity_logits"][parents]))


def test_clones_and_splits_each_follow_their_own_size():
    sizes = torch.where(torch.arange(20) % 2 == 0, SMALL, LARGE)[:, None]
    model, optimizer, density = set_up(gradients=high_for([0, 1, 2, 3]), scale_logits=sizes)
    density.act(50, model, optimizer)
    assert len(model) == 20 + 2 + 2  # each clone and each split adds one


@pytest.mark.parametrize("scale_rule", ["sum", "product"])
@pytest.mark.parametrize("scale_logit", [-3.0, -1.0, 0.3])
def test_children_are_decoded_as_their_parent_over_1_6(scale_rule, scale_logit):
    config = dataclasses.replace(CONFIG, split_scale=0.01, prune_scale=1.0)
    settings = {"scale_logits": scale_logit, "scale_rule": scale_rule, "scale_grows": False}
    model, optimizer, density = set_up(config=config, **settings)
    with torch.no_grad():
        parents = model.decode_geometry().scales

        density.act(50, model, optimizer)

        children = model.decode_geometry().scales
    assert len(model) == 40
    torch.testing.assert_close(children, parents.repeat(2, 1) / 1.6, rtol=1e-4, atol=0)


def test_children_shrink_by_1_6_where_the_field_stretches_the_parent():
    """The explicit logit is one number for three axes, so small ones shrink alike, up to the sigmoid's bend."""
    model, optimizer, density = set_up(scale_logits=-2.5, scale_rule="sum", scale_grows=False)
    with torch.no_grad():
        model.geometry.biases[-1][1:4] = torch.tensor([-1.0, 0.0, 0.5])
        parents = model.decode_geometry().scales
        assert parents[0].max() > 3 * parents[0].min()
        density.act(50, model, optimizer)
        children = model.decode_geometry().scales
    torch.testing.assert_close(children, parents.repeat(2, 1) / 1.6, rtol=0.06, atol=0)


def test_children_are_drawn_from_their_parent():
    """In units of the parent's axes, offsets are standard normal."""
    count = 2000
    model, optimizer, density = set_up(count, budget=10_000, scale_logits=LARGE)
    with torch.no_grad():
        model.geometry.biases[-1][1:] = torch.tensor([-0.5, 0.0, 0.5, -0.2, 0.7, -0.3, 0.1])  # stretched and turned
        parents = model.decode_geometry()
    positions = model.gaussians.positions.detach().clone()
    w, *axis = torch.nn.functional.normalize(parents.quats[0], dim=0).tolist()
    x, y, z = axis
    # The rotation by Rodrigues' formula: angle and axis.
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
    before = copied(model)
    density.act(50, model, optimizer)
    assert all(torch.equal(getattr(model.gaussians, name), values) for name, values in before.items())


def test_the_gradient_is_the_mean_over_views_not_the_sum():
    model, optimizer, density = set_up(gradients=5e-3)
    density.views = torch.where(torch.arange(20) < 4, 1.0, 10.0)  # 5e-3 for four of them, 5e-4 for the others
    density.act(50, model, optimizer)
    assert len(model) == 24


# -- pruning ---------------------------------------------------------------------------------------------------------


def test_faint_and_huge_gaussians_are_removed():
    opacities, sizes = torch.full((20, 1), 2.0), torch.full((20, 1), SMALL)
    opacities[[1, 4]] = -6.0  # 0.0025, below 0.005
    opacities[5] = -5.0  # 0.0067, stays
    sizes[9] = 0.5  # 0.62 of S(p), above 0.5
    sizes[10] = -0.5  # 0.38, stays
    model, optimizer, density = set_up(gradients=0.0, opacity_logits=opacities, scale_logits=sizes)
    before = copied(model)

    density.act(50, model, optimizer)

    kept = [i for i in range(20) if i not in (1, 4, 9)]
    assert torch.equal(model.gaussians.positions, before["positions"][kept])


def test_pruned_gaussians_are_not_cloned():
    opacities = torch.full((20, 1), 2.0)
    opacities[3] = -8.0
    model, optimizer, density = set_up(gradients=high_for([3, 4]), opacity_logits=opacities)
    density.act(50, model, optimizer)
    assert len(model) == 19 + 1
    opacities[[3, 4]] = halved(2.0)  # the last one has the place of the one that went
    torch.testing.assert_close(model.gaussians.opacity_logits.sort(0).values, opacities.sort(0).values)


def test_far_gaussians_are_judged_by_their_share_of_what_may_be():
    """Outside the box S(p) = |u|: 0.3 |u| local units is not huge there."""
    model, optimizer, density = set_up(gradients=0.0, scale_logits=float(np.log(0.3 / 0.7)))
    with torch.no_grad():
        model.gaussians.positions.mul_(100)
    assert model.decode_geometry().scales.max() > 10
    density.act(50, model, optimizer)
    assert len(model) == 20


@pytest.mark.parametrize(("huge", "left"), [(1, 19), (2, 18), (3, 20), (20, 20)])
def test_huge_gaussians_are_removed_only_while_they_are_few(huge, left):
    """Where most are huge they carry the scene; without them there would be nothing."""
    sizes = torch.full((20, 1), SMALL)
    sizes[:huge] = 5.0
    model, optimizer, density = set_up(gradients=0.0, scale_logits=sizes)
    for step in (10, 20, 30, 40, 50):
        density.act(step, model, optimizer)
    assert len(model) == left


def test_the_scene_is_never_emptied():
    opacities = torch.full((20, 1), -9.0)
    opacities[7] += 0.5  # the most opaque
    model, optimizer, density = set_up(gradients=0.0, opacity_logits=opacities)
    before = copied(model)

    for step in (10, 20, 30, 40, 50):
        density.act(step, model, optimizer)

    assert len(model) == 1 and torch.equal(model.gaussians.positions, before["positions"][[7]])


# -- the budget ------------------------------------------------------------------------------------------------------


def test_the_count_grows_along_a_line_to_the_budget():
    model, optimizer, density = set_up(20, budget=100)
    for step, most in [(10, 20), (20, 40), (30, 60), (40, 80), (50, 100)]:
        density.gradients, density.views = torch.ones(len(model)), torch.ones(len(model))
        density.act(step, model, optimizer)
        assert len(model) <= most
    # 20 can at most double in a round: 20, 40, 60, 80, 100.
    assert len(model) == 100


@pytest.mark.parametrize("scale_logits", [SMALL, LARGE])
def test_the_budget_is_kept_whatever_the_gradients(scale_logits):
    generator = torch.Generator().manual_seed(0)
    model, optimizer, density = set_up(20, budget=33, scale_logits=scale_logits)
    for step in range(1, STEPS + 1):
        density.gradients = torch.rand(len(model), generator=generator)
        density.views = torch.ones(len(model))
        density.act(step, model, optimizer)
        assert len(model) <= 33
    assert len(model) == 33


def test_room_is_given_to_the_largest_gradients():
    gradients = torch.linspace(0.01, 1.0, 20)[torch.randperm(20, generator=torch.Generator().manual_seed(0))]
    model, optimizer, density = set_up(budget=24, gradients=gradients)
    before = copied(model)
    density.act(50, model, optimizer)
    best = gradients.argsort(descending=True)[:4].sort().values
    assert torch.equal(model.gaussians.positions[20:], before["positions"][best])


def test_a_full_budget_still_replaces_what_is_pruned():
    opacities = torch.full((20, 1), 2.0)
    opacities[:5] = -8.0
    model, optimizer, density = set_up(budget=20, opacity_logits=opacities)
    density.act(30, model, optimizer)
    assert len(model) == 20 and (model.gaussians.opacity_logits >= halved(2.0) - 1e-5).all()


# -- above the budget and back ---------------------------------------------------------------------------------------

EXCESS = dataclasses.replace(CONFIG, peak=0.3, excess=3.0)  # of 100 steps: most after 30, the budget after 50


def test_the_count_rises_above_the_budget_and_falls_to_it_along_two_lines():
    model, optimizer, density = set_up(20, budget=40, config=EXCESS)
    counts = {}
    for step in range(1, STEPS + 1):
        density.gradients, density.views = torch.ones(len(model)), torch.ones(len(model))
        density.act(step, model, optimizer)
        counts[step] = len(model)
    assert [counts[step] for step in (9, 10, 20, 30, 40, 49, 50, 100)] == [20, 20, 40, 80, 80, 80, 40, 40]
    assert [density.target(step) for step in (10, 20, 30, 40, 50)] == [20, 70, 120, 80, 40]


@pytest.mark.parametrize(("start", "stop", "rounds"), [(0.1, 0.5, 3), (0.02, 0.72, 30), (0.0, 1.0, 7)])
def test_the_budget_is_what_is_left_whether_rounds_divide_the_run_or_not(start, stop, rounds):
    config = dataclasses.replace(EXCESS, start=start, stop=stop, rounds=rounds)
    model, optimizer, density = set_up(20, budget=21, config=config)
    for step in range(1, STEPS + 1):
        density.gradients, density.views = torch.ones(len(model)), torch.ones(len(model))
        density.act(step, model, optimizer)
    assert len(model) == 21


def test_those_go_whose_opacity_moves_the_loss_least():
    """By o dL/do = dL/dx / (1 - o): of two with the same slope by their logits, the more opaque one matters more."""
    opacities = torch.where(torch.arange(20) < 10, 0.0, 2.0)[:, None]  # 0.5 and 0.88
    model, optimizer, density = set_up(config=EXCESS, budget=12, opacity_logits=opacities)
    density.squares = torch.linspace(1, 2, 20)[torch.randperm(20, generator=torch.Generator().manual_seed(0))]
    slopes = density.squares.clone()
    before = copied(model)
    density.act(50, model, optimizer)

    worth = slopes / (1 - opacities[:, 0].sigmoid()) ** 2
    kept = worth.argsort(descending=True)[:12].sort().values
    assert set(range(10, 20)) < set(kept.tolist())
    assert torch.equal(model.gaussians.positions, before["positions"][kept])
    torch.testing.assert_close(density.squares, 0.8 * slopes[kept])


def test_squares_are_summed_over_views_and_shared_with_clones_and_children():
    sizes = torch.where(torch.arange(20) % 2 == 0, SMALL, LARGE)[:, None]
    model, optimizer, density = set_up(gradients=high_for([2, 5]), scale_logits=sizes)
    view = SimpleNamespace(width=8, height=8)
    for slope in (1.0, 2.0):
        model.gaussians.opacity_logits.grad = torch.full((20, 1), slope)
        density.observe(seen_by([3], [True], [[0.0, 0.0]]), view, model)
    assert (density.squares == 5).all()
    density.act(50, model, optimizer)

    expected = torch.full((22,), 4.0)
    expected[[2, 19, 20, 21]] = 2.0  # the one cloned; its clone, and the two children of the one that went
    torch.testing.assert_close(density.squares, expected)


@pytest.mark.parametrize("scale_logits", [SMALL, LARGE])
def test_two_let_through_what_one_did(scale_logits):
    opacities = torch.linspace(-0.5, 12, 20)[:, None]
    model, optimizer, density = set_up(opacity_logits=opacities, scale_logits=scale_logits, fields=0.0)
    with torch.no_grad():
        before = 1 - model.decode_geometry().opacities.double()
        density.act(50, model, optimizer)
        after = 1 - model.decode_geometry().opacities.double()
    assert len(after) == 40
    pairs = after[:20] * after[20:]
    torch.testing.assert_close(pairs, before, rtol=1e-2, atol=1e-6)


def test_faint_ones_stay_as_they_are():
    """Halved at every round, they would be gone before any step made them brighter."""
    opacities = torch.linspace(-4, -1.4, 20)[:, None]  # up to 0.198
    model, optimizer, density = set_up(opacity_logits=opacities)
    density.act(50, model, optimizer)
    torch.testing.assert_close(model.gaussians.opacity_logits, opacities.repeat(2, 1))


# -- opacity reset ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fields", [0.0, 1.0])
def test_a_reset_caps_decoded_opacities(fields):
    """Whatever the field says, and however far the logit has run."""
    logits = torch.cat([torch.linspace(-8, 8, 17), torch.tensor([12.0, 15.0, 30.0])])[:, None]
    config = dataclasses.replace(CONFIG, resets=3, prune_opacity=0.0)
    model, optimizer, density = set_up(gradients=0.0, opacity_logits=logits, fields=fields, config=config)
    with torch.no_grad():
        before = model.decode_geometry().opacities

        density.act(20, model, optimizer)

        after = model.decode_geometry().opacities
    np.testing.assert_allclose(after, before.clamp_max(0.01), rtol=1e-3)
    assert (optimizer.state_dict()["opacity_logits.0.exp_avg"] == 0).all()


def test_resets_come_where_they_are_due_and_never_at_the_end():
    config = dataclasses.replace(CONFIG, resets=3, prune_opacity=0.0)
    model, optimizer, density = set_up(gradients=0.0, config=config)
    due = []
    for step in range(1, STEPS + 1):
        with torch.no_grad():
            model.gaussians.opacity_logits.fill_(2.0)
        density.act(step, model, optimizer)
        if model.decode_geometry().opacities.max() < 0.02:
            due.append(step)
    assert due == [20, 30]  # 40 lies within a round of the end: nothing would be seen to recover


# -- when, and from what ---------------------------------------------------------------------------------------------


def steps_of_rounds(density, model, optimizer, steps):
    """The steps after which density control acts: a round forgets what was collected."""
    acted = []
    for step in range(1, steps + 1):
        density.views = torch.ones(len(model))
        density.act(step, model, optimizer)
        if density.views.sum() == 0:
            acted.append(step)
    return acted


def test_density_acts_at_its_rounds_only():
    model, optimizer, density = set_up(gradients=0.0)
    acted = steps_of_rounds(density, model, optimizer, STEPS)
    assert acted == [10, 20, 30, 40, 50]


@pytest.mark.parametrize("steps", [1, 2, 3, 10, 37])
def test_short_runs_have_a_schedule_too(steps):
    model, optimizer, _ = set_up()
    density = DensityControl(DensityConfig(resets=2), steps, 30, len(model), 0)
    for step in range(1, steps + 1):
        density.gradients, density.views = torch.ones(len(model)), torch.ones(len(model))
        density.act(step, model, optimizer)
    assert 1 <= len(model) <= 30


def seen_by(indices, visible, absgrad) -> SimpleNamespace:
    return SimpleNamespace(indices=torch.tensor(indices), visible=torch.tensor(visible), absgrad=torch.tensor(absgrad))


def test_views_add_gradients_in_ndc_for_what_was_visible():
    model, _, density = set_up()
    density.clear(20)
    wide = SimpleNamespace(width=200, height=100)
    density.observe(seen_by([3, 7, 9], [True, False, True], [[0.3, 0.0], [9.0, 9.0], [0.03, 0.04]]), wide, model)
    density.observe(seen_by([3], [True], [[0.0, 0.2]]), wide, model)

    assert density.views.tolist() == [0, 0, 0, 2, 0, 0, 0, 0, 0, 1, *[0] * 10]
    expected = torch.zeros(20)
    expected[3] = 0.3 * 100 + 0.2 * 50
    expected[9] = ((0.03 * 100) ** 2 + (0.04 * 50) ** 2) ** 0.5
    torch.testing.assert_close(density.gradients, expected)


def test_views_without_gradients_leave_no_trace():
    model, _, density = set_up(gradients=0.25)
    nothing = SimpleNamespace(indices=torch.tensor([3]), visible=torch.tensor([True]), absgrad=None)
    density.observe(nothing, SimpleNamespace(width=10, height=10), model)
    assert (density.gradients == 0.25).all() and (density.views == 1).all()


def test_gradients_are_wanted_until_the_last_round():
    """Before the first round too: that is what it goes by."""
    _, _, density = set_up()
    assert [step for step in range(1, STEPS + 1) if density.watching(step)] == list(range(1, 51))


@pytest.mark.parametrize("steps", [1, 2, 3, 10, 37, 100, 1000, 3001])
def test_every_round_is_watched(steps):
    """Also where the part of the run does not divide into rounds evenly."""
    model, optimizer, _ = set_up()
    density = DensityControl(DensityConfig(prune_opacity=0.0), steps, 20, len(model), 0)
    acted = steps_of_rounds(density, model, optimizer, steps)
    assert acted and all(density.watching(step) for step in range(1, acted[-1] + 1))
    assert not density.watching(round(0.65 * steps) + 1)


def test_the_same_seed_gives_the_same_children():
    results = []
    for seed in (1, 1, 2):
        model, optimizer, density = set_up(seed=seed, scale_logits=LARGE)
        torch.manual_seed(len(results))  # the global generator must not matter
        density.act(50, model, optimizer)
        results.append(model.gaussians.positions.detach())
    assert torch.equal(results[0], results[1]) and not torch.equal(results[0], results[2])


def test_children_of_two_rounds_are_drawn_apart():
    drawn = []
    for step in (20, 30):
        model, optimizer, density = set_up(1, scale_logits=LARGE, budget=100)
        density.act(step, model, optimizer)
        drawn.append(model.gaussians.positions.detach())
    assert not torch.equal(*drawn)


def test_new_gaussians_start_without_momentum():
    model, optimizer, density = set_up(gradients=high_for([2, 3]))
    for p in model.parameters():
        p.grad = torch.ones_like(p)
    optimizer.step(10, STEPS)
    density.act(50, model, optimizer)
    moments = optimizer.state_dict()["positions.0.exp_avg"]
    assert (moments[:20] != 0).all() and (moments[20:] == 0).all()

from __future__ import annotations

import numpy as np
import pytest
import torch
from scenes import ball_points, small_model

from hyrfpack.config.train import LearningRates
from hyrfpack.model.gaussians import Gaussians
from hyrfpack.train.optimizer import Optimizer

LEARNING_RATES = LearningRates(
    positions=(1e-2, 1e-4),
    fields=(2e-2, 1e-3),
    color_logits=(3e-2, 3e-2),
    scale_logits=(4e-2, 1e-2),
    opacity_logits=(5e-2, 1e-3),
)


def make_model(count: int = 6, seed: int = 0):
    return small_model(ball_points(count)[0], fields=1.0, seed=seed)


def set_gradients(model, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    for p in model.parameters():
        p.grad = torch.randn(p.shape, generator=generator)


def step_with_gradients_of(alone, edited, rows, optimizers) -> None:
    """Give the Gaussians of `edited` the gradients of these rows of `alone`, and take a step of both."""
    set_gradients(alone, 99)
    for p, q in zip(edited.gaussians.parameters(), alone.gaussians.parameters(), strict=True):
        p.grad = q.grad[rows].clone()
    for optimizer in optimizers:
        optimizer.step(10, 20)


def take_steps(model, optimizer, steps, total: int = 20) -> None:
    for step in steps:
        set_gradients(model, step)
        optimizer.step(step, total)


# Pairs of run length in steps and factor. A quarter of the full length doubles the rates; below 1,000 steps the factor
# is constant.
RATE_FACTORS_BY_STEPS = [(20, 30**0.5), (1000, 30**0.5), (7500, 2.0), (30_000, 1.0), (100_000, 1.0)]


@pytest.mark.parametrize(("steps", "pace"), RATE_FACTORS_BY_STEPS)
@pytest.mark.parametrize("name", [*Gaussians.PARAMETER_NAMES, "fields"])
def test_learning_rates_decay_exponentially_and_are_higher_in_short_runs(name, steps, pace):
    first, last = getattr(LEARNING_RATES, name)
    assert LEARNING_RATES.at(name, 0, steps) == pytest.approx(pace * first, rel=1e-12)
    assert LEARNING_RATES.at(name, steps // 2, steps) == pytest.approx(pace * (first * last) ** 0.5, rel=1e-12)
    assert LEARNING_RATES.at(name, steps - 1, steps) == pytest.approx(
        pace * last * (first / last) ** (1 / steps), rel=1e-12
    )


@pytest.mark.parametrize("views", [2, 4, 16])
@pytest.mark.parametrize("seen", [200, 3000, 30_000])
def test_learning_rates_grow_with_the_square_root_of_the_views_per_step(views, seen):
    for name in (*Gaussians.PARAMETER_NAMES, "fields"):
        for share in (0, 0.25, 1):
            alone, together = (
                LEARNING_RATES.at(name, share * seen, seen),
                LEARNING_RATES.at(name, share * seen / views, seen / views, views),
            )
            assert together == pytest.approx(views**0.5 * alone, rel=1e-12)


@pytest.mark.parametrize(("views", "betas"), [(1, (0.9, 0.999)), (4, (0.6, 0.996)), (16, (0.0, 0.984))])
def test_adam_averages_cover_the_same_number_of_views_for_any_views_per_step(views, betas):
    model = make_model()
    plain = {name: p.detach().clone().requires_grad_() for name, p in model.named_parameters()}
    adam = torch.optim.Adam(
        [{"params": [p]} for p in plain.values()], betas=betas, eps=1e-15, foreach=False, fused=False
    )
    optimizer = Optimizer(model, LEARNING_RATES, views)
    for step in range(3):
        for group, name in zip(adam.param_groups, plain, strict=True):
            kind = name.removeprefix("gaussians.")
            group["lr"] = LEARNING_RATES.at(kind if kind in Gaussians.PARAMETER_NAMES else "fields", step, 20, views)
        set_gradients(model, step)
        for name, parameter in model.named_parameters():
            plain[name].grad = parameter.grad.clone()
        optimizer.step(step, 20)
        adam.step()
    for name, parameter in model.named_parameters():
        torch.testing.assert_close(parameter.detach(), plain[name].detach(), rtol=1e-4, atol=1e-5)


def test_rates_fall_tenfold_or_more_by_default():
    rates = LearningRates()
    for name in (*Gaussians.PARAMETER_NAMES, "fields"):
        assert rates.at(name, 0, 30_000) >= 9.99 * rates.at(name, 30_000, 30_000) > 0


@pytest.mark.parametrize(("steps", "pace"), RATE_FACTORS_BY_STEPS)
def test_steps_match_adam_with_the_scheduled_rates(steps, pace):
    model = make_model()
    plain = {name: p.detach().clone().requires_grad_() for name, p in model.named_parameters()}
    adam = torch.optim.Adam([{"params": [p]} for p in plain.values()], eps=1e-15, foreach=False, fused=False)
    optimizer = Optimizer(model, LEARNING_RATES)

    for step in range(0, steps, steps // 20):
        progress = step / steps
        set_gradients(model, step)
        for group, (name, p) in zip(adam.param_groups, plain.items(), strict=True):
            p.grad = dict(model.named_parameters())[name].grad.clone()
            first, last = getattr(LEARNING_RATES, name.removeprefix("gaussians.") if "gaussians" in name else "fields")
            group["lr"] = pace * np.exp((1 - progress) * np.log(first) + progress * np.log(last))
        adam.step()
        optimizer.step(step, steps)

    for name, parameter in model.named_parameters():
        torch.testing.assert_close(parameter.detach(), plain[name].detach(), rtol=1e-5, atol=1e-6)


def test_only_the_fields_have_a_warm_up_and_their_rate_rises_linearly():
    model = make_model()
    optimizer = Optimizer(model, LEARNING_RATES, warmup_steps=4)
    moving = {"positions": model.gaussians.positions, "fields": model.geometry.weights[1]}
    for step in range(6):
        before = {name: parameter.detach().double() for name, parameter in moving.items()}
        for parameter in model.parameters():
            parameter.grad = torch.ones_like(parameter)
        optimizer.step(step, 20)
        for name, parameter in moving.items():
            # With a constant gradient, each step of Adam moves every number by the learning rate.
            moved = (before[name] - parameter.detach().double()).mean().item()
            share = min(1, (step + 1) / 4) if name == "fields" else 1
            assert moved == pytest.approx(share * LEARNING_RATES.at(name, step, 20), rel=1e-3)


def test_a_step_clears_the_gradients():
    model = make_model()
    take_steps(model, Optimizer(model, LEARNING_RATES), range(1))
    assert all(p.grad is None for p in model.parameters())


def test_every_parameter_belongs_to_one_group():
    model = make_model()
    owned = [p for group in Optimizer(model, LEARNING_RATES).groups.values() for p in group]
    assert {id(p) for p in owned} == {id(p) for p in model.parameters()} and len(owned) == len(set(map(id, owned)))


def test_replacing_keeps_rows_and_moments_and_starts_new_ones_at_zero():
    model = make_model()
    optimizer = Optimizer(model, LEARNING_RATES)
    take_steps(model, optimizer, range(3))
    values = {name: getattr(model.gaussians, name).detach().clone() for name in Gaussians.PARAMETER_NAMES}
    moments = {key: value.clone() for key, value in optimizer.state_dict().items()}
    keep = torch.tensor([4, 0, 2])
    new = {
        name: torch.full((2, width), 7.0)
        for name, width in zip(Gaussians.PARAMETER_NAMES, Gaussians.PARAMETER_WIDTHS, strict=True)
    }

    optimizer.replace_gaussians(keep, new)

    after = optimizer.state_dict()
    for name in Gaussians.PARAMETER_NAMES:
        assert torch.equal(getattr(model.gaussians, name), torch.cat([values[name][keep], new[name]]))
        for moment in ("exp_avg", "exp_avg_sq"):
            kept = moments[f"{name}.0.{moment}"][keep]
            assert kept.abs().min() > 0
            assert torch.equal(after[f"{name}.0.{moment}"], torch.cat([kept, torch.zeros_like(new[name])]))
    fields = [key for key in moments if key.startswith("fields.")]
    assert fields and all(torch.equal(after[key], moments[key]) for key in fields)


def test_kept_rows_continue_unchanged_after_a_replacement():
    edited, alone = make_model(), make_model()
    optimizers = Optimizer(edited, LEARNING_RATES), Optimizer(alone, LEARNING_RATES)
    for model, optimizer in zip((edited, alone), optimizers, strict=True):
        take_steps(model, optimizer, range(3))
    keep = torch.tensor([1, 5])
    nothing = {
        name: torch.zeros(0, width)
        for name, width in zip(Gaussians.PARAMETER_NAMES, Gaussians.PARAMETER_WIDTHS, strict=True)
    }

    optimizers[0].replace_gaussians(keep, nothing)
    step_with_gradients_of(alone, edited, keep, optimizers)

    for p, q in zip(edited.gaussians.parameters(), alone.gaussians.parameters(), strict=True):
        torch.testing.assert_close(p.detach(), q.detach()[keep], rtol=1e-6, atol=1e-7)


def test_replacing_before_the_first_step_works():
    model = make_model()
    optimizer = Optimizer(model, LEARNING_RATES)
    new = {
        name: torch.zeros(3, width)
        for name, width in zip(Gaussians.PARAMETER_NAMES, Gaussians.PARAMETER_WIDTHS, strict=True)
    }
    optimizer.replace_gaussians(torch.arange(6), new)
    take_steps(model, optimizer, range(2))
    assert len(model) == 9 and optimizer.state_dict()["positions.0.exp_avg"].shape == (9, 3)


def test_reordered_gaussians_continue_as_before():
    edited, alone = make_model(), make_model()
    optimizers = Optimizer(edited, LEARNING_RATES), Optimizer(alone, LEARNING_RATES)
    for model, optimizer in zip((edited, alone), optimizers, strict=True):
        take_steps(model, optimizer, range(3))
    order = torch.tensor([4, 0, 5, 3, 1, 2])

    optimizers[0].reorder_gaussians(order)
    step_with_gradients_of(alone, edited, order, optimizers)

    for p, q in zip(edited.gaussians.parameters(), alone.gaussians.parameters(), strict=True):
        assert torch.equal(p, q[order])


def test_resetting_sets_values_and_forgets_moments_of_one_group():
    model = make_model()
    optimizer = Optimizer(model, LEARNING_RATES)
    take_steps(model, optimizer, range(3))
    before = {key: value.clone() for key, value in optimizer.state_dict().items()}

    optimizer.reset("opacity_logits", torch.full((6, 1), -3.0))

    assert (model.gaussians.opacity_logits == -3).all()
    for key, value in optimizer.state_dict().items():
        if key.startswith("opacity_logits.0.exp_avg"):
            assert (value == 0).all()
        else:
            assert torch.equal(value, before[key])


def test_a_state_dict_continues_with_the_same_bits():
    model = make_model()
    optimizer = Optimizer(model, LEARNING_RATES)
    take_steps(model, optimizer, range(5))
    copy = make_model(seed=9)
    copy.load_state_dict(model.state_dict())
    state = {key: value.clone() for key, value in optimizer.state_dict().items()}
    restored = Optimizer(copy, LEARNING_RATES)
    restored.load_state_dict(state)

    take_steps(model, optimizer, range(5, 10))
    take_steps(copy, restored, range(5, 10))

    assert all(torch.equal(p, q) for p, q in zip(model.parameters(), copy.parameters(), strict=True))
    states = optimizer.state_dict(), restored.state_dict()
    assert states[0].keys() == states[1].keys()
    assert all(torch.equal(states[1][key], states[0][key]) for key in states[0])


def test_a_state_before_the_first_step_can_be_loaded():
    model, copy = make_model(), make_model()
    optimizer, restored = Optimizer(model, LEARNING_RATES), Optimizer(copy, LEARNING_RATES)
    restored.load_state_dict(optimizer.state_dict())
    take_steps(model, optimizer, range(2))
    take_steps(copy, restored, range(2))
    assert all(torch.equal(p, q) for p, q in zip(model.parameters(), copy.parameters(), strict=True))


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
@pytest.mark.parametrize("group", [*Gaussians.PARAMETER_NAMES, "fields"])
def test_the_group_with_a_broken_gradient_is_named(bad, group):
    model = make_model()
    set_gradients(model, 0)
    broken = model.radiance.weights[1] if group == "fields" else getattr(model.gaussians, group)
    broken.grad.view(-1)[3] = bad
    before = {name: p.detach().clone() for name, p in model.named_parameters()}
    optimizer = Optimizer(model, LEARNING_RATES)

    assert optimizer.names(optimizer.step(0, 20).tolist()) == [group]

    assert all(torch.isfinite(p).all() for p in model.parameters())
    assert broken.view(-1)[3] == before[next(n for n, p in model.named_parameters() if p is broken)].view(-1)[3]


def test_healthy_gradients_name_no_group():
    model = make_model()
    set_gradients(model, 0)
    model.radiance.biases[0].grad = None
    optimizer = Optimizer(model, LEARNING_RATES)
    assert optimizer.names(optimizer.step(0, 20).tolist()) == []

"""adam_step: every implementation against the reference in float64, and against torch.optim.Adam."""

from __future__ import annotations

import pytest
import torch
from ops.device import gpu, needs_triton
from torch import Tensor

from hyrfpack.ops.adam import adam_step
from hyrfpack.parallel import has_numba

TESTED_IMPLEMENTATIONS = ["reference", "cpu", pytest.param("gpu", marks=needs_triton)]
LEARNING_RATE = 1e-2


def normal(*shape: int, seed: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def make_group(shapes: list[tuple[int, ...]], gradient: float = 1.0, step: int = 1) -> list[list[Tensor]]:
    """Return values, gradients of this size, and moments as such gradients leave them before this step."""
    values = [normal(*shape, seed=i) for i, shape in enumerate(shapes)]
    gradients = [gradient * normal(*shape, seed=10 + i) for i, shape in enumerate(shapes)]
    if step == 1:
        return [values, gradients, [torch.zeros(shape) for shape in shapes], [torch.zeros(shape) for shape in shapes]]
    exp_avg = [0.3 * gradient * normal(*shape, seed=20 + i) for i, shape in enumerate(shapes)]
    exp_avg_sq = [(gradient * (0.5 + normal(*shape, seed=30 + i).abs())) ** 2 for i, shape in enumerate(shapes)]
    return [values, gradients, exp_avg, exp_avg_sq]


def step_group(
    group: list[list[Tensor]], implementation: str, dtype=torch.float32, rate=LEARNING_RATE, **settings
) -> tuple[list, list[bool]]:
    """Step a copy of the group; return values and moments on the CPU, and what the step returned."""
    place = gpu if implementation == "gpu" else torch.clone
    copy = [[place(tensor.to(dtype).clone()) for tensor in tensors] for tensors in group]
    broken = adam_step(*copy, rate=rate, implementation=implementation, **settings)
    assert broken.shape == (len(group[0]),) and broken.dtype == torch.bool and broken.device == copy[0][0].device
    return [[tensor.cpu() for tensor in copy[i]] for i in (0, 2, 3)], broken.tolist()


# Name -> the group and the number of its step.
GROUPS_AND_STEPS = {
    "no number": (make_group([(0,)]), 1),
    "one number": (make_group([(1,)]), 1),
    "an odd count": (make_group([(77, 13)], step=5), 5),
    "many blocks": (make_group([(100_000,)], step=40), 40),
    "a whole number of blocks": (make_group([(2048,)], step=40), 40),
    "a field: large, small and empty tensors": (make_group([(5000, 2), (64, 32), (64,), (0, 3), (8, 64), (8,)]), 1),
    "more tensors than slots": (make_group([(3,)] * 40, step=7), 7),
    "step 1000": (make_group([(3000,), (10,)], step=1000), 1000),
    "gradients of zero at the first step": (make_group([(500,)], 0.0), 1),
    "gradients of zero later": ([*make_group([(500,)], 0.0)[:2], *make_group([(500,)], step=9)[2:]], 9),
    "tiny gradients": (make_group([(500,)], 1e-30), 1),
    "gradients of the size of eps": (make_group([(500,)], 1e-15), 1),
    "huge gradients": (make_group([(500,)], 1e18), 1),
}


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
@pytest.mark.parametrize("case", GROUPS_AND_STEPS)
def test_a_step_matches_the_float64_reference(implementation: str, case: str) -> None:
    group, step = GROUPS_AND_STEPS[case]
    (values, exp_avg, exp_avg_sq), broken = step_group(group, implementation, step=step)
    expected, _ = step_group(group, "reference", torch.float64, step=step)
    assert not any(broken)
    for i, before in enumerate(group[0]):
        # A finite element moves by about the learning rate, and float32 represents a value to 2^-24 of its size.
        error = (values[i].double() - expected[0][i]).abs()
        moved = (expected[0][i] - before).abs()
        assert (error <= 1e-4 * moved + 1e-6 * LEARNING_RATE + 2**-23 * before.abs()).all()
        # The two terms of the first moment may cancel.
        size = group[1][i].abs().double() + group[2][i].abs()
        assert ((exp_avg[i] - expected[1][i]).abs() <= 1e-6 * size + 1e-37).all()
        torch.testing.assert_close(exp_avg_sq[i].double(), expected[2][i], rtol=1e-5, atol=1e-37)


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_twenty_steps_match_torch(implementation: str) -> None:
    shapes = [(40, 3), (7,), (300, 2)]
    values = make_group(shapes)[0]
    theirs = [value.clone().requires_grad_() for value in values]
    adam = torch.optim.Adam(theirs, eps=1e-15, foreach=False, fused=False)
    place = gpu if implementation == "gpu" else torch.clone
    ours = [place(value) for value in values]
    moments = [[torch.zeros_like(value) for value in ours] for _ in range(2)]
    for step in range(1, 21):
        rate = LEARNING_RATE / step
        gradients = [0.1 * value + normal(*value.shape, seed=step) for value in values]
        for tensor, gradient in zip(theirs, gradients, strict=True):
            tensor.grad = gradient.clone()
        adam.param_groups[0]["lr"] = rate
        adam.step()
        gradients = [place(gradient) for gradient in gradients]
        adam_step(ours, gradients, *moments, step=step, rate=rate, implementation=implementation)
    for tensor, expected in zip(ours, theirs, strict=True):
        torch.testing.assert_close(tensor.cpu(), expected.detach(), rtol=1e-6, atol=1e-6)


def test_cpu_has_the_bits_of_torch_fused() -> None:
    values = make_group([(123, 3), (5000,), (300_001, 2)])[0]
    theirs = [value.clone().requires_grad_() for value in values]
    adam = torch.optim.Adam(theirs, lr=LEARNING_RATE, betas=(0.8, 0.99), eps=1e-15, fused=True)
    moments = [[torch.zeros_like(value) for value in values] for _ in range(2)]
    for step in range(1, 9):
        gradients = [normal(*value.shape, seed=step) for value in values]
        for tensor, gradient in zip(theirs, gradients, strict=True):
            tensor.grad = gradient.clone()
        adam.step()
        adam_step(values, gradients, *moments, step=step, rate=LEARNING_RATE, betas=(0.8, 0.99), implementation="cpu")
    assert all(torch.equal(ours, tensor) for ours, tensor in zip(values, theirs, strict=True))
    for name, ours in zip(("exp_avg", "exp_avg_sq"), moments, strict=True):
        assert all(torch.equal(moment, adam.state[p][name]) for moment, p in zip(ours, theirs, strict=True))


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf"), 1e30, -1e30])
@pytest.mark.parametrize("place", [(0, 0), (0, 2999), (1, 4)])
def test_an_element_with_a_broken_gradient_is_reported_and_not_changed(implementation: str, bad: float, place) -> None:
    group = make_group([(3000,), (5,)], step=6)
    tensor, index = place
    healthy, broken = step_group(group, implementation, step=6)
    assert broken == [False, False]
    group[1][tensor][index] = bad

    after, broken = step_group(group, implementation, step=6)

    assert broken == [tensor == 0, tensor == 1]
    for old, new, alone in zip((group[0], group[2], group[3]), after, healthy, strict=True):
        assert new[tensor][index] == old[tensor][index]
        alone[tensor][index] = old[tensor][index]
        torch.testing.assert_close(new, alone, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_each_tensor_may_have_its_own_step_and_rate(implementation: str) -> None:
    steps, rates, shapes = [1, 9, 3, 9], [1e-2, 3e-3, 3e-3, 3e-3], [(1500, 2), (7,), (64, 3), (1,)]
    group = [
        sum(lists, [])
        for lists in zip(*(make_group([s], step=n) for s, n in zip(shapes, steps, strict=True)), strict=True)
    ]
    together, broken = step_group(group, implementation, step=steps, rate=rates)
    assert broken == [False] * 4
    for place, (step, rate) in enumerate(zip(steps, rates, strict=True)):
        alone, _ = step_group([[tensors[place]] for tensors in group], implementation, step=step, rate=rate)
        assert all(torch.equal(some[place], one[0]) for some, one in zip(together, alone, strict=True))


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_gradients_of_any_layout_and_unaligned_tensors_are_supported(implementation: str) -> None:
    group = make_group([(50, 3), (11, 2)], step=3)
    expected, _ = step_group(group, implementation, step=3)
    put = gpu if implementation == "gpu" else torch.clone
    # The start is one number off the alignment that 16-byte reads need.
    copy = [[put(torch.cat((t.new_zeros(1), t.flatten())))[1:].view(t.shape) for t in tensors] for tensors in group]
    copy[1] = [gradient.T.contiguous().T for gradient in copy[1]]

    adam_step(*copy, step=3, rate=LEARNING_RATE, implementation=implementation)

    for tensors, others in zip((copy[0], copy[2], copy[3]), expected, strict=True):
        torch.testing.assert_close([tensor.cpu() for tensor in tensors], others, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("implementation", TESTED_IMPLEMENTATIONS)
def test_parameters_that_need_gradients_are_stepped(implementation: str) -> None:
    group = make_group([(10,)])
    parameter = (gpu if implementation == "gpu" else torch.clone)(group[0][0].clone()).requires_grad_()
    parameter.square().sum().backward()
    moments = [torch.zeros_like(parameter.detach()) for _ in range(2)]
    adam_step(
        [parameter],
        [parameter.grad],
        *([m] for m in moments),
        step=1,
        rate=LEARNING_RATE,
        implementation=implementation,
    )
    expected = group[0][0] - LEARNING_RATE * group[0][0].sign()
    torch.testing.assert_close(parameter.detach().cpu(), expected, rtol=1e-5, atol=1e-6)


@pytest.mark.skipif(not has_numba(), reason="no numba")
def test_auto_uses_the_fused_kernel_on_the_cpu() -> None:
    group = make_group([(3000,)], step=4)
    assert all(map(torch.equal, *(sum(step_group(group, name, step=4)[0], []) for name in ("auto", "cpu"))))


def test_inputs_that_do_not_fit_are_rejected() -> None:
    group = make_group([(4, 3)])
    with pytest.raises(ValueError, match="steps count from 1"):
        adam_step(*group, step=0, rate=LEARNING_RATE)
    with pytest.raises(ValueError, match="there must be a tensor"):
        adam_step([], [], [], [], step=1, rate=LEARNING_RATE)
    with pytest.raises(ValueError, match="1 tensors, 2 steps and 1 rates"):
        adam_step(*group, step=[1, 2], rate=LEARNING_RATE)
    with pytest.raises(ValueError, match="shapes differ"):
        adam_step(group[0], [torch.zeros(3, 4)], *group[2:], step=1, rate=LEARNING_RATE)
    with pytest.raises(ValueError, match="contiguous"):
        adam_step([torch.zeros(3, 4).T], *group[1:], step=1, rate=LEARNING_RATE)
    with pytest.raises(ValueError):
        adam_step(group[0] * 2, *group[1:], step=1, rate=LEARNING_RATE)

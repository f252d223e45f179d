"""A step of Adam in one Triton launch for all tensors.

There may be tensors of 8 numbers and of 100 million. A small table on the device says where each tensor's numbers lie
and which program is its first, another how far each moves; a program finds its tensor there and does a block of it.
Each number is read and written once, in 16-byte pieces.
"""

from __future__ import annotations

import math
from functools import lru_cache
from itertools import accumulate

import torch
import triton
import triton.language as tl
from torch import Tensor

# Two 16-byte reads a thread of each of the four arrays: enough under way to fill the memory bus.
_BLOCK = 1024
_WARPS = 4
_FEWEST_SLOTS = 32  # of the table, a power of two, so that a few more tensors build no new kernel


@triton.jit
def _numbers(table, row, slot, start, SLOTS: tl.constexpr, ALIGNED: tl.constexpr):
    """Pointer to number `start` of the array whose address is in a row of the table."""
    numbers = tl.load(table + row * SLOTS + slot).to(tl.pointer_type(tl.float32)) + start
    return tl.multiple_of(numbers, 16) if ALIGNED else numbers


@triton.jit
def _update(values, gradients, exp_avg, exp_avg_sq, broken, inside, lane, gain1, gain2, rate, root, eps):
    """Step the numbers at `lane` of a block where they are `inside` the tensor."""
    x, g = tl.load(values + lane, mask=inside), tl.load(gradients + lane, mask=inside, other=0.0)
    m, v = tl.load(exp_avg + lane, mask=inside), tl.load(exp_avg_sq + lane, mask=inside)
    finite = g * g < float("inf")  # false for a NaN
    new_m = m + gain1 * (g - m)
    new_v = v + gain2 * (g * g - v)
    new_x = x - rate * (new_m / (tl.sqrt(new_v) * root + eps))
    tl.store(values + lane, tl.where(finite, new_x, x), mask=inside)
    tl.store(exp_avg + lane, tl.where(finite, new_m, m), mask=inside)
    tl.store(exp_avg_sq + lane, tl.where(finite, new_v, v), mask=inside)
    tl.store(broken, 1, mask=tl.sum((finite == 0).to(tl.int32)) > 0)  # all who write, write the same


@triton.jit
def step_numbers(
    table,
    paces,
    broken,
    gain1,
    gain2,
    eps,
    SLOTS: tl.constexpr,
    ALIGNED: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """One block of one tensor.

    Args:
        table: (6, SLOTS) int64: first program, number of numbers, addresses of values, gradients, exp_avg and
            exp_avg_sq of each tensor; unused slots have a first program beyond all.
        paces: (2, SLOTS): learning rate / (1 - b1^step) and 1 / sqrt(1 - b2^step) of each tensor.
        broken: (tensors,) uint8, set to 1 where a squared gradient is not finite.
        gain1, gain2: 1 - b1 and 1 - b2.
        ALIGNED: whether all addresses are multiples of 16.
    """
    program = tl.program_id(0)
    firsts = tl.load(table + tl.arange(0, SLOTS))
    slot = tl.sum((firsts <= program).to(tl.int32)) - 1
    start = (program - tl.load(table + slot)) * BLOCK
    left = tl.load(table + SLOTS + slot) - start
    rate, root = tl.load(paces + slot), tl.load(paces + SLOTS + slot)
    values = _numbers(table, 2, slot, start, SLOTS, ALIGNED)
    gradients = _numbers(table, 3, slot, start, SLOTS, ALIGNED)
    exp_avg = _numbers(table, 4, slot, start, SLOTS, ALIGNED)
    exp_avg_sq = _numbers(table, 5, slot, start, SLOTS, ALIGNED)
    lane = tl.arange(0, BLOCK)
    if left >= BLOCK:  # a mask known when this is compiled does not take the 16-byte reads apart
        _update(
            values, gradients, exp_avg, exp_avg_sq, broken + slot, lane < BLOCK, lane, gain1, gain2, rate, root, eps
        )
    else:
        _update(values, gradients, exp_avg, exp_avg_sq, broken + slot, lane < left, lane, gain1, gain2, rate, root, eps)


@lru_cache(maxsize=256)
def _table(sizes: tuple[int, ...], addresses: tuple[int, ...], device: torch.device) -> tuple[Tensor, int]:
    """The kernel's table on the device, and the number of programs; `addresses` are those of all values, then of all
    gradients, and so on. Kept: memory is handed out in the same places step after step."""
    count = len(sizes)
    slots = max(_FEWEST_SLOTS, triton.next_power_of_2(count))
    *firsts, programs = accumulate((triton.cdiv(size, _BLOCK) for size in sizes), initial=0)
    columns = [firsts, sizes, *(addresses[i : i + count] for i in range(0, 4 * count, count))]
    rows = [[*column, *[2**31] * (slots - count)] for column in columns]
    table = torch.tensor(rows, dtype=torch.int64, pin_memory=device.type == "cuda")
    return table.to(device, non_blocking=True), programs


def adam_step(
    values: list[Tensor],
    gradients: list[Tensor],
    exp_avg: list[Tensor],
    exp_avg_sq: list[Tensor],
    steps: list[int],
    rates: list[float],
    betas: tuple[float, float],
    eps: float,
) -> Tensor:
    """As `hyrfpack.ops.adam.adam_step`."""
    device = values[0].device
    gradients = [gradient.contiguous() for gradient in gradients]  # held here until the kernel is launched
    sizes = tuple(value.numel() for value in values)
    addresses = tuple(t.data_ptr() for tensors in (values, gradients, exp_avg, exp_avg_sq) for t in tensors)
    table, programs = _table(sizes, addresses, device)
    broken = torch.zeros(len(values), dtype=torch.bool, device=device)
    if programs:
        slots = table.shape[1]
        columns = (
            [rate / (1 - betas[0] ** step) for rate, step in zip(rates, steps, strict=True)],
            [1 / math.sqrt(1 - betas[1] ** step) for step in steps],
        )
        rows = [[*column, *[0.0] * (slots - len(values))] for column in columns]
        paces = torch.tensor(rows, pin_memory=device.type == "cuda").to(device, non_blocking=True)
        step_numbers[(programs,)](
            table,
            paces,
            broken.view(torch.uint8),
            1.0 - betas[0],
            1.0 - betas[1],
            float(eps),
            SLOTS=slots,
            ALIGNED=all(address % 16 == 0 for address in addresses),
            BLOCK=_BLOCK,
            num_warps=_WARPS,
            enable_fp_fusion=True,
        )
    return broken

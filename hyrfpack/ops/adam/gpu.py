"""Implements the Adam step in one Triton launch for all tensors.

Tensors may have 8 elements or 100 million. A small table on the device holds each tensor's addresses and its first
program; another holds each tensor's step scales. Each program looks up its tensor there and updates one block of that
tensor. It reads and writes each element once, in accesses of 16 bytes.
"""

from __future__ import annotations

import math
from functools import lru_cache
from itertools import accumulate

import torch
import triton
import triton.language as tl
from torch import Tensor

# Each thread reads 2 x 16 bytes of each of the four arrays, which keeps enough reads in flight to saturate the memory
# bus.
_ELEMENTS_PER_PROGRAM = 1024
_WARPS_PER_PROGRAM = 4
# The table's length is a compile-time power of two. This minimum lets small numbers of tensors share one kernel.
_MIN_TABLE_SLOTS = 32


@triton.jit
def _element_pointer(table, row, slot, start, SLOTS: tl.constexpr, ALIGNED: tl.constexpr):
    """Return the pointer to element `start` of the array whose address is in a row of the table."""
    pointer = tl.load(table + row * SLOTS + slot).to(tl.pointer_type(tl.float32)) + start
    return tl.multiple_of(pointer, 16) if ALIGNED else pointer


@triton.jit
def _update_elements(
    values, gradients, exp_avg, exp_avg_sq, skipped, inside, lane, weight1, weight2, rate, inv_root, eps
):
    """Update the elements at `lane` of a block where they are `inside` the tensor."""
    x, g = tl.load(values + lane, mask=inside), tl.load(gradients + lane, mask=inside, other=0.0)
    m, v = tl.load(exp_avg + lane, mask=inside), tl.load(exp_avg_sq + lane, mask=inside)
    finite = g * g < float("inf")  # The comparison is false for NaN.
    new_m = m + weight1 * (g - m)
    new_v = v + weight2 * (g * g - v)
    new_x = x - rate * (new_m / (tl.sqrt(new_v) * inv_root + eps))
    tl.store(values + lane, tl.where(finite, new_x, x), mask=inside)
    tl.store(exp_avg + lane, tl.where(finite, new_m, m), mask=inside)
    tl.store(exp_avg_sq + lane, tl.where(finite, new_v, v), mask=inside)
    tl.store(skipped, 1, mask=tl.sum((finite == 0).to(tl.int32)) > 0)  # No race: all programs write the same value.


@triton.jit
def adam_step_kernel(
    table,
    step_scales,
    enabled,
    skipped,
    weight1,
    weight2,
    eps,
    SLOTS: tl.constexpr,
    ALIGNED: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Take the Adam step for one block of one tensor.

    Args:
        table: (6, SLOTS) int64: first program, number of elements, addresses of values, gradients, exp_avg and
            exp_avg_sq of each tensor; in unused slots the first program is beyond the last one.
        step_scales: (2, SLOTS): learning rate / (1 - b1^step) and 1 / sqrt(1 - b2^step) of each tensor.
        enabled: uint8 scalar, 0 if nothing may change; or None.
        skipped: (tensors,) uint8, set to 1 for a tensor with a non-finite squared gradient.
        weight1, weight2: 1 - b1 and 1 - b2.
        ALIGNED: whether all addresses are multiples of 16.
    """
    if enabled is not None:
        if tl.load(enabled) == 0:
            return
    program = tl.program_id(0)
    firsts = tl.load(table + tl.arange(0, SLOTS))
    slot = tl.sum((firsts <= program).to(tl.int32)) - 1
    start = (program - tl.load(table + slot)) * BLOCK
    left = tl.load(table + SLOTS + slot) - start
    rate, inv_root = tl.load(step_scales + slot), tl.load(step_scales + SLOTS + slot)
    values = _element_pointer(table, 2, slot, start, SLOTS, ALIGNED)
    gradients = _element_pointer(table, 3, slot, start, SLOTS, ALIGNED)
    exp_avg = _element_pointer(table, 4, slot, start, SLOTS, ALIGNED)
    exp_avg_sq = _element_pointer(table, 5, slot, start, SLOTS, ALIGNED)
    lane = tl.arange(0, BLOCK)
    if left >= BLOCK:  # With a mask that is constant at compile time, reads stay 16 bytes wide.
        _update_elements(
            values,
            gradients,
            exp_avg,
            exp_avg_sq,
            skipped + slot,
            lane < BLOCK,
            lane,
            weight1,
            weight2,
            rate,
            inv_root,
            eps,
        )
    else:
        _update_elements(
            values,
            gradients,
            exp_avg,
            exp_avg_sq,
            skipped + slot,
            lane < left,
            lane,
            weight1,
            weight2,
            rate,
            inv_root,
            eps,
        )


@lru_cache(maxsize=256)
def _table(sizes: tuple[int, ...], addresses: tuple[int, ...], device: torch.device) -> tuple[Tensor, int]:
    """Return the kernel's table on the device and the number of programs.

    `addresses` lists the addresses of all values, then of all gradients, exp_avg and exp_avg_sq. The result is cached,
    since the allocator returns the same addresses at every step.
    """
    count = len(sizes)
    slots = max(_MIN_TABLE_SLOTS, triton.next_power_of_2(count))
    *firsts, programs = accumulate((triton.cdiv(size, _ELEMENTS_PER_PROGRAM) for size in sizes), initial=0)
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
    enabled: Tensor | None = None,
) -> Tensor:
    """Take the step of `hyrfpack.ops.adam.adam_step`."""
    device = values[0].device
    gradients = [gradient.contiguous() for gradient in gradients]  # This keeps copies alive until the launch.
    sizes = tuple(value.numel() for value in values)
    addresses = tuple(t.data_ptr() for tensors in (values, gradients, exp_avg, exp_avg_sq) for t in tensors)
    table, programs = _table(sizes, addresses, device)
    skipped = torch.zeros(len(values), dtype=torch.bool, device=device)
    if programs:
        slots = table.shape[1]
        columns = (
            [rate / (1 - betas[0] ** step) for rate, step in zip(rates, steps, strict=True)],
            [1 / math.sqrt(1 - betas[1] ** step) for step in steps],
        )
        rows = [[*column, *[0.0] * (slots - len(values))] for column in columns]
        step_scales = torch.tensor(rows, pin_memory=device.type == "cuda").to(device, non_blocking=True)
        adam_step_kernel[(programs,)](
            table,
            step_scales,
            None if enabled is None else enabled.view(torch.uint8),
            skipped.view(torch.uint8),
            1.0 - betas[0],
            1.0 - betas[1],
            float(eps),
            SLOTS=slots,
            ALIGNED=all(address % 16 == 0 for address in addresses),
            BLOCK=_ELEMENTS_PER_PROGRAM,
            num_warps=_WARPS_PER_PROGRAM,
            enable_fp_fusion=True,
        )
    return skipped

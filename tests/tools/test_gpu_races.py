"""tools/gpu/races.py finds planted races, and none in the kernels of hyrfpack."""

from __future__ import annotations

import pytest
import torch
from ops.device import IS_INTERPRETED, needs_triton

triton = pytest.importorskip("triton")
import triton.language as tl  # noqa: E402

from hyrfpack.self_test.cases import list_self_test_cases  # noqa: E402
from tools.gpu import races  # noqa: E402

pytestmark = [needs_triton, pytest.mark.skipif(not IS_INTERPRETED, reason="races are found in Triton's interpreter")]

PROGRAMS = 4
# Kernels that sum parts of results, of which these inputs have too few for a second program.
ONE_PROGRAM_HERE = {"sum_copies_kernel", "_reduce_kernel"}


@triton.jit
def _store_own_number(x, y, STEP: tl.constexpr):
    program = tl.program_id(0)
    tl.store(x + program * STEP, program)


@triton.jit
def _store_one(x, y, STEP: tl.constexpr):
    tl.store(x + tl.program_id(0) * STEP, 1)


@triton.jit
def _load_the_next(x, y, STEP: tl.constexpr):
    program = tl.program_id(0)
    tl.store(y + program, tl.load(x + program + STEP))
    tl.store(x + program, program)


@triton.jit
def _add_and_load(x, y, STEP: tl.constexpr):
    program = tl.program_id(0)
    tl.atomic_add(x, 1)
    tl.store(y + program, tl.load(x + STEP))


@triton.jit
def _add_and_store(x, y, STEP: tl.constexpr):
    program = tl.program_id(0)
    tl.atomic_add(x + program, 1)
    tl.store(x + (program + STEP) % 4, 7)


@triton.jit
def _store_lanes(x, y, STEP: tl.constexpr):
    lane = tl.arange(0, 4)
    tl.store(x + tl.program_id(0) * 4 + lane * STEP, lane)


@triton.jit
def _store_wide(x, y, STEP: tl.constexpr):
    """Store 8 bytes, of which the previous program loads the upper 4 if STEP is 1."""
    program = tl.program_id(0)
    wide = (x + program * 2).to(tl.pointer_type(tl.int64))
    tl.store(wide, program.to(tl.int64))
    tl.store(y + program, tl.load(x + ((program * 2 + 3) % 8 if STEP else 8)))


@triton.jit
def _store_past_the_end(x, y, STEP: tl.constexpr):
    at = tl.program_id(0) * 4 + tl.arange(0, 4)
    tl.store(x + at, at, mask=at < 13 + STEP)


@triton.jit
def _load_past_the_end(x, y, STEP: tl.constexpr):
    program = tl.program_id(0)
    tl.store(y + program, tl.load(x + 9 + program + STEP))


@triton.jit
def _load_own_stores(x, y, STEP: tl.constexpr):
    lane = tl.arange(0, 4)
    tl.store(x + tl.program_id(0) * 4 + lane, lane)
    if STEP == 0:
        tl.debug_barrier()
    tl.store(y + tl.program_id(0), tl.sum(tl.load(x + tl.program_id(0) * 4 + lane), 0))


def run_watched(kernel, step: int) -> set[str]:
    """Launch a kernel on two tensors of which only the first 13 elements are passed; return what is found."""
    report = races.RaceReport()
    x, y = torch.zeros(16, dtype=torch.int32)[:13], torch.zeros(16, dtype=torch.int32)[:13]
    if kernel in (_store_lanes, _load_own_stores):
        x = torch.zeros(16, dtype=torch.int32)
    with races.watch_launches(report):
        kernel[(PROGRAMS,)](x, y, STEP=step)
    assert sum(report.launches.values()) == sum(report.compared.values()) == 1
    return {problem for _, problem in report.found}


@pytest.mark.parametrize(
    ("kernel", "racing", "clean", "problem"),
    [
        (_store_own_number, 0, 1, races.STORED_TWICE),
        (_load_the_next, 1, 0, races.LOADED_AND_STORED),
        (_add_and_load, 0, 1, races.LOADED_AND_ADDED),
        (_add_and_store, 1, 0, races.STORED_AND_ADDED),
        (_store_lanes, 0, 1, races.STORED_TWICE_AT_ONCE),
        (_store_wide, 1, 0, races.LOADED_AND_STORED),
        (_store_past_the_end, 1, 0, races.OUT_OF_BOUNDS),
        (_load_past_the_end, 1, 0, races.OUT_OF_BOUNDS),
        (_load_own_stores, 1, 0, races.RELOADED),
    ],
)
def test_a_planted_mistake_is_found_and_its_correction_is_clean(kernel, racing: int, clean: int, problem: str) -> None:
    assert run_watched(kernel, racing) == {problem}
    assert run_watched(kernel, clean) == set()


def test_programs_that_store_the_same_value_do_not_race() -> None:
    assert run_watched(_store_one, 0) == set()


def test_an_access_out_of_bounds_changes_nothing() -> None:
    whole = torch.zeros(16, dtype=torch.int32)
    with races.watch_launches(races.RaceReport()):
        _store_past_the_end[(PROGRAMS,)](whole[:13], whole, STEP=3)
    assert whole[13:].eq(0).all() or whole[:13].tolist() == list(range(13))


def test_programs_run_in_another_order_for_each_seed() -> None:
    orders = []
    for seed in (1, 2):
        x = torch.zeros(1, dtype=torch.int32)
        with races.watch_launches(races.RaceReport(), seed):
            for _ in range(6):
                _store_own_number[(PROGRAMS,)](x, x, STEP=0)
                orders.append((seed, int(x)))
    assert len({last for seed, last in orders if seed == 1}) > 1
    assert [last for seed, last in orders if seed == 1] != [last for seed, last in orders if seed == 2]


@pytest.fixture(scope="module")
def report() -> races.RaceReport:
    """The launches of all cases of the self-test, with their gradients."""
    report = races.RaceReport()
    with races.watch_launches(report):
        for case in list_self_test_cases().values():
            tensors = {name: tensor.clone() for name, tensor in case.inputs.items()}
            leaves = [tensors[name].requires_grad_() for name in case.gradient_inputs]
            with torch.set_grad_enabled(bool(leaves)):
                results = case.run("gpu", tensors).values()
                if pulled := [value for value in results if value.requires_grad]:
                    torch.autograd.grad([value.sum() for value in pulled], leaves)
    return report


def test_no_kernel_races_or_leaves_its_tensors(report: races.RaceReport) -> None:
    assert not report.found, "\n".join(report.lines())


def test_every_kernel_of_several_programs_is_compared(report: races.RaceReport) -> None:
    assert len(report.launches) >= 25
    assert {name for name in report.launches if not report.compared[name]} <= ONE_PROGRAM_HERE

"""The self-test finds kernels that are broken in every way, and its cases cover every GPU operation."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from unittest import mock

import pytest
import torch
from ops.device import IS_INTERPRETED, needs_triton

from hyrfpack.ops.dispatch import GPU_OPERATIONS
from hyrfpack.parallel import has_numba
from hyrfpack.self_test import SelfTest, run_self_test
from hyrfpack.self_test import run as self_test_run
from hyrfpack.self_test.cases import self_test_cases
from hyrfpack.self_test.check import check_case

BROKEN_WORKER_FILE = Path(__file__).with_name("broken_worker.py")
CPU_DEVICE = torch.device("cpu")
# Cases that the interpreter runs within a second.
QUICK_CASES = ("contract", "encode_views, sh", "activate_geometry, sum", "shade", "composite", "adam_step")

ALL_CASES = self_test_cases()

needs_interpreter = pytest.mark.skipif(not IS_INTERPRETED, reason="kernels are compiled for the GPU that is there")


def run_broken(broken: dict[str, str], cases: Sequence[str] = QUICK_CASES, **limits: float) -> SelfTest:
    """Run some cases of the self-test in the interpreter, with some kernels broken."""

    def command(implementation: str, device: str, names: Sequence[str]) -> list[str]:
        return [sys.executable, str(BROKEN_WORKER_FILE), json.dumps(broken), implementation, device, *names]

    with mock.patch.object(self_test_run, "self_test_cases", lambda: {name: ALL_CASES[name] for name in cases}):
        return run_self_test("gpu", CPU_DEVICE, command, **limits)


def test_every_gpu_operation_has_a_case() -> None:
    assert {case.operation for case in ALL_CASES.values()} == set(GPU_OPERATIONS)


@needs_triton
@needs_interpreter
@pytest.mark.parametrize("name", QUICK_CASES)
def test_kernels_pass_with_errors_far_below_their_bounds(name: str) -> None:
    case = ALL_CASES[name]
    row = check_case(case, "gpu", CPU_DEVICE)
    assert "status" not in row and row["value error"] < case.bounds[0] / 10
    assert ("gradient error" in row) == bool(case.gradient_inputs)


@needs_triton
@needs_interpreter
@pytest.mark.acceptance
def test_all_kernels_pass_in_a_child_process() -> None:
    test = run_self_test("gpu", CPU_DEVICE)
    assert test.problem is None and not test.failed_rows
    assert [row["item"] for row in test.rows] == list(ALL_CASES)


@pytest.mark.skipif(not has_numba(), reason="no numba")
@pytest.mark.acceptance
def test_all_cpu_kernels_pass_in_a_child_process() -> None:
    test = run_self_test("cpu", CPU_DEVICE)
    assert not test.failed_rows and len(test.rows) == sum(case.has_cpu_kernels for case in ALL_CASES.values())


@needs_triton
@needs_interpreter
def test_a_kernel_that_crashes_and_a_wrong_one_are_found_and_another_still_runs() -> None:
    test = run_broken({"contract": "crashes", "composite": "nan"}, ("contract", "composite", "adam_step"))
    assert test.problem is None
    assert {operation: str(row["note"]) for operation, row in test.failed_operations.items()} == {
        "contract": "its process ended by SIGSEGV: last words",
        "composite": "image is NaN or infinite",
    }
    assert [row["item"] for row in test.rows if "status" not in row] == ["adam_step"]


@needs_triton
@needs_interpreter
@pytest.mark.acceptance
def test_kernels_broken_in_any_way_are_found_and_the_others_still_run() -> None:
    test = run_broken(
        {
            "contract": "does not compile",
            "encode_views": "crashes",
            "activate_geometry gradient": "wrong",
            "shade": "illegal access",
            "composite": "nan",
        }
    )
    failed = test.failed_operations
    notes = {operation: str(row["note"]) for operation, row in failed.items()}
    assert test.problem is None
    assert set(notes) == {"activate_geometry", "composite", "contract", "encode_views", "shade"}
    assert notes["contract"] == "RuntimeError: PassManager::run failed more"
    assert notes["encode_views"] == "its process ended by SIGSEGV: last words"
    assert notes["activate_geometry"].startswith("the gradient of raw is off by ")
    assert "illegal memory access" in notes["shade"]
    assert notes["composite"] == "image is NaN or infinite"
    # How much slower plain torch is, is known only of kernels that ran to the end.
    assert {operation for operation, row in failed.items() if "slowdown" in row} == {"activate_geometry", "composite"}
    assert [row["item"] for row in test.rows if "status" not in row] == ["adam_step"]


@needs_triton
@needs_interpreter
@pytest.mark.acceptance
def test_a_kernel_that_hangs_fails_after_its_time_and_the_others_still_run() -> None:
    test = run_broken({"contract": "hangs"}, ("contract", "adam_step"), max_case_seconds=40.0)
    assert [row.get("note") for row in test.rows] == ["not done within 40 s", None]


@pytest.mark.acceptance
def test_a_device_that_cannot_be_used_is_a_problem_and_no_failure_of_kernels() -> None:
    test = run_broken({"device": "busy"})
    assert test.rows == () and test.problem == "its process ended: CUDA-capable device(s) is/are busy or unavailable"

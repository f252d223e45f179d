"""The self-test finds kernels that are broken in every way, and its cases cover every GPU operation."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from unittest import mock
from unittest.mock import Mock

import pytest
import torch
from ops.device import IS_INTERPRETED, needs_triton

from hyrfpack.ops.dispatch import GPU_OPERATIONS
from hyrfpack.parallel import has_numba
from hyrfpack.parallel.child_items import ROW_PREFIX
from hyrfpack.self_test import SelfTest, run_self_test, worker
from hyrfpack.self_test import run as self_test_run
from hyrfpack.self_test.cases import Inputs, SelfTestCase, list_self_test_cases
from hyrfpack.self_test.check import check_case
from hyrfpack.self_test.worker import CACHE_FIX, INSTALL_FIX, explain_launch_failure

BROKEN_WORKER_FILE = Path(__file__).with_name("broken_worker.py")
CPU_DEVICE = torch.device("cpu")
# Cases that the interpreter runs within a second.
QUICK_CASES = ("contract", "encode_views, sh", "activate_geometry, sum", "shade", "composite", "adam_step")

ALL_CASES = list_self_test_cases()

needs_interpreter = pytest.mark.skipif(not IS_INTERPRETED, reason="kernels are compiled for the GPU that is there")


def run_broken(broken: dict[str, str], cases: Sequence[str] = QUICK_CASES, **limits: float) -> SelfTest:
    """Run some cases of the self-test in the interpreter, with some kernels broken."""

    def command(implementation: str, device: str, names: Sequence[str]) -> list[str]:
        return [sys.executable, str(BROKEN_WORKER_FILE), json.dumps(broken), implementation, device, *names]

    with mock.patch.object(self_test_run, "list_self_test_cases", lambda: {name: ALL_CASES[name] for name in cases}):
        return run_self_test("gpu", CPU_DEVICE, command, **limits)


def test_every_gpu_operation_has_a_case() -> None:
    assert {case.operation for case in ALL_CASES.values()} == set(GPU_OPERATIONS)


def test_only_cases_in_mixed_precision_replace_mixed_precision(monkeypatch) -> None:
    def fail(command, names, *limits):
        return [{"item": name, "status": "failed", "note": "no bfloat16"} for name in names if name in ALL_CASES]

    monkeypatch.setattr(self_test_run, "run_in_children", fail)
    for row in run_self_test("gpu", CPU_DEVICE).rows:
        name = str(row["item"])
        assert row["operation"] == ("mixed_precision" if "mixed precision" in name else ALL_CASES[name].operation)


@needs_triton
@needs_interpreter
@pytest.mark.parametrize("name", QUICK_CASES)
def test_kernels_pass_with_errors_far_below_their_bounds(name: str) -> None:
    case = ALL_CASES[name]
    row = check_case(case, "gpu", CPU_DEVICE)
    assert "status" not in row and row["value error"] < case.bounds[0] / 10
    assert ("gradient error" in row) == bool(case.gradient_inputs)


def make_case(first: float, **attributes: bool) -> SelfTestCase:
    """Return a case of two results, of which kernels return `first` and a right number, and the reference two ones."""

    def run(implementation: str, inputs: Inputs) -> dict[str, torch.Tensor]:
        return {
            "first": torch.tensor([1.0 if implementation == "reference" else first]),
            "second": torch.tensor([1.0 if implementation == "reference" else 1.0 + 2**-20]),
        }

    return SelfTestCase("contract", {}, run, **attributes)


def test_a_result_of_nan_stays_the_largest_error_before_one_that_is_right() -> None:
    row = check_case(make_case(math.nan), "cpu", CPU_DEVICE)
    assert row["status"] == "failed" and row["note"] == "first is NaN or infinite"
    assert row["value error"] == math.inf


@pytest.mark.parametrize("reference_runs", [True, False])
def test_kernels_are_compared_in_time_only_with_a_reference_that_runs(reference_runs: bool) -> None:
    row = check_case(make_case(2.0, reference_runs=reference_runs), "cpu", CPU_DEVICE)
    assert row["status"] == "failed" and ("slowdown" in row) == reference_runs
    assert not ALL_CASES["rasterize, replay"].reference_runs


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


@pytest.mark.acceptance
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
    assert not test.is_conclusive


@needs_triton
@needs_interpreter
@pytest.mark.acceptance
def test_a_case_whose_process_is_killed_fails_for_now_and_one_that_ends_by_itself_for_good() -> None:
    test = run_broken({"contract": "is killed", "composite": "crashes"}, ("contract", "composite"))
    assert [row["note"] for row in test.rows] == [
        "its process ended by SIGKILL: no output",
        "its process ended by SIGSEGV: last words",
    ]
    assert [row.get("is_temporary", False) for row in test.rows] == [True, False] and not test.is_conclusive


def run_here(names: Sequence[str], capsys: pytest.CaptureFixture[str]) -> list[dict]:
    """Run items of the self-test in this process, and return the rows that a child would print."""
    worker.run_cases("gpu", CPU_DEVICE, names)
    lines = capsys.readouterr().out.splitlines()
    return [json.loads(line.removeprefix(ROW_PREFIX)) for line in lines if line.startswith(ROW_PREFIX)]


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (
            torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 MiB.\nmore"),
            {
                "note": "the GPU's memory ran out (CUDA out of memory. Tried to allocate 2 MiB.)",
                "is_temporary": True,
            },
        ),
        (RuntimeError("PassManager::run failed\nmore"), {"note": "RuntimeError: PassManager::run failed more"}),
    ],
)
def test_only_memory_that_ran_out_is_a_temporary_error(error, expected, monkeypatch, capsys) -> None:
    monkeypatch.setattr(worker, "check_case", Mock(side_effect=error))
    assert run_here(["contract"], capsys) == [{"item": "contract", "status": "failed"} | expected]


@needs_triton
@needs_interpreter
@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (RuntimeError("Failed to find C compiler.\nmore"), {"note": "Failed to find C compiler.", "fix": INSTALL_FIX}),
        (
            PermissionError(13, "Permission denied", "/root/.triton/cache"),
            {"note": "[Errno 13] Permission denied: '/root/.triton/cache'", "fix": CACHE_FIX},
        ),
        (
            RuntimeError("Triton Error [CUDA]: out of memory"),
            {"note": "the GPU's memory ran out (Triton Error [CUDA]: out of memory)", "is_temporary": True},
        ),
        (None, None),
    ],
)
def test_a_failed_launch_says_what_to_install_unless_memory_ran_out(error, expected, monkeypatch, capsys) -> None:
    if error is not None:
        monkeypatch.setattr("hyrfpack.self_test.simplest_kernel.launch_simplest_kernel", Mock(side_effect=error))
    rows = run_here(["launch"], capsys)
    assert rows == ([] if expected is None else [{"item": "launch", "status": "failed"} | expected])


@pytest.mark.parametrize("fix", [{}, {"fix": "install gcc"}])
def test_a_triton_that_launches_nothing_is_one_problem_and_no_failure_of_kernels(fix, monkeypatch) -> None:
    row = {"item": "launch", "status": "failed", "note": "no compiler", **fix}
    monkeypatch.setattr(self_test_run, "run_in_children", lambda *_: [row])
    problem = "Triton cannot compile and launch kernels here (no compiler)" + ("; install gcc" if fix else "")
    test = run_self_test("gpu", CPU_DEVICE)
    assert test == SelfTest("gpu", "cpu", (), problem, can_launch=False) and not test.is_conclusive


@pytest.mark.parametrize("has_headers", [True, False])
def test_a_c_compiler_that_fails_says_whether_headers_are_missing(
    has_headers: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if has_headers:
        (tmp_path / "Python.h").touch()
    monkeypatch.setattr("sysconfig.get_path", lambda name: str(tmp_path))
    error = subprocess.CalledProcessError(1, ["/usr/bin/gcc", "/tmp/x/main.c", "-O3"])
    missing = "" if has_headers else "; Python.h is missing"
    assert explain_launch_failure(error) == (f"gcc ended with exit code 1{missing}", INSTALL_FIX)


@pytest.mark.acceptance
def test_a_device_that_cannot_be_used_is_a_problem_and_no_failure_of_kernels() -> None:
    test = run_broken({"device": "busy"})
    assert test.rows == () and test.problem == "its process ended: CUDA-capable device(s) is/are busy or unavailable"

"""Run what a user's first command on a GPU runs: the self-test of the kernels; then `hyrfpack doctor`."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator

from hyrfpack.self_test.cases import list_self_test_cases
from hyrfpack.self_test.check import check_case
from tools.gpu.process import TimedProcess
from tools.gpu.rows import Row
from tools.gpu.setup import Setup

TABLE_NAME = "Self-test"
DOCTOR_ITEM = "hyrfpack doctor"
SELF_TIMED_ITEMS = (DOCTOR_ITEM,)
DOCTOR_PROBLEM_PREFIX, DOCTOR_RESULT_PREFIX = "problem: ", "self-test: "


def items(setup: Setup) -> list[str]:
    """Return the names of the self-test's cases, and one item for the command."""
    cases = list_self_test_cases()
    return [
        *(name for name, case in cases.items() if setup.implementation == "gpu" or case.has_cpu_kernels),
        DOCTOR_ITEM,
    ]


def run(item: str, setup: Setup) -> Iterator[Row]:
    """Yield the row of a case, or of the command.

    The seconds of a case include compilation, the first of each kernel on this machine. The command runs the same cases
    again, so the seconds that it states are without compilation.
    """
    row: Row = {"table": TABLE_NAME, "case": item}
    if item == DOCTOR_ITEM:
        yield row | _run_doctor(setup)
    else:
        yield row | check_case(list_self_test_cases()[item], setup.implementation, setup.torch_device)


def _run_doctor(setup: Setup) -> Row:
    command = [sys.executable, "-m", "hyrfpack", "doctor", "--device", setup.device]
    start = time.perf_counter()
    process = TimedProcess(command, setup.doctor_seconds, setup.log_path("doctor"), os.environ)
    lines = [line.strip() for line in process.lines()]
    result = next((line for line in lines if line.startswith(DOCTOR_RESULT_PREFIX)), "no result")
    row: Row = {"seconds": round(time.perf_counter() - start, 3), "result": result.removeprefix(DOCTOR_RESULT_PREFIX)}
    problems = [line for line in lines if line.startswith(DOCTOR_PROBLEM_PREFIX)]
    if process.is_out_of_time:
        return row | {"status": "failed", "note": f"not done within {setup.doctor_seconds:.0f} s"}
    if process.exit_code or problems:
        reason = (problems or lines[-1:] or ["no output"])[0].removeprefix(DOCTOR_PROBLEM_PREFIX)
        return row | {"status": "failed", "note": f"exit code {process.exit_code}: {reason}"}
    return row

"""Run NVIDIA's compute-sanitizer on the cases of the self-test: accesses out of bounds, and races in shared memory."""

from __future__ import annotations

import re
import shutil
import sys
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

from hyrfpack.parallel.child_items import DONE_PREFIX, child_environment
from hyrfpack.self_test.cases import list_self_test_cases
from tools.gpu.process import TimedProcess
from tools.gpu.rows import Row
from tools.gpu.setup import Setup

TABLE_NAME = "compute-sanitizer"
# The usual place of the tool, for machines whose PATH lacks it.
DEFAULT_PROGRAM = Path("/usr/local/cuda/bin/compute-sanitizer")
# The time limit of each tool, in the order in which they run. Together they fit into the part's time limit.
TOOL_SECONDS = {"memcheck": 45.0, "racecheck": 33.0}
_SUMMARY = re.compile(r"(?:ERROR|RACECHECK) SUMMARY: (\d+) (.*)")


def items(setup: Setup) -> list[str]:
    """Return the names of the sanitizer's tools."""
    return list(TOOL_SECONDS)


def run(item: str, setup: Setup) -> Iterator[Row]:
    """Yield the row of one tool, with the number of errors that it found."""
    program = shutil.which("compute-sanitizer") or (str(DEFAULT_PROGRAM) if DEFAULT_PROGRAM.exists() else None)
    if program is None:
        yield {
            "table": TABLE_NAME,
            "tool": item,
            "status": "left out",
            "note": "compute-sanitizer is not installed here",
        }
        return
    cases = list_self_test_cases()
    names = [name for name, case in cases.items() if item == "memcheck" or case.operation in list_product_operations()]
    worker = [sys.executable, "-m", "hyrfpack.self_test.worker", setup.implementation, f"{setup.device}:0", *names]
    # torch's cache of memory would hide accesses between two tensors.
    environment = {**child_environment(), "PYTORCH_NO_CUDA_MEMORY_CACHING": "1"}
    process = TimedProcess([program, "--tool", item, *worker], TOOL_SECONDS[item], setup.log_path(item), environment)
    output = "".join(process.lines())
    row: Row = {"table": TABLE_NAME, "tool": item, "cases": f"{count_checked_cases(output)} of {len(names)}"}
    if process.is_out_of_time:
        printed_lines = "; ".join(islice(_iterate_report_lines(output), 4))[:300]
        yield row | {
            "status": "failed",
            "note": f"not done within {TOOL_SECONDS[item]:.0f} s; it printed: {printed_lines}",
        }
    else:
        yield row | describe_output(output, process.exit_code, len(names))


def list_product_operations() -> set[str]:
    """Return the operations whose kernels multiply matrices, through shared memory: those with mixed precision."""
    return {case.operation for case in list_self_test_cases().values() if case.is_mixed}


def count_checked_cases(output: str) -> int:
    """Return how many cases the self-test has ended in a tool's output."""
    return sum(line.startswith(DONE_PREFIX) for line in output.splitlines())


def describe_output(output: str, exit_code: int, cases: int) -> Row:
    """Return the number of errors in a tool's output, with a status if there are any or not all cases were checked."""
    summary = _SUMMARY.search(output)
    if summary is None:
        last_line = (output.strip().splitlines() or ["no output"])[-1]
        return {"status": "failed", "note": f"it ended with exit code {exit_code} and no summary: {last_line[:200]}"}
    row: Row = {"found": f"{summary[1]} {summary[2].strip()}"}
    if int(summary[1]):
        return row | {"status": "failed", "note": "; ".join(islice(_iterate_report_lines(output), 4))[:300]}
    checked = count_checked_cases(output)
    if exit_code or checked != cases:
        note = f"it ended with exit code {exit_code} after {checked} of {cases} cases"
        return row | {"status": "failed", "note": note}
    return row


def _iterate_report_lines(output: str) -> Iterator[str]:
    """Yield the lines of the tool itself, without those of the program that it runs."""
    for line in output.splitlines():
        if line.startswith("=========") and line.strip("= "):
            yield line.strip("= ")

"""Run the repository's tests marked `gpu` with pytest, in several processes, and make one row for each file."""

from __future__ import annotations

import os
import re
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path

from tools.gpu.process import TimedProcess
from tools.gpu.rows import Row

MAX_SECONDS = 125.0  # leaves time for the summary and the random cases within the part's time limit
GPU_MARKER = "gpu"  # the marker that pyproject.toml declares
# pyproject.toml asks for strict settings; these are not strict, because a GPU machine may lack pytest's plugins. It may
# also lack other packages, so files that cannot be imported do not stop the others.
PYTEST_OVERRIDES = (
    "-o", "addopts=--import-mode=importlib", "-p", "no:cacheprovider", "--continue-on-collection-errors",
)  # fmt: skip
# Building kernels takes a CPU core each. Processes begin with a range of neighbouring tests each, and take tests from
# others when they are done, so that no file of slow tests keeps one of them busy alone.
MAX_TEST_PROCESSES = min(12, os.cpu_count() or 1)
PARALLEL_OPTIONS = ("--dist", "worksteal", "-p", "tools.gpu.replace_worker")
_OUTCOME = "(?P<outcome>PASSED|FAILED|ERROR|SKIPPED|XFAIL|XPASS)"
# "tests/test_a.py::test_b PASSED [ 50%]", or from xdist "[gw1] [ 50%] PASSED tests/test_a.py::test_b".
_TEST_LINES = (
    re.compile(rf"(?P<file>\S+\.py)::.* {_OUTCOME}(?: \(.*\))?\s+\[ *\d+%\]\s*"),
    re.compile(rf"\[gw\d+\] \[ *\d+%\] {_OUTCOME} (?P<file>\S+\.py)::.*\s*"),
)
_OUTCOME_LABELS = {
    "PASSED": "passed",
    "FAILED": "failed",
    "ERROR": "errors",
    "SKIPPED": "skipped",
    "XFAIL": "xfailed",
    "XPASS": "xpassed",
}
_FAILED_OUTCOMES = ("FAILED", "ERROR")
_SKIP_LINE = re.compile(r"SKIPPED \[\d+\] (?P<file>[^:]+\.py)(?::\d+)?: (?P<reason>.*)")  # of pytest's summary


def run_suite(
    paths: Sequence[str], seconds: float = MAX_SECONDS, workers: int = MAX_TEST_PROCESSES, log: Path | None = None
) -> Iterator[Row]:
    """Run the tests marked `gpu`; yield a row for each file, and one more if no test passed or pytest itself failed.

    A file whose tests were all skipped is left out. Rows are yielded at the end, or when `seconds` are over, with the
    first reason of each file's failures. Each test's line is printed when the test ends, so the last line precedes a
    test that hangs.

    Args:
        paths: files and folders of tests.
        seconds: time limit, after which pytest is interrupted.
        workers: number of xdist's processes; 0, or a missing xdist, runs all tests in one process.
        log: file for all that pytest prints, or None.

    Raises:
        ModuleNotFoundError: pytest is not installed.
    """
    import pytest

    parallel = ("-n", str(workers), *PARALLEL_OPTIONS) if workers and find_spec("xdist") else ()
    command = [sys.executable, "-m", "pytest", "-v", "-rfEs", "--no-header", *PYTEST_OVERRIDES, *parallel]
    command += ["-m", GPU_MARKER, *paths]
    # The lines must be wide enough for the message of a failed test.
    environment = {**os.environ, "COLUMNS": "400", "PYTHONUNBUFFERED": "1"}
    process = TimedProcess(command, seconds, log, environment)
    counts: dict[str, Counter[str]] = {}
    last_line, reasons, skip_reasons = "", dict[str, str](), dict[str, str]()
    for line in process.lines():
        last_line = " ".join(line.split()) or last_line
        if test := next(filter(None, (pattern.fullmatch(line) for pattern in _TEST_LINES)), None):
            print(last_line, flush=True)
            counts.setdefault(test["file"], Counter())[test["outcome"]] += 1
        elif line.startswith(_FAILED_OUTCOMES):  # a line of pytest's summary
            reasons.setdefault(line.partition(" ")[2].partition("::")[0], last_line)
        elif skip := _SKIP_LINE.match(line):
            skip_reasons.setdefault(skip["file"], skip["reason"])
    code, tests = process.exit_code, sum(outcomes.total() for outcomes in counts.values())
    for file, outcomes in counts.items():
        row = _row(file, outcomes)
        if _has_failed(outcomes):
            row |= {"status": "failed", "note": reasons.get(file, last_line)}
        elif set(outcomes) == {"SKIPPED"}:
            row |= {"status": "left out", "note": skip_reasons.get(file, "all its tests were skipped")}
        yield row
    if code and process.is_out_of_time:
        yield {"case": "pytest", "status": "failed", "note": f"not done within {seconds:.0f} s; {tests} tests were run"}
    elif not counts and code == pytest.ExitCode.NO_TESTS_COLLECTED:
        yield {"case": "pytest", "status": "failed", "note": f"no test is marked '{GPU_MARKER}' in {' '.join(paths)}"}
    elif code and not any(map(_has_failed, counts.values())):
        note = next(iter(reasons.values()), last_line)
        yield {"case": "pytest", "status": "failed", "note": f"pytest ended with exit code {code}: {note}"}
    elif counts and not any(outcomes["PASSED"] or _has_failed(outcomes) for outcomes in counts.values()):
        yield {"case": "pytest", "status": "failed", "note": f"none of the {tests} tests passed"}


def _has_failed(outcomes: Counter[str]) -> bool:
    return any(outcomes[name] for name in _FAILED_OUTCOMES)


def _row(file: str, outcomes: Counter[str]) -> Row:
    return {
        "case": file,
        "result": ", ".join(f"{outcomes[name]} {label}" for name, label in _OUTCOME_LABELS.items() if outcomes[name]),
    }

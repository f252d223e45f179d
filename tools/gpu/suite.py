"""Run the repository's tests marked `gpu` with pytest, all in one process, and make one row for each file."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

from tools.gpu.rows import Row

REPOSITORY_ROOT = Path(__file__).parents[2]
TEST_PATHS = ("tests/ops", "tests/test_gpu_path.py")  # the kernels alone, and the pipeline from photos to pictures
GPU_MARKER = "gpu"  # the marker that pyproject.toml declares
# pyproject.toml asks for strict settings; these are not strict, because a GPU machine may lack pytest's plugins. It may
# also lack other packages, so files that cannot be imported do not stop the others.
PYTEST_OVERRIDES = (
    "-o", "addopts=--import-mode=importlib", "-p", "no:cacheprovider", "--continue-on-collection-errors",
)  # fmt: skip
_TEST_LINE = re.compile(r"(\S+\.py)::.* (PASSED|FAILED|ERROR|SKIPPED|XFAIL|XPASS)(?: \(.*\))?\s+\[ *\d+%\]\s*")
_OUTCOME_LABELS = {"PASSED": "passed", "FAILED": "failed", "ERROR": "errors", "SKIPPED": "skipped", "XFAIL": "xfailed"}
_FAILED_OUTCOMES = ("FAILED", "ERROR")


def run_suite(paths: Sequence[str] = TEST_PATHS) -> Iterator[Row]:
    """Run the tests marked `gpu`; yield one row for each file, and one more if pytest failed outside of a test.

    The row of a file without failures is yielded when the next file begins. That of a file with failures is yielded at
    the end, with the first reason. Each test's line is printed when the test ends, so the last line precedes a test
    that hangs.

    Raises:
        ModuleNotFoundError: pytest is not installed.
    """
    import pytest

    command = [sys.executable, "-m", "pytest", "-v", "--no-header", *PYTEST_OVERRIDES, "-m", GPU_MARKER, *paths]
    # The lines must be wide enough for the message of a failed test.
    environment = {**os.environ, "COLUMNS": "400", "PYTHONUNBUFFERED": "1"}
    child = subprocess.Popen(
        command,
        cwd=REPOSITORY_ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        env=environment,
    )
    counts: dict[str, Counter[str]] = {}
    last_line, reasons = "", dict[str, str]()
    reported = set[str]()
    assert child.stdout is not None
    for line in child.stdout:
        last_line = " ".join(line.split()) or last_line
        if test := _TEST_LINE.fullmatch(line):
            print(last_line, flush=True)
            file, outcome = test.groups()
            for other in [name for name in counts if name not in {file, *reported} and not _has_failed(counts[name])]:
                reported.add(other)
                yield _row(other, counts[other])
            counts.setdefault(file, Counter())[outcome] += 1
        elif line.startswith(_FAILED_OUTCOMES):  # a line of pytest's summary
            reasons.setdefault(line.partition(" ")[2].partition("::")[0], last_line)
    code = child.wait()
    for file in [name for name in counts if name not in reported]:
        row = _row(file, counts[file])
        if _has_failed(counts[file]):
            row |= {"status": "failed", "note": reasons.get(file, last_line)}
        yield row
    if not counts and code == pytest.ExitCode.NO_TESTS_COLLECTED:
        yield {"case": "pytest", "status": "failed", "note": f"no test is marked '{GPU_MARKER}' in {' '.join(paths)}"}
    elif code and not any(map(_has_failed, counts.values())):
        note = next(iter(reasons.values()), last_line)
        yield {"case": "pytest", "status": "failed", "note": f"pytest ended with exit code {code}: {note}"}


def _has_failed(outcomes: Counter[str]) -> bool:
    return any(outcomes[name] for name in _FAILED_OUTCOMES)


def _row(file: str, outcomes: Counter[str]) -> Row:
    return {
        "case": file,
        "result": ", ".join(f"{count} {_OUTCOME_LABELS.get(name, name)}" for name, count in outcomes.items()),
    }

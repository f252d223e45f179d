"""The tests that run on a GPU where there is one, by pytest: all in one process, a row for each file."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

from tools.gpu.rows import Row

ROOT = Path(__file__).parents[2]
PLACES = ("tests/ops", "tests/test_gpu_path.py")  # those of kernels, and of the whole way from photos to pictures
CHOSEN = "gpu"  # the marker of tests/conftest.py
# Not strict: a GPU's machine may lack the plugins that pyproject.toml has settings of.
LENIENT = ("-o", "addopts=--import-mode=importlib", "-p", "no:cacheprovider")
_TEST = re.compile(r"(\S+\.py)::.* (PASSED|FAILED|ERROR|SKIPPED|XFAIL|XPASS)(?: \(.*\))?\s+\[ *\d+%\]\s*")
_WORDS = {"PASSED": "passed", "FAILED": "failed", "ERROR": "errors", "SKIPPED": "skipped", "XFAIL": "xfailed"}
_BROKEN = ("FAILED", "ERROR")


def run_suite(places: Sequence[str] = PLACES) -> Iterator[Row]:
    """Run the tests marked `gpu`; yields what came of each file, and what ended pytest where that was none of them.

    A file has its row as soon as the next begins, or, with the first reason, at the end where a test of it failed.
    Each test is printed as it ends: where one hangs, the last is that before it.

    Raises:
        ModuleNotFoundError: there is no pytest.
    """
    import pytest

    command = [sys.executable, "-m", "pytest", "-v", "--no-header", *LENIENT, "-m", CHOSEN, *places]
    wide = {**os.environ, "COLUMNS": "400", "PYTHONUNBUFFERED": "1"}  # as long as the sentence of a failed test
    child = subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace", env=wide
    )
    counts: dict[str, Counter[str]] = {}
    last, reasons = "", dict[str, str]()
    told = set[str]()
    assert child.stdout is not None
    for line in child.stdout:
        last = " ".join(line.split()) or last
        if test := _TEST.fullmatch(line):
            print(last, flush=True)
            file, outcome = test.groups()
            for other in [name for name in counts if name not in {file, *told} and not _is_broken(counts[name])]:
                told.add(other)
                yield _row(other, counts[other])
            counts.setdefault(file, Counter())[outcome] += 1
        elif line.startswith(_BROKEN):  # of the summary at the end
            reasons.setdefault(line.partition(" ")[2].partition("::")[0], last)
    code = child.wait()
    for file in [name for name in counts if name not in told]:
        row = _row(file, counts[file])
        if _is_broken(counts[file]):
            row |= {"status": "failed", "note": reasons.get(file, last)}
        yield row
    if not counts and code == pytest.ExitCode.NO_TESTS_COLLECTED:
        yield {"case": "pytest", "status": "failed", "note": f"no test is marked '{CHOSEN}' in {' '.join(places)}"}
    elif code and not any(map(_is_broken, counts.values())):
        note = next(iter(reasons.values()), last)
        yield {"case": "pytest", "status": "failed", "note": f"it ended with exit code {code}: {note}"}


def _is_broken(outcomes: Counter[str]) -> bool:
    return any(outcomes[name] for name in _BROKEN)


def _row(file: str, outcomes: Counter[str]) -> Row:
    return {"case": file, "result": ", ".join(f"{count} {_WORDS.get(name, name)}" for name, count in outcomes.items())}

"""How the GPU check runs the tests marked `gpu`, and what it reports of them."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tools.gpu import check as gpu_check
from tools.gpu import suite as gpu_suite
from tools.gpu.setup import Setup


@pytest.mark.parametrize("workers", [0, 2])
def test_tests_marked_gpu_are_run_and_a_failure_is_reported_with_its_reason(workers: int, tmp_path: Path) -> None:
    (tmp_path / "test_a.py").write_text("import pytest\npytestmark = pytest.mark.gpu\ndef test_good(): pass\n")
    (tmp_path / "test_b.py").write_text(
        "import pytest\n@pytest.mark.gpu\ndef test_good(): pass\n@pytest.mark.gpu\ndef test_bad(): assert 1 == 2\n"
        "@pytest.mark.gpu\ndef test_worse(): assert 3 == 4\ndef test_cpu(): assert False\n"
    )
    (tmp_path / "test_c.py").write_text(
        "import pytest\n@pytest.mark.gpu\n@pytest.mark.parametrize('x', ['a b - FAILED'])\ndef test_good(x): pass\n"
    )
    rows = gpu_suite.run_suite([str(tmp_path)], workers=workers)
    good, bad, last = sorted(rows, key=lambda row: str(row["case"]))
    assert [Path(row["case"]).name for row in (good, bad, last)] == ["test_a.py", "test_b.py", "test_c.py"]
    assert good["result"] == last["result"] == "1 passed" and "status" not in good | last
    assert bad["result"] == "1 passed, 2 failed" and bad["status"] == "failed"
    assert "test_bad" in bad["note"] and "1 == 2" in bad["note"]


@pytest.mark.parametrize("workers", [0, 2])
def test_a_file_whose_tests_are_all_skipped_is_left_out_with_the_reason(workers: int, tmp_path: Path) -> None:
    skipped = "import pytest\npytestmark = [pytest.mark.gpu, pytest.mark.skip('needs 20 GB: too few')]\n"
    (tmp_path / "test_a.py").write_text(skipped + "def test_one(): pass\ndef test_two(): pass\n")
    nothing_passed = list(gpu_suite.run_suite([str(tmp_path)], workers=workers))
    (tmp_path / "test_b.py").write_text("import pytest\n@pytest.mark.gpu\ndef test_good(): pass\n")
    left_out, good = sorted(gpu_suite.run_suite([str(tmp_path)], workers=workers), key=lambda row: str(row["case"]))
    assert left_out["result"] == "2 skipped" and left_out["status"] == "left out"
    assert left_out["note"] == "needs 20 GB: too few" and "status" not in good
    assert nothing_passed[0]["status"] == "left out"
    assert nothing_passed[1:] == [{"case": "pytest", "status": "failed", "note": "none of the 2 tests passed"}]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("def test_cpu(): pass", "no test is marked 'gpu'"),
        ("import no_such_module", "exit code 1.*test_some.py"),
        ("import os, pytest\n@pytest.mark.gpu\ndef test_dies(): os._exit(7)", "exit code 7.*test_dies"),
    ],
)
def test_pytest_without_a_result_is_a_failure(content: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "test_some.py").write_text(content)
    (row,) = gpu_suite.run_suite([str(tmp_path)], workers=0)
    assert row["status"] == "failed" and re.search(words, row["note"]), row


def test_a_worker_whose_gpu_is_broken_is_replaced_and_the_rest_of_its_file_still_runs(tmp_path: Path) -> None:
    (tmp_path / "test_some.py").write_text(
        "import os, sys, types, pytest\npytestmark = pytest.mark.gpu\n"
        "def test_first(): pass\n"
        "def test_breaks(monkeypatch):\n"
        "    from tools.gpu import replace_worker\n"
        "    replace_worker.is_gpu_broken = lambda: True\n"
        "    raise RuntimeError('an illegal memory access')\n"
        "def test_last(): pass\n"
    )
    (row,) = gpu_suite.run_suite([str(tmp_path)], workers=1)
    assert sorted(str(row["result"]).split(", ")) == ["1 failed", "2 passed"]
    assert "crashed while running" in row["note"] and "test_breaks" in row["note"]


def test_a_suite_that_takes_too_long_keeps_the_outcomes_of_the_tests_that_ended(tmp_path: Path) -> None:
    (tmp_path / "test_some.py").write_text(
        "import time, pytest\npytestmark = pytest.mark.gpu\n"
        "def test_quick(): pass\ndef test_bad(): assert 1 == 2\ndef test_slow(): time.sleep(60)\n"
    )
    seconds = 20.0  # on a busy machine, pytest takes 8 s to start
    row, late = gpu_suite.run_suite([str(tmp_path)], seconds=seconds, workers=0)
    assert row["result"] == "1 passed, 1 failed" and "1 == 2" in row["note"]
    assert late["status"] == "failed" and late["note"] == "not done within 20 s; 2 tests were run"


def test_a_file_that_cannot_be_imported_does_not_stop_the_others(tmp_path: Path) -> None:
    (tmp_path / "test_a.py").write_text("import no_such_module")
    (tmp_path / "test_b.py").write_text("import pytest\n@pytest.mark.gpu\ndef test_good(): pass")
    good, missing = gpu_suite.run_suite([str(tmp_path)], workers=0)
    assert Path(good["case"]).name == "test_b.py" and good["result"] == "1 passed" and "status" not in good
    assert missing["status"] == "failed" and "test_a.py" in missing["note"]


def test_every_kernel_test_and_end_to_end_test_is_selected() -> None:
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "--collect-only",
        *gpu_suite.PYTEST_OVERRIDES,
        "-m",
        gpu_suite.GPU_MARKER,
    ]
    done = subprocess.run(
        [*command, *Setup().test_paths], cwd=gpu_check.REPOSITORY_ROOT, capture_output=True, text=True
    )
    chosen = {line.partition("[")[0] for line in done.stdout.splitlines() if "::" in line}
    for file in ("tests/ops/test_shaded.py", "tests/test_gpu_path.py"):
        names = re.findall(r"^def (test_\w+)", (gpu_check.REPOSITORY_ROOT / file).read_text(), re.MULTILINE)
        assert names and {f"{file}::{name}" for name in names} <= chosen
    kernels = {path.parent.name for path in gpu_check.REPOSITORY_ROOT.glob("hyrfpack/ops/*/gpu.py")}
    assert len(kernels) > 5 and kernels <= {re.search(r"test_(\w+)\.py", name)[1] for name in chosen}

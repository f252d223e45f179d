"""tools/gpu/ranks.py: what its rows say of two processes, with a program in the place of training and with training."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from tools.gpu import ranks as gpu_ranks
from tools.gpu.rows import Row
from tools.gpu.setup import Setup

SMALL_CPU_SETUP = Setup(
    device="cpu", implementation="cpu", demo_views=9, demo_size=16, ranks_steps=4, ranks_seconds=200.0
)
# The arguments are "train SCENE -o OUT ... --processes N".
FAKE_TRAINING = """
import json, os, sys, time
from pathlib import Path
processes, out = int(sys.argv[-1]), Path(sys.argv[4])
out.mkdir()
nan = float("nan")
psnr = {psnr}[processes]
(out / "metrics.json").write_text(json.dumps({{"evaluation": {{"psnr": psnr}}}}))
print("collectives", os.environ["HYRFPACK_COLLECTIVES"], flush=True)
if psnr is None:
    sys.exit("Error: the processes do not agree")
if psnr == 0:
    time.sleep(60)
"""


@pytest.fixture
def rows_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[Row]]:
    """Return a function that returns the rows if one process and two reach these PSNRs; None fails, 0 hangs."""

    def rows(one: float | None, two: float | None, setup: Setup = SMALL_CPU_SETUP) -> list[Row]:
        (tmp_path / "hyrfpack").mkdir(exist_ok=True)
        (tmp_path / "hyrfpack" / "__init__.py").touch()
        (tmp_path / "hyrfpack" / "__main__.py").write_text(FAKE_TRAINING.format(psnr={1: one, 2: two}))
        monkeypatch.setattr("tools.gpu.process.REPOSITORY_ROOT", tmp_path)
        return list(gpu_ranks.run("demo", replace(setup, logs=str(tmp_path / "logs"))))

    return rows


@pytest.mark.parametrize(
    ("one", "two", "statuses"),
    [(25.0, 24.1, [None, None]), (25.0, 23.9, [None, "failed"]), (25.0, float("nan"), [None, "failed"])],
    ids=["close", "lower", "NaN"],
)
def test_two_processes_fail_where_their_psnr_is_a_decibel_lower(
    rows_for: Callable[..., list[Row]], one: float, two: float, statuses: list[str | None], tmp_path: Path
) -> None:
    rows = rows_for(one, two)
    assert [row.get("status") for row in rows] == statuses
    assert [row["processes"] for row in rows] == [1, 2]
    assert (tmp_path / "logs" / "train-2.txt").read_text() == "collectives gloo\n"


def test_a_run_that_fails_or_hangs_is_a_failed_row_with_its_reason(rows_for: Callable[..., list[Row]]) -> None:
    first, second = rows_for(None, 24.0)
    assert first["status"] == "failed" and first["note"] == "exit code 1: Error: the processes do not agree"
    assert "status" not in second
    first, second = rows_for(25.0, 0, replace(SMALL_CPU_SETUP, ranks_seconds=1.0))
    assert "status" not in first
    assert second["status"] == "failed" and second["note"] == "not done within 1 s"


def test_processes_with_a_gpu_each_use_nccl_and_others_gloo() -> None:
    assert [gpu_ranks.choose_collectives("cuda", gpus) for gpus in (1, 2, 8)] == ["gloo", "nccl", "nccl"]
    assert gpu_ranks.choose_collectives("cpu", 0) == "gloo"


@pytest.mark.acceptance
def test_two_processes_on_the_cpu_train_as_well_as_one() -> None:
    setup = replace(SMALL_CPU_SETUP, demo_views=24, demo_size=64, ranks_steps=60)
    rows = list(gpu_ranks.run("demo", setup))
    assert [row.get("note") for row in rows] == [None, None]

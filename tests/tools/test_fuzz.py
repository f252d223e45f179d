"""tools/safety/fuzz.py: what a run does when its workers die."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from tools.safety import fuzz
from tools.safety.fuzz import FuzzRun, Tally


class FakeWorker:
    """A worker that dies at chosen inputs, or before its first input for the first `failed_starts` answers."""

    deadly: tuple[int, ...] = ()
    failed_starts = 0

    def __init__(self, seed: int) -> None:
        self.current = SimpleNamespace(value=-1)
        self.process = SimpleNamespace(exitcode=-9, join=lambda: None)
        self.pipe = SimpleNamespace(send=lambda message: None)

    def ask(self, numbers: list[int]) -> tuple[Tally, int] | None:
        if FakeWorker.failed_starts > 0:
            FakeWorker.failed_starts -= 1
            return None
        if killers := [number for number in numbers if number in self.deadly]:
            self.current.value = killers[0]
            return None
        tally = Tally()
        tally.kinds["made up"] += len(numbers)
        return tally, 0


@pytest.fixture(autouse=True)
def fake_worker(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fuzz, "_Worker", FakeWorker)
    monkeypatch.setattr(FakeWorker, "failed_starts", 0)


def run_fuzz() -> FuzzRun:
    run = FuzzRun(count=2500, seed=0, jobs=1)
    run.run()
    return run


def test_an_input_that_kills_its_worker_is_the_only_failure(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(FakeWorker, "deadly", (5, 1999))
    run = run_fuzz()
    assert sorted(run.tally.failures) == [5, 1999] and run.tally.kinds.total() == 2498 and run.unexamined == 0


def test_a_worker_that_dies_between_batches_is_replaced(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(FakeWorker, "failed_starts", fuzz.MAX_FAILED_STARTS - 1)
    run = run_fuzz()
    assert run.tally.failures == {} and run.tally.kinds.total() == 2500 and run.unexamined == 0


def test_inputs_stay_unexamined_if_no_worker_starts(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(FakeWorker, "failed_starts", 1000)
    run = run_fuzz()
    assert run.tally.failures == {} and run.unexamined == 2500

"""No test reads a clock, so none waits for the machine to warm up."""

from __future__ import annotations

import pytest

from hyrfpack.measure import timing


@pytest.fixture(autouse=True)
def no_warming(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(timing, "WARM_SECONDS", 0)

from __future__ import annotations

import pytest

from hyrfpack.distill import pack, start


@pytest.fixture(autouse=True)
def short_work(monkeypatch: pytest.MonkeyPatch) -> None:
    """As little of everything as still makes a model."""
    monkeypatch.setattr(start, "LEAST_STEPS", 100)
    monkeypatch.setattr(pack, "TRIALS", 2)

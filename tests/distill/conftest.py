from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def short_work(short_imports: None) -> None:
    pass

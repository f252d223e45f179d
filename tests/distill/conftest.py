from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def use_short_imports(short_imports: None) -> None:
    pass

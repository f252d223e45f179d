from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def use_quick_import(quick_import: None) -> None:
    pass

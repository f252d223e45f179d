from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def use_quick_distillation(quick_distillation: None) -> None:
    pass

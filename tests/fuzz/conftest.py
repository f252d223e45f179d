"""Give fuzz tests the scene-folder helpers of tests/data."""

from __future__ import annotations

import runpy
from pathlib import Path
from types import SimpleNamespace

import pytest

TESTS_FOLDER = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def folders() -> SimpleNamespace:
    """Return the names defined in tests/data/conftest.py, such as ColmapFolder and write_pictures."""
    return SimpleNamespace(**runpy.run_path(str(TESTS_FOLDER / "data" / "conftest.py")))

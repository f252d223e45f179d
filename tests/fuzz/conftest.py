"""Makes the scene folders of tests/data at hand."""

from __future__ import annotations

import runpy
from pathlib import Path
from types import SimpleNamespace

import pytest

TESTS = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def folders() -> SimpleNamespace:
    """What tests/data/conftest.py defines: ColmapFolder, write_pictures, poses_of, rotation_of."""
    return SimpleNamespace(**runpy.run_path(str(TESTS / "data" / "conftest.py")))

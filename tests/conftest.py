"""Shared fixtures: where the real data sets are. Tests may also import `scenes`, the maker of tiny worlds beside this."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parent))


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real multi-view sets; tests that need it skip where it is absent."""
    folder = Path(os.environ.get("HYRFPACK_DATA") or Path(__file__).parents[2] / "shared" / "data")
    if not folder.is_dir():
        pytest.skip(f"real data sets not found at {folder} (set HYRFPACK_DATA)")
    return folder

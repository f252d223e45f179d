"""Shared fixtures: where the real data sets are. Tests may also import `scenes`, beside this: tiny made-up worlds."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parent))

# OpenMP's threads spin while they wait and take the cores from the kernels' own: tiny pictures train 3 times slower on
# a quiet machine and 20 times on a busy one. Read once, when torch is loaded.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real multi-view sets; tests that need it skip where it is absent."""
    folder = Path(os.environ.get("HYRFPACK_DATA") or Path(__file__).parents[2] / "shared" / "data")
    if not folder.is_dir():
        pytest.skip(f"real data sets not found at {folder} (set HYRFPACK_DATA)")
    return folder

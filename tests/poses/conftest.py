"""A small set of photos with known poses, and what an estimation makes of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from made_up_photos import write_photos

import hyrfpack


@pytest.fixture(scope="session")
def taken(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, np.ndarray]]:
    """A folder of photos, not to be changed, and their poses by name."""
    folder = tmp_path_factory.mktemp("taken") / "photos"
    return folder, write_photos(folder)


@pytest.fixture(scope="session")
def posed(taken, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, hyrfpack.PosesReport, list, list]:
    """The scene made of them, not to be changed; the report; what was told of progress, and what was said."""
    told: list[tuple[str, float]] = []
    said: list[str] = []
    out = tmp_path_factory.mktemp("posed") / "scene"
    report = hyrfpack.estimate_poses(taken[0], out, report=lambda *now: told.append(now), say=said.append)
    return out, report, told, said

"""A small set of photos with known poses, and what an estimation makes of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from made_up_photos import write_photos

import hyrfpack


@pytest.fixture(scope="session")
def taken(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, np.ndarray]]:
    """A folder of photos, not to be changed, and their poses by name: names with spaces, any letters, and as long as
    files may have."""
    folder = tmp_path_factory.mktemp("taken") / "my photos"
    poses = write_photos(folder)
    names = {name: f"fähre ({number}).png" for number, name in enumerate(sorted(poses)[:-1])}
    names[max(poses)] = "x" * 251 + ".png"
    for name, new in names.items():
        (folder / name).rename(folder / new)
    return folder, {names[name]: pose for name, pose in poses.items()}


@pytest.fixture(scope="session")
def posed(taken, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, hyrfpack.PosesReport, list, list]:
    """The scene made of them, not to be changed; the report; what was told of progress, and what was said."""
    told: list[tuple[str, float]] = []
    said: list[str] = []
    out = tmp_path_factory.mktemp("posed") / "a scene"
    report = hyrfpack.estimate_poses(taken[0], out, report=lambda *now: told.append(now), say=said.append)
    return out, report, told, said

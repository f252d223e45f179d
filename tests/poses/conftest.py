"""Fixtures of a small set of photos with known poses, and the result of estimating its poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from made_up_photos import write_photos

import hyrfpack
from hyrfpack.context import RunContext
from hyrfpack.progress import Event


@pytest.fixture(scope="session")
def photos_and_poses(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, np.ndarray]]:
    """A folder of photos and their poses by name. Tests must not change it.

    The names have spaces, letters of any alphabet and the longest length that files may have.
    """
    folder = tmp_path_factory.mktemp("taken") / "my photos"
    poses = write_photos(folder)
    names = {name: f"fähre ({number}).png" for number, name in enumerate(sorted(poses)[:-1])}
    names[max(poses)] = "x" * 251 + ".png"
    for name, new in names.items():
        (folder / name).rename(folder / new)
    return folder, {names[name]: pose for name, pose in poses.items()}


@pytest.fixture(scope="session")
def estimated_scene(
    photos_and_poses, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, hyrfpack.PosesReport, list]:
    """The estimated scene, its report and the events that were reported. Tests must not change it."""
    progress: list[Event] = []
    out = tmp_path_factory.mktemp("posed") / "a scene"
    report = hyrfpack.estimate_poses(photos_and_poses[0], out, context=RunContext(progress=progress.append))
    return out, report, progress

"""New focal lengths: only pairs that were verified before are verified again, also after an interruption."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from made_up_photos import FOCAL_PIXELS, PHOTO_SIZE

import hyrfpack  # must come before pycolmap  # noqa: F401
from hyrfpack.poses.database import create_database, open_database, read_cameras, recalibrate, verified_pairs
from hyrfpack.poses.job import Device, Job
from hyrfpack.progress import ignore_progress

pycolmap = pytest.importorskip("pycolmap")


def make_job(folder: Path) -> Job:
    """Return a job with two overlapping photos of a random cloud of points, and a third with random matches."""
    folder.mkdir()
    names = ("a.png", "b.png", "c.png")
    job = Job(folder, folder, names, (Device(PHOTO_SIZE, FOCAL_PIXELS),), (0, 0, 0), {}, "exhaustive", 0)
    create_database(job)
    rng = np.random.default_rng(0)
    points = rng.uniform((-1, -1, 4), (1, 1, 8), (60, 3))
    centre, matches = np.array(PHOTO_SIZE) / 2, np.column_stack([np.arange(60)] * 2).astype(np.uint32)
    with open_database(job) as database:
        for number in (1, 2):
            seen = points + (0.5 * number, 0.0, 0.1 * number)
            database.write_keypoints(number, (FOCAL_PIXELS * seen[:, :2] / seen[:, 2:] + centre).astype(np.float32))
        database.write_keypoints(3, rng.uniform(0, PHOTO_SIZE, (60, 2)).astype(np.float32))
        database.write_matches(1, 2, matches)
        for first in (1, 2):  # so few that no geometry has enough inliers by chance
            database.write_matches(first, 3, matches[:16])
    pycolmap.geometric_verification(job.database_path)
    assert pairs_in(job) == [(1, 2)]
    return job


def pairs_in(job: Job) -> list[tuple[int, int]]:
    with open_database(job) as database:
        return [(first, second) for first, second, _ in verified_pairs(database)]


def test_pairs_that_failed_are_not_verified_again(tmp_path):
    job = make_job(tmp_path / "work")
    with open_database(job) as database:
        database.delete_two_view_geometry(1, 3)
        failed = pycolmap.TwoViewGeometry()
        failed.config = int(pycolmap.TwoViewGeometryConfiguration.DEGENERATE)
        failed.inlier_matches = np.zeros((7, 2), np.uint32)  # no verification of these matches would give this count
        database.write_two_view_geometry(1, 3, failed)
    assert recalibrate(job, "step", better_cameras, ignore_progress)
    assert pairs_in(job) == [(1, 2)]
    with open_database(job) as database:
        assert len(database.read_two_view_geometry(1, 3).inlier_matches) == 7
        assert database.exists_two_view_geometry(1, 2)


def better_cameras(cameras: dict[int, pycolmap.Camera]) -> dict[int, pycolmap.Camera]:
    cameras[1].focal_length *= 1.02
    return cameras


def test_a_recalibration_that_was_interrupted_is_completed(tmp_path, monkeypatch):
    job = make_job(tmp_path / "work")

    def interrupt(*arguments: object, **options: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(pycolmap, "geometric_verification", interrupt)
        recalibrate(job, "step", better_cameras, ignore_progress)
    assert pairs_in(job) == []
    assert recalibrate(job, "step", better_cameras, ignore_progress)
    assert pairs_in(job) == [(1, 2)]
    with open_database(job) as database:
        assert read_cameras(database)[1].focal_length == pytest.approx(1.02 * FOCAL_PIXELS)

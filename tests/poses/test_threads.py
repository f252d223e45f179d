"""HYRFPACK_THREADS limits the threads of pose estimation."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from made_up_photos import FOCAL_PIXELS, PHOTO_SIZE, write_photos

import hyrfpack  # must come before pycolmap  # noqa: F401
from hyrfpack.data.folder import list_photos
from hyrfpack.poses import features, prepare
from hyrfpack.poses.database import recalibrate
from hyrfpack.poses.job import Device, Job
from hyrfpack.poses.matching import match_photos
from hyrfpack.progress import ignore_progress

pycolmap = pytest.importorskip("pycolmap")

THREAD_COUNT = 3


@pytest.fixture
def recorded_threads(monkeypatch) -> dict[str, set[int | None]]:
    """Set HYRFPACK_THREADS, and record the threads of each pool and of each function of pycolmap that has many."""
    monkeypatch.setenv("HYRFPACK_THREADS", str(THREAD_COUNT))
    found: dict[str, set[int | None]] = {}

    def record(name: str, options_type: type) -> None:
        function = getattr(pycolmap, name)

        def recorded(*arguments, **settings):
            options = [value for value in (*arguments, *settings.values()) if isinstance(value, options_type)]
            found.setdefault(name, set()).update(value.num_threads for value in options or [options_type()])
            return function(*arguments, **settings)

        monkeypatch.setattr(pycolmap, name, recorded)

    def make_pool(max_workers: int | None = None) -> ThreadPoolExecutor:
        found.setdefault("pools", set()).add(max_workers)
        return ThreadPoolExecutor(max_workers)

    record("extract_features", pycolmap.FeatureExtractionOptions)
    record("match_image_pairs", pycolmap.FeatureMatchingOptions)
    record("geometric_verification", pycolmap.GeometricVerifierOptions)
    for module in (features, prepare):
        monkeypatch.setattr(module, "ThreadPoolExecutor", make_pool)
    return found


@pytest.mark.acceptance
def test_the_number_of_threads_is_that_of_the_environment(recorded_threads, tmp_path: Path):
    names = list(write_photos(tmp_path / "images", 3))
    photos, _ = prepare.read_headers(tmp_path / "images", list_photos(tmp_path / "images"), in_place=False)
    prepare.make_images(photos, tmp_path / "copies")
    (tmp_path / "work").mkdir()
    devices = (Device(PHOTO_SIZE, FOCAL_PIXELS),)
    job = Job(tmp_path / "images", tmp_path / "work", tuple(names), devices, (0, 0, 0), {}, "exhaustive", 0)
    features.find_features(job, ignore_progress)
    match_photos(job, ignore_progress)
    recalibrate(job, "step", lambda cameras: cameras, ignore_progress)
    assert recorded_threads == {
        name: {THREAD_COUNT} for name in ("pools", "extract_features", "match_image_pairs", "geometric_verification")
    }

"""A kernel is compiled and runs wherever its machine code can or cannot be kept."""

from __future__ import annotations

import numba
import pytest
from numba.core.caching import CompileResultCacheImpl

from hyrfpack.parallel.compiled import compiled


def twice(x):
    return 2 * x


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    return tmp_path


def kept(folder):
    return sorted(path.suffix for path in folder.rglob("*") if path.is_file())


def test_machine_code_is_kept_and_found_again(folder):
    assert compiled()(twice)(21) == 42
    assert kept(folder) == [".nbc", ".nbi"]
    again = compiled()(twice)
    assert again(21) == 42 and sum(again.stats.cache_hits.values()) == 1


def test_full_disk_is_no_reason_to_stop_and_leaves_no_index_without_its_code(folder):
    """The index is small and is written first; the code after it does not fit any more."""
    resource = pytest.importorskip("resource")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, limits[1]))
    try:
        assert compiled()(twice)(21) == 42
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert kept(folder) == []


def test_nowhere_to_keep_machine_code_is_no_reason_to_stop(monkeypatch):
    monkeypatch.setattr(CompileResultCacheImpl, "_locator_classes", [])
    assert compiled()(twice)(21) == 42

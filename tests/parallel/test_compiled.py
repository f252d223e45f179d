"""A kernel compiles and runs whether or not its machine code can be cached on disk."""

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


def cached_suffixes(folder):
    return sorted(path.suffix for path in folder.rglob("*") if path.is_file())


def test_machine_code_is_cached_and_loaded_again(folder):
    assert compiled()(twice)(21) == 42
    assert cached_suffixes(folder) == [".nbc", ".nbi"]
    again = compiled()(twice)
    assert again(21) == 42 and sum(again.stats.cache_hits.values()) == 1


def test_a_kernel_runs_on_a_full_disk_and_leaves_no_index_without_its_code(folder):
    """The small index is written first; the code that follows exceeds the limit."""
    resource = pytest.importorskip("resource")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, limits[1]))
    try:
        assert compiled()(twice)(21) == 42
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert cached_suffixes(folder) == []


def test_a_kernel_runs_without_a_cache_folder(monkeypatch):
    monkeypatch.setattr(CompileResultCacheImpl, "_locator_classes", [])
    assert compiled()(twice)(21) == 42

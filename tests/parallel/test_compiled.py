"""A kernel compiles and runs whether or not its machine code can be cached on disk."""

from __future__ import annotations

import importlib
import sys

import numba
import pytest
from numba.core.caching import CompileResultCacheImpl, FunctionCache

from hyrfpack.parallel.compiled import _source_digest, can_cache_kernels, compiled


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


def import_anew(module):
    """Import a module as a new process does."""
    for name in [name for name in sys.modules if name.split(".")[0] == module.split(".")[0]]:
        del sys.modules[name]
    _source_digest.cache_clear()
    return importlib.import_module(module)


def test_machine_code_is_compiled_again_after_a_change_of_a_constant_in_another_module(folder, monkeypatch):
    package = folder / "example_of_kernels" / "ops"
    package.mkdir(parents=True)
    (package / "limits.py").write_text("LIMIT = 1\n")
    (package / "kernel.py").write_text(
        "from example_of_kernels.ops.limits import LIMIT\n"
        "from hyrfpack.parallel.compiled import compiled\n\n\n"
        "@compiled()\ndef limit():\n    return LIMIT\n"
    )
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    assert import_anew("example_of_kernels.ops.kernel").limit() == 1
    again = import_anew("example_of_kernels.ops.kernel").limit
    assert again() == 1 and sum(again.stats.cache_hits.values()) == 1

    (package / "limits.py").write_text("LIMIT = 2\n")

    assert import_anew("example_of_kernels.ops.kernel").limit() == 2


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


def test_kernels_are_not_cached_by_a_numba_that_stamps_them_in_another_way(folder, monkeypatch):
    class OtherCacheFile:
        pass

    def open_other(cache, function):
        cache._cache_file = OtherCacheFile()

    monkeypatch.setattr(FunctionCache, "__init__", open_other)
    assert not can_cache_kernels()
    assert compiled()(twice)(21) == 42 and cached_suffixes(folder) == []

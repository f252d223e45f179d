"""In a home folder that cannot be written, as in many containers, the command line prints one note and continues."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from commands import succeeded
from numba.core.caching import CompileResultCacheImpl

from hyrfpack.cache_folder import open_cache_folder

COMPACT_GOLDEN_FILE = Path(__file__).parent / "golden" / "v1.1_compact.hyrf"
CACHE_FOLDER_VARIABLES = ("MPLCONFIGDIR", "XDG_CACHE_HOME", "XDG_CONFIG_HOME")


@pytest.mark.parametrize("room", [True, False])
def test_a_command_says_once_that_kernels_cannot_be_cached_and_how_to_change_that(room, tmp_path, monkeypatch):
    if not room:
        monkeypatch.setattr(CompileResultCacheImpl, "_locator_classes", [])
    messages = succeeded("decompress", COMPACT_GOLDEN_FILE, "-o", tmp_path / "raw.hyrf").stderr
    assert messages.count("NUMBA_CACHE_DIR") == messages.count("MPLCONFIGDIR") == (0 if room else 1)


def test_the_library_prints_no_note_about_the_cache(tmp_path):
    code = (
        "import logging\n"
        "from numba.core.caching import CompileResultCacheImpl\n"
        "CompileResultCacheImpl._locator_classes = []\n"
        "import hyrfpack\n"
        f"hyrfpack.load_model({str(COMPACT_GOLDEN_FILE)!r})\n"
        "from hyrfpack.evaluate.figures import draw_training_curve\n"
        "draw_training_curve([{'step': 1, 'psnr': 20.0, 'loss': 0.1, 'gaussians': 1}], 'curve.png')\n"
        "assert logging.getLogger('matplotlib').getEffectiveLevel() == logging.WARNING"
    )
    environment = {name: value for name, value in os.environ.items() if name not in CACHE_FOLDER_VARIABLES}
    environment |= {"HOME": os.devnull + "/none", "PYTHONPATH": str(Path(__file__).parents[1])}
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "curve.png").is_file()


@pytest.mark.parametrize("home", ["~", "relative/caches"])
def test_without_a_known_home_the_cache_is_in_the_temporary_folder(home, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(os.path, "expanduser", lambda _: home)
    monkeypatch.setattr(tempfile, "gettempdir", lambda: str(tmp_path / "temporary"))
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)

    folder = open_cache_folder("archives")

    assert folder.parent.parent == tmp_path / "temporary"
    assert [path.name for path in tmp_path.iterdir()] == ["temporary"]


def test_a_relative_cache_folder_is_ignored(tmp_path, monkeypatch):
    monkeypatch.setattr(os.path, "expanduser", lambda _: str(tmp_path))
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", "caches")
    assert open_cache_folder("archives") == tmp_path / ".cache" / "hyrfpack" / "archives"

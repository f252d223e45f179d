"""A home that cannot be written, as in many containers: one line says what it costs, and nothing else does."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from commands import succeeded
from numba.core.caching import CompileResultCacheImpl

PACKED = Path(__file__).parent / "golden" / "v1.1_compact.hyrf"
HOMES = ("MPLCONFIGDIR", "XDG_CACHE_HOME", "XDG_CONFIG_HOME")


@pytest.mark.parametrize("room", [True, False])
def test_a_command_says_once_that_kernels_cannot_be_kept_and_where_they_could(room, tmp_path, monkeypatch):
    if not room:
        monkeypatch.setattr(CompileResultCacheImpl, "_locator_classes", [])
    told = succeeded("decompress", PACKED, "-o", tmp_path / "raw.hyrf").stderr
    assert told.count("NUMBA_CACHE_DIR") == told.count("MPLCONFIGDIR") == (0 if room else 1)


def test_the_library_says_nothing_of_it(tmp_path):
    code = (
        "import logging\n"
        "from numba.core.caching import CompileResultCacheImpl\n"
        "CompileResultCacheImpl._locator_classes = []\n"
        "import hyrfpack\n"
        f"hyrfpack.load({str(PACKED)!r})\n"
        "from hyrfpack.evaluate.figures import draw_training_curve\n"
        "draw_training_curve([{'step': 1, 'psnr': 20.0, 'loss': 0.1, 'gaussians': 1}], 'curve.png')\n"
        "assert logging.getLogger('matplotlib').getEffectiveLevel() == logging.WARNING"
    )
    environment = {name: value for name, value in os.environ.items() if name not in HOMES}
    environment |= {"HOME": os.devnull + "/none", "PYTHONPATH": str(Path(__file__).parents[1])}
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "curve.png").is_file()

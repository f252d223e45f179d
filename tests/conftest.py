"""Shared fixtures: photos, programs under node. Tests may also import what lies beside this (`scenes`, tiny made-up
worlds; `commands`), and what `tools` has."""

from __future__ import annotations

import gc
import json
import os
import shutil
import signal
import subprocess
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

# OpenMP's threads spin while they wait and take the cores from the kernels' own: tiny pictures train 3 times slower on
# a quiet machine and 20 times on a busy one. Read once, when torch is loaded.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

# Tests side by side have all cores busy; those of threads ask for more. On such small pictures as theirs a second
# thread takes a fifth more time.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("HYRFPACK_THREADS", "1")
    os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch

# Without a GPU its kernels run in Triton's interpreter. Read once, when they are defined.
os.environ.setdefault("TRITON_INTERPRET", "0" if torch.cuda.is_available() else "1")
if os.environ["TRITON_INTERPRET"] == "1" and find_spec("triton"):
    from interpreter import patch_once

    patch_once()

from ops.device import needs_triton  # not before: it asks for Triton, which reads the environment


def pytest_itemcollected(item: pytest.Item) -> None:
    """Marks what runs kernels of the GPU, so that a machine with one can choose that alone."""
    if needs_triton.mark in item.iter_markers():
        item.add_marker("gpu")


# Until all tests are collected, nothing becomes garbage, and looking for it takes a third of the time.
gc.disable()


def pytest_collection_finish() -> None:
    gc.freeze()
    gc.enable()


@pytest.fixture(scope="session", autouse=True)
def no_warming() -> None:
    """No test reads a clock, so none waits for the machine to warm up."""
    from hyrfpack.measure import timing

    timing.WARM_UP_SECONDS = 0


@pytest.fixture
def signals() -> Iterator[None]:
    """Signals do what they do in a terminal, here and in programs started from here.

    Whoever started the tests may have had some ignored, as nohup and the background of a script do.
    """
    usual = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}
    if hasattr(signal, "SIGHUP"):
        usual[signal.SIGHUP] = signal.SIG_DFL
    before = {number: signal.signal(number, handler) for number, handler in usual.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture
def short_imports(monkeypatch: pytest.MonkeyPatch) -> None:
    """As little work of an import as still makes a model."""
    from hyrfpack.distill import initialize, pack

    monkeypatch.setattr(initialize, "MIN_STEPS", 100)
    monkeypatch.setattr(pack, "MAX_TRIALS", 2)


@pytest.fixture(scope="session")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten small photos of the demo's scene, with poses; not to be changed."""
    from hyrfpack.demo.scene import write_demo_scene

    return write_demo_scene(tmp_path_factory.mktemp("data"), views=10, size=48)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real multi-view sets; tests that need it skip where it is absent."""
    folder = Path(os.environ.get("HYRFPACK_DATA") or Path(__file__).parents[2] / "shared" / "data")
    if not folder.is_dir():
        pytest.skip(f"real data sets not found at {folder} (set HYRFPACK_DATA)")
    return folder


@pytest.fixture(scope="session")
def node() -> Callable[..., Any]:
    """Runs a script of tests/node with arguments; returns the last line it prints, which is JSON."""
    program, folder = shutil.which("node"), Path(__file__).parent / "node"
    if program is None:
        pytest.skip("node is not on this machine")
    if not (folder / "node_modules").is_dir():
        pytest.skip("node's packages are not installed (npm ci --prefix tests/node)")

    def run(script: str, *arguments: object) -> Any:
        command = [program, str(folder / script), *map(str, arguments)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout.splitlines()[-1])

    return run

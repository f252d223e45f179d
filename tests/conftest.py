"""Fixtures shared by all tests: photos, scripts that run under node, signal handling.

Tests may also import the helper modules in this folder (`scenes` with small synthetic scenes, `commands`) and `tools`.
"""

from __future__ import annotations

import gc
import json
import logging
import os
import shutil
import signal
import subprocess
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import nullcontext
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

# OpenMP's threads spin while they wait and take the cores from the kernels' own threads: tiny pictures train 3 times
# slower on a quiet machine and 20 times slower on a busy one. OpenMP reads this once, when torch is loaded.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

# Parallel test workers keep all cores busy. Tests of threads set their own number. On such small pictures a second
# thread takes a fifth more time.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("HYRFPACK_THREADS", "1")
    os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch

# Without a GPU the kernels run in Triton's interpreter. Triton reads this once, when the kernels are defined.
os.environ.setdefault("TRITON_INTERPRET", "0" if torch.cuda.is_available() else "1")
if os.environ["TRITON_INTERPRET"] == "1" and find_spec("triton"):
    from interpreter import fill_new_memory_with_nan, speed_up_interpreter

    speed_up_interpreter()
    fill_new_memory_with_nan()

if "PYTEST_XDIST_WORKER" in os.environ:
    from shared_kernels import compile_kernels_once

    compile_kernels_once()

from hang_watchdog import HangWatchdog
from layers import forbid_training_and_processes, layer_of
from ops.device import needs_triton  # this import asks for Triton, which reads the environment set above
from property_tests import use_profile

from hyrfpack.atomic import write_atomic
from hyrfpack.evaluate.figures import figure_to_svg


def pytest_configure(config: pytest.Config) -> None:
    """End tests that hang. Draw fewer examples of property tests without acceptance tests, as in `make test`."""
    config.pluginmanager.register(HangWatchdog())
    use_profile("quick" if "not acceptance" in config.option.markexpr else "complete")


def pytest_itemcollected(item: pytest.Item) -> None:
    """Mark each test with its layer, and those that run GPU kernels with `gpu`, so that `-m` can select them."""
    if needs_triton.mark in item.iter_markers():
        item.add_marker("gpu")
    item.add_marker(layer_of(item))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Make training and the start of processes an error in unit tests and their fixtures."""
    with forbid_training_and_processes() if layer_of(item) == "unit" else nullcontext():
        return (yield)


# Until all tests are collected nothing becomes garbage, and the garbage collector takes a third of the time.
gc.disable()


def pytest_collection_finish() -> None:
    gc.freeze()
    gc.enable()
    capture_library_log_messages()


def capture_library_log_messages() -> None:
    """Let `caplog` capture the library's log messages from level INFO on.

    pytest's option `log_level` would set the level three times a test. It also adds its handlers to each logger that
    does not propagate, of which torch has dozens. Both take 2 ms a test.
    """
    root = logging.getLogger()
    root.setLevel(logging.INFO)
    for logger in root.manager.loggerDict.values():
        if isinstance(logger, logging.Logger):
            logger.propagate = True


@pytest.fixture(scope="session", autouse=True)
def skip_timing_warm_up() -> None:
    """Skip the warm-up of timings, because no test reads a clock."""
    from hyrfpack.measure import timing

    timing.WARM_UP_SECONDS = 0


@pytest.fixture(scope="session", autouse=True)
def skip_waiting_for_the_disk() -> Iterator[None]:
    """Skip fsync, because no test cuts the power. Tests of its place in the order of writes replace it themselves."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda descriptor: None)
        yield


@pytest.fixture(scope="session", autouse=True)
def skip_drawing_curves() -> Iterator[None]:
    """Write a white pixel as the curve of a training run, because drawing it takes as long as the run of a test."""

    def write_pixel(records: Sequence[dict], path: Path, *, overwrite: bool = True) -> Path:
        pixel = BytesIO()
        Image.new("RGB", (1, 1), "white").save(pixel, "png")
        return write_atomic(path, pixel.getvalue(), overwrite=overwrite)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hyrfpack.train.results.draw_training_curve", write_pixel)
        yield


@pytest.fixture(scope="session", autouse=True)
def skip_drawing_figures() -> Iterator[None]:
    """Embed an empty figure in the pages of reports, because drawing one takes as long as all else in a page."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hyrfpack.report.page.figure_to_svg", lambda figure: '<svg xmlns="http://www.w3.org/2000/svg"/>')
        yield


@pytest.fixture
def drawn_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw the figures of reports in this test."""
    monkeypatch.setattr("hyrfpack.report.page.figure_to_svg", figure_to_svg)


@pytest.fixture
def quick_distances(monkeypatch: pytest.MonkeyPatch) -> None:
    """Measure distances between meshes at a tenth of the points."""
    monkeypatch.setattr("hyrfpack.mesh.solid.DISTANCE_POINTS", 2_000)
    monkeypatch.setattr("hyrfpack.mesh.solid.DISTANCE_SAMPLES", 20_000)


@pytest.fixture
def signals() -> Iterator[None]:
    """Set the default signal handlers of a terminal, in this process and in programs started from it.

    The process that started the tests may ignore some signals, as nohup and a script's background jobs do.
    """
    usual = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}
    if hasattr(signal, "SIGHUP"):
        usual[signal.SIGHUP] = signal.SIG_DFL
    before = {number: signal.signal(number, handler) for number, handler in usual.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture
def quick_import(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reduce the viewpoints and files of an import of splats to the least that still makes a model.

    Most small splats cover too little of every picture, so that an import would try all candidates.
    """
    from hyrfpack.imports import pack, prepare
    from hyrfpack.splats import viewpoints

    monkeypatch.setattr(viewpoints, "CANDIDATES_PER_CAMERA", 1)
    monkeypatch.setattr(pack, "MAX_TRIALS", 2)
    monkeypatch.setattr(prepare, "LIGHT_MEASUREMENT_VIEWS", 8)
    monkeypatch.setattr(prepare, "VALIDATION_VIEWS_PER_TEST_VIEW", 1)


@pytest.fixture
def quick_scores(monkeypatch: pytest.MonkeyPatch) -> None:
    """Score exports and conversions of splats in two small views."""
    monkeypatch.setattr("hyrfpack.export.source.MAX_MEASURED_VIEWS", 2)
    monkeypatch.setattr("hyrfpack.export.conversion.MEASURED_VIEWS", 2)
    monkeypatch.setattr("hyrfpack.export.conversion.MEASURED_SIZE_PIXELS", 64)


@pytest.fixture(scope="module")
def quick_calibration() -> Iterator[None]:
    """Measure sensitivities of profile "compact" in few small views and correct them once, in all tests of a module."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hyrfpack.compress.sensitivity.MAX_SENSITIVITY_VIEWS", 8)
        patch.setattr("hyrfpack.compress.reference_renders.MIN_COMPARISON_VIEWS", 4)
        patch.setattr("hyrfpack.compress.reference_renders.MAX_COMPARISON_VIEWS", 4)
        patch.setattr("hyrfpack.compress.calibrate.MAX_CORRECTION_ROUNDS", 1)
        yield


@pytest.fixture(scope="session")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of ten small photos of the demo scene, with poses. Tests must not change it.

    The golden model of the demo scene is trained on the same photos.
    """
    from tools.safety.train_golden import write_demo_photos

    return write_demo_photos(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real multi-view sets. Tests that need it skip where it is absent."""
    folder = Path(os.environ.get("HYRFPACK_DATA") or Path(__file__).parents[2] / "shared" / "data")
    if not folder.is_dir():
        pytest.skip(f"real data sets not found at {folder} (set HYRFPACK_DATA)")
    return folder


@pytest.fixture(scope="session")
def node() -> Callable[..., Any]:
    """A function that runs a script of tests/node with arguments and returns its last output line, parsed as JSON."""
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

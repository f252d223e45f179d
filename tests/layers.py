"""The layer of each test, which decides when it runs.

- `unit` tests train nothing and start no process.
- `integration` tests may train on tiny scenes, run commands and start short scripts.
- `acceptance` tests run browsers, several processes, kills, compilers and maintainers' tools, and further cases of
  slow tests, of which the other layers run those that differ most.

`make test` runs the first two and those acceptance tests that have the mark `smoke`, too: a thin slice with browsers,
several processes and a kill. `make test-all` runs everything. A mark at the test or its module decides on the layer;
otherwise a test that opens a browser is an acceptance test, and the longest matching path below decides for the others.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Container, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from multiprocessing.process import BaseProcess
from pathlib import Path
from unittest.mock import patch

import pytest

from hyrfpack.train.trainer import Trainer

LAYERS = ("unit", "integration", "acceptance")
BROWSER_FIXTURES = {"browser", "browser_reader", "one_browser", "start_browser"}
TESTS_FOLDER = Path(__file__).parent
LAYER_BY_PATH = {
    "": "integration",
    "blocks/test_merge.py": "unit",
    "blocks/test_plan.py": "unit",
    "blocks/test_processes.py": "acceptance",
    "cameras": "unit",
    "cli/test_processes.py": "acceptance",
    "compress/test_determinism.py": "acceptance",
    "config": "unit",
    "data": "unit",
    "evaluate": "unit",
    "format": "unit",
    "fuzz": "unit",
    "independent/test_gsply.py": "acceptance",
    "measure": "unit",
    "model": "unit",
    "ops": "unit",
    "ops/test_cold_kernels.py": "acceptance",
    "outputs": "unit",
    "parallel/test_fork.py": "acceptance",
    "parallel/test_ranks.py": "acceptance",
    "poses/test_interruptions.py": "acceptance",
    "progress": "unit",
    "quant": "unit",
    "render": "unit",
    "splats": "unit",
    "test_architecture.py": "unit",
    "test_choices.py": "unit",
    "test_context.py": "unit",
    "test_errors.py": "unit",
    "test_examples.py": "acceptance",
    "test_no_home.py": "acceptance",
    "test_package.py": "acceptance",
    "test_public.py": "acceptance",
    "test_pycolmap.py": "acceptance",
    "test_scene.py": "unit",
    "test_site.py": "acceptance",
    "tools": "acceptance",
    "train/test_advice.py": "unit",
    "train/test_distributed.py": "acceptance",
}


def only_in_acceptance(values: Iterable, slow: Container) -> list:
    """Return parameters of a test, those in `slow` with the mark `acceptance`."""
    return [pytest.param(value, marks=[pytest.mark.acceptance] if value in slow else []) for value in values]


def layer_of(item: pytest.Item) -> str:
    """Return the layer of a test, one of LAYERS."""
    for mark in item.iter_markers():  # the closest mark comes first, so a test can differ from its module
        if mark.name in LAYERS:
            return mark.name
    if BROWSER_FIXTURES & set(getattr(item, "fixturenames", ())):
        return "acceptance"
    return _layer_of_file(item.path)


@cache
def _layer_of_file(path: Path) -> str:
    name = path.relative_to(TESTS_FOLDER).as_posix()
    return LAYER_BY_PATH[max((prefix for prefix in LAYER_BY_PATH if name.startswith(prefix)), key=len)]


@contextmanager
def forbid_training_and_processes() -> Iterator[None]:
    """Make training and the start of processes an error, in the tests of the layer `unit`.

    Where kernels are compiled for a GPU and not interpreted, processes are allowed, because Triton starts compilers.
    """

    def refuse(*arguments: object, **options: object) -> None:
        raise AssertionError("a unit test trains or starts a process: give it the mark of another layer")

    with ExitStack() as stack:
        if os.environ.get("TRITON_INTERPRET") == "1":
            stack.enter_context(patch.object(subprocess.Popen, "__init__", refuse))
        if hasattr(os, "fork"):
            stack.enter_context(patch.object(os, "fork", refuse))
        stack.enter_context(patch.object(BaseProcess, "start", refuse))
        stack.enter_context(patch.object(Trainer, "run", refuse))
        yield

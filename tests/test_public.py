"""What `import hyrfpack` gives: functions and classes, for people, editors, type checkers and other processes."""

from __future__ import annotations

import ast
import inspect
import pickle
import pydoc
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from importlib import import_module
from importlib.resources import files
from multiprocessing import get_context
from pathlib import Path

import pytest

import hyrfpack

FUNCTIONS = [name for name in hyrfpack.__all__ if inspect.isfunction(getattr(hyrfpack, name))]
# Calls that are refused at once, by the function itself.
REFUSED = {
    "bench": ("missing.hyrf",),
    "compress": ("missing.hyrf", "out.hyrf"),
    "describe": ("missing.hyrf",),
    "distill": ("missing.ply", "out.hyrf"),
    "export": ("missing.hyrf", "out.spz"),
    "load": ("missing.hyrf",),
    "load_scene": ("missing",),
}


def fresh(code: str) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parents[1], capture_output=True, text=True)


def test_what_does_something_is_a_function():
    assert set(FUNCTIONS) == {*REFUSED, "evaluate", "render", "save", "train"}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_function_tells_its_arguments_and_what_it_does(name):
    function = getattr(hyrfpack, name)
    parameters = inspect.signature(function).parameters.values()
    assert "args" not in [parameter.name for parameter in parameters]
    assert all(parameter.annotation is not parameter.empty for parameter in parameters)
    assert "Args:" in function.__doc__ or "Arguments" in function.__doc__ or "Raises:" in function.__doc__
    assert pydoc.render_doc(function).startswith(f"Python Library Documentation: function {name} in module")


@pytest.mark.parametrize("name", [name for name in hyrfpack.__all__ if name != "__version__"])
def test_a_public_name_can_be_pickled(name):
    value = getattr(hyrfpack, name)
    assert pickle.loads(pickle.dumps(value)) is value


def test_functions_can_be_called_in_processes_that_are_spawned():
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        calls = {name: pool.submit(getattr(hyrfpack, name), *arguments) for name, arguments in REFUSED.items()}
        calls["evaluate"] = pool.submit(hyrfpack.evaluate, None, [])
        for name, call in calls.items():
            assert isinstance(call.exception(), (hyrfpack.HyrfError, TypeError)), name


def test_sub_packages_can_be_imported_from_in_every_way():
    code = (
        "import hyrfpack.train.progress as progress, hyrfpack.train as t, hyrfpack.evaluate\n"
        "from hyrfpack.train import Trainer, progress as again\n"
        "import hyrfpack.render.paths, sys\n"
        "assert progress is again is sys.modules['hyrfpack.train.progress'] is hyrfpack.train.progress\n"
        "assert t is hyrfpack.train is sys.modules['hyrfpack.train'].train\n"
        "assert t.Trainer is Trainer and hyrfpack.render.paths.orbit\n"
        "progress.LOG_EVERY = 7\n"
        "assert hyrfpack.train.progress.LOG_EVERY == 7\n"
        "try: hyrfpack.nothing\n"
        "except AttributeError: print('and nothing else')"
    )
    assert fresh(code).stdout == "and nothing else\n", fresh(code).stderr


def test_type_checkers_see_the_public_names_and_nothing_else():
    nodes = [node for node in ast.parse(inspect.getsource(hyrfpack)).body if isinstance(node, ast.If)]
    (block,) = [node for node in nodes if ast.unparse(node.test) == "TYPE_CHECKING"]
    told = {}
    for statement in block.body:
        for alias in statement.names:
            assert alias.name == alias.asname, "what is not imported under its own name again is private"
            told[alias.name] = statement.module
    assert {"__version__", *told} == set(hyrfpack.__all__)
    for name, module in told.items():
        assert getattr(import_module(module), name) is getattr(hyrfpack, name)
    assert files("hyrfpack").joinpath("py.typed").is_file()

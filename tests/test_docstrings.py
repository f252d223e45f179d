"""Every public function has an example in its docstring, and the example gives what it shows."""

from __future__ import annotations

import doctest
import importlib
import inspect
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from made_up_photos import write_photos

import hyrfpack
from hyrfpack import quant
from hyrfpack.train import load_training_scene

pytestmark = pytest.mark.usefixtures("quick_calibration")
DOCUMENTED_OPERATIONS = (
    "activate", "adam", "background", "composite", "contraction", "hash_encode", "mlp", "rasterize", "shade", "ssim",
)  # fmt: skip
# These functions are not for users. `background_grid` and `shade` take a whole decoder, which no short example makes.
FUNCTIONS_WITHOUT_EXAMPLE = {
    "background_colors", "background_grid", "check_shading", "choose_shading_implementation", "shade",
}  # fmt: skip


def list_public_functions() -> Iterator[tuple[str, object]]:
    for name in hyrfpack.__all__:
        if inspect.isfunction(getattr(hyrfpack, name)):
            yield f"hyrfpack.{name}", getattr(hyrfpack, name)
    yield "hyrfpack.train.load_training_scene", load_training_scene
    modules = [importlib.import_module(f"hyrfpack.ops.{name}") for name in DOCUMENTED_OPERATIONS]
    operations = {f"{m.__name__}.{name}": value for m in modules for name, value in vars(m).items()}
    coders = {f"{quant.__name__}.{name}": getattr(quant, name) for name in quant.__all__}
    for name, value in {**operations, **coders}.items():
        module, _, short = name.rpartition(".")
        here = value.__module__ == module or module == quant.__name__ if inspect.isfunction(value) else False
        if here and not short.startswith("_") and short not in FUNCTIONS_WITHOUT_EXAMPLE:
            yield name, value


PUBLIC_FUNCTIONS = dict(list_public_functions())
# Tests of their packages call these in the integration layer, on less than the examples need.
SLOW_EXAMPLES = {
    "hyrfpack.benchmark_model", "hyrfpack.compare_runs", "hyrfpack.compress_model", "hyrfpack.edit_model",
    "hyrfpack.estimate_poses", "hyrfpack.import_splats", "hyrfpack.select_levels", "hyrfpack.split_model",
    "hyrfpack.train_blocks", "hyrfpack.train_model",
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, data: Path) -> Path:
    """The folder in which the examples run, with photos, photos with poses, a short run, its packed file and splats."""
    root = tmp_path_factory.mktemp("examples")
    (root / "photos").mkdir()
    (root / "photos" / "bonsai").symlink_to(data)
    write_photos(root / "photos" / "corner", 5)
    scene = hyrfpack.load_scene(data)
    hyrfpack.train_model(
        scene,
        root / "runs" / "bonsai",
        hyrfpack.TrainConfig(steps=6, max_gaussians=100),
        context=hyrfpack.RunContext(progress=None),
    )
    shutil.copytree(root / "runs" / "bonsai", root / "runs" / "again")
    hyrfpack.compress_model(root / "runs" / "bonsai" / "model.hyrf", root / "bonsai.hyrf")
    hyrfpack.export_model(root / "bonsai.hyrf", root / "bonsai.ply", hyrfpack.ExportConfig(degree=0, background=False))
    return root


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.acceptance] if name in SLOW_EXAMPLES else []) for name in PUBLIC_FUNCTIONS],
)
def test_the_example_of_a_public_function_runs(name, folder, monkeypatch, capsys):
    function = PUBLIC_FUNCTIONS[name]
    known = {**vars(inspect.getmodule(function)), "np": np, "torch": torch}
    found = doctest.DocTestFinder(recurse=False).find(function, name, globs=known)
    examples = [example for test in found for example in test.examples]
    partner = name.replace("decode", "encode").replace("unpack", "pack")
    assert examples or (partner != name and ">>>" in PUBLIC_FUNCTIONS[partner].__doc__), f"{name} has no example"
    monkeypatch.chdir(folder)
    runner = doctest.DocTestRunner(verbose=False)
    for test in found:
        runner.run(test, clear_globs=False)
    assert runner.failures == 0, capsys.readouterr().out

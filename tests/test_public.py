"""The names that `import hyrfpack` gives work for people, editors, type checkers and other processes."""

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
import torch
from scenes import ball_scene, small_model

import hyrfpack
from hyrfpack.config.edit import Center

PUBLIC_FUNCTIONS = [name for name in hyrfpack.__all__ if inspect.isfunction(getattr(hyrfpack, name))]
# Arguments that each function rejects at once.
REJECTED_ARGUMENTS = {
    "benchmark_model": ("missing.hyrf",),
    "compare_runs": (["missing", "other"], "out.html"),
    "compress_model": ("missing.hyrf", "out.hyrf"),
    "convert_splats": ("missing.ply", "out.spz"),
    "describe_file": ("missing.hyrf",),
    "diagnose_machine": ("missing",),
    "describe_photos": ("missing",),
    "edit_model": ("missing.hyrf", "out.hyrf", [Center()]),
    "import_splats": ("missing.ply", "out.hyrf"),
    "estimate_poses": ("missing", "out"),
    "export_model": ("missing.hyrf", "out.spz"),
    "load_merged_model": ("missing.hyrf",),
    "load_model": ("missing.hyrf",),
    "load_scene": ("missing",),
    "make_scene": ("missing", "out.html"),
    "merge_models": (["missing.hyrf"], "out.hyrf"),
    "split_model": ("missing.hyrf", "out"),
    "plan_edit": ("missing.hyrf", [Center()]),
}


def run_in_new_interpreter(code: str) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parents[1], capture_output=True, text=True)


def test_every_public_function_is_covered_here():
    assert set(PUBLIC_FUNCTIONS) == {
        *REJECTED_ARGUMENTS,
        "evaluate_model",
        "export_gallery",
        "export_player",
        "place_photos",
        "render_view",
        "save_model",
        "select_levels",
        "train_blocks",
        "train_model",
    }


@pytest.mark.parametrize("name", PUBLIC_FUNCTIONS)
def test_a_public_function_documents_its_arguments_and_purpose(name):
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
        calls = {
            name: pool.submit(getattr(hyrfpack, name), *arguments) for name, arguments in REJECTED_ARGUMENTS.items()
        }
        calls["evaluate_model"] = pool.submit(hyrfpack.evaluate_model, None, [])
        for name, call in calls.items():
            assert isinstance(call.exception(), (hyrfpack.HyrfError, TypeError)), name


@pytest.mark.parametrize(
    ("asking", "printed"),
    [
        ("", ""),
        (
            "logging.basicConfig(level=logging.INFO)",
            "INFO:hyrfpack.make.auto_pose:a note\nWARNING:hyrfpack.train.log:a loss\n",
        ),
    ],
    ids=["not asked for", "asked for"],
)
def test_messages_are_printed_only_if_the_program_asks_for_them(asking, printed):
    code = (
        f"import logging, hyrfpack\n{asking}\n"
        "from hyrfpack.make.auto_pose import _LOG\n_LOG.info('a note')\n"
        "from hyrfpack.train.log import _LOG\n_LOG.warning('a loss')\n"
    )
    assert run_in_new_interpreter(code).stderr == printed


def test_sub_packages_support_every_form_of_import():
    code = (
        "import hyrfpack.train.advice as advice, hyrfpack.train as t, hyrfpack.evaluate\n"
        "from hyrfpack.train import Trainer, advice as again\n"
        "import hyrfpack.cameras.paths, sys\n"
        "assert advice is again is sys.modules['hyrfpack.train.advice'] is hyrfpack.train.advice\n"
        "assert t is hyrfpack.train is sys.modules['hyrfpack.train'] and t.train_model is hyrfpack.train_model\n"
        "assert t.Trainer is Trainer and hyrfpack.cameras.paths.orbit\n"
        "advice.MIN_ADVICE_STEPS = 7\n"
        "assert hyrfpack.train.advice.MIN_ADVICE_STEPS == 7\n"
        "try: hyrfpack.nothing\n"
        "except AttributeError: print('and nothing else')"
    )
    assert run_in_new_interpreter(code).stdout == "and nothing else\n", run_in_new_interpreter(code).stderr


def test_a_former_name_raises_an_error_with_the_present_name():
    with pytest.raises(AttributeError, match="the name is now hyrfpack.load_model"):
        _ = hyrfpack.load
    stderr = run_in_new_interpreter("import hyrfpack\nhyrfpack.train()").stderr
    assert "AttributeError" in stderr and "the name is now hyrfpack.train_model" in stderr


# A mistaken call, and its error message.
MISTAKEN_CALLS = [
    (lambda model, scene: hyrfpack.train_model("photos", "run"), "scene must be a Scene, not a str; .*load_scene"),
    (lambda model, scene: hyrfpack.train_model(scene, "run", {"steps": 3}), "config must be a TrainConfig, not a dict"),
    (lambda model, scene: hyrfpack.train_blocks("photos", "run"), "scene must be a Scene, not a str; .*load_scene"),
    (
        lambda model, scene: hyrfpack.compress_model("m.hyrf", "a.hyrf", data="photos"),
        "data must be a Scene.*load_scene",
    ),
    (lambda model, scene: hyrfpack.compress_model(model, "a.hyrf"), "str.*not HybridModel"),
    (lambda model, scene: hyrfpack.compress_model("m.hyrf", "a.hyrf", "paper"), "hyrfpack.CompressConfig"),
    (lambda model, scene: hyrfpack.export_model("m.hyrf", "a.ply", data="photos"), "data must be a Scene.*load_scene"),
    (lambda model, scene: hyrfpack.benchmark_model("m.hyrf", "photos"), "scene must be a Scene.*load_scene"),
    (lambda model, scene: hyrfpack.evaluate_model("m.hyrf", scene.train), "model must be a HybridModel.*hyrfpack.load"),
    (lambda model, scene: hyrfpack.evaluate_model(model, "photos"), "views must be a View, not a str; .*scene.test"),
    (lambda model, scene: hyrfpack.evaluate_model(model, scene), "views must be a View, not a Scene; .*scene.test"),
    (
        lambda model, scene: hyrfpack.render_view(model, scene.train[0]),
        "camera must be a Camera, not a View; .*view.camera",
    ),
    (lambda model, scene: hyrfpack.render_view("m.hyrf", scene.train[0].camera), "model must be a HybridModel"),
    (lambda model, scene: hyrfpack.render_view(model, scene.train[0].camera, 0.1), "settings must be a RenderSettings"),
    (lambda model, scene: hyrfpack.save_model("m.hyrf", "a.hyrf"), "model must be a HybridModel"),
    (lambda model, scene: hyrfpack.import_splats("a.ply", "a.hyrf", 500), "config must be a ImportConfig"),
    (lambda model, scene: hyrfpack.import_splats("a.ply", "a.hyrf", cameras=scene.train), "cameras must be a Camera"),
    (
        lambda model, scene: hyrfpack.merge_models("m.hyrf", "a.hyrf"),
        "sources must be several paths, not 'm.hyrf' alone",
    ),
    (lambda model, scene: hyrfpack.export_gallery("m.hyrf", "a"), "sources must be several paths, not 'm.hyrf' alone"),
    (
        lambda model, scene: hyrfpack.select_levels("scene", scene.train[0].camera),
        "manifest must be a Manifest, not a str; .*scene.manifest",
    ),
]


@pytest.mark.parametrize("call, sentence", MISTAKEN_CALLS)
def test_a_mistaken_call_is_a_type_error_that_says_what_to_do(call, sentence, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(TypeError, match=sentence):
        call(small_model([(0, 0, 0)]), ball_scene(2, side=8))
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_loading_to_a_missing_device_is_a_clear_error(tmp_path):
    hyrfpack.save_model(small_model([(0, 0, 0)]), tmp_path / "model.hyrf")
    with pytest.raises(hyrfpack.HyrfError, match="'cuda' is not available"):
        hyrfpack.load_model(tmp_path / "model.hyrf", device="cuda")


def test_a_render_of_a_loaded_model_converts_to_numpy(tmp_path):
    hyrfpack.save_model(small_model([(0, 0, 0)]), tmp_path / "model.hyrf")
    model, (view, _) = hyrfpack.load_model(tmp_path / "model.hyrf"), ball_scene(2, side=8).train
    assert hyrfpack.render_view(model, view.camera).rgb.numpy().shape == (8, 8, 3)
    assert hyrfpack.render_view(model.requires_grad_(), view.camera).rgb.requires_grad


def test_type_checkers_see_the_public_names_and_nothing_else():
    nodes = [node for node in ast.parse(inspect.getsource(hyrfpack)).body if isinstance(node, ast.If)]
    (block,) = [node for node in nodes if ast.unparse(node.test) == "TYPE_CHECKING"]
    messages = {}
    for statement in block.body:
        for alias in statement.names:
            assert alias.name == alias.asname, "what is not imported under its own name again is private"
            messages[alias.name] = statement.module
    assert {"__version__", *messages} == set(hyrfpack.__all__)
    for name, module in messages.items():
        assert getattr(import_module(module), name) is getattr(hyrfpack, name)
    assert files("hyrfpack").joinpath("py.typed").is_file()

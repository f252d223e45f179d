"""An error is one line with a problem and a fix, also where a package is missing that only one task needs."""

from __future__ import annotations

import ast
import pickle
import sys
from copy import copy
from functools import cache
from importlib import import_module
from pathlib import Path

import click
import pytest
from commands import refused
from scenes import small_model

import hyrfpack
from hyrfpack.cli import main
from hyrfpack.data import load_scene
from hyrfpack.errors import HyrfDataError, HyrfError, HyrfSizeError, needs_package, short_reason, strip_path
from hyrfpack.evaluate.figures import draw_training_curve
from hyrfpack.format import save_model

LIBRARY_FOLDER = Path(hyrfpack.__file__).parent


@cache
def raised_errors() -> list[tuple[str, ast.Call]]:
    """Return (place, call) for every error that hyrfpack makes by the name of its class."""
    return [
        (f"{path.relative_to(LIBRARY_FOLDER).as_posix()}:{node.lineno}", node)
        for path in sorted(LIBRARY_FOLDER.rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in ERROR_CLASS_NAMES
    ]


ERROR_CLASS_NAMES = {name for name in vars(hyrfpack.errors) if name.startswith("Hyrf")}


def literal_text(node: ast.AST) -> str:
    """The text of all literals in an expression."""
    return "".join(
        part.value for part in ast.walk(node) if isinstance(part, ast.Constant) and isinstance(part.value, str)
    )


def test_every_error_names_its_fix():
    calls = raised_errors()
    assert len(calls) > 400
    assert [place for place, call in calls if "fix" not in [keyword.arg for keyword in call.keywords]] == []


def test_settings_are_named_in_the_fix_where_the_command_line_translates_them():
    assert [place for place, call in raised_errors() if "`" in literal_text(call.args[0])] == []


@pytest.mark.parametrize(
    ("message", "reason"),
    [("a\nb", "a"), ("\n \n  no module\nmore", "no module"), ("", "ValueError"), (" \n", "ValueError")],
)
def test_a_quoted_reason_is_the_first_line_with_text_or_the_type(message, reason):
    assert short_reason(ValueError(message)) == reason


def test_an_error_is_one_line_of_problem_and_fix():
    error = HyrfDataError("a\nb.png: the picture is empty", fix="copy {it} again with `overwrite=True`")

    assert str(error) == "a\\nb.png: the picture is empty; copy {it} again with `overwrite=True`"
    assert (error.problem, error.fix) == ("a\\nb.png: the picture is empty", "copy {it} again with `overwrite=True`")
    assert strip_path(error, "a\nb.png") == "the picture is empty"


@pytest.mark.parametrize("copied", [copy, lambda error: pickle.loads(pickle.dumps(error))], ids=["copy", "pickle"])
def test_a_copied_error_keeps_its_parts(copied):
    error = copied(HyrfSizeError("it is too large", fix="ask for more", min_bytes=7))

    assert (str(error), error.fix, error.min_bytes) == ("it is too large; ask for more", "ask for more", 7)


def test_an_error_with_other_text_keeps_its_type_and_attributes():
    error = HyrfSizeError("it is too large", fix="ask for more", min_bytes=7)

    other = error.with_text(f"packing failed: {error.problem}")

    assert isinstance(other, HyrfSizeError) and other.min_bytes == 7
    assert str(other) == "packing failed: it is too large; ask for more"
    assert str(error) == "it is too large; ask for more"


@pytest.fixture
def hide_package(monkeypatch):
    """A function that makes a package impossible to import."""

    def hide(package: str) -> None:
        for name in [name for name in sys.modules if name.split(".")[0] == package]:
            monkeypatch.delitem(sys.modules, name)
        monkeypatch.setitem(sys.modules, package, None)

    return hide


@pytest.mark.parametrize(
    ("module", "sentence"),
    [
        ("nowhere.at.all", "flying needs nowhere; run 'pip install nowhere'"),
        ("PIL", "flying needs pillow; run 'pip install pillow'"),
        ("av", "flying needs av; run 'pip install \"hyrfpack[video]\"'"),
        ("OpenEXR", "flying needs OpenEXR; run 'pip install \"hyrfpack[exr]\"'"),
        ("pillow_heif", "flying needs pillow-heif; run 'pip install \"hyrfpack[heic]\"'"),
        ("pxr", "flying needs usd-core; run 'pip install \"hyrfpack[usd]\"'"),
        ("pycolmap", "flying needs pycolmap; run 'pip install \"hyrfpack[poses]\"'"),
    ],
)
def test_a_missing_package_is_named_with_its_task_and_how_to_install_it(module, sentence, hide_package):
    hide_package(module)
    with pytest.raises(HyrfError) as caught, needs_package("flying"):
        import_module(module)
    assert str(caught.value) == sentence


def test_a_missing_module_of_hyrfpack_is_no_error_of_the_user():
    with pytest.raises(ModuleNotFoundError), needs_package("flying"):
        import_module("hyrfpack.nowhere")


def test_a_command_without_its_package_ends_with_one_line(monkeypatch):
    @click.command
    def fly():
        import nowhere_at_all  # noqa: F401

    monkeypatch.setitem(main.commands, "fly", fly)
    assert refused("fly") == "Error: this command needs nowhere_at_all; run 'pip install nowhere_at_all'"


def test_profile_paper_without_dahuffman_writes_nothing(hide_package, tmp_path):
    hide_package("dahuffman")

    with pytest.raises(HyrfError, match="profile 'paper' needs dahuffman; run 'pip install dahuffman'"):
        save_model(small_model([(0, 0, 0)]), tmp_path / "model.hyrf", "paper")

    assert not list(tmp_path.iterdir())


def test_a_colmap_model_without_pycolmap_is_a_clear_error_that_names_the_folder(hide_package, tmp_path):
    (tmp_path / "images").mkdir()
    (tmp_path / "sparse").mkdir()
    for table in ("cameras", "images", "points3D"):
        (tmp_path / "sparse" / f"{table}.txt").touch()
    hide_package("pycolmap")

    with pytest.raises(HyrfError, match="sparse: reading COLMAP models needs pycolmap"):
        load_scene(tmp_path)


def test_figures_without_matplotlib_are_a_clear_error(hide_package, tmp_path):
    hide_package("matplotlib")

    with pytest.raises(HyrfError, match="drawing figures needs matplotlib"):
        draw_training_curve([{"step": 1, "psnr": 20.0, "loss": 0.1, "gaussians": 1}], tmp_path / "curve.png")


def test_commands_that_end_with_a_figure_miss_matplotlib_before_their_work(hide_package, monkeypatch, tmp_path):
    save_model(small_model([(0, 0, 0)]), tmp_path / "a.hyrf")
    hide_package("matplotlib")
    for work in ("bench.suite.benchmark_model", "compress.compress_model", "report.compression.describe_file"):
        monkeypatch.setattr(f"hyrfpack.{work}", lambda *_, **__: pytest.fail("the work has begun"))

    assert "drawing figures needs matplotlib" in refused("bench", tmp_path / "a.hyrf", "-o", tmp_path / "a.png")
    written = ("-o", tmp_path / "b.hyrf", "--report", tmp_path / "page")
    assert "drawing figures needs matplotlib" in refused("compress", tmp_path / "a.hyrf", *written)

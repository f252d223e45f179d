"""Command lines of the tools: all answer --help, and errors that the user can correct are one line."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hyrfpack.errors import HyrfError
from tools.command import read_child_json, run_command
from tools.safety import make_golden
from tools.safety.make_golden import GOLDEN_SCENE_FOLDER
from tools.safety.train_golden import DEMO_MODEL_FILE, write_demo_photos
from tools.safety.variants import __main__ as variants
from tools.studies import export_table, mesh_scale
from tools.studies.train_sets import list_sets

REPOSITORY_ROOT = Path(__file__).parents[2]
SOURCE_BY_MODULE = {
    ".".join(path.relative_to(REPOSITORY_ROOT).with_suffix("").parts): text
    for path in sorted((REPOSITORY_ROOT / "tools").rglob("*.py"))
    if "def main(" in (text := path.read_text("utf-8")) and ".parse_args(" in text
}
CHANGES_ENVIRONMENT = {module for module, text in SOURCE_BY_MODULE.items() if "\nos.environ" in text}


@pytest.mark.parametrize("module", sorted(SOURCE_BY_MODULE.keys() - CHANGES_ENVIRONMENT))
def test_every_tool_answers_help(module: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.setattr(sys, "argv", [module, "--help"])
    with pytest.raises(SystemExit) as exit_info:
        importlib.import_module(module).main()
    assert exit_info.value.code in (None, 0) and "usage:" in capsys.readouterr().out


@pytest.mark.parametrize("module", sorted(CHANGES_ENVIRONMENT))
def test_a_tool_that_changes_the_environment_answers_help(module: str):
    """It runs in a process of its own, because Triton's interpreter would else be off for later tests."""
    process = subprocess.run([sys.executable, "-m", module, "--help"], cwd=REPOSITORY_ROOT, stdout=subprocess.PIPE)
    assert process.returncode == 0 and b"usage:" in process.stdout


@pytest.mark.parametrize("module", sorted(name for name in SOURCE_BY_MODULE if name.startswith("tools.studies.")))
def test_the_help_of_a_study_names_a_page_that_names_the_study(module: str):
    paths = re.findall(r"docs/[\w/-]+\.md", SOURCE_BY_MODULE[module].split('"""')[1])
    pages = [(REPOSITORY_ROOT / path).read_text("utf-8") for path in paths]
    assert any(module in page or f"{module.replace('.', '/')}.py" in page for page in pages)


def test_an_error_that_the_user_can_correct_is_one_line_with_options(capsys: pytest.CaptureFixture[str]):
    def fail() -> None:
        raise HyrfError("photos: there are no data sets", fix="name the folder with `data`")

    with pytest.raises(SystemExit) as exit_info:
        run_command(fail)
    assert exit_info.value.code == 2
    assert capsys.readouterr().err == "error: photos: there are no data sets; name the folder with --data\n"


@pytest.mark.parametrize("code", [None, 0, 1])
def test_a_tool_exits_with_its_code(code: int | None):
    with pytest.raises(SystemExit) as exit_info:
        run_command(lambda: code)
    assert exit_info.value.code == code


def test_the_last_line_of_a_child_process_is_its_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "child.py").write_text("import sys\nprint('step 1')\nprint(sys.argv[1])\nsys.exit(len(sys.argv) - 2)")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    assert read_child_json("child", ["[4]"]) == [4]
    with pytest.raises(HyrfError, match="child ended with exit code 1"):
        read_child_json("child", [4, 5])


def test_data_sets_are_folders_with_photos(tmp_path: Path):
    for name in ("b/images", "a/train", "empty"):
        (tmp_path / name).mkdir(parents=True)
    assert list_sets(tmp_path) == ["a", "b"]


@pytest.mark.parametrize("name", ["missing", "empty"])
def test_a_folder_without_data_sets_is_refused(name: str, tmp_path: Path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(HyrfError, match=f"{name}: there are no data sets; .*HYRFPACK_DATA"):
        list_sets(tmp_path / name)


def test_an_unknown_format_is_refused_before_anything_is_read(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(sys, "argv", ["export_table", "missing.hyrf", "missing", "--formats", "ply", "foo"])
    with pytest.raises(SystemExit):
        export_table.main()
    error = capsys.readouterr().err
    assert "--formats .foo: there is no such format" in error and ".spz v3" in error


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        ("crop_subject", ["--runs", "runs", "--crops", "fox"], "'fox' is not SET=RADIUS"),
        ("crop_subject", ["--runs", "runs", "--crops", "fox=-1"], "'fox=-1' is not SET=RADIUS"),
        ("compare_versions", ["--against", ".", "--shares", "half"], "'half' is neither a positive number nor"),
        ("compare_versions", ["--against", ".", "--only", "a"], "unrecognized arguments: --only"),
        ("ablations", ["--seeds", "0"], "--seeds: '0' is not an integer of at least 1"),
        ("web_player", [], "nothing to measure; name --runs, --large or both"),
    ],
)
def test_a_study_refuses_wrong_arguments(name, arguments, message, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [name, *arguments])
    with pytest.raises(SystemExit) as exit_info:
        importlib.import_module(f"tools.studies.{name}").main()
    assert exit_info.value.code == 2 and message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        ("compression", ["--models", "{folder}"], "there are no models; make them"),
        ("compression", ["--models", "{folder}", "--sets", "b", "a"], "there are no models: a, b; make them"),
        ("estimated_poses", ["--scenes", "{folder}/none"], "there are no estimated poses; estimate"),
        ("poses", ["--data", "{folder}"], "there are no known poses"),
        ("poses", ["--data", "{folder}", "--sets", "fox"], "there are no known poses .*: fox;"),
        ("tile_scene", [str(GOLDEN_SCENE_FOLDER), "--copies", "2", "--out", "{folder}"], "it exists already"),
        ("viewer_comparison", [str(DEMO_MODEL_FILE), "--viewers", "{folder}"], "is not installed|no viewers are"),
    ],
)
def test_a_study_of_what_is_missing_is_an_error_of_one_line(name, arguments, message, tmp_path, monkeypatch):
    write_demo_photos(tmp_path / "demo")
    monkeypatch.setattr(sys, "argv", [name, *(word.format(folder=tmp_path) for word in arguments)])
    with pytest.raises(HyrfError, match=message):
        importlib.import_module(f"tools.studies.{name}").main()


def test_distances_to_the_disk_end_at_its_edge():
    points = np.array([[4.9, 0.0, 0.1], [8.0, 0.0, 4.0], [0.0, 0.0, 2.5]])
    np.testing.assert_allclose(mesh_scale.measure_surface_distances(points), [0.1, 5.0, 0.5])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [(["missing"], "missing: there is no data set"), (["{data}", "--only", "no such variant"], "nothing was checked")],
)
def test_variants_of_a_missing_set_or_name_are_an_error(arguments, words, data, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", "")  # which the tool replaces
    monkeypatch.setattr(sys, "argv", ["variants", *(word.format(data=data) for word in arguments)])
    with pytest.raises(HyrfError, match=words):
        variants.main()


@pytest.mark.parametrize("name", ["browser.build_types", "browser.build_player", "safety.make_golden"])
def test_a_tool_without_options_refuses_arguments_before_it_writes(name, monkeypatch):
    monkeypatch.setattr(sys, "argv", [name, "--halp"])
    monkeypatch.setattr("subprocess.run", None)
    with pytest.raises(SystemExit) as exit_info:
        importlib.import_module(f"tools.{name}").main()
    assert exit_info.value.code == 2


@pytest.mark.parametrize(
    ("name", "option"),
    [
        ("fuzz", "--count"), ("fuzz", "--jobs"), ("fuzz_browser", "--count"), ("fuzz_browser", "--jobs"),
        ("kill", "--kills"), ("kill", "--jobs"), ("races", "--rounds"), ("run_docs", "--steps"),
    ],
)  # fmt: skip
def test_a_check_of_nothing_is_refused(name, option, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [name, option, "0"])
    with pytest.raises(SystemExit) as exit_info:
        importlib.import_module(f"tools.safety.{name}").main()
    assert exit_info.value.code == 2 and f"{option}: '0' is not an integer of at least 1" in capsys.readouterr().err


def test_a_missing_page_is_refused_before_another_runs(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["run_docs", str(REPOSITORY_ROOT / "README.md"), "missing.md"])
    monkeypatch.setattr("subprocess.run", None)
    with pytest.raises(SystemExit) as exit_info:
        importlib.import_module("tools.safety.run_docs").main()
    assert exit_info.value.code == 2 and "missing.md: there is no such page" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["fuzz", "fuzz_browser"])
def test_a_folder_for_results_that_cannot_be_made_is_refused_before_the_run(name, tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    module = importlib.import_module(f"tools.safety.{name}")
    monkeypatch.setattr("multiprocessing.get_context", None)  # which starts the run
    monkeypatch.setattr("shutil.which", str)
    monkeypatch.setattr(sys, "argv", [name, "--jobs", "1", "--out", str(tmp_path / "file" / "runs")])
    with pytest.raises(HyrfError, match="the folder cannot be made"):
        module.main()


def test_a_golden_file_never_stays_without_its_numbers(tmp_path: Path, monkeypatch):
    def fail(*_: object, **values: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(make_golden.np, "savez_compressed", fail)
    with pytest.raises(KeyboardInterrupt):
        make_golden.write_golden_file(tmp_path / "golden.hyrf", b"bytes", {})
    assert not list(tmp_path.iterdir())

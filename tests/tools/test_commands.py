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
from tools.command import run_command
from tools.safety import make_golden
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

"""tools/browser: building the player and its package keeps foreign files and reports errors in one line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from hyrfpack.errors import HyrfError
from tools.browser import build_package as package_tool
from tools.browser import node_programs
from tools.browser.build_package import PACKAGE_NAME, build_package
from tools.browser.node_programs import PROGRAMS_FOLDER, run_node_program


def read_files(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def earlier_package(tmp_path: Path) -> Path:
    folder = tmp_path / "package"
    folder.mkdir()
    (folder / "package.json").write_text(json.dumps({"name": PACKAGE_NAME}))
    (folder / "old.js").write_text("old")
    return folder


@pytest.mark.parametrize("name", ["package.json", "photo.jpg"])
def test_a_folder_with_other_files_is_refused_and_kept(name: str, tmp_path: Path):
    (tmp_path / name).write_text('{"name": "mine"}')
    with pytest.raises(HyrfError, match="are not a package hyrf-viewer; choose another folder"):
        build_package(tmp_path)
    assert read_files(tmp_path) == {name: b'{"name": "mine"}'}


def test_an_earlier_package_stays_if_the_new_one_cannot_be_built(earlier_package: Path, monkeypatch):
    def fail(*_: object, **options: object) -> bytes:
        raise HyrfError("esbuild ended with exit code 1", fix="correct what its message names")

    monkeypatch.setattr(package_tool, "is_minified_current", lambda: True)
    monkeypatch.setattr(package_tool, "run_node_program", fail)
    before = read_files(earlier_package.parent)
    with pytest.raises(HyrfError, match="esbuild ended"):
        build_package(earlier_package)
    assert read_files(earlier_package.parent) == before


@pytest.mark.skipif(not (PROGRAMS_FOLDER / "esbuild").exists(), reason="esbuild is not installed")
def test_an_earlier_package_is_replaced_as_a_whole(earlier_package: Path, monkeypatch):
    monkeypatch.setattr(package_tool, "is_minified_current", lambda: True)
    build_package(earlier_package)
    names = {path.name for path in earlier_package.iterdir()}
    assert {"index.js", "index.js.map", "worker.js", "package.json", "LICENSE"} <= names and "old.js" not in names
    assert [path.name for path in earlier_package.parent.iterdir()] == [earlier_package.name]
    first = read_files(earlier_package)
    build_package(earlier_package)
    assert read_files(earlier_package) == first


def test_a_missing_program_is_one_message_that_says_how_to_install_it():
    with pytest.raises(HyrfError, match=r"nothing: the program is missing; install node, then run 'npm ci"):
        run_node_program("nothing")


def test_the_output_of_a_program_that_fails_is_shown(tmp_path: Path, monkeypatch, capsys):
    program = tmp_path / "tsc"
    program.write_text("#!/bin/sh\necho 'index.js(1,1): error'\nexit 2\n")
    program.chmod(0o755)
    monkeypatch.setattr(node_programs, "PROGRAMS_FOLDER", tmp_path)
    with pytest.raises(HyrfError, match="tsc ended with exit code 2"):
        run_node_program("tsc")
    assert capsys.readouterr().err == "index.js(1,1): error\n"

"""Paths that the system refuses, such as those in a folder without access, end every command with one sentence."""

from __future__ import annotations

from pathlib import Path

import pytest
from commands import refused
from denied_access import deny_access

WORDS_BY_COMMAND = {
    "info": ("info", "{}.ply"),
    "import": ("import", "{}.ply", "-o", "out.hyrf"),
    "cameras of an import": ("import", "splats.ply", "-o", "out.hyrf", "--cameras", "{}.json"),
    "convert": ("convert", "{}.ply", "out.spz"),
    "export": ("export", "{}.hyrf", "-o", "out"),
    "split": ("split", "{}.hyrf", "-o", "out"),
    "render": ("render", "{}.hyrf", "-o", "out"),
    "view": ("view", "{}.hyrf", "--no-browser"),
    "evaluate": ("evaluate", "{}.hyrf", "--data", "photos"),
    "bench": ("bench", "{}.hyrf"),
    "train": ("train", "{}", "-o", "out"),
    "poses": ("poses", "{}", "-o", "out"),
    "make": ("make", "{}", "-o", "out.html"),
}


@pytest.mark.parametrize("words", WORDS_BY_COMMAND.values(), ids=WORDS_BY_COMMAND)
def test_a_path_in_a_folder_without_access_is_named_with_the_reason(words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "private"
    folder.mkdir()
    for name in ("a", "a.ply", "a.hyrf", "a.json"):
        (folder / name).write_bytes(b"x")
    (tmp_path / "splats.ply").write_bytes(b"x")
    deny_access(monkeypatch, folder)
    sentence = refused(*(word.format(folder / "a") for word in words))
    assert str(folder / "a") in sentence and "Permission denied" in sentence
    assert not Path("out").exists()


@pytest.mark.acceptance
@pytest.mark.parametrize("words", WORDS_BY_COMMAND.values(), ids=WORDS_BY_COMMAND)
def test_a_path_with_too_long_a_name_is_refused(words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "splats.ply").write_bytes(b"x")
    refused(*(word.format("x" * 300) for word in words))
    assert not Path("out").exists()

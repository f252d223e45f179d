"""Tables of studies: rows are printed when they are made, and results of several calls are kept."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest

import hyrfpack
from hyrfpack.compress.distortion import DEFAULT_PSNR_DROP_DB
from hyrfpack.errors import HyrfError
from tools import tables
from tools.bench import __main__ as benchmarks
from tools.json_files import merge_rows
from tools.safety.train_golden import DEMO_MODEL_FILE
from tools.studies import (
    compression,
    design_choices,
    estimated_poses,
    few_photos,
    import_comparison,
    video,
    web_player,
    webgpu_player,
)
from tools.studies.web_player import psnr


def test_an_error_of_a_subject_becomes_its_row_and_rows_are_printed_when_made(capsys):
    printed = []

    def measure(name: str):
        printed.append(capsys.readouterr().out)
        if name == "b":
            raise HyrfError("b: no photo", fix="take some")
        yield [name, "1", "2"]

    tables.print_measured_table(("set", "x", "y"), ["a", "b", "c"], measure)
    assert "| a | 1 | 2 |" in printed[1] and "| b | b: no photo; take some |  |" in printed[2]
    assert capsys.readouterr().out == "| c | 1 | 2 |\n"


def test_merged_rows_replace_those_of_the_same_keys_alone(tmp_path):
    path = tmp_path / "new" / "rows.json"
    merge_rows(path, [{"set": "a", "steps": 1, "x": 1}, {"set": "b", "steps": 1, "x": 2}], ("set", "steps"))
    merge_rows(path, [{"set": "a", "steps": 2, "x": 3}, {"set": "b", "steps": 1, "x": 4}], ("set", "steps"))
    assert [(row["set"], row["steps"], row["x"]) for row in json.loads(path.read_text())] == [
        ("a", 1, 1),
        ("b", 1, 4),
        ("a", 2, 3),
    ]


def test_an_interrupted_write_leaves_the_stored_rows(tmp_path, monkeypatch):
    path = tmp_path / "rows.json"
    merge_rows(path, [{"set": "a"}], ("set",))

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", interrupt)
    with pytest.raises(KeyboardInterrupt):
        merge_rows(path, [{"set": "b"}], ("set",))
    assert json.loads(path.read_text()) == [{"set": "a"}] and list(tmp_path.iterdir()) == [path]


def test_rows_of_a_benchmark_are_stored_before_the_next_one_runs(tmp_path, monkeypatch):
    def run(name: str) -> list[dict]:
        if name == "ssim":
            raise KeyboardInterrupt
        return [{"ms": 1.0}]

    monkeypatch.setattr(benchmarks, "run_benchmark", run)
    with pytest.raises(KeyboardInterrupt):
        benchmarks.main(["--only", "fields", "--only", "ssim", "--json", str(tmp_path / "out.json")])
    assert json.loads((tmp_path / "out.json").read_text())["results"] == {"fields": [{"ms": 1.0}]}


def test_a_run_of_few_photos_is_stored_before_the_next_one_starts(tmp_path, monkeypatch):
    def train_and_score(data: Path, name: str, fold: int, steps: int, exposure: bool) -> few_photos.Scores:
        if steps == 20:
            raise KeyboardInterrupt
        return few_photos.Scores(20.0, 0.5, 22.0)

    monkeypatch.setattr(few_photos, "train_and_score", train_and_score)
    arguments = ["few_photos", "--steps", "10", "20", "--sets", "a", "--out", str(tmp_path / "few.json")]
    monkeypatch.setattr(sys, "argv", arguments)
    with pytest.raises(KeyboardInterrupt):
        few_photos.main()
    assert [row["steps"] for row in json.loads((tmp_path / "few.json").read_text())] == [10]


def test_estimated_poses_keep_the_results_of_other_calls(tmp_path, monkeypatch):
    def measure(name: str, data: Path, scenes: Path, out: Path, steps: int, seeds: int) -> dict:
        return {"set": name, "steps": steps, "photos": 9, "lacking": 0, "given": [20.0], "own": [19.0]}

    monkeypatch.setattr(estimated_poses, "measure", measure)
    for name in "ab":
        (tmp_path / "scenes" / name / "sparse").mkdir(parents=True)
        arguments = ["--sets", name, "--scenes", str(tmp_path / "scenes"), "--out", str(tmp_path)]
        monkeypatch.setattr(sys, "argv", ["estimated_poses", *arguments])
        estimated_poses.main()
    assert [row["set"] for row in json.loads((tmp_path / "table.json").read_text())] == ["a", "b"]


def test_few_photos_keep_the_results_of_other_calls(tmp_path, monkeypatch):
    monkeypatch.setattr(few_photos, "train_and_score", lambda *_: few_photos.Scores(20.0, 0.5, 22.0))
    for names in (["a", "b"], ["c"]):
        arguments = ["few_photos", "--steps", "10", "--sets", *names, "--out", str(tmp_path / "few.json")]
        monkeypatch.setattr(sys, "argv", arguments)
        few_photos.main()
    assert [row["set"] for row in json.loads((tmp_path / "few.json").read_text())] == ["a", "b", "c"]


def test_a_set_that_fails_leaves_the_rows_of_the_others_of_a_video_study(tmp_path, monkeypatch, capsys):
    for name in "ac":
        (tmp_path / name / "images").mkdir(parents=True)
    monkeypatch.setattr(video, "write_video", lambda *_: ["photo"])
    monkeypatch.setattr(video, "choose_frames", lambda *_: None)
    monkeypatch.setattr(video, "format_row", lambda name, *_: [name] * 8)
    monkeypatch.setattr(sys, "argv", ["video", "--sets", "a", "b", "c", "--data", str(tmp_path)])
    video.main()
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(" | ")[0] for line in lines] == ["| set", "| ---", "| a", "| b", "| c"]
    assert "there is no folder images" in lines[3]


def test_pictures_of_the_web_player_are_kept_when_a_later_set_fails(tmp_path, monkeypatch, capsys):
    def measure(run: Path, *_: object) -> list[str]:
        if run.name == "b":
            raise HyrfError("b: no model", fix="train it")
        return [run.name] * 10

    monkeypatch.setattr(web_player, "measure_pictures", measure)
    monkeypatch.setattr(sys, "argv", ["web_player", "--runs", str(tmp_path), "--sets", "a", "b"])
    web_player.main()
    printed = capsys.readouterr().out
    assert "| a | a |" in printed and "b: no model" in printed


def test_files_of_hyrfpack_are_kept_when_other_programs_are_missing(monkeypatch, capsys):
    class OneSplat:
        degree = 0

        def __len__(self) -> int:
            return 1

    def fail(*_: object):
        raise HyrfError("splat-transform is not installed", fix="install it")
        yield

    own = import_comparison.MeasuredFile("hyrfpack", "--psnr 30", 1000, 30.0, 29.0, 1.0)
    monkeypatch.setattr(import_comparison, "read_splats", lambda file: OneSplat())
    monkeypatch.setattr(import_comparison, "prepare_model", lambda *_, **__: None)
    monkeypatch.setattr(import_comparison, "measure_own_files", lambda *_: iter([own]))
    monkeypatch.setattr(import_comparison, "measure_other_files", fail)
    monkeypatch.setattr(sys, "argv", ["import_comparison", "a.ply"])
    import_comparison.main()
    printed = capsys.readouterr().out
    assert "| hyrfpack | --psnr 30 | 1,000 |" in printed and "splat-transform is not installed" in printed


def test_the_player_with_webgpu_is_compared_by_rgb_alone(monkeypatch):
    pictures = np.random.default_rng(0).integers(0, 256, (2, 5, 4)).astype(np.uint8)
    pictures[..., 3] = 255
    remaining = iter(pictures)

    class FakeChromium:
        def __init__(self, *_: object, **__: object) -> None:
            pass

        def __enter__(self):
            return self

        def __exit__(self, *_: object) -> None:
            pass

        resize = open = lambda self, *_: None

        def cpu_seconds(self) -> float:
            return 0.0

        def evaluate(self, script: str):
            if script == webgpu_player.COMPLETE_PICTURE_SCRIPT:
                return False
            if script == webgpu_player.PIXELS_SCRIPT:
                return next(remaining).tobytes().decode("latin-1")
            return {"colors": [1.0], "frame": [1.0], "sort": [1.0]}

    monkeypatch.setattr(webgpu_player, "Chromium", FakeChromium)
    first, second = (webgpu_player.measure("http://here", "webgl", 1, 9)[1] for _ in range(2))
    expected = 10 * np.log10(255**2 / np.mean((pictures[0, :, :3].astype(float) - pictures[1, :, :3]) ** 2))
    assert psnr(first, second) == pytest.approx(expected)


def test_the_default_file_of_the_compression_study_is_that_of_the_command(data, tmp_path, monkeypatch):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "model.hyrf").write_bytes(DEMO_MODEL_FILE.read_bytes())
    target_drops, encode = [], compression.Packer.encode_to_distortion

    def encode_to_distortion(self, target, references, target_drop=None):
        target_drops.append(target_drop)
        return encode(self, target, references, target_drop)

    monkeypatch.setattr(compression.Packer, "encode_to_distortion", encode_to_distortion)
    row = compression.TrainedSet(tmp_path / "run", data).measure(steps=0, matched=False)
    quiet = hyrfpack.RunContext("cpu", progress=None)
    scene = hyrfpack.load_scene(data)
    report = hyrfpack.compress_model(DEMO_MODEL_FILE, tmp_path / "compact.hyrf", data=scene, context=quiet)
    assert row["default"]["bytes"] == report.bytes_after and target_drops == [DEFAULT_PSNR_DROP_DB] * 2


def test_one_seed_has_no_spread():
    assert design_choices.format_spread([20.0]) == "" and design_choices.format_spread([20.0, 20.5]) == "0.50"

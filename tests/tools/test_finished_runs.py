"""Studies take finished runs only for the settings with which they were made."""

from __future__ import annotations

import json
from dataclasses import asdict

import pytest

from hyrfpack.demo.scene import write_demo_scene
from hyrfpack.errors import HyrfError
from tools.studies import count_laws, processes, reuse
from tools.studies.trained_runs import load_runs


def test_files_beside_the_folders_of_runs_are_ignored(tmp_path):
    write_demo_scene(tmp_path / "data" / "demo", views=4, size=8)
    (tmp_path / "runs" / "demo").mkdir(parents=True)
    (tmp_path / "runs" / "demo" / "model.hyrf").touch()
    (tmp_path / "runs" / "table.json").touch()
    assert [name for name, _, _ in load_runs(tmp_path / "runs", tmp_path / "data")] == ["demo"]


def test_a_set_with_runs_of_two_versions_is_refused(tmp_path):
    for version in ("before", "now"):
        folder = tmp_path / "runs" / "demo" / f"{version}-measured-0"
        folder.mkdir(parents=True)
        (folder / "model.hyrf").touch()
    with pytest.raises(HyrfError, match="demo/before-measured-0, demo/now-measured-0"):
        list(load_runs(tmp_path / "runs", tmp_path / "data"))


def test_runs_of_other_steps_have_other_folders(tmp_path, monkeypatch):
    metrics = {"evaluation": {"psnr": 1, "ssim": 1}, "stage_seconds": {}, "gaussians": 1, "seconds": 1}
    folders = []
    monkeypatch.setattr(processes, "train", lambda data, out, count, options: folders.append(out) or metrics)
    for steps in ("10", "20"):
        processes.main(["--sets", "a", "--steps", steps, "--processes", "1", "--out", str(tmp_path)])
    assert len(set(folders)) == 2


def test_counts_are_measured_again_for_other_steps_or_versions_and_for_a_missing_lpips(tmp_path, monkeypatch, capsys):
    calls = []

    def measure(data, size, count, steps, folder, lpips_weights):
        folder.mkdir(parents=True, exist_ok=True)
        calls.append((steps, lpips_weights is not None))
        lpips, weights = (None, None) if lpips_weights is None else (0.5, str(lpips_weights.resolve()))
        row = count_laws.CountRow(size, count, 1000, 20.0, 0.5, lpips, 4, 3, 2, 1, lpips_weights=weights)
        (folder / count_laws.ROW_FILE).write_text(json.dumps(asdict(row)))

    monkeypatch.setattr(count_laws, "measure", measure)
    lpips = ["--lpips-weights", "w.pth"]
    for version, options in enumerate(([], [], ["--steps", "9"], lpips, lpips, lpips)):
        monkeypatch.setattr(reuse, "describe_own_version", lambda version=version: "later" if version == 5 else "now")
        command = ["count_laws", "--sizes", "400", "--counts", "8", "16", "--out", str(tmp_path), *options]
        monkeypatch.setattr("sys.argv", command)
        count_laws.main()
    assert calls == [(3000, False)] * 2 + [(9, False)] * 2 + [(3000, True)] * 4

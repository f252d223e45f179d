"""The study of few photos trains on each fold and scores its validation photos."""

from __future__ import annotations

import json

from scenes import ball_scene

from tools.studies import few_photos


def test_the_study_scores_each_number_of_steps_on_each_fold(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(few_photos, "load_variant", lambda data, name: ball_scene(views=12, points=60, side=24))
    out = tmp_path / "scores.json"
    arguments = ["few_photos", "--sets", "ball", "--steps", "2", "8", "--folds", "2", "--no-exposure"]
    monkeypatch.setattr("sys.argv", [*arguments, "--out", str(out)])
    few_photos.main()

    results = json.loads(out.read_text())
    assert [(row["fold"], row["steps"]) for row in results] == [(0, 2), (0, 8), (1, 2), (1, 8)]
    psnr = [row["psnr"] for row in results]
    assert len(set(psnr)) == 4 and psnr[1] > psnr[0] > 5
    table = capsys.readouterr().out.split("\n\n")[-1]
    assert "| 2 steps | 8 steps |" in table and all(f"{value:.2f}, " in table for value in psnr)

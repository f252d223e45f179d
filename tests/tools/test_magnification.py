"""The study of larger pictures scores both kinds of sampling at both sizes."""

from __future__ import annotations

import json

from tools.safety.train_golden import write_demo_photos
from tools.studies import magnification


def test_larger_pictures_depend_on_the_sampling(monkeypatch, tmp_path, capsys):
    write_demo_photos(tmp_path / "data" / "demo")
    arguments = ["magnification", "--data", str(tmp_path / "data"), "--sets", "demo", "--steps", "12", "--seeds", "1"]
    monkeypatch.setattr("sys.argv", [*arguments, "--out", str(tmp_path / "out")])
    magnification.main()

    lines = capsys.readouterr().out.splitlines()
    row = json.loads(next(line for line in lines if line.startswith("{")))
    scores = {column: [float(number) for number in row[column].split(", ")] for column in row if column != "set"}
    assert all(psnr > 5 and 0 < ssim < 1 for psnr, ssim in scores.values())
    assert scores["full one"] != scores["full photos"]
    assert lines[-1].startswith("| demo | ") and lines[-1].count("|") == 6

"""The study of larger pictures scores both kinds of sampling at both sizes."""

from __future__ import annotations

from tools.safety.train_golden import write_demo_photos
from tools.studies import magnification


def test_larger_pictures_depend_on_the_sampling(monkeypatch, tmp_path, capsys):
    write_demo_photos(tmp_path / "data" / "demo")
    arguments = ["magnification", "--data", str(tmp_path / "data"), "--sets", "demo", "--steps", "12", "--seeds", "1"]
    monkeypatch.setattr("sys.argv", [*arguments, "--out", str(tmp_path / "out")])
    magnification.main()

    first, _, header, _, row = capsys.readouterr().out.splitlines()
    assert first == row and row.startswith("| demo | ")
    columns, cells = ([cell.strip() for cell in line.strip("|").split("|")] for line in (header, row))
    scores = {
        column: [float(number) for number in cell.split(", ")]
        for column, cell in zip(columns[1:], cells[1:], strict=True)
    }
    assert all(psnr > 5 and 0 < ssim < 1 for psnr, ssim in scores.values())
    assert scores["full size, one pixel"] != scores["full size, photos"]

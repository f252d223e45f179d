import csv
import json
from dataclasses import asdict, replace

import pytest

from tools.studies import reuse
from tools.studies.count_laws import (
    ROW_FILE,
    SURVEY_COLUMNS,
    CountRow,
    describe_run,
    format_fits,
    format_rows,
    has_row,
    read_rows,
    write_survey,
)


def row(size: int, gaussians: int, psnr: float, total: int, lpips: float | None = None) -> CountRow:
    return CountRow(
        size, gaussians, total, psnr, 0.5, lpips, positions=total // 2, properties=total // 4, tables=0, rest=total // 4
    )


ROWS_ON_A_LAW = [row(400, 1000 * 2**k, 20.0 + 1.5 * k, 6 * 1000 * 2**k + 4000) for k in range(4)]


def test_rows_that_follow_a_law_give_its_numbers():
    start = 20.0 - 1.5 * 9.965784284662087  # 1.5 dB a doubling, 20 dB at 1,000 = 2^9.9658
    assert f"| 400 | {start:.2f} + 1.50 log2(N) dB | 48.0 bits a Gaussian and 4,000 bytes |" in format_fits(
        ROWS_ON_A_LAW
    )


def test_a_single_run_of_a_size_has_no_fit():
    assert "| 200 |" not in format_fits([*ROWS_ON_A_LAW, row(200, 1000, 20.0, 10_000)])


def test_bits_of_the_parts_add_up_to_those_of_the_file():
    cells = [cell.strip() for cell in format_rows(ROWS_ON_A_LAW[:1]).splitlines()[-1].strip("|").split("|")]
    assert sum(map(float, cells[6:])) == pytest.approx(float(cells[5])) == 80.0


def test_the_survey_gets_one_file_for_each_photo_size_with_its_columns(tmp_path):
    write_survey([*ROWS_ON_A_LAW, row(200, 1000, 21.5, 9000, 0.25)], tmp_path, "bonsai")
    with (tmp_path / "bonsai-400.csv").open(newline="") as file:
        large = list(csv.reader(file))
    assert tuple(large[0]) == SURVEY_COLUMNS and len(large) == 1 + len(ROWS_ON_A_LAW)
    assert large[1] == ["", "20.0", "0.5", "", "10000", "1000"]
    assert (tmp_path / "bonsai-200.csv").read_text().splitlines()[1] == ",21.5,0.5,0.25,9000,1000"


def test_the_survey_of_one_photo_size_has_the_name_of_the_set(tmp_path):
    write_survey(ROWS_ON_A_LAW, tmp_path, "bonsai")
    assert [path.name for path in tmp_path.iterdir()] == ["bonsai.csv"]


def test_rows_of_another_version_are_named_and_left_out(tmp_path, monkeypatch, capsys):
    for version, counts in (("old", (1000, 2000)), ("new", (4000,))):
        monkeypatch.setattr(reuse, "describe_own_version", lambda version=version: version)
        for count in counts:
            folder = tmp_path / "400" / str(count)
            folder.mkdir(parents=True)
            (folder / ROW_FILE).write_text(json.dumps(asdict(row(400, count, 20.0, 10_000))))
            reuse.write_origin(folder, describe_run(tmp_path / "data", 3000, 400, count))

    assert [kept.gaussians for kept in read_rows(tmp_path, tmp_path / "data", 3000)] == [4000]
    assert capsys.readouterr().err.count("is left out: version was old, now new") == 2


def test_a_row_with_other_weights_of_lpips_is_measured_again(tmp_path):
    weights = tmp_path / "alex.pth"
    measured = replace(row(400, 1000, 20.0, 10_000, 0.25), lpips_weights=str(weights.resolve()))
    (tmp_path / ROW_FILE).write_text(json.dumps(asdict(measured)))

    run = tmp_path / "400" / "1000"
    run.mkdir(parents=True)
    (run / ROW_FILE).write_text(json.dumps(asdict(measured)))
    reuse.write_origin(run, describe_run(tmp_path / "data", 3000, 400, 1000))

    for asked, expected in ((weights, 0.25), (tmp_path / "vgg.pth", None), (None, None)):
        (kept,) = read_rows(tmp_path, tmp_path / "data", 3000, asked)
        assert kept.lpips == expected
    assert has_row(tmp_path, None) and has_row(tmp_path, weights)
    assert not has_row(tmp_path, tmp_path / "vgg.pth")

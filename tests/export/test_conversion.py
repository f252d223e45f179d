"""Splats of one format to another, and what that loses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from explicit_balls import ball_splats

import hyrfpack
from hyrfpack.errors import HyrfDataError, HyrfError
from hyrfpack.splats.files import READABLE_ENDINGS, read_splats
from hyrfpack.splats.formats import sog
from hyrfpack.splats.formats.hints import NO_HINTS
from hyrfpack.splats.splats import Splats
from hyrfpack.splats.table import FORMATS

COUNT = 60


@pytest.fixture(autouse=True)
def few_small_views(monkeypatch):
    from hyrfpack.export import conversion

    monkeypatch.setattr(conversion, "MEASURED_VIEWS", 2)
    monkeypatch.setattr(conversion, "MEASURED_SIZE_PIXELS", 32)


def written(folder: Path, ending: str, splats: Splats) -> Path:
    path = folder / f"before{ending}"
    path.write_bytes(FORMATS[ending].encode(splats, NO_HINTS))
    return path


@pytest.mark.parametrize("after", FORMATS)
@pytest.mark.parametrize("before", READABLE_ENDINGS)
def test_every_pair_of_formats_keeps_places_and_looks(before, after, tmp_path):
    if FORMATS[after].package:
        pytest.importorskip(FORMATS[after].package[0])
    source, target = written(tmp_path, before, ball_splats(COUNT)), tmp_path / f"after{after}"
    report = hyrfpack.convert_splats(source, target)
    kept, back = FORMATS[before].decode(source.read_bytes(), "it"), FORMATS[after].decode(target.read_bytes(), "it")
    assert (report.bytes_before, report.bytes_after) == (source.stat().st_size, target.stat().st_size)
    assert report.gaussians_before == report.gaussians_after == len(back) == COUNT
    assert report.degree_before == kept.degree == min(1, FORMATS[before].max_degree)
    assert report.degree_after == back.degree == min(kept.degree, FORMATS[after].max_degree)
    nearest = np.linalg.norm(back.positions[:, None] - kept.positions, axis=-1).min(axis=0)
    assert nearest.max() < 2e-3
    lost_harmonics = kept.degree > back.degree
    assert report.views == 2 and report.psnr_worst <= report.psnr
    assert report.psnr > (15 if lost_harmonics else 35)


def test_a_format_that_holds_all_loses_nothing(tmp_path):
    report = hyrfpack.convert_splats(written(tmp_path, ".ply", ball_splats(COUNT)), tmp_path / "after.usdc")
    assert report.psnr == report.psnr_worst == 100


def test_a_loose_sog_is_bundled_and_all_its_bytes_are_counted(tmp_path):
    folder = tmp_path / "loose"
    folder.mkdir()
    for name, data in sog.encode_files(ball_splats(COUNT)).items():
        (folder / name).write_bytes(data)
    report = hyrfpack.convert_splats(folder, tmp_path / "bundled.sog")
    assert report.bytes_before == sum(path.stat().st_size for path in folder.iterdir())
    assert hyrfpack.convert_splats(folder / "meta.json", tmp_path / "again.sog").bytes_before == report.bytes_before


def test_choices_leave_out_gaussians_and_harmonics(tmp_path):
    splats = ball_splats(COUNT, degree=2)
    source = written(tmp_path, ".ply", splats)
    box = (-9, -9, -9, 9, 9, 0)
    report = hyrfpack.convert_splats(source, tmp_path / "a.ply", degree=1, crop=box, min_opacity=0.6)
    back = read_splats(tmp_path / "a.ply")
    assert len(back) == ((splats.positions[:, 2] <= 0) & (splats.opacities >= 0.6)).sum()
    assert (report.gaussians_before, report.gaussians_after) == (COUNT, len(back))
    assert (report.degree_before, report.degree_after, back.degree) == (2, 1, 1)


def test_a_crop_alone_is_no_loss_and_what_is_left_out_by_opacity_is(tmp_path):
    source = written(tmp_path, ".ply", ball_splats(COUNT))
    cropped = hyrfpack.convert_splats(source, tmp_path / "a.ply", crop=(-9, -9, -9, 9, 9, 0))
    thinned = hyrfpack.convert_splats(source, tmp_path / "b.ply", min_opacity=0.6)
    assert cropped.psnr == 100 and thinned.psnr < 40


def test_what_the_format_cannot_hold_is_told(tmp_path):
    told: list[str] = []
    hyrfpack.convert_splats(
        written(tmp_path, ".ply", ball_splats(COUNT, degree=3)), tmp_path / "a.splat", say=told.append
    )
    assert told == [".splat holds no harmonics above degree 0; those of degree 3 are lost"]


def test_progress_is_reported_in_order(tmp_path):
    told: list[tuple[str, float]] = []
    source = written(tmp_path, ".ply", ball_splats(COUNT))
    hyrfpack.convert_splats(source, tmp_path / "a.spz", report=lambda *said: told.append(said))
    shares = [share for _, share in told]
    assert shares == sorted(shares) and 0 <= shares[0] and shares[-1] <= 1
    assert told[0][0] == "reading before.ply" and told[-1][0] == "comparing view 2/2"


@pytest.mark.parametrize(
    ("source", "target", "sentence"),
    [
        ("model.hyrf", "a.ply", "this is a model, not splats; write it with 'hyrfpack export model.hyrf -o a.ply'"),
        ("photo.png", "a.ply", "this is not a file of splats"),
        ("a.ply", "b.hyrf", "to a model, which has to learn from them; run 'hyrfpack import a.ply -o b.hyrf'"),
        ("a.ply", "b.compressed.ply", "compressed PLY is read, not written"),
        ("a.ply", "b.txt", "the file extension does not name a known format"),
        ("missing.ply", "b.spz", "cannot be read"),
    ],
)
def test_what_cannot_be_converted_is_refused_with_what_to_do(source, target, sentence, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    written(tmp_path, ".ply", ball_splats(5)).rename("a.ply")
    with pytest.raises(HyrfError, match="(?s)" + sentence.replace("(", r"\(")):
        hyrfpack.convert_splats(source, target)
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]


def test_the_source_is_never_replaced(tmp_path):
    source = written(tmp_path, ".ply", ball_splats(5))
    with pytest.raises(HyrfError, match="the output is an input itself"):
        hyrfpack.convert_splats(source, source)


def test_splats_that_a_format_cannot_reach_are_refused_before_anything_is_written(tmp_path):
    splats = ball_splats(5)
    positions = splats.positions + [2 * FORMATS[".spz"].max_coordinate, 0, 0]
    far = Splats(positions, splats.scales, splats.quats, splats.opacities, splats.harmonics)
    with pytest.raises(HyrfError, match="choose another format"):
        hyrfpack.convert_splats(written(tmp_path, ".ply", far), tmp_path / "a.spz")
    assert not (tmp_path / "a.spz").exists()


def test_splats_that_cannot_be_seen_are_refused(tmp_path):
    splats = ball_splats(5)
    unseen = Splats(splats.positions, splats.scales * 0, splats.quats, splats.opacities, splats.harmonics)
    with pytest.raises(HyrfDataError, match="no Gaussian is visible"):
        hyrfpack.convert_splats(written(tmp_path, ".splat", unseen), tmp_path / "a.spz")

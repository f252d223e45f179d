"""Convert splats from one format to another and report the loss."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from explicit_balls import ball_splats

import hyrfpack
from hyrfpack.config.export import ConvertConfig
from hyrfpack.errors import HyrfDataError, HyrfError
from hyrfpack.splats.files import READABLE_ENDINGS, read_splats
from hyrfpack.splats.formats import sog
from hyrfpack.splats.formats.hints import NO_HINTS
from hyrfpack.splats.splats import Splats
from hyrfpack.splats.table import FORMATS

GAUSSIAN_COUNT = 60


@pytest.fixture(autouse=True)
def measure_few_small_views(monkeypatch):
    from hyrfpack.export import conversion

    monkeypatch.setattr(conversion, "MEASURED_VIEWS", 2)
    monkeypatch.setattr(conversion, "MEASURED_SIZE_PIXELS", 32)


def write_splats(folder: Path, ending: str, splats: Splats) -> Path:
    path = folder / f"before{ending}"
    path.write_bytes(FORMATS[ending].encode(splats, NO_HINTS))
    return path


# `make test` takes every format before and after .ply, `make test-all` takes all pairs.
@pytest.mark.parametrize(
    ("before", "after"),
    [
        pytest.param(before, after, marks=[] if ".ply" in (before, after) else pytest.mark.acceptance)
        for before, after in product(READABLE_ENDINGS, FORMATS)
    ],
)
def test_every_pair_of_formats_keeps_positions_and_appearance(before, after, tmp_path):
    if FORMATS[after].module:
        pytest.importorskip(FORMATS[after].module)
    source, target = write_splats(tmp_path, before, ball_splats(GAUSSIAN_COUNT)), tmp_path / f"after{after}"
    report = hyrfpack.convert_splats(source, target)
    original, converted = (
        FORMATS[before].decode(source.read_bytes(), "it"),
        FORMATS[after].decode(target.read_bytes(), "it"),
    )
    assert (report.bytes_before, report.bytes_after) == (source.stat().st_size, target.stat().st_size)
    assert report.gaussians_before == report.gaussians_after == len(converted) == GAUSSIAN_COUNT
    assert report.degree_before == original.degree == min(1, FORMATS[before].max_degree)
    assert report.degree_after == converted.degree == min(original.degree, FORMATS[after].max_degree)
    nearest = np.linalg.norm(converted.positions[:, None] - original.positions, axis=-1).min(axis=0)
    assert nearest.max() < 2e-3
    lost_harmonics = original.degree > converted.degree
    assert report.views == 2 and report.psnr_worst <= report.psnr
    assert report.psnr > (15 if lost_harmonics else 35)


def with_outlying_color(splats: Splats) -> Splats:
    harmonics = splats.harmonics.copy()
    harmonics[0, 0, 0] = 1e30
    return replace(splats, harmonics=harmonics)


@pytest.mark.parametrize(
    ("ending", "change"),
    [
        pytest.param(".spz", lambda s: replace(s, positions=s.positions + (5e5, 4e6, 100)), id="far"),
        pytest.param(".sog", with_outlying_color, id="outlier"),
    ],
)
def test_a_low_psnr_by_rounding_is_a_warning_that_names_other_formats(ending, change, tmp_path, caplog):
    source = write_splats(tmp_path, ".ply", change(ball_splats(300)))  # more colours than a codebook
    report = hyrfpack.convert_splats(source, tmp_path / f"after{ending}")
    assert report.psnr < 30
    assert f"{ending} leaves {report.psnr:.1f} dB, because its numbers are too coarse" in caplog.text
    assert "choose another format (.glb, .usda, .usdc, .usdz)" in caplog.text
    caplog.clear()
    assert hyrfpack.convert_splats(source, tmp_path / "after.glb").psnr > 60
    assert not caplog.text


def write_text_ply(path: Path, splats: Splats) -> Path:
    """Write splats as a text PLY, whose positions may have all digits of float64."""
    header, _, body = FORMATS[".ply"].encode(splats, NO_HINTS).partition(b"end_header\n")
    others = np.frombuffer(body, "<f4").reshape(len(splats), -1)[:, 3:]
    rows = np.column_stack((splats.positions, others.astype(np.float64)))
    lines = header.decode().replace("binary_little_endian", "ascii").replace("property float", "property double")
    path.write_text(lines + "end_header\n" + "\n".join(" ".join(map(repr, row)) for row in rows.tolist()) + "\n")
    return path


@pytest.mark.parametrize("ending", [".ply", ".splat"])
def test_a_format_without_an_origin_of_its_own_is_reported_for_map_coordinates(ending, tmp_path, caplog):
    splats = ball_splats(GAUSSIAN_COUNT, degree=0)
    splats.positions[:], splats.scales[:] = 0.2 * splats.positions + (5e5, 4e6, 100), np.float32(0.2) * splats.scales
    source = write_text_ply(tmp_path / "survey.ply", splats)
    report = hyrfpack.convert_splats(source, tmp_path / f"after{ending}")
    assert report.psnr < 30
    assert f"{ending} leaves {report.psnr:.1f} dB, because its numbers are too coarse" in caplog.text
    assert "choose another format (.glb, .usda, .usdc, .usdz)" in caplog.text
    caplog.clear()
    assert hyrfpack.convert_splats(source, tmp_path / "after.glb").psnr > 60
    assert not caplog.text


def test_what_is_left_out_on_purpose_is_not_reported_as_rounding(tmp_path, caplog):
    source = write_splats(tmp_path, ".ply", ball_splats(GAUSSIAN_COUNT))
    report = hyrfpack.convert_splats(source, tmp_path / "after.spz", ConvertConfig(min_opacity=0.6, degree=0))
    assert report.psnr < 30 and "too coarse" not in caplog.text


def test_a_lossless_format_has_the_maximum_psnr(tmp_path):
    report = hyrfpack.convert_splats(
        write_splats(tmp_path, ".ply", ball_splats(GAUSSIAN_COUNT)), tmp_path / "after.usdc"
    )
    assert report.psnr == report.psnr_worst == 100


def test_a_loose_sog_is_bundled_and_the_size_of_all_its_files_is_reported(tmp_path):
    folder = tmp_path / "loose"
    folder.mkdir()
    for name, data in sog.encode_files(ball_splats(GAUSSIAN_COUNT)).items():
        (folder / name).write_bytes(data)
    report = hyrfpack.convert_splats(folder, tmp_path / "bundled.sog")
    assert report.bytes_before == sum(path.stat().st_size for path in folder.iterdir())
    assert hyrfpack.convert_splats(folder / "meta.json", tmp_path / "again.sog").bytes_before == report.bytes_before


def test_degree_crop_and_min_opacity_reduce_the_splats(tmp_path):
    splats = ball_splats(GAUSSIAN_COUNT, degree=2)
    source = write_splats(tmp_path, ".ply", splats)
    box = (-9, -9, -9, 9, 9, 0)
    report = hyrfpack.convert_splats(source, tmp_path / "a.ply", ConvertConfig(degree=1, crop=box, min_opacity=0.6))
    converted = read_splats(tmp_path / "a.ply")
    assert len(converted) == ((splats.positions[:, 2] <= 0) & (splats.opacities >= 0.6)).sum()
    assert (report.gaussians_before, report.gaussians_after) == (GAUSSIAN_COUNT, len(converted))
    assert (report.degree_before, report.degree_after, converted.degree) == (2, 1, 1)


def test_a_crop_has_no_loss_but_min_opacity_has(tmp_path):
    source = write_splats(tmp_path, ".ply", ball_splats(GAUSSIAN_COUNT))
    cropped = hyrfpack.convert_splats(source, tmp_path / "a.ply", ConvertConfig(crop=(-9, -9, -9, 9, 9, 0)))
    thinned = hyrfpack.convert_splats(source, tmp_path / "b.ply", ConvertConfig(min_opacity=0.6))
    assert cropped.psnr == 100 and thinned.psnr < 40


def test_lost_harmonics_are_reported(tmp_path, caplog):
    hyrfpack.convert_splats(write_splats(tmp_path, ".ply", ball_splats(GAUSSIAN_COUNT, degree=3)), tmp_path / "a.splat")
    assert caplog.messages == [".splat stores harmonics up to degree 0; higher ones, up to degree 3, are lost"]


@pytest.mark.parametrize(
    ("unit", "large", "expected"),
    [
        pytest.param(1, None, None, id="meters"),
        pytest.param(1, 1e-7, None, id="flat"),  # so thin that its thickness does not show
        pytest.param(
            1, 1500, r"scales of 6 of 60 Gaussians are larger than 379 units, the limit of \.spz,", id="large"
        ),
        pytest.param(1e-4, None, r"scales of 60 of 60 Gaussians are smaller than 4\.54e-05 units,", id="small"),
    ],
)
def test_scales_that_spz_clamps_are_reported(unit, large, expected, tmp_path, caplog):
    splats = ball_splats(GAUSSIAN_COUNT)
    splats.positions[:], splats.scales[:] = splats.positions * unit, splats.scales * np.float32(unit)
    if large:
        splats.scales[::10, 0] = large
    hyrfpack.convert_splats(write_splats(tmp_path, ".ply", splats), tmp_path / "a.spz")
    messages = [message for message in caplog.messages if "scales of" in message]
    assert len(messages) == (expected is not None)
    if expected:
        assert re.search(expected + r".*choose another format, or .*`scale`", messages[0])
    assert hyrfpack.convert_splats(tmp_path / "before.ply", tmp_path / "a.sog").psnr > 20
    assert len([message for message in caplog.messages if "scales of" in message]) == len(messages)


def test_progress_is_reported_in_order(tmp_path):
    messages: list[tuple[str, float]] = []
    context = hyrfpack.RunContext(progress=lambda event: messages.append((event.task, event.share)))
    source = write_splats(tmp_path, ".ply", ball_splats(GAUSSIAN_COUNT))
    hyrfpack.convert_splats(source, tmp_path / "a.spz", context=context)
    shares = [share for _, share in messages]
    assert shares == sorted(shares) and 0 <= shares[0] and shares[-1] <= 1
    assert messages[0][0] == "reading before.ply" and messages[-1][0] == "comparing view 2/2"


@pytest.mark.parametrize(
    ("source", "target", "sentence"),
    [
        ("model.hyrf", "a.ply", "this is a model, not splats; write it with 'hyrfpack export model.hyrf -o a.ply'"),
        ("photo.png", "a.ply", "this is not a file of splats"),
        ("a.ply", "b.hyrf", "are imported as a model, not converted; run 'hyrfpack import a.ply -o b.hyrf'"),
        ("my ball.hyrf", "a.ply", "write it with 'hyrfpack export 'my ball.hyrf' -o a.ply'"),
        ("a.ply", "my ball.hyrf", "run 'hyrfpack import a.ply -o 'my ball.hyrf''"),
        ("a.ply", "b.compressed.ply", "compressed PLY is read, not written"),
        ("a.ply", "b.mesh.ply", ".mesh.ply is not a format of splats; use one of .ply, .splat"),
        ("a.ply", "b.POINTS.glb", ".points.glb is not a format of splats"),
        ("a.ply", "b.collision.ply", "a collision mesh is not written in this format"),
        ("a.ply", "b.html", ".html is not a format of splats"),
        ("a.ply", "b.txt", "the file extension does not name a known format"),
        ("missing.ply", "b.spz", "cannot be read"),
    ],
)
def test_unsupported_conversions_are_refused_with_what_to_do(source, target, sentence, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_splats(tmp_path, ".ply", ball_splats(5)).rename("a.ply")
    with pytest.raises(HyrfError, match="(?s)" + sentence.replace("(", r"\(")):
        hyrfpack.convert_splats(source, target)
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]


def test_a_streamed_sog_is_refused_with_the_folders_to_name(tmp_path):
    (tmp_path / "lod-meta.json").touch()
    with pytest.raises(HyrfError, match="name one of the folders in it, such as 0_0"):
        hyrfpack.convert_splats(tmp_path, tmp_path / "a.ply")


def test_a_version_of_spz_is_refused_for_another_format(tmp_path):
    source = write_splats(tmp_path, ".spz", ball_splats(5))
    with pytest.raises(HyrfError, match=r"after.ply: only .spz files have a version; leave out `spz_version`"):
        hyrfpack.convert_splats(source, tmp_path / "after.ply", ConvertConfig(spz_version=3))
    assert [path.name for path in tmp_path.iterdir()] == ["before.spz"]


def test_the_source_is_never_overwritten(tmp_path):
    source = write_splats(tmp_path, ".ply", ball_splats(5))
    with pytest.raises(HyrfError, match="the output is an input itself"):
        hyrfpack.convert_splats(source, source)


def test_splats_out_of_a_formats_range_are_refused_before_anything_is_written(tmp_path):
    splats = ball_splats(5)
    positions = splats.positions + [2 * FORMATS[".spz"].max_coordinate, 0, 0]
    far = Splats(positions, splats.scales, splats.quats, splats.opacities, splats.harmonics)
    with pytest.raises(HyrfError, match="choose another format"):
        hyrfpack.convert_splats(write_splats(tmp_path, ".ply", far), tmp_path / "a.spz")
    assert not (tmp_path / "a.spz").exists()


@pytest.mark.parametrize("config", [None, ConvertConfig(crop=(0, 0, 0, 1, 1, 1))])
def test_an_empty_file_is_refused_as_such(config, tmp_path):
    source = write_splats(tmp_path, ".ply", ball_splats(5)[:0])
    with pytest.raises(HyrfDataError, match=r"before\.ply: there is no Gaussian in it; name another file$"):
        hyrfpack.convert_splats(source, tmp_path / "a.spz", config)
    with pytest.raises(HyrfDataError, match=r"before\.ply: there is no Gaussian in it; name another file$"):
        hyrfpack.import_splats(source, tmp_path / "a.hyrf")


def test_invisible_splats_are_refused(tmp_path):
    splats = ball_splats(5)
    unseen = Splats(splats.positions, splats.scales * 0, splats.quats, splats.opacities, splats.harmonics)
    with pytest.raises(HyrfDataError, match="no Gaussian is visible"):
        hyrfpack.convert_splats(write_splats(tmp_path, ".splat", unseen), tmp_path / "a.spz")

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from commands import refused, succeeded
from explicit_balls import ball_splats

from hyrfpack.cameras.files import cameras_to_json
from hyrfpack.data import load_scene
from hyrfpack.demo.scene import write_demo_scene
from hyrfpack.imports import pack
from hyrfpack.splats.draw import Drawable
from hyrfpack.splats.formats import ply
from hyrfpack.splats.viewpoints import WeightedSplats, sample_viewpoints

QUICK_OPTIONS = ("--size", 24)
pytestmark = pytest.mark.usefixtures("quick_calibration", "quick_import")


@pytest.fixture
def source(tmp_path: Path) -> Path:
    path = tmp_path / "ball.ply"
    path.write_bytes(ply.encode(ball_splats(40)))
    return path


@pytest.fixture
def cameras(tmp_path: Path) -> Path:
    weighted = WeightedSplats.from_splats(ball_splats(40), "ball")
    made = sample_viewpoints(weighted, Drawable.from_splats(ball_splats(40), weighted.frame), 9, 48, 3)
    path = tmp_path / "cameras.json"
    path.write_text(cameras_to_json([(str(number), camera) for number, camera in enumerate(made)]))
    return path


def test_import_uses_the_cameras_and_prints_its_results(source: Path, cameras: Path, tmp_path: Path) -> None:
    target = tmp_path / "ball.hyrf"
    result = succeeded("import", source, "-o", target, *QUICK_OPTIONS, "--cameras", cameras, "--json")
    numbers = json.loads(result.stdout)
    assert numbers["views"] == 2  # the first and the ninth of nine
    assert numbers["bytes_after"] == target.stat().st_size
    assert numbers["bytes_source"] == source.stat().st_size
    words = succeeded("import", source, "-o", target, *QUICK_OPTIONS, "--cameras", cameras, "--overwrite").stdout
    assert f"{numbers['bytes_after']:,}" in words
    assert f"mean {numbers['psnr']:.2f} dB" in words


def test_a_missing_device_is_rejected_before_any_work(source: Path, tmp_path: Path) -> None:
    target = tmp_path / "ball.hyrf"
    target.write_bytes(b"kept")
    messages = refused("import", source, "-o", target, *QUICK_OPTIONS, "--device", "cuda:9", "--overwrite")
    assert "device 'cuda:9' is not available" in messages and "--device cpu" in messages
    assert target.read_bytes() == b"kept"


def test_cameras_can_come_from_a_set_of_photos(source: Path, tmp_path: Path) -> None:
    photos = write_demo_scene(tmp_path / "photos", views=10, size=24)
    result = succeeded("import", source, "-o", tmp_path / "x.hyrf", *QUICK_OPTIONS, "--cameras", photos, "--json")
    assert json.loads(result.stdout)["views"] == 2
    assert "8 given viewpoints" in result.stderr


def test_notes_on_the_photos_of_cameras_are_printed(source: Path, tmp_path: Path) -> None:
    photos = write_demo_scene(tmp_path / "photos", views=10, size=24)
    next((photos / "images").iterdir()).unlink()
    result = succeeded("import", source, "-o", tmp_path / "x.hyrf", *QUICK_OPTIONS, "--cameras", photos)
    assert any(sentence in result.stderr for sentence in load_scene(photos).notes)


@pytest.mark.parametrize("place", ["x.hyrf", "images/x.hyrf"])
def test_no_import_is_written_among_the_photos_of_its_cameras(place: str, source: Path, tmp_path: Path) -> None:
    photos = write_demo_scene(tmp_path / "photos", views=10, size=24)
    before = sorted(tmp_path.rglob("*"))
    sentence = refused("import", source, "-o", photos / place, "--cameras", photos, "--overwrite", *QUICK_OPTIONS)
    assert "the same command reads what lies in this folder" in sentence
    assert sorted(tmp_path.rglob("*")) == before


def test_the_cameras_file_of_3dgs_training_is_used(source: Path, cameras: Path, tmp_path: Path) -> None:
    left = tmp_path / "output"
    cloud = left / "point_cloud" / "iteration_30000" / "point_cloud.ply"
    cloud.parent.mkdir(parents=True)
    shutil.copy(source, cloud)
    shutil.copy(cameras, left / "cameras.json")

    result = succeeded("import", cloud, "-o", tmp_path / "x.hyrf", *QUICK_OPTIONS)

    assert str(left / "cameras.json") in result.stderr and "7 given viewpoints" in result.stderr


def test_photos_without_poses_are_rejected_as_cameras(source: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    sentence = refused("import", source, "-o", tmp_path / "x.hyrf", "--cameras", tmp_path / "empty")
    assert "empty" in sentence and not (tmp_path / "x.hyrf").exists()


def test_import_without_cameras_samples_viewpoints_and_creates_missing_folders(source: Path, tmp_path: Path) -> None:
    result = succeeded("import", source, "-o", tmp_path / "not" / "yet" / "ball.hyrf", *QUICK_OPTIONS)
    assert "sampled viewpoints" in result.stderr  # as there is no file of cameras
    assert (tmp_path / "not" / "yet" / "ball.hyrf").is_file()


def test_invalid_inputs_of_import_are_a_clear_error(source: Path, tmp_path: Path) -> None:
    target = tmp_path / "x.hyrf"
    assert "nothing.ply" in refused("import", tmp_path / "nothing.ply", "-o", target)
    assert "name another file" in refused("import", source, "-o", source)
    both = refused("import", source, "-o", target, "--psnr", 37, "--target-size", "20kB")
    assert "decide how large the file is; give one of --target-size and --psnr" in both
    (tmp_path / "broken.ply").write_bytes(source.read_bytes()[:-7])
    assert "broken.ply" in refused("import", tmp_path / "broken.ply", "-o", target)
    assert "JSON" in refused("import", source, "-o", target, "--cameras", source)
    assert not target.exists()


@pytest.mark.acceptance
def test_import_reports_a_missed_target(source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pack, "MAX_TRIALS", 1)
    monkeypatch.setattr(pack, "PLANNED_ERROR_SHARE", 16.0)  # makes the only file miss the target
    result = succeeded("import", source, "-o", tmp_path / "x.hyrf", *QUICK_OPTIONS, "--psnr", 40, "--json")
    numbers = json.loads(result.stdout)
    assert numbers["psnr_asked"] == 40
    assert (
        f"the target PSNR is 40 dB, but the file reaches {numbers['psnr']:.1f} dB at held-out viewpoints"
        in result.stderr
    )
    assert "set a higher target with --psnr" in result.stderr

"""Models are merged without a change of their bytes, placed where they should be, and taken out again."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import refused, succeeded
from scenes import QUIET_CONTEXT, ball_scene, small_model

from hyrfpack.cameras.capture import Capture
from hyrfpack.compress import compress_model
from hyrfpack.config.compress import CompressConfig
from hyrfpack.config.edit import Center, Scale, Translate
from hyrfpack.edit import edit_model, merge_models
from hyrfpack.errors import HyrfError
from hyrfpack.evaluate.metrics import psnr
from hyrfpack.format import describe_file, load_merged_model, load_model, save_model
from hyrfpack.model.merged import MergedModel
from hyrfpack.render import render_view
from hyrfpack.scene import Camera

pytestmark = pytest.mark.usefixtures("quick_calibration")
GOLDEN_FOLDER = Path(__file__).parents[1] / "golden" / "trained"
COMPACT_FILE = GOLDEN_FOLDER / "demo_compact.hyrf"
MAP_FILE = GOLDEN_FOLDER / "exposed_balls.hyrf"


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path]:
    """Return copies of a scene and of an object with an exposure map, in the current folder."""
    monkeypatch.chdir(tmp_path)
    room, balls = tmp_path / "room.hyrf", tmp_path / "balls.hyrf"
    room.write_bytes(COMPACT_FILE.read_bytes())
    balls.write_bytes(MAP_FILE.read_bytes())
    return room, balls


def first_camera(path: Path) -> Camera:
    return Capture(describe_file(path)).cameras[0]


def moved_camera(camera: Camera, factor: float, offset: tuple[float, float, float]) -> Camera:
    """Return the camera that sees p' = factor p + offset as `camera` sees p."""
    pose = camera.camera_from_world.copy()
    pose[:3, 3] = factor * pose[:3, 3] - pose[:3, :3] @ np.array(offset)
    return replace(camera, camera_from_world=pose)


def test_merged_models_keep_their_bytes(tmp_path: Path, files: tuple[Path, Path]):
    report = merge_models(files, tmp_path / "both.hyrf")

    facts = describe_file(report.file)
    assert [part.name for part in report.parts] == [part["name"] for part in facts["parts"]] == ["room", "balls"]
    assert report.bytes == facts["bytes"] == (tmp_path / "both.hyrf").stat().st_size
    for name, source in zip(("room", "balls"), files, strict=True):
        edit_model(tmp_path / "both.hyrf", tmp_path / "out.hyrf", [], part=name)
        assert load_model(tmp_path / "out.hyrf").config == load_model(source).config
        assert (tmp_path / "out.hyrf").read_bytes() == source.read_bytes()


def test_a_moved_part_is_seen_by_the_moved_camera_as_before(tmp_path: Path, files: tuple[Path, Path]):
    room, balls = files
    offset = (400.0, -30.0, 2.0)
    merge_models([room, balls], tmp_path / "both.hyrf", {"balls": [Scale(2.5), Translate(offset)]})
    camera = first_camera(balls)

    merged = load_merged_model(tmp_path / "both.hyrf")
    picture = render_view(merged, moved_camera(camera, 2.5, offset), depth=True)
    alone = render_view(load_model(balls), camera, depth=True)

    covered = alone.alpha > 0.99
    assert covered.any()
    assert psnr(picture.rgb[covered], alone.rgb[covered]) > 45
    np.testing.assert_allclose(picture.depth[covered], 2.5 * alone.depth[covered], rtol=0.01)


def test_a_merged_file_shows_the_scene_where_the_other_part_is_far_away(tmp_path: Path, files: tuple[Path, Path]):
    merge_models(files, tmp_path / "both.hyrf", {"balls": [Translate((1e4, 0.0, 0.0))]})
    camera = first_camera(files[0])

    merged, alone = load_merged_model(tmp_path / "both.hyrf"), load_model(files[0])

    assert psnr(render_view(merged, camera).rgb, render_view(alone, camera).rgb) > 60


def test_a_merged_file_can_be_merged_and_moved_again(tmp_path: Path, files: tuple[Path, Path]):
    merge_models(files, tmp_path / "both.hyrf", {"balls": [Translate((3.0, 0.0, 0.0))]})

    report = merge_models([tmp_path / "both.hyrf", files[1]], tmp_path / "three.hyrf", {"both": [Scale(2.0)]})

    assert [part.name for part in report.parts] == ["room", "balls", "balls 2"]
    centers = [np.array(part.config.frame.center) for part in load_merged_model(report.file).parts]
    expected = [np.array(load_model(path).config.frame.center) for path in (*files, files[1])]
    np.testing.assert_allclose(centers[0], 2 * expected[0])
    np.testing.assert_allclose(centers[1], 2 * (expected[1] + (3, 0, 0)))
    np.testing.assert_allclose(centers[2], expected[2])


def test_the_viewpoint_and_the_cameras_are_those_of_the_scene(tmp_path: Path, files: tuple[Path, Path]):
    merge_models(files, tmp_path / "both.hyrf")

    assert describe_file(tmp_path / "both.hyrf")["provenance"] == describe_file(files[0])["provenance"]


def test_the_same_merge_gives_the_same_bytes(tmp_path: Path, files: tuple[Path, Path]):
    for name in ("a.hyrf", "b.hyrf"):
        merge_models(files, tmp_path / name, {"balls": [Scale(2.0)]})

    assert (tmp_path / "a.hyrf").read_bytes() == (tmp_path / "b.hyrf").read_bytes()


def test_control_characters_of_a_file_name_are_left_out(tmp_path: Path, files: tuple[Path, Path]):
    odd = tmp_path / ("a\u2028b" + "x" * 90 + ".hyrf")
    os.rename(files[1], odd)

    report = merge_models([files[0], odd, odd], tmp_path / "both.hyrf")

    assert [part.name for part in report.parts][1:] == ["ab" + "x" * 59, "ab" + "x" * 59 + " 2"]


def test_models_that_one_picture_cannot_show_are_refused(tmp_path: Path, files: tuple[Path, Path]):
    other = tmp_path / "other.hyrf"
    save_model(small_model(np.zeros((3, 3)), antialiased=not load_model(files[0]).config.antialiased), other)

    with pytest.raises(HyrfError, match="antialiased"):
        merge_models([files[0], other], tmp_path / "both.hyrf")

    assert not (tmp_path / "both.hyrf").exists()


def test_more_parts_than_a_file_holds_are_refused(tmp_path: Path, files: tuple[Path, Path]):
    assert len(merge_models([files[0]] * 64, tmp_path / "most.hyrf").parts) == 64

    for count in (65, 200):
        with pytest.raises(HyrfError, match="more than 64 parts"):
            merge_models([files[0]] * count, tmp_path / "many.hyrf")
    with pytest.raises(HyrfError, match="more than 64 parts"):
        merge_models([tmp_path / "most.hyrf", files[1]], tmp_path / "many.hyrf")
    assert not (tmp_path / "many.hyrf").exists()


def test_a_model_without_gaussians_is_refused(tmp_path: Path, files: tuple[Path, Path]):
    save_model(small_model(np.zeros((0, 3)), background=True), tmp_path / "empty.hyrf")

    for sources in ((files[0], "empty.hyrf"), ("empty.hyrf", files[0])):
        with pytest.raises(HyrfError, match=r"empty.hyrf: there is no Gaussian in it to merge"):
            merge_models(sources, tmp_path / "both.hyrf")
    assert not (tmp_path / "both.hyrf").exists()


def test_an_action_that_is_not_a_move_is_a_type_error(tmp_path: Path, files: tuple[Path, Path]):
    with pytest.raises(TypeError, match="is not a move"):
        merge_models(files, tmp_path / "both.hyrf", {"balls": [Center()]})  # type: ignore[list-item]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("room.hyrf balls.hyrf -o out.hyrf --translate lamp=1,0,0", "'lamp', but none of the models room, balls"),
        ("room.hyrf room.hyrf -o out.hyrf --scale room=2", "more than one of the models"),
        ("room.hyrf balls.hyrf -o out.hyrf --translate balls=1,0", "is not 3 numbers"),
        ("room.hyrf balls.hyrf -o out.hyrf --translate 1,0,0", "names no model"),
        ("room.hyrf balls.hyrf -o out.hyrf --scale balls=0", "--scale"),
        ("room.hyrf balls.hyrf -o out.hyrf --scale balls=1e300", "move and scale it by less"),
        ("room.hyrf balls.hyrf -o out.hyrf --scale room=1e-300", "move and scale it by less"),
        (
            "room.hyrf balls.hyrf -o out.hyrf --translate room=1e308,0,0 --translate room=1e308,0,0",
            "move and scale it by less",
        ),
        ("room.hyrf balls.hyrf -o room.hyrf --overwrite", "room.hyrf"),
        ("room.hyrf missing.hyrf -o out.hyrf", "missing.hyrf"),
        ("room.hyrf balls.hyrf -o out.ply", ".hyrf"),
        ("-o out.hyrf", "MODELS"),
    ],
)
def test_bad_requests_get_one_message(tmp_path: Path, files: tuple[Path, Path], arguments: str, message: str):
    before = {path.name: path.read_bytes() for path in files}

    error = refused("merge", *arguments.split())

    assert message in error
    assert {path.name: path.read_bytes() for path in tmp_path.glob("*")} == before


def test_a_folder_gives_its_whole_name(tmp_path: Path, files: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch):
    run = tmp_path / "room.v1.2"
    run.mkdir()
    (run / "model.hyrf").write_bytes(files[0].read_bytes())
    monkeypatch.chdir(run)

    by_name = merge_models([run, files[1]], tmp_path / "a.hyrf", {"room.v1.2": [Scale(2.0)]})
    from_inside = merge_models([".", files[1]], tmp_path / "b.hyrf")

    assert [part.name for part in by_name.parts] == [part.name for part in from_inside.parts] == ["room.v1.2", "balls"]


def test_a_message_about_a_part_names_the_merged_file(tmp_path: Path, files: tuple[Path, Path]):
    plain = save_model(small_model([[0.0, 0.0, 0.0]]), tmp_path / "plain.hyrf", "raw").file
    merge_models([files[0], plain], tmp_path / "both.hyrf")

    error = refused("edit", "both.hyrf", "--plan", "--part", "plain", "--up", "auto")

    assert error.startswith("Error: both.hyrf: this file keeps no cameras")


def test_the_commands_read_what_merge_writes(tmp_path: Path, files: tuple[Path, Path]):
    run = "merge room.hyrf balls.hyrf -o both.hyrf --scale balls=0.5 --translate balls=1,0,0 --json"
    report = json.loads(succeeded(*run.split()).stdout)
    assert [part["name"] for part in report["parts"]] == ["room", "balls"]

    shown = succeeded("info", "both.hyrf").stdout
    assert "room" in shown and "balls" in shown and "format 1.4" in shown
    succeeded("render", "both.hyrf", "--orbit", "2", "-o", "pictures")
    assert len(list((tmp_path / "pictures").glob("*.png"))) == 2
    succeeded("edit", "both.hyrf", "-o", "again.hyrf", "--part", "balls")
    assert len(load_model(tmp_path / "again.hyrf")) == len(load_model(files[1]))
    succeeded("decompress", "both.hyrf", "-o", "raw.hyrf")
    assert [part["profile"] for part in describe_file("raw.hyrf")["parts"]] == ["raw", "raw"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("edit both.hyrf -o out.hyrf --part lamp", "holds the parts 'room', 'balls'"),
        ("edit room.hyrf -o out.hyrf --part lamp", "one model and no parts"),
    ],
)
def test_what_needs_one_model_says_so(tmp_path: Path, files: tuple[Path, Path], arguments: str, message: str):
    merge_models(files, tmp_path / "both.hyrf")

    assert message in refused(*arguments.split())
    assert not list(tmp_path.glob("out.*"))


def test_fine_tuning_needs_one_model(tmp_path: Path, files: tuple[Path, Path]):
    merge_models(files, tmp_path / "both.hyrf")

    with pytest.raises(HyrfError, match="compress the models before they are merged"):
        compress_model("both.hyrf", "out.hyrf", CompressConfig(finetune_steps=5), data=ball_scene(4))


@pytest.mark.acceptance
def test_each_part_of_a_merged_file_is_compressed_by_itself(tmp_path: Path, files: tuple[Path, Path]):
    merge_models(files, tmp_path / "both.hyrf", {"balls": [Translate((1.0, 0.0, 0.0))]})
    report = compress_model(tmp_path / "both.hyrf", tmp_path / "small.hyrf", context=QUIET_CONTEXT)
    assert report.bytes_after == (tmp_path / "small.hyrf").stat().st_size < (tmp_path / "both.hyrf").stat().st_size

    for name in ("room", "balls"):
        edit_model(tmp_path / "both.hyrf", tmp_path / "part.hyrf", [], part=name, context=QUIET_CONTEXT)
        compress_model(tmp_path / "part.hyrf", tmp_path / "alone.hyrf", context=QUIET_CONTEXT)
        edit_model(tmp_path / "small.hyrf", tmp_path / "taken.hyrf", [], part=name, context=QUIET_CONTEXT)
        alone, taken = load_model(tmp_path / "alone.hyrf"), load_model(tmp_path / "taken.hyrf")
        assert taken.config == alone.config and describe_file(tmp_path / "taken.hyrf")["profile"] == "compact"
        assert all((a == b).all() for a, b in zip(alone.parameters(), taken.parameters(), strict=True))

    succeeded("compress", "both.hyrf", "-o", "paper.hyrf", "--profile", "paper")
    assert len(load_merged_model(tmp_path / "paper.hyrf")) == len(load_merged_model(tmp_path / "both.hyrf"))


def test_a_merged_model_of_one_part_is_that_model(files: tuple[Path, Path]):
    merged = load_merged_model(files[0])

    assert isinstance(merged, MergedModel) and len(merged.parts) == 1

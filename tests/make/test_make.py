"""Which stages a call of `make` runs or reuses, its inputs, outputs and errors. The expensive work is faked."""

from __future__ import annotations

import json
import re
import shutil
import zipfile
from pathlib import Path
from types import SimpleNamespace

import pytest
from commands import hyrfpack, refused, succeeded
from denied_access import deny_access
from explicit_balls import ball_splats
from PIL import Image

from hyrfpack import load_model, load_scene
from hyrfpack.cli.make import _viewing_hint
from hyrfpack.config.make import MakeConfig
from hyrfpack.config.train import TrainConfig
from hyrfpack.context import RunContext
from hyrfpack.data import PictureCache
from hyrfpack.errors import HyrfError
from hyrfpack.format.min_file_size import min_file_bytes
from hyrfpack.lock import exclusive_folder
from hyrfpack.make import Stopped, make_scene, stages
from hyrfpack.make.progress import Reporter
from hyrfpack.progress import StageEvent, StepEvent, TaskEvent
from hyrfpack.splats.formats import sog

# One ending of each kind; tests/export covers the others.
OUTPUT_ENDINGS = (".hyrf", ".html", ".spz", ".points.ply", "")
STAGE_NAMES = ["training", "compression", "scoring", "export"]

pytestmark = pytest.mark.usefixtures("fake_stages")


def test_pilot_runs_do_not_count_in_the_forecast_of_training(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr("hyrfpack.make.progress.monotonic", lambda: clock[0])
    messages: list[StageEvent] = []
    reporter = Reporter(["training"], messages.append)
    reporter.estimates |= {"pilots": 10.0, "training": 30.0, "results": 0.0}
    reporter.begin("training")
    shown = stages._TrainingProgress(reporter)
    pilots = [TaskEvent("pilot run", share=step / 480) for step in range(1, 241)]
    for event in [*pilots, *(StepEvent(step, 1000, 0.1, 0.01, 500) for step in range(1, 301))]:
        clock[0] += 0.1
        shown.report_event(event)
    assert messages[240].details == ("pilot run",)
    assert messages[240].share == pytest.approx(0.125)  # half of the pilots, which are a quarter of all steps
    assert messages[-1].share == pytest.approx((10 + 0.3 * 30) / 40) and messages[-1].seconds_left == pytest.approx(
        70.0, rel=0.02
    )


def test_teacher_runs_are_a_part_of_the_training_between_pilot_runs_and_steps():
    messages: list[StageEvent] = []
    reporter = Reporter(["training"], messages.append)
    reporter.estimates |= {"pilots": 10.0, "teachers": 20.0, "training": 30.0, "results": 0.0}
    reporter.begin("training")
    shown = stages._TrainingProgress(reporter)
    events = [
        TaskEvent("pilot run", share=0.5),
        TaskEvent("teacher run 1/3: training", 0.25, 750, 1_000),
        TaskEvent("rendering virtual views"),
        StepEvent(1, 2, 0.1, 0.01, 500),
    ]
    for event, share in zip(events, (5, 15, 15, 45), strict=True):
        shown.report_event(event)
        assert messages[-1].share == pytest.approx(share / 60)


@pytest.mark.parametrize(
    ("steps", "start"), [(2_999, "2,999 steps on "), (3_000, "3 teacher runs of 1,000 steps, then 3,")]
)
def test_the_description_of_the_training_names_teacher_runs(steps, start, posed):
    assert stages.describe_runs(load_scene(posed), TrainConfig(steps)).startswith(start)


def test_a_training_that_resumes_from_its_checkpoint_announces_no_teacher_runs(posed, tmp_path, monkeypatch, caplog):
    def interrupt(scene, run, config, **_):
        run.mkdir(exist_ok=True)
        (run / "checkpoint.pt").write_bytes(b"of step 2,500")
        raise KeyboardInterrupt

    monkeypatch.setattr(stages, "train_model", interrupt)
    monkeypatch.setattr("hyrfpack.train.teachers.usual_steps", lambda pixels: 9)
    for start in ("training: 3 teacher runs of 1,000 steps, then 9 steps on ", "training: 9 steps on "):
        caplog.clear()
        with pytest.raises(Stopped):
            make_scene(posed, tmp_path / "scene.hyrf")
        assert any(message.startswith(start) for message in caplog.messages)


def test_scoring_after_the_last_step_is_part_of_the_training_progress():
    messages: list[StageEvent] = []
    reporter = Reporter(["training"], messages.append)
    reporter.estimates |= {"pilots": 0.0, "training": 30.0, "results": 10.0}
    reporter.begin("training")
    shown = stages._TrainingProgress(reporter)
    shown.report_event(StepEvent(1, 1, 0.1, 0.01, 500))
    assert messages[-1].share == 0.75 and messages[-1].seconds_left > 0
    shown.report_event(TaskEvent("scoring held-out photos", done=1, total=2))
    assert messages[-1].share == 0.875 and messages[-1].details == ("scoring held-out photos 1/2",)


# -- inputs and outputs ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ending", OUTPUT_ENDINGS)
def test_every_kind_of_output_is_written_without_repeating_other_stages(ending, finished_work, posed, tmp_path):
    result = make_scene(posed, tmp_path / f"out{ending}", work=finished_work)
    assert result.kept == ("training", "compression", "scoring")
    assert [path.name for path in (finished_work / "export").iterdir()] == [result.output.name]
    files = [path for path in result.output.rglob("*") if path.is_file()] or [result.output]
    assert result.bytes == sum(path.stat().st_size for path in files) > 100


@pytest.mark.parametrize("name", ["bonsai", "bonsai.v2"])
@pytest.mark.parametrize("inside", [False, True])
def test_a_player_has_the_title_of_its_folder(name, inside, finished_work, tmp_path, monkeypatch):
    (tmp_path / name).mkdir()
    monkeypatch.chdir(tmp_path / name if inside else tmp_path)
    make_scene(finished_work / "model.hyrf", "." if inside else name, work=tmp_path / "work")
    assert f"<title>{name}</title>" in (tmp_path / name / "index.html").read_text()
    assert (tmp_path / name / "README.txt").read_text().startswith(f"{name}\n")


def test_poses_of_photos_without_poses_are_estimated(photos, poses, tmp_path):
    shares: list[StageEvent] = []
    result = make_scene(photos, tmp_path / "scene.hyrf", context=RunContext(progress=shares.append))
    assert poses == [photos]
    assert list(result.seconds) == ["poses", *STAGE_NAMES]
    assert result.poses["left_out"] == {"dark.jpg": "blurred"}
    assert {progress.stage for progress in shares} == {"poses", *STAGE_NAMES}
    for progress in shares:
        assert 0 <= progress.share <= 1 and progress.seconds_left is not None and progress.seconds_left >= 0, progress
    assert len(load_scene(result.work / "scene").views) == 18


@pytest.mark.parametrize("top", ["", "holiday/"])
def test_photos_without_poses_may_come_in_an_archive(top, photos, poses, tmp_path, monkeypatch, caplog):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    with zipfile.ZipFile(tmp_path / "photos.zip", "w") as archive:
        for photo in photos.iterdir():
            archive.write(photo, f"{top}{photo.name}")
    make_scene(tmp_path / "photos.zip", tmp_path / "scene.hyrf", MakeConfig(quality="draft"))
    (folder,) = poses
    assert folder.is_relative_to(tmp_path / "cache") and len(list(folder.rglob("*.png"))) == 18
    assert sum(str(folder) in sentence for sentence in caplog.messages) == 1
    assert len(make_scene(tmp_path / "photos.zip", tmp_path / "scene.hyrf", MakeConfig(quality="draft")).kept) == 5


def test_photos_may_lie_beside_a_meta_json_that_is_not_of_splats(photos, poses, tmp_path):
    (photos / "meta.json").write_text('{"album": "holiday"}')
    make_scene(photos, tmp_path / "scene.hyrf", MakeConfig(quality="draft"))
    assert poses == [photos]


def test_other_files_in_the_folder_of_a_sog_do_not_repeat_its_import(tmp_path):
    recorded = SimpleNamespace(folder=tmp_path, run_stage=lambda name, inputs, execute: inputs)

    def record_inputs() -> dict:
        return stages.run_import_stage(recorded, tmp_path / "loose", 30.0, 0, RunContext())

    (tmp_path / "loose").mkdir()
    files = sog.encode_files(ball_splats(9))
    for name, data in files.items():
        (tmp_path / "loose" / name).write_bytes(data)
    before = record_inputs()
    (tmp_path / "loose" / "notes.txt").write_text("other")
    assert record_inputs() == before
    (tmp_path / "loose" / "quats.webp").write_bytes(files["quats.webp"] + b"0")
    assert record_inputs() != before


def test_photos_with_poses_need_no_estimation(posed, poses, tmp_path):
    make_scene(posed, tmp_path / "scene.hyrf")
    assert not poses


def test_poses_of_a_video_are_estimated(poses, tmp_path):
    (tmp_path / "clip.MP4").write_bytes(b"frames")
    make_scene(tmp_path / "clip.MP4", tmp_path / "scene.hyrf", MakeConfig(quality="draft"))
    assert poses == [tmp_path / "clip.MP4"]


def test_a_model_is_exported(finished_work, tmp_path):
    result = make_scene(finished_work / "model.hyrf", tmp_path / "scene.html")
    assert list(result.seconds) == ["export"] and result.gaussians == len(load_model(finished_work / "model.hyrf"))


@pytest.mark.parametrize("count, held_out", [(3, 0), (8, 1), (15, 1)])
def test_small_sets_hold_out_few_photos(count, held_out, posed, tmp_path):
    shutil.copytree(posed, tmp_path / "few")
    table = tmp_path / "few" / "transforms.json"
    content = json.loads(table.read_text())
    content["frames"] = content["frames"][:count]
    table.write_text(json.dumps(content))
    result = make_scene(tmp_path / "few", tmp_path / "scene.hyrf", MakeConfig(quality="draft"))
    assert result.views == held_out and (result.psnr is None) == (held_out == 0)


def test_the_number_of_gaussians_and_the_preset_are_passed_to_the_training(posed, tmp_path):
    arguments = ("make", posed, "-o", tmp_path / "scene.hyrf", "--max-gaussians", 300, "--preset", "large", "--json")
    choices = json.loads(succeeded(*arguments).stdout)["training"]["choices"]
    assert choices["max_gaussians"].startswith("300: ") and choices["preset"].startswith("large: ")


# -- target sizes ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size, meant", [("10", "10MB"), ("500", "500kB")])
def test_an_impossible_target_size_is_rejected_before_any_work(
    size, meant, posed, photos, poses, tmp_path, monkeypatch
):
    monkeypatch.setattr("hyrfpack.make.stages.train_model", None)
    for given in (posed, photos):
        sentence = refused("make", given, "-o", tmp_path / "scene.html", "--target-size", size)
        assert f"{size} bytes" in sentence and f"did you mean {meant}?" in sentence
        (smallest,) = re.findall(r"smallest possible file, about ([\d,]+) bytes", sentence)
        assert int(smallest.replace(",", "")) >= min_file_bytes()
    assert not poses and not (tmp_path / "scene.work").exists()


def test_another_target_size_packs_the_trained_model_again_and_says_how_to_train_again(
    finished_work, posed, tmp_path, caplog
):
    before = (finished_work / "model.hyrf").read_bytes()
    target = len(before) * 3 // 4
    result = make_scene(posed, tmp_path / "a.hyrf", MakeConfig(target_bytes=target), work=finished_work)
    assert result.kept == ("training",) and result.bytes <= target
    assert any("trained without a target size" in sentence and "`work`" in sentence for sentence in caplog.messages)
    assert make_scene(posed, tmp_path / "b.hyrf", work=finished_work).kept == ("training",)
    assert (tmp_path / "b.hyrf").read_bytes() == before


def test_a_stopped_training_resumes_unchanged_with_another_target_size(posed, tmp_path, monkeypatch, caplog):
    configs = []
    usual = stages.train_model

    def stop(scene, run, config, **options):
        configs.append(config)
        usual(scene, run, config, **options)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(stages, "train_model", stop)
        for target in (30_000, 50_000):
            (tmp_path / "scene.work" / "run" / "metrics.json").unlink(missing_ok=True)
            with pytest.raises(Stopped):
                make_scene(posed, tmp_path / "scene.hyrf", MakeConfig(target_bytes=target))
    assert [config.target_bytes for config in configs] == [30_000, 30_000]
    result = make_scene(posed, tmp_path / "scene.hyrf", MakeConfig(target_bytes=50_000))
    assert result.training["target_bytes"] == 30_000
    assert any("the training that was begun for 30,000 bytes is resumed" in sentence for sentence in caplog.messages)


def test_a_time_limit_and_a_quality_are_refused_together(posed, tmp_path):
    with pytest.raises(HyrfError, match=r"each decide the number of training steps.*`minutes` or `quality`"):
        make_scene(posed, tmp_path / "scene.hyrf", MakeConfig(minutes=1, quality="draft"))
    assert not (tmp_path / "scene.work").exists()


def test_with_minutes_another_number_of_held_out_photos_is_measured_again(posed, tmp_path):
    make_scene(posed, tmp_path / "scene.hyrf", MakeConfig(minutes=0.01, test_every=0))
    result = make_scene(posed, tmp_path / "scene.hyrf", MakeConfig(minutes=0.01, test_every=4), overwrite=True)
    assert "measurement" not in result.kept


def test_with_minutes_another_target_size_keeps_the_measurement_and_the_training(posed, tmp_path, caplog):
    make_scene(posed, tmp_path / "scene.hyrf", MakeConfig(minutes=0.01, target_bytes=30_000))
    result = make_scene(posed, tmp_path / "scene.hyrf", MakeConfig(minutes=0.01, target_bytes=50_000), overwrite=True)
    assert result.kept == ("measurement", "training")
    assert any("model is kept: it was trained for 30,000 bytes" in sentence for sentence in caplog.messages)


def test_a_work_folder_of_an_earlier_version_is_trained_again_once(finished_work, posed, tmp_path, caplog):
    table = json.loads((finished_work / "make.json").read_text())
    training = table["stages"]["training"]
    training["inputs"]["settings"] |= training.pop("fixed")  # earlier versions stored both there
    (finished_work / "make.json").write_text(json.dumps(table))
    assert make_scene(posed, tmp_path / "scene.hyrf", work=finished_work).kept[:1] != ("training",)
    assert "training: running again, because settings changed" in caplog.messages
    assert len(make_scene(posed, tmp_path / "scene.hyrf", work=finished_work).kept) == 4


# -- what runs again -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "settings, kept",
    [
        ({}, tuple(STAGE_NAMES)),
        ({"quality": "best"}, ("training",)),  # with these settings, "best" trains as long
        ({"seed": 1}, ()),
        ({"test_every": 3}, ()),
        ({"max_size": 24}, ()),
        ({"target_bytes": 50_000}, ("training",)),
        ({"max_gaussians": 400}, ()),
        ({"preset": "street"}, ()),
    ],
)
def test_changed_settings_repeat_the_stages_that_depend_on_them(settings, kept, finished_work, posed, tmp_path):
    result = make_scene(posed, tmp_path / "scene.hyrf", MakeConfig(**settings), work=finished_work)
    assert result.kept == kept


def test_a_changed_photo_repeats_all_stages_and_a_moved_folder_none(photos, poses, tmp_path, caplog):
    make_scene(photos, tmp_path / "a.hyrf", MakeConfig(quality="draft"), work=tmp_path / "work")
    moved = photos.rename(tmp_path / "elsewhere")
    assert len(make_scene(moved, tmp_path / "a.hyrf", MakeConfig(quality="draft"), work=tmp_path / "work").kept) == 5
    Image.new("RGB", (32, 32), "red").save(moved / "0003.png")
    result = make_scene(moved, tmp_path / "b.hyrf", MakeConfig(quality="draft"), work=tmp_path / "work")
    assert "poses" not in result.kept and "poses: running again, because photos changed" in caplog.messages


def test_poses_are_kept_from_a_draft_to_another_quality_and_back(photos, poses, tmp_path):
    for quality in ("draft", "normal", "draft"):
        make_scene(photos, tmp_path / "scene.hyrf", MakeConfig(quality=quality), overwrite=True)
    assert poses == [photos]


def test_the_matching_setting_is_passed_on_and_repeats_the_poses(photos, poses, tmp_path):
    make_scene(photos, tmp_path / "a.hyrf", MakeConfig(quality="draft"))
    result = make_scene(
        photos, tmp_path / "b.hyrf", MakeConfig(quality="draft", matching="sequential"), work=tmp_path / "a.work"
    )
    assert len(poses) == 2 and result.kept == ("training", "compression", "scoring")  # the poses did not change


@pytest.mark.parametrize(
    "name, kept",
    [("model.hyrf", ("training", "scoring", "export")), ("run/model.hyrf", ("compression", "scoring", "export"))],
)
def test_a_damaged_product_is_made_again(name, kept, finished_work, posed, tmp_path):
    whole = (finished_work / name).read_bytes()
    (finished_work / name).write_bytes(whole[:100])
    result = make_scene(posed, tmp_path / "scene.hyrf", work=finished_work)
    assert result.kept == kept and (finished_work / name).read_bytes() == whole


def test_poses_without_their_photos_are_estimated_again(photos, poses, tmp_path, caplog):
    work = make_scene(photos, tmp_path / "scene.hyrf", MakeConfig(quality="draft")).work
    (work / "scene" / "images" / "0004.png").unlink()
    result = make_scene(photos, tmp_path / "other.hyrf", MakeConfig(quality="draft"), work=work)
    assert (
        len(poses) == 2
        and result.kept == tuple(STAGE_NAMES[:-1])
        and "poses: running again, because its files changed" in caplog.messages
    )


def test_a_repeated_call_keeps_everything_and_a_changed_output_needs_overwrite(finished_work, posed, tmp_path):
    output = tmp_path / "scene.html"
    make_scene(posed, output, work=finished_work)
    before = output.read_bytes()
    assert len(make_scene(posed, output, work=finished_work).kept) == 4
    with pytest.raises(HyrfError, match="another source or with other settings.*`overwrite=True`"):
        make_scene(posed, output, MakeConfig(target_bytes=1_000_000), work=finished_work)
    assert output.read_bytes() == before
    make_scene(posed, output, MakeConfig(seed=3), work=finished_work, overwrite=True)
    assert output.read_bytes() != before


@pytest.mark.parametrize("name, stage", [("model.hyrf", "compression"), ("run", "training"), ("export", "export")])
def test_an_output_whose_intermediate_results_are_missing_needs_overwrite(name, stage, posed, tmp_path):
    output = tmp_path / "scene.hyrf"
    work = make_scene(posed, output).work
    (work / name).rename(tmp_path / "moved")
    with pytest.raises(HyrfError, match=f"product of its {stage} stage in .* is missing .*`overwrite=True`"):
        make_scene(posed, output)
    assert stage not in make_scene(posed, output, overwrite=True).kept
    assert len(make_scene(posed, output).kept) == 4


def test_an_output_without_its_work_folder_needs_overwrite(posed, tmp_path):
    shutil.rmtree(make_scene(posed, tmp_path / "scene.hyrf").work)
    with pytest.raises(HyrfError, match="there is a file of this name; .*`overwrite=True`"):
        make_scene(posed, tmp_path / "scene.hyrf")
    assert make_scene(posed, tmp_path / "scene.hyrf", overwrite=True).kept == ()


def test_a_changed_player_is_not_taken_for_photos(finished_work, posed, tmp_path):
    player, photos = tmp_path / "player", tmp_path / "photos"
    make_scene(posed, player, work=finished_work)
    (player / "index.html").write_text("changed")
    with pytest.raises(HyrfError, match=r"player: scene\.hyrf and \d more of the files to be written are there"):
        make_scene(posed, player, work=finished_work)
    assert (player / "index.html").read_text() == "changed"
    shutil.copytree(posed / "images", photos)
    with pytest.raises(HyrfError, match="photos or poses lie in this folder"):
        make_scene(posed, photos, work=finished_work)


def test_settings_of_an_interrupted_call_do_not_count_as_missing_results(finished_work, posed, tmp_path, monkeypatch):
    output, other = tmp_path / "scene.hyrf", MakeConfig(seed=3)
    make_scene(posed, output, work=finished_work)

    def stop(*arguments, **options):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(Stopped):
        patch.setattr(stages, "train_model", stop)
        make_scene(posed, output, other, work=finished_work, overwrite=True)
    with pytest.raises(HyrfError, match="another source or with other settings"):
        make_scene(posed, output, other, work=finished_work)


@pytest.mark.parametrize("is_own", [True, False])
def test_photos_are_dropped_before_compression_unless_the_caller_shares_the_cache(is_own, posed, tmp_path, monkeypatch):
    shared, cached_bytes = PictureCache(), []

    train_model, compress_model = stages.train_model, stages.compress_model

    def train(scene, *arguments, context, **options):
        context.cache.get(scene.train[0])
        return train_model(scene, *arguments, context=context, **options)

    def compress(*arguments, context, **options):
        cached_bytes.append(context.cache.nbytes)
        return compress_model(*arguments, context=context, **options)

    monkeypatch.setattr(stages, "train_model", train)
    monkeypatch.setattr(stages, "compress_model", compress)
    make_scene(posed, tmp_path / "scene.hyrf", context=RunContext(cache=None if is_own else shared))

    assert (cached_bytes == [0]) == is_own and (shared.nbytes > 0) == (not is_own)


# -- errors ----------------------------------------------------------------------------------------------------------


def test_impossible_requests_are_rejected_before_any_work(posed, photos, finished_work, tmp_path, monkeypatch):
    monkeypatch.setattr("hyrfpack.make.stages.train_model", None)
    (tmp_path / "there.html").write_bytes(b"mine")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "letter.txt").write_bytes(b"mine")
    (tmp_path / "letter.txt").write_bytes(b"mine")
    (tmp_path / "empty").mkdir()
    (tmp_path / "videos").mkdir()
    (tmp_path / "videos" / "clip.mp4").write_bytes(b"mine")
    out = tmp_path / "scene.html"
    for sentence, *arguments in (
        ("no such file or folder", tmp_path / "nothing", "-o", out),
        ("the file extension does not name a known format", posed, "-o", tmp_path / "scene.xyz"),
        (
            f"only the cameras of the photos; name another format; for the cameras of a finished model, use 'hyrfpack "
            f"export MODEL -o {tmp_path / 'cameras.json'}' with --data",
            posed,
            "-o",
            tmp_path / "cameras.json",
        ),
        ("there is a file of this name", posed, "-o", tmp_path / "there.html"),
        ("is a file, not a folder", posed, "-o", tmp_path / "there.html" / "scene.html"),
        ("reads what lies in this folder", photos, "-o", photos / "scene.html"),
        ("the work folder would lie among the photos", photos, "-o", photos / "made" / "scene.html"),
        ("may not contain each other", posed, "-o", tmp_path / "work" / "a.html", "--work", tmp_path / "work"),
        ("holds other files", posed, "-o", out, "--work", tmp_path / "full"),
        ("the folder is empty", tmp_path / "empty", "-o", out),
        ("none is left to train on; hold out fewer with --test-every", photos, "-o", out, "--test-every", 1),
        ("but the video clip.mp4; name the video itself", tmp_path / "videos", "-o", out),
        ("is a .hyrf file already", finished_work / "model.hyrf", "-o", tmp_path / "a.hyrf"),
        ("were given; leave out --minutes", finished_work / "model.hyrf", "-o", out, "--minutes", 3),
        (
            "were given; leave out --max-gaussians",
            finished_work / "model.hyrf",
            "-o",
            out,
            "--max-gaussians",
            30,
        ),
        ("were given; leave out --preset", finished_work / "model.hyrf", "-o", out, "--preset", "large"),
        (
            "were given; leave out --matching",
            finished_work / "model.hyrf",
            "-o",
            out,
            "--matching",
            "exhaustive",
        ),
        ("were given; leave out --images", finished_work / "model.hyrf", "-o", out, "--images", "images_4"),
        ("were given; leave out --max-size", finished_work / "model.hyrf", "-o", out, "--max-size", 0),
        ("were given; leave out --test-every", finished_work / "model.hyrf", "-o", out, "--test-every", 0),
        ("were given; leave out --view", finished_work / "model.hyrf", "-o", out, "--view"),
        ("exported as it is; leave out --quality", finished_work / "model.hyrf", "-o", out, "--quality", "best"),
        ("exported as it is; leave out --seed", finished_work / "model.hyrf", "-o", out, "--seed", 3),
        ("give one of them", posed, "-o", out, "--minutes", 3, "--quality", "draft"),
        ("give one of them", posed, "-o", out, "--max-gaussians", 300, "--target-size", "1MB"),
        ("name a folder of photos", tmp_path / "letter.txt", "-o", out),
        ("this is one photo; name a folder of photos", posed / "images" / "0003.png", "-o", out),
        ("'cuda:9' is not available", posed, "-o", out, "--device", "cuda:9"),
    ):
        assert sentence in refused("make", *arguments)
    assert not out.exists() and not (tmp_path / "scene.work").exists()
    assert (tmp_path / "there.html").read_bytes() == b"mine"


def test_a_folder_that_may_not_be_read_is_a_clear_error(photos, tmp_path, monkeypatch):
    deny_access(monkeypatch, photos)
    with pytest.raises(HyrfError, match="photos: the folder cannot be read .*; check its permissions"):
        make_scene(photos, tmp_path / "scene.hyrf")


def test_a_failed_stage_names_its_folder_and_keeps_finished_stages(posed, tmp_path, monkeypatch):
    def full(*arguments, **options):
        raise HyrfError("the disk is full", fix="free some space")

    with monkeypatch.context() as patch:
        patch.setattr("hyrfpack.make.stages.compress_model", full)
        sentence = refused("make", posed, "-o", tmp_path / "scene.html", "--quality", "draft")
    assert "compression failed: the disk is full; free some space; finished work is kept in" in sentence
    assert make_scene(posed, tmp_path / "scene.html", MakeConfig(quality="draft")).kept == ("training",)


@pytest.mark.parametrize("given", ["clip.mp4", "one photo"])
def test_a_failure_before_the_first_finished_stage_leaves_no_files(given, tmp_path, monkeypatch):
    """The estimation of poses is the real one; the inputs are a file that is no video, and a folder with one photo."""
    if given == "clip.mp4":
        (tmp_path / given).write_bytes(b"no video" * 100)
    else:
        (tmp_path / given).mkdir()
        Image.new("RGB", (64, 48), "red").save(tmp_path / given / "a.jpg")
    sentence = refused("make", tmp_path / given, "-o", tmp_path / "made" / "scene.html")
    assert "poses failed: " in sentence and "what is finished" not in sentence
    assert sorted(path.name for path in tmp_path.iterdir()) == [given]


def test_a_failure_after_poses_keeps_them_and_says_so(photos, poses, tmp_path, monkeypatch):
    def fail(*arguments, **options):
        raise HyrfError("the masks leave nothing", fix="check them")

    with monkeypatch.context() as patch:
        patch.setattr(stages, "train_model", fail)
        with pytest.raises(HyrfError, match="training failed: .*; finished work is kept in"):
            make_scene(photos, tmp_path / "scene.html")
    assert make_scene(photos, tmp_path / "scene.html").kept == ("poses",)


@pytest.mark.parametrize(
    "record, reason",
    [
        ("", "it is damaged"),
        ("{", "it is damaged"),
        ("[]", "it is damaged"),
        ('{"version": 1, "stages": {"training": 5}}', "it is damaged"),
        ('{"version": 1, "stages": {"training": {"inputs": {}, "seconds": "1"}}}', "it is damaged"),
        ('{"version": 1, "stages": {"training": {"inputs": {}, "seconds": 1.0, "files": []}}}', "it is damaged"),
        ('{"version": 0, "stages": {}}', "another version"),
    ],
)
def test_a_record_that_is_damaged_is_rejected(record, reason, posed, tmp_path):
    (tmp_path / "work").mkdir()
    (tmp_path / "work" / "make.json").write_text(record)
    with pytest.raises(HyrfError, match=f"cannot be read .*{reason}.*`work`"):
        make_scene(posed, tmp_path / "scene.hyrf", work=tmp_path / "work")


def test_a_second_call_in_the_same_work_folder_is_rejected(finished_work, posed, tmp_path):
    pytest.importorskip("fcntl", reason="locks are of Unix")
    with exclusive_folder(finished_work), pytest.raises(HyrfError, match="another hyrfpack command is at work.*`work`"):
        make_scene(posed, tmp_path / "scene.hyrf", work=finished_work)
    assert len(make_scene(posed, tmp_path / "scene.hyrf", work=finished_work).kept) == 4


def test_an_output_without_a_name_is_rejected_or_the_current_folder(finished_work, tmp_path, monkeypatch):
    assert "the root folder" in refused("make", finished_work / "model.hyrf", "-o", "/")
    (tmp_path / "player").mkdir()
    monkeypatch.chdir(tmp_path / "player")
    succeeded("make", finished_work / "model.hyrf", "-o", ".")
    assert (tmp_path / "player" / "index.html").is_file() and (tmp_path / "player.work" / "make.json").is_file()
    (tmp_path / "site" / "assets").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "site" / "assets")
    result = succeeded("make", finished_work / "model.hyrf", "-o", "..")
    assert "in the meantime" not in result.stderr
    assert (tmp_path / "site" / "index.html").is_file() and (tmp_path / "site.work" / "make.json").is_file()


# -- the command -----------------------------------------------------------------------------------------------------


def test_the_command_reports_its_results(photos, poses, tmp_path):
    result = succeeded("make", photos, "-o", tmp_path / "scene.html", "--quality", "draft")
    for part in (
        "poses: 18 of 19 photos, 17 confirmed by both mappers\n",
        "left out: dark.jpg, blurred",
        "times: poses 0 s, training",
        "3 photos held out: PSNR ",
        "scene.html: ",
        "open it in a browser",
    ):
        assert part in result.stdout
    numbers = json.loads(
        succeeded("make", photos, "-o", tmp_path / "scene.html", "--quality", "draft", "--json").stdout
    )
    assert numbers["kept"] == ["poses", *STAGE_NAMES] and numbers["views"] == 3 and numbers["poses"]["sure"] == 17
    assert numbers["total_seconds"] == pytest.approx(sum(numbers["seconds"].values()), abs=0.5)  # each value is rounded


def test_the_command_reports_where_it_was_stopped(posed, tmp_path, monkeypatch):
    def stop(*arguments, **options):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("hyrfpack.make.stages.evaluate_model", stop)
        result = hyrfpack("make", posed, "-o", tmp_path / "scene.html", "--quality", "draft")
    assert result.exit_code == 1 and result.stdout == ""
    assert result.stderr.splitlines()[-1] == "stopped in scoring; the same command resumes"


# -- train --poses ---------------------------------------------------------------------------------------------------


def test_training_on_photos_without_poses_names_the_command_that_estimates_them(photos, tmp_path):
    sentence = refused("train", photos, "-o", tmp_path / "run")
    assert f"{photos}: no poses found for the 18 photos; 'hyrfpack poses {photos} -o SCENE' estimates them" in sentence
    (tmp_path / "clip.mp4").write_bytes(b"frames")
    assert "'hyrfpack poses" in refused("train", tmp_path / "clip.mp4", "-o", tmp_path / "run")


@pytest.mark.acceptance
def test_training_estimates_poses_once_with_the_option(photos, poses, tmp_path):
    arguments = ("train", photos, "-o", tmp_path / "run", "--poses", "--steps", 3, "--max-gaussians", 50)
    succeeded(*arguments)
    assert (tmp_path / "run" / "model.hyrf").is_file() and (tmp_path / "run" / "scene" / "sparse").is_dir()
    assert "model.hyrf and 1 more of the files to be written are there" in refused(*arguments)
    (tmp_path / "run" / "model.hyrf").unlink()
    (tmp_path / "run" / "metrics.json").unlink()
    shutil.rmtree(tmp_path / "run" / "views")
    (tmp_path / "run" / "curve.png").unlink()
    assert "reusing the poses in" in succeeded(*arguments).stderr
    assert len(poses) == 1
    succeeded(*arguments, "--overwrite")
    assert len(poses) == 2


def test_a_run_among_photos_without_poses_is_rejected(photos, poses, tmp_path):
    assert "among the photos" in refused("train", photos, "-o", photos / "run", "--poses")
    assert not poses


@pytest.mark.parametrize(
    ("name", "is_viewable"),
    [("a.hyrf", True), ("a.PLY", True), ("a.mesh.ply", False), ("a.POINTS.ply", False), ("a.usdz", False)],
)
def test_the_hint_names_a_file_that_the_player_can_show(name, is_viewable):
    result = SimpleNamespace(output=Path(name), model=Path("a.work/packed.hyrf"))
    assert _viewing_hint(result) == f"see it with 'hyrfpack view {name if is_viewable else 'a.work/packed.hyrf'}'"

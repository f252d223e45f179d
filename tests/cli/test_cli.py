from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import click
import numpy as np
import pytest
import torch
from commands import hyrfpack, refused, succeeded
from PIL import Image

from hyrfpack.cli import main
from hyrfpack.cli.train import train
from hyrfpack.cli.types import INPUT_PATH, SIZE
from hyrfpack.config.compress import PROFILES
from hyrfpack.demo.scene import write_demo_scene
from hyrfpack.format import load_model
from hyrfpack.train import Trainer
from hyrfpack.train.decisions import decide
from tools.safety.train_golden import DEMO_COMPACT_FILE, DEMO_MODEL_FILE

pytestmark = pytest.mark.usefixtures("quick_calibration")
COMMAND_NAMES = (
    "make",
    "train",
    "compress",
    "decompress",
    "render",
    "evaluate",
    "info",
    "bench",
    "doctor",
    "demo",
    "export",
    "view",
    "import",
)


def run_python(code: str) -> subprocess.CompletedProcess:
    """Run code in a new interpreter that finds this package."""
    root = str(Path(__file__).parents[2])
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([root, os.environ.get("PYTHONPATH", "")])}
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)


@pytest.fixture(scope="module")
def run(data, tmp_path_factory) -> Path:
    """A run of 30 steps on ten small photos."""
    folder = tmp_path_factory.mktemp("runs") / "tiny"
    result = succeeded("train", data, "-o", folder, "--steps", 30, "--max-gaussians", 500, "--json")
    assert json.loads(result.stdout)["complete"] is True
    return folder


@pytest.fixture(scope="module")
def packed(run, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("packed") / "paper.hyrf"
    succeeded("compress", run / "model.hyrf", "-o", path, "--profile", "paper")
    return path


@pytest.fixture(scope="module")
def report_with_photos(run, data, tmp_path_factory) -> dict:
    """What `compress --json` prints for the run and its photos."""
    path = tmp_path_factory.mktemp("packed") / "compact.hyrf"
    return json.loads(succeeded("compress", run, "-o", path, "--data", data, "--json").stdout)


# -- from photos to files and scores -----------------------------------------------------------------------------------


def test_train_writes_a_model_metrics_and_pictures(run):
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["settings"]["steps"] == 30 and metrics["settings"]["max_gaussians"] == 500
    assert metrics["bytes"] == (run / "model.hyrf").stat().st_size
    assert {path.name for path in (run / "views").iterdir()} == {"0000.png", "0008.png"}


@pytest.mark.parametrize(
    "profile", [pytest.param(name, marks=pytest.mark.acceptance if name == "compact" else ()) for name in PROFILES]
)
def test_compress_reports_the_bytes_on_disk(profile, run, tmp_path):
    arguments = ("compress", run / "model.hyrf", "-o", tmp_path / "p.hyrf", "--profile", profile, "--json")
    report = json.loads(succeeded(*arguments).stdout)
    assert report["profile"] == profile and report["file"] == str(tmp_path / "p.hyrf")
    assert report["bytes_after"] == (tmp_path / "p.hyrf").stat().st_size <= (run / "model.hyrf").stat().st_size
    assert sum(section["after"] for section in report["sections"]) < report["bytes_after"]


@pytest.mark.acceptance
def test_compact_is_the_default_and_smaller_than_the_paper_profile(run, packed, tmp_path):
    report = json.loads(succeeded("compress", run / "model.hyrf", "-o", tmp_path / "p.hyrf", "--json").stdout)
    assert report["bytes_after"] == (tmp_path / "p.hyrf").stat().st_size
    assert report["profile"] == "compact" and report["bytes_after"] < 0.7 * packed.stat().st_size
    assert report["error"] > 0 and sum(report["shares"].values()) == pytest.approx(1)


def test_compress_prints_every_section_with_its_bytes_and_scores(run, data, tmp_path):
    printed = succeeded("compress", run / "model.hyrf", "-o", tmp_path / "p.hyrf", "--data", data).stdout
    words = ("positions", "geometry hash table", "radiance decoder", "padding", "bits/Gaussian", "bits/number")
    for word in (*words, "of the loss", "loss in pictures", "held-out photos: PSNR"):
        assert word in printed


def test_compress_with_photos_reports_the_loss_on_held_out_photos(run, data, report_with_photos):
    report = report_with_photos
    scores = [
        json.loads(succeeded("evaluate", path, "--data", data, "--json").stdout)
        for path in (run / "model.hyrf", report["file"])
    ]
    assert (report["psnr_before"], report["psnr"]) == pytest.approx([score["psnr"] for score in scores])
    assert (report["ssim_before"], report["ssim"]) == pytest.approx([score["ssim"] for score in scores])


def test_compress_of_a_run_uses_its_photos_by_default(run, data, report_with_photos, tmp_path):
    arguments = ("compress", run, "-o", tmp_path / "p.hyrf", "--overwrite", "--json")
    result = succeeded(*arguments)
    assert f"using the photos that the model was trained on, {data}" in result.stderr
    named = {**report_with_photos, "file": str(tmp_path / "p.hyrf")}
    assert json.loads(result.stdout) == named and "psnr" in named
    without = succeeded(*arguments, "--no-data")
    assert "trained on" not in without.stderr and "psnr" not in json.loads(without.stdout)


def test_compress_works_when_the_photos_of_a_run_are_gone(run, tmp_path):
    shutil.copytree(run, tmp_path / "run")
    metrics = json.loads((run / "metrics.json").read_text())
    metrics["scene"]["reading"]["path"] = str(tmp_path / "moved")
    (tmp_path / "run" / "metrics.json").write_text(json.dumps(metrics))
    arguments = ("compress", tmp_path / "run", "-o", tmp_path / "p.hyrf")
    assert "continuing without the photos" in succeeded(*arguments).stderr
    assert "name their folder with --data" in refused(*arguments, "--overwrite", "--finetune", 1)


def test_compress_meets_a_target_size(tmp_path):
    target = int(0.8 * DEMO_COMPACT_FILE.stat().st_size)
    arguments = ("compress", DEMO_MODEL_FILE, "-o", tmp_path / "p.hyrf", "--target-size")
    report = json.loads(succeeded(*arguments, f"{target / 1000}kB", "--json").stdout)
    assert 0.9 * target < report["bytes_after"] <= target
    assert f"of {target:,} bytes" in report["found"]


@pytest.mark.acceptance
def test_compress_can_fine_tune_and_keep_every_gaussian(run, data, tmp_path):
    arguments = ("compress", run / "model.hyrf", "-o", tmp_path / "p.hyrf", "--data", data, "--json")
    report = json.loads(succeeded(*arguments, "--finetune", 3, "--no-prune").stdout)
    assert report["gaussians"] == len(load_model(run / "model.hyrf"))
    assert report["psnr"] > 12


def test_the_last_line_says_how_numbers_are_stored(run, tmp_path):
    raw, paper = (
        succeeded(
            "compress", run / "model.hyrf", "-o", tmp_path / f"{profile}.hyrf", "--profile", profile
        ).stdout.splitlines()
        for profile in ("raw", "paper")
    )
    assert re.search("bytes, [0-9,]+ Gaussians, all numbers as float32$", raw[-1])
    assert "times smaller than float32" in paper[-1]


def test_decompress_of_a_raw_file_is_byte_exact(run, tmp_path):
    succeeded("decompress", run / "model.hyrf", "-o", tmp_path / "back.hyrf")
    assert (tmp_path / "back.hyrf").read_bytes() == (run / "model.hyrf").read_bytes()


def test_decompressed_files_score_like_the_file_they_come_from(packed, data, tmp_path):
    succeeded("decompress", packed, "-o", tmp_path / "back.hyrf")
    scores = [
        json.loads(succeeded("evaluate", path, "--data", data, "--json").stdout)
        for path in (packed, tmp_path / "back.hyrf")
    ]
    assert scores[0]["views"] == scores[1]["views"]
    assert scores[0]["bytes"] == packed.stat().st_size != scores[1]["bytes"]


def test_evaluate_prints_strict_json_only(packed, data):
    result = succeeded("evaluate", packed, "--data", data, "--json")
    values = json.loads(result.stdout, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    assert {"psnr", "ssim", "lpips", "bytes", "gaussians", "views", "seconds_per_frame"} <= set(values)
    assert [view["name"] for view in values["views"]] == ["0000.png", "0008.png"]
    assert values["lpips"] is None and values["lpips_reason"]
    assert values["psnr"] > 12


def test_evaluate_scores_the_requested_split(packed, data):
    values = json.loads(succeeded("evaluate", packed, "--data", data, "--split", "all", "--json").stdout)
    assert len(values["views"]) == 10
    held_out = json.loads(succeeded("evaluate", packed, "--data", data, "--test-every", 5, "--json").stdout)
    assert [view["name"] for view in held_out["views"]] == ["0000.png", "0005.png"]


def test_evaluate_prints_a_table_and_writes_pictures(packed, data, tmp_path):
    printed = succeeded("evaluate", packed, "--data", data, "--pictures", tmp_path / "views").stdout
    assert "0008.png" in printed and "mean" in printed and "LPIPS: no weights" in printed
    assert len(list((tmp_path / "views").iterdir())) == 2


def test_info_describes_the_file_and_the_choices_behind_it(packed):
    facts = json.loads(succeeded("info", packed, "--json").stdout)
    assert facts["profile"] == "paper" and facts["bytes"] == packed.stat().st_size
    assert facts["provenance"]["choices"]["preset"]
    printed = succeeded("info", packed).stdout
    for words in (f"{facts['bytes']:,} bytes", "profile paper", "chosen in training", "preset", "radiance hash table"):
        assert words in printed


def test_render_names_pictures_after_photos(packed, data, tmp_path):
    succeeded("render", packed, "-o", tmp_path, "--data", data, "--split", "test")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0000.png", "0008.png"]
    assert Image.open(tmp_path / "0008.png").size == (48, 48)


def test_render_orbits_the_scene_by_default(packed, tmp_path):
    result = json.loads(succeeded("render", packed, "-o", tmp_path, "--orbit", 3, "--depth", "--json").stdout)
    assert [Path(path).name for path in result["pictures"]] == ["0000.png", "0001.png", "0002.png"]
    assert np.asarray(Image.open(tmp_path / "0001.depth.tiff")).max() > 0.1
    assert np.asarray(Image.open(tmp_path / "0001.png")).std() > 5


def test_render_takes_cameras_from_a_file(packed, tmp_path):
    camera = {"name": "left/eye", "width": 20, "height": 10, "fx": 15, "camera_from_world": np.eye(4).tolist()}
    (tmp_path / "cameras.json").write_text(json.dumps([camera]))
    succeeded("render", packed, "-o", tmp_path / "out", "--cameras", tmp_path / "cameras.json")
    assert Image.open(tmp_path / "out" / "left" / "eye.png").size == (20, 10)


def test_a_video_without_ffmpeg_gives_pictures_and_a_note(packed, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    result = succeeded("render", packed, "-o", tmp_path / "out", "--orbit", 2, "--video", "--json")
    assert json.loads(result.stdout)["video"] is None
    assert "ffmpeg was not found, so only pictures are written" in result.stderr
    assert len(list((tmp_path / "out").iterdir())) == 2


@pytest.mark.usefixtures("signals")
@pytest.mark.parametrize(
    ("options", "messages"),
    [
        ((), "the same command with --resume continues"),
        (("--overwrite",), "with --resume instead of --overwrite continues"),
        (("--blocks", "auto"), "the same command with --resume continues"),
    ],
    ids=["new", "overwriting", "a single block"],
)
def test_interrupted_training_saves_exits_with_1_and_says_how_to_resume(options, messages, data, tmp_path, monkeypatch):
    before, run = signal.getsignal(signal.SIGINT), Trainer.run

    def run_interrupted(trainer, *, progress, **rest):
        def report_and_interrupt(event):
            progress(event)
            signal.raise_signal(signal.SIGINT)

        return run(trainer, progress=report_and_interrupt, **rest)

    monkeypatch.setattr(Trainer, "run", run_interrupted)
    result = hyrfpack("train", data, "-o", tmp_path, "--steps", 100, "--max-gaussians", 200, "--json", *options)
    assert result.exit_code == 1 and isinstance(result.exception, SystemExit)
    summary = json.loads(result.stdout)
    assert (summary["complete"], summary["step"]) == (False, 1)
    assert messages in result.stderr
    assert (tmp_path / "checkpoint.pt").is_file() and not (tmp_path / "model.hyrf").exists()
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.usefixtures("signals")
@pytest.mark.parametrize(
    ("finished", "message"),
    [
        (False, "stopped before the first step; run the same command to start again"),
        (True, "stopped before the first step; the same command with --resume continues from there"),
    ],
)
def test_training_interrupted_during_pilot_runs_exits_with_1(data, tmp_path, monkeypatch, finished, message):
    before = signal.getsignal(signal.SIGINT)

    def decide_interrupted(*arguments):
        if finished:
            (tmp_path / "pilots.json").write_text('{"version": 1, "scores": {}}')
        signal.raise_signal(signal.SIGINT)
        return decide(*arguments)

    monkeypatch.setattr("hyrfpack.train.run.decide", decide_interrupted)
    result = hyrfpack("train", data, "-o", tmp_path, "--steps", 1_000, "--max-gaussians", 200, "--json")
    assert result.exit_code == 1 and json.loads(result.stdout) == {"complete": False, "step": 0}
    assert message in result.stderr
    assert not any((tmp_path / name).exists() for name in ("checkpoint.pt", "model.hyrf"))
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.acceptance
def test_demo_prints_a_table_and_writes_a_picture(tmp_path):
    from hyrfpack.demo.run import run_demo

    result = run_demo(tmp_path, steps=10, views=10, size=32)
    assert Image.open(tmp_path / "demo.png").width > 900
    assert {path.name for path in tmp_path.iterdir()} == {
        "scene", "run", "paper.hyrf", "compact.hyrf", "back.hyrf", "renders", "demo.html", "demo.png",
    }  # fmt: skip
    assert [profile.profile for profile in result.profiles] == ["raw", "paper", "compact"]
    assert [profile.bytes for profile in result.profiles] == [
        (tmp_path / name).stat().st_size for name in ("run/model.hyrf", "paper.hyrf", "compact.hyrf")
    ]
    assert result.gaussians == len(load_model(tmp_path / "compact.hyrf"))
    assert all(
        torch.equal(a, b)
        for a, b in zip(
            load_model(tmp_path / "back.hyrf").parameters(),
            load_model(tmp_path / "compact.hyrf").parameters(),
            strict=True,
        )
    )
    json.dumps(result.to_dict(), allow_nan=False)
    assert len(result.table()) == 6


# -- mistakes of the user ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "arguments",
    [
        ("info", "none.hyrf"),
        ("info", "."),
        ("info", "junk.hyrf"),
        ("compress", "none.hyrf", "-o", "x.hyrf"),
        ("compress", "junk.hyrf", "-o", "x.hyrf"),
        ("decompress", "junk.hyrf", "-o", "x.hyrf"),
        ("render", "junk.hyrf", "-o", "out"),
        ("render", "none.hyrf", "-o", "out", "--orbit", "2"),
        ("evaluate", "none.hyrf", "--data", "."),
        ("train", "nowhere", "-o", "run"),
        ("train", "junk.hyrf", "-o", "run"),
        ("train", "empty", "-o", "run"),
        ("train", "data", "-o", "run", "--resume"),
    ],
)
def test_an_invalid_input_is_a_clear_error_that_names_it(arguments, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "junk.hyrf").write_bytes(b"no model at all" * 20)
    (tmp_path / "empty").mkdir()
    if "data" in arguments:
        write_demo_scene(tmp_path / "data", views=9, size=16)
    sentence = refused(*arguments)
    assert sentence.removeprefix("Error: ").startswith("run" if "--resume" in arguments else arguments[1])
    assert not any((tmp_path / name).exists() for name in ("x.hyrf", "out", "run"))


@pytest.mark.parametrize(
    "arguments",
    [
        ("train", "data"),
        ("train", "data", "-o", "run", "--steps", "0"),
        ("train", "data", "-o", "run", "--preset", "huge"),
        ("train", "data", "-o", "run", "--seed", str(2**64)),
        ("import", "a.ply", "-o", "b.hyrf", "--seed", str(2**64)),
        ("train", "data", "-o", "run", "--resume", "--overwrite"),
        ("compress", "a.hyrf", "-o", "b.hyrf", "--profile", "zip"),
        ("render", "a.hyrf", "-o", "out", "--orbit", "3", "--data", "d"),
        ("evaluate", "a.hyrf"),
        ("fly", "away"),
    ],
)
def test_wrong_usage_exits_with_2(arguments):
    refused(*arguments)


# Options of `compress` and the error that they give.
REJECTED_OPTIONS = {
    "fine-tuning without photos": (("--no-data", "--finetune", 5), "need photos; name their folder with --data"),
    "a loss without photos": (("--no-data", "--max-psnr-drop", 0.1), "need photos; name their folder with --data"),
    "photos and none": (("--no-data", "--data", "DATA"), "give one of them"),
    "two aims": (("--data", "DATA", "--target-size", "20kB", "--max-psnr-drop", 0.1), "give one of them"),
    "photos for the paper profile": (("--data", "DATA", "--profile", "paper"), "profile 'paper' cannot be fitted"),
    "a size for the raw profile": (("--target-size", "1MB", "--profile", "raw"), "profile 'raw' cannot be fitted"),
    "a size that no file can have": (("--target-size", "90"), "90 bytes is below the smallest possible file"),
    "a size without its unit": (("--target-size", "10"), "did you mean 10MB?"),
    "a size that this model cannot have": (("--target-size", "2kB"), "does not fit into 2,000 bytes"),
    "photos that are not there": (("--data", "nowhere"), "nowhere"),
    "a gain": (("--data", "DATA", "--max-psnr-drop", "-1"), "--max-psnr-drop"),
    "no step": (("--data", "DATA", "--finetune", 0), "--finetune"),
    "words for a size": (("--target-size", "small"), "'small' is not a size"),
    "no size": (("--target-size", "0"), "'0' is not a size"),
    "a size of nothing": (("--target-size", "0.0001kB"), "is not a size"),
    "a negative size": (("--target-size", "-5kB"), "is not a size"),
    "two points": (("--target-size", "1.2.3MB"), "is not a size"),
    "a decimal comma": (("--target-size", "1,84"), "is not a size"),
}


@pytest.mark.parametrize(
    ("text", "size"), [("1,840", 1_840), ("12,345,678", 12_345_678), ("1,500 kB", 1_500_000), ("0.5MB", 500_000)]
)
def test_a_size_may_have_thousands_separators(text, size):
    assert SIZE.convert(text, None, None) == size


@pytest.mark.parametrize("case", REJECTED_OPTIONS)
def test_invalid_options_of_compress_are_a_clear_error(case, run, data, tmp_path):
    options, words = REJECTED_OPTIONS[case]
    (tmp_path / "old.hyrf").write_bytes(b"old")
    options = [data if option == "DATA" else option for option in options]
    assert words in refused("compress", run / "model.hyrf", "-o", tmp_path / "old.hyrf", "--overwrite", *options)
    assert (tmp_path / "old.hyrf").read_bytes() == b"old" and len(list(tmp_path.iterdir())) == 1


def test_a_number_of_gaussians_together_with_a_target_size_is_rejected(data, tmp_path):
    options = ("--max-gaussians", 500, "--target-size", "20kB")
    assert "give one of them" in refused("train", data, "-o", tmp_path / "run", *options)
    assert not (tmp_path / "run").exists()


def test_a_target_size_determines_the_number_of_gaussians(data, tmp_path):
    done = succeeded("train", data, "-o", tmp_path / "run", "--steps", 5, "--target-size", "11.5kB", "--json")
    assert "to be packed into 11,500 bytes" in json.loads(done.stdout)["choices"]["max_gaussians"]


def test_a_second_training_does_not_overwrite_the_first(run, data):
    before = (run / "model.hyrf").read_bytes()
    assert "--overwrite" in refused("train", data, "-o", run, "--steps", 5)
    assert (run / "model.hyrf").read_bytes() == before


@pytest.mark.parametrize("command", ["compress", "decompress"])
def test_an_output_that_is_the_input_is_rejected(command, packed, tmp_path):
    before = packed.read_bytes()
    (tmp_path / "link.hyrf").symlink_to(packed)
    for target in (packed, packed.parent / ".." / packed.parent.name / packed.name, tmp_path / "link.hyrf"):
        assert "input itself" in refused(command, packed, "-o", target)
        assert "input itself" in refused(command, packed, "-o", target, "--overwrite")
    assert packed.read_bytes() == before


def test_a_failed_command_keeps_the_old_file(packed, tmp_path):
    damaged = bytearray(packed.read_bytes())
    damaged[len(damaged) // 2] ^= 1
    (tmp_path / "damaged.hyrf").write_bytes(damaged)
    (tmp_path / "old.hyrf").write_bytes(b"old")
    assert "damaged" in refused("decompress", tmp_path / "damaged.hyrf", "-o", tmp_path / "old.hyrf", "--overwrite")
    assert (tmp_path / "old.hyrf").read_bytes() == b"old"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["damaged.hyrf", "old.hyrf"]


def test_a_missing_output_folder_is_created(packed, tmp_path):
    succeeded("decompress", packed, "-o", tmp_path / "not" / "yet" / "there.hyrf")
    assert (tmp_path / "not" / "yet" / "there.hyrf").is_file()


def test_a_file_as_the_output_folder_of_pictures_is_rejected(packed, tmp_path):
    (tmp_path / "file").write_text("mine")
    refused("render", packed, "-o", tmp_path / "file", "--orbit", 1)
    assert (tmp_path / "file").read_text() == "mine"


def test_an_empty_split_and_missing_weights_are_named_in_the_error(packed, data, tmp_path):
    assert "split 'test'" in refused("evaluate", packed, "--data", data, "--test-every", 0)
    assert "none.pt" in refused("evaluate", packed, "--data", data, "--lpips-weights", tmp_path / "none.pt")


def test_an_unexpected_exception_keeps_its_traceback(packed, monkeypatch):
    def broken(path):
        raise ValueError("a bug")

    monkeypatch.setattr("hyrfpack.format.describe_file", broken)
    result = hyrfpack("info", packed)
    assert result.exit_code == 1
    assert isinstance(result.exception, ValueError) and result.exc_info[2] is not None


# -- help, defaults, imports -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", COMMAND_NAMES)
def test_the_help_of_every_command_has_an_example(command):
    text = succeeded(command, "--help").stdout
    assert "Example" in text and f"hyrfpack {command}" in text


def test_all_commands_are_listed():
    text = succeeded("--help").stdout
    assert all(f"\n  {command}" in text for command in COMMAND_NAMES)


def test_the_command_line_offers_the_choices_of_the_library():
    from hyrfpack.format import codec
    from hyrfpack.train import TrainConfig

    assert PROFILES == tuple(codec.PROFILES)
    defaults = TrainConfig().to_dict()
    options = {option.name: option.default for option in train.params if option.name in defaults}
    assert {"steps", "seed", "preset", "max_gaussians", "antialiased", "background", "log2_table_size"} <= set(options)
    with train.make_context("train", ["data", "-o", "run"]) as context:
        assert {name: context.params[name] for name in options} == {name: defaults[name] for name in options}


def test_importing_the_package_or_the_command_line_loads_no_numerical_library():
    code = "import hyrfpack, hyrfpack.cli, sys; print({'torch', 'numpy', 'numba', 'PIL', 'rich'} & set(sys.modules))"
    assert run_python(code).stdout.strip() == "set()"


def test_info_loads_no_numerical_library(packed):
    code = (
        "import sys; from hyrfpack.cli import main\n"
        f"main(['info', {str(packed)!r}, '--json'], standalone_mode=False)\n"
        "assert not {'torch', 'numpy', 'matplotlib', 'PIL', 'rich'} & set(sys.modules)"
    )
    result = run_python(code)
    assert result.returncode == 0, result.stderr
    assert json.loads(result.stdout)["profile"] == "paper"


def test_the_module_runs_as_a_program():
    root = Path(__file__).parents[2]
    result = subprocess.run([sys.executable, "-m", "hyrfpack", "--version"], capture_output=True, text=True, cwd=root)
    assert result.returncode == 0 and result.stdout.startswith("hyrfpack")


@pytest.mark.parametrize("option", [("--test-every", 8), ("--images", "i"), ("--max-size", 0), ("--model", 1)])
@pytest.mark.parametrize("command", ["render", "compress", "export", "edit", "split"])
def test_options_for_reading_photos_need_the_folder_of_photos(command, option, packed, tmp_path):
    message = refused(command, packed, "-o", tmp_path / "out", *option)
    assert message == f"Error: {option[0]} is for reading photos; name their folder with --data"
    assert not list(tmp_path.iterdir())


def test_render_refuses_split_without_photos(packed, tmp_path):
    message = refused("render", packed, "-o", tmp_path / "out", "--split", "test")
    assert message == "Error: --split is for reading photos; name their folder with --data"


@pytest.mark.parametrize(
    "words", ["info", "view", "render -o out", "train -o out", "compress -o out.hyrf", "make -o out.html"]
)
def test_an_empty_path_is_not_the_current_folder(words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    command, *options = words.split()
    assert "'' is not a path; give the path of a file or a folder" in refused(command, "", *options)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("words", "file"),
    [
        ("train photos -o fox.hyrf", "fox.hyrf"),
        ("render fox.hyrf -o fox.PNG", "fox.PNG"),
        ("split fox.hyrf -o parts/fox.hyrf", "parts/fox.hyrf"),
        ("poses photos -o transforms.json", "transforms.json"),
        ("demo -o demo.html", "demo.html"),
        ("evaluate fox.hyrf --data photos --pictures errors.jpg", "errors.jpg"),
        ("compress fox.hyrf -o small.hyrf --report report.html", "report.html"),
        ("make photos -o fox.html --work fox.zip", "fox.zip"),
    ],
)
def test_a_new_folder_of_results_has_no_name_of_a_file(words, file, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    stem, extension = file.split(".")
    assert refused(*words.split()).endswith(
        f"'{file}' is the name of a .{extension} file, but a folder is written; "
        f"give the name of a folder, such as '{stem}'"
    )
    assert not list(tmp_path.iterdir())


def test_an_existing_folder_with_the_name_of_a_file_is_used(packed, tmp_path):
    (tmp_path / "fox.hyrf").mkdir()
    succeeded("render", packed, "-o", tmp_path / "fox.hyrf", "--orbit", 1)
    assert [file.name for file in (tmp_path / "fox.hyrf").iterdir() if not file.name.startswith(".")] == ["0000.png"]


def test_an_interrupted_rendering_says_what_was_written(packed, tmp_path, monkeypatch):
    def write_two(*_args, **_settings):
        yield tmp_path / "out/0000.png"
        yield tmp_path / "out/0001.png"
        raise KeyboardInterrupt

    monkeypatch.setattr("hyrfpack.render.files.write_pictures", write_two)
    result = hyrfpack("render", packed, "-o", tmp_path / "out", "--orbit", 1000)
    assert result.exit_code == 1
    assert f"{tmp_path / 'out'}: 2 of 1,000 pictures were written" in result.stderr.splitlines()


def test_every_input_path_is_checked_for_being_empty():
    given = [option for command in main.commands.values() for option in command.params]
    paths = [option for option in given if isinstance(option.type, click.Path)]
    assert len(paths) > 20 and all(option.type is INPUT_PATH for option in paths)

"""Commands at the same time, and files that appear while one works: nobody's result is lost.

A file that appears in the meantime is created when the command has finished its work and is about to name the first
file that it writes; whether the command has looked at the place before does not matter then.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest
from commands import hyrfpack as run_command
from commands import refused, succeeded
from explicit_balls import ball_splats
from scenes import ring

import hyrfpack
from hyrfpack.compress.report import write_report
from hyrfpack.data import load_scene
from hyrfpack.demo.run import run_demo
from hyrfpack.errors import HyrfError
from hyrfpack.format import CompressionReport, load_model, repack
from hyrfpack.lock import exclusive_folder
from hyrfpack.make.auto_pose import auto_pose
from hyrfpack.render.files import render_files
from hyrfpack.splats.formats import ply
from hyrfpack.train import TrainConfig

pytest.importorskip("fcntl", reason="locks are of Unix")
FOREIGN = b"of another program"
BUSY = "another hyrfpack command is at work in this folder; wait until it has ended, or name another"
TRAINING = "--steps 2 --max-gaussians 40"


@pytest.fixture(scope="module")
def template(data, tmp_path_factory) -> Path:
    """A data set, photos without poses, a run, models and splats; not to be changed."""
    folder = tmp_path_factory.mktemp("template")
    shutil.copytree(data, folder / "data")
    shutil.copytree(data / "images", folder / "photos")
    succeeded("train", folder / "data", "-o", folder / "first", "--steps", 3, "--max-gaussians", 40)
    shutil.copytree(folder / "first", folder / "second")
    shutil.copy(folder / "first" / "model.hyrf", folder / "model.hyrf")
    succeeded("compress", folder / "model.hyrf", "-o", folder / "packed.hyrf", "--profile", "paper")
    (folder / "ball.ply").write_bytes(ply.encode(ball_splats(20)))
    return folder


@pytest.fixture
def world(template, tmp_path, monkeypatch) -> Path:
    """A copy, which is the working folder."""
    folder = Path(shutil.copytree(template, tmp_path / "world"))
    monkeypatch.chdir(folder)
    return folder


def appears(path: str, patch: pytest.MonkeyPatch) -> None:
    """A file that another program creates as soon as the command has written its first one."""
    fsync = os.fsync

    def create(descriptor: int) -> None:
        if not os.path.exists(path):
            Path(path).parent.mkdir(parents=True, exist_ok=True)
            Path(path).write_bytes(FOREIGN)
        fsync(descriptor)

    patch.setattr(os, "fsync", create)


def looked_at_each_write(folder: str, patch: pytest.MonkeyPatch) -> list[bool]:
    """Whether a folder is locked, asked each time that a file is written."""
    fsync, held = os.fsync, []

    def look(descriptor: int) -> None:
        try:
            with exclusive_folder(folder):
                held.append(False)
        except HyrfError:
            held.append(True)
        fsync(descriptor)

    patch.setattr(os, "fsync", look)
    return held


def files_in(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


# -- a file that appears while a command works -------------------------------------------------------------------------

SINGLE_FILES = [  # the command, the file that is asked for, and where the result must be
    ("compress model.hyrf --profile paper -o {}", "out.hyrf", "out-2.hyrf"),
    ("compress first --no-data -o {}", "out.hyrf", "out-2.hyrf"),
    ("decompress packed.hyrf -o {}", "out.hyrf", "out-2.hyrf"),
    ("export model.hyrf -o {}", "out.html", "out-2.html"),
    ("export model.hyrf --baked --sh-degree 0 -o {}", "out.html", "out-2.html"),
    ("export model.hyrf --sh-degree 0 -o {}", "out.ply", "out-2.ply"),
    ("export model.hyrf -o {}", "out.points.ply", "out-2.points.ply"),
    ("export model.hyrf -o {}", "out.json", "out-2.json"),
    ("import ball.ply --steps 1 --size 16 -o {}", "out.hyrf", "out-2.hyrf"),
    ("compare first second -o {}", "out.html", "out-2.html"),
    ("make packed.hyrf --work made -o {}", "out.html", "out-2.html"),
    ("make packed.hyrf --work made -o {}", "out.points.ply", "out-2.points.ply"),
]
IN_FOLDERS = [  # files of a folder that can have another name each
    ("render model.hyrf --orbit 2 -o out", "out/0001.png", "out/0001-2.png"),
    (f"train data {TRAINING} -o out", "out/model.hyrf", "out/model-2.hyrf"),
]


@pytest.mark.usefixtures("short_imports")
@pytest.mark.parametrize(("command", "asked", "beside"), [*SINGLE_FILES, *IN_FOLDERS])
def test_a_file_that_appears_meanwhile_is_kept_and_the_result_is_beside_it(command, asked, beside, world, monkeypatch):
    appears(asked, monkeypatch)
    result = succeeded(*command.format(asked).split())

    assert Path(asked).read_bytes() == FOREIGN and Path(beside).stat().st_size > len(FOREIGN)
    sentence = (
        f"{asked}: this file was created by something else in the meantime and is kept; the result is in {beside}"
    )
    assert result.stderr.count(sentence) == 1
    if beside.endswith(".hyrf"):
        assert len(load_model(beside))
    if "out/" not in beside:
        assert beside in result.stdout and asked not in result.stdout


@pytest.mark.usefixtures("short_imports")
@pytest.mark.parametrize(("command", "asked", "beside"), SINGLE_FILES)
def test_json_names_the_file_that_was_really_written(command, asked, beside, world, monkeypatch):
    appears(asked, monkeypatch)
    facts = json.loads(succeeded(*command.format(asked).split(), "--json").stdout)

    assert facts.get("file", facts.get("output")) == beside
    if "output" in facts:
        assert facts["export"]["file"] == beside


@pytest.mark.usefixtures("short_imports")
@pytest.mark.parametrize(("command", "asked", "beside"), [*SINGLE_FILES, *IN_FOLDERS])
def test_with_overwrite_the_last_one_wins(command, asked, beside, world, monkeypatch):
    appears(asked, monkeypatch)
    result = succeeded(*command.format(asked).split(), "--overwrite")

    assert Path(asked).stat().st_size > len(FOREIGN) and not Path(beside).exists()
    assert "meantime" not in result.stderr


def test_json_of_render_names_the_pictures_that_were_really_written(world, monkeypatch):
    appears("out/0000.png", monkeypatch)
    facts = json.loads(succeeded("render", "model.hyrf", "--orbit", 2, "-o", "out", "--json").stdout)
    assert facts["pictures"] == ["out/0000-2.png", "out/0001.png"]


def test_bench_keeps_files_that_appear_meanwhile_and_fills_the_page_as_it_is_then(world, monkeypatch):
    words = import_module("hyrfpack.bench.tables")
    measure = import_module("hyrfpack.bench").benchmark_model
    Path("page.md").write_text(words.empty_page({"machine": "", "codec": ""}))

    def edited_meanwhile(*arguments, **options):
        Path("page.md").write_text(f"A new line.\n{Path('page.md').read_text()}")
        Path("out.png").write_bytes(FOREIGN)
        return measure(*arguments, **options)

    monkeypatch.setattr(import_module("hyrfpack.bench"), "benchmark_model", edited_meanwhile)
    options = "--only codec --repeats 1 -o out.png --markdown page.md"
    result = succeeded("bench", "packed.hyrf", *options.split())

    assert Path("out.png").read_bytes() == FOREIGN
    assert "out-2.png: time against error" in result.stderr
    page = Path("page.md").read_text()
    assert page.startswith("A new line.\n") and "| raw |" in page.replace("`", "")


def test_a_log_that_appears_meanwhile_is_kept(world, monkeypatch):
    run = import_module("hyrfpack.train.run")
    trainer = run.Trainer

    def create(*arguments, **options):
        Path("log.jsonl").write_bytes(FOREIGN)
        return trainer(*arguments, **options)

    monkeypatch.setattr(run, "Trainer", create)
    result = succeeded("train", "data", *TRAINING.split(), "-o", "out", "--log", "log.jsonl")

    assert Path("log.jsonl").read_bytes() == FOREIGN and "the result is in log-2.jsonl" in result.stderr
    assert json.loads(Path("log-2.jsonl").read_text().splitlines()[-1])["complete"] is True


def test_a_checkpoint_of_another_program_is_kept_and_training_continues(world, monkeypatch):
    appears("out/checkpoint.pt", monkeypatch)
    result = succeeded("train", "data", "--steps", 3, "--max-gaussians", 40, "-o", "out")

    assert Path("out/checkpoint.pt").read_bytes() == FOREIGN and Path("out/model.hyrf").is_file()
    assert "checkpoint.pt: another program created this file in the meantime" in result.stderr


NAMED_BY_OTHERS = [  # files of a folder that name each other
    ("export model.hyrf -o out", "out/index.html"),
    ("export model.hyrf packed.hyrf -o out", "out/index.html"),
    ("export model.hyrf --colmap -o out", "out/sparse/0/cameras.bin"),
    ("compress model.hyrf --profile paper -o new.hyrf --report out", "out/index.html"),
    ("evaluate model.hyrf --data data --pictures out", "out/0000.png"),
    ("make packed.hyrf --work made -o out", "out/index.html"),
    ("demo --steps 2 -o out", "out/scene/transforms.json"),
]


@pytest.mark.parametrize(("command", "asked"), NAMED_BY_OTHERS)
def test_a_file_that_appears_in_a_folder_of_files_that_name_each_other_is_kept(command, asked, world, monkeypatch):
    appears(asked, monkeypatch)
    sentence = refused_at_last(command)

    assert Path(asked).read_bytes() == FOREIGN
    assert asked.split("/")[-1] in sentence and "--overwrite" in sentence
    assert not list(Path("out").rglob("*-2.*"))


def refused_at_last(command: str) -> str:
    """The one sentence of a command that was refused after its work."""
    result = run_command(*command.split())
    assert result.exit_code == 2 and "Traceback" not in result.stderr, result.output
    (sentence,) = [line for line in result.stderr.splitlines() if line.startswith("Error: ")]
    return sentence


WRITERS = {  # functions of the library that write one file
    "save": lambda out: hyrfpack.save_model(load_model("model.hyrf"), out, overwrite=False),
    "repack": lambda out: repack("packed.hyrf", out, overwrite=False),
    "compress": lambda out: hyrfpack.compress_model("model.hyrf", out, "paper", overwrite=False),
    "distill": lambda out: hyrfpack.import_splats(
        "ball.ply", out, hyrfpack.DistillConfig(steps=1, size=16), overwrite=False
    ),
    "export": lambda out: hyrfpack.export_model("model.hyrf", out, degree=0, overwrite=False),
    "compare": lambda out: hyrfpack.compare_runs(["first", "second"], out),
}


@pytest.mark.usefixtures("short_imports")
@pytest.mark.parametrize("name", WRITERS)
def test_a_library_call_without_overwrite_keeps_what_appears_meanwhile_and_reports_the_path(name, world, monkeypatch):
    ending = {"export": "ply", "compare": "html"}.get(name, "hyrf")
    appears(f"out.{ending}", monkeypatch)
    assert WRITERS[name](f"out.{ending}").file == f"out-2.{ending}"
    assert Path(f"out.{ending}").read_bytes() == FOREIGN and Path(f"out-2.{ending}").is_file()


@pytest.mark.parametrize("name", [name for name in WRITERS if name != "save"])
def test_a_library_call_without_overwrite_rejects_a_file_that_is_there_at_the_start(name, world):
    ending = {"export": "ply", "compare": "html"}.get(name, "hyrf")
    Path(f"out.{ending}").write_bytes(FOREIGN)
    before = files_in(world)
    with pytest.raises(HyrfError, match="there is a file of this name"):
        WRITERS[name](f"out.{ending}")
    assert files_in(world) == before


# -- two commands in one folder ----------------------------------------------------------------------------------------

FOLDERS = [
    f"train data {TRAINING} -o out",
    f"train data {TRAINING} -o out --overwrite",
    f"train data {TRAINING} -o out --resume",
    f"train photos {TRAINING} -o out --poses",
    f"train photos {TRAINING} -o out --poses --overwrite",
    "poses photos -o out",
    "render model.hyrf --orbit 1 -o out",
    "evaluate model.hyrf --data data --pictures out",
    "compress model.hyrf --profile paper -o new.hyrf --report out",
    "export model.hyrf -o out",
    "export model.hyrf packed.hyrf -o out",
    "export -o out",
    "export model.hyrf --colmap -o out",
    "make packed.hyrf --work made -o out",
    "make packed.hyrf --work out -o new.html",
    "demo --steps 1 -o out",
]


@pytest.mark.parametrize("command", FOLDERS)
def test_a_command_is_rejected_where_another_one_is_at_work_and_nothing_changes(command, world):
    with exclusive_folder("out"):
        before = files_in(world)
        assert refused(*command.split()).startswith(f"Error: out: {BUSY}")
        after = files_in(world)
        new = {"new.hyrf"} if "--report" in command else set()  # the file is finished before its page is begun
        assert {name: after[name] for name in after if name not in new} == before


CALLS = {  # functions of the library that write into a folder
    "train": lambda: hyrfpack.train_model(load_scene("data"), "out", TrainConfig(steps=2), quiet=True),
    "estimate_poses": lambda: hyrfpack.estimate_poses("photos", "out"),
    "evaluate": lambda: hyrfpack.evaluate_model(load_model("model.hyrf"), load_scene("data").test, pictures="out"),
    "export": lambda: hyrfpack.export_model("model.hyrf", "out"),
    "export colmap": lambda: hyrfpack.export_model("model.hyrf", "out", colmap=True),
    "player": lambda: hyrfpack.export.player(None, "out"),
    "gallery": lambda: hyrfpack.export.gallery(["model.hyrf"], "out"),
    "make": lambda: hyrfpack.make_scene("packed.hyrf", "out", work="made"),
    "make work": lambda: hyrfpack.make_scene("packed.hyrf", "new.html", work="out"),
    "render_files": lambda: list(render_files(load_model("model.hyrf"), ring_of_two(), "out")),
    "write_report": lambda: write_report("out", "model.hyrf", "packed.hyrf", CompressionReport("paper", 1, 1, 1, [])),
    "run_demo": lambda: run_demo("out", steps=1),
    "posed": lambda: auto_pose(Path("photos"), Path("out")),
}


def ring_of_two() -> list:
    return [(str(number), camera) for number, camera in enumerate(ring(2))]


@pytest.mark.parametrize("name", CALLS)
def test_a_library_call_is_rejected_where_another_one_is_at_work_and_nothing_changes(name, world):
    with exclusive_folder("out"):
        before = files_in(world)
        with pytest.raises(HyrfError, match=f"out: {BUSY}"):
            CALLS[name]()
        assert files_in(world) == before


@pytest.mark.parametrize("name", [name for name in CALLS if name in ("export", "gallery", "render_files", "evaluate")])
def test_a_library_call_holds_its_folder_while_it_writes(name, world, monkeypatch):
    held = looked_at_each_write("out", monkeypatch)
    CALLS[name]()
    assert held and all(held)


HOLDING = [command for command in FOLDERS if "--resume" not in command and "pos" not in command]


@pytest.mark.parametrize("command", HOLDING)
def test_a_command_holds_its_folder_while_it_writes(command, world, monkeypatch):
    held = looked_at_each_write("out", monkeypatch)
    succeeded(*command.split())

    writes = held[1:] if "--report" in command else held  # the file comes before the page
    assert any(writes) and all(writes[1:])


def test_a_film_is_made_before_the_folder_is_free_again(world, monkeypatch):
    from hyrfpack.render import video

    held = []

    def film(frames, path, overwrite):
        with pytest.raises(HyrfError, match=BUSY), exclusive_folder("out"):
            pass
        held.append(len(frames))
        return path

    monkeypatch.setattr(video, "has_ffmpeg", lambda: True)
    monkeypatch.setattr(video, "write_video", film)
    succeeded("render", "model.hyrf", "--orbit", 2, "-o", "out", "--video")
    assert held == [2]


def test_two_trainings_that_start_at_once_in_one_folder_end_with_one_result_and_one_refusal(world):
    command = [sys.executable, "-m", "hyrfpack", "train", "data", *TRAINING.split(), "-o", "out", "--seed"]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2]), "HYRFPACK_THREADS": "1"}
    both = [
        subprocess.Popen([*command, seed], env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        for seed in ("1", "2")
    ]
    said = [process.communicate() for process in both]

    assert sorted(process.returncode for process in both) == [0, 2], said
    winner = 0 if both[0].returncode == 0 else 1
    assert json.loads(Path("out/metrics.json").read_text())["settings"]["seed"] == winner + 1
    assert len(load_model("out/model.hyrf")) and said[winner][0].startswith("out/model.hyrf: ")
    (sentence,) = [line for line in said[1 - winner][1].splitlines() if line.startswith("Error: ")]
    assert BUSY in sentence or "the folder holds an earlier run" in sentence


def test_two_compressions_to_one_file_at_once_both_leave_their_result(world):
    command = [sys.executable, "-m", "hyrfpack", "compress", "model.hyrf", "-o", "out.hyrf", "--profile", "paper"]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2]), "HYRFPACK_THREADS": "1"}
    both = [
        subprocess.Popen(
            [*command, "--json"], env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        for _ in range(2)
    ]
    said = [process.communicate() for process in both]
    written = [json.loads(out)["file"] for process, (out, _) in zip(both, said, strict=True) if not process.returncode]

    assert written and {path.name for path in Path().glob("out*.hyrf")} == set(written)
    for process, (_, complaint) in zip(both, said, strict=True):  # one that started late is told so
        assert process.returncode == 0 or "there is a file of this name" in complaint

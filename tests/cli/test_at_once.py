"""Simultaneous commands, and files that appear while a command works, never cost anybody a result.

The file of another program is created when the command has finished its work and is about to name its first output.
At that moment it no longer matters whether the command has checked the path before.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Sequence
from importlib import import_module
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path

import pytest
from commands import hyrfpack as run_command
from commands import refused, succeeded
from explicit_balls import ball_splats
from scenes import QUIET_CONTEXT, ring

import hyrfpack
from hyrfpack.compress import CompressionReport
from hyrfpack.data import load_scene
from hyrfpack.demo.run import run_demo
from hyrfpack.demo.scene import write_demo_scene
from hyrfpack.errors import HyrfError
from hyrfpack.format import load_model, repack
from hyrfpack.lock import exclusive_folder
from hyrfpack.make.auto_pose import auto_pose
from hyrfpack.render.files import render_files
from hyrfpack.report.compression import write_compression_report
from hyrfpack.splats.formats import ply
from hyrfpack.train import TrainConfig

pytest.importorskip("fcntl", reason="locks are of Unix")
pytestmark = pytest.mark.usefixtures("quick_calibration", "quick_scores")
FOREIGN_BYTES = b"of another program"
BUSY_FOLDER_ERROR = "another hyrfpack command is at work in this folder; wait until it has ended, or name another"
PAPER_PROFILE = hyrfpack.CompressConfig(profile="paper")
PAPER_REPORT = CompressionReport("packed.hyrf", "paper", 1, 1, 1, [])
TINY_TRAINING_OPTIONS = "--steps 2 --max-gaussians 40"


@pytest.fixture(scope="module")
def template(data, tmp_path_factory) -> Path:
    """A folder with a data set, photos without poses, a run, models and splats. Tests must not change it."""
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
def working_folder(template, tmp_path, monkeypatch) -> Path:
    """A copy of the template as the working folder."""
    folder = Path(shutil.copytree(template, tmp_path / "world"))
    monkeypatch.chdir(folder)
    return folder


@pytest.fixture
def quick_demo(monkeypatch) -> None:
    """Reduce the demo to four photos of 16 pixels."""

    def write_tiny_scene(folder: Path, views: int, size: int, overwrite: bool) -> Path:
        return write_demo_scene(folder, views=4, size=16, overwrite=overwrite)

    monkeypatch.setattr("hyrfpack.demo.run.write_demo_scene", write_tiny_scene)


def create_foreign_file(path: str, patch: pytest.MonkeyPatch) -> None:
    """Create a file of another program as soon as the command has written its first output."""
    fsync = os.fsync

    def create(descriptor: int) -> None:
        if not os.path.exists(path):
            Path(path).parent.mkdir(parents=True, exist_ok=True)
            Path(path).write_bytes(FOREIGN_BYTES)
        fsync(descriptor)

    patch.setattr(os, "fsync", create)


def record_lock_at_writes(folder: str, patch: pytest.MonkeyPatch) -> list[bool]:
    """Record at each write whether a folder is locked."""
    fsync, locked = os.fsync, []

    def look(descriptor: int) -> None:
        try:
            with exclusive_folder(folder):
                locked.append(False)
        except HyrfError:
            locked.append(True)
        fsync(descriptor)

    patch.setattr(os, "fsync", look)
    return locked


def files_in(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


# -- a file that appears while a command works -------------------------------------------------------------------------

# The command, the requested file, and the path where the result must be.
SINGLE_FILE_COMMANDS = [
    ("compress model.hyrf --profile paper -o {}", "out.hyrf", "out-2.hyrf"),
    ("compress first --no-data -o {}", "out.hyrf", "out-2.hyrf"),
    ("decompress packed.hyrf -o {}", "out.hyrf", "out-2.hyrf"),
    ("export model.hyrf -o {}", "out.html", "out-2.html"),
    ("export model.hyrf --baked --sh-degree 0 -o {}", "out.html", "out-2.html"),
    ("export model.hyrf --sh-degree 0 -o {}", "out.ply", "out-2.ply"),
    ("export model.hyrf -o {}", "out.points.ply", "out-2.points.ply"),
    ("export model.hyrf -o {}", "out.json", "out-2.json"),
    ("import ball.ply --size 16 -o {}", "out.hyrf", "out-2.hyrf"),
    ("compare first second -o {}", "out.html", "out-2.html"),
    ("make packed.hyrf --work made -o {}", "out.html", "out-2.html"),
    ("make packed.hyrf --work made -o {}", "out.points.ply", "out-2.points.ply"),
]
# These write with the same function as another command of the list. The acceptance layer has all commands in all tests.
SLOW_COMMANDS = ("compress first", "export model.hyrf --baked")
# The integration layer has at least one of the three tests below for most of these.
SLOWER_COMMANDS = (*SLOW_COMMANDS, "export model.hyrf --sh-degree 0", "import ", "compare ", "make packed.hyrf")


def mark_slow(cases: Sequence[Sequence[str]], slow: tuple[str, ...]) -> list:
    """Return the cases, those whose command begins with one of `slow` for the acceptance layer."""
    return [pytest.param(*case, marks=[pytest.mark.acceptance] if case[0].startswith(slow) else []) for case in cases]


# Folders whose files can each have another name.
FOLDER_COMMANDS_WITH_FREE_NAMES = [
    ("render model.hyrf --orbit 2 -o out", "out/0001.png", "out/0001-2.png"),
    (f"train data {TINY_TRAINING_OPTIONS} -o out", "out/model.hyrf", "out/model-2.hyrf"),
]


@pytest.mark.usefixtures("quick_import")
@pytest.mark.parametrize(
    ("command", "asked", "beside"),
    mark_slow([*SINGLE_FILE_COMMANDS, *FOLDER_COMMANDS_WITH_FREE_NAMES], (*SLOW_COMMANDS, "import ", "compare ")),
)
def test_a_file_that_appears_meanwhile_is_kept_and_the_result_gets_another_name(
    command, asked, beside, working_folder, monkeypatch
):
    create_foreign_file(asked, monkeypatch)
    result = succeeded(*command.format(asked).split())

    assert Path(asked).read_bytes() == FOREIGN_BYTES and Path(beside).stat().st_size > len(FOREIGN_BYTES)
    sentence = (
        f"{asked}: this file was created by something else in the meantime and is kept; the result is in {beside}"
    )
    assert result.stderr.count(sentence) == 1
    if beside.endswith(".hyrf"):
        assert len(load_model(beside))
    if "out/" not in beside:
        assert beside in result.stdout and asked not in result.stdout


@pytest.mark.usefixtures("quick_import")
@pytest.mark.parametrize(("command", "asked", "beside"), mark_slow(SINGLE_FILE_COMMANDS, (*SLOW_COMMANDS, "import ")))
def test_json_names_the_file_that_was_actually_written(command, asked, beside, working_folder, monkeypatch):
    create_foreign_file(asked, monkeypatch)
    facts = json.loads(succeeded(*command.format(asked).split(), "--json").stdout)

    assert facts.get("file", facts.get("output")) == beside
    if "output" in facts:
        assert facts["export"]["file"] == beside


@pytest.mark.usefixtures("quick_import")
@pytest.mark.parametrize(
    ("command", "asked", "beside"),
    mark_slow([*SINGLE_FILE_COMMANDS, *FOLDER_COMMANDS_WITH_FREE_NAMES], (*SLOWER_COMMANDS, "train ")),
)
def test_with_overwrite_the_last_writer_wins(command, asked, beside, working_folder, monkeypatch):
    create_foreign_file(asked, monkeypatch)
    result = succeeded(*command.format(asked).split(), "--overwrite")

    assert Path(asked).stat().st_size > len(FOREIGN_BYTES) and not Path(beside).exists()
    assert "meantime" not in result.stderr


def test_json_of_render_names_the_pictures_that_were_actually_written(working_folder, monkeypatch):
    create_foreign_file("out/0000.png", monkeypatch)
    facts = json.loads(succeeded("render", "model.hyrf", "--orbit", 2, "-o", "out", "--json").stdout)
    assert facts["pictures"] == ["out/0000-2.png", "out/0001.png"]


@pytest.mark.acceptance
def test_bench_keeps_files_that_appear_meanwhile_and_updates_the_current_page(working_folder, monkeypatch):
    words = import_module("hyrfpack.bench.tables")
    measure = import_module("hyrfpack.bench.suite").benchmark_model
    Path("page.md").write_text(words.empty_page({"machine": "", "codec": ""}))

    def edited_meanwhile(*arguments, **options):
        text = f"A new line.\n{Path('page.md').read_text()}"
        Path("page.md").write_bytes(text.replace("\n", "\r\n").encode())  # as an editor on Windows may save it
        Path("out.png").write_bytes(FOREIGN_BYTES)
        return measure(*arguments, **options)

    monkeypatch.setattr(import_module("hyrfpack.bench.suite"), "benchmark_model", edited_meanwhile)
    monkeypatch.setattr("hyrfpack.bench.codec.PROFILE_SETTING_VALUES", {})
    options = "--only codec --repeats 1 -o out.png --markdown page.md"
    result = succeeded("bench", "packed.hyrf", *options.split())

    assert Path("out.png").read_bytes() == FOREIGN_BYTES
    assert "out-2.png: time against error" in result.stderr
    page = Path("page.md").read_bytes().decode()
    assert page.startswith("A new line.\r\n") and "| raw |" in page.replace("`", "")
    assert page.count("\n") == page.count("\r\n")


def test_a_log_that_appears_meanwhile_is_kept(working_folder, monkeypatch):
    run = import_module("hyrfpack.train.run")
    trainer = run.Trainer

    def create(*arguments, **options):
        Path("log.jsonl").write_bytes(FOREIGN_BYTES)
        return trainer(*arguments, **options)

    monkeypatch.setattr(run, "Trainer", create)
    result = succeeded("train", "data", *TINY_TRAINING_OPTIONS.split(), "-o", "out", "--log", "log.jsonl")

    assert Path("log.jsonl").read_bytes() == FOREIGN_BYTES and "the result is in log-2.jsonl" in result.stderr
    assert json.loads(Path("log-2.jsonl").read_text().splitlines()[-1])["complete"] is True


def test_a_checkpoint_of_another_program_is_kept_and_training_continues(working_folder, monkeypatch):
    create_foreign_file("out/checkpoint.pt", monkeypatch)
    result = succeeded("train", "data", "--steps", 3, "--max-gaussians", 40, "-o", "out")

    assert Path("out/checkpoint.pt").read_bytes() == FOREIGN_BYTES and Path("out/model.hyrf").is_file()
    assert "checkpoint.pt: another program created this file in the meantime" in result.stderr


# Folders whose files refer to each other by name.
FOLDER_COMMANDS_WITH_FIXED_NAMES = [
    ("export model.hyrf -o out", "out/index.html"),
    ("export model.hyrf packed.hyrf -o out", "out/index.html"),
    ("export model.hyrf --colmap -o out", "out/sparse/0/cameras.bin"),
    ("compress model.hyrf --profile paper -o new.hyrf --report out", "out/index.html"),
    ("evaluate model.hyrf --data data --pictures out", "out/0000.png"),
    ("make packed.hyrf --work made -o out", "out/index.html"),
    ("demo --steps 2 -o out", "out/scene/transforms.json"),
]


@pytest.mark.usefixtures("quick_demo")
@pytest.mark.parametrize(("command", "asked"), FOLDER_COMMANDS_WITH_FIXED_NAMES)
def test_a_file_that_appears_in_a_folder_with_fixed_names_is_kept(command, asked, working_folder, monkeypatch):
    create_foreign_file(asked, monkeypatch)
    sentence = error_after_work(command)

    assert Path(asked).read_bytes() == FOREIGN_BYTES
    assert asked.split("/")[-1] in sentence and "--overwrite" in sentence
    assert not list(Path("out").rglob("*-2.*"))


def error_after_work(command: str) -> str:
    """Run a command that fails after its work, and return its error line."""
    result = run_command(*command.split())
    assert result.exit_code == 2 and "Traceback" not in result.stderr, result.output
    (sentence,) = [line for line in result.stderr.splitlines() if line.startswith("Error: ")]
    return sentence


# Functions of the library that write one file.
CALLS_THAT_WRITE_A_FILE = {
    "save": lambda out: hyrfpack.save_model(load_model("model.hyrf"), out, overwrite=False),
    "repack": lambda out: repack("packed.hyrf", out, overwrite=False),
    "compress": lambda out: hyrfpack.compress_model("model.hyrf", out, PAPER_PROFILE, overwrite=False),
    "import": lambda out: hyrfpack.import_splats("ball.ply", out, hyrfpack.ImportConfig(size=16), overwrite=False),
    "export": lambda out: hyrfpack.export_model("model.hyrf", out, hyrfpack.ExportConfig(degree=0), overwrite=False),
    "compare": lambda out: hyrfpack.compare_runs(["first", "second"], out),
}


@pytest.mark.usefixtures("quick_import")
@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.acceptance if name == "import" else ()) for name in CALLS_THAT_WRITE_A_FILE],
)
def test_a_library_call_without_overwrite_keeps_a_new_file_and_reports_its_own_path(name, working_folder, monkeypatch):
    ending = {"export": "ply", "compare": "html"}.get(name, "hyrf")
    create_foreign_file(f"out.{ending}", monkeypatch)
    assert CALLS_THAT_WRITE_A_FILE[name](f"out.{ending}").file == f"out-2.{ending}"
    assert Path(f"out.{ending}").read_bytes() == FOREIGN_BYTES and Path(f"out-2.{ending}").is_file()


@pytest.mark.parametrize("name", [name for name in CALLS_THAT_WRITE_A_FILE if name != "save"])
def test_a_library_call_without_overwrite_rejects_an_existing_file(name, working_folder):
    ending = {"export": "ply", "compare": "html"}.get(name, "hyrf")
    Path(f"out.{ending}").write_bytes(FOREIGN_BYTES)
    before = files_in(working_folder)
    with pytest.raises(HyrfError, match="there is a file of this name"):
        CALLS_THAT_WRITE_A_FILE[name](f"out.{ending}")
    assert files_in(working_folder) == before


# -- two commands in one folder ----------------------------------------------------------------------------------------

FOLDER_COMMANDS = [
    f"train data {TINY_TRAINING_OPTIONS} -o out",
    f"train data {TINY_TRAINING_OPTIONS} -o out --overwrite",
    f"train data {TINY_TRAINING_OPTIONS} -o out --resume",
    f"train photos {TINY_TRAINING_OPTIONS} -o out --poses",
    f"train photos {TINY_TRAINING_OPTIONS} -o out --poses --overwrite",
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


@pytest.mark.parametrize("command", FOLDER_COMMANDS)
def test_a_command_is_rejected_in_a_locked_folder_and_changes_nothing(command, working_folder):
    with exclusive_folder("out"):
        before = files_in(working_folder)
        assert refused(*command.split()).startswith(f"Error: out: {BUSY_FOLDER_ERROR}")
        after = files_in(working_folder)
        new = {"new.hyrf"} if "--report" in command else set()  # the file is complete before its page is begun
        assert {name: after[name] for name in after if name not in new} == before


# Functions of the library that write into a folder.
CALLS_THAT_WRITE_A_FOLDER = {
    "train": lambda: hyrfpack.train_model(load_scene("data"), "out", TrainConfig(steps=2), context=QUIET_CONTEXT),
    "estimate_poses": lambda: hyrfpack.estimate_poses("photos", "out"),
    "evaluate": lambda: hyrfpack.evaluate_model(load_model("model.hyrf"), load_scene("data").test, pictures="out"),
    "export": lambda: hyrfpack.export_model("model.hyrf", "out"),
    "export colmap": lambda: hyrfpack.export_model("model.hyrf", "out", hyrfpack.ExportConfig(colmap=True)),
    "player": lambda: hyrfpack.export_player(None, "out"),
    "gallery": lambda: hyrfpack.export_gallery(["model.hyrf"], "out"),
    "make": lambda: hyrfpack.make_scene("packed.hyrf", "out", work="made"),
    "make work": lambda: hyrfpack.make_scene("packed.hyrf", "new.html", work="out"),
    "render_files": lambda: list(render_files(load_model("model.hyrf"), two_ring_cameras(), "out")),
    "write_compression_report": lambda: write_compression_report("out", "model.hyrf", "packed.hyrf", PAPER_REPORT),
    "run_demo": lambda: run_demo("out", steps=1),
    "posed": lambda: auto_pose(Path("photos"), Path("out")),
}


def two_ring_cameras() -> list:
    return [(str(number), camera) for number, camera in enumerate(ring(2))]


@pytest.mark.parametrize("name", CALLS_THAT_WRITE_A_FOLDER)
def test_a_library_call_is_rejected_in_a_locked_folder_and_changes_nothing(name, working_folder):
    with exclusive_folder("out"):
        before = files_in(working_folder)
        with pytest.raises(HyrfError, match=f"out: {BUSY_FOLDER_ERROR}"):
            CALLS_THAT_WRITE_A_FOLDER[name]()
        assert files_in(working_folder) == before


@pytest.mark.parametrize(
    "name", [name for name in CALLS_THAT_WRITE_A_FOLDER if name in ("export", "gallery", "render_files", "evaluate")]
)
def test_a_library_call_locks_its_folder_while_it_writes(name, working_folder, monkeypatch):
    locked = record_lock_at_writes("out", monkeypatch)
    CALLS_THAT_WRITE_A_FOLDER[name]()
    assert locked and all(locked)


LOCKING_COMMANDS = [command for command in FOLDER_COMMANDS if "--resume" not in command and "pos" not in command]


@pytest.mark.usefixtures("quick_demo")
@pytest.mark.parametrize(
    "command",
    mark_slow([[command] for command in LOCKING_COMMANDS], ("demo ", "compress ", "make packed.hyrf --work o")),
)
def test_a_command_locks_its_folder_while_it_writes(command, working_folder, monkeypatch):
    locked = record_lock_at_writes("out", monkeypatch)
    succeeded(*command.split())

    writes = locked[1:] if "--report" in command else locked  # the file comes before the page
    assert any(writes) and all(writes[1:])


def test_a_video_is_written_before_the_folder_is_unlocked(working_folder, monkeypatch):
    from hyrfpack.render import video

    locked = []

    def film(frames, path, overwrite):
        with pytest.raises(HyrfError, match=BUSY_FOLDER_ERROR), exclusive_folder("out"):
            pass
        locked.append(len(frames))
        return path

    monkeypatch.setattr(video, "has_ffmpeg", lambda: True)
    monkeypatch.setattr(video, "write_video", film)
    succeeded("render", "model.hyrf", "--orbit", 2, "-o", "out", "--video")
    assert locked == [2]


def run_at_once(*commands: str) -> list[tuple[int, str, str]]:
    """Run commands in forked processes that start together; return exit code, output and messages of each."""
    fork = get_context("fork")
    barrier = fork.Barrier(len(commands))

    def run(command: str, sender: Connection) -> None:
        barrier.wait()
        result = run_command(*command.split())
        sender.send((result.exit_code, result.stdout, result.stderr))

    started = []
    for command in commands:
        receiver, sender = fork.Pipe(duplex=False)
        started.append((receiver, fork.Process(target=run, args=(command, sender))))
        started[-1][1].start()
        sender.close()  # so that a process that ends without a result is an error here
    results = [receiver.recv() for receiver, _ in started]
    for _, process in started:
        process.join()
    return results


def test_two_simultaneous_renderings_in_one_folder_give_one_result_and_one_error(working_folder):
    results = run_at_once(*(f"render model.hyrf --orbit {count} -o out" for count in (1, 2)))

    codes = [code for code, _, _ in results]
    assert sorted(codes) == [0, 2], results
    assert len(files_in(Path("out"))) == codes.index(0) + 1
    (sentence,) = [line for line in results[codes.index(2)][2].splitlines() if line.startswith("Error: ")]
    assert BUSY_FOLDER_ERROR in sentence or "there is a file of this name" in sentence  # if it started late


def test_two_simultaneous_decompressions_to_one_file_keep_both_results(working_folder):
    results = run_at_once(*["decompress packed.hyrf -o out.hyrf --json"] * 2)
    written = [json.loads(output)["file"] for code, output, _ in results if code == 0]

    assert written and {path.name for path in Path().glob("out*.hyrf")} == set(written)
    assert len(written) == len(set(written))
    for code, _, messages in results:  # a command that started late gets this error
        assert code == 0 or "there is a file of this name" in messages

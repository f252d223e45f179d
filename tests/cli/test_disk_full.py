"""A full disk in any command is a clear error with exit code 2, and leaves old files and no partial ones.

The full disk is a tmpfs where mounting is allowed. Elsewhere it is a limit on file sizes (ulimit -f), which stops a
write in the middle in the same way.
"""

from __future__ import annotations

import dataclasses
import errno
import io
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest
from commands import hyrfpack
from PIL import Image
from scenes import QUIET_CONTEXT, ball_scene

from hyrfpack import format as hyrf_format
from hyrfpack.context import RunContext
from hyrfpack.data import PictureCache
from hyrfpack.errors import HyrfError
from hyrfpack.train import TrainConfig, Trainer, train_model

pytestmark = pytest.mark.usefixtures("quick_calibration")
resource = pytest.importorskip("resource", reason="limits and mounts are of Unix")
SHORT_TRAINING_OPTIONS = ("--steps", 8, "--max-gaussians", 500)
PICTURE_NAME_PATTERN = re.compile(r"\.(png|tiff)$")


@contextmanager
def file_limit(size: int) -> Iterator[None]:
    """Limit the size of files that this process writes."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


@pytest.fixture
def disk(tmp_path) -> Iterator[Path]:
    """A disk of 8 MiB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=8m", "none", str(folder)], capture_output=True, text=True, check=False
    )
    if mounted.returncode:
        pytest.skip(f"a disk cannot be mounted here ({mounted.stderr.strip()})")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


def fill(disk: Path, leave: int) -> Path:
    """Write a file that leaves `leave` bytes free on the disk, and return its path."""
    ballast = disk / "ballast"
    ballast.write_bytes(bytes(shutil.disk_usage(disk).free - leave))
    return ballast


def files_in(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def run(data, tmp_path_factory) -> Path:
    """An undisturbed run. It also compiles the kernels, whose cache the limits of the tests would affect."""
    folder = tmp_path_factory.mktemp("runs") / "tiny"
    assert hyrfpack("train", data, "-o", folder, *SHORT_TRAINING_OPTIONS).exit_code == 0
    return folder


@pytest.fixture(scope="module")
def packed(run, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("packed") / "packed.hyrf"
    assert hyrfpack("compress", run / "model.hyrf", "-o", path).exit_code == 0
    return path


# Command -> its arguments, given data, the trained model, the packed model and the output folder.
COMMANDS_THAT_WRITE = {
    "train": lambda data, model, packed, out: ("train", data, "-o", out, "--overwrite", *SHORT_TRAINING_OPTIONS),
    "compress": lambda data, model, packed, out: ("compress", model, "-o", out / "model.hyrf", "--overwrite"),
    "decompress": lambda data, model, packed, out: ("decompress", packed, "-o", out / "model.hyrf", "--overwrite"),
    "render": lambda data, model, packed, out: ("render", packed, "-o", out, "--orbit", 2, "--overwrite"),
    "render depth": lambda data, model, packed, out: (
        "render",
        packed,
        "-o",
        out,
        "--orbit",
        2,
        "--depth",
        "--overwrite",
    ),
    "evaluate": lambda data, model, packed, out: ("evaluate", packed, "--data", data, "--pictures", out, "--overwrite"),
    "demo": lambda data, model, packed, out: ("demo", "-o", out, "--overwrite", "--steps", 2),
}


def check_error(result, out: Path, before: dict[str, bytes], reason: str) -> None:
    assert result.exit_code == 2, result.output
    assert result.stdout == "" and "Traceback" not in result.stderr
    (sentence,) = [line for line in result.stderr.splitlines() if line.startswith("Error: ")]
    assert sentence.startswith(f"Error: {out}") and reason in sentence
    assert files_in(out) == before


def write_old_outputs(out: Path) -> dict[str, bytes]:
    """Write files of an earlier run under every name that a command here writes."""
    names = ("model.hyrf", "metrics.json", "curve.png", "views/0000.png", "0000.png", "0000.depth.tiff")
    for name in names:
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_bytes(f"old {name}".encode())
    (out / "scene" / "images").mkdir(parents=True)
    (out / "scene" / "images" / "0000.png").write_bytes(b"old photo")
    return files_in(out)


@pytest.mark.parametrize("command", COMMANDS_THAT_WRITE)
def test_a_full_disk_is_a_clear_error_and_the_old_files_stay(command, data, run, packed, disk):
    out = disk / "out"
    before = write_old_outputs(out)
    fill(disk, leave=0)

    result = hyrfpack(*COMMANDS_THAT_WRITE[command](data, run / "model.hyrf", packed, out))

    check_error(result, out, before, "the disk is full and this file was not written; free ")


@pytest.mark.parametrize("command", COMMANDS_THAT_WRITE)
def test_a_file_size_limit_is_a_clear_error_and_the_old_files_stay(command, data, run, packed, tmp_path):
    before = write_old_outputs(tmp_path)
    arguments = COMMANDS_THAT_WRITE[command](data, run / "model.hyrf", packed, tmp_path)

    with file_limit(1000):
        result = hyrfpack(*arguments)

    check_error(result, tmp_path, before, "so large a file is not allowed here (see 'ulimit -f')")


@pytest.mark.parametrize("command", COMMANDS_THAT_WRITE)
def test_a_read_only_disk_is_a_clear_error(command, data, run, packed, disk):
    out = disk / "out"
    before = write_old_outputs(out)
    subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)

    result = hyrfpack(*COMMANDS_THAT_WRITE[command](data, run / "model.hyrf", packed, out))

    check_error(result, out, before, "(Read-only file system); choose another place")
    assert "step" not in result.stderr  # training is rejected before its first step


def test_a_disk_that_fills_while_rendering_keeps_complete_pictures(packed, disk):
    size = 256 * 256 // 4
    fill(disk, leave=8 * size)

    result = hyrfpack("render", packed, "-o", disk / "out", "--orbit", 100)

    assert result.exit_code == 2 and "the disk is full" in result.stderr
    left = sorted((disk / "out").iterdir())
    assert 1 <= len(left) < 100 and all(PICTURE_NAME_PATTERN.search(path.name) for path in left)
    for path in left:
        Image.open(path).load()


# -- training --------------------------------------------------------------------------------------------------------


def test_training_continues_without_checkpoints_that_do_not_fit(data, run, tmp_path):
    """The model fits on the disk, and the checkpoint, which is three times as large, does not."""
    size = (run / "model.hyrf").stat().st_size
    with file_limit(2 * size):
        result = hyrfpack("train", data, "-o", tmp_path, *SHORT_TRAINING_OPTIONS)

    assert result.exit_code == 0, result.output
    notes = [
        line for line in result.stderr.splitlines() if "training continues, without the checkpoint of step" in line
    ]
    assert len(notes) == 7 and all(line.startswith(f"{tmp_path / 'checkpoint.pt'}: ") for line in notes)
    assert (tmp_path / "model.hyrf").read_bytes() == (run / "model.hyrf").read_bytes()
    assert {path.name for path in tmp_path.iterdir()} == {"model.hyrf", "metrics.json", "curve.png", "views"}


SHORT_CONFIG = TrainConfig(steps=40, seed=1, max_gaussians=120)


def balls_with_counted_loads(before_load=lambda count: None):
    """Return six views whose photos call `before_load` with the number of loads so far."""
    scene, count = ball_scene(views=6, points=60, side=24), [0]

    def watched(view):
        def load():
            count[0] += 1
            before_load(count[0])
            return view.load()

        return dataclasses.replace(view, load=load)

    return dataclasses.replace(scene, train=[watched(view) for view in scene.train])


@pytest.mark.acceptance
def test_a_disk_that_fills_in_training_keeps_the_checkpoint_and_resumes_to_the_same_model(disk):
    whole = Trainer(balls_with_counted_loads(), SHORT_CONFIG)
    whole.run()
    out = disk / "run"

    def fill_from_the_30th(count: int) -> None:
        # This repeats, because a finished checkpoint frees the space of the one before.
        if count >= 30:
            with suppress(OSError), open(disk / "ballast", "ab", buffering=0) as ballast:
                ballast.write(bytes(shutil.disk_usage(disk).free))

    out.mkdir()
    (out / "model.hyrf").write_bytes(b"old")

    kept = r"checkpoint of step \d+ is kept, the same command with `resume=True` instead of `overwrite=True` continues"
    with pytest.raises(HyrfError, match=rf"model.hyrf: the disk is full.*{kept}") as e:
        train_model(
            balls_with_counted_loads(fill_from_the_30th),
            out,
            SHORT_CONFIG,
            overwrite=True,
            context=RunContext(cache=PictureCache(0), progress=None),
        )

    assert files_in(out).keys() == {"model.hyrf", "checkpoint.pt"} and (out / "model.hyrf").read_bytes() == b"old"
    assert 10 <= int(re.search(r"checkpoint of step (\d+)", str(e.value))[1]) <= 30
    (disk / "ballast").unlink()
    result = train_model(balls_with_counted_loads(), out, SHORT_CONFIG, resume=True, context=QUIET_CONTEXT)
    for name, parameter in hyrf_format.load_model(result.model).named_parameters():
        np.testing.assert_array_equal(parameter.detach(), dict(whole.model.named_parameters())[name].detach())


def test_a_stop_without_space_for_the_checkpoint_names_the_one_that_is_kept(tmp_path):
    """On a full disk Ctrl-C cannot save a checkpoint, and the run ends."""
    trainer = Trainer(balls_with_counted_loads(), SHORT_CONFIG)
    path = tmp_path / "checkpoint.pt"
    trainer.run(checkpoint=path, stop=lambda: trainer.step == 10)
    kept = path.read_bytes()

    with file_limit(1000), pytest.raises(HyrfError, match="checkpoint.pt: so large a file"):
        trainer.run(checkpoint=path, stop=lambda: trainer.step == 13)

    assert trainer.saved == 10 and files_in(tmp_path) == {"checkpoint.pt": kept}


def test_the_trainer_warns_when_a_checkpoint_cannot_be_written(tmp_path, caplog):
    trainer = Trainer(balls_with_counted_loads(), dataclasses.replace(SHORT_CONFIG, steps=2))

    (tmp_path / "file").write_bytes(b"")

    assert trainer.run(checkpoint=tmp_path / "file" / "checkpoint.pt")

    (warning,) = caplog.records
    assert warning.levelname == "WARNING"
    assert re.search("cannot be made.*training continues, without the checkpoint of step 1", warning.getMessage())


def test_a_folder_removed_while_training_is_created_again_for_the_model(tmp_path):
    out = tmp_path / "run"
    scene = balls_with_counted_loads(lambda count: shutil.rmtree(out, ignore_errors=True) if count >= 20 else None)

    result = train_model(scene, out, SHORT_CONFIG, context=RunContext(cache=PictureCache(0), progress=None))

    assert result.complete and hyrf_format.load_model(out / "model.hyrf") is not None
    assert json.loads((out / "metrics.json").read_text())["settings"]["seed"] == 1


# -- what is printed -------------------------------------------------------------------------------------------------


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="there is no /dev/full")
def test_standard_output_on_a_full_disk_is_a_clear_error(packed):
    command = [sys.executable, "-m", "hyrfpack", "info", packed]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    with open("/dev/full", "w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False, env=environment)

    assert done.returncode == 2
    assert done.stderr.startswith("Error: the output cannot be printed") and "Traceback" not in done.stderr


class FullLog(io.StringIO):
    written = 0

    def write(self, text: str) -> int:
        FullLog.written += 1
        raise OSError(errno.ENOSPC, "No space left on device")


def test_log_on_a_full_disk_does_not_end_the_training(monkeypatch, tmp_path):
    monkeypatch.setattr("hyrfpack.progress.lines.LOG_INTERVAL_SECONDS", 0.0)
    monkeypatch.setattr("sys.stderr", FullLog())

    result = train_model(balls_with_counted_loads(), tmp_path, dataclasses.replace(SHORT_CONFIG, steps=2))

    assert result.complete and FullLog.written >= 2

"""Commands that several processes carry out: by --processes, or started as torchrun starts them."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
import torch.distributed as dist
from commands import refused, succeeded
from hypothesis import given
from hypothesis import strategies as st
from rank_processes import ProcessOutcome, needs_ranks, run_command_on_ranks, torchrun_environment

from hyrfpack.cli.processes import remove_option
from hyrfpack.demo.scene import write_demo_scene
from hyrfpack.errors import HyrfError
from hyrfpack.parallel.launch import launch

ROOT = Path(__file__).parents[2]
STEPS = ("--steps", 60, "--max-gaussians", 200)
LONG = ("--steps", 100, "--max-gaussians", 200)
NAMES = ("nowhere", "run", "nothing.hyrf", "out", "out.hyrf")  # of files in the folder of a test


def files_in(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def model_of(run: Path) -> bytes:
    return (run / "model.hyrf").read_bytes()


def spoken_for(ends: list[ProcessOutcome], code: int = 0) -> ProcessOutcome:
    """All ended alike, and rank 0 alone has said something."""
    assert [end.exit_code for end in ends] == [code] * len(ends), [end.errors for end in ends]
    assert [(end.output, end.errors) for end in ends[1:]] == [("", "")] * (len(ends) - 1)
    return ends[0]


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    """Ten photos, smaller than those of other tests."""
    return write_demo_scene(tmp_path_factory.mktemp("data"), views=10, size=24)


@pytest.fixture(scope="module")
def logs(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("logs")


@pytest.fixture(scope="module")
def trained(data, logs, tmp_path_factory) -> tuple[Path, list[ProcessOutcome]]:
    """A run of two processes, and how they ended."""
    out = tmp_path_factory.mktemp("runs") / "two"
    return out, run_command_on_ranks("train", data, "-o", out, *STEPS, "--json", folder=logs)


@pytest.fixture(scope="module")
def model(trained) -> Path:
    return trained[0] / "model.hyrf"


# -- the words -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "left"),
    [
        ("train a --processes 2 --steps 9", "train a --steps 9"),
        ("train a --processes=2 --steps 9", "train a --steps 9"),
        ("--quiet train --processes 4 a", "--quiet train a"),
        ("train a -o b --processes 2", "train a -o b"),
        ("train a --steps 2", "train a --steps 2"),
        ("train a --processes 2 --processes 3", "train a"),
    ],
)
def test_the_option_is_taken_out_with_its_value(words, left):
    assert remove_option(words.split()) == left.split()


@given(
    st.lists(st.sampled_from(["train", "a", "--steps", "9", "-o", "run", "--json"])), st.integers(1, 99), st.booleans()
)
def test_all_other_words_stay_in_their_order(words, number, joined):
    for place in range(len(words) + 1):
        option = [f"--processes={number}"] if joined else ["--processes", str(number)]
        assert remove_option([*words[:place], *option, *words[place:]]) == words


def test_processes_cannot_be_asked_for_within_one_of_several(monkeypatch, tmp_path):
    for name, value in torchrun_environment(0, 2, 1).items():
        monkeypatch.setenv(name, value)
    sentence = refused("train", tmp_path, "-o", tmp_path / "run", "--processes", 2)
    assert "started 2 processes; leave out --processes" in sentence


@pytest.mark.parametrize("number", ["0", "-1", "two", "1.5"])
def test_a_number_of_processes_that_is_none_is_rejected(number, tmp_path):
    assert "--processes" in refused("train", tmp_path, "-o", tmp_path / "run", "--processes", number)


def test_an_environment_that_makes_no_sense_is_a_clear_error(monkeypatch, tmp_path):
    monkeypatch.setenv("RANK", "3")
    monkeypatch.setenv("WORLD_SIZE", "2")
    assert "process 3 of 2" in refused("train", tmp_path, "-o", tmp_path / "run")


# -- one process -----------------------------------------------------------------------------------------------------


def test_one_process_of_torchrun_gives_the_bytes_of_none_and_touches_no_network(data, tmp_path, monkeypatch):
    words = ("train", data, *("--steps", 12, "--max-gaussians", 200))
    succeeded(*words, "-o", tmp_path / "none")
    monkeypatch.setattr(dist, "init_process_group", lambda *_, **__: pytest.fail("the network was touched"))
    for name, value in torchrun_environment(0, 1, 1).items():
        monkeypatch.setenv(name, value)
    succeeded(*words, "-o", tmp_path / "torchrun")
    succeeded(*words, "-o", tmp_path / "asked", "--processes", 1)
    assert model_of(tmp_path / "torchrun") == model_of(tmp_path / "none") == model_of(tmp_path / "asked")


# -- two processes ---------------------------------------------------------------------------------------------------


@needs_ranks
def test_rank_0_alone_speaks_and_says_how_many_they_are(trained):
    out, ends = trained
    first = spoken_for(ends)
    said = json.loads(first.output)
    assert said["complete"] and said["step"] == 30 and said["settings"]["steps"] == 60
    assert said["processes"] == json.loads((out / "metrics.json").read_text())["processes"] == 2
    assert "in each of 2 processes" in first.errors
    assert {path.name for path in out.iterdir()} == {"model.hyrf", "metrics.json", "curve.png", "views"}


@needs_ranks
@pytest.mark.parametrize("size", [2, 3])
def test_scores_are_those_of_one_process(size, data, model, logs, tmp_path):
    """With three, one has no photo."""
    words = ("evaluate", model, "--data", data, "--json", "--pictures")
    said = json.loads(spoken_for(run_command_on_ranks(*words, tmp_path / "many", folder=logs, size=size)).output)
    expected = json.loads(succeeded(*words, tmp_path / "one").stdout)
    assert len(said["views"]) == 2 and said.pop("seconds_per_frame") > 0 and expected.pop("seconds_per_frame") > 0
    assert said == expected
    assert files_in(tmp_path / "many") == files_in(tmp_path / "one") != {}


@needs_ranks
def test_pictures_are_those_of_one_process(model, logs, tmp_path):
    words = ("render", model, "--orbit", 5, "--depth", "--json", "-o")
    said = json.loads(spoken_for(run_command_on_ranks(*words, tmp_path / "two", folder=logs)).output)
    expected = json.loads(succeeded(*words, tmp_path / "one").stdout)
    assert [Path(path).name for path in said["pictures"]] == [Path(path).name for path in expected["pictures"]]
    assert files_in(tmp_path / "two") == files_in(tmp_path / "one") and len(files_in(tmp_path / "one")) == 10


@needs_ranks
def test_fine_tuning_together_gives_the_same_bytes_twice(data, model, logs, tmp_path):
    words = ("compress", model, "--data", data, "--finetune", 6, "--json", "-o")
    reports = [
        json.loads(spoken_for(run_command_on_ranks(*words, tmp_path / f"{name}.hyrf", folder=logs)).output)
        for name in "ab"
    ]
    assert (tmp_path / "a.hyrf").read_bytes() == (tmp_path / "b.hyrf").read_bytes()
    assert {**reports[0], "file": ""} == {**reports[1], "file": ""}
    assert reports[0]["psnr"] > reports[0]["psnr_before"] - 1


@needs_ranks
def test_a_profile_that_has_nothing_to_share_gives_what_one_process_does(model, logs, tmp_path):
    words = ("compress", model, "--profile", "paper", "-o")
    spoken_for(run_command_on_ranks(*words, tmp_path / "two.hyrf", folder=logs))
    succeeded(*words, tmp_path / "one.hyrf")
    assert (tmp_path / "two.hyrf").read_bytes() == (tmp_path / "one.hyrf").read_bytes()


@needs_ranks
def test_a_file_that_is_there_is_rejected_once(model, logs):
    end = spoken_for(run_command_on_ranks("compress", model, "-o", model, folder=logs), 2)
    assert str(model) in end.error_line


@needs_ranks
@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("train", "nowhere", "-o", "run"), "nowhere"),
        (("train", "data", "-o", "run", "--resume"), "there is no checkpoint to resume"),
        (("train", "data", "-o", "run", "--poses"), "--poses runs in one process only"),
        (("train", "data", "-o", "run", "--resume", "--overwrite"), "give one of them"),
        (("train", "data", "-o", "run", "--processes", "2"), "leave out --processes"),
        (("evaluate", "nothing.hyrf", "--data", "data"), "nothing.hyrf"),
        (("render", "nothing.hyrf", "-o", "out"), "nothing.hyrf"),
        (("compress", "nothing.hyrf", "-o", "out.hyrf"), "nothing.hyrf"),
    ],
    ids=lambda words: " ".join(words) if isinstance(words, tuple) else "",
)
def test_what_the_user_got_wrong_is_said_once(words, told, data, tmp_path):
    named = [data if word == "data" else tmp_path / word if word in NAMES else word for word in words]
    end = spoken_for(run_command_on_ranks(*named, folder=tmp_path / "logs"), 2)
    assert told in end.error_line and end.output == ""
    assert [path.name for path in tmp_path.iterdir()] == ["logs"]


# -- the launcher ----------------------------------------------------------------------------------------------------


@pytest.fixture
def launched(tmp_path, monkeypatch, signals, capfd):
    """Launches two processes that are a script of the shell; returns the exit code or sentence, and what they print."""
    (tmp_path / "python").write_text("")
    (tmp_path / "python").chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))

    def run(script: str) -> tuple[int | str, str]:
        (tmp_path / "python").write_text(f"#!/bin/sh\n{script}\n")
        try:
            code: int | str = launch(["info", "a b"], 2)
        except HyrfError as error:
            code = str(error)
        said = capfd.readouterr()
        return code, said.out + said.err

    return run


@needs_ranks
def test_processes_get_the_words_and_what_they_say_comes_through(launched):
    code, said = launched('echo "$RANK of $WORLD_SIZE: $5."; echo "also $RANK" >&2')
    assert code == 0 and sorted(said.splitlines()) == ["0 of 2: a b.", "1 of 2: a b.", "also 0", "also 1"]


@needs_ranks
@pytest.mark.parametrize("rank", [0, 1])
def test_the_exit_code_is_that_of_the_first_that_failed_and_the_others_are_ended(rank, launched):
    code, said = launched(f"test $RANK = {rank} && exit 3; exec sleep 500")
    assert code == 3 and said == ""


@needs_ranks
def test_a_first_process_that_was_killed_is_told_of(launched):
    code, _ = launched("test $RANK = 0 && kill -9 $$; exec sleep 500")
    assert "process 0 of 2 was ended by SIGKILL" in code


@needs_ranks
def test_a_request_to_stop_is_passed_on(launched):
    """Once both listen, the first sends it to the launcher."""
    listening = """trap 'echo $RANK stops; exit 1' TERM; touch "$0.$RANK" """
    asking = """test $RANK = 0 && { until test -e "$0.1"; do sleep 0.1; done; kill -TERM $PPID; }"""
    code, said = launched(f"{listening}; {asking}; while true; do sleep 0.1; done")
    assert code == 1 and {"0 stops", "1 stops"} <= set(said.splitlines())


@needs_ranks
def test_another_process_that_was_killed_is_told_of_where_the_first_can_say_nothing(launched):
    """As while it is still loading, or waits for the one that is gone."""
    code, said = launched("test $RANK = 1 && kill -9 $$; exec sleep 500")
    assert code == 2 and "process 1 of 2 was ended by SIGKILL" in said


@needs_ranks
def test_a_first_process_that_was_killed_is_an_error_of_the_launcher(launched):
    code, _ = launched("test $RANK = 0 && kill -9 $$; exec sleep 500")
    assert "process 0 of 2 was ended by SIGKILL" in code


# -- launchers and whole runs ----------------------------------------------------------------------------------------

# Python reads it in every process that starts: rank 1, as it was started first, kills itself once the run has written a
# checkpoint, and comes late when it is started anew.
KILLER = """
import os, threading, time
def kill():
    while not os.path.exists({checkpoint!r}):
        time.sleep(0.01)
    os.kill(os.getpid(), 9)
if os.environ.get("RANK") == "1" and os.environ.get("TORCHELASTIC_RESTART_COUNT") == "0":
    threading.Thread(target=kill, daemon=True).start()
elif os.environ.get("RANK") == "1":
    time.sleep(1)
"""


def ended(*words: object, folder: Path, code: int) -> tuple[str, str]:
    """Run Python with these words, where rank 1 kills itself; returns what it printed."""
    (folder / "sitecustomize.py").write_text(KILLER.format(checkpoint=str(folder / "run" / "checkpoint.pt")))
    paths = [str(folder), str(ROOT), os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "HYRFPACK_THREADS": "1", "OMP_NUM_THREADS": "1"}
    command = [sys.executable, *map(str, words)]
    process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        output, errors = process.communicate(timeout=90)
    finally:
        process.terminate()  # it ends those that it has started
        process.wait()
    assert process.returncode == code, errors
    return output, errors


def children(process: int) -> list[int]:
    return [int(word) for word in Path(f"/proc/{process}/task/{process}/children").read_text().split()]


def until(happened: Callable[[], bool], seconds: float = 60) -> bool:
    end = time.monotonic() + seconds
    while not happened() and time.monotonic() < end:
        time.sleep(0.05)
    return happened()


@needs_ranks
@pytest.mark.skipif(sys.platform != "linux", reason="looks for processes in /proc")
def test_processes_stop_when_their_launcher_is_killed(data, tmp_path):
    checkpoint = tmp_path / "run" / "checkpoint.pt"
    words = ["train", data, "-o", checkpoint.parent, "--processes", 2, "--steps", 4000, "--max-gaussians", 50]
    paths = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": paths, "HYRFPACK_THREADS": "1", "OMP_NUM_THREADS": "1"}
    with (tmp_path / "said").open("w") as said:
        command = [sys.executable, "-m", "hyrfpack", *map(str, words)]
        launcher = subprocess.Popen(command, env=environment, stdout=said, stderr=said)
    workers: list[int] = []
    try:
        assert until(checkpoint.exists), (tmp_path / "said").read_text()
        workers, before = children(launcher.pid), checkpoint.stat().st_mtime_ns
        launcher.kill()
        launcher.wait()
        assert until(lambda: not any(Path(f"/proc/{worker}").exists() for worker in workers), 30)
    finally:
        launcher.kill()
        launcher.wait()
        for worker in workers:
            with suppress(ProcessLookupError):
                os.kill(worker, signal.SIGKILL)
    assert len(workers) == 2 and checkpoint.stat().st_mtime_ns > before  # saved on the way out


@pytest.fixture(scope="module")
def uninterrupted(data, logs, tmp_path_factory) -> bytes:
    out = tmp_path_factory.mktemp("uninterrupted")
    spoken_for(run_command_on_ranks("train", data, "-o", out, *LONG, folder=logs))
    return model_of(out)


@needs_ranks
@pytest.mark.usefixtures("signals")
def test_a_run_of_two_that_has_lost_one_says_so_and_can_be_resumed(data, uninterrupted, logs, tmp_path):
    words = ("-m", "hyrfpack", "train", data, "-o", tmp_path / "run", *LONG, "--json", "--processes", 2)
    output, errors = ended(*words, folder=tmp_path, code=2)
    told, who = [line for line in errors.splitlines() if line.startswith("Error: ")]
    assert "one of the 2 processes has ended" in told and "the same command with --resume continues" in told
    assert "process 1 of 2 was ended by SIGKILL" in who
    assert json.loads(output)["error"] == told.removeprefix("Error: ") and "Traceback" not in errors
    assert [path.name for path in (tmp_path / "run").iterdir()] == ["checkpoint.pt"]

    spoken_for(run_command_on_ranks(*words[2:-2], "--resume", folder=logs))
    assert model_of(tmp_path / "run") == uninterrupted


@needs_ranks
def test_torchrun_starts_a_run_again_that_lost_a_process_and_it_continues(data, uninterrupted, tmp_path):
    torchrun = ("-m", "torch.distributed.run", "--standalone", "--nproc-per-node", 2, "--max-restarts", 1)
    words = ("-m", "hyrfpack", "train", data, "-o", tmp_path / "run", *LONG)
    output, errors = ended(*torchrun, *words, folder=tmp_path, code=0)
    assert "200 Gaussians" in output and output.count("model.hyrf") == 1
    assert "has ended" in errors or "closing signal" in errors  # said by the other process, or by torchrun before it
    assert model_of(tmp_path / "run") == uninterrupted

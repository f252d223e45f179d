"""Commands that run in several processes, by --processes or under torchrun."""

from __future__ import annotations

import json
import os
import signal
import socket
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

from hyrfpack.cli.processes import remove_processes_option
from hyrfpack.demo.scene import write_demo_scene
from hyrfpack.errors import HyrfError
from hyrfpack.parallel.launch import launch

REPOSITORY_ROOT = Path(__file__).parents[2]
TRAINING_OPTIONS = ("--steps", 60, "--max-gaussians", 200)
LONG_TRAINING_OPTIONS = ("--steps", 100, "--max-gaussians", 200)
# Names of files in a test's folder.
FILE_NAMES = ("nowhere", "run", "nothing.hyrf", "out", "out.hyrf")


def files_in(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def read_model_bytes(run: Path) -> bytes:
    return (run / "model.hyrf").read_bytes()


def check_rank_0_speaks(ends: list[ProcessOutcome], code: int = 0) -> ProcessOutcome:
    """Check that all processes ended with `code` and only rank 0 printed; return the outcome of rank 0."""
    assert [end.exit_code for end in ends] == [code] * len(ends), [end.errors for end in ends]
    assert [(end.output, end.errors) for end in ends[1:]] == [("", "")] * (len(ends) - 1)
    return ends[0]


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    """Ten photos that are smaller than those of other tests."""
    return write_demo_scene(tmp_path_factory.mktemp("data"), views=10, size=24)


@pytest.fixture(scope="module")
def logs(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("logs")


@pytest.fixture(scope="module")
def run_and_outcomes(data, logs, tmp_path_factory) -> tuple[Path, list[ProcessOutcome]]:
    """The folder of a run of two processes, and their outcomes."""
    out = tmp_path_factory.mktemp("runs") / "two"
    return out, run_command_on_ranks("train", data, "-o", out, *TRAINING_OPTIONS, "--json", folder=logs)


@pytest.fixture(scope="module")
def model(run_and_outcomes) -> Path:
    return run_and_outcomes[0] / "model.hyrf"


# -- arguments -------------------------------------------------------------------------------------------------------


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
def test_the_option_is_removed_with_its_value(words, left):
    assert remove_processes_option(words.split()) == left.split()


@given(
    st.lists(st.sampled_from(["train", "a", "--steps", "9", "-o", "run", "--json"])), st.integers(1, 99), st.booleans()
)
def test_all_other_arguments_keep_their_order(words, number, joined):
    for place in range(len(words) + 1):
        option = [f"--processes={number}"] if joined else ["--processes", str(number)]
        assert remove_processes_option([*words[:place], *option, *words[place:]]) == words


def test_the_processes_option_is_rejected_in_one_of_several_processes(monkeypatch, tmp_path):
    for name, value in torchrun_environment(0, 2, 1).items():
        monkeypatch.setenv(name, value)
    sentence = refused("train", tmp_path, "-o", tmp_path / "run", "--processes", 2)
    assert "started 2 processes; leave out --processes" in sentence


@pytest.mark.parametrize("number", ["0", "-1", "two", "1.5"])
def test_an_invalid_number_of_processes_is_rejected(number, tmp_path):
    assert "--processes" in refused("train", tmp_path, "-o", tmp_path / "run", "--processes", number)


def test_an_environment_that_makes_no_sense_is_a_clear_error(monkeypatch, tmp_path):
    monkeypatch.setenv("RANK", "3")
    monkeypatch.setenv("WORLD_SIZE", "2")
    assert "process 3 of 2" in refused("train", tmp_path, "-o", tmp_path / "run")


# -- one process -----------------------------------------------------------------------------------------------------


def test_one_process_under_torchrun_gives_the_same_bytes_without_network_access(data, tmp_path, monkeypatch):
    words = ("train", data, *("--steps", 12, "--max-gaussians", 200))
    succeeded(*words, "-o", tmp_path / "none")
    monkeypatch.setattr(dist, "init_process_group", lambda *_, **__: pytest.fail("the network was touched"))
    for name, value in torchrun_environment(0, 1, 1).items():
        monkeypatch.setenv(name, value)
    succeeded(*words, "-o", tmp_path / "torchrun")
    succeeded(*words, "-o", tmp_path / "asked", "--processes", 1)
    assert (
        read_model_bytes(tmp_path / "torchrun")
        == read_model_bytes(tmp_path / "none")
        == read_model_bytes(tmp_path / "asked")
    )


# -- two processes ---------------------------------------------------------------------------------------------------


@needs_ranks
def test_a_port_of_the_view_is_that_of_rank_0(data, logs, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    options = ("--steps", 4, "--max-gaussians", 50, "--view", "--view-port", port)
    first = check_rank_0_speaks(run_command_on_ranks("train", data, "-o", tmp_path / "run", *options, folder=logs))
    assert f"http://127.0.0.1:{port}/" in first.errors


@pytest.mark.smoke
@needs_ranks
def test_only_rank_0_prints_and_reports_the_number_of_processes(run_and_outcomes):
    out, ends = run_and_outcomes
    first = check_rank_0_speaks(ends)
    said = json.loads(first.output)
    assert said["complete"] and said["step"] == 30 and said["settings"]["steps"] == 60
    assert said["processes"] == json.loads((out / "metrics.json").read_text())["processes"] == 2
    assert "in each of 2 processes" in first.errors
    assert {path.name for path in out.iterdir()} == {"model.hyrf", "metrics.json", "curve.png", "views"}


@needs_ranks
@pytest.mark.parametrize("size", [2, 3])
def test_scores_equal_those_of_one_process(size, data, model, logs, tmp_path):
    """With three processes, one has no photo."""
    words = ("evaluate", model, "--data", data, "--json", "--pictures")
    said = json.loads(
        check_rank_0_speaks(run_command_on_ranks(*words, tmp_path / "many", folder=logs, size=size)).output
    )
    expected = json.loads(succeeded(*words, tmp_path / "one").stdout)
    assert len(said["views"]) == 2 and said.pop("seconds_per_frame") > 0 and expected.pop("seconds_per_frame") > 0
    assert said == expected
    assert files_in(tmp_path / "many") == files_in(tmp_path / "one") != {}


@needs_ranks
def test_pictures_equal_those_of_one_process(model, logs, tmp_path):
    words = ("render", model, "--orbit", 5, "--depth", "png", "--normals", "--json", "-o")
    said = json.loads(check_rank_0_speaks(run_command_on_ranks(*words, tmp_path / "two", folder=logs)).output)
    expected = json.loads(succeeded(*words, tmp_path / "one").stdout)
    assert [Path(path).name for path in said["pictures"]] == [Path(path).name for path in expected["pictures"]]
    assert files_in(tmp_path / "two") == files_in(tmp_path / "one") and len(files_in(tmp_path / "one")) == 16


@needs_ranks
def test_fine_tuning_in_two_processes_is_deterministic(data, model, logs, tmp_path):
    words = ("compress", model, "--data", data, "--finetune", 6, "--json", "-o")
    reports = [
        json.loads(check_rank_0_speaks(run_command_on_ranks(*words, tmp_path / f"{name}.hyrf", folder=logs)).output)
        for name in "ab"
    ]
    assert (tmp_path / "a.hyrf").read_bytes() == (tmp_path / "b.hyrf").read_bytes()
    assert {**reports[0], "file": ""} == {**reports[1], "file": ""}
    assert reports[0]["psnr"] > reports[0]["psnr_before"] - 1


@needs_ranks
def test_a_profile_without_parallel_work_gives_the_bytes_of_one_process(model, logs, tmp_path):
    words = ("compress", model, "--profile", "paper", "-o")
    check_rank_0_speaks(run_command_on_ranks(*words, tmp_path / "two.hyrf", folder=logs))
    succeeded(*words, tmp_path / "one.hyrf")
    assert (tmp_path / "two.hyrf").read_bytes() == (tmp_path / "one.hyrf").read_bytes()


@needs_ranks
def test_an_existing_file_is_rejected_with_one_error(model, logs):
    end = check_rank_0_speaks(run_command_on_ranks("compress", model, "-o", model, folder=logs), 2)
    assert str(model) in end.error_line


@needs_ranks
@pytest.mark.parametrize(
    ("words", "messages"),
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
def test_mistakes_of_the_user_are_reported_once(words, messages, data, tmp_path):
    named = [data if word == "data" else tmp_path / word if word in FILE_NAMES else word for word in words]
    end = check_rank_0_speaks(run_command_on_ranks(*named, folder=tmp_path / "logs"), 2)
    assert messages in end.error_line and end.output == ""
    assert [path.name for path in tmp_path.iterdir()] == ["logs"]


# -- the launcher ----------------------------------------------------------------------------------------------------


@pytest.fixture
def launch_script(tmp_path, monkeypatch, signals, capfd):
    """A function that launches a shell script as two processes; returns the exit code or error, and the output."""
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
def test_processes_receive_the_arguments_and_their_output_is_passed_on(launch_script):
    code, said = launch_script('echo "$RANK of $WORLD_SIZE: $5."; echo "also $RANK" >&2')
    assert code == 0 and sorted(said.splitlines()) == ["0 of 2: a b.", "1 of 2: a b.", "also 0", "also 1"]


@needs_ranks
@pytest.mark.parametrize("rank", [0, 1])
def test_the_exit_code_is_that_of_the_first_failure_and_the_others_are_ended(rank, launch_script):
    code, said = launch_script(f"test $RANK = {rank} && exit 3; exec sleep 500")
    assert code == 3 and said == ""


@pytest.mark.smoke
@needs_ranks
def test_a_killed_first_process_is_reported(launch_script):
    code, _ = launch_script("test $RANK = 0 && kill -9 $$; exec sleep 500")
    assert "process 0 of 2 was ended by SIGKILL" in code


@needs_ranks
@pytest.mark.skipif(not hasattr(signal, "SIGRTMIN"), reason="needs real-time signals")
def test_a_process_ended_by_a_signal_without_a_name_is_reported(launch_script):
    code, _ = launch_script(f"test $RANK = 0 && kill -{signal.SIGRTMIN + 6} $$; exec sleep 500")
    assert f"process 0 of 2 was ended by signal {signal.SIGRTMIN + 6}" in code


@needs_ranks
def test_a_request_to_stop_is_passed_on(launch_script):
    """When both processes listen, the first one sends the signal to the launcher."""
    listening = """trap 'echo $RANK stops; exit 1' TERM; touch "$0.$RANK" """
    asking = """test $RANK = 0 && { until test -e "$0.1"; do sleep 0.1; done; kill -TERM $PPID; }"""
    code, said = launch_script(f"{listening}; {asking}; while true; do sleep 0.1; done")
    assert code == 1 and {"0 stops", "1 stops"} <= set(said.splitlines())


@needs_ranks
def test_another_killed_process_is_reported_while_the_first_cannot(launch_script, caplog):
    """The first process may still be loading, or waiting for the one that has ended."""
    code, _ = launch_script("test $RANK = 1 && kill -9 $$; exec sleep 500")
    assert code == 2 and "process 1 of 2 was ended by SIGKILL" in caplog.messages[-1]


# -- launchers and complete runs -------------------------------------------------------------------------------------

# Python runs this in every process that starts. The first time, rank 1 kills itself once the run has a checkpoint; when
# it is started again it waits.
KILL_RANK_1_CODE = """
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


def run_and_kill_rank_1(*words: object, folder: Path, code: int) -> tuple[str, str]:
    """Run Python with these arguments, where rank 1 kills itself, and return its output."""
    (folder / "sitecustomize.py").write_text(KILL_RANK_1_CODE.format(checkpoint=str(folder / "run" / "checkpoint.pt")))
    paths = [str(folder), str(REPOSITORY_ROOT), os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "HYRFPACK_THREADS": "1", "OMP_NUM_THREADS": "1"}
    command = [sys.executable, *map(str, words)]
    process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        output, errors = process.communicate(timeout=90)
    finally:
        process.terminate()  # it ends the processes that it has started
        process.wait()
    assert process.returncode == code, errors
    return output, errors


def child_process_ids(process: int) -> list[int]:
    return [int(word) for word in Path(f"/proc/{process}/task/{process}/children").read_text().split()]


def wait_until(happened: Callable[[], bool], seconds: float = 240) -> bool:
    end = time.monotonic() + seconds
    while not happened() and time.monotonic() < end:
        time.sleep(0.05)
    return happened()


@needs_ranks
@pytest.mark.skipif(sys.platform != "linux", reason="looks for processes in /proc")
def test_processes_stop_when_their_launcher_is_killed(data, tmp_path):
    checkpoint = tmp_path / "run" / "checkpoint.pt"
    words = ["train", data, "-o", checkpoint.parent, "--processes", 2, "--steps", 4000, "--max-gaussians", 50]
    paths = os.pathsep.join([str(REPOSITORY_ROOT), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": paths, "HYRFPACK_THREADS": "1", "OMP_NUM_THREADS": "1"}
    with (tmp_path / "said").open("w") as said:
        command = [sys.executable, "-m", "hyrfpack", *map(str, words)]
        launcher = subprocess.Popen(command, env=environment, stdout=said, stderr=said)
    workers: list[int] = []
    try:
        assert wait_until(checkpoint.exists), (tmp_path / "said").read_text()
        workers, before = child_process_ids(launcher.pid), checkpoint.stat().st_mtime_ns
        launcher.kill()
        launcher.wait()
        assert wait_until(lambda: not any(Path(f"/proc/{worker}").exists() for worker in workers), 30)
    finally:
        launcher.kill()
        launcher.wait()
        for worker in workers:
            with suppress(ProcessLookupError):
                os.kill(worker, signal.SIGKILL)
    assert len(workers) == 2 and checkpoint.stat().st_mtime_ns > before  # the checkpoint was saved on exit


@pytest.fixture(scope="module")
def uninterrupted(data, logs, tmp_path_factory) -> bytes:
    out = tmp_path_factory.mktemp("uninterrupted")
    check_rank_0_speaks(run_command_on_ranks("train", data, "-o", out, *LONG_TRAINING_OPTIONS, folder=logs))
    return read_model_bytes(out)


@needs_ranks
@pytest.mark.usefixtures("signals")
def test_a_run_that_has_lost_a_process_reports_it_and_can_be_resumed(data, uninterrupted, logs, tmp_path):
    words = (
        "-m",
        "hyrfpack",
        "train",
        data,
        "-o",
        tmp_path / "run",
        *LONG_TRAINING_OPTIONS,
        "--json",
        "--processes",
        2,
    )
    output, errors = run_and_kill_rank_1(*words, folder=tmp_path, code=2)
    messages, who = [line for line in errors.splitlines() if line.startswith("Error: ")]
    assert "one of the 2 processes has ended" in messages and "the same command with --resume continues" in messages
    assert "process 1 of 2 was ended by SIGKILL" in who
    assert json.loads(output)["error"] == messages.removeprefix("Error: ") and "Traceback" not in errors
    assert [path.name for path in (tmp_path / "run").iterdir()] == ["checkpoint.pt"]

    check_rank_0_speaks(run_command_on_ranks(*words[2:-2], "--resume", folder=logs))
    assert read_model_bytes(tmp_path / "run") == uninterrupted


@needs_ranks
def test_torchrun_restarts_a_run_that_lost_a_process_and_it_resumes(data, uninterrupted, tmp_path):
    torchrun = ("-m", "torch.distributed.run", "--standalone", "--nproc-per-node", 2, "--max-restarts", 1)
    words = ("-m", "hyrfpack", "train", data, "-o", tmp_path / "run", *LONG_TRAINING_OPTIONS)
    output, errors = run_and_kill_rank_1(*torchrun, *words, folder=tmp_path, code=0)
    assert "200 Gaussians" in output and output.count("model.hyrf") == 1
    assert "has ended" in errors or "closing signal" in errors  # printed by the other process, or by torchrun before it
    assert read_model_bytes(tmp_path / "run") == uninterrupted

"""Run two commands with one output at the same time, or create a file at a command's output, and check for data loss.

    python -m tools.safety.races                                   50 rounds of each race (ten minutes on two cores)
    python -m tools.safety.races --rounds 10 --races train export --seed 3

There are two races of two commands: `train` with two seeds into one folder, and `compress` with and without pruning to
one file. In every other round both start together; otherwise the second starts at a random moment of the first one's
run. There are two races with a file of another program, which is created at the output while the command runs: `export`
and `make`. The file is created at a random moment, or in every other round when the command's temporary file appears.

Each command runs in a process forked from this one, which has loaded all modules. So commands that start together also
run at the same time. A command with exit code 0 must have left the bytes of an undisturbed run in the file that it
reports. Every other command must end with exit code 2 and one error message. A file of another program must stay
unchanged, and no temporary file may be left.

It prints one line for each race with the number of rounds by outcome, and exits with 1 after a violation.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path

import torch

import hyrfpack.compress
import hyrfpack.export
import hyrfpack.make  # noqa: F401 - these three are loaded before processes are forked
from hyrfpack.cli import main as cli
from hyrfpack.demo.scene import write_demo_scene
from hyrfpack.format.run_folder import METRICS_FILE, MODEL_FILE
from tools.command import positive_integer
from tools.safety.kill import COMMAND_ENVIRONMENT, is_temporary_file

FOREIGN_BYTES = b"of another program"
POLL_INTERVAL_SECONDS = 2e-4  # time between two searches for temporary files
TRAIN_OPTIONS = ["--steps", "30", "--max-gaussians", "200", "--log2-table-size", "10"]
FORK_CONTEXT = get_context("fork")
# Each error message of a refused command has one of these texts.
FOLDER_BUSY_TEXT, OUTPUT_EXISTS_TEXT = "is at work in this folder", "--overwrite"


@dataclass
class Command:
    """A command of a race.

    Attributes:
        arguments: returns the command line for an output.
        expected: the bytes that an undisturbed run writes.
        seconds: duration of an undisturbed run.
    """

    arguments: Callable[[Path], list[str]]
    expected: bytes = b""
    seconds: float = 0.0


@dataclass
class Race:
    """Commands that run at the same time.

    Attributes:
        commands: two commands, or one whose output a file of another program occupies.
        output: the name of the output in the folder of a round.
    """

    commands: list[Command]
    output: str


@dataclass
class Outcome:
    """Result of one round: a label for counting, and the faults."""

    label: str
    faults: list[str] = field(default_factory=list)


class RunningCommand:
    """A hyrfpack command that runs in its own process.

    Attributes:
        process: the child process.
    """

    def __init__(self, arguments: list[str]) -> None:
        self._logs = [tempfile.TemporaryFile("w+") for _ in range(2)]  # standard output and standard error
        self.process = FORK_CONTEXT.Process(target=self._work, args=(arguments,))
        self.process.start()

    def _work(self, arguments: list[str]) -> None:
        for log, descriptor in zip(self._logs, (1, 2), strict=True):
            os.dup2(log.fileno(), descriptor)
        os.environ.update(COMMAND_ENVIRONMENT)
        torch.set_num_threads(1)
        cli(arguments, prog_name="hyrfpack")

    def wait(self) -> tuple[int, str, str]:
        """Wait for the command to end; return its exit code, standard output and standard error."""
        self.process.join()
        outputs = []
        for log in self._logs:
            log.seek(0)
            outputs.append(log.read())
            log.close()
        code = self.process.exitcode
        assert code is not None  # the process has ended
        return code, outputs[0], outputs[1]


def start_command(command: Command, output: Path) -> RunningCommand:
    """Start a command with --json."""
    return RunningCommand([*command.arguments(output), "--json"])


def find_written_file(output: Path, stdout_text: str) -> Path:
    """Return the file that a command reports as written in its JSON output."""
    facts = json.loads(stdout_text)
    if "complete" in facts:
        return output / MODEL_FILE
    return Path(facts.get("file") or facts["output"])


def check_command(command: Command, output: Path, running: RunningCommand) -> Outcome:
    """Wait for a command and check its exit code, its output file and its error message."""
    code, stdout_text, stderr_text = running.wait()
    if code == 0:
        written_file = find_written_file(output, stdout_text)
        has_other_name = written_file.name != (MODEL_FILE if output.is_dir() else output.name)
        data = written_file.read_bytes() if written_file.is_file() else b""
        faults = [] if data == command.expected else [f"exit code 0, and {written_file.name} does not hold its result"]
        return Outcome("beside" if has_other_name else "written", faults)
    errors = [line for line in stderr_text.splitlines() if line.startswith("Error: ")]
    is_expected = len(errors) == 1 and (FOLDER_BUSY_TEXT in errors[0] or OUTPUT_EXISTS_TEXT in errors[0])
    faults = [] if code == 2 and is_expected else [f"exit code {code}: {stderr_text[-300:]}"]
    return Outcome("refused, busy" if errors and FOLDER_BUSY_TEXT in errors[0] else "refused, exists", faults)


def race_commands(race: Race, folder: Path, random_source: random.Random, together: bool) -> Outcome:
    """Run one round with two commands and one output."""
    output = folder / race.output
    order = random_source.sample(race.commands, 2)
    running = [start_command(order[0], output)]
    if not together:
        time.sleep(random_source.uniform(0, order[0].seconds))
    running.append(start_command(order[1], output))
    ends = [check_command(command, output, process) for command, process in zip(order, running, strict=True)]
    faults = [sentence for end in ends for sentence in end.faults]
    if not any(end.label == "written" for end in ends):
        faults.append("none of them has written its output")
    if output.is_dir() and not faults:
        winner = next(number for number, end in enumerate(ends) if end.label == "written")
        seed = json.loads((output / METRICS_FILE).read_text())["settings"]["seed"]
        if order[winner] is not race.commands[seed]:
            faults.append(f"the metrics are of seed {seed}, and the model is not")
    return Outcome(" + ".join(sorted(end.label for end in ends)), faults)


def race_with_file(race: Race, folder: Path, random_source: random.Random, together: bool) -> Outcome:
    """Run one round with a command and a file of another program at its output."""
    (command,), output = race.commands, folder / race.output
    running, started = start_command(command, output), time.perf_counter()
    moment = random_source.uniform(0, command.seconds)
    while running.process.is_alive():
        if any(map(is_temporary_file, os.listdir(folder))) if together else time.perf_counter() - started >= moment:
            break
        time.sleep(POLL_INTERVAL_SECONDS)
    created = False
    with contextlib.suppress(FileExistsError), open(output, "xb") as file:
        file.write(FOREIGN_BYTES)
        created = True
    end = check_command(command, output, running)
    if created and output.read_bytes() != FOREIGN_BYTES:
        end.faults.append("the file of another program was replaced")
    return Outcome(end.label if created else "written before the file was created", end.faults)


def wait_for_success(running: RunningCommand) -> str:
    """Wait for a command that must succeed; return its standard output."""
    code, stdout_text, stderr_text = running.wait()
    if code:
        raise SystemExit(f"exit code {code}\n{stderr_text}")
    return stdout_text


def prepare(work_folder: Path) -> dict[str, Race]:
    """Make the inputs, and run every command once undisturbed for its expected bytes and duration."""
    scene, run = write_demo_scene(work_folder / "scene", views=10, size=48), work_folder / "run"
    model, packed = str(run / MODEL_FILE), str(work_folder / "packed.hyrf")
    wait_for_success(RunningCommand(["train", str(scene), "-o", str(run), *TRAIN_OPTIONS]))
    wait_for_success(RunningCommand(["compress", model, "-o", packed, "--profile", "paper"]))

    def train(seed: int) -> Command:
        return Command(lambda out: ["train", str(scene), "-o", str(out), "--seed", str(seed), *TRAIN_OPTIONS])

    def compress(pruning: str) -> Command:
        return Command(lambda out: ["compress", model, "-o", str(out), pruning])

    export = Command(lambda out: ["export", model, "-o", str(out), "--sh-degree", "0"])
    make = Command(lambda out: ["make", packed, "-o", str(out), "--work", str(out.parent / "work")])
    races = {
        "train": Race([train(0), train(1)], "run"),
        "compress": Race([compress("--prune"), compress("--no-prune")], "out.hyrf"),
        "export": Race([export], "out.ply"),
        "make": Race([make], "out.html"),
    }
    for name, race in races.items():
        for number, command in enumerate(race.commands):
            output = work_folder / f"{name}-{number}" / race.output
            output.parent.mkdir()
            started = time.perf_counter()
            stdout_text = wait_for_success(start_command(command, output))
            command.seconds = time.perf_counter() - started
            command.expected = find_written_file(output, stdout_text).read_bytes()
    return races


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = ("train", "compress", "export", "make")
    parser.add_argument("--rounds", type=positive_integer, default=50, help="number of rounds of each race (50)")
    parser.add_argument("--races", nargs="+", choices=names, default=names, help="races to run (all)")
    parser.add_argument("--seed", type=int, default=0, help="random seed of the moments (0)")
    args = parser.parse_args()
    work_folder = Path(tempfile.mkdtemp(prefix="hyrfpack-races-"))
    violations = []
    for name, race in prepare(work_folder).items():
        if name not in args.races:
            continue
        counts: Counter[str] = Counter()
        for number in range(args.rounds):
            folder = work_folder / f"{name}-round-{number}"
            folder.mkdir()
            run_race = race_commands if len(race.commands) == 2 else race_with_file
            outcome = run_race(race, folder, random.Random(f"{args.seed} {name} {number}"), number % 2 == 0)
            outcome.faults += [f"{path.name} is left" for path in folder.rglob("*") if is_temporary_file(path.name)]
            counts[outcome.label] += 1
            violations += [f"{folder.name}: {sentence}" for sentence in outcome.faults]
            if not outcome.faults:
                shutil.rmtree(folder)
        summary = "; ".join(f"{count} {label}" for label, count in sorted(counts.items()))
        print(f"{name}, {args.rounds} rounds: {summary}", flush=True)
    print(f"violations: {len(violations)}")
    if violations:
        print("\n".join(violations), f"the files of the failed rounds are in {work_folder}", sep="\n")
        sys.exit(1)
    shutil.rmtree(work_folder)


if __name__ == "__main__":
    main()

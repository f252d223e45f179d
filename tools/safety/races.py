"""Starts commands at the same time, or creates a file where they are about to write, and checks that nothing is lost.

    python -m tools.safety.races                                   50 rounds of each race (ten minutes on two cores)
    python -m tools.safety.races --rounds 10 --races train export --seed 3

Races of two commands: `train` with two seeds into one folder, and `compress` with and without pruning to one file. In
every other round both start together; otherwise the second one starts at a random moment of the first one's work.
Races with a file of another program, which is created at the output while the command works: `export` and `make`. The
file is created at a random moment, or in every other round as soon as the command's temporary file is there.

Each command runs in a process of its own, forked from this one, which has loaded all modules: commands that start
together then also work at the same time. Every command that ends with exit code 0 must have left the bytes of an
undisturbed run in the file that it names. Every other one must end with exit code 2 and one sentence. A file of another
program must stay as it is, and no temporary file may be left. Exits with 1 on a violation.
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
from tools.safety.kill import ENVIRONMENT, is_stray

FOREIGN = b"of another program"
POLL_SECONDS = 2e-4  # between looks for a temporary file
TRAINING = ["--steps", "30", "--max-gaussians", "200", "--log2-table-size", "10"]
FORK = get_context("fork")
BUSY, EXISTS = "is at work in this folder", "--overwrite"  # in the sentences of refusals


@dataclass
class Command:
    """One command line.

    Attributes:
        arguments: for an output.
        expected: the bytes that an undisturbed run leaves.
        seconds: that an undisturbed run takes.
    """

    arguments: Callable[[Path], list[str]]
    expected: bytes = b""
    seconds: float = 0.0


@dataclass
class Race:
    """What happens at the same time.

    Attributes:
        commands: two, or one that a file of another program gets in the way of.
        output: the name of the output in the folder of a round.
    """

    commands: list[Command]
    output: str


@dataclass
class Outcome:
    """One round: what came of it, in words, and what is wrong."""

    words: str
    wrong: list[str] = field(default_factory=list)


class Running:
    """A command line in a process of its own.

    Attributes:
        process: the process.
    """

    def __init__(self, arguments: list[str]) -> None:
        self._logs = [tempfile.TemporaryFile("w+") for _ in range(2)]  # standard output and standard error
        self.process = FORK.Process(target=self._work, args=(arguments,))
        self.process.start()

    def _work(self, arguments: list[str]) -> None:
        for log, descriptor in zip(self._logs, (1, 2), strict=True):
            os.dup2(log.fileno(), descriptor)
        os.environ.update(ENVIRONMENT)
        torch.set_num_threads(1)
        cli(arguments, prog_name="hyrfpack")

    def end(self) -> tuple[int, str, str]:
        """Wait for the end; returns the exit code, and what was printed on standard output and standard error."""
        self.process.join()
        said = []
        for log in self._logs:
            log.seek(0)
            said.append(log.read())
            log.close()
        code = self.process.exitcode
        assert code is not None  # it has ended
        return code, said[0], said[1]


def start(command: Command, output: Path) -> Running:
    """The command, its results as JSON."""
    return Running([*command.arguments(output), "--json"])


def written_by(output: Path, said: str) -> Path:
    """The file that a command says it has written."""
    facts = json.loads(said)
    if "complete" in facts:
        return output / MODEL_FILE
    return Path(facts.get("file") or facts["output"])


def judge(command: Command, output: Path, running: Running) -> Outcome:
    """What one command came to."""
    code, said, complaint = running.end()
    if code == 0:
        written = written_by(output, said)
        beside = written.name != (MODEL_FILE if output.is_dir() else output.name)
        data = written.read_bytes() if written.is_file() else b""
        wrong = [] if data == command.expected else [f"exit code 0, and {written.name} does not hold its result"]
        return Outcome("beside" if beside else "written", wrong)
    errors = [line for line in complaint.splitlines() if line.startswith("Error: ")]
    known = len(errors) == 1 and (BUSY in errors[0] or EXISTS in errors[0])
    wrong = [] if code == 2 and known else [f"exit code {code}: {complaint[-300:]}"]
    return Outcome("refused, busy" if errors and BUSY in errors[0] else "refused, exists", wrong)


def race_two(race: Race, folder: Path, draw: random.Random, together: bool) -> Outcome:
    """Two commands with one output."""
    output = folder / race.output
    order = draw.sample(race.commands, 2)
    running = [start(order[0], output)]
    if not together:
        time.sleep(draw.uniform(0, order[0].seconds))
    running.append(start(order[1], output))
    ends = [judge(command, output, one) for command, one in zip(order, running, strict=True)]
    wrong = [sentence for end in ends for sentence in end.wrong]
    if not any(end.words == "written" for end in ends):
        wrong.append("none of them has written its output")
    if output.is_dir() and not wrong:
        winner = next(number for number, end in enumerate(ends) if end.words == "written")
        seed = json.loads((output / METRICS_FILE).read_text())["settings"]["seed"]
        if order[winner] is not race.commands[seed]:
            wrong.append(f"the metrics are of seed {seed}, and the model is not")
    return Outcome(" + ".join(sorted(end.words for end in ends)), wrong)


def race_file(race: Race, folder: Path, draw: random.Random, together: bool) -> Outcome:
    """A command, and a file of another program at its output."""
    (command,), output = race.commands, folder / race.output
    running, began = start(command, output), time.perf_counter()
    moment = draw.uniform(0, command.seconds)
    while running.process.is_alive():
        if any(map(is_stray, os.listdir(folder))) if together else time.perf_counter() - began >= moment:
            break
        time.sleep(POLL_SECONDS)
    created = False
    with contextlib.suppress(FileExistsError), open(output, "xb") as file:
        file.write(FOREIGN)
        created = True
    end = judge(command, output, running)
    if created and output.read_bytes() != FOREIGN:
        end.wrong.append("the file of another program was replaced")
    return Outcome(end.words if created else "written before the file was created", end.wrong)


def finish(running: Running) -> str:
    """What a command that must succeed prints."""
    code, said, complaint = running.end()
    if code:
        raise SystemExit(f"exit code {code}\n{complaint}")
    return said


def prepare(work: Path) -> dict[str, Race]:
    """Make the inputs, and run every command once without a disturbance."""
    scene, run = write_demo_scene(work / "scene", views=10, size=48), work / "run"
    model, packed = str(run / MODEL_FILE), str(work / "packed.hyrf")
    finish(Running(["train", str(scene), "-o", str(run), *TRAINING]))
    finish(Running(["compress", model, "-o", packed, "--profile", "paper"]))

    def train(seed: int) -> Command:
        return Command(lambda out: ["train", str(scene), "-o", str(out), "--seed", str(seed), *TRAINING])

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
            output = work / f"{name}-{number}" / race.output
            output.parent.mkdir()
            began = time.perf_counter()
            said = finish(start(command, output))
            command.seconds = time.perf_counter() - began
            command.expected = written_by(output, said).read_bytes()
    return races


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = ("train", "compress", "export", "make")
    parser.add_argument("--rounds", type=int, default=50, help="of each race (50)")
    parser.add_argument("--races", nargs="+", choices=names, default=names, help="which (all)")
    parser.add_argument("--seed", type=int, default=0, help="of the moments (0)")
    args = parser.parse_args()
    work = Path(tempfile.mkdtemp(prefix="hyrfpack-races-"))
    bad = []
    for name, race in prepare(work).items():
        if name not in args.races:
            continue
        counts: Counter[str] = Counter()
        for number in range(args.rounds):
            folder = work / f"{name}-round-{number}"
            folder.mkdir()
            run = race_two if len(race.commands) == 2 else race_file
            outcome = run(race, folder, random.Random(f"{args.seed} {name} {number}"), number % 2 == 0)
            outcome.wrong += [f"{path.name} is left" for path in folder.rglob("*") if is_stray(path.name)]
            counts[outcome.words] += 1
            bad += [f"{folder.name}: {sentence}" for sentence in outcome.wrong]
            if not outcome.wrong:
                shutil.rmtree(folder)
        told = "; ".join(f"{count} {words}" for words, count in sorted(counts.items()))
        print(f"{name}, {args.rounds} rounds: {told}", flush=True)
    print(f"violations: {len(bad)}")
    if bad:
        print("\n".join(bad), f"what the rounds left is in {work}", sep="\n")
        sys.exit(1)
    shutil.rmtree(work)


if __name__ == "__main__":
    main()

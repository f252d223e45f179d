"""Kill train, compress, decompress, render and make at random moments, and check the files that they leave.

    python -m tools.safety.kill                                   50 kills of each command (25 minutes on two cores)
    python -m tools.safety.kill --kills 10 --commands compress decompress --seed 3

Each trial starts the real command in a folder with the results of an earlier run with another seed, and ends it with
SIGKILL. In half of the trials the moment is uniform over the command's duration; in the other half it is at most 2 ms
after the k-th temporary file appears. Afterwards every file must hold its old bytes or the complete new ones, and there
may be no further files except temporary ones. If there are temporary files, and in every fifth trial, the command runs
again (train with --resume if there is a checkpoint). That run must leave the bytes of an uninterrupted run and no
temporary file. In the work folder of make, products that are being replaced may be missing.

It prints one line for each command: seconds of a run, kills, the moments of the kills, temporary files, reruns and
violations. It exits with 1 after a violation.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import io
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import torch
from PIL import Image

import hyrfpack
from hyrfpack.atomic import TEMPORARY_PREFIX, TEMPORARY_SUFFIX
from hyrfpack.demo.scene import write_demo_scene
from hyrfpack.format.run_folder import CHECKPOINT_FILE, METRICS_FILE, MODEL_FILE
from hyrfpack.format.run_folder import WORK_RECORD_FILE as RECORD
from hyrfpack.train.checkpoint import DIGEST_BYTES
from tools.command import positive_integer

COMMAND_ENVIRONMENT = {**os.environ, "HYRFPACK_THREADS": "1", "OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE"}
COMMAND_NAMES = ("train", "compress", "decompress", "render", "make")  # each command reads the output of earlier ones
KILL_MOMENTS = ("before", "while writing", "between or after", "too late")
MAKE_OPTIONS = ["--quality", "draft"]
TRAIN_OPTIONS = ["--steps", "60", "--log2-table-size", "13"]
ORBIT_FRAMES = 6
MAKE_WORK_FOLDER_NAME = "out.work"
# The folders of an output in which the commands write files.
WRITTEN_FOLDERS = (
    "",
    "views",
    MAKE_WORK_FOLDER_NAME,
    f"{MAKE_WORK_FOLDER_NAME}/run",
    f"{MAKE_WORK_FOLDER_NAME}/run/views",
    f"{MAKE_WORK_FOLDER_NAME}/export",
)
POLL_INTERVAL_SECONDS = 2e-4  # time between two searches for temporary files
MAX_KILL_DELAY_SECONDS = 2e-3  # longest delay of the kill after a temporary file appears
RERUN_EVERY = 5
METRICS_TIME_KEYS = {"seconds", "steps_per_second", "stage_seconds", "seconds_per_frame"}  # these differ between runs


@dataclass
class Case:
    """One command, with its old and its new files.

    Attributes:
        name: the command.
        arguments: returns the command line for an output folder.
        old: the files before the command runs, by path.
        new: the files that an uninterrupted run writes, by path.
        seconds: duration of an uninterrupted run.
        writes: number of temporary files that appear during this run.
    """

    name: str
    arguments: Callable[[Path], list[str]]
    old: dict[str, bytes] = field(default_factory=dict)
    new: dict[str, bytes] = field(default_factory=dict)
    seconds: float = 0.0
    writes: int = 0


@dataclass
class Outcome:
    """Result of one trial.

    Attributes:
        moment: one of KILL_MOMENTS.
        temporary_files: number of temporary files that the kill left.
        was_rerun: whether the command ran again.
        faults: descriptions of the violations.
    """

    moment: str
    temporary_files: int
    was_rerun: bool
    faults: list[str]


def start_command(arguments: list[str], log: IO[bytes]) -> subprocess.Popen:
    """Start a hyrfpack command as a child process whose standard error goes to the file `log`.

    A pipe would make the command wait once it is full, because nothing reads it while temporary files are searched.
    """
    command = [sys.executable, "-m", "hyrfpack", *arguments]
    return subprocess.Popen(command, env=COMMAND_ENVIRONMENT, stdout=subprocess.DEVNULL, stderr=log)


def read_log(log: IO[bytes]) -> str:
    """Return the standard error of a command that has ended."""
    log.seek(0)
    return log.read().decode()


def is_temporary_file(name: str) -> bool:
    """Return whether a path has the name of a temporary file of `hyrfpack.atomic`."""
    base = os.path.basename(name)
    return base.startswith(TEMPORARY_PREFIX) and base.endswith(TEMPORARY_SUFFIX)


def read_files(folder: Path) -> dict[str, bytes]:
    """Return the bytes of all files below a folder, by their path in it."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def wait_for_temporary_files(process: subprocess.Popen, folder: Path, count: int | None = None) -> int:
    """Wait until `count` temporary files have appeared, or the process has ended; return how many appeared."""
    temporary_names: set[str] = set()
    while process.poll() is None and (count is None or len(temporary_names) < count):
        for folder_path in (folder / name for name in WRITTEN_FOLDERS):
            if folder_path.is_dir():
                temporary_names.update(name for name in os.listdir(folder_path) if is_temporary_file(name))
        time.sleep(POLL_INTERVAL_SECONDS)
    return len(temporary_names)


def drop_times(value: Any) -> Any:
    """Return JSON values without the measured times in dictionaries at any depth."""
    if isinstance(value, dict):
        return {key: drop_times(item) for key, item in value.items() if key not in METRICS_TIME_KEYS}
    return [drop_times(item) for item in value] if isinstance(value, list) else value


def find_file_fault(name: str, data: bytes, case: Case) -> str | None:
    """Return what is wrong with a file under its final name; None if it has the old or the complete new bytes."""
    if data == case.old.get(name):
        return None
    base = os.path.basename(name)
    if base != CHECKPOINT_FILE and name not in case.new:
        return "the command does not write this file"
    try:
        if base == CHECKPOINT_FILE:
            is_intact = hashlib.sha256(data[:-DIGEST_BYTES]).digest() == data[-DIGEST_BYTES:]
            torch.load(io.BytesIO(data[:-DIGEST_BYTES]), weights_only=True)
        elif base == METRICS_FILE:
            is_intact = drop_times(json.loads(data)) == drop_times(json.loads(case.new[name]))
        elif base == RECORD:
            is_intact = set(json.loads(data)["stages"]) <= set(json.loads(case.new[name])["stages"])
        else:
            is_intact = data == case.new[name]
            if name.endswith(".hyrf"):
                hyrfpack.format.decode_model(data)
            else:
                Image.open(io.BytesIO(data)).load()
    except Exception as error:
        return f"it cannot be read ({error!r})"
    return None if is_intact else "it has neither the old bytes nor the new ones"


def find_faults(files: dict[str, bytes], case: Case) -> list[str]:
    """Return descriptions of all faults in a folder after a kill."""
    faults = [
        f"{name} is missing"
        for name in case.old
        if name not in files and not name.startswith(f"{MAKE_WORK_FOLDER_NAME}/")
    ]
    for name, data in files.items():
        if not is_temporary_file(name) and (reason := find_file_fault(name, data, case)):
            faults.append(f"{name}: {reason}")
    return faults


def classify_moment(found: dict[str, bytes], case: Case, killed: bool) -> str:
    """Return the moment of the kill, one of KILL_MOMENTS, judged by the files that are left."""
    if not killed:
        return "too late"
    if any(map(is_temporary_file, found)):
        return "while writing"
    return "before" if found == case.old else "between or after"


def check_rerun(case: Case, out: Path) -> list[str]:
    """Run the command again after a kill; return the differences from an uninterrupted run."""
    arguments = case.arguments(out)
    if (out / CHECKPOINT_FILE).exists():
        arguments = [argument if argument != "--overwrite" else "--resume" for argument in arguments]
    with tempfile.TemporaryFile() as log:
        if code := start_command(arguments, log).wait():
            return [f"run again, it exits with {code}: {read_log(log)[-300:]}"]
    final_files = read_files(out)
    faults = [f"run again: {sentence}" for sentence in find_faults(final_files, case)]
    faults += [
        f"run again: {name} is left"
        for name in final_files
        if is_temporary_file(name) or name.endswith(CHECKPOINT_FILE)
    ]
    faults += [
        f"run again: {name} is missing or still the old one"
        for name in case.new
        if final_files.get(name) == case.old[name] or name not in final_files
    ]
    return faults


def run_trial(case: Case, number: int, seed: int, out: Path) -> Outcome:
    """Run one trial in its own folder, which is kept if there are faults."""
    random_source = random.Random(f"{seed} {case.name} {number}")
    for name, data in case.old.items():
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_bytes(data)
    with tempfile.TemporaryFile() as log:
        process = start_command(case.arguments(out), log)
        if number % 2:
            wait_for_temporary_files(process, out, random_source.randint(1, case.writes))
            time.sleep(random_source.uniform(0, MAX_KILL_DELAY_SECONDS))
        else:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(random_source.uniform(0, case.seconds))
        process.kill()
        process.wait()
        stderr_text = read_log(log)
    files = read_files(out)
    temporary_files = sum(map(is_temporary_file, files))
    outcome = Outcome(
        classify_moment(files, case, process.returncode == -signal.SIGKILL),
        temporary_files,
        False,
        find_faults(files, case),
    )
    if process.returncode not in (0, -signal.SIGKILL):
        outcome.faults.append(f"it ended by itself with {process.returncode}: {stderr_text[-300:]}")
    if temporary_files or number % RERUN_EVERY == 0:
        outcome.was_rerun = True
        outcome.faults += check_rerun(case, out)
    if not outcome.faults:
        shutil.rmtree(out)
    return outcome


def prepare(work_folder: Path, names: Sequence[str]) -> list[Case]:
    """Make the inputs, run each command twice without a kill for its old and new files, and time the second run."""
    scene = write_demo_scene(work_folder / "scene", views=10, size=48)
    cases = []
    for name in names:

        def arguments(out: Path, seed: int = 0, name: str = name) -> list[str]:
            model, packed = work_folder / f"train-{seed}" / MODEL_FILE, work_folder / f"compress-{seed}" / "out.hyrf"
            return {
                "train": ["train", str(scene), "-o", str(out), "--overwrite", "--seed", str(seed), *TRAIN_OPTIONS],
                "compress": ["compress", str(model), "-o", str(out / "out.hyrf"), "--overwrite"],
                "decompress": ["decompress", str(packed), "-o", str(out / "out.hyrf"), "--overwrite"],
                "render": ["render", str(packed), "-o", str(out), "--orbit", str(ORBIT_FRAMES), "--overwrite"],
                "make": [
                    "make",
                    str(scene),
                    "-o",
                    str(out / "out.hyrf"),
                    "--overwrite",
                    "--seed",
                    str(seed),
                    *MAKE_OPTIONS,
                ],
            }[name]

        case = Case(name, arguments)
        for seed in (1, 0):
            out = work_folder / f"{name}-{seed}"
            out.mkdir()
            with tempfile.TemporaryFile() as log:
                process, started = start_command(arguments(out, seed), log), time.perf_counter()
                case.writes = max(1, wait_for_temporary_files(process, out))
                case.seconds = time.perf_counter() - started
                if process.returncode:
                    raise SystemExit(f"{' '.join(process.args)}: exit {process.returncode}\n{read_log(log)}")
        case.old, case.new = read_files(work_folder / f"{name}-1"), read_files(work_folder / f"{name}-0")
        cases.append(case)
    return cases


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=positive_integer, default=50, help="number of kills of each command (50)")
    parser.add_argument(
        "--commands", nargs="+", choices=COMMAND_NAMES, default=COMMAND_NAMES, help="commands to kill (all)"
    )
    parser.add_argument("--seed", type=int, default=0, help="random seed of the moments (0)")
    parser.add_argument("--jobs", type=positive_integer, default=2, help="number of trials at the same time (2)")
    args = parser.parse_args()
    work_folder = Path(tempfile.mkdtemp(prefix="hyrfpack-kill-"))
    header = ("command", "seconds", "kills", *KILL_MOMENTS, "temporary files", "run again", "violations")
    print(" | ".join(header), flush=True)
    violations = []
    for case in prepare(work_folder, COMMAND_NAMES[: 1 + max(map(COMMAND_NAMES.index, args.commands))]):
        if case.name not in args.commands:
            continue
        folders = [work_folder / f"{case.name}-trial-{number}" for number in range(args.kills)]
        with ThreadPoolExecutor(args.jobs) as pool:
            outcomes = list(
                pool.map(run_trial, [case] * args.kills, range(args.kills), [args.seed] * args.kills, folders)
            )
        count = Counter(outcome.moment for outcome in outcomes)
        faults = [f"{folder.name}: {text}" for folder, o in zip(folders, outcomes, strict=True) for text in o.faults]
        temporary_files, reruns = sum(o.temporary_files for o in outcomes), sum(o.was_rerun for o in outcomes)
        row = (
            case.name,
            f"{case.seconds:.1f}",
            args.kills,
            *(count[m] for m in KILL_MOMENTS),
            temporary_files,
            reruns,
            len(faults),
        )
        print(" | ".join(f"{value:>{len(title)}}" for title, value in zip(header, row, strict=True)), flush=True)
        violations += faults
    if violations:
        print("\n".join(violations), f"the files of the failed trials are in {work_folder}", sep="\n")
        sys.exit(1)
    shutil.rmtree(work_folder)


if __name__ == "__main__":
    main()

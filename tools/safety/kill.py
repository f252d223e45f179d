"""Kills train, compress, decompress, render and make at random moments and checks what is left on the disk.

    python -m tools.safety.kill                                   50 kills of each command (25 minutes on two cores)
    python -m tools.safety.kill --kills 10 --commands compress decompress --seed 3

Each trial starts the real command line over what an earlier run with another seed left, and ends it with SIGKILL: half
of the trials at a moment drawn evenly from the command's time, half up to 2 ms after the k-th temporary file appears.
Then every file must hold its old bytes or the whole new ones, and nothing else may be there but temporary files. Where
there are such, and in every fifth trial, the command is run again (train with --resume where there is a checkpoint): it
must end with the bytes of an uninterrupted run and leave no temporary file. In the work folder of make, what is made
anew may be gone. Exits with 1 on a violation.
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

import torch
from PIL import Image

import hyrfpack
from hyrfpack.atomic import TEMPORARY_PREFIX, TEMPORARY_SUFFIX
from hyrfpack.demo.scene import write_demo_scene
from hyrfpack.format.run_folder import CHECKPOINT_FILE, METRICS_FILE, MODEL_FILE
from hyrfpack.make.state import RECORD_NAME as RECORD
from hyrfpack.train.checkpoint import DIGEST_BYTES

ENVIRONMENT = {**os.environ, "HYRFPACK_THREADS": "1", "OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE"}
COMMANDS = ("train", "compress", "decompress", "render", "make")  # each works on what those before it made
MOMENTS = ("before", "while writing", "between or after", "too late")
DRAFT = ["--quality", "draft"]
TRAINING = ["--steps", "60", "--log2-table-size", "13"]
FRAMES = 6
WORK = "out.work"  # of make
PLACES = ("", "views", WORK, f"{WORK}/run", f"{WORK}/run/views", f"{WORK}/export")  # where files are written
POLL = 2e-4  # seconds between looks for a temporary file
AIM = 2e-3  # seconds: the most between the sight of a temporary file and the kill
RERUN_EVERY = 5


@dataclass
class Case:
    """One command: its arguments for an output folder, and what it writes there over what is there already."""

    name: str
    arguments: Callable[[Path], list[str]]
    old: dict[str, bytes] = field(default_factory=dict)
    new: dict[str, bytes] = field(default_factory=dict)
    seconds: float = 0.0  # of an uninterrupted run
    writes: int = 0  # temporary files seen meanwhile


@dataclass
class Outcome:
    """One trial: where the kill came, and what is wrong."""

    moment: str
    strays: int
    rerun: bool
    wrong: list[str]


def start(arguments: list[str]) -> subprocess.Popen:
    """The command line in a process of its own."""
    command = [sys.executable, "-m", "hyrfpack", *arguments]
    return subprocess.Popen(command, env=ENVIRONMENT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


def is_stray(name: str) -> bool:
    base = os.path.basename(name)
    return base.startswith(TEMPORARY_PREFIX) and base.endswith(TEMPORARY_SUFFIX)


def contents(folder: Path) -> dict[str, bytes]:
    """Files below a folder, by their path in it."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def watch(process: subprocess.Popen, folder: Path, enough: int | None = None) -> int:
    """Wait until `enough` temporary files have been seen, or the process has ended; returns how many were seen."""
    seen: set[str] = set()
    while process.poll() is None and (enough is None or len(seen) < enough):
        for place in (folder / name for name in PLACES):
            if place.is_dir():
                seen.update(name for name in os.listdir(place) if is_stray(name))
        time.sleep(POLL)
    return len(seen)


def untimed(metrics: bytes) -> dict:
    """A run's metrics without what the clock says."""
    values = json.loads(metrics)
    for key in ("seconds", "steps_per_second", "stage_seconds"):
        del values[key]
    del values["evaluation"]["seconds_per_frame"]
    return values


def fault(name: str, data: bytes, case: Case) -> str | None:
    """What is wrong with a file under its final name; None for the old bytes and for the whole new ones."""
    if data == case.old.get(name):
        return None
    base = os.path.basename(name)
    if base != CHECKPOINT_FILE and name not in case.new:
        return "nobody asked for this file"
    try:
        if base == CHECKPOINT_FILE:
            same = hashlib.sha256(data[:-DIGEST_BYTES]).digest() == data[-DIGEST_BYTES:]
            torch.load(io.BytesIO(data[:-DIGEST_BYTES]), weights_only=True)
        elif base == METRICS_FILE:
            same = untimed(data) == untimed(case.new[name])
        elif base == RECORD:
            same = set(json.loads(data)["stages"]) <= set(json.loads(case.new[name])["stages"])
        else:
            same = data == case.new[name]
            if name.endswith(".hyrf"):
                hyrfpack.format.decode_model(data)
            else:
                Image.open(io.BytesIO(data)).load()
    except Exception as error:
        return f"it cannot be read ({error!r})"
    return None if same else "neither the old bytes nor the new ones"


def faults(found: dict[str, bytes], case: Case) -> list[str]:
    """What is wrong with a folder after a kill."""
    wrong = [f"{name} is gone" for name in case.old if name not in found and not name.startswith(f"{WORK}/")]
    for name, data in found.items():
        if not is_stray(name) and (reason := fault(name, data, case)):
            wrong.append(f"{name}: {reason}")
    return wrong


def moment(found: dict[str, bytes], case: Case, killed: bool) -> str:
    """Where in the command the kill came, by what it left."""
    if not killed:
        return "too late"
    if any(map(is_stray, found)):
        return "while writing"
    return "before" if found == case.old else "between or after"


def rerun(case: Case, out: Path) -> list[str]:
    """Run the command again after a kill: it must end as if nothing had happened."""
    arguments = case.arguments(out)
    if (out / CHECKPOINT_FILE).exists():
        arguments = [argument if argument != "--overwrite" else "--resume" for argument in arguments]
    process = start(arguments)
    _, complaint = process.communicate()
    if process.returncode:
        return [f"run again, it exits with {process.returncode}: {complaint.decode()[-300:]}"]
    after = contents(out)
    wrong = [f"run again: {sentence}" for sentence in faults(after, case)]
    wrong += [f"run again: {name} is left" for name in after if is_stray(name) or name.endswith(CHECKPOINT_FILE)]
    wrong += [
        f"run again: {name} is missing or still the old one"
        for name in case.new
        if after.get(name) == case.old[name] or name not in after
    ]
    return wrong


def attempt(case: Case, number: int, seed: int, out: Path) -> Outcome:
    """One trial in a folder of its own, which stays when something is wrong."""
    draw = random.Random(f"{seed} {case.name} {number}")
    for name, data in case.old.items():
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_bytes(data)
    process = start(case.arguments(out))
    if number % 2:
        watch(process, out, draw.randint(1, case.writes))
        time.sleep(draw.uniform(0, AIM))
    else:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(draw.uniform(0, case.seconds))
    process.kill()
    _, complaint = process.communicate()
    found = contents(out)
    strays = sum(map(is_stray, found))
    outcome = Outcome(moment(found, case, process.returncode == -signal.SIGKILL), strays, False, faults(found, case))
    if process.returncode not in (0, -signal.SIGKILL):
        outcome.wrong.append(f"it ended by itself with {process.returncode}: {complaint.decode()[-300:]}")
    if strays or number % RERUN_EVERY == 0:
        outcome.rerun = True
        outcome.wrong += rerun(case, out)
    if not outcome.wrong:
        shutil.rmtree(out)
    return outcome


def prepare(work: Path, names: Sequence[str]) -> list[Case]:
    """Make the inputs, run the commands to their ends twice (old and new), and measure the second time."""
    scene = write_demo_scene(work / "scene", views=10, size=48)
    cases = []
    for name in names:

        def arguments(out: Path, seed: int = 0, name: str = name) -> list[str]:
            model, packed = work / f"train-{seed}" / MODEL_FILE, work / f"compress-{seed}" / "out.hyrf"
            return {
                "train": ["train", str(scene), "-o", str(out), "--overwrite", "--seed", str(seed), *TRAINING],
                "compress": ["compress", str(model), "-o", str(out / "out.hyrf"), "--overwrite"],
                "decompress": ["decompress", str(packed), "-o", str(out / "out.hyrf"), "--overwrite"],
                "render": ["render", str(packed), "-o", str(out), "--orbit", str(FRAMES), "--overwrite"],
                "make": ["make", str(scene), "-o", str(out / "out.hyrf"), "--overwrite", "--seed", str(seed), *DRAFT],
            }[name]

        case = Case(name, arguments)
        for seed in (1, 0):
            out = work / f"{name}-{seed}"
            out.mkdir()
            process, began = start(arguments(out, seed)), time.perf_counter()
            case.writes = max(1, watch(process, out))
            case.seconds = time.perf_counter() - began
            if process.returncode:
                complaint = process.stderr.read().decode()
                raise SystemExit(f"{' '.join(process.args)}: exit {process.returncode}\n{complaint}")
        case.old, case.new = contents(work / f"{name}-1"), contents(work / f"{name}-0")
        cases.append(case)
    return cases


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=50, help="of each command (50)")
    parser.add_argument("--commands", nargs="+", choices=COMMANDS, default=COMMANDS, help="which to kill (all)")
    parser.add_argument("--seed", type=int, default=0, help="of the moments (0)")
    parser.add_argument("--jobs", type=int, default=2, help="trials at once (2)")
    args = parser.parse_args()
    work = Path(tempfile.mkdtemp(prefix="hyrfpack-kill-"))
    header = ("command", "seconds", "kills", *MOMENTS, "temporary files", "run again", "violations")
    print(" | ".join(header), flush=True)
    bad = []
    for case in prepare(work, COMMANDS[: 1 + max(map(COMMANDS.index, args.commands))]):
        if case.name not in args.commands:
            continue
        places = [work / f"{case.name}-trial-{number}" for number in range(args.kills)]
        with ThreadPoolExecutor(args.jobs) as pool:
            outcomes = list(pool.map(attempt, [case] * args.kills, range(args.kills), [args.seed] * args.kills, places))
        count = Counter(outcome.moment for outcome in outcomes)
        wrong = [f"{place.name}: {text}" for place, o in zip(places, outcomes, strict=True) for text in o.wrong]
        strays, again = sum(o.strays for o in outcomes), sum(o.rerun for o in outcomes)
        row = (case.name, f"{case.seconds:.1f}", args.kills, *(count[m] for m in MOMENTS), strays, again, len(wrong))
        print(" | ".join(f"{value:>{len(title)}}" for title, value in zip(header, row, strict=True)), flush=True)
        bad += wrong
    if bad:
        print("\n".join(bad), f"what the trials left is in {work}", sep="\n")
        sys.exit(1)
    shutil.rmtree(work)


if __name__ == "__main__":
    main()

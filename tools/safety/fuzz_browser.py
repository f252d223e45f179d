"""Feed hostile `.hyrf` files to the readers in Python and in JavaScript, and check that both give the same results.

    python -m tools.safety.fuzz_browser --count 20000 --jobs 2 --out runs/fuzz_browser

The inputs are those of `fuzz_mutate.make_hostile_file`. Every fourth input is read as the start of a file, the others
as whole files. Both readers must accept an input, or both must refuse it. Accepted numbers must be equal bit for bit. A
refusal must be one printable line. The reader in JavaScript may take MIN_LIMIT_SECONDS of CPU time plus
MAX_JAVASCRIPT_RATIO times that of the reader in Python. Anything else is a failure, such as the end of node or another
exception in Python, and the input is saved with its seed and number. It prints a summary with counts and seconds of CPU
time, and exits with 1 after a failure. If a process of the reader in Python dies, the run ends, fails and says how many
inputs were not compared; `tools.safety.fuzz` finds the input.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import multiprocessing
import os
import shutil
import struct
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import torch

from hyrfpack.atomic import check_writable, make_folder
from hyrfpack.errors import HyrfFormatError
from hyrfpack.format import decode_model
from hyrfpack.format.arrays import to_arrays
from hyrfpack.format.container import read_container
from hyrfpack.format.parts import decode_parts
from hyrfpack.format.sections import SECTION_CONTENTS
from hyrfpack.model import HybridModel
from hyrfpack.model.merged import parts_of
from tools.command import positive_integer, run_command
from tools.safety.fuzz import MAX_MESSAGE_CHARACTERS, generalize_message
from tools.safety.fuzz_mutate import make_hostile_file

READER_SCRIPT = Path(__file__).parent / "read_many.mjs"
MIN_LIMIT_SECONDS, MAX_JAVASCRIPT_RATIO = 0.5, 20.0
NODE_BATCH_TIMEOUT_SECONDS = 600
INPUTS_PER_BATCH = 500
PARTIAL_EVERY = 4  # one input in this many is read as the start of a file


@dataclass(frozen=True)
class Verdict:
    """Result of reading one file.

    Attributes:
        groups: SHA-256 of each group's numbers as float32, by section, and by number after the first part of a merged
            file; empty if the file is refused.
        refused: the message of the refusal, else empty.
        failed: an unexpected error or the end of node, else empty.
        seconds: CPU time.
        layers: number of Gaussians of each layer that was read (JavaScript, accepted files).
        whole: whether all layers were read (JavaScript, accepted files).
        peak: peak memory of the process up to now in bytes (JavaScript, accepted files).
    """

    groups: dict[str, str] = field(default_factory=dict)
    refused: str = ""
    failed: str = ""
    seconds: float = 0.0
    layers: tuple[int, ...] = ()
    whole: bool = True
    peak: int = 0


def read_in_python(data: bytes, is_start: bool = False) -> Verdict:
    """Read a file with hyrfpack, or, with `is_start`, the start of a file."""
    start = time.process_time()
    try:
        if is_start:
            models: Sequence[HybridModel] = [decode_model(data, fraction=1)]
        else:
            models = parts_of(decode_parts(read_container(data, SECTION_CONTENTS)))
        groups = {
            f"{group} {number}" if number else group: values
            for number, model in enumerate(models)
            for group, values in to_arrays(model).items()
        }
    except HyrfFormatError as error:
        return Verdict(refused=str(error), seconds=time.process_time() - start)
    except Exception as error:
        return Verdict(failed=f"{type(error).__name__}: {error}", seconds=time.process_time() - start)
    hashes = {group: hashlib.sha256(values.tobytes()).hexdigest() for group, values in groups.items()}
    return Verdict(hashes, seconds=time.process_time() - start)


def read_in_javascript(files: Sequence[tuple[bytes, bool]]) -> list[Verdict]:
    """Read files with the JavaScript decoder under node, which is started again after a file at which it ends.

    Args:
        files: the bytes of each file, and whether it is the start of a file.
    """
    verdicts: list[Verdict] = []
    while len(verdicts) < len(files):
        batch_verdicts, failed = _read_until_end(files[len(verdicts) :])
        verdicts += batch_verdicts
        if failed:
            verdicts.append(Verdict(failed=failed))
    return verdicts


def _read_until_end(files: Sequence[tuple[bytes, bool]]) -> tuple[list[Verdict], str]:
    """Return the results of one run of node, and how it failed at the file after these, "" if it read all files."""
    with tempfile.TemporaryDirectory() as folder:
        batch = Path(folder) / "files"
        batch.write_bytes(b"".join(struct.pack("<IB", len(data), is_start) + data for data, is_start in files))
        output, errors = Path(folder) / "output", Path(folder) / "errors"
        with output.open("wb") as stdout, errors.open("wb") as stderr:
            command = ["node", str(READER_SCRIPT), str(batch)]
            try:
                process = subprocess.run(command, stdout=stdout, stderr=stderr, timeout=NODE_BATCH_TIMEOUT_SECONDS)
                end = f"exit code {process.returncode}"
            except subprocess.TimeoutExpired:
                end = f"not done within {NODE_BATCH_TIMEOUT_SECONDS} s"
        answers = [json.loads(line) for line in output.read_text("utf-8", "replace").split("\n")[:-1]]
        message = errors.read_text("utf-8", "replace")[-2000:]
    failed = "" if len(answers) == len(files) else f"node ended: {end}: {message}"
    verdicts = [
        Verdict(
            answer.get("groups", {}),
            answer.get("refused", ""),
            answer.get("failed", ""),
            answer["ms"] / 1000,
            tuple(answer.get("layers", ())),
            answer.get("whole", True),
            answer.get("peak", 0),
        )
        for answer in answers
    ]
    return verdicts, failed


def find_disagreement(python: Verdict, javascript: Verdict) -> str:
    """Return how two results of one file disagree, or which rule they break; "" if neither is the case."""
    for language, verdict in (("Python", python), ("JavaScript", javascript)):
        if verdict.failed:
            return f"{language} fails: {verdict.failed}"
    if bool(python.refused) != bool(javascript.refused):
        return f"Python: {python.refused or 'accepted'!r:.500}; JavaScript: {javascript.refused or 'accepted'!r:.500}"
    if one_sided := python.groups.keys() ^ javascript.groups.keys():
        return f"only one reader has {', '.join(sorted(one_sided))}"
    if wrong := [group for group, digest in python.groups.items() if javascript.groups[group] != digest]:
        return f"different numbers in {', '.join(wrong)}"
    if javascript.refused and not (
        javascript.refused.isprintable() and 10 < len(javascript.refused) < MAX_MESSAGE_CHARACTERS
    ):
        return f"the message is empty, too long or not printable: {javascript.refused[:200]!r}"
    if javascript.seconds > MIN_LIMIT_SECONDS + MAX_JAVASCRIPT_RATIO * python.seconds:
        return f"JavaScript takes {javascript.seconds:.2f} s (Python {python.seconds:.2f} s)"
    return ""


@dataclass
class Tally:
    """Counts of a run.

    Attributes:
        kinds: number of inputs by kind.
        accepted: number of accepted inputs by kind.
        refused: number of refused inputs by message pattern.
        slowest: most seconds of CPU time in JavaScript, and the number of the input.
        failures: description of each failure by the number of its input.
    """

    kinds: Counter = field(default_factory=Counter)
    accepted: Counter = field(default_factory=Counter)
    refused: Counter = field(default_factory=Counter)
    slowest: tuple[float, int] = (0.0, -1)
    failures: dict[int, str] = field(default_factory=dict)

    def add(self, other: Tally) -> None:
        """Add the counts and failures of another tally."""
        for name in ("kinds", "accepted", "refused", "failures"):
            getattr(self, name).update(getattr(other, name))
        self.slowest = max(self.slowest, other.slowest)


def compare(numbers: Sequence[int], seed: int = 0) -> Tally:
    """Read the inputs with these numbers with both readers, and return the tally."""
    torch.set_num_threads(1)
    os.environ["HYRFPACK_THREADS"] = "1"
    inputs = {number: make_hostile_file(number, seed) for number in numbers}
    files = [(data, number % PARTIAL_EVERY == 0) for number, (_, data) in inputs.items()]
    tally = Tally()
    for number, (data, is_start), javascript in zip(numbers, files, read_in_javascript(files), strict=True):
        kind, python = inputs[number][0], read_in_python(data, is_start)
        tally.kinds[kind] += 1
        if javascript.refused:
            tally.refused[generalize_message(javascript.refused)] += 1
        elif not javascript.failed:
            tally.accepted[kind] += 1
        tally.slowest = max(tally.slowest, (javascript.seconds, number))
        if wrong := find_disagreement(python, javascript):
            tally.failures[number] = f"{kind}: {wrong}"
    return tally


def compare_in_processes(compare_batch: Callable[[Sequence[int]], Tally], count: int, jobs: int) -> Tally:
    """Compare inputs 0 to `count` - 1 in processes; return the tally of all batches before the death of a process."""
    tally = Tally()
    batches = [range(first, min(first + INPUTS_PER_BATCH, count)) for first in range(0, count, INPUTS_PER_BATCH)]
    # Unlike multiprocessing's pool, this one does not wait for ever for the batch of a process that has died.
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as executor:
        with contextlib.suppress(BrokenProcessPool):
            for result in as_completed([executor.submit(compare_batch, batch) for batch in batches]):
                tally.add(result.result())
                if sys.stderr.isatty():
                    print(f"\r{tally.kinds.total():,} of {count:,}", end="", file=sys.stderr)
    return tally


def report(tally: Tally, seconds: float) -> str:
    """Format the summary of a run."""
    total = tally.kinds.total()
    lines = [
        f"{total:,} inputs in {seconds:.0f} s, {len(tally.failures)} failures; {tally.accepted.total():,} accepted, "
        f"{tally.refused.total():,} refused; slowest {tally.slowest[0]:.3f} s (input {tally.slowest[1]})",
        "\nkind of input            inputs  accepted",
        *(f"  {kind:<20} {count:>9,} {tally.accepted[kind]:>9,}" for kind, count in tally.kinds.most_common()),
        "\nmessages of refused inputs (JavaScript)",
        *(f"  {count:>9,}  {message}" for message, count in tally.refused.most_common()),
    ]
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=positive_integer, default=20_000, help="number of inputs (20,000)")
    parser.add_argument("--seed", type=int, default=0, help="random seed of the inputs (0)")
    parser.add_argument(
        "--jobs",
        type=positive_integer,
        default=multiprocessing.cpu_count(),
        help="number of worker processes (one per core)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("runs/fuzz_browser"),
        help="folder for the report and failures (runs/fuzz_browser)",
    )
    options = parser.parse_args()
    if not shutil.which("node"):
        parser.error("node is not installed; install Node.js 20 or newer")
    make_folder(options.out)  # before the run, so that no result is lost
    check_writable(options.out)
    start = time.monotonic()
    tally = compare_in_processes(partial(compare, seed=options.seed), options.count, options.jobs)
    text = report(tally, time.monotonic() - start)
    (options.out / f"report-{options.seed}.txt").write_text(text + "\n")
    print("\n" + text)
    for number, description in sorted(tally.failures.items()):
        path = options.out / f"{options.seed}-{number}.hyrf"
        path.write_bytes(make_hostile_file(number, options.seed)[1])
        print(f"FAILED {path}: {description[:600]}")
    if missing := options.count - tally.kinds.total():
        print(f"FAILED: {missing:,} inputs were not compared, because a process of the reader in Python died")
    return 1 if tally.failures or missing else 0


if __name__ == "__main__":
    run_command(main)

"""Feed hostile `.hyrf` files to the readers in Python and in JavaScript and see that they say the same of each.

    python -m tools.safety.fuzz_browser --count 20000 --jobs 2 --out runs/fuzz_browser

The inputs are those of `fuzz_mutate.mutant`, as whole files and every fourth as the start of one. Both readers must
accept or both refuse; what both accept must be the same numbers, bit for bit; a refusal must be one printable
sentence; and no file may take the reader in JavaScript more processor time than MIN_LIMIT_SECONDS and
MAX_JAVASCRIPT_RATIO times what it takes the reader in Python. What else happens is a
failure, saved with the numbers that make it again.
"""

from __future__ import annotations

import argparse
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
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import torch

from hyrfpack.errors import HyrfFormatError
from hyrfpack.format import decode_model
from hyrfpack.format.arrays import to_arrays
from tools.safety.fuzz import LONGEST, pattern
from tools.safety.fuzz_mutate import mutant

READER = Path(__file__).parent / "read_many.mjs"
MIN_LIMIT_SECONDS, MAX_JAVASCRIPT_RATIO = 0.5, 20.0
NEVER_ANSWERS = 600  # seconds of a batch after which node is taken for stuck
BATCH = 500
CUT_EVERY = 4  # inputs, one of which is read as the start of a file


@dataclass(frozen=True)
class Verdict:
    """What a reader says of a file.

    Attributes:
        groups: SHA-256 of each group's numbers as float32, by section; empty if it is refused.
        refused: the sentence it is refused with, else empty.
        failed: what should not have happened, else empty.
        seconds: of processor time that it took.
        layers, whole, peak: of an accepted file, in JavaScript: Gaussians of the layers that were read, whether all
            layers were, and the most bytes of memory up to then.
    """

    groups: dict[str, str] = field(default_factory=dict)
    refused: str = ""
    failed: str = ""
    seconds: float = 0.0
    layers: tuple[int, ...] = ()
    whole: bool = True
    peak: int = 0


def in_python(data: bytes, cut: bool = False) -> Verdict:
    """What hyrfpack says of a file, or, if `cut`, of the start of one."""
    start = time.process_time()
    try:
        groups = to_arrays(decode_model(data, fraction=1 if cut else None))
    except HyrfFormatError as error:
        return Verdict(refused=str(error), seconds=time.process_time() - start)
    hashes = {group: hashlib.sha256(values.tobytes()).hexdigest() for group, values in groups.items()}
    return Verdict(hashes, seconds=time.process_time() - start)


def in_javascript(files: Sequence[tuple[bytes, bool]]) -> list[Verdict]:
    """What the decoder under node says of files; the second of each pair is as `cut` of `in_python`.

    Raises:
        RuntimeError: node died, of the file whose number the message tells.
    """
    with tempfile.TemporaryDirectory() as folder:
        batch = Path(folder) / "files"
        batch.write_bytes(b"".join(struct.pack("<IB", len(data), cut) + data for data, cut in files))
        run = subprocess.run(["node", str(READER), str(batch)], capture_output=True, text=True, timeout=NEVER_ANSWERS)
    answers = [json.loads(line) for line in run.stdout.splitlines()]
    if run.returncode or len(answers) != len(files):
        raise RuntimeError(f"node died of file {len(answers)}: {run.stderr[-2000:]}")
    return [
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


def disagreement(python: Verdict, javascript: Verdict) -> str:
    """What is wrong with two verdicts on one file; empty if nothing is."""
    if javascript.failed:
        return f"JavaScript fails: {javascript.failed}"
    if bool(python.refused) != bool(javascript.refused):
        return f"Python: {python.refused or 'accepted'!r:.500}; JavaScript: {javascript.refused or 'accepted'!r:.500}"
    if wrong := [group for group, digest in python.groups.items() if javascript.groups[group] != digest]:
        return f"other numbers in {', '.join(wrong)}"
    if javascript.refused and not (javascript.refused.isprintable() and 10 < len(javascript.refused) < LONGEST):
        return f"no sentence: {javascript.refused[:200]!r}"
    if javascript.seconds > MIN_LIMIT_SECONDS + MAX_JAVASCRIPT_RATIO * python.seconds:
        return f"JavaScript takes {javascript.seconds:.2f} s (Python {python.seconds:.2f} s)"
    return ""


@dataclass
class Tally:
    """What a run has seen."""

    kinds: Counter = field(default_factory=Counter)
    accepted: Counter = field(default_factory=Counter)
    refused: Counter = field(default_factory=Counter)
    slowest: tuple[float, int] = (0.0, -1)
    failures: dict[int, str] = field(default_factory=dict)

    def add(self, other: Tally) -> None:
        for name in ("kinds", "accepted", "refused", "failures"):
            getattr(self, name).update(getattr(other, name))
        self.slowest = max(self.slowest, other.slowest)


def compare(numbers: Sequence[int], seed: int = 0) -> Tally:
    """Both readers on these inputs of a run."""
    torch.set_num_threads(1)
    os.environ["HYRFPACK_THREADS"] = "1"
    made = {number: mutant(number, seed) for number in numbers}
    files = [(data, number % CUT_EVERY == 0) for number, (_, data) in made.items()]
    tally = Tally()
    for number, (data, cut), javascript in zip(numbers, files, in_javascript(files), strict=True):
        kind, python = made[number][0], in_python(data, cut)
        tally.kinds[kind] += 1
        if javascript.refused:
            tally.refused[pattern(javascript.refused)] += 1
        else:
            tally.accepted[kind] += 1
        tally.slowest = max(tally.slowest, (javascript.seconds, number))
        if wrong := disagreement(python, javascript):
            tally.failures[number] = f"{kind}: {wrong}"
    return tally


def report(tally: Tally, seconds: float) -> str:
    """The summary of a run."""
    total = tally.kinds.total()
    lines = [
        f"{total:,} inputs in {seconds:.0f} s, {len(tally.failures)} failures; {tally.accepted.total():,} accepted, "
        f"{tally.refused.total():,} refused; slowest {tally.slowest[0]:.3f} s (input {tally.slowest[1]})",
        "\nmade by                  inputs  accepted",
        *(f"  {kind:<20} {count:>9,} {tally.accepted[kind]:>9,}" for kind, count in tally.kinds.most_common()),
        "\nrefused in JavaScript with",
        *(f"  {count:>9,}  {sentence}" for sentence, count in tally.refused.most_common()),
    ]
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=20_000, help="inputs (20,000)")
    parser.add_argument("--seed", type=int, default=0, help="another seed, other inputs (0)")
    parser.add_argument("--jobs", type=int, default=multiprocessing.cpu_count(), help="processes (one a core)")
    parser.add_argument("--out", type=Path, default=Path("runs/fuzz_browser"), help="folder for failures")
    options = parser.parse_args()
    if not shutil.which("node"):
        parser.error("node is not here; install Node.js 20 or newer")
    start, tally = time.monotonic(), Tally()
    batches = [range(first, min(first + BATCH, options.count)) for first in range(0, options.count, BATCH)]
    with multiprocessing.get_context("spawn").Pool(options.jobs) as pool:
        for part in pool.imap_unordered(partial(compare, seed=options.seed), batches):
            tally.add(part)
            if sys.stderr.isatty():
                print(f"\r{tally.kinds.total():,} of {options.count:,}", end="", file=sys.stderr)
    options.out.mkdir(parents=True, exist_ok=True)
    text = report(tally, time.monotonic() - start)
    (options.out / f"report-{options.seed}.txt").write_text(text + "\n")
    print("\n" + text)
    for number, story in sorted(tally.failures.items()):
        path = options.out / f"{options.seed}-{number}.hyrf"
        path.write_bytes(mutant(number, options.seed)[1])
        print(f"FAILED {path}: {story[:600]}")
    return 1 if tally.failures else 0


if __name__ == "__main__":
    sys.exit(main())

"""Feed the `.hyrf` reader hostile files and see that each is decoded or refused in one sentence, in time and in memory.

    python -m tools.safety.fuzz --count 1000000 --jobs 2 --out runs/fuzz

For each input of `fuzz_mutate.mutant` the reader must either decode it - every number finite, and the model written
as profile raw decodes to itself - or raise HyrfFormatError with one printable line. What else happens is a failure,
saved with the numbers that make it again: another exception, a warning, the death of the process, more than SECONDS of
processor time, more than SPACE of address space, or (traced, for one input in TRACED) more memory at once than

    10 x (bytes that the table of contents says the sections decode to, within the format's own limit, + bytes of the
    file) + SLACK

One input in FILED also goes through a file: `load` and `describe` must agree with the decoder, and `hyrfpack info` must
print it. One decoded model in RENDERED is rendered. Workers are processes of their own and are replaced when they die.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import itertools
import multiprocessing
import os
import re
import resource
import signal
import struct
import sys
import tempfile
import threading
import time
import traceback
import tracemalloc
import warnings
from collections import Counter
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import torch

from hyrfpack.cameras.capture import Capture
from hyrfpack.cameras.paths import orbit
from hyrfpack.cameras.view_sampling import shrink_camera
from hyrfpack.cli.files import info
from hyrfpack.errors import HyrfError, HyrfFormatError
from hyrfpack.format import decode_model, describe, encode_model, load
from hyrfpack.format.container import raw_bytes_limit
from hyrfpack.format.exposure import encode_exposure
from hyrfpack.model import HybridModel
from hyrfpack.model.exposure import MAX_LOG_GAIN
from hyrfpack.render.renderer import render
from tools.safety.fuzz_mutate import mutant, seeds

SECONDS = 2.0
SPACE = 1 << 30
SLACK = 16 << 20
TRACED, FILED, RENDERED = 100, 100, 20
LONGEST = 1000  # characters of a sentence
BATCH = 1000
NEVER_ANSWERS = 300  # seconds of silence after which a worker is taken for stuck where no signal reaches


class Failure(Exception):
    """The reader did what it must not."""


class TooLong(BaseException):
    """The processor time is used up. No Exception, so that no reader takes it for one of its own."""


@dataclass
class Tally:
    """What a run has seen."""

    kinds: Counter = field(default_factory=Counter)
    decoded: Counter = field(default_factory=Counter)
    refused: Counter = field(default_factory=Counter)
    traced: int = 0
    filed: int = 0
    rendered: int = 0
    slowest: tuple[float, int] = (0.0, -1)
    largest: tuple[int, int] = (0, -1)
    closest: tuple[float, int] = (0.0, -1)
    failures: dict[int, str] = field(default_factory=dict)

    def add(self, other: Tally) -> None:
        for name in ("kinds", "decoded", "refused", "failures"):
            getattr(self, name).update(getattr(other, name))
        for name in ("traced", "filed", "rendered"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        for name in ("slowest", "largest", "closest"):
            setattr(self, name, max(getattr(self, name), getattr(other, name)))


# --- one input ---


def allowance(data: bytes) -> int:
    """Most bytes that decoding may have allocated at once."""
    declared = 0
    if len(data) >= 48:
        (count,) = struct.unpack_from("<I", data, 36)
        entries = range(72, min(48 + 40 * count, len(data) - 8), 40)
        declared = sum(struct.unpack_from("<Q", data, at)[0] for at in entries)
    return 10 * (min(declared, raw_bytes_limit(len(data))) + len(data)) + SLACK


def decode(data: bytes) -> HybridModel | str:
    """The model, or the sentence it was refused with. Raises Failure where that is no sentence."""
    try:
        return decode_model(data)
    except HyrfFormatError as error:
        sentence = str(error)
        if not sentence.isprintable() or not 10 < len(sentence) < LONGEST:
            raise Failure(f"no sentence: {sentence[:200]!r}") from error
        return sentence


def check_model(model: HybridModel) -> None:
    """Raise Failure unless every number is finite, the model survives profile raw, and log gains are within bounds."""
    state = model.state_dict()
    again = decode_model(encode_model(model, "raw"))
    again_values = again.state_dict()
    for name, values in state.items():
        if not torch.isfinite(values).all():
            raise Failure(f"{name} is not finite")
        if not torch.equal(values, again_values[name]):
            raise Failure(f"{name} does not survive")
    if model.exposure is None:
        return
    if again.exposure is None or encode_exposure(again.exposure) != encode_exposure(model.exposure):
        raise Failure("the exposure map does not survive")
    for position in (np.zeros(3), np.full(3, 1e30)):
        gains = model.exposure.predict_log_gains(position, np.array([0.0, 0.0, 1.0]))
        if not (np.abs(gains) <= MAX_LOG_GAIN).all():
            raise Failure(f"the exposure map gives the log gains {gains}")


def check_trace(data: bytes) -> tuple[int, float]:
    """Most bytes allocated at once in decoding, and as a share of what is allowed; Failure if that is more than 1."""
    tracemalloc.start()
    try:
        outcome = decode(data)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    if isinstance(outcome, HybridModel):  # torch's own memory is not traced
        peak += sum(4 * values.numel() for values in outcome.state_dict().values())
    allowed = allowance(data)
    if peak > allowed:
        raise Failure(f"{peak:,} bytes were allocated at once, and {allowed:,} are allowed")
    return peak, peak / allowed


def check_file(data: bytes, outcome: HybridModel | str, folder: Path) -> None:
    """Raise Failure unless the file at a path is read as its bytes are, described, and shown."""
    path = folder / "model.hyrf"
    path.write_bytes(data)
    try:
        load(path)
        refused = None
    except HyrfFormatError as error:
        refused = str(error).replace(str(path), "the data")
    if refused != (outcome if isinstance(outcome, str) else None):
        raise Failure(f"the file says {refused!r} and its bytes {outcome!r:.200}")
    shown = io.TextIOWrapper(io.BytesIO(), encoding="utf-8")
    try:
        describe(path)
        with contextlib.redirect_stdout(shown):
            info.callback(path, False)
            info.callback(path, True)
    except HyrfFormatError as error:
        if not isinstance(outcome, str):
            raise Failure(f"a decoded file is not described: {error}") from error
    shown.seek(0)
    if not shown.read().replace("\n", "").isprintable():
        raise Failure("what is shown of the file is not printable")


def check_picture(model: HybridModel) -> None:
    """Render; a frame that no camera can be placed by, and numbers that overflow, are refused in a sentence."""
    with contextlib.suppress(HyrfError), torch.no_grad():
        facts = {"provenance": {}, "config": {"frame": vars(model.config.frame)}}
        (camera,) = orbit(Capture(facts).viewpoint, 1)
        render(model, shrink_camera(camera, 16))


def examine(number: int, seed: int, tally: Tally, folder: Path) -> None:
    """One input of a run, from making it to the verdict."""
    kind, data = mutant(number, seed)
    tally.kinds[kind] += 1
    try:
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        start = time.process_time()
        outcome = decode(data)
        taken = time.process_time() - start
        signal.setitimer(signal.ITIMER_PROF, 0)
        tally.slowest = max(tally.slowest, (taken, number))
        if isinstance(outcome, str):
            tally.refused[pattern(outcome)] += 1
        else:
            tally.decoded[kind] += 1
            check_model(outcome)
            if number % RENDERED == 0:
                tally.rendered += 1
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")  # senseless models overflow
                    check_picture(outcome)
        if number % TRACED == 0:
            peak, share = check_trace(data)
            tally.traced += 1
            tally.largest, tally.closest = max(tally.largest, (peak, number)), max(tally.closest, (share, number))
        if number % FILED == 0:
            tally.filed += 1
            check_file(data, outcome, folder)
    except TooLong:
        tally.failures[number] = f"{kind}: more than {SECONDS} s of processor time\n{traceback.format_exc()}"
    except Exception as error:
        tally.failures[number] = f"{kind}: {type(error).__name__}: {error}\n{traceback.format_exc()}"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)


def pattern(sentence: str) -> str:
    """A sentence without what it says of this one file, so that the same complaints count together."""
    sentence = sentence.removeprefix("the data: ")
    sentence = re.sub(r"(?<=section )'(\w{4})'", r"<\1>", sentence)
    sentence = re.sub(r"^rule .* and this", "rule '...' and this", sentence)
    sentence = re.sub(r"(?<!\w)b?'.*('(?!\w)|$)|\"[^\"]*\"", "'...'", sentence)
    sentence = re.sub(r"0x[\da-f]+|-?\d[\d,.e+-]*", "#", sentence)
    return re.sub(r"<[\w#]{4}>", "<....>", sentence).split(";")[0][:110]


# --- many ---


def work(pipe: Connection, current: multiprocessing.Value, seed: int) -> None:
    """The loop of a worker: batches (numbers to examine) come in, tallies go out."""

    def stop(*_: object) -> None:
        raise TooLong

    torch.set_num_threads(1)
    os.environ["HYRFPACK_THREADS"] = "1"  # what is refused first, and how much memory it takes, is no matter of luck
    signal.signal(signal.SIGPROF, stop)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    warnings.simplefilter("error")
    with tempfile.TemporaryDirectory() as folder:
        for data in seeds()[0]:  # everything is loaded and compiled before the limit is set
            model = decode(data)
            check_file(data, model, Path(folder))
            check_picture(model)
        size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (size + SPACE, resource.RLIM_INFINITY))
        while (numbers := pipe.recv()) is not None:
            tally = Tally()
            for number in numbers:
                current.value = number
                examine(number, seed, tally, Path(folder))
            pipe.send((tally, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10))


class Run:
    """Hands batches to workers until `count` inputs are examined; replaces workers that die."""

    def __init__(self, count: int, seed: int, jobs: int) -> None:
        self.count, self.seed, self.jobs = count, seed, jobs
        self.batches = itertools.count(0, BATCH)
        self.tally, self.resident = Tally(), 0
        self.lock = threading.Lock()

    def start(self) -> Tally:
        threads = [threading.Thread(target=self._serve, daemon=True) for _ in range(self.jobs)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        return self.tally

    def _serve(self) -> None:
        worker = _Worker(self.seed)
        while (first := next(self.batches)) < self.count:
            numbers = list(range(first, min(first + BATCH, self.count)))
            while numbers:
                answer = worker.ask(numbers)
                if answer is None:
                    killer = worker.current.value
                    with self.lock:
                        self.tally.failures[killer] = f"the worker died: exit code {worker.process.exitcode}"
                    if killer not in numbers:  # it never came to work
                        return
                    numbers.remove(killer)
                    worker = _Worker(self.seed)
                    continue
                with self.lock:
                    self.tally.add(answer[0])
                    self.resident = max(self.resident, answer[1])
                    done = self.tally.kinds.total()
                    if sys.stderr.isatty():
                        print(
                            f"\r{done:,} of {self.count:,}, {len(self.tally.failures)} failures",
                            end="",
                            file=sys.stderr,
                        )
                numbers = []
        worker.pipe.send(None)
        worker.process.join()


class _Worker:
    def __init__(self, seed: int) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, end = context.Pipe()
        self.current = context.Value("q", -1, lock=False)
        self.process = context.Process(target=work, args=(end, self.current, seed), daemon=True)
        self.process.start()
        end.close()

    def ask(self, numbers: list[int]) -> tuple[Tally, int] | None:
        """The tally of these inputs and the worker's largest resident size; None when it died of one."""
        try:
            self.pipe.send(numbers)
            before = -1
            while not self.pipe.poll(NEVER_ANSWERS):
                if self.current.value == before:
                    self.process.kill()
                before = self.current.value
            return self.pipe.recv()
        except (EOFError, OSError):
            self.process.join()
            return None


def report(tally: Tally, resident: int, seconds: float) -> str:
    """The summary of a run."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    cores = used.ru_utime + used.ru_stime
    total, decoded = tally.kinds.total(), tally.decoded.total()
    lines = [
        f"{total:,} inputs in {seconds:.0f} s ({total / seconds:.0f}/s, {total / cores:.0f} a "
        f"second of processor time), {len(tally.failures)} failures",
        f"{decoded:,} decoded, {tally.refused.total():,} refused; {tally.traced:,} traced, {tally.filed:,} through a "
        f"file, {tally.rendered:,} rendered",
        f"slowest {tally.slowest[0]:.3f} s of processor time (input {tally.slowest[1]})",
        f"most allocated at once {tally.largest[0] / 1e6:.1f} MB (input {tally.largest[1]}); at most "
        f"{tally.closest[0]:.0%} of what is allowed (input {tally.closest[1]}); largest worker {resident / 1e6:.0f} MB",
        "\nmade by                  inputs   decoded",
        *(f"  {kind:<20} {count:>9,} {tally.decoded[kind]:>9,}" for kind, count in tally.kinds.most_common()),
        "\nrefused with",
        *(f"  {count:>9,}  {sentence}" for sentence, count in tally.refused.most_common()),
    ]
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=1_000_000, help="inputs (1,000,000)")
    parser.add_argument("--seed", type=int, default=0, help="another seed, other inputs (0)")
    parser.add_argument("--jobs", type=int, default=multiprocessing.cpu_count(), help="processes (one a core)")
    parser.add_argument("--out", type=Path, default=Path("runs/fuzz"), help="folder for failures (runs/fuzz)")
    parser.add_argument("--only", type=int, help="examine this one input of the run and show what goes wrong")
    options = parser.parse_args()
    if options.only is not None:
        kind, data = mutant(options.only, options.seed)
        print(f"{kind}, {len(data)} bytes: {decode(data)!r:.2000}")
        return 0
    start = time.monotonic()
    run = Run(options.count, options.seed, options.jobs)
    tally = run.start()
    options.out.mkdir(parents=True, exist_ok=True)
    text = report(tally, run.resident, time.monotonic() - start)
    (options.out / f"report-{options.seed}.txt").write_text(text + "\n")
    print("\n" + text)
    for number, story in sorted(tally.failures.items()):
        name = options.out / f"{options.seed}-{number}"
        name.with_suffix(".hyrf").write_bytes(mutant(number, options.seed)[1])
        name.with_suffix(".txt").write_text(f"--seed {options.seed} --only {number}\n{story}")
        print(f"FAILED {name}.hyrf: {story.splitlines()[0][:200]}")
    return 1 if tally.failures else 0


if __name__ == "__main__":
    sys.exit(main())

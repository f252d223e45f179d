"""Feed hostile files to the `.hyrf` reader and check that it decodes or refuses each within its time and memory limits.

    python -m tools.safety.fuzz --count 1000000 --jobs 2 --out runs/fuzz

It prints a summary with counts, seconds of CPU time and MB of memory, saves it in --out, and exits with 1 after a
failure. For each input of `fuzz_mutate.make_hostile_file` the reader must do one of two things. It decodes the input:
all numbers are finite, and the model survives a round trip through profile raw. Or it raises HyrfFormatError with one
printable line. Anything else is a failure, and the input is saved with the seed and number that reproduce it. Failures
are: another exception, a warning, the death of the process, more than MAX_CPU_SECONDS of CPU time, more than
MAX_EXTRA_ADDRESS_SPACE_BYTES of address space, or (for one input in TRACE_EVERY) a peak of allocated memory above

    10 x (decoded bytes of the sections by the table of contents, within the format's limit, + bytes of the file)
    + ALLOWED_BASE_BYTES

For one input in FILE_CHECK_EVERY, `load` and `describe` of a file must agree with the decoder, and `hyrfpack info` must
print it. One decoded model in RENDER_EVERY is rendered. Inputs run in worker processes, which are replaced if they die.
If MAX_FAILED_STARTS workers die before their first input, the run fails and says how many inputs were not examined.
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

from hyrfpack.atomic import check_writable, make_folder
from hyrfpack.cameras.capture import Capture
from hyrfpack.cameras.paths import orbit
from hyrfpack.cameras.view_sampling import shrink_camera
from hyrfpack.cli.info import info
from hyrfpack.errors import HyrfError, HyrfFormatError
from hyrfpack.format import decode_model, describe_file, encode_model
from hyrfpack.format.container import raw_bytes_limit, read_container
from hyrfpack.format.exposure import encode_exposure
from hyrfpack.format.parts import decode_parts, load_model_or_parts
from hyrfpack.format.sections import SECTION_CONTENTS
from hyrfpack.model import HybridModel
from hyrfpack.model.exposure import MAX_LOG_GAIN
from hyrfpack.model.merged import MergedModel, parts_of, scene_of
from hyrfpack.render.renderer import render_view
from tools.command import positive_integer, run_command
from tools.cpu_time import children_cpu_seconds
from tools.safety.fuzz_mutate import load_merged_seed_files, load_seed_files, make_hostile_file

MAX_CPU_SECONDS = 2.0
MAX_EXTRA_ADDRESS_SPACE_BYTES = 1 << 30
ALLOWED_BASE_BYTES = 16 << 20
# One input in this many has its memory traced, is read from a file, or is rendered after decoding.
TRACE_EVERY, FILE_CHECK_EVERY, RENDER_EVERY = 100, 100, 20
MAX_MESSAGE_CHARACTERS = 1000
INPUTS_PER_BATCH = 1000
MAX_FAILED_STARTS = 3  # of workers, one after the other, before a thread gives up
# Compiled code may not react to the signal of the CPU time, so a worker that is silent for this long is killed.
STUCK_WORKER_SECONDS = 300


class Failure(Exception):
    """The reader broke one of the rules."""


class CpuTimeExceeded(BaseException):
    """The CPU time is used up; this does not derive from Exception, so that the reader does not catch it."""


@dataclass
class Tally:
    """Counts and extremes of a run.

    Attributes:
        kinds: number of inputs by kind.
        decoded: number of decoded inputs by kind.
        refused: number of refused inputs by message pattern.
        traced, read_from_file, rendered: number of inputs with traced memory, read from a file, and rendered.
        slowest: most seconds of CPU time, and the number of the input.
        largest: most bytes allocated at once, and the number of the input.
        closest_to_limit: largest share of the allowed bytes, and the number of the input.
        failures: description of each failure by the number of its input.
    """

    kinds: Counter = field(default_factory=Counter)
    decoded: Counter = field(default_factory=Counter)
    refused: Counter = field(default_factory=Counter)
    traced: int = 0
    read_from_file: int = 0
    rendered: int = 0
    slowest: tuple[float, int] = (0.0, -1)
    largest: tuple[int, int] = (0, -1)
    closest_to_limit: tuple[float, int] = (0.0, -1)
    failures: dict[int, str] = field(default_factory=dict)

    def add(self, other: Tally) -> None:
        """Add the counts and extremes of another tally."""
        for name in ("kinds", "decoded", "refused", "failures"):
            getattr(self, name).update(getattr(other, name))
        for name in ("traced", "read_from_file", "rendered"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        for name in ("slowest", "largest", "closest_to_limit"):
            setattr(self, name, max(getattr(self, name), getattr(other, name)))


# --- Check one input ---


def compute_max_decoder_bytes(data: bytes) -> int:
    """Return the largest number of bytes that decoding may allocate at one time."""
    declared = 0
    if len(data) >= 48:
        (count,) = struct.unpack_from("<I", data, 36)
        entries = range(48, min(48 + 40 * count, len(data) - 40), 40)
        declared = sum(struct.unpack_from("<Q", data, at + 24)[0] for at in entries)
        if any(data[at : at + 4] == b"PRTS" for at in entries):
            declared = raw_bytes_limit(len(data))  # of which the sections of all parts may take any share
    return 10 * (min(declared, raw_bytes_limit(len(data))) + len(data)) + ALLOWED_BASE_BYTES


def decode(data: bytes) -> HybridModel | MergedModel | str:
    """Return the decoded model or models, or the message of their refusal.

    Raises:
        Failure: the message is not one printable line of reasonable length.
    """
    try:
        return decode_parts(read_container(data, SECTION_CONTENTS, "the data"))
    except HyrfFormatError as error:
        message = str(error)
        if not message.isprintable() or not 10 < len(message) < MAX_MESSAGE_CHARACTERS:
            raise Failure(f"the message is empty, too long or not printable: {message[:200]!r}") from error
        return message


def check_model(model: HybridModel | MergedModel) -> None:
    """Raise Failure unless every number is finite, all models survive profile raw, and log gains are within bounds."""
    for part in parts_of(model):
        _check_part(part)


def _check_part(model: HybridModel) -> None:
    state = model.state_dict()
    reloaded = decode_model(encode_model(model, "raw"))
    reloaded_values = reloaded.state_dict()
    for name, values in state.items():
        if not torch.isfinite(values).all():
            raise Failure(f"{name} is not finite")
        if not torch.equal(values, reloaded_values[name]):
            raise Failure(f"{name} differs after a round trip through profile raw")
    if model.exposure is None:
        return
    if reloaded.exposure is None or encode_exposure(reloaded.exposure) != encode_exposure(model.exposure):
        raise Failure("the exposure map differs after a round trip through profile raw")
    for position in (np.zeros(3), np.full(3, 1e30)):
        gains = model.exposure.predict_log_gains(position, np.array([0.0, 0.0, 1.0]))
        if not (np.abs(gains) <= MAX_LOG_GAIN).all():
            raise Failure(f"the exposure map predicts log gains out of range: {gains}")


def check_memory(data: bytes) -> tuple[int, float]:
    """Return the peak of allocated bytes in decoding, and its share of the allowed bytes; raise Failure above 1."""
    tracemalloc.start()
    try:
        outcome = decode(data)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    if not isinstance(outcome, str):  # tracemalloc does not see torch's memory
        peak += sum(4 * values.numel() for part in parts_of(outcome) for values in part.state_dict().values())
    allowed = compute_max_decoder_bytes(data)
    if peak > allowed:
        raise Failure(f"{peak:,} bytes were allocated at once, and {allowed:,} are allowed")
    return peak, peak / allowed


def check_file(data: bytes, outcome: HybridModel | MergedModel | str, folder: Path) -> None:
    """Raise Failure unless a file with these bytes gives the same outcome, and is described and printed by `info`."""
    path = folder / "model.hyrf"
    path.write_bytes(data)
    try:
        load_model_or_parts(path)
        refused = None
    except HyrfFormatError as error:
        refused = str(error).replace(str(path), "the data")
    if refused != (outcome if isinstance(outcome, str) else None):
        raise Failure(f"reading the file gives {refused!r}, decoding its bytes gives {outcome!r:.200}")
    output = io.TextIOWrapper(io.BytesIO(), encoding="utf-8")
    try:
        describe_file(path)
        with contextlib.redirect_stdout(output):
            info.callback(path, False)
            info.callback(path, True)
    except HyrfFormatError as error:
        if not isinstance(outcome, str):
            raise Failure(f"the decoder accepts the file, but `describe` refuses it: {error}") from error
    output.seek(0)
    if not output.read().replace("\n", "").isprintable():
        raise Failure("`hyrfpack info` prints unprintable characters")


def check_rendering(model: HybridModel | MergedModel) -> None:
    """Render a small picture; a HyrfError is allowed, because a hostile frame may fit no camera."""
    with contextlib.suppress(HyrfError), torch.no_grad():
        facts = {"provenance": {}, "config": {"frame": vars(scene_of(model).config.frame)}}
        (camera,) = orbit(Capture(facts).viewpoint, 1)
        render_view(model, shrink_camera(camera, 16))


def examine_input(number: int, seed: int, tally: Tally, folder: Path) -> None:
    """Make input `number` of a run, check it, and add the result to the tally."""
    kind, data = make_hostile_file(number, seed)
    tally.kinds[kind] += 1
    try:
        signal.setitimer(signal.ITIMER_PROF, MAX_CPU_SECONDS)
        start = time.process_time()
        outcome = decode(data)
        seconds = time.process_time() - start
        signal.setitimer(signal.ITIMER_PROF, 0)
        tally.slowest = max(tally.slowest, (seconds, number))
        if isinstance(outcome, str):
            tally.refused[generalize_message(outcome)] += 1
        else:
            tally.decoded[kind] += 1
            check_model(outcome)
            if number % RENDER_EVERY == 0:
                tally.rendered += 1
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")  # models decoded from damaged files may overflow
                    check_rendering(outcome)
        if number % TRACE_EVERY == 0:
            peak, share = check_memory(data)
            tally.traced += 1
            tally.largest = max(tally.largest, (peak, number))
            tally.closest_to_limit = max(tally.closest_to_limit, (share, number))
        if number % FILE_CHECK_EVERY == 0:
            tally.read_from_file += 1
            check_file(data, outcome, folder)
    except CpuTimeExceeded:
        tally.failures[number] = f"{kind}: more than {MAX_CPU_SECONDS} s of CPU time\n{traceback.format_exc()}"
    except Exception as error:
        tally.failures[number] = f"{kind}: {type(error).__name__}: {error}\n{traceback.format_exc()}"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)


def generalize_message(message: str) -> str:
    """Replace the names and numbers of one file in a message, so that equal refusals are counted together."""
    message = message.removeprefix("the data: ")
    message = re.sub(r"(?<=section )'(\w{4})'", r"<\1>", message)
    message = re.sub(r"^rule .* and this", "rule '...' and this", message)
    message = re.sub(r"(?<!\w)b?'.*('(?!\w)|$)|\"[^\"]*\"", "'...'", message)
    message = re.sub(r"0x[\da-f]+|-?\d[\d,.e+-]*", "#", message)
    return re.sub(r"<[\w#]{4}>", "<....>", message).split(";")[0][:110]


# --- Run many inputs in worker processes ---


def run_worker(pipe: Connection, current: multiprocessing.Value, seed: int) -> None:
    """Run a worker's loop: receive batches of input numbers, send back tallies and the peak resident size in bytes."""

    def stop(*_: object) -> None:
        raise CpuTimeExceeded

    torch.set_num_threads(1)
    os.environ["HYRFPACK_THREADS"] = "1"  # with one thread, the first error and the memory are reproducible
    signal.signal(signal.SIGPROF, stop)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    warnings.simplefilter("error")
    with tempfile.TemporaryDirectory() as folder:
        # Everything is loaded and compiled before the memory limit is set.
        for data in (*load_seed_files()[0], *load_merged_seed_files()):
            model = decode(data)
            check_file(data, model, Path(folder))
            check_rendering(model)
        size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (size + MAX_EXTRA_ADDRESS_SPACE_BYTES, resource.RLIM_INFINITY))
        while (numbers := pipe.recv()) is not None:
            tally = Tally()
            for number in numbers:
                current.value = number
                examine_input(number, seed, tally, Path(folder))
            pipe.send((tally, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10))


class FuzzRun:
    """A run that hands batches to workers until `count` inputs are examined, and replaces workers that die."""

    def __init__(self, count: int, seed: int, jobs: int) -> None:
        self.count, self.seed, self.jobs = count, seed, jobs
        self.batches = itertools.count(0, INPUTS_PER_BATCH)
        self.tally, self.resident, self.deaths, self.unexamined = Tally(), 0, 0, 0
        self.lock = threading.Lock()

    def run(self) -> Tally:
        """Examine all inputs and return the tally."""
        threads = [threading.Thread(target=self._serve, daemon=True) for _ in range(self.jobs)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        self.unexamined = self.count - self.tally.kinds.total() - self.deaths
        return self.tally

    def _serve(self) -> None:
        """Hand batches to one worker after another, until no batch is left or no worker starts."""
        worker, failed_starts = _Worker(self.seed), 0
        while (first := next(self.batches)) < self.count:
            numbers = list(range(first, min(first + INPUTS_PER_BATCH, self.count)))
            while numbers:
                answer = worker.ask(numbers)
                if answer is None:
                    killer, exit_code = worker.current.value, worker.process.exitcode
                    failed_starts = 0 if killer in numbers else failed_starts + 1
                    if failed_starts == MAX_FAILED_STARTS:
                        return
                    if killer in numbers:  # else the worker died before its first input
                        numbers.remove(killer)
                        with self.lock:
                            self.deaths += 1
                            self.tally.failures[killer] = f"the worker died: exit code {exit_code}"
                    worker = _Worker(self.seed)
                    continue
                failed_starts = 0
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
    """A process that runs `run_worker`.

    Attributes:
        current: the number of the input that it examines, which outlives the process; -1 before the first one.
    """

    def __init__(self, seed: int) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, end = context.Pipe()
        self.current = context.Value("q", -1, lock=False)
        self.process = context.Process(target=run_worker, args=(end, self.current, seed), daemon=True)
        self.process.start()
        end.close()

    def ask(self, numbers: list[int]) -> tuple[Tally, int] | None:
        """Return the tally of these inputs and the worker's largest resident size in bytes; None if it died."""
        self.current.value = -1
        try:
            self.pipe.send(numbers)
            previous = -1
            while not self.pipe.poll(STUCK_WORKER_SECONDS):
                if self.current.value == previous:
                    self.process.kill()
                previous = self.current.value
            return self.pipe.recv()
        except (EOFError, OSError):
            self.process.join()
            return None


def report(tally: Tally, resident: int, seconds: float) -> str:
    """Format the summary of a run; `resident` is the largest resident size of a worker in bytes."""
    cores = children_cpu_seconds()
    total, decoded = tally.kinds.total(), tally.decoded.total()
    lines = [
        f"{total:,} inputs in {seconds:.0f} s ({total / seconds:.0f}/s, {total / cores:.0f} per "
        f"second of CPU time), {len(tally.failures)} failures",
        f"{decoded:,} decoded, {tally.refused.total():,} refused; memory of {tally.traced:,} traced, "
        f"{tally.read_from_file:,} read from a file, {tally.rendered:,} rendered",
        f"slowest input: {tally.slowest[0]:.3f} s of CPU time (input {tally.slowest[1]})",
        f"peak of allocated memory: {tally.largest[0] / 1e6:.1f} MB (input {tally.largest[1]}); at most "
        f"{tally.closest_to_limit[0]:.0%} of the allowed bytes (input {tally.closest_to_limit[1]}); "
        f"largest worker {resident / 1e6:.0f} MB",
        "\nkind of input            inputs   decoded",
        *(f"  {kind:<20} {count:>9,} {tally.decoded[kind]:>9,}" for kind, count in tally.kinds.most_common()),
        "\nmessages of refused inputs",
        *(f"  {count:>9,}  {message}" for message, count in tally.refused.most_common()),
    ]
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=positive_integer, default=1_000_000, help="number of inputs (1,000,000)")
    parser.add_argument("--seed", type=int, default=0, help="random seed of the inputs (0)")
    parser.add_argument(
        "--jobs",
        type=positive_integer,
        default=multiprocessing.cpu_count(),
        help="number of worker processes (one per core)",
    )
    parser.add_argument(
        "--out", type=Path, default=Path("runs/fuzz"), help="folder for the report and failed inputs (runs/fuzz)"
    )
    parser.add_argument("--only", type=int, help="decode only the input with this number and print the result")
    options = parser.parse_args()
    if options.only is not None:
        kind, data = make_hostile_file(options.only, options.seed)
        print(f"{kind}, {len(data)} bytes: {decode(data)!r:.2000}")
        return 0
    make_folder(options.out)  # before the run, so that no result is lost
    check_writable(options.out)
    start = time.monotonic()
    fuzz_run = FuzzRun(options.count, options.seed, options.jobs)
    tally = fuzz_run.run()
    text = report(tally, fuzz_run.resident, time.monotonic() - start)
    (options.out / f"report-{options.seed}.txt").write_text(text + "\n")
    print("\n" + text)
    for number, description in sorted(tally.failures.items()):
        name = options.out / f"{options.seed}-{number}"
        name.with_suffix(".hyrf").write_bytes(make_hostile_file(number, options.seed)[1])
        name.with_suffix(".txt").write_text(f"--seed {options.seed} --only {number}\n{description}")
        print(f"FAILED {name}.hyrf: {description.splitlines()[0][:200]}")
    if fuzz_run.unexamined:
        print(
            f"FAILED: {fuzz_run.unexamined:,} inputs were not examined, because workers died before their first input"
        )
    return 1 if tally.failures or fuzz_run.unexamined else 0


if __name__ == "__main__":
    run_command(main)

"""Check and measure hyrfpack's GPU kernels on this machine, and write a report; this takes at most 9 minutes.

    python -m tools.gpu.check                          the default parts; writes docs/gpu/<machine>.json and .md
    python -m tools.gpu.check --parts tests kernels    only these parts; writes <machine>-tests-kernels.json and .md
    python -m tools.gpu.check --parts quality --data ../shared/data/mipnerf360_bonsai

It prints one line for each row of the report, and writes the report again after each row. It needs a GPU, torch with
Triton, and numpy; hyrfpack need not be installed. The part `tests` also needs pytest. Training needs pillow, rich and
scipy, and on the CPU Numba. Items that lack a package are left out, and the report gives the reason. The parts, in the
order in which they run:

    self-test  the self-test of the kernels case by case, and `hyrfpack doctor`
    tests      random cases against the float64 reference, and the tests marked "gpu"
    kernels    each operation alone: time in ms, roofline, error
    frames     whole frames, training steps and gsplat, with 100,000 to 3 million Gaussians
    sanitizer  NVIDIA's compute-sanitizer on the cases of the self-test, where it is installed
    repeat     the same frame and the same training step twice: whether all bits agree
    quality    the same training run on the CPU and on the GPU: PSNR on held-out photos in dB; not run by default
    ranks      training by one process and by two, which may share a GPU; not run by default
    full-run   30,000 steps on the real data set on the GPU, as far as the time allows; not run by default

Exit code: 0 if every check passed, 1 if one failed, 2 if there is no GPU. A missed goal does not fail the check.
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from math import inf
from pathlib import Path

# Without this, torch's CPU threads keep spinning and slow down the kernel that is timed next.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import torch

from hyrfpack.measure.machine import format_machine
from hyrfpack.parallel.child_items import run_in_children
from tools.gpu.report import describe_gpu_machine, make_file_name, write_report
from tools.gpu.rows import Row
from tools.gpu.setup import FULL_RUN_SECONDS, Setup, find_dataset
from tools.gpu.worker import failure_row, run_child

REPOSITORY_ROOT = Path(__file__).parents[2]
LOGS_FOLDER = "logs"  # in the folder of results: what pytest and other programs print
FULL_RUN_OVERHEAD_SECONDS = 60.0  # what the full run takes besides its training time
# Each part has a module with `items(setup)` and `run(item, setup)`, and a time limit in seconds for all its items. The
# limits of the first two parts include the first build of 140 kernels, each of which takes 1 or 2 seconds of a core.
CHECK_PARTS = {
    "self-test": ("tools.gpu.first_contact", 140.0),
    "tests": ("tools.gpu.tests", 150.0),
    "kernels": ("tools.gpu.kernels", 45.0),
    "frames": ("tools.gpu.frames", 90.0),
    "sanitizer": ("tools.gpu.sanitizer", 95.0),
    "repeat": ("tools.gpu.repeat", 20.0),
    "quality": ("tools.gpu.quality", 170.0),
    "ranks": ("tools.gpu.ranks", 150.0),
    "full-run": ("tools.gpu.full_run", FULL_RUN_OVERHEAD_SECONDS),
}
# The time limit of each item in parts of many items, so that a kernel that hangs does not take the time of the others.
# Items in the module's SELF_TIMED_ITEMS keep a limit of their own.
ITEM_SECONDS = {"self-test": 40.0, "tests": 20.0, "kernels": 22.0, "frames": 45.0}
DEFAULT_PARTS = ("self-test", "tests", "kernels", "frames", "sanitizer", "repeat")
# The default parts end within this time, because some machines kill a command after 10 minutes.
MAX_DEFAULT_SECONDS = 540.0
NO_GPU = "torch finds no GPU on this machine, so nothing was checked; run this on a machine with a CUDA or ROCm GPU"


def check(
    parts: Sequence[str],
    setup: Setup,
    scale: float = 1.0,
    report: Callable[[Sequence[Row]], object] = lambda rows: None,
) -> list[Row]:
    """Run the parts, each in its own child processes; print each row as one line and return all rows.

    Args:
        parts: keys of CHECK_PARTS.
        setup: the sizes and the device.
        scale: factor of the parts' time limits.
        report: called with all rows so far after each row, so that an interrupted check loses nothing.
    """
    rows: list[Row] = []
    for part in parts:
        start = time.monotonic()
        for row in run_part(part, setup, scale * choose_time_limit(part, setup), scale * ITEM_SECONDS.get(part, inf)):
            rows.append({"part": part, **row})
            print(_format_row(rows[-1]), flush=True)
            report(rows)
        seconds = time.monotonic() - start
        rows.append({"table": "Time taken", "part": part, "item": "", "what": part, "seconds": round(seconds, 1)})
        report(rows)
    return rows


def choose_time_limit(part: str, setup: Setup) -> float:
    """Return the time limit of a part in seconds."""
    return CHECK_PARTS[part][1] + (setup.full_run_seconds if part == "full-run" else 0.0)


def run_part(part: str, setup: Setup, seconds: float, item_seconds: float) -> Iterator[Row]:
    """Yield the rows of one part; `seconds` is its time limit, and `item_seconds` that of each of its items."""
    try:
        module = importlib.import_module(CHECK_PARTS[part][0])
        items = module.items(setup)
    except Exception as error:  # if a module is missing or broken, the other parts still run
        yield {"item": "", **failure_row(error)}
        return

    def command(remaining: list[str]) -> list[str]:
        return [sys.executable, "-m", "tools.gpu.check", "--worker", part, setup.to_json(), *remaining]

    yield from run_in_children(command, items, seconds, item_seconds, getattr(module, "SELF_TIMED_ITEMS", ()))


def run_child_items(part: str, setup: Setup, items: Sequence[str]) -> int:
    """Run the items of a part in the child process (see `worker`); return the exit code."""
    module = importlib.import_module(CHECK_PARTS[part][0])
    from hyrfpack.self_test.worker import is_usable

    return run_child(lambda item: module.run(item, setup), items, lambda: is_usable(setup.torch_device))


def choose_report_path(folder: Path, device: str, parts: Sequence[str]) -> Path:
    """Return the page of a check, named by the machine and by its parts unless they are the default ones.

    So a check of some parts leaves the machine's full report as it is.
    """
    chosen = [part for part in CHECK_PARTS if part in parts]
    suffix = [] if chosen == list(DEFAULT_PARTS) else chosen
    return folder / f"{'-'.join([make_file_name(device), *suffix])}.md"


def main(arguments: list[str] | None = None) -> int:
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments[:1] == ["--worker"]:
        return run_child_items(arguments[1], Setup.from_json(arguments[2]), arguments[3:])
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--parts",
        nargs="+",
        choices=list(CHECK_PARTS),
        default=list(DEFAULT_PARTS),
        help="parts to run (all but quality, ranks and full-run)",
    )
    parser.add_argument(
        "--out", type=Path, default=REPOSITORY_ROOT / "docs" / "gpu", help="folder for results (docs/gpu)"
    )
    parser.add_argument("--data", type=Path, help="a real data set to train on, or a folder of data sets")
    parser.add_argument("--commit", help="the commit that is checked, for a copy of the repository without .git")
    parser.add_argument(
        "--full-run-seconds", type=float, default=FULL_RUN_SECONDS, help="seconds for the full run (240)"
    )
    parser.add_argument("--long", action="store_true", help="triple the time limits of timing and training")
    args = parser.parse_args(arguments)
    if not torch.cuda.is_available():
        print(f"tools.gpu.check: {NO_GPU}", file=sys.stderr)
        return 2
    if args.data and find_dataset(args.data, None, args.data) is None:
        parser.error(f"--data {args.data}: there is no data set; name a data set, or a folder of data sets")
    data = find_dataset(args.data, os.environ.get("HYRFPACK_DATA"), REPOSITORY_ROOT.parent / "shared" / "data")
    setup = replace(Setup(data=None if data is None else str(data)), logs=str((args.out / LOGS_FOLDER).absolute()))
    setup = replace(setup, full_run_seconds=args.full_run_seconds)
    if args.long:
        setup = replace(setup, step_seconds=3 * setup.step_seconds, quality_seconds=3 * setup.quality_seconds)
    facts = describe_gpu_machine(setup.torch_device, args.commit)
    setup = replace(setup, commit=str(facts["commit"]))
    print(format_machine(facts), flush=True)

    page = choose_report_path(args.out, str(facts["device"]), args.parts)

    def report(rows: Sequence[Row]) -> None:
        write_report(page, facts, asdict(setup), rows)

    report([])  # the machine's description remains even if the first part takes all the time
    rows = check(args.parts, setup, 3.0 if args.long else 1.0, report)
    failed = [row for row in rows if row.get("status") == "failed"]
    print(f"{page}: {len(rows)} rows, {len(failed)} failed")
    return 1 if failed else 0


def _format_row(row: Row) -> str:
    cells = [f"{key} {value:.4g}" if isinstance(value, float) else f"{key} {value}" for key, value in row.items()]
    return "  ".join(cells)


if __name__ == "__main__":
    sys.exit(main())

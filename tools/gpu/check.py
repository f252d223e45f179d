"""Checks and measures hyrfpack's GPU kernels on this machine, and writes what came out: in thirteen minutes at most.

    python -m tools.gpu.check                          everything; docs/gpu/<machine>.json and .md
    python -m tools.gpu.check --parts tests kernels    some of it
    python -m tools.gpu.check --out runs/gpu --data ../shared/data/mipnerf360_bonsai

It needs a GPU, torch with Triton, and numpy, and hyrfpack need not be installed. Tests also need pytest, and training,
in the last two parts, pillow, rich and scipy, and on the CPU Numba; what cannot be done is left out, with its reason.
The parts:

    tests     a matrix of random cases against the float64 reference, and the tests marked "gpu"
    kernels   each operation by itself: time, roofline, error
    frames    whole frames, training steps and gsplat, with 100,000 to 3 million Gaussians
    quality   the same training on the CPU and on the GPU: held-out PSNR

Exit code 0 when every check passed, 1 when one failed, 2 when there is no GPU. A goal that is missed is no failure.
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path

# torch's own threads, on the CPU, would go on spinning on the cores of the kernels timed next.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import torch

from hyrfpack.measure.machine import format_machine
from tools.gpu.report import machine, write
from tools.gpu.rows import Row
from tools.gpu.setup import Setup, find_set
from tools.gpu.worker import failure, run_items, work

ROOT = Path(__file__).parents[2]
# Part -> the module that has `items(setup)` and `run(item, setup)`, and the seconds that all its items may take. Those
# of the tests leave room for 140 kernels that are built for the first time, at up to a second each.
PARTS = {
    "tests": ("tools.gpu.tests", 300.0),
    "kernels": ("tools.gpu.kernels", 90.0),
    "frames": ("tools.gpu.frames", 200.0),
    "quality": ("tools.gpu.quality", 170.0),
}
NO_GPU = "torch finds no GPU here, so nothing was checked; run this on a machine with a CUDA or ROCm GPU"


def check(parts: Sequence[str], setup: Setup, scale: float = 1.0) -> list[Row]:
    """Run the parts, each in processes of its own; prints a line for each item and returns all rows.

    Args:
        scale: of the parts' time limits.
    """
    rows: list[Row] = []
    for part in parts:
        start = time.monotonic()
        for row in run_part(part, setup, scale * PARTS[part][1]):
            rows.append({"part": part, **row})
            print(_line(rows[-1]), flush=True)
        seconds = time.monotonic() - start
        rows.append({"table": "Time taken", "part": part, "item": "", "what": part, "seconds": round(seconds, 1)})
    return rows


def run_part(part: str, setup: Setup, seconds: float) -> Iterator[Row]:
    """Rows of one part."""
    try:
        items = importlib.import_module(PARTS[part][0]).items(setup)
    except Exception as error:  # a module that is missing, or broken: the other parts still run
        yield {"item": "", **failure(error)}
        return

    def command(left: list[str]) -> list[str]:
        return [sys.executable, "-m", "tools.gpu.check", "--worker", part, setup.to_json(), *left]

    yield from run_items(command, items, seconds)


def do_items(part: str, setup: Setup, items: Sequence[str]) -> int:
    """What a child process does; see `worker`."""
    module = importlib.import_module(PARTS[part][0])
    return work(lambda item: module.run(item, setup), items, lambda: _is_usable(setup.torch_device))


def main(arguments: list[str] | None = None) -> int:
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments[:1] == ["--worker"]:
        return do_items(arguments[1], Setup.from_json(arguments[2]), arguments[3:])
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="+", choices=list(PARTS), default=list(PARTS), help="default: all")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "gpu", help="folder for results (docs/gpu)")
    parser.add_argument("--data", type=Path, help="a real set to train on, or a folder of sets")
    parser.add_argument("--long", action="store_true", help="time and train for three times as long")
    asked = parser.parse_args(arguments)
    if not torch.cuda.is_available():
        print(f"tools.gpu.check: {NO_GPU}", file=sys.stderr)
        return 2
    data = find_set(asked.data, os.environ.get("HYRFPACK_DATA"), ROOT.parent / "shared" / "data")
    setup = Setup(data=None if data is None else str(data))
    if asked.long:
        setup = replace(setup, step_seconds=3 * setup.step_seconds, quality_seconds=3 * setup.quality_seconds)
    facts = machine(setup.torch_device)
    print(format_machine(facts), flush=True)
    rows = check(asked.parts, setup, 3.0 if asked.long else 1.0)
    page = write(asked.out, facts, asdict(setup), rows)
    failed = [row for row in rows if row.get("status") == "failed"]
    print(f"{page}: {len(rows)} rows, {len(failed)} failed")
    return 1 if failed else 0


def _line(row: Row) -> str:
    cells = [f"{key} {value:.4g}" if isinstance(value, float) else f"{key} {value}" for key, value in row.items()]
    return "  ".join(cells)


def _is_usable(device: torch.device) -> bool:
    """Whether the device still answers: an illegal access ends that for the whole process."""
    try:
        torch.ones(1, device=device).item()
    except RuntimeError:
        return False
    return True


if __name__ == "__main__":
    sys.exit(main())

"""Compare training on one process with training on several, over the same number of photos.

    python -m tools.studies.processes --sets gerrard_hall indoor_room --steps 2000 --processes 1 2 4

Each process has one thread. The table has PSNR in dB and SSIM on held-out photos with their differences from one
process, seconds, and the share of time waiting for other processes. Parallel efficiency is W0 T0 / (W T) for
the first number W0 of processes, which takes T0 seconds, and W processes, which take T. It is meaningful only if each
process has its own core.

The results are in docs/research/scaling.md.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from hyrfpack.errors import HyrfError
from tools.command import positive_integer, run_command
from tools.studies.reuse import describe_origin, remove_outdated
from tools.studies.train_sets import DATA_FOLDER
from tools.tables import markdown_table


def train(data: Path, out: Path, processes: int, options: Sequence[str]) -> dict:
    """Train with several processes unless this version has made the run; return its metrics.

    Raises:
        HyrfError: training failed. Its messages went to standard error.
    """
    remove_outdated(out, describe_origin(data, processes=processes, options=list(options)))
    if not (out / "metrics.json").exists():
        command = [sys.executable, "-m", "hyrfpack", "train", str(data), "-o", str(out), "--processes", str(processes)]
        environment = {**os.environ, "HYRFPACK_THREADS": "1", "OMP_NUM_THREADS": "1"}
        command += [*options, "--overwrite", "--quiet"]
        process = subprocess.run(command, check=False, env=environment, stdout=subprocess.DEVNULL)
        if process.returncode:
            problem = f"{data}: training with {processes} processes ended with exit code {process.returncode}"
            raise HyrfError(problem, fix="see its messages above")
    return json.loads((out / "metrics.json").read_text())


def format_row(name: str, processes: int, metrics: dict, baseline_processes: int, baseline: dict) -> list[str]:
    """Format the row of a run, compared with the metrics of a baseline: the run on the first number of processes."""
    speedup = baseline["seconds"] / metrics["seconds"]
    scores, first = metrics["evaluation"], baseline["evaluation"]
    exchange = metrics["stage_seconds"].get("exchange", 0.0)
    return [
        name,
        str(processes),
        f"{metrics['gaussians']:,}",
        f"{scores['psnr']:.2f} ({scores['psnr'] - first['psnr']:+.2f})",
        f"{scores['ssim']:.4f} ({scores['ssim'] - first['ssim']:+.4f})",
        f"{metrics['seconds']:.0f}",
        f"{exchange / metrics['seconds']:.1%}",
        f"{speedup * baseline_processes / processes:.2f}",
    ]


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=DATA_FOLDER, help="folder of the data sets")
    parser.add_argument("--sets", nargs="+", required=True, help="folders below --data")
    parser.add_argument("--steps", type=positive_integer, default=2000, help="photos of all processes together (2,000)")
    parser.add_argument(
        "--processes", type=positive_integer, nargs="+", default=[1, 2, 4], help="numbers of processes (1 2 4)"
    )
    parser.add_argument("--seed", type=int, default=0, help="random seed (0)")
    parser.add_argument("--out", type=Path, default=Path("runs/processes"), help="folder for runs (runs/processes)")
    options = parser.parse_args(arguments)
    rows = []
    for name in options.sets:
        results_by_count = {
            count: train(
                options.data / name,
                options.out / f"{name}-{options.steps}-{options.seed}-{count}",
                count,
                ["--steps", str(options.steps), "--seed", str(options.seed)],
            )
            for count in options.processes
        }
        first = options.processes[0]
        rows += [
            format_row(name, count, metrics, first, results_by_count[first])
            for count, metrics in results_by_count.items()
        ]
        print(" | ".join(rows[-1]), file=sys.stderr)
    header = ["set", "processes", "Gaussians", "PSNR", "SSIM", "seconds", "waiting for others", "parallel efficiency"]
    print(markdown_table(header, rows))


if __name__ == "__main__":
    run_command(main)

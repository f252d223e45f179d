"""Trains sets on one process and on several, over equally many photos: what is lost, and what a photo takes.

    python -m tools.studies.processes --sets gerrard_hall indoor_room --steps 2000 --processes 1 2 4

Each process has one thread. PSNR and SSIM are of held-out photos. "Of the ideal" is the seconds of one process
over W times those of W; it means something only where each process has a core of its own.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from tools.studies.train_sets import DATA
from tools.tables import markdown_table


def trained(data: Path, out: Path, processes: int, options: Sequence[str]) -> dict:
    """What a run came to, from its metrics; one that is there is not repeated."""
    if not (out / "metrics.json").exists():
        command = [sys.executable, "-m", "hyrfpack", "train", str(data), "-o", str(out), "--processes", str(processes)]
        alone = {**os.environ, "HYRFPACK_THREADS": "1", "OMP_NUM_THREADS": "1"}
        subprocess.run([*command, *options, "--overwrite", "--quiet"], check=True, env=alone, stdout=subprocess.DEVNULL)
    return json.loads((out / "metrics.json").read_text())


def row(name: str, processes: int, metrics: dict, alone: dict) -> list[str]:
    """A run beside that of one process."""
    scores, first = metrics["evaluation"], alone["evaluation"]
    exchange = metrics["stage_seconds"].get("exchange", 0.0)
    return [
        name,
        str(processes),
        f"{metrics['gaussians']:,}",
        f"{scores['psnr']:.2f} ({scores['psnr'] - first['psnr']:+.2f})",
        f"{scores['ssim']:.4f} ({scores['ssim'] - first['ssim']:+.4f})",
        f"{metrics['seconds']:.0f}",
        f"{exchange / metrics['seconds']:.1%}",
        f"{alone['seconds'] / metrics['seconds'] / processes:.2f}",
    ]


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--sets", nargs="+", required=True)
    parser.add_argument("--steps", type=int, default=2000, help="photos, of all processes together")
    parser.add_argument("--processes", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("runs/processes"))
    options = parser.parse_args(arguments)
    rows = []
    for name in options.sets:
        runs = {
            count: trained(
                options.data / name,
                options.out / f"{name}-{options.seed}-{count}",
                count,
                ["--steps", str(options.steps), "--seed", str(options.seed)],
            )
            for count in options.processes
        }
        rows += [row(name, count, metrics, runs[options.processes[0]]) for count, metrics in runs.items()]
        print(" | ".join(rows[-1]), file=sys.stderr)
    header = ["set", "processes", "Gaussians", "PSNR", "SSIM", "seconds", "waiting for others", "of the ideal"]
    print(markdown_table(header, rows))


if __name__ == "__main__":
    main()

"""Measure how well `hyrfpack make --minutes` keeps its time limit on several data sets.

    python -m tools.studies.time_limit                                            5 minutes on each of four sets
    python -m tools.studies.time_limit --minutes 3 --sets llff_fern --bare        photos alone: poses are estimated

Each row is one command in its own process. The table has the time limit and the duration in minutes, training steps,
the photos' longest side in pixels, PSNR in dB, and seconds of each stage. Nothing else should run on the machine.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tools.studies.train_sets import DATA_FOLDER
from tools.tables import markdown_row, markdown_table

DEFAULT_SETS = ("mipnerf360_bonsai", "gerrard_hall", "llff_fern", "indoor_room")
TABLE_COLUMNS = (
    "set",
    "minutes asked",
    "minutes taken",
    "off",
    "steps",
    "longest side",
    "PSNR",
    "seconds of each stage",
)


def measure(photos: Path, minutes: float, folder: Path) -> list[str]:
    """Run one command and return its row of the table."""
    command = [sys.executable, "-m", "hyrfpack", "--quiet", "make", str(photos), "-o", str(folder / "scene.html")]
    started = time.monotonic()
    process = subprocess.run(
        [*command, "--minutes", str(minutes), "--json"], capture_output=True, text=True, check=False
    )
    minutes_taken = (time.monotonic() - started) / 60
    if process.returncode:
        raise SystemExit(process.stderr)
    result = json.loads(process.stdout)
    plan = json.loads((folder / "scene.work" / "make.json").read_text())["stages"]["training"]["inputs"]
    longest_side = max(max(size) for size in plan["size of photos"])
    stages = ", ".join(f"{stage} {seconds:.0f}" for stage, seconds in result["seconds"].items())
    psnr = "" if result["psnr"] is None else f"{result['psnr']:.2f}"
    cells = [
        f"{minutes:g}",
        f"{minutes_taken:.2f}",
        f"{minutes_taken / minutes - 1:+.0%}",
        f"{result['training']['steps']:,}",
    ]
    return [photos.parent.name if photos.name == "images" else photos.name, *cells, f"{longest_side}", psnr, stages]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=5.0, help="time limit of each command in minutes (5)")
    parser.add_argument(
        "--sets", nargs="+", default=DEFAULT_SETS, help=f"data sets: folders below --data ({', '.join(DEFAULT_SETS)})"
    )
    parser.add_argument("--data", type=Path, default=DATA_FOLDER, help=f"folder of the data sets ({DATA_FOLDER})")
    parser.add_argument("--bare", action="store_true", help="use only the photos, so that poses are estimated")
    args = parser.parse_args()
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}\n\n{markdown_table(TABLE_COLUMNS, [])}", flush=True)
    for name in args.sets:
        with tempfile.TemporaryDirectory(prefix="hyrfpack-minutes-") as folder:
            photos = args.data / name / "images" if args.bare else args.data / name
            print(markdown_row(measure(photos, args.minutes, Path(folder))), flush=True)


if __name__ == "__main__":
    main()

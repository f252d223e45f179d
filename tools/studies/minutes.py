"""How well `hyrfpack make --minutes` keeps its time: asked for and taken, on several sets.

    python -m tools.studies.minutes                                            5 minutes on each of four sets
    python -m tools.studies.minutes --minutes 3 --sets llff_fern --bare        photos alone: poses are estimated

Each row is one command in a process of its own, as a person would give it, on a machine that should do nothing else.
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

from tools.studies.train_sets import DATA
from tools.tables import markdown_row, markdown_table

SETS = ("mipnerf360_bonsai", "gerrard_hall", "llff_fern", "indoor_room")
COLUMNS = ("set", "minutes asked", "minutes taken", "off", "steps", "longest side", "PSNR", "seconds of each stage")


def measure(photos: Path, minutes: float, folder: Path) -> list[str]:
    """A row of the table."""
    command = [sys.executable, "-m", "hyrfpack", "--quiet", "make", str(photos), "-o", str(folder / "scene.html")]
    began = time.monotonic()
    done = subprocess.run([*command, "--minutes", str(minutes), "--json"], capture_output=True, text=True, check=False)
    taken = (time.monotonic() - began) / 60
    if done.returncode:
        raise SystemExit(done.stderr)
    result = json.loads(done.stdout)
    plan = json.loads((folder / "scene.work" / "make.json").read_text())["stages"]["training"]["inputs"]
    longest = max(max(size) for size in plan["size of photos"])
    stages = ", ".join(f"{stage} {seconds:.0f}" for stage, seconds in result["seconds"].items())
    psnr = "" if result["psnr"] is None else f"{result['psnr']:.2f}"
    cells = [f"{minutes:g}", f"{taken:.2f}", f"{taken / minutes - 1:+.0%}", f"{result['training']['steps']:,}"]
    return [photos.parent.name if photos.name == "images" else photos.name, *cells, f"{longest}", psnr, stages]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=5.0, help="to ask for (5)")
    parser.add_argument("--sets", nargs="+", default=SETS, help=f"folders below --data ({', '.join(SETS)})")
    parser.add_argument("--data", type=Path, default=DATA, help=f"where the sets are ({DATA})")
    parser.add_argument("--bare", action="store_true", help="take the photos alone, so that poses are estimated")
    args = parser.parse_args()
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}\n\n{markdown_table(COLUMNS, [])}", flush=True)
    for name in args.sets:
        with tempfile.TemporaryDirectory(prefix="hyrfpack-minutes-") as folder:
            photos = args.data / name / "images" if args.bare else args.data / name
            print(markdown_row(measure(photos, args.minutes, Path(folder))), flush=True)


if __name__ == "__main__":
    main()

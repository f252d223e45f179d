"""Trains real sets and prints one table: quality, bytes of each profile, what compression lost, speed.

    python -m tools.studies.train_sets --steps 1000                            every set below ../shared/data
    python -m tools.studies.train_sets --steps 2000 --sets mipnerf360_bonsai gerrard_hall

    python -m tools.studies.train_sets --sets mipnerf360_bonsai@25              25 of its photos (`variants.py`)

Scores are on held-out views (every 8th; Blender-style sets their own split) of the files as decoded from disk.
Runs stay in --out (default runs/sets/<steps>), so a second call with --reuse only measures.
"""

from __future__ import annotations

import argparse
import json
import os
import time
import warnings
from collections.abc import Sequence
from pathlib import Path

import hyrfpack
from hyrfpack.train import TrainConfig
from tools.studies.variants import load_variant
from tools.tables import markdown_table

PROFILES = ("paper", "compact")
DATA = Path(os.environ.get("HYRFPACK_DATA") or Path(__file__).parents[3] / "shared" / "data")


def measure(data: Path, name: str, out: Path, config: TrainConfig, reuse: bool) -> dict:
    """Train one set, compress it with each profile that loses something, score all files."""
    scene = load_variant(data, name)
    if not (reuse and (out / "metrics.json").exists()):
        hyrfpack.train_model(scene, out, config, overwrite=True)
    trained = json.loads((out / "metrics.json").read_text())
    model = out / "model.hyrf"
    packed = {}
    for profile in PROFILES:
        path = out / f"{profile}.hyrf"
        began = time.perf_counter()
        hyrfpack.compress_model(model, path, profile=profile)
        seconds = time.perf_counter() - began
        scores = hyrfpack.evaluate_model(hyrfpack.load_model(path), scene.test)
        packed |= {f"psnr_{profile}": scores.psnr, f"ssim_{profile}": scores.ssim}
        packed |= {f"bytes_{profile}": path.stat().st_size, f"seconds_{profile}": seconds}
    raw = trained["evaluation"]
    return {
        "set": name,
        "steps": config.steps,
        "psnr": raw["psnr"],
        "ssim": raw["ssim"],
        "gaussians": trained["gaussians"],
        "bytes_raw": model.stat().st_size,
        **packed,
        "steps_per_second": trained["steps_per_second"],
        "seconds": trained["seconds"],
        "frame_ms": 1000 * scores.seconds_per_frame,
        "preset": trained["choices"]["preset"].split(":")[0],
    }


def table(rows: list[dict]) -> str:
    """The rows as Markdown."""
    header = ["set", "preset", "PSNR", "SSIM", "Gaussians", "raw bytes"]
    for profile in PROFILES:
        header += [f"{profile} bytes", "loss", "s"]
    header += ["compact / paper", "steps/s", "train s", "frame ms"]
    lines = []
    for r in rows:
        cells = [r["set"], r["preset"], f"{r['psnr']:.2f}", f"{r['ssim']:.3f}", f"{r['gaussians']:,}"]
        cells.append(f"{r['bytes_raw']:,}")
        for profile in PROFILES:
            loss = r["psnr"] - r[f"psnr_{profile}"]
            cells += [f"{r[f'bytes_{profile}']:,}", f"{loss:.3f} dB", f"{r[f'seconds_{profile}']:.1f}"]
        cells += [f"{r['bytes_compact'] / r['bytes_paper']:.2f}", f"{r['steps_per_second']:.1f}"]
        cells += [f"{r['seconds']:.0f}", f"{r['frame_ms']:.1f}"]
        lines.append(cells)
    return markdown_table(header, lines)


def study_arguments(
    text: str, steps: int, sets: Sequence[str], out: Path, seeds: bool = True
) -> argparse.ArgumentParser:
    """The options of a study that trains variants on sets; `text` is its help, the rest are defaults.

    With `seeds` False every run has one seed, and there is no such option.
    """
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=steps, help=f"of each run ({steps:,})")
    parser.add_argument("--sets", nargs="*", default=list(sets), help=f"folders below --data ({' '.join(sets)})")
    if seeds:
        parser.add_argument("--seeds", type=int, default=2, help="runs of each row and set, with seeds from 0 (2)")
    parser.add_argument("--data", type=Path, default=DATA, help="where the sets are")
    parser.add_argument("--out", type=Path, default=out, help=f"folder for results ({out})")
    parser.add_argument("--only", nargs="*", help="parts of the names of the rows wanted")
    return parser


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--sets", nargs="*", help="below --data, or variants (`variants.py`); default all that load")
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--exposure", action=argparse.BooleanOptionalAction, help="learn per-image gains, or not (default: pilot runs)"
    )
    parser.add_argument("--reuse", action="store_true", help="do not train again what --out already holds")
    args = parser.parse_args()
    out = args.out or Path("runs/sets") / str(args.steps)
    names = args.sets or sorted(
        folder.name for folder in args.data.iterdir() if (folder / "images").exists() or (folder / "train").exists()
    )
    warnings.simplefilter("error")  # a run that warns has not passed
    config = TrainConfig(steps=args.steps, seed=args.seed, exposure=args.exposure)
    rows = []
    for name in names:
        rows.append(measure(args.data, name, out / name, config, args.reuse))
        print(table(rows[-1:]).splitlines()[-1], flush=True)
        out.mkdir(parents=True, exist_ok=True)
        (out / "table.json").write_text(json.dumps(rows, indent=1))
    print("\n" + table(rows))


if __name__ == "__main__":
    main()

"""Trains real sets and prints one table: quality, bytes of each profile, what compression lost, speed.

    python tools/train_sets.py --steps 1000                            every set below ../shared/data
    python tools/train_sets.py --steps 2000 --sets mipnerf360_bonsai gerrard_hall

Scores are on held-out views (every 8th; Blender-style sets their own split) of the files as decoded from disk.
Runs stay in --out (default runs/sets/<steps>), so a second call with --reuse only measures.
"""

from __future__ import annotations

import argparse
import json
import os
import warnings
from collections.abc import Sequence
from pathlib import Path

import hyrfpack
from hyrfpack.train import TrainConfig

DATA = Path(os.environ.get("HYRFPACK_DATA") or Path(__file__).parents[2] / "shared" / "data")


def measure(folder: Path, out: Path, config: TrainConfig, reuse: bool) -> dict:
    """Train one set, compress it with the paper profile, score both files."""
    scene = hyrfpack.load_scene(folder)
    if not (reuse and (out / "metrics.json").exists()):
        hyrfpack.train(scene, out, config, overwrite=True)
    trained = json.loads((out / "metrics.json").read_text())
    model, packed = out / "model.hyrf", out / "paper.hyrf"
    hyrfpack.compress(model, packed, profile="paper")
    scores = hyrfpack.evaluate(hyrfpack.load(packed), scene.test)
    raw = trained["evaluation"]
    return {
        "set": folder.name,
        "steps": config.steps,
        "psnr": raw["psnr"],
        "ssim": raw["ssim"],
        "psnr_paper": scores.psnr,
        "ssim_paper": scores.ssim,
        "gaussians": trained["gaussians"],
        "bytes_raw": model.stat().st_size,
        "bytes_paper": packed.stat().st_size,
        "steps_per_second": trained["steps_per_second"],
        "seconds": trained["seconds"],
        "frame_ms": 1000 * scores.seconds_per_frame,
        "preset": trained["choices"]["preset"].split(":")[0],
    }


def table(rows: list[dict]) -> str:
    """The rows as Markdown."""
    lines = [
        "| set | preset | PSNR | SSIM | Gaussians | raw bytes | paper bytes | loss | steps/s | train s | frame ms |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {r['set']} | {r['preset']} | {r['psnr']:.2f} | {r['ssim']:.3f} | {r['gaussians']:,} | {r['bytes_raw']:,} | "
        f"{r['bytes_paper']:,} | {r['psnr'] - r['psnr_paper']:.3f} dB | {r['steps_per_second']:.1f} | "
        f"{r['seconds']:.0f} | {r['frame_ms']:.1f} |"
        for r in rows
    ]
    return "\n".join(lines)


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
    parser.add_argument("--sets", nargs="*", help="folder names below the data folder; default all that load")
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--reuse", action="store_true", help="do not train again what --out already holds")
    args = parser.parse_args()
    out = args.out or Path("runs/sets") / str(args.steps)
    names = args.sets or sorted(
        folder.name for folder in args.data.iterdir() if (folder / "images").exists() or (folder / "train").exists()
    )
    warnings.simplefilter("error")  # a run that warns has not passed
    rows = []
    for name in names:
        rows.append(measure(args.data / name, out / name, TrainConfig(steps=args.steps), args.reuse))
        print(table(rows[-1:]).splitlines()[-1], flush=True)
        out.mkdir(parents=True, exist_ok=True)
        (out / "table.json").write_text(json.dumps(rows, indent=1))
    print("\n" + table(rows))


if __name__ == "__main__":
    main()

"""Train real data sets and print one table: quality, bytes of each profile, PSNR lost by compression, and speed.

    python -m tools.studies.train_sets --steps 1000                            every set below ../shared/data
    python -m tools.studies.train_sets --steps 2000 --sets mipnerf360_bonsai gerrard_hall

    python -m tools.studies.train_sets --sets mipnerf360_bonsai@25              25 of its photos (`set_variants.py`)

The columns are PSNR in dB, SSIM, numbers of Gaussians, bytes, losses in dB, seconds of compression, training steps per
second, training seconds, and ms per frame. Scores are those of the decoded files on held-out views (every 8th;
Blender-style sets have their own split). Runs are kept in --out (runs/sets/<steps>), and --reuse only measures
those. It refuses runs of another version, data set or configuration. A file table.json there has the rows of all sets.

The results are in docs/research/quality.md.
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
from hyrfpack.errors import HyrfError
from hyrfpack.train import TrainConfig
from tools.command import positive_integer, run_command
from tools.json_files import merge_rows
from tools.studies.complete_run import train_completely
from tools.studies.reuse import ORIGIN_FILE, check_origin, describe_origin, write_origin
from tools.studies.set_variants import load_variant
from tools.tables import markdown_table

COMPRESSED_PROFILES = ("paper", "compact")
DATA_FOLDER = Path(os.environ.get("HYRFPACK_DATA") or Path(__file__).parents[3] / "shared" / "data")


def list_sets(data: Path) -> list[str]:
    """Return the names of all data sets in a folder, sorted.

    Raises:
        HyrfError: there is no data set.
    """
    folders = sorted(data.iterdir()) if data.is_dir() else []
    names = [folder.name for folder in folders if (folder / "images").exists() or (folder / "train").exists()]
    if not names:
        fix = "name the folder of the data sets with `data`, or in the environment variable HYRFPACK_DATA"
        raise HyrfError(f"{data}: there are no data sets", fix=fix)
    return names


def choose_names(requested: Sequence[str] | None, available: Sequence[str], problem: str, fix: str) -> list[str]:
    """Return the requested names of data sets, or all available ones if none is requested.

    Args:
        requested: names from the command line.
        available: the names that a study can measure.
        problem: the problem text of the error, without the missing names.
        fix: what to do next.

    Raises:
        HyrfError: a requested name is not available, or there are no names at all.
    """
    if missing := sorted(set(requested or ()) - set(available)):
        raise HyrfError(f"{problem}: {', '.join(missing)}", fix=fix)
    if not available:
        raise HyrfError(problem, fix=fix)
    return list(requested or available)


def measure(data: Path, name: str, out: Path, config: TrainConfig, reuse: bool) -> dict:
    """Train one data set, compress the model with each lossy profile, and score all files; return the row.

    Raises:
        HyrfError: with `reuse`, the run in `out` is of another version, data set or configuration.
    """
    scene = load_variant(data, name)
    origin = describe_origin(data / name, **config.to_dict())
    if reuse and (out / "metrics.json").exists():
        check_origin(out, origin)
    else:
        (out / ORIGIN_FILE).unlink(missing_ok=True)
        train_completely(scene, out, config)
        write_origin(out, origin)
    trained = json.loads((out / "metrics.json").read_text())
    model = out / "model.hyrf"
    packed: dict[str, float] = {}
    for profile in COMPRESSED_PROFILES:
        path = out / f"{profile}.hyrf"
        started = time.perf_counter()
        hyrfpack.compress_model(model, path, hyrfpack.CompressConfig(profile=profile))
        seconds = time.perf_counter() - started
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


def format_table(rows: list[dict]) -> str:
    """Format the rows as a Markdown table."""
    header = ["set", "preset", "PSNR", "SSIM", "Gaussians", "raw bytes"]
    for profile in COMPRESSED_PROFILES:
        header += [f"{profile} bytes", "loss", "s"]
    header += ["compact / paper", "steps/s", "train s", "frame ms"]
    lines = []
    for row in rows:
        cells = [row["set"], row["preset"], f"{row['psnr']:.2f}", f"{row['ssim']:.3f}", f"{row['gaussians']:,}"]
        cells.append(f"{row['bytes_raw']:,}")
        for profile in COMPRESSED_PROFILES:
            loss = row["psnr"] - row[f"psnr_{profile}"]
            cells += [f"{row[f'bytes_{profile}']:,}", f"{loss:.3f} dB", f"{row[f'seconds_{profile}']:.1f}"]
        cells += [f"{row['bytes_compact'] / row['bytes_paper']:.2f}", f"{row['steps_per_second']:.1f}"]
        cells += [f"{row['seconds']:.0f}", f"{row['frame_ms']:.1f}"]
        lines.append(cells)
    return markdown_table(header, lines)


def make_study_parser(
    text: str, steps: int, sets: Sequence[str], out: Path, *, seeds: bool = True, only: bool = True
) -> argparse.ArgumentParser:
    """Return the parser of a study that trains variants on data sets.

    Args:
        text: the description.
        steps, sets, out: the defaults of --steps, --sets and --out.
        seeds: whether there is the option --seeds.
        only: whether there is the option --only, for a study whose rows have names.
    """
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=positive_integer, default=steps, help=f"training steps of each run ({steps:,})")
    parser.add_argument(
        "--sets", nargs="*", default=list(sets), help=f"data sets: folders below --data ({' '.join(sets)})"
    )
    if seeds:
        parser.add_argument(
            "--seeds", type=positive_integer, default=2, help="number of seeds for each row and data set (2)"
        )
    parser.add_argument("--data", type=Path, default=DATA_FOLDER, help="folder of the data sets")
    parser.add_argument("--out", type=Path, default=out, help=f"folder for results ({out})")
    if only:
        parser.add_argument("--only", nargs="*", help="run only rows whose names contain one of these words")
    return parser


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=positive_integer, default=1000, help="training steps (1,000)")
    parser.add_argument("--sets", nargs="*", help="folders below --data, or variants (`set_variants.py`); default: all")
    parser.add_argument("--data", type=Path, default=DATA_FOLDER, help="folder of the data sets")
    parser.add_argument("--out", type=Path, help="folder for runs (runs/sets/<steps>)")
    parser.add_argument("--seed", type=int, default=0, help="random seed (0)")
    parser.add_argument(
        "--exposure",
        action=argparse.BooleanOptionalAction,
        help="learn per-image gains or not (default: pilot runs decide)",
    )
    parser.add_argument(
        "--reuse", action="store_true", help="measure the runs that --out has, and train only missing ones"
    )
    args = parser.parse_args()
    out = args.out or Path("runs/sets") / str(args.steps)
    names = args.sets or list_sets(args.data)
    warnings.simplefilter("error")  # a run that warns is a failure
    config = TrainConfig(steps=args.steps, seed=args.seed, exposure=args.exposure)
    rows = []
    for name in names:
        rows.append(measure(args.data, name, out / name, config, args.reuse))
        print(format_table(rows[-1:]).splitlines()[-1], flush=True)
        merge_rows(out / "table.json", rows[-1:], keys=("set",))
    print("\n" + format_table(rows))


if __name__ == "__main__":
    run_command(main)

"""Train data sets at several numbers of steps, over several calls if needed, and print a table of all finished runs.

    python -m tools.studies.long_runs --steps 1000 3000 7000 30000 --sets drone_brighton_beach mipnerf360_bonsai@12
    python -m tools.studies.long_runs --steps 30000 --table                     only prints the table

Short runs come first. If a call is stopped, the next one resumes its run and does not repeat finished runs.
Runs of another version or data set are named, and neither resumed nor repeated. Several calls can share one queue,
because each run's folder is locked while it is trained and measured. --finetune adds a fine-tuned file also to finished
runs. The table has PSNR in dB and SSIM of the raw file on held-out photos, and the gap, which is PSNR on up to 16
training photos minus that. It also has bytes and scores of the compressed files as decoded from disk, and seconds of
training. Fewer steps are taken than asked for if pilot runs say so.

The results are in docs/research/long-runs.md, few-photos.md and quality.md.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import hyrfpack
from hyrfpack.errors import HyrfError
from hyrfpack.format.run_folder import METRICS_FILE, MODEL_FILE
from hyrfpack.lock import exclusive_folder
from hyrfpack.scene import Scene, evenly_spaced
from hyrfpack.train import TrainConfig
from hyrfpack.train.run import is_begun
from tools.command import positive_integer, run_command
from tools.json_files import write_json
from tools.studies.complete_run import train_completely
from tools.studies.reuse import check_origin, describe_origin, write_origin
from tools.studies.set_variants import load_variant
from tools.studies.train_sets import DATA_FOLDER, list_sets
from tools.tables import markdown_table

MEASUREMENT_FILE = "measured.json"
MAX_TRAINING_VIEWS_SCORED = 16
TABLE_COLUMNS = (
    "set", "steps", "taken", "seed", "gains", "PSNR", "SSIM", "gap", "Gaussians", "raw", "paper", "compact",
    "compact PSNR", "compact SSIM", "fine-tuned", "fine-tuned PSNR", "training s",
)  # fmt: skip


@dataclass(frozen=True)
class QueuedRun:
    """One training run of the queue."""

    name: str
    steps: int
    seed: int
    exposure: bool | None

    def folder(self, out: Path) -> Path:
        """Return the folder of the run below `out`."""
        gains = {None: "", True: "-gains", False: "-no-gains"}[self.exposure]
        return out / f"{self.steps}{gains}" / f"seed{self.seed}" / self.name


def measure(run: QueuedRun, data: Path, out: Path, finetune_steps: int) -> bool:
    """Train a run, resuming from its checkpoint if there is one, and write its row into its folder.

    A run that has a row only gets a fine-tuned file, and only if it is missing. Returns whether anything was done.

    Raises:
        HyrfError: the data set cannot be read, a file cannot be written, or another version has begun the run.
    """
    folder = run.folder(out)
    origin = describe_origin(data / run.name, **asdict(run))
    if is_begun(folder) or any((folder / name).exists() for name in (MEASUREMENT_FILE, METRICS_FILE)):
        check_origin(folder, origin)
    else:
        write_origin(folder, origin)
    if is_finished(folder, finetune_steps):
        return False
    scene = load_variant(data, run.name)
    if (folder / MEASUREMENT_FILE).exists():
        row = json.loads((folder / MEASUREMENT_FILE).read_text())
    else:
        row = _train_and_measure(run, scene, folder)
    if finetune_steps:
        tuned = _compress_and_score(folder, scene, "compact", finetune_steps)
        row["finetuned"] = {**tuned, "steps": finetune_steps}
    write_json(folder / MEASUREMENT_FILE, row)
    return True


def is_finished(folder: Path, finetune_steps: int) -> bool:
    """Return whether a run has its row and, with `finetune_steps`, a file that was fine-tuned for so many steps."""
    if not (folder / MEASUREMENT_FILE).exists():
        return False
    tuned = json.loads((folder / MEASUREMENT_FILE).read_text()).get("finetuned", {})
    return not finetune_steps or tuned.get("steps") == finetune_steps


def _train_and_measure(run: QueuedRun, scene: Scene, folder: Path) -> dict:
    """Train a run unless its metrics are there, compress and score it, and return its row."""
    if not (folder / METRICS_FILE).exists():
        config = TrainConfig(steps=run.steps, seed=run.seed, exposure=run.exposure)
        resume = is_begun(folder)
        train_completely(scene, folder, config, resume=resume, context=hyrfpack.RunContext(progress=None))
    metrics = json.loads((folder / METRICS_FILE).read_text())
    model = hyrfpack.load_model(folder / MODEL_FILE)
    training = hyrfpack.evaluate_model(model, evenly_spaced(scene.train, MAX_TRAINING_VIEWS_SCORED))
    return {
        **asdict(run),
        "gains": metrics["settings"]["exposure"],
        "steps_taken": metrics["settings"]["steps"],
        "psnr": metrics["evaluation"]["psnr"],
        "ssim": metrics["evaluation"]["ssim"],
        "training_psnr": training.psnr,
        "gaussians": metrics["gaussians"],
        "seconds": metrics["seconds"],
        "raw": {"bytes": (folder / MODEL_FILE).stat().st_size},
        "paper": _compress_and_score(folder, scene, "paper"),
        "compact": _compress_and_score(folder, scene, "compact"),
    }


def _compress_and_score(folder: Path, scene: Scene, profile: str, finetune_steps: int | None = None) -> dict:
    """Compress the run's model and score the file on the held-out photos."""
    path = folder / f"{'finetuned' if finetune_steps else profile}.hyrf"
    config = hyrfpack.CompressConfig(profile=profile, finetune_steps=finetune_steps)
    hyrfpack.compress_model(folder / MODEL_FILE, path, config, data=scene if finetune_steps else None)
    scores = hyrfpack.evaluate_model(hyrfpack.load_model(path), scene.test)
    return {"bytes": path.stat().st_size, "psnr": scores.psnr, "ssim": scores.ssim}


def read_finished_rows(out: Path) -> Iterator[dict]:
    """Yield the rows of all finished runs."""
    for path in sorted(out.glob(f"*/seed*/*/{MEASUREMENT_FILE}")):
        yield json.loads(path.read_text())


def format_table(rows: list[dict]) -> str:
    """Return the rows as Markdown, by set, length and seed."""
    lines = []
    for row in sorted(rows, key=lambda row: (row["name"], row["steps"], row["seed"], str(row["exposure"]))):
        tuned = row.get("finetuned")
        lines.append(
            [
                row["name"],
                f"{row['steps']:,}",
                f"{row['steps_taken']:,}",
                str(row["seed"]),
                "yes" if row["gains"] else "no",
                f"{row['psnr']:.2f}",
                f"{row['ssim']:.3f}",
                f"{row['training_psnr'] - row['psnr']:.1f}",
                f"{row['gaussians']:,}",
                *(f"{row[profile]['bytes']:,}" for profile in ("raw", "paper", "compact")),
                f"{row['compact']['psnr']:.2f}",
                f"{row['compact']['ssim']:.3f}",
                f"{tuned['bytes']:,}" if tuned else "",
                f"{tuned['psnr']:.2f}" if tuned else "",
                f"{row['seconds']:.0f}",
            ]
        )
    return markdown_table(TABLE_COLUMNS, lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--steps",
        type=positive_integer,
        nargs="+",
        default=[1000, 3000, 7000, 15000, 30000],
        help="numbers of training steps (1000 3000 7000 15000 30000)",
    )
    parser.add_argument("--sets", nargs="+", help="folders below --data, or variants (`set_variants.py`); default: all")
    parser.add_argument(
        "--seeds", type=positive_integer, default=1, help="number of seeds for each data set and number of steps (1)"
    )
    parser.add_argument(
        "--exposure",
        action=argparse.BooleanOptionalAction,
        help="learn per-image gains or not (default: pilot runs decide)",
    )
    parser.add_argument("--finetune", type=int, default=0, help="steps of fine-tuning a further file; 0 for none (0)")
    parser.add_argument("--data", type=Path, default=DATA_FOLDER, help="folder of the data sets")
    parser.add_argument("--out", type=Path, default=Path("runs/long"), help="folder for runs (runs/long)")
    parser.add_argument("--table", action="store_true", help="only print the table")
    args = parser.parse_args()
    if args.table:
        print(format_table(list(read_finished_rows(args.out))))
        return
    names = args.sets or list_sets(args.data)
    queue = [
        QueuedRun(name, steps, seed, args.exposure)
        for steps in sorted(args.steps)
        for seed in range(args.seeds)
        for name in names
    ]
    for run in queue:
        folder = run.folder(args.out)
        lock = folder.with_name(f"{folder.name}.queue")  # training locks the folder itself
        try:
            with exclusive_folder(lock):
                started = time.strftime("%H:%M")
                if measure(run, args.data, args.out, args.finetune):
                    print(f"{started} to {time.strftime('%H:%M')}  {folder}", flush=True)
        except HyrfError as error:  # another call trains it, another version has, or the data set cannot be read
            print(f"{folder}: {error}", flush=True)
    print(format_table(list(read_finished_rows(args.out))))


if __name__ == "__main__":
    run_command(main)

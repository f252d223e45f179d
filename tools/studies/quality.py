"""This version against another one: bytes at equal PSNR, and PSNR at equal bytes, of compact files.

    git worktree add ../before 42597b1
    python -m tools.studies.quality --against ../before --steps 2000

Each set is trained with both versions at several budgets of Gaussians, as shares of this version's, by the command
line of each, and packed by it; both are scored by this version, on held-out photos, from the files as decoded, by PSNR
and SSIM of what `render` shows. Then for each set the difference in bytes at equal PSNR (Bjontegaard's, over the PSNR
that both reach, by monotone cubics through the points), and the difference in scores at the most bytes that both have.
A share of `measured` is the budget that a version takes by itself. Runs are kept below --out, and one that is there is
not trained again, nor scored again while its scores.json is there. The other version runs with this environment's
packages.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.interpolate import PchipInterpolator

import hyrfpack
from hyrfpack.scene import Scene
from hyrfpack.train import TrainConfig
from hyrfpack.train.setup import budget_for
from tools.studies.train_sets import study_arguments
from tools.tables import markdown_table

HERE = Path(__file__).parents[2]
SETS = (
    "drone_brighton_beach",
    "drone_caliterra",
    "gerrard_hall",
    "indoor_room",
    "kitti_street",
    "llff_fern",
    "mipnerf360_bonsai",
    "nerf_synthetic_lego",
    "ngp_fox",
    "shiny_can_nerfstudio",
    "specular_gold_cape",
    "street_lund",
)
MEASURED = "measured"
SCORES = ("bytes", "psnr", "ssim", "seconds", "gaussians")


def run(version: Path, scene: Scene, steps: int, gaussians: int | None, seed: int, out: Path) -> dict[str, float]:
    """Train and pack with one version, score with this one. Without a number of Gaussians, it chooses."""
    kept = out / "scores.json"
    if kept.exists():
        return json.loads(kept.read_text())
    if not (out / "metrics.json").exists():
        settings = ["--steps", str(steps), "--seed", str(seed), "--overwrite"]
        budget = [] if gaussians is None else ["--max-gaussians", str(gaussians)]
        _command(version, "train", str(scene.path), "-o", str(out), *settings, *budget)
    packed = out / "compact.hyrf"
    packed.unlink(missing_ok=True)
    _command(version, "compress", str(out / "model.hyrf"), "-o", str(packed))
    scores = hyrfpack.evaluate_model(hyrfpack.load_model(packed), scene.test)
    trained = json.loads((out / "metrics.json").read_text())
    found = {
        "bytes": packed.stat().st_size,
        "psnr": scores.psnr,
        "ssim": scores.ssim,
        "seconds": trained["seconds"],
        "gaussians": trained["gaussians"],
    }
    kept.write_text(json.dumps(found))
    return found


def _command(version: Path, command: str, *arguments: str) -> None:
    """Run a command of the package that lies in a folder."""
    environment = {**os.environ, "PYTHONPATH": str(version)}
    words = [sys.executable, "-m", "hyrfpack", command, *arguments]
    done = subprocess.run(words, env=environment, cwd=version, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{version}: {command} failed: {done.stderr.strip().splitlines()[-1]}")


def bytes_at_equal_psnr(ours: np.ndarray, theirs: np.ndarray) -> float | None:
    """Bjontegaard's difference in rate, as a share: -.3 is 30 % fewer bytes. None where no PSNR is reached by both.

    Args:
        ours, theirs: (n, 2) bytes and PSNR of the same model at n sizes.
    """
    low = max(points[:, 1].min() for points in (ours, theirs))
    high = min(points[:, 1].max() for points in (ours, theirs))
    if low >= high:
        return None
    means = []
    for points in (ours, theirs):
        rising = points[np.argsort(points[:, 0])]
        best = np.maximum.accumulate(rising[:, 1])  # a larger file that is worse would not be made
        kept = np.concatenate(([True], np.diff(best) > 0))
        if kept.sum() < 2:
            return None
        curve = PchipInterpolator(best[kept], np.log(rising[kept, 0]))
        means.append(curve.integrate(low, high) / (high - low))
    return float(np.exp(means[0] - means[1]) - 1)


def at_equal_bytes(ours: np.ndarray, theirs: np.ndarray) -> float:
    """How much more `ours` scores, at the most bytes that both have.

    Args:
        ours, theirs: (n, 2) bytes and score at n sizes.
    """
    size = np.log(min(points[:, 0].max() for points in (ours, theirs)))
    values = []
    for points in (ours, theirs):
        rising = points[np.argsort(points[:, 0])]
        values.append(np.interp(size, np.log(rising[:, 0]), rising[:, 1]))
    return float(values[0] - values[1])


def row(name: str, ours: list[dict[str, float]], theirs: list[dict[str, float]]) -> list[str]:
    """A line of the table: mean scores over seeds at each size."""
    curves = [{key: np.array([point[key] for point in points]) for key in SCORES} for points in (ours, theirs)]

    def pair(score: str) -> list[np.ndarray]:
        return [np.stack((curve["bytes"], curve[score]), 1) for curve in curves]

    saved = bytes_at_equal_psnr(*pair("psnr"))
    cells = [name, "" if saved is None else f"{100 * saved:+.0f} %"]
    cells += [f"{at_equal_bytes(*pair(score)):+.{digits}f}" for score, digits in _DIGITS.items()]
    cells.append(f"{np.sum(curves[0]['seconds']) / np.sum(curves[1]['seconds']):.2f}")
    for curve in curves[::-1]:
        points = zip(curve["bytes"], curve["psnr"], strict=True)
        cells.append(", ".join(f"{size / 1000:.0f}: {psnr:.2f}" for size, psnr in points))
    return cells


_DIGITS = {"psnr": 2, "ssim": 3}
_HEADER = ["set", "bytes at equal PSNR", "dB", "SSIM", "time", "before, kB: dB", "now, kB: dB"]


def mean_over_seeds(points: Sequence[dict[str, float]]) -> dict[str, float]:
    return {key: float(np.mean([point[key] for point in points])) for key in SCORES}


def main() -> None:
    parser = study_arguments(__doc__ or "", 2000, SETS, Path("runs/quality"))
    parser.add_argument("--against", type=Path, required=True, help="folder of the other version")
    parser.add_argument("--shares", nargs="+", default=["0.25", "0.5", "1", "2"], help="of the budget, or 'measured'")
    args = parser.parse_args()
    versions = {"now": HERE, "before": args.against.resolve()}
    warnings.simplefilter("ignore")
    rows = []
    for name in args.sets:
        scene = hyrfpack.load_scene((args.data / name).resolve())
        budget, _ = budget_for(scene, TrainConfig(steps=args.steps))
        points: dict[str, list[dict[str, float]]] = {version: [] for version in versions}
        for share in args.shares:
            for version, folder in versions.items():
                seeds = []
                for seed in range(args.seeds):
                    out = args.out.resolve() / f"{args.steps}" / name / f"{version}-{share}-{seed}"
                    out.mkdir(parents=True, exist_ok=True)
                    gaussians = None if share == MEASURED else round(float(share) * budget)
                    seeds.append(run(folder, scene, args.steps, gaussians, seed, out))
                points[version].append(mean_over_seeds(seeds))
        rows.append(row(name, points["now"], points["before"]))
        print(markdown_table(_HEADER, rows[-1:]).splitlines()[-1], flush=True)
    print("\n" + markdown_table(_HEADER, rows))


if __name__ == "__main__":
    main()

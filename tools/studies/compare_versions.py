"""Compare this version of hyrfpack with another one: bytes at equal PSNR, and scores at equal bytes, of compact files.

    git worktree add ../before 42597b1
    python -m tools.studies.compare_versions --against ../before --steps 2000

Each version trains and compresses each data set at several budgets, given as shares of this version's budget. This
version scores the decoded files on held-out photos by PSNR and SSIM. For each data set the table has the change of
bytes at equal PSNR in percent (BD-rate over the common range of PSNR, by monotone cubics). It also has the change of
PSNR in dB and of SSIM at the largest common number of bytes, and the ratio of CPU seconds of `train`. The share
`measured` is the budget that a version chooses itself. With that share alone, the table has PSNR, SSIM and bytes of
both versions and their differences instead. With --sizes, each model is also compressed to shares of its default file,
so one budget is enough for the change of bytes at equal PSNR:

    python -m tools.studies.compare_versions --against ../before --shares measured --sizes 1 0.7 0.5 0.35

Runs are kept in --out and are not repeated while their data set, the version that trains them and its options stay
the same. Their scores are kept while this version stays the same. Uncommitted changes and untracked sources count as
another version. The other version runs with the packages of this environment, and with --against-options for `train`.
CPU seconds are without the compilation of kernels: each version first trains a few steps on the data set.

The results are in docs/research/earlier-versions.md.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import subprocess
import sys
import warnings
from collections.abc import Sequence
from functools import cache
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.interpolate import PchipInterpolator

import hyrfpack
from hyrfpack.errors import HyrfError
from hyrfpack.scene import Scene
from hyrfpack.train import TrainConfig
from hyrfpack.train.setup import budget_for
from tools.command import run_command
from tools.cpu_time import children_cpu_seconds
from tools.json_files import write_json
from tools.studies.reuse import REPOSITORY_ROOT, describe_origin, describe_version, remove_outdated
from tools.studies.train_sets import make_study_parser
from tools.tables import markdown_table

DEFAULT_SETS = (
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
ESTIMATED_BUDGET_SHARE = "measured"
SCORE_KEYS = ("bytes", "psnr", "ssim", "seconds", "gaussians")
COMPILING_STEPS = 20
COMPILING_GAUSSIANS = 500


def train_and_score(
    version: Path,
    scene: Scene,
    steps: int,
    gaussians: int | None,
    seed: int,
    out: Path,
    options: Sequence[str] = (),
    size: float = 1,
) -> dict[str, float]:
    """Train and compress with one version, score with this one, and return bytes, scores, CPU seconds and Gaussians.

    With `gaussians` None, the version chooses its budget. `options` are further options of its command `train`. `size`
    is the share of the bytes of the version's default file that the scored file may have; 1 for that file itself. What
    `out` holds is used again where it comes from the same versions, data, options and number of Gaussians.
    """
    settings = {"steps": steps, "seed": seed, "options": list(options), "gaussians": gaussians}
    data = Path(scene.path)
    remove_outdated(out, describe_origin(data, describe_version(version), **settings))
    remove_outdated(out / "scores", describe_origin(data))
    suffix = "" if size == 1 else f"-{size:g}"
    scores_file = out / "scores" / f"scores{suffix}.json"
    if scores_file.exists():
        return json.loads(scores_file.read_text())
    cpu_time = out / "cpu_seconds.json"  # The last file of a training.
    if not cpu_time.exists():
        compile_kernels(version, data, tuple(options))
        command_options = ["--steps", str(steps), "--seed", str(seed), "--overwrite", *options]
        budget = [] if gaussians is None else ["--max-gaussians", str(gaussians)]
        start_seconds = children_cpu_seconds()
        _run_command(version, "train", str(data), "-o", str(out), *command_options, *budget)
        write_json(cpu_time, children_cpu_seconds() - start_seconds)
    default_file, packed = out / "compact.hyrf", out / f"compact{suffix}.hyrf"
    packed.unlink(missing_ok=True)
    limit = [] if size == 1 else ["--target-size", str(round(size * default_file.stat().st_size))]
    _run_command(version, "compress", str(out / "model.hyrf"), "-o", str(packed), *limit)
    scores = hyrfpack.evaluate_model(hyrfpack.load_model(packed), scene.test)
    result = {
        "bytes": packed.stat().st_size,
        "psnr": scores.psnr,
        "ssim": scores.ssim,
        "seconds": json.loads(cpu_time.read_text()),
        "gaussians": json.loads((out / "metrics.json").read_text())["gaussians"],
    }
    write_json(scores_file, result)
    return result


@cache
def compile_kernels(version: Path, data: Path, options: tuple[str, ...]) -> None:
    """Train a few steps with a version, so that the CPU time of its runs is without the compilation of its kernels."""
    with TemporaryDirectory() as folder:
        steps = ["--steps", str(COMPILING_STEPS), "--max-gaussians", str(COMPILING_GAUSSIANS)]
        _run_command(version, "train", str(data), "-o", str(Path(folder, "run")), *options, *steps)


def _run_command(version: Path, command: str, *arguments: str) -> None:
    """Run a hyrfpack command with the package in the folder `version`."""
    environment = {**os.environ, "PYTHONPATH": str(version)}
    command_line = [sys.executable, "-m", "hyrfpack", command, *arguments]
    process = subprocess.run(command_line, env=environment, cwd=version, capture_output=True, text=True, check=False)
    if process.returncode:
        last_line = (process.stderr.strip().splitlines() or ["no output"])[-1]
        problem = f"{version}: `hyrfpack {command}` ended with exit code {process.returncode}: {last_line}"
        raise HyrfError(problem, fix=f"run it in that folder: {shlex.join(['hyrfpack', command, *arguments])}")


def bytes_change_at_equal_psnr(ours: np.ndarray, theirs: np.ndarray) -> float | None:
    """Return the BD-rate (Bjontegaard) of `ours` against `theirs`: -0.3 means 30 % fewer bytes at equal PSNR.

    Larger files that have no higher PSNR than smaller ones are ignored. It returns None if the ranges of PSNR of the
    others do not overlap.

    Args:
        ours, theirs: (n, 2) bytes and PSNR of the same scene at n sizes.
    """
    curves = []
    for points in (ours, theirs):
        rising = points[np.argsort(points[:, 0])]
        best = np.maximum.accumulate(rising[:, 1])  # a larger file with a lower PSNR is not worth using
        is_better = np.concatenate(([True], np.diff(best) > 0))
        if is_better.sum() < 2:
            return None
        curves.append(PchipInterpolator(best[is_better], np.log(rising[is_better, 0]), extrapolate=False))
    low, high = max(curve.x[0] for curve in curves), min(curve.x[-1] for curve in curves)
    if low >= high:
        return None
    log_bytes = [curve.integrate(low, high) / (high - low) for curve in curves]
    return float(np.exp(log_bytes[0] - log_bytes[1]) - 1)


def score_gain_at_equal_bytes(ours: np.ndarray, theirs: np.ndarray) -> float | None:
    """Return the score of `ours` minus that of `theirs` at the largest number of bytes that both reach.

    Args:
        ours, theirs: (n, 2) bytes and score at n sizes.

    Returns:
        The difference; None if all files of one are larger than those of the other.
    """
    largest = min(points[:, 0].max() for points in (ours, theirs))
    if largest < max(points[:, 0].min() for points in (ours, theirs)):
        return None
    size = np.log(largest)
    values = []
    for points in (ours, theirs):
        rising = points[np.argsort(points[:, 0])]
        values.append(np.interp(size, np.log(rising[:, 0]), rising[:, 1]))
    return float(values[0] - values[1])


def format_row(name: str, ours: list[dict[str, float]], theirs: list[dict[str, float]]) -> list[str]:
    """Format one row of the table from the mean scores over seeds at each budget."""
    curves = [{key: np.array([point[key] for point in points]) for key in SCORE_KEYS} for points in (ours, theirs)]

    def pair(score: str) -> list[np.ndarray]:
        return [np.stack((curve["bytes"], curve[score]), 1) for curve in curves]

    saved = bytes_change_at_equal_psnr(*pair("psnr"))
    cells = [name, "" if saved is None else f"{100 * saved:+.0f} %"]
    for score, digits in _SCORE_DIGITS.items():
        gain = score_gain_at_equal_bytes(*pair(score))
        cells.append("" if gain is None else f"{gain:+.{digits}f}")
    cells.append(f"{np.sum(curves[0]['seconds']) / np.sum(curves[1]['seconds']):.2f}")
    for curve in curves[::-1]:
        points = zip(curve["bytes"], curve["psnr"], strict=True)
        cells.append(", ".join(f"{size / 1000:.0f}: {psnr:.2f}" for size, psnr in points))
    return cells


_SCORE_DIGITS = {"psnr": 2, "ssim": 3}
_TABLE_HEADER = ["set", "bytes at equal PSNR", "dB", "SSIM", "time", "before, kB: dB", "now, kB: dB"]


def format_scores_row(name: str, ours: dict[str, float], theirs: dict[str, float]) -> list[str]:
    """Format one row of the table of both versions' scores at their own budgets."""
    cells = [name]
    for scores in (theirs, ours):
        cells.append(f"{scores['psnr']:.2f}, {scores['ssim']:.3f}, {scores['bytes'] / 1000:.0f}")
    cells += [f"{ours['psnr'] - theirs['psnr']:+.2f}", f"{ours['ssim'] - theirs['ssim']:+.4f}"]
    cells.append(f"{100 * (ours['bytes'] / theirs['bytes'] - 1):+.0f} %")
    return [*cells, f"{ours['seconds'] / theirs['seconds']:.2f}"]


_SCORES_HEADER = ["set", "before: dB, SSIM, kB", "now", "dB", "SSIM", "bytes", "time"]


def mean_over_seeds(points: Sequence[dict[str, float]]) -> dict[str, float]:
    """Return the mean of each score over the seeds."""
    return {key: float(np.mean([point[key] for point in points])) for key in SCORE_KEYS}


def parse_share(text: str) -> str:
    """Return a share of the budget as it was written, for the names of folders; argparse reports other texts.

    Raises:
        ArgumentTypeError: the text is neither a positive number nor ESTIMATED_BUDGET_SHARE.
    """
    try:
        if text == ESTIMATED_BUDGET_SHARE or 0 < float(text) < float("inf"):
            return text
    except ValueError:
        pass
    raise argparse.ArgumentTypeError(f"'{text}' is neither a positive number nor '{ESTIMATED_BUDGET_SHARE}'")


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = make_study_parser(__doc__ or "", 2000, DEFAULT_SETS, Path("runs/quality"), only=False)
    parser.add_argument("--against", type=Path, required=True, help="folder of the other version")
    parser.add_argument(
        "--shares",
        type=parse_share,
        nargs="+",
        default=["0.25", "0.5", "1", "2"],
        help="shares of this version's budget, or 'measured' (0.25 0.5 1 2)",
    )
    parser.add_argument(
        "--sizes", type=float, nargs="+", default=[1.0], help="bytes of the files, as shares of the default file's (1)"
    )
    parser.add_argument(
        "--against-options",
        type=shlex.split,
        default=[],
        help="options of `train` for the other version, as one text: --against-options='--no-exposure --sh-degree 2'",
    )
    return parser


def main() -> None:
    args = make_parser().parse_args()
    shows_scores = args.shares == [ESTIMATED_BUDGET_SHARE] and args.sizes == [1.0]
    header = _SCORES_HEADER if shows_scores else _TABLE_HEADER
    versions = {"now": REPOSITORY_ROOT, "before": args.against.resolve()}
    warnings.simplefilter("ignore")
    rows = []
    for name in args.sets:
        scene = hyrfpack.load_scene((args.data / name).resolve())
        budget, _ = budget_for(scene, TrainConfig(steps=args.steps))
        points: dict[str, list[dict[str, float]]] = {version: [] for version in versions}
        for share, size in product(args.shares, sorted(args.sizes, reverse=True)):
            for version, folder in versions.items():
                seeds = []
                for seed in range(args.seeds):
                    out = args.out.resolve() / f"{args.steps}" / name / f"{version}-{share}-{seed}"
                    gaussians = None if share == ESTIMATED_BUDGET_SHARE else round(float(share) * budget)
                    options = args.against_options if version == "before" else []
                    seeds.append(train_and_score(folder, scene, args.steps, gaussians, seed, out, options, size))
                points[version].append(mean_over_seeds(seeds))
        now, before = points["now"], points["before"]
        rows.append(format_scores_row(name, now[0], before[0]) if shows_scores else format_row(name, now, before))
        print(markdown_table(header, rows[-1:]).splitlines()[-1], flush=True)
    print("\n" + markdown_table(header, rows))


if __name__ == "__main__":
    run_command(main)

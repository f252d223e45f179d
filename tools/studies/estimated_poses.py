"""Compare training on given poses with training on poses estimated by hyrfpack, with the same photos and split.

    python -m tools.studies.poses --out runs/poses                            estimates the poses of every set
    python -m tools.studies.estimated_poses --scenes runs/poses --steps 1000        trains on both and prints the table

Photos without an estimated pose are left out of both runs and counted. The table has PSNR in dB on held-out photos,
which are every 8th of the common ones. Each reconstruction undistorts the photos with its own cameras.

The results are in docs/research/poses.md.
"""

from __future__ import annotations

import argparse
import dataclasses
import statistics
from pathlib import Path, PurePosixPath

import hyrfpack
from hyrfpack.scene import Scene
from tools.command import positive_integer, run_command
from tools.json_files import merge_rows
from tools.studies.complete_run import train_completely
from tools.studies.train_sets import DATA_FOLDER, choose_names
from tools.tables import markdown_table

TEST_EVERY = 8


def select_common_photos(given: Scene, own: Scene) -> tuple[Scene, Scene, int]:
    """Return both scenes with their common photos and the same split, and the number of photos missing in `own`."""

    def by_stem(scene: Scene) -> dict[str, hyrfpack.View]:
        return {str(PurePosixPath(view.name).with_suffix("")): view for view in scene.views}

    views = by_stem(given), by_stem(own)
    names = sorted(views[0].keys() & views[1].keys())
    held_out = set(names[::TEST_EVERY])

    def restrict(scene: Scene, views_by_name: dict[str, hyrfpack.View]) -> Scene:
        train = [views_by_name[name] for name in names if name not in held_out]
        return dataclasses.replace(scene, train=train, test=[views_by_name[name] for name in names if name in held_out])

    return restrict(given, views[0]), restrict(own, views[1]), len(views[0]) - len(names)


def train_and_score(scene: Scene, out: Path, steps: int, seed: int) -> float:
    """Train a model; return its mean PSNR in dB on held-out photos."""
    config = hyrfpack.TrainConfig(steps=steps, seed=seed, budget_factor=1.0)
    result = train_completely(scene, out, config, context=hyrfpack.RunContext(progress=None))
    return result.metrics["evaluation"]["psnr"]


def measure(name: str, data: Path, scenes: Path, out: Path, steps: int, seeds: int) -> dict:
    """Train on both sets of poses of one data set with each seed; return the row."""
    given, own, missing = select_common_photos(
        hyrfpack.load_scene(data / name, layout="colmap"), hyrfpack.load_scene(scenes / name, layout="colmap")
    )
    scores = {
        kind: [train_and_score(scene, out / name / f"{kind}-{seed}", steps, seed) for seed in range(seeds)]
        for kind, scene in (("given", given), ("own", own))
    }
    return {"set": name, "steps": steps, "photos": len(given.views), "lacking": missing, **scores}


def format_table(rows: list[dict]) -> str:
    """Format the rows and the mean loss as a Markdown table."""
    table_rows, losses = [], []
    for row in rows:
        given, own = statistics.mean(row["given"]), statistics.mean(row["own"])
        losses.append(given - own)
        counts = [str(row["photos"]), str(row["lacking"])]
        table_rows.append([row["set"], *counts, f"{given:.2f}", f"{own:.2f}", f"{losses[-1]:+.2f}"])
    table_rows.append(["mean", "", "", "", "", f"{statistics.mean(losses):+.2f}"])
    return markdown_table(
        ["set", "photos", "without estimated pose", "given poses, dB", "estimated poses, dB", "loss, dB"], table_rows
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--scenes", type=Path, default=Path("runs/poses"), help="folder that `tools.studies.poses` has written"
    )
    parser.add_argument("--sets", nargs="*", help="names of data sets (all in --scenes)")
    parser.add_argument("--data", type=Path, default=DATA_FOLDER, help="folder of the data sets")
    parser.add_argument("--steps", type=positive_integer, default=1000, help="training steps of each run (1,000)")
    parser.add_argument("--seeds", type=positive_integer, default=1, help="number of seeds for each data set (1)")
    parser.add_argument("--out", type=Path, default=Path("runs/own-poses"), help="folder for results (runs/own-poses)")
    args = parser.parse_args()
    posed = sorted(path.parent.name for path in args.scenes.glob("*/sparse"))
    fix = "estimate poses with tools.studies.poses, and name its folder with `scenes`"
    names = choose_names(args.sets, posed, f"{args.scenes}: there are no estimated poses", fix)
    rows = []
    for name in names:
        rows.append(measure(name, args.data, args.scenes, args.out, args.steps, args.seeds))
        print(format_table(rows[-1:]).splitlines()[2], flush=True)
        merge_rows(args.out / "table.json", rows[-1:], keys=("set", "steps"))
    print("\n" + format_table(rows))


if __name__ == "__main__":
    run_command(main)

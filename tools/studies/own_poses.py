"""What training loses on poses of our own: the same photos and split, with the given poses and with ours.

    python -m tools.studies.poses --out runs/poses                            estimates the poses of every set
    python -m tools.studies.own_poses --scenes runs/poses --steps 1000        trains on both and prints the table

A photo that our poses lack is left out of both runs and counted. Scores are on held-out photos (every 8th of those in
both), each in its own reconstruction: a photo is undistorted by the camera that it is scored with.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import statistics
from pathlib import Path, PurePosixPath

import hyrfpack
from hyrfpack.scene import Scene
from tools.studies.train_sets import DATA
from tools.tables import markdown_table

TEST_EVERY = 8


def common(given: Scene, own: Scene) -> tuple[Scene, Scene, int]:
    """Both scenes with the photos that both have, split alike, and how many the second lacks."""

    def by_stem(scene: Scene) -> dict[str, hyrfpack.View]:
        return {str(PurePosixPath(view.name).with_suffix("")): view for view in scene.views}

    views = by_stem(given), by_stem(own)
    names = sorted(views[0].keys() & views[1].keys())
    held_out = set(names[::TEST_EVERY])

    def restrict(scene: Scene, its: dict[str, hyrfpack.View]) -> Scene:
        train = [its[name] for name in names if name not in held_out]
        return dataclasses.replace(scene, train=train, test=[its[name] for name in names if name in held_out])

    return restrict(given, views[0]), restrict(own, views[1]), len(views[0]) - len(names)


def score(scene: Scene, out: Path, steps: int, seed: int) -> float:
    """Mean PSNR on held-out photos of a model trained for so many steps."""
    result = hyrfpack.train_model(
        scene, out, hyrfpack.TrainConfig(steps=steps, seed=seed, budget_factor=1.0), overwrite=True, quiet=True
    )
    return result.metrics["evaluation"]["psnr"]


def measure(name: str, data: Path, scenes: Path, out: Path, steps: int, seeds: int) -> dict:
    """Train on both poses of one set with each seed."""
    given, own, lacking = common(
        hyrfpack.load_scene(data / name, layout="colmap"), hyrfpack.load_scene(scenes / name, layout="colmap")
    )
    scores = {
        kind: [score(scene, out / name / f"{kind}-{seed}", steps, seed) for seed in range(seeds)]
        for kind, scene in (("given", given), ("own", own))
    }
    return {"set": name, "photos": len(given.views), "lacking": lacking, **scores}


def table(rows: list[dict]) -> str:
    """The rows as Markdown, and their mean."""
    lines, losses = [], []
    for row in rows:
        given, own = statistics.mean(row["given"]), statistics.mean(row["own"])
        losses.append(given - own)
        counts = [str(row["photos"]), str(row["lacking"])]
        lines.append([row["set"], *counts, f"{given:.2f}", f"{own:.2f}", f"{losses[-1]:+.2f}"])
    lines.append(["mean", "", "", "", "", f"{statistics.mean(losses):+.2f}"])
    return markdown_table(
        ["set", "photos", "without a pose of ours", "given poses, dB", "our poses, dB", "loss, dB"], lines
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=Path, default=Path("runs/poses"), help="scenes of `tools.studies.poses`")
    parser.add_argument("--sets", nargs="*", help="names of sets; all that --scenes has by default")
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("runs/own-poses"))
    args = parser.parse_args()
    names = args.sets or sorted(folder.name for folder in args.scenes.iterdir() if (folder / "sparse").is_dir())
    rows = []
    args.out.mkdir(parents=True, exist_ok=True)
    for name in names:
        rows.append(measure(name, args.data, args.scenes, args.out, args.steps, args.seeds))
        print(table(rows[-1:]).splitlines()[2], flush=True)
        (args.out / "table.json").write_text(json.dumps(rows, indent=1))
    print("\n" + table(rows))


if __name__ == "__main__":
    main()

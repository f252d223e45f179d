"""Measure the time and memory of a training step for several numbers of Gaussians.

    python -m tools.studies.densify_model --data ../shared/data/mipnerf360_bonsai --out runs/million
    python -m tools.studies.step_cost --data ../shared/data/mipnerf360_bonsai --model runs/million/model.hyrf

The Gaussians are an even selection of those of --model; if it has fewer, they are repeated with an offset. The photos
are scaled to --size. Each number of Gaussians runs in its own process. The table has median seconds of a step, seconds
of the step with a round of density control, peak memory in MB, and the bytes per Gaussian that training adds after the
model and the photos are loaded.

The results are in docs/research/scaling.md.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import statistics
import sys
import time
from pathlib import Path

import numpy as np
import torch
from PIL import Image

import hyrfpack
from hyrfpack.model import HybridModel
from hyrfpack.scene import Camera, Picture, Scene, View, evenly_spaced
from hyrfpack.train import DensityConfig, TrainConfig, Trainer
from hyrfpack.train.log import peak_memory
from tools.command import positive_integer, read_child_json, run_command
from tools.tables import markdown_table

MAX_PHOTOS = 8


def resample_gaussians(model: HybridModel, count: int) -> HybridModel:
    """Return the model with `count` evenly selected Gaussians; repeated ones get a random offset of their own size."""
    available, generator = len(model), torch.Generator().manual_seed(0)
    chosen = torch.arange(count) * available // count if count <= available else torch.arange(count) % available
    part, is_repeated = model.subset(chosen), torch.arange(count) >= available
    with torch.no_grad():
        scales = model.decode_geometry().scales[chosen[is_repeated]]
        part.gaussians.positions[is_repeated] += scales * torch.randn(len(scales), 3, generator=generator)
    return part


def scale_view(view: View, width: int, height: int) -> View:
    """Return a view whose photo is scaled to a size in pixels."""
    camera = view.camera
    x, y = width / camera.width, height / camera.height
    fx, fy, cx, cy = camera.intrinsics
    picture = Picture(np.asarray(Image.fromarray(view.load().rgb).resize((width, height))))
    larger = Camera(width, height, fx * x, fy * y, cx * x, cy * y, camera.camera_from_world)
    return View(view.name, larger, lambda: picture)


def measure_steps(scene: Scene, model: HybridModel, steps: int) -> dict:
    """Train `steps` steps; return the median seconds of a step, those with the round, and peak and added bytes."""
    density = DensityConfig(start=0.5, stop=0.5, peak=0.5, rounds=1)
    config = TrainConfig(
        steps=steps, resolution_schedule=False, max_gaussians=len(model), density=density, exposure=False
    )
    initial_peak = peak_memory() or 0
    trainer = Trainer(scene, config, model=model)
    is_round = [trainer.strategy.acting(step) for step in range(1, steps + 1)]
    ends = [time.perf_counter()]
    trainer.run(progress=lambda _: ends.append(time.perf_counter()))
    seconds = np.diff(ends)
    peak = peak_memory() or 0
    parts = {name: round(value / steps, 3) for name, value in sorted(trainer.seconds.items())}
    return {
        "step": statistics.median(seconds[2:]),  # the first steps compile kernels
        "round": float(seconds[is_round].max()),
        "peak": peak,
        "added": peak - initial_peak,
        "parts": parts,
    }


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="a data set")
    parser.add_argument("--model", type=Path, required=True, help="a model of that data set with many Gaussians")
    parser.add_argument(
        "--gaussians",
        type=positive_integer,
        nargs="+",
        default=[50_000, 200_000, 1_000_000, 3_000_000],
        help="numbers of Gaussians (50,000 200,000 1,000,000 3,000,000)",
    )
    parser.add_argument(
        "--size", type=int, nargs=2, default=[800, 600], help="width and height of the photos in pixels (800 600)"
    )
    parser.add_argument("--steps", type=positive_integer, default=16, help="training steps (16)")
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.one:
        scene = hyrfpack.load_scene(options.data)
        views = [scale_view(view, *options.size) for view in evenly_spaced(scene.train, MAX_PHOTOS)]
        model = resample_gaussians(hyrfpack.load_model(options.model), options.gaussians[0])
        print(json.dumps(measure_steps(dataclasses.replace(scene, train=views, test=[]), model, options.steps)))
        return
    rows = []
    for count in options.gaussians:
        child_options = ["--one", "--gaussians", count, "--data", options.data, "--model", options.model]
        child_options += ["--steps", options.steps, "--size", *options.size]
        costs = read_child_json("tools.studies.step_cost", child_options)
        print(count, costs, file=sys.stderr)
        rows.append(
            [
                f"{count:,}",
                f"{costs['step']:.2f}",
                f"{costs['round']:.2f}",
                f"{costs['peak'] / 1e6:,.0f}",
                f"{costs['added'] / count:,.0f}",
            ]
        )
    print(
        markdown_table(["Gaussians", "s a step", "s with density control", "peak, MB", "added bytes a Gaussian"], rows)
    )


if __name__ == "__main__":
    run_command(main)

"""What a training step takes in time and memory, by the number of Gaussians.

    python -m tools.studies.densify_model --data ../shared/data/mipnerf360_bonsai --out runs/million
    python -m tools.studies.large --data ../shared/data/mipnerf360_bonsai --model runs/million/model.hyrf

Of --model as many Gaussians as are wanted are taken, spread over it; where it has fewer, each is repeated beside
itself. The photos are scaled to --size. Each number has a process of its own, whose memory is told at its peak, and
beyond what it had with model and photos read. A round of density control falls in the middle of the steps.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import statistics
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import torch
from PIL import Image

import hyrfpack
from hyrfpack.model import HybridModel
from hyrfpack.scene import Camera, Picture, Scene, View
from hyrfpack.train import DensityConfig, TrainConfig, Trainer
from hyrfpack.train.log import peak_memory
from tools.tables import markdown_table

PHOTOS = 8  # that are taken of the set


def of_so_many(model: HybridModel, count: int) -> HybridModel:
    """The model with so many of its Gaussians, spread over them; further ones a standard deviation off."""
    there, generator = len(model), torch.Generator().manual_seed(0)
    chosen = torch.arange(count) * there // count if count <= there else torch.arange(count) % there
    part, again = model.part(chosen), torch.arange(count) >= there
    with torch.no_grad():
        scales = model.decode_geometry().scales[chosen[again]]
        part.gaussians.positions[again] += scales * torch.randn(len(scales), 3, generator=generator)
    return part


def scaled(view: View, width: int, height: int) -> View:
    """A view whose photo has so many pixels."""
    camera = view.camera
    x, y = width / camera.width, height / camera.height
    fx, fy, cx, cy = camera.intrinsics
    picture = Picture(np.asarray(Image.fromarray(view.load().rgb).resize((width, height))))
    larger = Camera(width, height, fx * x, fy * y, cx * x, cy * y, camera.camera_from_world)
    return View(view.name, larger, lambda: picture)


def measured(scene: Scene, model: HybridModel, steps: int) -> dict:
    """Seconds of a step, in the median and of the one with a round of density control, and bytes."""
    density = DensityConfig(start=0.5, stop=0.5, peak=0.5, rounds=1)
    config = TrainConfig(steps=steps, max_gaussians=len(model), density=density, exposure=False)
    before = peak_memory() or 0
    trainer = Trainer(scene, config, model=model)
    ends = [time.perf_counter()]
    trainer.run(report=lambda *_: ends.append(time.perf_counter()))
    seconds = np.diff(ends)[2:]  # kernels are compiled in the first ones
    peak = peak_memory() or 0
    parts = {name: round(value / steps, 3) for name, value in sorted(trainer.seconds.items())}
    return {
        "step": statistics.median(seconds),
        "round": float(seconds.max()),
        "peak": peak,
        "added": peak - before,
        "parts": parts,
    }


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--model", type=Path, required=True, help="of that set, of many Gaussians")
    parser.add_argument("--gaussians", type=int, nargs="+", default=[50_000, 200_000, 1_000_000, 3_000_000])
    parser.add_argument("--size", type=int, nargs=2, default=[800, 600])
    parser.add_argument("--steps", type=int, default=16)
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.one:
        scene = hyrfpack.load_scene(options.data)
        views = [scaled(view, *options.size) for view in scene.train[:: max(1, len(scene.train) // PHOTOS)]]
        model = of_so_many(hyrfpack.load_model(options.model), options.gaussians[0])
        print(json.dumps(measured(dataclasses.replace(scene, train=views, test=[]), model, options.steps)))
        return
    rows = []
    for count in options.gaussians:
        again = [sys.executable, "-m", "tools.studies.large", "--one", "--gaussians", str(count)]
        again += ["--data", str(options.data), "--model", str(options.model), "--steps", str(options.steps)]
        again += ["--size", *map(str, options.size)]
        done = subprocess.run(again, check=True, stdout=subprocess.PIPE, text=True)
        found = json.loads(done.stdout.splitlines()[-1])
        print(count, found, file=sys.stderr)
        rows.append(
            [
                f"{count:,}",
                f"{found['step']:.2f}",
                f"{found['round']:.2f}",
                f"{found['peak'] / 1e6:,.0f}",
                f"{found['added'] / count:,.0f}",
            ]
        )
    print(markdown_table(["Gaussians", "s a step", "with a round", "peak, MB", "bytes a Gaussian added"], rows))


if __name__ == "__main__":
    main()
